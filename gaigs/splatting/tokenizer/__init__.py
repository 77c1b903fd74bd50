"""Tokenizers embed the query, the Gaussians and the whole scene."""
