"""Files: tables, images, meshes, YAML and atomic writes."""

FAR = 1e5
"""Bound of all coordinates [m]: float32 resolves 8 mm there, and half a metre at UTM's northings.
"""

WITHIN = "positions within 1e5 m of the origin on each axis (subtract a common origin from all)"
