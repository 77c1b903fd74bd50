"""Mirrored Gaussians: each is at an image of the transmitter in the learnt walls."""
