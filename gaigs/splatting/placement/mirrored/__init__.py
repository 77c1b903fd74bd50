"""Mirrored Gaussians: each stands at an image of the transmitter in learnt planes, the walls of the
room.
"""
