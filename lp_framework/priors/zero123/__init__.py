"""Zero123 (Liu et al. 2023) and Zero123-XL: Stable Diffusion's networks conditioned on an image and a relative pose."""
