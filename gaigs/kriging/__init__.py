"""Kriging: Gaussian processes over the places of links, for the models that use them."""
