"""The paper's pipeline, from Gaussians and their placement to the label of a receiver."""
