"""Gaussian processes over links."""
