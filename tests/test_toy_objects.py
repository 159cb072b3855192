"""The embedded objects are well made, and their ambiguity classes are true of their shapes and colours."""

from __future__ import annotations

import hashlib
import pickle
import re
from collections import Counter
from functools import cache

import numpy as np
import pytest
import trimesh
from embedded_objects import TOYS as MAKERS
from embedded_objects.continuous import REPEATS
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lp_framework.data.procedural import solids as shapes
from lp_framework.data.toy import toy_objects

TOYS = {toy.name: toy for toy in toy_objects()}
SPACING = 0.015  # between neighbouring points of a cloud, in units of the object's longest side
SAME, DIFFERENT = 0.6 * SPACING, 1.25 * SPACING  # Chamfer distances; two clouds of one surface are 0.5 * SPACING apart


def names(ambiguity: str) -> list[str]:
    return [toy.name for toy in TOYS.values() if toy.ambiguity == ambiguity]


@cache
def scene_of(name: str) -> trimesh.Scene:
    return TOYS[name].load()


@cache
def cloud(name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points `[P, 3]` spread evenly over the surface, and their sRGB colours `[P, 3]` in [0, 1]."""
    points, colours = [], []
    for index, mesh in enumerate(scene_of(name).geometry.values()):
        count = int(mesh.area / SPACING**2) + 1
        random = np.random.default_rng(index)
        face = random.choice(len(mesh.faces), count, p=mesh.area_faces / mesh.area)
        weights = random.dirichlet([1, 1, 1], count)
        points.append(np.einsum("pc,pcd->pd", weights, mesh.triangles[face]))
        uv = np.einsum("pc,pcd->pd", weights, mesh.visual.uv[mesh.faces[face]])
        image = np.asarray(mesh.visual.material.baseColorTexture) / 255
        row = ((1 - uv[:, 1]) * image.shape[0]).astype(int).clip(0, image.shape[0] - 1)
        column = (uv[:, 0] * image.shape[1]).astype(int).clip(0, image.shape[1] - 1)
        colours.append(image[row, column])
    return np.concatenate(points), np.concatenate(colours)


def turned(points: NDArray[np.float64], degrees: float) -> NDArray[np.float64]:
    rotation = trimesh.transformations.rotation_matrix(np.radians(degrees), [0, 1, 0])[:3, :3]
    return points @ rotation.T


def chamfer(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Mean distance from a point to the nearest of the other cloud, over both."""
    there, back = cKDTree(second).query(first)[0], cKDTree(first).query(second)[0]
    return float((there.mean() + back.mean()) / 2)


def colour_difference(name: str, degrees: float) -> float:
    """Mean difference between the colours of the object and of the turned object at the same place."""
    points, colours = cloud(name)
    _, nearest = cKDTree(turned(points, degrees)).query(points)
    return float(np.abs(colours - colours[nearest]).mean())


def test_names_are_unique_folder_names() -> None:
    assert len(TOYS) == len(toy_objects()) == 12
    assert all(re.fullmatch(r"[a-z][a-z0-9_]*", name) for name in TOYS)


def test_every_class_is_represented() -> None:
    assert Counter(toy.ambiguity for toy in TOYS.values()) == {"unique": 6, "twofold": 3, "continuous": 3}


@pytest.mark.parametrize("name", TOYS)
def test_worker_processes_can_receive_it(name: str) -> None:
    received = pickle.loads(pickle.dumps(TOYS[name]))
    assert (received.name, received.ambiguity) == (name, TOYS[name].ambiguity)
    assert content(received.load()) == content(scene_of(name))


@pytest.mark.parametrize("name", TOYS)
def test_meshes_are_closed_finite_and_face_outward(name: str) -> None:
    meshes = scene_of(name).geometry.values()
    assert sum(len(mesh.faces) for mesh in meshes) < 40_000
    for mesh in meshes:
        assert len(mesh.faces) > 0 and np.isfinite(mesh.vertices).all() and np.isfinite(mesh.vertex_normals).all()
        welded = trimesh.Trimesh(mesh.vertices.round(9), mesh.faces)  # seams of the texture closed
        assert welded.is_watertight and welded.is_winding_consistent
        assert all(body.volume > 0 for body in welded.split(only_watertight=False))


@pytest.mark.parametrize("name", TOYS)
def test_meshes_are_textured(name: str) -> None:
    images = []
    for mesh in scene_of(name).geometry.values():
        assert mesh.visual.uv.shape == (len(mesh.vertices), 2)
        assert mesh.visual.uv.min() > -1e-9 and mesh.visual.uv.max() < 1 + 1e-9
        images.append(np.asarray(mesh.visual.material.baseColorTexture).reshape(-1, 3)[::97])
    assert len(np.unique(np.concatenate(images), axis=0)) > 20


@pytest.mark.parametrize("name", TOYS)
def test_it_is_normalised_and_fills_its_cube(name: str) -> None:
    bounds = scene_of(name).bounds
    np.testing.assert_allclose(bounds.sum(axis=0), 0, atol=1e-9)
    size = bounds[1] - bounds[0]
    assert size.max() == pytest.approx(1)
    assert size.min() > 0.3


def content(scene: trimesh.Scene) -> str:
    """A hash of all that is in the file of an object."""
    digest = hashlib.sha256()
    for mesh in scene.geometry.values():
        for array in (mesh.vertices, mesh.faces, mesh.visual.uv, mesh.visual.material.baseColorTexture):
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


CONTENT = {
    "fire_engine": "304f2ba95ff184f4",
    "cottage": "85f4f89bc9e6046a",
    "robot": "ce3440f8e2e1f924",
    "sailboat": "eba0c3ab44870c93",
    "duck": "ad5a9aa3c0299f70",
    "watering_can": "97d4cf9b667d1d61",
    "tram": "5ed2277a9ebbef89",
    "juice_carton": "548cff9280a94885",
    "suitcase": "c1e38ec9306812d7",
    "soup_can": "759d82a45435b5a3",
    "lotus_vase": "957a07fb1521bc99",
    "celadon_bottle": "df2ed6010cc86b07",
}


@pytest.mark.parametrize("name", TOYS)
def test_bundled_objects_are_those_of_the_recorded_results(name: str) -> None:
    assert content(scene_of(name)) == CONTENT[name]


@pytest.mark.parametrize("name", TOYS)
def test_bundled_objects_are_reproducible_by_their_script(name: str) -> None:
    assert list(MAKERS) == list(TOYS)
    for made, ships in zip(MAKERS[name]().geometry.values(), scene_of(name).geometry.values(), strict=True):
        np.testing.assert_allclose(made.vertices, ships.vertices, rtol=0, atol=1e-12)  # the last bits are the machine's
        np.testing.assert_array_equal(made.faces, ships.faces)
        np.testing.assert_allclose(made.visual.uv, ships.visual.uv, rtol=0, atol=1e-12)
        pixels = [np.asarray(mesh.visual.material.baseColorTexture, dtype=int) for mesh in (made, ships)]
        assert pixels[0].shape == pixels[1].shape and np.abs(pixels[0] - pixels[1]).max() <= 1
        assert repr(made.visual.material.main_color) == repr(ships.visual.material.main_color)


@pytest.mark.parametrize("name", names("unique"))
def test_unique_shape_differs_after_every_turn(name: str) -> None:
    points, _ = cloud(name)  # a turn and its inverse have the same distance
    assert min(chamfer(points, turned(points, degrees)) for degrees in range(30, 181, 30)) > DIFFERENT


@pytest.mark.parametrize("name", names("twofold"))
def test_twofold_shape_repeats_only_after_half_a_turn(name: str) -> None:
    points, _ = cloud(name)
    assert chamfer(points, turned(points, 180)) < SAME
    assert min(chamfer(points, turned(points, degrees)) for degrees in range(30, 151, 30)) > DIFFERENT


@pytest.mark.parametrize("name", names("twofold"))
def test_twofold_vertices_map_onto_each_other(name: str) -> None:
    vertices = np.concatenate([mesh.vertices for mesh in scene_of(name).geometry.values()])
    distance, _ = cKDTree(vertices).query(turned(vertices, 180))
    assert distance.max() < 1e-6


@pytest.mark.parametrize("name", names("twofold"))
def test_twofold_paint_distinguishes_front_and_back(name: str) -> None:
    assert colour_difference(name, 180) > 0.1


@pytest.mark.parametrize("name", names("continuous"))
@pytest.mark.parametrize("degrees", [7.3, 61.0, 133.7])
def test_continuous_shape_is_unchanged_by_any_turn(name: str, degrees: float) -> None:
    points, _ = cloud(name)
    assert chamfer(points, turned(points, degrees)) < SAME


def test_can_label_has_no_period() -> None:
    assert min(colour_difference("soup_can", degrees) for degrees in range(30, 331, 30)) > 0.08


def texture(name: str) -> NDArray[np.float64]:
    (mesh,) = scene_of(name).geometry.values()
    return np.asarray(mesh.visual.material.baseColorTexture, dtype=np.float64) / 255


def test_vase_pattern_has_its_period_and_no_smaller_one() -> None:
    image = texture("lotus_vase")
    assert REPEATS >= 12
    step = image.shape[1] // REPEATS
    np.testing.assert_array_equal(image, np.roll(image, step, axis=1))
    assert min(np.abs(image - np.roll(image, shift, axis=1)).mean() for shift in range(step // 4, 3 * step // 4)) > 0.03


def test_bottle_is_the_same_from_all_sides() -> None:
    image = texture("celadon_bottle")
    np.testing.assert_array_equal(image, np.broadcast_to(image[:, :1], image.shape))


def test_texture_of_a_lathe_reads_from_left_to_right_in_front() -> None:
    can = shapes.lathe([(1, 0), (1, 1)], segments=64)
    side = np.abs(can.vertices[:, [0, 2]]).max(axis=1) > 0.5
    for u, (x, z) in {0.5: (0, 1), 0.75: (1, 0), 0.25: (-1, 0)}.items():
        at = side & np.isclose(can.uv[:, 0], u)
        np.testing.assert_allclose(can.vertices[at][:, [0, 2]], np.broadcast_to([x, z], (at.sum(), 2)), atol=1e-12)


@pytest.mark.parametrize(
    ("shape", "volume"),
    [
        (shapes.ellipsoid(0.5, 0.3, 0.2, 64), 4 / 3 * np.pi * 0.03),
        (shapes.cylinder(0.4, 1.0, segments=128), np.pi * 0.16),
        (shapes.torus(0.5, 0.1, 96), 2 * np.pi**2 * 0.5 * 0.01),
        (shapes.rod((0, 0, 0), (1, 2, 2), 0.1, 64), np.pi * 0.01 * 3),
        (shapes.extrude([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], 0.5, 0.001), 1.5),
        (shapes.box(1.0, 2.0, 3.0, 0.01), 6.0),
        (shapes.box(1.0, 1.0, 1.0, 0.499, 12), 4 / 3 * np.pi / 8),
        (shapes.box(1.0, 2.0, 3.0, 0.01).scale(x=-0.5).turn("z", 40).move(3, -1, 2), 3.0),
    ],
    ids=["ellipsoid", "cylinder", "torus", "rod", "extrude", "box", "ball", "mirrored box"],
)
def test_shapes_enclose_their_volume(shape: shapes.Shape, volume: float) -> None:
    solid = trimesh.Trimesh(shape.vertices.round(9), shape.triangles)
    assert solid.is_watertight
    assert solid.volume == pytest.approx(volume, rel=0.03)


@pytest.mark.parametrize("outline", [[(0, 0), (0, 1), (1, 1), (1, 0)], [(0, 0), (0, 1), (1, 0)]])
def test_clockwise_outline_is_refused(outline: list[tuple[int, int]]) -> None:
    with pytest.raises(ValueError, match="counter-clockwise"):
        shapes.extrude(outline, 0.5)
