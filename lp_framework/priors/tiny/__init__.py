"""A small pose-conditioned diffusion model that is trained in minutes and ships with its weights."""
