"""Geometry, antennas, queries, tasks and the laws of propagation: what data, models and figures
share.
"""
