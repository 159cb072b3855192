"""For any file content, readers return a valid result or one sentence naming the file, and change no files."""

from __future__ import annotations

import gzip
import io
import json
import math
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from corruptions import NONSENSE, damaged, json_damage, misshapen, read_or_reported, snapshot
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from result_folders import write_result
from test_co3d import SEQUENCE, write_category
from test_hopev2 import write_hopev2
from test_omni3d import write_omni3d
from view_folders import draw_view, random_poses, transforms, write_split

from lp_framework.data.cache import cached_array, decoded_views
from lp_framework.data.files import ObjectLists, kept_lists
from lp_framework.data.meshes import load_scene
from lp_framework.data.photographs import read_image
from lp_framework.data.sets.co3d import CO3DData
from lp_framework.data.sets.converted import is_converted
from lp_framework.data.sets.hopev2 import HOPEv2Data
from lp_framework.data.sets.omni3d import RADIUS, omni3d_cameras
from lp_framework.data.sets.rendered import read_labels
from lp_framework.data.views import read_views
from lp_framework.evaluation.journal import Journal
from lp_framework.evaluation.metrics import SolvedBatch
from lp_framework.report.runs import find_runs

FUZZ = settings(
    max_examples=100,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
SLOW = settings(FUZZ, max_examples=40)


def rigid(cameras: torch.Tensor) -> bool:
    rotation = cameras[..., :3, :3]
    skew = (rotation.mT @ rotation - torch.eye(3, dtype=rotation.dtype)).abs().max()
    return bool(cameras.isfinite().all() and skew < 1e-2 and (rotation.det() > 0).all())


# ---------------------------------------------------------------- views


VIEWS = transforms(random_poses(3, "fuzz"), ambiguity="twofold", unique_answer=True)


@pytest.fixture(scope="module")
def views(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("views")
    write_split(root / "cup" / "test", random_poses(3, "fuzz"))
    return root


@FUZZ
@given(content=json_damage(VIEWS))
def test_transform_json(views, content):
    file = views / "cup" / "test" / "transform.json"
    file.write_bytes(content)
    before = snapshot(views)
    found = read_or_reported(lambda: read_views(views, "cup", "test"), file)
    assert snapshot(views) == before
    if found is not None:
        assert len(found) == len(found.files) == len(found.cameras) > 0
        assert all(image.is_file() for image in found.files)
        assert rigid(found.cameras) and found.poses.isfinite().all() and (found.poses[:, 2] > 0).all()
        assert ((found.field_of_view > 0) & (found.field_of_view < math.pi)).all()


@FUZZ
@given(content=json_damage({"chosen": {"seed": 0}, "seen": ["a", "b"], "unseen": ["c"]}))
def test_objects_json(tmp_path, content):
    (tmp_path / "objects.json").write_bytes(content)
    lists = read_or_reported(lambda: kept_lists(tmp_path, {"seed": 0}, lambda: ObjectLists([], [])), "objects.json")
    assert (tmp_path / "objects.json").read_bytes() == content
    if lists is not None:
        assert all(isinstance(name, str) for name in [*lists.seen, *lists.unseen])


@FUZZ
@given(content=json_damage({"object": "cup", "source": "download", "left_out": {}}))
def test_conversion_json(tmp_path, content):
    (tmp_path / "conversion.json").write_bytes(content)
    assert is_converted(tmp_path, {"source": "download"}, tmp_path) in (True, False)


# ---------------------------------------------------------------- data sets


def npy(array: object) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()


POSE = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, -4], [0, 1, 0, 0], [0, 0, 0, 1]], dtype=torch.float64).numpy()
ARRAYS = st.one_of(
    damaged(npy(POSE)),
    st.sampled_from(
        [POSE[:3], POSE.astype(np.float16), POSE * math.nan, POSE * 1e200, POSE * 0, POSE.T, POSE[None]]
    ).map(npy),
    st.sampled_from(
        [np.eye(4, dtype="<U3"), np.array(["a"]), np.eye(4) * 1j, np.eye(4, dtype=bool), np.array(3.0)]
    ).map(npy),
    st.sampled_from([b"PK\x03\x04", b"\x93NUMPY\x01\x00\xff\xff{" + b"(" * 20_000]),
    NONSENSE.map(lambda value: npy(np.array([None, repr(value)], dtype=object))),  # a pickle
)


@FUZZ
@given(content=ARRAYS)
def test_poses_of_omni3d(tmp_path_factory, content):
    root = tmp_path_factory.mktemp("omni3d")
    write_omni3d(root)
    file = root / "dinosaur_002" / "poses" / "011.npy"
    file.write_bytes(content)
    before = snapshot(root)
    cameras = read_or_reported(lambda: omni3d_cameras(root, "dinosaur_002"), file)
    assert snapshot(root) == before
    if cameras is not None:
        stacked = torch.stack(list(cameras.values()))
        assert rigid(stacked)
        assert stacked[:, :3, 3].norm(dim=-1).median().item() == pytest.approx(RADIUS)


@pytest.fixture(scope="module")
def hope(tmp_path_factory) -> Path:
    return write_hopev2(tmp_path_factory.mktemp("hope"), views=3)


@SLOW
@given(data=st.data())
def test_annotations_of_hopev2(hope, tmp_path_factory, data):
    files = [hope / "models" / "models_info.json", *sorted((hope / "val" / "000001").glob("*.json"))]
    file = data.draw(st.sampled_from(files), "file")
    whole = file.read_bytes()
    try:
        file.write_bytes(data.draw(json_damage(json.loads(whole)), "content"))
        before = snapshot(hope)
        read_or_reported(
            lambda: photographs_of(HOPEv2Data(str(hope), splits=["val"])), file, file.parent, "mask_visib", "rgb"
        )
        assert snapshot(hope) == before
    finally:
        file.write_bytes(whole)


def photographs_of(dataset: HOPEv2Data | CO3DData) -> None:
    for name in dataset.names():
        photographs, points, *_ = dataset.photographs(name)
        for photograph in photographs:
            assert rigid(photograph.camera) and photograph.intrinsics.isfinite().all()
        assert points.isfinite().all()


@pytest.fixture(scope="module")
def co3d(tmp_path_factory) -> Path:
    return write_category(tmp_path_factory.mktemp("co3d"), views=4)


@SLOW
@given(data=st.data())
def test_annotations_of_co3d(co3d, tmp_path_factory, data):
    file = co3d / "hydrant" / "frame_annotations.jgz"
    whole = file.read_bytes()
    frames = json.loads(gzip.decompress(whole))
    zipped = misshapen(frames).map(lambda value: gzip.compress(json.dumps(value).encode(), 1))
    set_list = co3d / "hydrant" / "set_lists" / "set_lists_manyview_dev_0.json"
    listed = set_list.read_bytes()
    try:
        if data.draw(st.booleans(), "frames"):
            file.write_bytes(
                data.draw(st.one_of(zipped, damaged(whole), st.just(gzip.compress(b"[" * 10**5))), "content")
            )
        else:
            set_list.write_bytes(data.draw(json_damage(json.loads(listed)), "content"))
        before = snapshot(co3d)
        dataset = CO3DData(str(co3d), str(tmp_path_factory.mktemp("views")), scenes=1)
        read_or_reported(lambda: photographs_of(dataset), file, set_list, SEQUENCE, co3d)
        assert snapshot(co3d) == before
    finally:
        file.write_bytes(whole)
        set_list.write_bytes(listed)


OFF = trimesh.creation.box().export(file_type="off").encode()
MESHES = {
    "off": OFF,
    "obj": trimesh.creation.box().export(file_type="obj").encode(),
    "stl": trimesh.creation.box().export(file_type="stl"),
    "ply": trimesh.creation.box().export(file_type="ply"),
    "glb": trimesh.creation.box().export(file_type="glb"),
}


@FUZZ
@given(data=st.data())
def test_meshes(tmp_path_factory, data):
    suffix = data.draw(st.sampled_from(sorted(MESHES)), "format")
    file = tmp_path_factory.mktemp("meshes") / f"box.{suffix}"
    file.write_bytes(data.draw(damaged(MESHES[suffix]), "content"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = read_or_reported(lambda: load_scene(file), file)
    if scene is not None:
        assert scene.extents.max() == pytest.approx(1)


# ---------------------------------------------------------------- results


@pytest.fixture(scope="module")
def result(tmp_path_factory) -> dict:
    return json.loads((write_result(tmp_path_factory.mktemp("runs") / "one") / "results.json").read_text())


@FUZZ
@given(data=st.data())
def test_results_json(tmp_path_factory, result, data):
    folder = tmp_path_factory.mktemp("runs")
    sound = write_result(folder / "sound", {"seed": 1}, seed=1)
    other = write_result(folder / "other")
    (other / "results.json").write_bytes(data.draw(json_damage(result), "content"))
    before = snapshot(folder)
    runs, left_out = find_runs([folder])
    assert snapshot(folder) == before
    assert sound in [run.folder for run in runs]
    assert {*(run.folder for run in runs), *(each.folder for each in left_out)} == {sound, other}
    for run in runs:
        assert all(isinstance(value, float) for over in run.metrics.values() if over for value in over.values())
    assert all("\n" not in each.reason for each in left_out)


@FUZZ
@given(content=damaged(b"hydra:\n  job: {name: eval}\n  runtime:\n    choices: {experiment: gamma}\n"))
def test_hydras_record_of_a_job(tmp_path_factory, content):
    folder = write_result(tmp_path_factory.mktemp("runs") / "one")
    (folder / ".hydra" / "hydra.yaml").write_bytes(content)
    runs, left_out = find_runs([folder])
    assert len(runs) + len(left_out) == 1


SUBJECT = {
    "config": {"seed": 0, "solver": {"name": "langevin"}},
    "checkpoint": None,
    "protocol": "ordered",
    "views": "a",
}


@pytest.fixture(scope="module")
def journal(tmp_path_factory) -> tuple[Path, dict, SolvedBatch]:
    """A run that was stopped, what it evaluates, and what it had solved."""
    folder = tmp_path_factory.mktemp("run")
    subject = {key: value for key, value in SUBJECT.items() if key != "views"}
    rows = {name: torch.arange(4.0).view(2, 2).double() for name in ("rotation", "translation", "answer")}
    pair, numbers = torch.tensor([[3, 4], [5, 3]]), {name: torch.tensor([3, 5]) for name in ("object", "chosen")}
    sure = torch.tensor([0.5, math.nan], dtype=torch.float64)
    batch = SolvedBatch(pair, **numbers, **rows, probability=sure, seconds=0.5, passes=3)
    journal = Journal(folder, subject)
    assert journal.begin("a") == []
    journal.append(batch, 0)
    return folder, subject, batch


@FUZZ
@given(data=st.data())
def test_the_journal_of_an_evaluation(journal, data):
    """Damaged lines are ignored, and their pairs are solved again."""
    folder, subject, batch = journal
    before = snapshot(folder)
    file = folder / "unfinished" / data.draw(st.sampled_from(["evaluation.json", "rank_0.jsonl"]), "file")
    damage = json_damage(SUBJECT) if file.suffix == ".json" else damaged(file.read_bytes())
    try:
        file.write_bytes(data.draw(damage, "content"))
        for found in read_or_reported(lambda: Journal(folder, subject).begin("a"), folder) or []:
            assert torch.equal(found.pair, batch.pair) and torch.equal(found.rotation, batch.rotation)
    finally:
        file.parent.mkdir(exist_ok=True)
        for name, content in before.items():
            (folder / name).write_bytes(content)


@FUZZ
@given(content=damaged(b"cup: {ambiguity: twofold, reason: a}\nmug: {ambiguity: unique, unique_answer: true}\n"))
def test_labels_of_objects(tmp_path, content):
    file = tmp_path / "labels.yaml"
    file.write_bytes(content)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        labels = read_or_reported(lambda: read_labels(file, ["cup", "mug"], tmp_path), file)
    assert file.read_bytes() == content
    if labels is not None:
        assert set(labels) <= {"cup", "mug"}


# ---------------------------------------------------------------- images and caches


def picture(form: str, mode: str) -> bytes:
    buffer = io.BytesIO()
    pixels = draw_view(random_poses(1, "picture")[0], 16)
    Image.fromarray(pixels).convert(mode).save(buffer, form)
    return buffer.getvalue()


PICTURES = {form: picture(form, "RGB" if form == "JPEG" else "RGBA") for form in ("PNG", "JPEG", "WEBP", "TIFF", "BMP")}


@FUZZ
@given(data=st.data())
def test_photographs(tmp_path, data):
    form = data.draw(st.sampled_from(sorted(PICTURES)), "format")
    file = tmp_path / f"photograph.{form.lower()}"
    file.write_bytes(data.draw(damaged(PICTURES[form]), "content"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        image = read_or_reported(lambda: read_image(file), file)
    if image is not None:
        assert image.mode in ("RGB", "RGBA") and min(image.size) > 0


@FUZZ
@given(content=damaged(PICTURES["PNG"]))
def test_images_of_views(tmp_path_factory, content):
    folder = tmp_path_factory.mktemp("views")
    file = folder / "000.png"
    file.write_bytes(content)
    decoded = read_or_reported(lambda: decoded_views([file], 8, folder / "cache"), file)
    assert file.read_bytes() == content
    if decoded is None:
        assert not list((folder / "cache").glob("*.npy"))
    else:
        assert decoded[1].shape == (1, 8, 8, 3)


@FUZZ
@given(data=st.data())
def test_entries_of_a_cache(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("cache")

    def blocks() -> list[np.ndarray]:
        return [np.arange(12, dtype=np.float32).reshape(3, 4)]

    cached_array(folder, "key", 3, blocks)
    file = data.draw(st.sampled_from([folder / "key.npy", folder / "key.json"]), "file")
    file.write_bytes(data.draw(damaged(file.read_bytes()), "content"))
    assert np.array_equal(cached_array(folder, "key", 3, blocks), np.arange(12).reshape(3, 4))
