"""Networks that map a link to its label without rays or Gaussians: MLP, FIRE, DCGAN, WRF-KAN."""
