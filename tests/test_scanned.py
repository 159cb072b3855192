from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scanned_layouts import write_gso, write_oo3d
from view_folders import write_object

from lp_framework import registry
from lp_framework.data.meshes import load_scene, surfaces
from lp_framework.data.sets.rendered import GSOData, OO3DData, load_scan
from lp_framework.errors import UserError


def check_upright_and_painted(scene) -> None:
    np.testing.assert_allclose(scene.extents, [0.5, 1.0, 0.25], atol=1e-9)  # y, z, x of the box: 2, 4, 1
    (surface,) = surfaces(scene)
    top = surface.positions[:, 1] > 0
    assert surface.texture is not None and surface.texture_coordinates is not None
    size = surface.texture.shape[0]
    for high, (red, _, blue) in ((True, (255, 0, 0)), (False, (0, 0, 255))):
        u, v = surface.texture_coordinates[top == high].mean(axis=0)
        colour = surface.texture[int((1 - v) * size), int(u * size)].astype(int)
        assert abs(colour[0] - red) < 30 and abs(colour[2] - blue) < 30
    np.testing.assert_allclose(np.cross(*np.diff(surface.positions[:3], axis=0)) @ surface.normals[0] > 0, True)


def test_gso_objects_are_turned_upright_and_find_their_texture(tmp_path):
    write_gso(tmp_path, "Shark")
    check_upright_and_painted(load_scan(tmp_path / "Shark" / "meshes" / "model.obj", "z"))


def test_omniobject3d_scans_are_upright_as_they_are(tmp_path):
    write_oo3d(tmp_path, "toy_car_003")
    check_upright_and_painted(load_scene(tmp_path / "toy_car" / "toy_car_003" / "Scan" / "Scan.obj"))


# ---------------------------------------------------------------- lists

GSO = [f"Object_{index}" for index in range(9)]
OO3D = ["apple_001", "apple_002", "toy_car_001", "toy_car_002", "teddy_001"]


def gso(root: Path, **settings) -> GSOData:
    settings = {"views": str(root.parent / "views"), "seen": 5, "unseen": 2, **settings}
    return GSOData(None, str(root), **settings)


def test_a_seeded_choice_is_kept_beside_the_views(tmp_path):
    root = write_gso(tmp_path / "gso", *GSO)
    assert registry.get("data", "gso") is GSOData and registry.get("data", "oo3d") is OO3DData
    seen, unseen = gso(root).names(), gso(root, objects="unseen").names()
    assert len(seen) == 5 and len(unseen) == 2 and not set(seen) & set(unseen)
    write_gso(root, "Another", "One_more")
    assert gso(root).names() == seen and gso(root, objects="unseen").names() == unseen
    assert gso(root, objects=["One_more", "Another"]).names() == ["Another", "One_more"]
    with pytest.raises(UserError, match="split_seed was 0, is 1"):
        gso(root, split_seed=1).names()


def test_the_names_are_those_of_the_renderings_where_they_are_given(tmp_path):
    root = write_gso(tmp_path / "gso", *GSO)
    for name in ("Object_3", "Object_7"):
        write_object(tmp_path / "rendering" / "GSO", name, train=2, test=2)
    renderings = str(tmp_path / "rendering" / "GSO")
    assert gso(root, renderings=renderings).names() == ["Object_3", "Object_7"]
    unseen = gso(root, renderings=renderings, objects="unseen").names()
    assert len(unseen) == 2 and not set(unseen) & {"Object_3", "Object_7"}
    write_object(tmp_path / "rendering" / "GSO", "Absent", train=2, test=2)
    with pytest.raises(UserError, match=r"1 of the 3 objects of .*GSO are missing, such as Absent"):
        gso(root, renderings=renderings, views=str(tmp_path / "other")).names()


def test_categories_with_an_underscore(tmp_path):
    root = write_oo3d(tmp_path / "raw_scans", *OO3D)
    data = OO3DData(None, str(root), views=str(tmp_path / "views"), seen=5, unseen=0)
    assert data.names() == sorted(OO3D)
    assert [data.files[name].parent.parent.name for name in OO3D] == OO3D


def test_bad_downloads(tmp_path):
    root = write_gso(tmp_path / "gso", *GSO)
    with pytest.raises(UserError, match="nowhere: there is no such folder of objects of GSO"):
        gso(tmp_path / "nowhere").names()
    with pytest.raises(UserError, match=r"holds no objects of GSO; looked for .*\*/meshes/model\.obj"):
        gso(root / "Object_0").names()
    with pytest.raises(UserError, match="found 9 objects, but 80 are needed"):
        gso(root, seen=70, unseen=10).names()
    with pytest.raises(UserError, match=r"looked for .*\*/\*/Scan/Scan\.obj"):
        OO3DData(None, str(root), views=str(tmp_path / "views")).names()
    with pytest.raises(UserError, match="nowhere: there is no such folder"):
        OO3DData(None, str(tmp_path / "nowhere"), views=str(tmp_path / "views")).names()


def test_damaged_objects(tmp_path):
    root = write_gso(tmp_path, *GSO[:3])
    (root / GSO[0] / "materials" / "textures" / "texture.png").unlink()
    (root / GSO[1] / "meshes" / "model.obj").write_text("nothing\n")
    (root / GSO[2] / "meshes" / "model.obj").unlink()
    messages = ["its texture texture.png is missing", "model.obj: ", "model.obj: there is no"]
    for name, message in zip(GSO, messages, strict=False):
        with pytest.raises(UserError, match=message):
            load_scan(root / name / "meshes" / "model.obj", "z")


@pytest.mark.parametrize(
    ("write", "data", "missing", "message"),
    [
        (write_gso, GSOData, "meshes/model.mtl", "model.obj: its material file model.mtl is missing"),
        (write_oo3d, OO3DData, "Scan/Scan.mtl", "Scan.obj: its material file Scan.mtl is missing"),
        (write_oo3d, OO3DData, "Scan/Scan.jpg", "Scan.obj: its texture Scan.jpg is missing"),
    ],
)
def test_scans_without_their_material_are_not_rendered(write, data, missing, message, tmp_path):
    root = write(tmp_path / "scans", "cup_001")
    next(root.glob(f"**/{missing}")).unlink()
    (obj,) = data(None, str(root), views=str(tmp_path / "views"), seen=1, unseen=0).objects()
    with pytest.raises(UserError, match=message):
        obj.load()


def test_rendering_objects_as_released(tmp_path):
    from lp_framework.data.rendering.raycast import RaycastRenderer

    root = write_gso(tmp_path / "gso", *GSO[:2])
    settings = {"resolution": 24, "test_views": 2, "latitude_step_degrees": 60.0, "longitude_step_degrees": 180.0}
    data = GSOData(RaycastRenderer(), str(root), str(tmp_path / "views"), seen=1, unseen=1, workers=1, **settings)
    data.prepare()
    (name,) = data.names()
    assert [len(data.views(name, split)) for split in ("train", "test")] == [4, 2]
    pixels = np.asarray(Image.open(tmp_path / "views" / name / "train" / "rgb" / "000.png")).astype(int)
    rows = [pixels[half][pixels[half][..., 3] > 200] for half in (slice(0, 12), slice(12, 24))]
    assert (rows[0][:, 0] > rows[0][:, 2]).mean() > 0.5 > (rows[1][:, 0] > rows[1][:, 2]).mean()  # red on top
