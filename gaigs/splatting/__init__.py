"""The paper's pipeline: Gaussians, their placement, tokens, deformation, projection, rasterizer and
pooling.
"""
