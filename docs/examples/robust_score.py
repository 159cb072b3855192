"""A score model with a robust loss, in which large errors count less."""

from torch import Tensor

from lp_framework.errors import check_settings
from lp_framework.models.backbones import Backbone
from lp_framework.models.pose_model import ScoreModel
from lp_framework.registry import register


@register("model", "robust_score")
class RobustScore(ScoreModel):
    """Score network trained by denoising score matching with a pseudo-Huber loss."""

    def __init__(
        self,
        backbone: Backbone,
        delta: float = 0.5,
        sigma: float = 1.0,
        hidden: int = 256,
        learning_rate: float = 2e-3,
        seed: int = 0,
    ) -> None:
        settings = {"hidden": hidden, "learning_rate": learning_rate, "seed": seed}
        super().__init__(backbone, sigma=sigma, **settings)
        check_settings("model", ("delta", delta, delta > 0, "positive"))
        self.delta = delta

    def pair_loss(self, condition: Tensor, noised: Tensor, true: Tensor) -> Tensor:
        """delta^2 (sqrt(1 + |e|^2 / delta^2) - 1), `[...]`, with e the score's error.

        Errors much smaller than delta count quadratically, larger ones linearly.
        """
        error = self.network(condition, noised) - self.kernel.score(noised, true)
        squares = error.square().sum(dim=-1)
        return self.delta**2 * ((1 + squares / self.delta**2).sqrt() - 1)
