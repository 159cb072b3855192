import json
import pickle
import warnings
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from scanned_objects import write_bottle, write_mug

from lp_framework.data.meshes import (
    NEUTRAL_GREY,
    MeshObject,
    fingerprint,
    load_scene,
    normalise,
    srgb_to_linear,
    surfaces,
)
from lp_framework.data.sets.rendered import MeshData
from lp_framework.errors import UserError


def coloured_box(extents=(1.0, 1.0, 1.0), colour=(200, 30, 30, 255)) -> trimesh.Trimesh:
    box = trimesh.creation.box(extents=extents)
    box.visual.face_colors = colour
    return box


def corners_of(scene: trimesh.Scene) -> np.ndarray:
    return np.concatenate([surface.positions for surface in surfaces(scene)])


# ---------------------------------------------------------------- normalisation


@pytest.mark.parametrize("seed", range(5))
def test_normalised_scene_is_centred_with_longest_side_one(seed):
    random = np.random.default_rng(seed)
    scene = trimesh.Scene()
    for _ in range(3):
        placed = trimesh.transformations.random_rotation_matrix(random.uniform(size=3))
        placed[:3, 3] = random.uniform(-50, 50, 3)
        scene.add_geometry(coloured_box(random.uniform(0.1, 20, 3)), transform=placed)
    before = scene.dump()
    normalised = normalise(scene)
    low, high = normalised.bounds
    np.testing.assert_allclose(low + high, 0, atol=1e-12)
    assert (high - low).max() == pytest.approx(1, abs=1e-12)
    # A similarity: all distances shrink by the same factor.
    old = np.concatenate([mesh.vertices for mesh in before])
    new = np.concatenate([mesh.vertices for mesh in normalised.dump()])
    factor = 1 / (old.max(axis=0) - old.min(axis=0)).max()
    np.testing.assert_allclose(np.diff(new, axis=0), np.diff(old, axis=0) * factor, atol=1e-9)


def test_normalising_leaves_the_scene_alone_and_is_idempotent():
    scene = trimesh.Scene(coloured_box((2, 4, 6)))
    once = normalise(scene)
    np.testing.assert_array_equal(scene.extents, [2, 4, 6])
    np.testing.assert_allclose(corners_of(normalise(once)), corners_of(once), atol=1e-7)


# ---------------------------------------------------------------- files


@pytest.mark.parametrize("suffix", ["glb", "ply", "off", "stl", "obj"])
def test_every_format_loads_to_the_same_shape(tmp_path, suffix):
    path = tmp_path / f"box.{suffix}"
    trimesh.creation.box(extents=(1, 2, 4)).export(path)
    with pytest.warns(UserWarning, match="no texture or colour") as caught:
        scene = load_scene(path)
    assert len(caught) == 1 and str(path) in str(caught[0].message)
    np.testing.assert_allclose(scene.extents, [0.25, 0.5, 1.0], atol=1e-6)
    (surface,) = surfaces(scene)
    assert surface.texture is None and surface.corner_colours is None
    np.testing.assert_allclose(surface.colour, NEUTRAL_GREY)


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


FLAT_OFF = "OFF\n3 1 0\n{0} 0 0\n{0} {1} 0\n{0} 0 {1}\n3 0 1 2\n"


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("cut.glb", "glTF and then nothing", "does not load"),
        ("strange.xyzzy", "hello", "does not load"),
        ("points.ply", "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
         "property float z\nend_header\n1 2 3\n", "no faces"),
        ("point.off", FLAT_OFF.format(1, 0), "extent"),
        ("nan.off", FLAT_OFF.format("nan", 1), "extent|no faces"),
    ],
)  # fmt: skip
def test_bad_files_are_user_errors_that_name_the_file(tmp_path, name, text, message):
    path = write(tmp_path / name, text)
    with pytest.raises(UserError, match=message) as caught:
        load_scene(path)
    assert name in str(caught.value)


def test_missing_file(tmp_path):
    with pytest.raises(UserError, match=r"gone\.glb: there is no such mesh file"):
        load_scene(tmp_path / "gone.glb")


def test_truncated_glb(tmp_path):
    whole = trimesh.Scene(coloured_box()).export(file_type="glb")
    path = tmp_path / "cut.glb"
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UserError, match=r"cut\.glb: does not load"):
        load_scene(path)


@pytest.mark.parametrize("write_object", [write_mug, write_bottle])
def test_textured_objects_load_with_their_colours(tmp_path, write_object):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = load_scene(write_object(tmp_path))
    assert np.ptp(corners_of(scene), axis=0).max() == pytest.approx(1, abs=1e-5)
    for surface in surfaces(scene):
        norms = np.linalg.norm(surface.normals, axis=1)
        assert np.isfinite(norms).all() and (norms > 0.99).mean() > 0.99


@pytest.mark.parametrize("suffix", ["obj", "glb"])
def test_the_axis_that_points_up_can_be_chosen(tmp_path, suffix):
    trimesh.creation.box(bounds=[[0, 0, 0], [1, 2, 4]]).export(tmp_path / f"box.{suffix}")
    for up, extents in (("y", [0.25, 0.5, 1]), ("z", [0.5, 1, 0.25])):  # x, y, z become our Z, X, Y
        (obj,) = MeshData(None, str(tmp_path), up=up).objects()
        with pytest.warns(UserWarning) as caught:
            np.testing.assert_allclose(obj.load().extents, extents, atol=1e-6)
        said = [each for each in caught if "files of this format have +Y up, but data.up=z is set" in str(each.message)]
        assert len(said) == (suffix == "glb" and up == "z")


# ---------------------------------------------------------------- colours


def test_vertex_and_face_colours_count_as_texture(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=1)
    ball.visual.vertex_colors = [188, 0, 255, 255]
    for mesh, name in ((ball, "ball.ply"), (coloured_box(colour=(188, 0, 255, 255)), "box.ply")):
        mesh.export(tmp_path / name)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            (surface,) = surfaces(load_scene(tmp_path / name))
        np.testing.assert_allclose(surface.corner_colours[0], srgb_to_linear(np.array([188, 0, 255]) / 255), atol=1e-6)


def test_obj_with_a_plain_material_has_its_colour(tmp_path):
    write(tmp_path / "red.mtl", "newmtl red\nKd 0.8 0.1 0.0\n")
    triangle = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n"
    (surface,) = surfaces(load_scene(write(tmp_path / "red.obj", f"mtllib red.mtl\nusemtl red\n{triangle}")))
    np.testing.assert_allclose(surface.colour, srgb_to_linear(np.array([0.8, 0.1, 0.0])), atol=0.01)


def test_textures_become_rgb_with_sides_that_are_powers_of_two():
    image = Image.new("P", (100, 30))
    plane = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    plane.visual = trimesh.visual.TextureVisuals(uv=[[0, 0], [1, 0], [0, 1]], image=image)
    (surface,) = surfaces(trimesh.Scene(plane))
    assert surface.texture.shape == (32, 128, 3) and surface.texture.dtype == np.uint8
    np.testing.assert_array_equal(surface.texture_coordinates, [[0, 0], [1, 0], [0, 1]])


# ---------------------------------------------------------------- normals and coinciding faces


def test_flat_faces_keep_sharp_edges_and_fine_curves_are_smooth():
    (box,) = surfaces(trimesh.Scene(trimesh.creation.box()))
    face_normals = np.cross(box.positions[1::3] - box.positions[::3], box.positions[2::3] - box.positions[::3])
    np.testing.assert_allclose(box.normals, np.repeat(face_normals, 3, axis=0), atol=1e-6)
    (ball,) = surfaces(trimesh.Scene(trimesh.creation.icosphere(subdivisions=3)))
    np.testing.assert_allclose(ball.normals, ball.positions, atol=0.02)  # unit sphere


def test_normals_are_smooth_across_a_seam_of_unmerged_vertices():
    ball = trimesh.creation.icosphere(subdivisions=2)
    soup = trimesh.Trimesh(ball.triangles.reshape(-1, 3), np.arange(3 * len(ball.faces)).reshape(-1, 3), process=False)
    (welded,), (split,) = surfaces(trimesh.Scene(ball)), surfaces(trimesh.Scene(soup))
    np.testing.assert_allclose(split.normals, welded.normals, atol=1e-6)


def test_coinciding_faces_are_dropped_and_turned_ones_are_twins():
    corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    front = trimesh.Trimesh(corners, [[0, 1, 2]])
    same = trimesh.Trimesh(corners, [[1, 2, 0]])
    back = trimesh.Trimesh(corners, [[0, 2, 1]])
    lone = trimesh.Trimesh(np.array(corners) + 1, [[0, 1, 2]])
    parts = surfaces(trimesh.Scene([front, same, lone, back]))
    assert [part.twins.tolist() for part in parts] == [[2], [-1], [0]]


# ---------------------------------------------------------------- fingerprint and objects


def test_the_fingerprint_depends_on_shape_and_colour_and_is_reproducible():
    red, same, blue = coloured_box(), coloured_box(), coloured_box(colour=(0, 0, 255, 255))
    longer = coloured_box((1, 1, 2))
    prints = [fingerprint(trimesh.Scene(mesh)) for mesh in (red, same, blue, longer)]
    assert prints[0] == prints[1] and len(set(prints)) == 3
    json.dumps(prints)


def test_objects_can_be_pickled(tmp_path):
    coloured_box().export(tmp_path / "box.ply")
    obj = MeshObject("box", "unlabelled", partial(load_scene, tmp_path / "box.ply"))
    assert fingerprint(pickle.loads(pickle.dumps(obj)).load()) == fingerprint(obj.load())
