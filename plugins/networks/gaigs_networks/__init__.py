"""Networks that map a link to its whole label, without rays or Gaussians: MLP, FIRE, DCGAN, WRF-KAN."""
