"""Mesh files that are easily misread (`odd_meshes.py`) are read correctly, equal for both renderers, or reported."""

import io
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from odd_meshes import (
    COLOURED,
    COLOURED_SQUARE,
    LINEAR,
    ODD,
    OTHER,
    PLACES,
    PLY,
    SQUARE,
    SRGB,
    Gltf,
    encoded,
    picture,
    write_obj,
)
from PIL import Image

from lp_framework.data.meshes import load_scene, srgb_to_linear, surfaces
from lp_framework.data.rendering.pyrender_renderer import PyrenderRenderer, offscreen_context
from lp_framework.data.rendering.raycast import RaycastRenderer
from lp_framework.errors import UserError
from lp_framework.geometry import camera_to_world

FRONT = camera_to_world(torch.tensor([[0.0, 0.0, 1.4]], dtype=torch.float64))
ASIDE = camera_to_world(torch.tensor([[0.3, 0.4, 1.4]], dtype=torch.float64))


def load(path: Path) -> tuple[trimesh.Scene, list[str]]:
    """The scene of a file and what it warns of."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = load_scene(path)
    assert all(each.category is not RuntimeWarning for each in caught)
    return scene, [str(each.message) for each in caught]


def view(scene: trimesh.Scene, cameras: torch.Tensor = FRONT, side: int = 48) -> np.ndarray:
    return RaycastRenderer().render(scene, cameras, side, 49.1)[0].astype(int)


@pytest.fixture(scope="module")
def plain_view(tmp_path_factory) -> np.ndarray:
    return view(load_scene(ODD["plain"](tmp_path_factory.mktemp("plain"))))


def test_the_plain_square_has_its_colours(plain_view):
    corners = [plain_view[row, column, :3].argsort()[::-1].tolist()[:2] for row in (15, 32) for column in (15, 32)]
    red, green, blue, yellow = corners
    assert (red[0], green[0], blue[0]) == (0, 1, 2) and set(yellow) == {0, 1}


@pytest.mark.parametrize("name", ODD)
def test_unusual_files_look_like_plain_ones(name, tmp_path, plain_view):
    scene, messages = load(ODD[name](tmp_path / "odd"))
    assert messages == []
    assert np.abs(view(scene) - plain_view).max() <= 2


@pytest.mark.parametrize("name", [*OTHER, "moved_texture", "mirrored", "triangle_strip", "obj_scaled_texture"])
def test_both_renderers_draw_odd_files_alike(name, tmp_path):
    try:
        offscreen_context()
    except UserError as error:
        pytest.skip(str(error))
    scene, _ = load((ODD | OTHER)[name](tmp_path / "odd"))
    by_gl, by_rays = (
        each.render(scene, ASIDE, 64, 49.1)[0].astype(int) for each in (PyrenderRenderer(), RaycastRenderer())
    )
    inside = [image[..., 3] >= 128 for image in (by_gl, by_rays)]
    assert (inside[0] & inside[1]).sum() > 0.98 * (inside[0] | inside[1]).sum()
    both = (by_gl[..., 3] == 255) & (by_rays[..., 3] == 255)
    difference = (by_gl - by_rays)[both][:, :3]
    assert np.abs(difference.mean(axis=0)).max() < 3 and np.abs(difference).mean() < 3


# ---------------------------------------------------------------- the values that are drawn


def the_surface(path: Path):
    (surface,) = surfaces(load(path)[0])
    return surface


@pytest.mark.parametrize("name", [*COLOURED, "coloured_texture"])
def test_vertex_colours_of_gltf_are_linear_and_multiply(name, tmp_path):
    surface = the_surface(OTHER[name](tmp_path))
    np.testing.assert_allclose(surface.corner_colours, LINEAR[[0, 1, 2, 0, 2, 3]], atol=0.003)
    np.testing.assert_allclose(surface.colour, [1, 0.4, 0.2], atol=0.003)
    assert (surface.texture is None) == (name in COLOURED)


def test_vertex_colours_of_gltf_without_a_material(tmp_path):
    file = Gltf(uv=None, image=None)
    del file.primitive["material"]
    file.attributes["COLOR_0"] = file.accessor(LINEAR)
    surface = the_surface(file.write(tmp_path))
    np.testing.assert_array_equal(surface.corner_colours, LINEAR[[0, 1, 2, 0, 2, 3]])
    np.testing.assert_array_equal(surface.colour, [1, 1, 1])


@pytest.mark.parametrize("name", [name for name in OTHER if name.startswith(("obj_colours", "ply_colours"))])
def test_vertex_colours_of_obj_and_ply_are_srgb_and_replace_the_material(name, tmp_path):
    surface = the_surface(OTHER[name](tmp_path / "odd"))
    of_place = {(-1, -1): 0, (1, -1): 1, (1, 1): 2, (-1, 1): 3}
    corners = [of_place[tuple(place)] for place in np.sign(surface.positions[:, :2]).astype(int).tolist()]
    np.testing.assert_allclose(surface.corner_colours, srgb_to_linear(np.array(SRGB))[corners], atol=0.005)
    np.testing.assert_array_equal(surface.colour, [1, 1, 1])
    assert surface.texture is None


def test_a_texture_beside_vertex_colours_of_obj_is_drawn_without_them(tmp_path, plain_view):
    scene, messages = load(write_obj(tmp_path, f"mtllib a.mtl\n{COLOURED_SQUARE}"))
    assert np.abs(view(scene) - plain_view).max() <= 2
    assert len(messages) == 1 and "odd.obj: has vertex or face colours beside its texture" in messages[0]


def test_vertices_without_a_colour_among_coloured_ones_are_white(tmp_path):
    path = tmp_path / "odd.obj"
    path.write_text("v 0 0 0 1 0 0\nv 1 0 0\nv 0 1 0 0 0 1\nf 1 2 3\n")
    np.testing.assert_array_equal(the_surface(path).corner_colours, [[1, 0, 0], [1, 1, 1], [0, 0, 1]])


def test_vertices_in_one_place_keep_their_own_colours(tmp_path):
    """Two squares that meet in an edge, red and green."""
    lines = ["0 0 0 1 0 0", "1 0 0 1 0 0", "1 1 0 1 0 0", "1 0 0 0 1 0", "2 0 0 0 1 0", "1 1 0 0 1 0"]
    path = tmp_path / "edge.obj"
    path.write_text("".join(f"v {line}\n" for line in lines) + "f 1 2 3\nf 4 5 6\n")
    np.testing.assert_array_equal(the_surface(path).corner_colours, np.repeat([[1, 0, 0], [0, 1, 0]], 3, axis=0))


def test_instances_are_where_the_file_puts_them(tmp_path):
    positions = np.concatenate([surface.positions for surface in surfaces(load(OTHER["instances"](tmp_path))[0])])
    low, high = PLACES.min(axis=0) - [0.5, 0.5, 0], [2.5, 3.25, 0]  # the bounding box of all three
    scale = (high - low).max()
    squares = positions.reshape(3, 6, 3) * scale + (low + high) / 2
    squares = squares[[np.abs(squares.mean(axis=1) - place).sum(axis=1).argmin() for place in PLACES]]
    np.testing.assert_allclose(squares.mean(axis=1), PLACES, atol=1e-6)
    np.testing.assert_allclose(np.ptp(squares, axis=1)[:, :2], [[1, 1], [1, 1], [0.5, 0.5]], atol=1e-6)
    np.testing.assert_allclose(squares[1, 0] - PLACES[1], [0.5, -0.5, 0], atol=1e-4)  # of (-0.5, -0.5), a quarter on


@pytest.mark.parametrize("name", ["clamped", "mirrored_many_times", "wrapped_in_two_ways", "repeated"])
def test_textures_wrap_as_the_file_says(name, tmp_path):
    """Nine cells across and up, coordinates from -1 to 2: each has the colour of a half of the picture."""
    halves = {
        "repeat": [0, 1, 0, 1, 0, 1],
        "clamp": [0, 0, 0, 1, 1, 1],
        "mirror": [1, 0, 0, 1, 1, 0],
    }
    across, down = {
        "clamped": ("clamp", "clamp"),
        "mirrored_many_times": ("mirror", "mirror"),
        "wrapped_in_two_ways": ("clamp", "mirror"),
        "repeated": ("repeat", "repeat"),
    }[name]
    image = view(
        load(OTHER[name](tmp_path))[0], camera_to_world(torch.tensor([[0.0, 0.0, 1.0946]], dtype=torch.float64))
    )
    rows, columns = halves[down], halves[across]
    expected = [[2 * row + column for column in columns] for row in rows]
    cells = image[4::8, 4::8, :3]
    colours = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0]])
    cells = cells / np.linalg.norm(cells, axis=-1, keepdims=True)
    found = (
        (cells[:, :, None] * (colours / np.linalg.norm(colours, axis=1, keepdims=True))).sum(axis=-1).argmax(axis=-1)
    )
    assert found.tolist() == expected


def test_textures_of_16_bits_keep_their_levels(tmp_path):
    texture = the_surface(OTHER["texture_of_16_bits"](tmp_path)).texture
    levels = np.rint((np.mgrid[0:16, 0:16].sum(axis=0) * 2000 + 3000) / 257)
    np.testing.assert_array_equal(texture, np.repeat(levels[..., None], 3, axis=2))


# ---------------------------------------------------------------- what is said


def gltf(**changes) -> Gltf:
    file = Gltf()
    file.header |= changes
    return file


@pytest.mark.parametrize(
    "name", ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_texture_basisu", "XY_z"]
)
def test_required_extensions_that_are_not_supported_are_named(name, tmp_path):
    path = gltf(extensionsRequired=["KHR_materials_unlit", name]).write(tmp_path)
    with pytest.raises(UserError, match=rf"^{path}: needs the glTF extension {name}, which is not supported; save it"):
        load_scene(path)


def test_compressed_parts_are_named_where_nothing_is_required(tmp_path):
    compressed = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
    file = Gltf()
    file.primitive["extensions"] = compressed
    load(file.write(tmp_path / "beside"))  # the same part is there uncompressed
    del file.header["accessors"][file.attributes["POSITION"]]["bufferView"]
    with pytest.raises(UserError, match="needs the glTF extension KHR_draco_mesh_compression"):
        load_scene(file.write(tmp_path / "alone"))
    file = Gltf()
    file.header["buffers"] = [{"byteLength": len(file.blob)}, {"byteLength": 9, "extensions": {"EXT_meshopt": {}}}]
    with pytest.raises(UserError, match="needs the glTF extension EXT_meshopt"):
        load_scene(file.write(tmp_path / "buffer"))


def texture_uri(uri: str):
    return lambda folder: gltf(images=[{"uri": uri}]).write(folder, "gltf")


def only_ktx2(folder: Path) -> Path:
    file = Gltf(image=b"KTX 20")
    file.header["images"][0]["mimeType"] = "image/ktx2"
    return file.write(folder)


def ply_texture(comments: str):
    def write(folder: Path) -> Path:
        path = folder / "odd.ply"
        path.write_text(PLY.format(comments=comments))
        return path

    return write


def broken_image(folder: Path) -> Path:
    path = write_obj(folder)
    data = encoded(picture())
    (folder / "tex.png").write_bytes(data[: len(data) // 2])
    return path


def material(**settings):
    def write(folder: Path) -> Path:
        file = Gltf(image=encoded(picture().convert("RGBA")))
        file.material |= settings
        return file.write(folder)

    return write


def faded(folder: Path) -> Path:
    file = Gltf(image=encoded(Image.merge("RGBA", (*picture().split(), Image.new("L", (16, 16), 99)))))
    file.material["alphaMode"] = "BLEND"
    return file.write(folder)


def moved_by(**settings):
    def write(folder: Path) -> Path:
        file = Gltf()
        file.node |= settings
        return file.write(folder)

    return write


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (faded, "ignored features of its materials: transparency"),
        (material(emissiveFactor=[0, 1, 0]), "ignored features of its materials: emitted light"),
        (lambda folder: Gltf(uv=None).write(folder), "ignored features of its materials: textures (it has no"),
        (lambda folder: write_obj(folder, mtl="newmtl m\nd .5\nmap_Kd tex.png\n"), "of its materials: transparency"),
        (lambda folder: write_obj(folder, mtl="newmtl m\nKe 0 1 0\nmap_Kd tex.png\n"), "materials: emitted light"),
        (moved_by(skin=0), "its skeleton (skins) is left out"),
        (moved_by(weights=[0.0, 0.5]), "its morph targets are left out"),
        (texture_uri("gone.png"), "its texture gone.png is missing or not a readable image"),
        (only_ktx2, "its texture image/ktx2 is missing or not a readable image"),
        (lambda folder: write_obj(folder, mtl="newmtl m\nmap_Kd gone.png\n"), "its texture gone.png is missing"),
        (lambda folder: write_obj(folder, f"mtllib gone.mtl\n{SQUARE}"), "its material file gone.mtl is missing"),
        (lambda folder: write_obj(folder, mtl="newmtl n\nKd 1 0 0\n"), "its material m is not in any of its material"),
        (broken_image, "its texture tex.png is missing or not a readable image"),
        (ply_texture("comment TextureFile gone.png\n"), "its texture gone.png is missing"),
        (ply_texture(""), "1 of 1 meshes have no texture or colour"),
        (OTHER["coordinates_that_are_not_numbers"], "1 of 2 triangles have no valid texture coordinates"),
        (OTHER["coordinates_without_end"], "1 of 2 triangles have no valid texture coordinates"),
        (OTHER["one_corner_nowhere"], "1 of 2 triangles have infinite or undefined"),
    ],
)  # fmt: skip
def test_what_is_not_drawn_is_named(write, message, tmp_path):
    scene, messages = load(write(tmp_path))
    assert [each for each in messages if message in each and each.startswith(f"{tmp_path}/odd.")]
    assert view(scene)[..., 3].max() == 255


def test_several_textures_of_a_ply_file_are_refused(tmp_path):
    path = ply_texture("comment TextureFile a.png\ncomment TextureFile b.png\n")(tmp_path)
    with pytest.raises(UserError, match=f"^{path}: has 2 textures, but only one can be read"):
        load_scene(path)


@pytest.mark.parametrize(
    "write",
    [
        ODD["plain"],
        material(alphaMode="BLEND"),
        lambda folder: write_obj(folder, mtl="newmtl m\nKe 0 0 0\nd 1\nTr 0\nmap_Kd tex.png\n"),
    ],
)
def test_supported_materials_do_not_warn(write, tmp_path):
    assert load(write(tmp_path))[1] == []


def test_archives_are_refused(tmp_path):
    (tmp_path / "odd.zip").write_bytes(b"PK")
    with pytest.raises(UserError, match=r"odd\.zip: is an archive; unpack it"):
        load_scene(tmp_path / "odd.zip")


def test_textures_of_floating_point_numbers_are_refused(tmp_path):
    file = io.BytesIO()
    picture().convert("F").save(file, "TIFF")
    with pytest.raises(UserError, match="its pixels are floating-point numbers"):
        load_scene(Gltf(image=file.getvalue()).write(tmp_path))
