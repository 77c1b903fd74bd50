"""Rooms of any shape, simulated by the independent ray tracer Sionna RT."""
