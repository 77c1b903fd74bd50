"""The paper's pipeline, from Gaussians and their placement to the value that a receiver reports."""
