"""The paper's figures; importing the package registers them by name."""

from lp_framework.figures import landscapes, results

__all__ = ["landscapes", "results"]
