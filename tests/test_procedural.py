"""Procedural objects are deterministic, valid and varied, and their ambiguity classes match their views."""

from __future__ import annotations

import hashlib
import pickle
from functools import cache

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray
from PIL import Image

from lp_framework.data.meshes import MeshObject
from lp_framework.data.procedural import FAMILIES, Family, ProceduralData, procedural_object
from lp_framework.data.procedural.labels import LAYOUTS, brand, four_sides, panel
from lp_framework.data.procedural.objects import family_of
from lp_framework.data.procedural.shapes import around, body, oval, stick
from lp_framework.data.procedural.textures import PICTURES, contrast, draw_picture, frieze, ink
from lp_framework.data.rendering.pyrender_renderer import PyrenderRenderer
from lp_framework.data.rendering.raycast import RaycastRenderer
from lp_framework.errors import UserError
from lp_framework.geometry import camera_to_world

SEED, COUNT = 5, 200
TURNS = 10  # views around an object; 36 degrees are no multiple of the steps that bodies of revolution are made of


@cache
def scene_of(index: int, seed: int = SEED) -> trimesh.Scene:
    return procedural_object(seed, index).load()


def of_family(family: Family, count: int) -> list[int]:
    """The first objects of a family."""
    return [index for index in range(4 * COUNT) if family_of(SEED, index) is family][:count]


def hashed(scene: trimesh.Scene) -> str:
    digest = hashlib.sha256()
    for mesh in scene.geometry.values():
        texture = np.asarray(mesh.visual.material.baseColorTexture)
        for array in (mesh.vertices, mesh.faces, mesh.visual.uv, texture, mesh.visual.material.baseColorFactor):
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def views_around(scene: trimesh.Scene, size: int = 40) -> NDArray[np.float64]:
    """Views `[TURNS, size, size, 3]` in [0, 1] on white from evenly spaced longitudes, from slightly above."""
    longitude = 0.2 + 2 * np.pi * np.arange(TURNS) / TURNS
    poses = np.stack([0 * longitude + 0.4, longitude, 0 * longitude + 1.7], axis=1)
    pixels = RaycastRenderer().render(scene, camera_to_world(torch.from_numpy(poses)), size, 49.1) / 255
    return pixels[..., :3] * pixels[..., 3:] + 1 - pixels[..., 3:]


def differences(scene: trimesh.Scene) -> NDArray[np.float64]:
    """`[TURNS, TURNS]`: mean absolute difference of two views, as a share of the pixels that the object covers."""
    views = views_around(scene)
    return np.abs(views[:, None] - views[None]).mean(axis=(2, 3, 4)) / (views < 1).any(axis=-1).mean()


def clay(scene: trimesh.Scene) -> trimesh.Scene:
    """The shape alone, without colours."""
    return trimesh.Scene([trimesh.Trimesh(m.vertices, m.faces, process=False) for m in scene.geometry.values()])


def after_turns(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """The largest difference after each turn but none, `[TURNS - 1]`."""
    return np.array([max(matrix[i, (i + turn) % TURNS] for i in range(TURNS)) for turn in range(1, TURNS)])


# ---------------------------------------------------------------- the objects as a whole


def test_objects_are_the_same_whenever_and_in_whatever_number_they_are_made() -> None:
    for index in (0, 7, 31, 58):
        obj = procedural_object(SEED, index)
        assert hashed(obj.load()) == hashed(pickle.loads(pickle.dumps(obj)).load()) == hashed(scene_of(index))
    few, many = (ProceduralData(RaycastRenderer(), objects=count).objects() for count in (5, 40))
    assert [vars(obj) | {"load": obj.load.args} for obj in few] == [
        vars(obj) | {"load": obj.load.args} for obj in many[:5]
    ]


def test_no_global_random_state_is_used_or_changed() -> None:
    np.random.seed(0)
    before = np.random.get_state()[1].copy()
    first = hashed(procedural_object(SEED, 3).load())
    np.testing.assert_array_equal(np.random.get_state()[1], before)
    np.random.seed(1)
    assert hashed(procedural_object(SEED, 3).load()) == first


def test_all_objects_differ() -> None:
    hashes = [hashed(scene_of(index, seed)) for seed in (SEED, SEED + 1) for index in range(30)]
    assert len({*hashes}) == 60
    names = [procedural_object(seed, index).name for seed in (0, 1) for index in range(300)]
    assert len({*names}) == 600


@pytest.mark.parametrize("seed", [0, SEED, 1234])
def test_every_family_occurs_in_200_objects_about_as_often_as_its_share(seed: int) -> None:
    total = sum(family.share for family in FAMILIES)
    found = [family_of(seed, index).name for index in range(COUNT)]
    for family in FAMILIES:
        assert found.count(family.name) == pytest.approx(COUNT * family.share / total, abs=2)
        assert family.name in found


def test_every_class_is_well_represented() -> None:
    objects = [procedural_object(SEED, index) for index in range(COUNT)]
    shares = {
        name: sum(obj.ambiguity == name for obj in objects) / COUNT for name in ("unique", "twofold", "continuous")
    }
    assert shares["unique"] > 0.4 and shares["twofold"] > 0.2 and shares["continuous"] > 0.1
    assert sum(bool(obj.unique_answer) for obj in objects) / COUNT > 0.8


@pytest.mark.parametrize("index", range(0, COUNT, 4))
def test_object_is_finite_textured_and_normalised(index: int) -> None:
    scene = scene_of(index)
    np.testing.assert_allclose(scene.bounds.sum(axis=0), 0, atol=1e-9)
    assert scene.extents.max() == pytest.approx(1)
    assert sum(len(mesh.faces) for mesh in scene.geometry.values()) < 12_000
    for mesh in scene.geometry.values():
        assert len(mesh.faces) and np.isfinite(mesh.vertices).all() and np.isfinite(mesh.vertex_normals).all()
        assert mesh.visual.uv.shape == (len(mesh.vertices), 2) and np.isfinite(mesh.visual.uv).all()
        texture = mesh.visual.material.baseColorTexture
        assert texture.mode == "RGB" and max(texture.size) <= 512
        assert (mesh.visual.material.baseColorFactor[:3] >= 150).all()


@pytest.mark.parametrize("renderer", [PyrenderRenderer(), RaycastRenderer()], ids=["pyrender", "raycast"])
@pytest.mark.parametrize("index", [0, 1, 2, 12])
def test_both_renderers_draw_it(index: int, renderer) -> None:
    camera = camera_to_world(torch.tensor([[0.3, 0.5, 1.6]], dtype=torch.float64))
    (pixels,) = renderer.render(scene_of(index), camera, 24, 49.1)
    assert 0.02 < (pixels[..., 3] > 127).mean() < 0.9
    assert np.ptp(pixels[pixels[..., 3] > 127][:, :3].astype(int)) > 20


# ---------------------------------------------------------------- the labels


@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.name)
def test_ambiguity_class_is_true_of_the_shape(family: Family) -> None:
    for index in of_family(family, 3):
        turned = after_turns(differences(clay(scene_of(index))))
        half = turned[TURNS // 2 - 1]
        if family.ambiguity == "unique":
            assert turned.min() > 0.01
        elif family.ambiguity == "twofold":
            assert half < 0.002
            assert family.name == "square_tin" or turned.max() > 0.01
        else:
            assert turned.max() < 0.004


@pytest.mark.parametrize(
    "family", [each for each in FAMILIES if each.ambiguity != "unique"], ids=lambda each: each.name
)
def test_unique_answer_is_true_of_the_texture(family: Family) -> None:
    for index in of_family(family, 3):
        matrix = differences(scene_of(index))
        halves = np.array([matrix[i, (i + TURNS // 2) % TURNS] for i in range(TURNS)])
        others = matrix[~np.eye(TURNS, dtype=bool)]
        if family.ambiguity == "twofold" and family.unique_answer:
            assert halves.mean() > 0.02
        elif family.ambiguity == "twofold":
            assert halves.max() < 0.018
        elif family.unique_answer:  # no two views are alike
            assert others.min() > 0.008
        else:  # some are
            assert others.min() < 0.004


# ---------------------------------------------------------------- the source


def test_source_renders_what_is_missing_and_labels_its_views(tmp_path) -> None:
    def source(objects: int, seed: int = 0) -> ProceduralData:
        return ProceduralData(
            RaycastRenderer(), str(tmp_path), objects, seed, resolution=8, test_views=2, train_views=3, workers=1,
            highest_latitude_degrees=75.0,
        )  # fmt: skip

    source(2).prepare()
    first = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.png")}
    assert len(first) == 2 * 5
    source(3).prepare()
    source(1, seed=1).prepare()  # of another seed: into the same folder, beside the others
    assert {path: path.stat().st_mtime_ns for path in first} == first
    assert len(list(tmp_path.rglob("*.png"))) == 4 * 5
    by_name: dict[str, MeshObject] = {obj.name: obj for obj in source(3).objects()}
    assert source(3).names() == sorted(by_name)
    for name, obj in by_name.items():
        views = source(3).views(name, "train")
        assert (len(views), views.ambiguity, views.unique_answer) == (3, obj.ambiguity, obj.unique_answer)


@pytest.mark.parametrize("wrong", [{"objects": 0}, {"objects_seed": -1}])
def test_impossible_settings_are_user_errors(wrong: dict[str, int]) -> None:
    with pytest.raises(UserError, match=next(iter(wrong))):
        ProceduralData(RaycastRenderer(), **wrong)


# ---------------------------------------------------------------- what objects are made of


@pytest.mark.parametrize("exponent", [2.0, 3.5, 8.0])
def test_oval_is_symmetric_even_and_has_its_axes(exponent: float) -> None:
    ring = oval(0.6, 0.4, 0.2, exponent)
    np.testing.assert_array_equal(ring[24:, [0, 2]], -ring[:24, [0, 2]])
    np.testing.assert_allclose(np.ptp(ring, axis=0), [0.6, 0, 0.4], rtol=0.01)
    steps = np.linalg.norm(ring - np.roll(ring, 1, axis=0), axis=1)
    assert steps.max() < 1.1 * steps.min()
    assert ring[0, 2] == pytest.approx(-0.2) and ring[1, 0] < 0  # from the back over -X


def test_a_bodys_texture_is_mapped_by_height() -> None:
    shape = body([(0.4, 0.4, 0.0), (0.6, 0.6, 0.3), (0.2, 0.2, 1.0)])
    np.testing.assert_allclose(shape.uv[:, 1], shape.vertices[:, 1], atol=1e-12)


def test_labels_go_all_the_way_round_with_the_first_in_the_middle() -> None:
    sheet = Image.new("RGB", (100, 50))
    colours = [(255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 0)]  # front, right, back, left
    around([Image.new("RGB", (20, 10), each) for each in colours], 0.2, 0.8, sheet)
    pixels = np.asarray(sheet)
    assert [tuple(pixels[25, x]) for x in (50, 75, 99, 0, 25)] == [colours[k] for k in (0, 1, 2, 2, 3)]
    assert (pixels[:9] == 0).all() and (pixels[41:] == 0).all()
    assert (pixels[11:39].max(axis=2) > 0).all()


def test_label_across_the_seam_goes_on_at_the_other_edge() -> None:
    sheet = Image.new("RGB", (100, 50))
    stick(Image.new("RGB", (8, 8), "white"), 0.0, 0.4, 0.6, 0.2, sheet)
    assert np.flatnonzero(np.asarray(sheet)[25, :, 0]).tolist() == [*range(10), *range(90, 100)]


def test_frieze_repeats_exactly() -> None:
    image = np.asarray(frieze(np.random.default_rng(0), 512, 60, 16, (240, 240, 240)))
    np.testing.assert_array_equal(image, np.roll(image, 32, axis=1))
    assert np.ptp(image) > 50


@pytest.mark.parametrize("name", PICTURES)
def test_picture_stays_about_its_place(name: str) -> None:
    image = Image.new("RGB", (100, 100), "white")
    draw_picture(image, name, 50, 50, 30, [(200, 0, 0), (0, 120, 0), (0, 0, 90)])
    rows, columns = np.nonzero((np.asarray(image) < 255).any(axis=2))
    assert min(rows.min(), columns.min()) >= 17 and max(rows.max(), columns.max()) <= 83
    assert len(rows) > 300


@pytest.mark.parametrize("role", LAYOUTS)
def test_every_layout_is_a_print_of_its_own(role: str) -> None:
    for seed in range(4):
        random = np.random.default_rng(seed)
        image = panel(random, brand(random), role, 1.0, 0.8)
        assert image.size == (256, 205)
        assert np.asarray(image).std(axis=(0, 1)).max() > 8


def test_sides_of_a_package_are_never_the_same_after_half_a_turn() -> None:
    for seed in range(30):
        random = np.random.default_rng(seed)
        front, right, back, left = four_sides(random, brand(random), 0.6, 0.4, 1.0)
        assert not (np.array_equal(front, back) and np.array_equal(right, left))


def test_ink_contrasts_with_its_ground() -> None:
    random = np.random.default_rng(0)
    for ground in [(250, 250, 250), (10, 10, 10), (128, 128, 128), (200, 30, 30)]:
        assert all(contrast(ink(random, ground), ground) > 75 for _ in range(50))
