"""The planes of a room: searches in measured links, refinement, materials and surfaces."""
