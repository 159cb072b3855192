"""The paper's figures by name; importing the package registers them."""

from lp_framework.figures import cameras, fields, landscapes, recall

__all__ = ["cameras", "fields", "landscapes", "recall"]
