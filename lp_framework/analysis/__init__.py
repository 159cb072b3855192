"""Computations behind the figures: energy landscapes, fields, and pairs with their explanations."""
