"""Reading and writing files: tables, meshes, YAML, and files written at once."""
