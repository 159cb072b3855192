"""The description of an answer: words, probability, second answer and verdict."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from toy_views import toy_view

from lp_framework.analysis.confidence import DOUBT, TRUST, Answer, answers, answers_by_prior, denoising_errors, in_words
from lp_framework.api import load_prior, view_set
from lp_framework.data.rendering.raycast import RaycastRenderer
from lp_framework.geometry import camera_to_world
from lp_framework.solvers.base import Cost, Solution


def solution(*pairs: list[tuple[float, float, float]]) -> Solution:
    """Pairs of ends, each (latitude, longitude) in degrees and its probability; the first is the answer."""
    ends = torch.tensor(pairs)
    poses = torch.cat([torch.deg2rad(ends[..., :2]), torch.zeros_like(ends[..., :1])], dim=-1)
    first = torch.zeros(len(ends), dtype=torch.long)
    valid = poses.isfinite().all(dim=-1)
    return Solution(poses, -ends[..., 2], valid, first, Cost(1, 0.1), probability=ends[..., 2])


@pytest.mark.parametrize(
    ("latitude", "longitude", "words"),
    [
        (10, 30, "30° to the right, 10° up"),
        (-10, 330, "30° to the left, 10° down"),
        (0, 90, "90° to the right"),
        (5, 0, "5° up"),
        (0, -180, "180° round"),
        (3, 179.8, "180° round, 3° up"),
        (0.2, 359.9, "the same viewpoint"),
        (math.nan, 0, "no pose"),
    ],
)
def test_words(latitude: float, longitude: float, words: str):
    assert in_words(math.radians(latitude), math.radians(longitude)) == words


def test_right_is_where_a_camera_goes_that_then_sees_more_of_what_was_on_the_right():
    """A box with a red side at the right of the reference's picture: from 60 degrees to the right it faces us."""
    box = trimesh.creation.box((0.6, 0.6, 0.6))
    colours = np.full((len(box.faces), 4), [90, 90, 90, 255], dtype=np.uint8)
    colours[box.face_normals[:, 0] > 0.9] = [255, 0, 0, 255]
    box.visual.face_colors = colours

    def red(longitude: float) -> np.ndarray:
        camera = camera_to_world(torch.tensor([[0.0, math.radians(longitude), 1.6]], dtype=torch.float64))
        pixels = RaycastRenderer().render(trimesh.Scene([box]), camera, 64, 49.1)[0].astype(int)
        return (pixels[..., 0] > pixels[..., 1] + 60) & (pixels[..., 3] > 128)

    near, far, other = red(20), red(60), red(-60)
    assert near.any() and np.nonzero(near)[1].mean() > 32  # the right side of the picture
    assert far.sum() > 2 * near.sum() and not other.any()
    assert in_words(0.0, math.radians(60 - 20)) == "40° to the right"


def test_verdicts_go_by_the_probability():
    assert [Answer(0, 0, each).verdict for each in (1.0, TRUST, 0.79, DOUBT, 0.49, 0.0, math.nan)] == [
        "trust", "trust", "doubtful", "doubtful", "do not trust", "do not trust", "",
    ]  # fmt: skip


def test_the_second_answer_is_the_most_probable_end_elsewhere():
    half, quarter, near = answers(
        solution(
            [(0, 30, 0.6), (0, 32, 0.6), (0, 212, 0.31), (0, 120, 0.04)],
            [(0, 350, 0.7), (0, 80, 0.2), (0, 200, 0.02), (0, 200, 0.02)],
            [(0, 10, 0.9), (20, 40, 0.4), (0, 180, 0.04), (0, 180, 0.04)],
        )
    )
    assert half.second_words == "148° to the left, probability 0.31 (about half a turn away: front and back look alike)"
    assert quarter.second_words == "80° to the right, probability 0.20"
    assert near.second is None and near.second_words == ""  # of the others one is too near, one not worth telling
    assert (half.words, half.verdict, near.verdict) == ("30° to the right", "doubtful", "trust")


def test_no_verdict_without_a_probability_or_a_pose():
    assert answers(None) == []
    silent = solution([(0, 30, 0.6)])
    assert answers(Solution(silent.poses, silent.energies, silent.valid, silent.chosen, silent.cost)) == []
    (failed,) = answers(solution([(math.nan, 0, math.nan), (math.nan, 0, math.nan)]))
    assert (failed.words, failed.verdict, failed.second) == ("no pose", "", None)


@pytest.mark.parametrize(("recoloured", "verdict"), [(False, "trust"), (True, "do not trust")])
def test_a_prior_distinguishes_familiar_from_unfamiliar_objects(recoloured, verdict):
    views = [toy_view("duck", *place) for place in ((6, 17), (-11, 69))]
    if recoloured:
        pixels = [np.asarray(view) for view in views]
        views = [Image.fromarray(np.concatenate([255 - each[..., :3] // 2, each[..., 3:]], -1)) for each in pixels]
    pairs, prior = view_set(views, torch.device("cpu")).with_first(), load_prior("tiny")
    true = torch.deg2rad(torch.tensor([[-17.0, 52.0, 0.0]]))
    (answer,) = answers_by_prior(prior, pairs, true)
    assert answer.verdict == verdict and "what it is for objects that the prior knows" in answer.reason
    error = denoising_errors(prior, pairs, true).item()
    assert answer.strangeness == pytest.approx(error / prior.usual_error)
    prior.usual_error = None
    assert answers_by_prior(prior, pairs, true) == []
