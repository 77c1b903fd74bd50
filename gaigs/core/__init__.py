"""Geometry, antennas, queries, tasks and laws of propagation, used by all other parts."""
