"""Priors: frozen diffusion models of what one view of an object says about another."""
