"""The paper's figures by name; importing the package registers them."""

from lp_framework.figures import cameras, failures, landscapes, recall, score_vs_energy, toy, trajectories

__all__ = ["cameras", "failures", "landscapes", "recall", "score_vs_energy", "toy", "trajectories"]
