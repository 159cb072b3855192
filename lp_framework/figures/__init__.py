"""The paper's figures by name; importing the package registers them."""

from lp_framework.figures import landscapes, results

__all__ = ["landscapes", "results"]
