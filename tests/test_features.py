"""`solver=features`: known two-view geometry, rendered objects, and images without enough matches."""

from __future__ import annotations

import csv
import json
import math
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from baseline_stand_ins import FIELD_OF_VIEW, KnownMatcher, know
from exact_prior import image_of
from solver_problems import exact_pairs
from torch import Tensor
from view_folders import random_poses, write_objects, write_split

from lp_framework import registry
from lp_framework.analysis.pairs import shown_pairs
from lp_framework.data.module import PairDataModule
from lp_framework.data.rendering.raycast import RaycastRenderer
from lp_framework.data.toy import toy_objects
from lp_framework.data.views import RenderingsData
from lp_framework.errors import UserError
from lp_framework.geometry import (
    at_optimal_scale,
    camera_to_world,
    relative_camera,
    rotation_error,
    translation_error,
    wrap_angle,
)
from lp_framework.solvers.base import Pairs, Solution, ViewSets, pairs_of
from lp_framework.solvers.features import Features, Learned, Matches, Sift, foreground

SIZE = 256
FOCAL = SIZE / 2 / math.tan(math.radians(FIELD_OF_VIEW) / 2)
VIEWS = torch.tensor(  # the first is the reference: 6, 23 and 97 degrees away from it
    [[0.3, 0.5, 1.6], [0.35, 0.6, 1.7], [0.3, 0.9, 1.6], [0.25, 2.2, 1.5]], dtype=torch.float64
)


def with_matches(matcher: KnownMatcher, **settings: float) -> Features:
    solver = Features(**settings)
    solver.matcher = matcher
    return solver


def from_first(images: Tensor) -> Pairs:
    """Every image but the first as query of the first."""
    queries = torch.arange(1, len(images))
    return Pairs(images, torch.zeros_like(queries), queries, 100 + queries)


def solve(solver: Features, pairs: Pairs, seed: int = 0) -> Solution:
    return solver.solve(pairs, torch.zeros(len(pairs), 1, 3), seed)


def errors(solution: Solution, reference: Tensor, query: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation (degrees) and translation at the optimal scale, `[B]`."""
    true = relative_camera(camera_to_world(reference), camera_to_world(query))
    found = at_optimal_scale(solution.cameras[:, 0].double(), true)
    return rotation_error(found, true), translation_error(found, true)


# ---------------------------------------------------------------- known correspondences


def test_exact_correspondences_give_the_exact_camera_and_pose():
    pairs, true = exact_pairs(20)
    reference = pairs.images[pairs.reference].flatten(1)[:, :3].double()
    query = pairs.images[pairs.query].flatten(1)[:, :3].double()
    solution = solve(know(Features()), pairs)
    rotation, translation = errors(solution, reference, query)
    assert rotation.max() < 0.01 and translation.max() < 1e-3
    assert solution.valid.all() and solution.energies.abs().max() == 0
    torch.testing.assert_close(
        torch.linalg.vector_norm(solution.cameras[:, 0, :3, 3], dim=-1), torch.ones(20), rtol=0, atol=1e-6
    )
    answer = solution.answer()
    assert wrap_angle(answer[:, 1] - true[:, 1]).abs().max() < 1e-3
    relative = 1.4 * (query[:, 2] / reference[:, 2] - 1)
    torch.testing.assert_close(answer[:, 2].double(), relative, rtol=0, atol=5e-3)


class Zoomed(KnownMatcher):
    """Matches in images whose fourth number is their field of view, degrees."""

    def describe(self, image: Tensor) -> Tensor:
        return image.flatten()[:4]

    def match(self, reference: Tensor, query: Tensor) -> Matches:
        centre = (self.size - 1) / 2
        angles = [math.radians(each[3].item()) for each in (reference, query)]
        zooms = [math.tan(math.radians(FIELD_OF_VIEW) / 2) / math.tan(angle / 2) for angle in angles]
        matches = super().match(reference[:3], query[:3])
        return Matches(*(centre + (each - centre) * zoom for each, zoom in zip(matches, zooms, strict=True)))


def with_fields_of_view(poses: Tensor, degrees: list[float]) -> Pairs:
    images = torch.nn.functional.pad(image_of(poses).float(), (0, SIZE - 8, 0, SIZE - 8))
    images.flatten(1)[:, 3] = torch.tensor(degrees)
    pairs = from_first(images)
    return replace(pairs, field_of_view=torch.deg2rad(torch.tensor(degrees, dtype=torch.float64)))


@pytest.mark.parametrize("degrees", [[25.0] * 4, [80.0] * 4, [30.0, 49.1, 70.0, 45.0]])
def test_each_view_has_its_own_field_of_view(degrees):
    """The solver uses the fields of view of the pairs, unless a single one is set."""
    pairs = with_fields_of_view(VIEWS, degrees)
    true = VIEWS[:1].expand(3, 3), VIEWS[1:]
    rotation, translation = errors(solve(with_matches(Zoomed(size=SIZE)), pairs), *true)
    assert rotation.max() < 0.02 and translation.max() < 1e-3
    without = replace(pairs, field_of_view=None)
    assert errors(solve(with_matches(Zoomed(size=SIZE)), without), *true)[0].max() > 1
    fixed = with_matches(Zoomed(size=SIZE), field_of_view_degrees=degrees[0])
    assert (errors(solve(fixed, without), *true)[0].max() < 0.02) == (len({*degrees}) == 1)
    torch.testing.assert_close(solve(fixed, pairs).poses, solve(fixed, without).poses, equal_nan=True)


def test_another_zoom_from_the_same_place_is_the_same_view():
    solution = solve(with_matches(Zoomed(size=SIZE)), with_fields_of_view(VIEWS[[0, 0]], [30.0, 60.0]))
    assert solution.valid.all() and solution.energies.item() == 0 and solution.poses.abs().max() == 0


def test_views_on_disk_are_solved_with_their_own_fields_of_view(tmp_path):
    """From `transform.json` to the solver; crops to the object have none."""
    path = write_split(tmp_path / "cup" / "test", random_poses(3, "any"), size=64)
    content = json.loads(path.read_text())
    content["frames"][1]["camera_angle_x"] = 0.4
    path.write_text(json.dumps(content))
    data = PairDataModule(RenderingsData(str(tmp_path)), str(tmp_path / "cache"), image_size=16)
    pairs = pairs_of(data.data("test")[np.array([[2, 1], [1, 0]])], torch.device("cpu"))
    assert pairs.field_of_view.tolist() == pytest.approx(
        [math.radians(FIELD_OF_VIEW), 0.4, math.radians(FIELD_OF_VIEW)]
    )
    focal = Features().focal_lengths(pairs)
    assert focal[1] == pytest.approx(8 / math.tan(0.2)) and focal[0] == focal[2] != focal[1]
    sets = ViewSets(pairs.images, torch.tensor([[2, 1, 0]]), torch.tensor([0]), pairs.field_of_view)
    assert sets.with_first().field_of_view is pairs.field_of_view
    before = data.fingerprint("test")
    content["frames"][1]["camera_angle_x"] = 0.5
    path.write_text(json.dumps(content))
    again = PairDataModule(RenderingsData(str(tmp_path)), str(tmp_path / "cache"), image_size=16, crop=True)
    assert again.fingerprint("test") != before
    cropped = pairs_of(again.data("test")[np.array([[2, 1]])], torch.device("cpu"))
    for source, angle in ((data, 0.4), (again, math.radians(FIELD_OF_VIEW))):
        _, (shown,) = shown_pairs(source.data("test"), np.array([[2, 1]]), torch.device("cpu"))
        assert shown.query.field_of_view == pytest.approx(angle)
    assert cropped.field_of_view is None and len({*Features().focal_lengths(cropped)}) == 1


@pytest.mark.parametrize("degrees", [20.0, 49.1, 90.0])
def test_another_field_of_view(degrees):
    """Matches at the angles of one field of view are right under it, and only under it."""
    matcher = KnownMatcher(size=SIZE)
    rotation = {}
    for assumed in (degrees, FIELD_OF_VIEW):
        solver = with_matches(matcher)
        zoom = math.tan(math.radians(FIELD_OF_VIEW) / 2) / math.tan(math.radians(degrees) / 2)
        found = []
        for query in VIEWS[1:3]:
            exact = matcher.match(VIEWS[0], query)
            points = [(each - (SIZE - 1) / 2) * zoom + (SIZE - 1) / 2 for each in exact]
            focal = SIZE / 2 / math.tan(math.radians(assumed) / 2)
            camera, _ = solver.relative_camera(Matches(*points), SIZE, (focal, focal), seed=0)
            true = relative_camera(*camera_to_world(torch.stack([VIEWS[0], query])))
            flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
            found.append(rotation_error(flip @ torch.from_numpy(camera) @ flip, true).item())
        rotation[assumed] = max(found)
    assert rotation[degrees] < 1e-3
    assert degrees == FIELD_OF_VIEW or rotation[FIELD_OF_VIEW] > 0.1


def test_robustness_to_noise_and_outliers():
    images = image_of(VIEWS).float()
    images = torch.nn.functional.pad(images, (0, SIZE - 8, 0, SIZE - 8))
    matcher = KnownMatcher(noise=0.3, outliers=60, size=SIZE)
    matcher.describe = lambda image: image[0, 0, :3]
    solution = solve(with_matches(matcher), from_first(images))
    rotation, translation = errors(solution, VIEWS[:1].expand(3, 3), VIEWS[1:])
    assert rotation.max() < 5 and translation.max() < 0.1
    torch.testing.assert_close(solution.energies[:, 0], torch.full((3,), 60 / 140), rtol=0, atol=0.1)


def test_draws_are_keyed_by_seed_and_pair():
    images = torch.nn.functional.pad(image_of(VIEWS[[0, 2]]).float(), (0, SIZE - 8, 0, SIZE - 8))
    matcher = KnownMatcher(noise=2.0, outliers=60, size=SIZE)  # hard enough to tell draws apart
    matcher.describe = lambda image: image[0, 0, :3]
    solver, one = with_matches(matcher), from_first(images)
    found = {
        (seed, number): solve(solver, Pairs(one.images, one.reference, one.query, torch.tensor([number])), seed).poses
        for seed in (0, 1)
        for number in (5, 6)
    }
    assert len({tuple(poses.flatten().tolist()) for poses in found.values()}) > 1
    again = solve(solver, Pairs(one.images, one.reference, one.query, torch.tensor([6])), 1).poses
    assert torch.equal(again, found[1, 6])


# ---------------------------------------------------------------- rendered objects


@pytest.fixture(scope="module")
def views() -> Tensor:
    """Images `[4, 3, 256, 256]` on white of a textured object at `VIEWS`."""
    (tram,) = (toy for toy in toy_objects() if toy.name == "tram")
    rendered = RaycastRenderer().render(tram.load(), camera_to_world(VIEWS), SIZE, FIELD_OF_VIEW).astype(np.float32)
    alpha = rendered[..., 3:] / 255
    pixels = rendered[..., :3] * alpha + 255 * (1 - alpha)
    return torch.from_numpy(pixels).permute(0, 3, 1, 2) / 127.5 - 1


def test_rendered_views_of_other_fields_of_view():
    """Of a pair taken with 30 and 65 degrees, as far away as they show the object about as large."""
    (cottage,) = (toy for toy in toy_objects() if toy.name == "cottage")
    poses, degrees, images = VIEWS[:2].clone(), (30.0, 65.0), []
    for pose, angle in zip(poses, degrees, strict=True):
        pose[2] *= math.tan(math.radians(FIELD_OF_VIEW) / 2) / math.tan(math.radians(angle) / 2)
        rendered = RaycastRenderer().render(cottage.load(), camera_to_world(pose[None]), SIZE, angle).astype(np.float32)
        alpha = rendered[..., 3:] / 255
        images.append(rendered[..., :3] * alpha + 255 * (1 - alpha))
    pairs = from_first(torch.from_numpy(np.concatenate(images)).permute(0, 3, 1, 2) / 127.5 - 1)
    own = replace(pairs, field_of_view=torch.deg2rad(torch.tensor(degrees, dtype=torch.float64)))
    rotation, wrong = (errors(solve(Features(), each), poses[:1], poses[1:])[0].item() for each in (own, pairs))
    assert rotation < 1.5 and wrong > 10


def test_small_baselines_are_found_and_a_wide_one_is_not(views):
    solution = solve(Features(), from_first(views))
    rotation, translation = errors(solution, VIEWS[:1].expand(3, 3), VIEWS[1:])
    assert rotation[0] < 1.5 and translation[0] < 0.03
    assert rotation[1] < 5 and translation[1] < 0.1
    assert solution.valid[:, 0].tolist() == [True, True, False]
    assert solution.poses[2].isnan().all() and solution.cameras[2].isnan().all() and solution.energies[2].isnan()
    assert rotation[2].isnan()
    assert solution.cost.network_passes == 0


def test_matches_of_sift_are_where_the_geometry_has_them(views):
    """The median distance from the epipolar line, in pixels: the pixels' origin and the axes are right."""
    sift = Sift(0.8)
    matches = sift.match(sift.describe(views[0]), sift.describe(views[1]))
    camera = relative_camera(*camera_to_world(VIEWS[:2])).numpy()  # of the query, OpenGL's axes
    rays = []
    for points in matches:
        centred = (points - (SIZE - 1) / 2) / FOCAL
        rays.append(np.stack([centred[:, 0], -centred[:, 1], -np.ones(len(points))], axis=1))
    normals = np.cross(rays[0], camera[:3, 3]) @ camera[:3, :3]  # of epipolar planes, in the query's frame
    distance = np.abs((normals * rays[1]).sum(1)) / np.linalg.norm(normals[:, :2], axis=1) * FOCAL
    assert len(distance) > 30 and np.median(distance) < 0.4


def test_an_image_and_itself_are_the_same_view(views):
    solution = solve(Features(), from_first(views[[0, 0]]))
    assert solution.valid.all() and solution.energies.item() == 0
    assert solution.poses.abs().max() == 0
    torch.testing.assert_close(solution.cameras[0, 0], torch.eye(4))


def test_images_without_features(views):
    blank = torch.ones(3, 3, 64, 64)
    blank[1, :, 20:40, 20:40] = -0.5  # a plain square
    solution = solve(Features(), from_first(blank))
    assert not solution.valid.any() and solution.poses.isnan().all()
    assert solution.chosen.tolist() == [0, 0]


@pytest.mark.parametrize("count", [0, 1, 4, 14])
def test_too_few_matches(count):
    pairs, _ = exact_pairs(1)
    solution = solve(with_matches(KnownMatcher(count)), pairs)
    assert not solution.valid.any() and solution.poses.isnan().all()


def test_too_few_inliers():
    random = np.random.default_rng(0)
    matches = Matches(*random.uniform(0, SIZE, (2, 40, 2)))
    assert Features(tolerance_pixels=0.2).relative_camera(matches, SIZE, (FOCAL, FOCAL), seed=0) is None


def test_a_set_of_images_with_one_that_shows_nothing(views):
    images = torch.cat([views[:2], torch.ones_like(views[:1])])
    sets = ViewSets(images, torch.tensor([[0, 1, 2]]), torch.tensor([3]))
    solution = Features().solve_views(sets, torch.zeros(1, 2, 1, 3), seed=0)
    assert solution.poses[0].isnan().all(dim=1).tolist() == [False, True]
    assert solution.valid.tolist() == [False]


# ---------------------------------------------------------------- matchers


def test_the_foreground_is_what_is_not_white_and_what_lies_within_it():
    image = torch.ones(3, 9, 9)
    image[1, 2:7, 2:7] = 0.0
    image[:, 4, 4] = 1.0
    mask = foreground(image)
    assert mask.sum() == 25 and mask[4, 4] and not mask[0, 0]


def test_mutual_and_ratio():
    def match(reference: list[float], query: list[float], ratio: float = 0.8) -> list[tuple[float, float]]:
        described = []
        for numbers in (reference, query):
            descriptors = np.zeros((len(numbers), 128), np.float32)
            descriptors[:, 0] = numbers
            described.append((np.array([[each, 0.0] for each in numbers]).reshape(-1, 2), descriptors))
        found = Sift(ratio).match(*described)
        return list(zip(found.reference[:, 0].tolist(), found.query[:, 0].tolist(), strict=True))

    assert match([0.0, 10.0], [0.5, 11.0]) == [(0.0, 0.5), (10.0, 11.0)]
    assert match([0.0, 1.0, 10.0], [0.5, 30.0]) == []  # 0 and 1 compete for 0.5, which is as near to both
    assert match([0.0, 100.0], [1.0, -1.1]) == []  # nothing is clearly nearer
    assert match([0.0, 100.0], [1.0, -1.1], ratio=1.0) == [(0.0, 1.0)]
    assert match([0.0, 10.0], [0.5]) == match([], []) == match([1.0], []) == []


def lightglue(tmp_path) -> Learned:
    """Transformers' own LightGlue, very small and untrained, saved and loaded."""
    transformers = pytest.importorskip("transformers")
    detector = {
        "model_type": "superpoint", "encoder_hidden_sizes": [8, 8, 8, 8], "decoder_hidden_size": 8,
        "descriptor_decoder_dim": 16, "max_keypoints": 20, "keypoint_threshold": 0.0,
    }  # fmt: skip
    config = transformers.LightGlueConfig(
        keypoint_detector_config=detector, descriptor_dim=16, num_hidden_layers=2, num_attention_heads=2
    )
    transformers.LightGlueForKeypointMatching(config).save_pretrained(tmp_path / "glue")
    transformers.LightGlueImageProcessor().save_pretrained(tmp_path / "glue")
    return Learned("lightglue", str(tmp_path / "glue"))


def test_a_learned_matcher_gives_places_on_both_objects_in_the_images_pixels(tmp_path, views):
    """With the real processor and the real network's form of output, but known points in it."""
    from transformers.models.lightglue.modeling_lightglue import LightGlueKeypointMatchingOutput

    matcher = lightglue(tmp_path)
    first, second = (matcher.describe(image) for image in views[:2])
    assert len(matcher.match(first, second).reference) == 0  # it runs; untrained, it is sure of nothing

    class Known(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.weight = torch.nn.Parameter(torch.ones(()))

        def forward(self, pixel_values: Tensor) -> LightGlueKeypointMatchingOutput:
            assert pixel_values.shape == (1, 2, 3, 640, 640) and 0 <= pixel_values.min() <= pixel_values.max() <= 1
            # Of the 640 pixels per side: the image's middle, a quarter, and the corner, which is white.
            points = torch.tensor([[319.5, 319.5], [300.0, 330.0], [0.0, 0.0], [310.0, 310.0]]) / 640
            return LightGlueKeypointMatchingOutput(
                keypoints=points.expand(1, 2, 4, 2),
                matches=torch.tensor([0, 1, 2, 3]).expand(1, 2, 4),
                matching_scores=torch.tensor([0.9, 0.8, 0.9, 0.1]).expand(1, 2, 4),  # the last one: hardly
                mask=torch.ones(1, 2, 4, dtype=torch.int),
            )

    matcher.network = Known()
    matches = matcher.match(first, second)
    wanted = (np.array([[319.5, 319.5], [300.0, 330.0]]) + 0.5) * SIZE / 640 - 0.5
    for points in matches:
        np.testing.assert_allclose(points, wanted, atol=1 / 64)


def test_a_learned_matcher_is_a_network_of_the_solver(tmp_path, views):
    lightglue(tmp_path)
    solver = registry.build("solver", {"name": "features", "matcher": "lightglue", "weights": str(tmp_path / "glue")})
    assert isinstance(solver.network, torch.nn.Module) and not solver.network.training
    solution = solve(solver, from_first(views[:2]))
    assert solution.cost.network_passes == 1 and not solution.valid.any()


# ---------------------------------------------------------------- mistakes


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"ratio": 0.0}, r"solver.ratio must be in \(0, 1\], got 0.0"),
        ({"tolerance_pixels": 0.0}, "solver.tolerance_pixels must be positive, got 0.0"),
        ({"fewest_inliers": 4}, "solver.fewest_inliers must be at least 5, got 4"),
        ({"field_of_view_degrees": 180.0}, "solver.field_of_view_degrees must be between 0 and 180, got 180.0"),
        ({"reference_radius": 0.0}, "solver.reference_radius must be positive, got 0.0"),
        ({"weights": "x"}, "solver.matcher=sift has no weights, got solver.weights=x"),
        ({"matcher": "surf"}, "matcher=surf does not fit; expected one of sift"),
    ],
)
def test_bad_settings(settings, message):
    with pytest.raises(UserError, match=message):
        registry.build("solver", {"name": "features", **settings})


def test_images_that_are_not_square():
    with pytest.raises(UserError, match="takes square images, got 8 x 6 pixels"):
        solve(Features(), from_first(torch.ones(2, 3, 8, 6)))


@pytest.mark.parametrize("package", ["cv2", "poselib"])
def test_without_a_package_one_sentence_says_what_to_install(package, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    message = f"solver=features needs the Python package '{package}', which is not installed: pip install"
    with pytest.raises(UserError, match=message + r" 'lp_framework\[features\]'"):
        Features()


def test_solvers_and_models_can_be_imported_without_optional_packages():
    missing = "import sys; sys.modules.update(dict.fromkeys(('cv2', 'poselib', 'dust3r', 'vggt', 'diffusers')))"
    wanted = "import lp_framework.solvers, lp_framework.models; from lp_framework.solvers import features, feed_forward"
    ran = subprocess.run([sys.executable, "-c", f"{missing}; {wanted}"], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr


def test_unavailable_weights_of_a_matcher(tmp_path):
    pytest.importorskip("transformers")
    with pytest.raises(UserError, match=f"{tmp_path}: the weights of efficientloftr cannot be loaded from there"):
        Features(matcher="efficientloftr", weights=str(tmp_path))


def test_an_evaluation_has_no_success_rate_and_its_report_leaves_it_open(lp, tmp_path):
    pytest.importorskip("cv2")
    write_objects(tmp_path / "views")
    ran = lp("eval", "solver=features", "data=renderings", "data.path=views", "data.image_size=16", "hydra.run.dir=run")
    assert ran.status == 0, ran.err
    result = json.loads((tmp_path / "run" / "results.json").read_text())
    names = {"R@5", "R@15", "R@30", "R(R)@5", "R(R)@15", "R(R)@30", "rotation_error", "translation_error"}
    assert set(result["metrics"]) == names == set(next(iter(result["per_object"].values())))
    ran = lp("report", "runs=run", "objects=all", "hydra.run.dir=report")
    assert ran.status == 0, ran.err
    with (tmp_path / "report" / "report.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert row["SR(R)@30"] == "" and float(row["R(R)@30"]) == result["metrics"]["R(R)@30"]
