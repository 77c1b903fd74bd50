"""Mirrored Gaussians: each is at the transmitter's mirror image in learnt walls."""
