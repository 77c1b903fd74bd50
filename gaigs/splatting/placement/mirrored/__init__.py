"""Mirrored Gaussians: each stands at an image of the transmitter in the learnt walls."""
