"""Files: tables, images, meshes, YAML and atomic writes."""
