import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from lp_framework.data.files import ObjectLists, drawn, kept_lists, raise_failures
from lp_framework.data.rendering.renderer import View
from lp_framework.data.sets.rendered import MeshData, ToyData
from lp_framework.data.views import RenderingsData
from lp_framework.errors import UserError

NAMES = [f"object_{index}" for index in range(12)]


@pytest.mark.parametrize(("seen", "unseen"), [(None, 3), (5, 3), (9, 3), (12, 0), (None, 0)])
def test_a_drawn_division_is_seeded_disjoint_and_of_the_size_asked(seen, unseen):
    lists = drawn(NAMES, seen, unseen, 0, Path("here"))
    assert len(lists.unseen) == unseen and len(lists.seen) == (12 - unseen if seen is None else seen)
    assert not set(lists.seen) & set(lists.unseen) and {*lists.seen, *lists.unseen} <= set(NAMES)
    assert lists.seen == sorted(lists.seen) and lists.unseen == sorted(lists.unseen)
    assert drawn(NAMES[::-1], seen, unseen, 0, Path("here")) == lists
    if unseen:
        assert len({tuple(drawn(NAMES, seen, unseen, seed, Path("here")).unseen) for seed in range(5)}) > 2


def test_impossible_divisions():
    with pytest.raises(UserError, match="here: found 12 objects, but 13 are needed"):
        drawn(NAMES, 10, 3, 0, Path("here"))
    with pytest.raises(UserError, match="must not be negative"):
        drawn(NAMES, None, -1, 0, Path("here"))


def test_lists_are_written_once_and_read_afterwards(tmp_path):
    first = kept_lists(tmp_path / "views", {"seed": 0}, lambda: ObjectLists(["a", "b"], ["c"]))
    assert json.loads((tmp_path / "views" / "objects.json").read_text())["unseen"] == ["c"]
    assert kept_lists(tmp_path / "views", {"seed": 0}, lambda: ObjectLists(["other"], [])) == first
    with pytest.raises(
        UserError, match=r"objects\.json: its objects were chosen with other settings \(seed was 0, is 1\)"
    ):
        kept_lists(tmp_path / "views", {"seed": 1}, lambda: first)
    (tmp_path / "views" / "objects.json").write_text("[]")
    with pytest.raises(UserError, match="is not a valid list of objects"):
        kept_lists(tmp_path / "views", {"seed": 0}, lambda: first)


# ---------------------------------------------------------------- a folder of meshes


@pytest.fixture
def meshes(tmp_path) -> Path:
    folder = tmp_path / "meshes"
    folder.mkdir()
    for name in NAMES:
        trimesh.creation.box().export(folder / f"{name}.ply")
    return folder


def names(meshes: Path, **settings) -> list[str]:
    return MeshData(None, str(meshes), views=str(meshes.parent / "views"), **settings).names()


def test_seen_and_unseen_objects_divide_a_folder_of_meshes(meshes):
    seen, unseen = names(meshes, unseen=4), names(meshes, unseen=4, objects="unseen")
    assert len(unseen) == 4 and sorted([*seen, *unseen]) == sorted(NAMES)
    trimesh.creation.box().export(meshes / "another.ply")
    assert names(meshes, unseen=4) == seen and names(meshes, unseen=4, objects="unseen") == unseen


def test_an_undivided_folder_is_all_seen_and_has_no_list(meshes):
    assert names(meshes) == sorted(NAMES)
    assert not (meshes.parent / "views").exists()


def test_objects_are_chosen_by_name_whatever_the_division(meshes):
    assert names(meshes, objects=["object_7", "object_10"], unseen=4) == ["object_10", "object_7"]
    assert names(meshes, objects="object_3") == ["object_3"]
    assert not (meshes.parent / "views").exists()
    for wrong, hint in (("objekt_3", "; did you mean 'object_3'?"), ("unsen", "; did you mean 'unseen'?"), ("mug", "")):
        with pytest.raises(UserError) as caught:
            names(meshes, objects=[wrong])
        assert str(caught.value) == f"data.objects: there is no '{wrong}' in {meshes}{hint}"
    with pytest.raises(UserError, match=r"data\.objects is empty"):
        names(meshes, objects=[])


def test_only_the_chosen_objects_are_made_and_read(tmp_path):
    grey = SimpleNamespace(name="grey", views=lambda scene, cameras, size, angle: map(grey_view, cameras))
    toy = ToyData(grey, str(tmp_path / "toy"), 16, 1, train_views=1, workers=1, objects=["tram", "duck"])
    toy.prepare()
    assert toy.names() == ["duck", "tram"] == sorted(each.name for each in (tmp_path / "toy").glob("[a-z]*"))
    views = RenderingsData(str(tmp_path / "toy"), ["tram"])
    assert views.names() == ["tram"] and views.views("tram", "test").ambiguity == "twofold"
    with pytest.raises(UserError, match=r"there is no 'trams' in .*toy; did you mean 'tram'\?"):
        RenderingsData(str(tmp_path / "toy"), ["trams"]).names()
    with pytest.raises(UserError, match="there is no 'goose' in data=toy"):
        ToyData(grey, str(tmp_path / "toy"), objects=["goose"]).names()


def grey_view(camera) -> View:
    return View(np.full((16, 16, 4), 200, np.uint8))


def test_bad_divisions(meshes):
    with pytest.raises(UserError, match="found 12 objects, but 13 are needed"):
        names(meshes, unseen=12)
    with pytest.raises(UserError, match=r"data\.objects=unseen: there are none; set data\.unseen"):
        names(meshes, objects="unseen")


def failed(failures: dict[str, str]) -> list[str]:
    with pytest.raises(UserError) as caught:
        raise_failures(failures, 90, "rendered")
    return str(caught.value).splitlines()


def test_failures_are_a_short_list():
    assert failed({"mug": "no faces"}) == ["1 of 90 objects could not be rendered: mug: no faces"]
    assert failed(dict.fromkeys(NAMES, "no OpenGL")) == [
        "12 of 90 objects could not be rendered: object_0, object_1, object_2, object_3, object_4 and 7 more: no OpenGL"
    ]
    many = {name: f"{name}.ply: no faces" for name in NAMES} | {"vase": "object_11.ply: no faces"}
    lines = failed(many)
    assert lines[0] == "13 of 90 objects could not be rendered:" and lines[-1] == "  and 8 more"
    assert lines[1:-1] == [f"  {name}: {name}.ply: no faces" for name in NAMES[:5]]
    raise_failures({}, 90, "rendered")
