"""Geometry, antennas, queries, tasks and laws of propagation, which all other parts share."""
