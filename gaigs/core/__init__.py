"""Geometry, antennas, queries, tasks and propagation, used by all other parts."""
