"""`solver=dust3r` and `solver=vggt`: all of their geometry, with mocks of the authors' packages."""

from __future__ import annotations

import sys

import baseline_stand_ins
import numpy as np
import pytest
import torch
from baseline_stand_ins import KnownNetwork, PairViewer, know, packages
from PIL import Image
from safetensors.torch import save_file
from solver_problems import exact_pairs
from torch import Tensor

from lp_framework import registry
from lp_framework.errors import UserError
from lp_framework.geometry import (
    at_optimal_scale,
    camera_to_world,
    relative_camera,
    rotation_error,
    translation_error,
    wrap_angle,
)
from lp_framework.solvers.base import Solver

BOTH = pytest.mark.parametrize("name", ["dust3r", "vggt"])


def build(name: str, **settings: object) -> Solver:
    with packages():
        return registry.build("solver", {"name": name, **settings})


@BOTH
@pytest.mark.parametrize("scale", [0.1, 1.0, 7.0])
def test_known_cameras_come_out_as_relative_cameras_and_poses(name, scale, monkeypatch):
    monkeypatch.setattr(KnownNetwork, "scale", scale)
    pairs, true = exact_pairs(8)
    solution = know(build(name)).solve(pairs, torch.zeros(8, 3, 3), seed=0)
    reference, query = (pairs.images[index].flatten(1)[:, :3].double() for index in (pairs.reference, pairs.query))
    wanted = relative_camera(camera_to_world(reference), camera_to_world(query))
    found = solution.cameras[:, 0].double()
    assert solution.poses.shape == (8, 1, 3) and solution.valid.all()
    assert rotation_error(found, wanted).max() < 0.01
    torch.testing.assert_close(found[:, :3, 3], scale * wanted[:, :3, 3], rtol=0, atol=1e-4 * scale)
    assert translation_error(at_optimal_scale(found, wanted), wanted).max() < 1e-4
    assert wrap_angle(solution.answer()[:, 1] - true[:, 1]).abs().max() < 1e-3
    assert solution.cost.network_passes == {"dust3r": 16, "vggt": 8}[name]


def test_dust3r_has_no_answer_where_its_viewer_found_no_camera(monkeypatch):
    monkeypatch.setattr(PairViewer, "fails", True)
    pairs, _ = exact_pairs(2)
    solution = know(build("dust3r")).solve(pairs, torch.zeros(2, 1, 3), seed=0)
    assert not solution.valid.any() and solution.poses.isnan().all() and solution.cameras.isnan().all()


@BOTH
def test_images_are_whole_at_the_size_and_in_the_range_that_the_network_expects(name, monkeypatch):
    seen: list[Tensor] = []
    if name == "vggt":
        aggregate = KnownNetwork.aggregator
        monkeypatch.setattr(
            KnownNetwork, "aggregator", lambda self, images: (seen.append(images * 2 - 1), aggregate(self, images))[1]
        )
    else:
        infer = baseline_stand_ins.inference
        monkeypatch.setattr(
            baseline_stand_ins,
            "inference",
            lambda pairs, *rest, **more: (
                seen.append(torch.stack([view["img"][0] for view in pairs[0]])[None]),
                infer(pairs, *rest, **more),
            )[1],
        )
    solver = build(name)
    pixels = np.random.default_rng(0).integers(60, 190, (24, 24, 3), dtype=np.uint8)  # Pillow cuts off in between
    images = torch.from_numpy(pixels).permute(2, 0, 1).float() / 127.5 - 1
    pairs, _ = exact_pairs(1)
    both = torch.stack([images, images.flip(-1)])
    solver.solve(type(pairs)(both, torch.tensor([0]), torch.tensor([1]), torch.tensor([0])), torch.zeros(1, 1, 3), 0)
    size = {"dust3r": 512, "vggt": 518}[name]
    assert seen[0].shape == (1, 2, 3, size, size)
    published = np.asarray(Image.fromarray(pixels).resize((size, size), Image.Resampling.BICUBIC), dtype=np.float32)
    torch.testing.assert_close(
        (seen[0][0, 0].permute(1, 2, 0) + 1) * 127.5, torch.from_numpy(published), rtol=0, atol=1.5
    )


@BOTH
def test_networks_are_frozen_and_can_be_found(name):
    solver = build(name)
    assert isinstance(solver.network, KnownNetwork) and not solver.network.training
    assert not any(each.requires_grad for each in solver.network.parameters())


@pytest.mark.parametrize("suffix", [".pt", ".safetensors"])
def test_weights_of_vggt_from_a_file(tmp_path, suffix):
    file = tmp_path / f"model{suffix}"
    weights = {"weight": torch.tensor(3.0)}
    save_file(weights, file) if suffix == ".safetensors" else torch.save(weights, file)
    assert build("vggt", weights=str(file)).network.weight == 3.0


# ---------------------------------------------------------------- mistakes


def test_without_the_package_of_dust3r():
    message = "solver=dust3r needs the Python package 'dust3r', which is not installed: see docs/baselines.md"
    with pytest.raises(UserError, match=message):
        registry.build("solver", "dust3r")


def test_without_the_package_of_vggt():
    message = r"solver=vggt needs the Python package 'vggt', which is not installed: pip install git\+https"
    with pytest.raises(UserError, match=message):
        registry.build("solver", "vggt")


def test_a_package_with_a_missing_dependency(monkeypatch):
    with packages():
        monkeypatch.setitem(sys.modules, "dust3r.cloud_opt", None)
        with pytest.raises(UserError, match=r"solver=dust3r needs the Python package 'dust3r.cloud_opt'"):
            registry.build("solver", "dust3r")
        monkeypatch.undo()


@BOTH
def test_missing_weights(name, tmp_path):
    with pytest.raises(UserError, match=r"gone.pth: there is no such file with the weights of"):
        build(name, weights="gone.pth")
    with pytest.raises(
        UserError, match=r"nobody/nothing: the weights of .* cannot be loaded from there .*identifier\); give"
    ):
        build(name, weights="nobody/nothing")


def test_weights_of_another_network(tmp_path):
    torch.save({"other": torch.ones(2)}, tmp_path / "other.pt")
    with pytest.raises(UserError, match=r"other.pt: the weights of VGGT cannot be loaded from there"):
        build("vggt", weights=str(tmp_path / "other.pt"))


@pytest.mark.parametrize(("name", "patch"), [("dust3r", 16), ("vggt", 14)])
def test_an_image_size_that_is_no_multiple_of_the_patch(name, patch):
    with pytest.raises(UserError, match=f"solver.image_size must be a multiple of {patch}, got 500"):
        build(name, image_size=500)
