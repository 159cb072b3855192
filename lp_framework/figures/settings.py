"""Settings that several figures have."""

from __future__ import annotations

from collections.abc import Sequence

from lp_framework.errors import UserError
from lp_framework.priors.base import Prior


def check_noises(prior: Prior, timesteps: Sequence[int], noises: int) -> None:
    """`UserError` unless the prior has all of the timesteps, at least one, and there is at least one noise for each."""
    if not timesteps or not all(0 <= each < prior.num_timesteps for each in timesteps):
        raise UserError(
            f"figure.timesteps must list some of 0 to {prior.num_timesteps - 1}, which this prior has; "
            f"got {list(timesteps)}"
        )
    if noises < 1:
        raise UserError(f"figure.noises must be at least 1, got {noises}")


def noises_in_words(timesteps: Sequence[int], noises: int) -> str:
    """A sentence for captions.

    >>> noises_in_words([100, 900], 5)
    'Mean over both directions of the pair, timesteps 100, 900 and 5 noises at each.'
    """
    each = "one noise" if noises == 1 else f"{noises} noises"
    return f"Mean over both directions of the pair, timesteps {', '.join(map(str, timesteps))} and {each} at each."
