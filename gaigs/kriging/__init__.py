"""Kriging: Gaussian processes over links, below the models that use them."""
