import itertools
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from view_folders import write_object, write_objects

from lp_framework import registry
from lp_framework.data.module import EVALUATION_PAIRS, PairDataModule
from lp_framework.data.pairs import as_images
from lp_framework.data.rendering.renderer import Renderer, View
from lp_framework.data.sets import rendered
from lp_framework.data.sets.rendered import MeshData, ToyData
from lp_framework.data.views import RenderingsData, ViewSource
from lp_framework.errors import UserError
from lp_framework.geometry import relative_pose


@pytest.fixture
def root(tmp_path) -> Path:
    """Three objects with 12 training and 4 test views each."""
    return write_objects(tmp_path / "views", train=12, test=4)


@pytest.fixture
def make(root, tmp_path):
    """`make(seed=1)`: the data module of that folder, with small settings."""

    def build(**changes) -> PairDataModule:
        settings = {"image_size": 16, "batch_pairs": 40, "block": 3, "validation_views": 4, "seed": 0}
        return PairDataModule(RenderingsData(str(root)), **{"cache": str(tmp_path / "cache"), **settings, **changes})

    return build


@pytest.fixture
def opened(monkeypatch) -> list[Path]:
    """The images that have been opened since."""
    paths, original = [], Image.open

    def counting(path):
        paths.append(path)
        return original(path)

    monkeypatch.setattr(Image, "open", counting)
    return paths


class Means:
    """Stands for a frozen backbone: the mean colour times a weight. Counts the images it is shown; one of them, in each
    `cache_features`, is the sample by which the data module recognises it."""

    def __init__(self, weight: float = 1.0) -> None:
        self.weight, self._lengths = weight, []

    @property
    def shown(self) -> int:
        return sum(self._lengths)

    def trunk(self, images: torch.Tensor) -> torch.Tensor:
        self._lengths.append(len(images))
        return self.weight * images.mean(dim=(2, 3))

    def to(self, device: torch.device) -> None:
        """It has nothing to move."""

    def fingerprint(self) -> str:
        return f"means {self.weight}"


def files_of(table) -> set[Path]:
    assert len(set(table.files)) == len(table.files)
    return set(table.files)


def pairs_of(loader) -> list[list[int]]:
    return [pair for batch in loader for pair in batch.pairs.tolist()]


# ---------------------------------------------------------------- splits


def test_validation_views_are_held_out_of_the_training_views(make, root):
    data = make()
    train, validation = data.table("train"), data.table("validation")
    assert train.counts == [8] * 3 and validation.counts == [4] * 3
    assert not files_of(train) & files_of(validation)
    assert files_of(train) | files_of(validation) == set(root.glob("*/train/rgb/*.png"))
    for table in (train, validation):
        assert table.names == ["cup", "tram", "vase"] and table.ambiguities == ["unique", "twofold", "continuous"]
        assert table.unique_answer == [True, True, False]


def test_each_kept_view_keeps_its_own_camera(make):
    everything = make(validation_views=0).table("train")
    camera = dict(zip(everything.files, everything.cameras, strict=True))
    for split in ("train", "validation"):
        table = make().table(split)
        assert all(torch.equal(camera[file], own) for file, own in zip(table.files, table.cameras, strict=True))


def test_the_division_depends_on_the_seed_alone(make, root, tmp_path):
    def held_out(seed: int) -> list[str]:
        return [str(file) for file in make(seed=seed).table("validation").files]

    assert held_out(0) == held_out(0)
    assert len({tuple(held_out(seed)) for seed in range(6)}) > 3
    before = [file for file in held_out(0) if "/cup/" in file]
    write_object(root, "another", train=12, test=4)
    assert [file for file in held_out(0) if "/cup/" in file] == before


def test_objects_hold_out_views_of_their_own(make, root):
    for name in ("brush", "cart", "drum"):
        write_object(root, name, train=12, test=4)
    places: dict[str, list[str]] = {}
    for file in make().table("validation").files:
        places.setdefault(file.parts[-4], []).append(file.name)
    assert len(places) == 6 and len({tuple(each) for each in places.values()}) > 3


def test_test_views_are_never_divided(make, root):
    for validation_views in (0, 2, 4):
        table = make(validation_views=validation_views).table("test")
        assert files_of(table) == set(root.glob("*/test/rgb/*.png"))


def test_without_validation_all_views_train(make, root):
    data = make(validation_views=0)
    assert files_of(data.table("train")) == set(root.glob("*/train/rgb/*.png"))
    assert data.val_dataloader() == []


def test_too_few_views_to_hold_some_out(make):
    assert make(validation_views=10).table("train").counts == [2] * 3
    with pytest.raises(
        UserError, match=r"object 'cup' has 12 training views; holding out data\.validation_views=11 needs at least 13"
    ):
        make(validation_views=11).table("train")


@pytest.mark.parametrize(
    "wrong", [{"validation_views": 1}, {"validation_views": -2}, {"image_size": 7}, {"batch_pairs": 0}, {"block": 0}]
)
def test_impossible_settings(make, wrong):
    with pytest.raises(UserError, match=rf"data\.{next(iter(wrong))} must be"):
        make(**wrong)


def test_an_object_without_test_views_is_trained_on_and_named_when_evaluated(make, root):
    (root / "tram" / "test" / "transform.json").unlink()
    data = make()
    data.prepare_data()
    data.evaluate_on("ordered", seed=0)
    with pytest.raises(UserError, match=r"tram/test/transform\.json: there is no such file"):
        data.prepare_data()


def test_a_broken_image_is_named_before_training(make, root):
    file = root / "vase" / "train" / "rgb" / "003.png"
    file.write_bytes(file.read_bytes()[:50])
    with pytest.raises(UserError, match=r"vase/train/rgb/003\.png: is not a readable image"):
        make().prepare_data()


def test_whole_objects_can_be_held_out_for_validation(make, root):
    data = make(validation_objects=1)
    train, validation = data.table("train"), data.table("validation")
    assert len(validation.names) == 1 and validation.counts == [4]
    assert sorted([*train.names, *validation.names]) == ["cup", "tram", "vase"] and train.counts == [12, 12]
    assert files_of(validation) < set(root.glob(f"{validation.names[0]}/train/rgb/*.png"))
    assert data.table("all_train").counts == [12] * 3 and data.table("test").counts == [4] * 3
    drawn = {tuple(make(validation_objects=1, seed=seed).table("validation").names) for seed in range(9)}
    assert len(drawn) > 1 and make(validation_objects=1).table("validation").names == validation.names
    before = make(validation_objects=2).table("validation").names
    write_object(root, "zebra", train=12, test=4)  # another object takes the place of one of them at most
    assert len(set(before) & set(make(validation_objects=2).table("validation").names)) >= 1
    assert make(validation_objects=2, validation_views=12).table("validation").counts == [12] * 2
    with pytest.raises(UserError, match=r"data\.validation_objects=4 of 4 objects leave none to train on"):
        make(validation_objects=4).table("train")
    with pytest.raises(UserError, match=r"data\.validation_objects must be 0 where data\.validation_views is 0, got 1"):
        make(validation_objects=1, validation_views=0)


# ---------------------------------------------------------------- what is decoded and computed


def test_nothing_is_decoded_twice_however_the_views_are_divided(make, opened, root):
    make().prepare_data()
    assert sorted(opened) == sorted(root.glob("*/train/rgb/*.png"))  # training needs no test views
    for changes in ({}, {"seed": 1}, {"validation_views": 2}, {"validation_views": 0}):
        data = make(**changes)
        data.prepare_data()
        list(data.train_dataloader()), list(data.val_dataloader())
    assert len(opened) == 3 * 12
    for _ in range(2):
        list(make().test_dataloader())
    assert sorted(opened) == sorted(root.glob("*/*/rgb/*.png"))


@pytest.mark.parametrize("split", ["train", "validation", "test"])
def test_a_view_shows_its_own_file(make, split):
    data = make().data(split)
    for view, file in enumerate(data.table.files):
        pixels = np.asarray(Image.open(file)).astype(int)
        expected = np.where(pixels[..., 3:] > 0, pixels[..., :3], 255)
        np.testing.assert_array_equal(data.images[data.rows[view]], expected)
    pairs = data.table.pairs("ordered")[-5:]
    batch = data[pairs]
    assert torch.equal(batch.images[batch.query], as_images(torch.from_numpy(data.images[data.rows[pairs[:, 1]]])))


def test_features_are_computed_once_and_are_the_backbones(make):
    extractor = Means()
    data = make()
    data.cache_features(extractor)
    data.prepare_data()
    assert extractor.shown == 3 * 12 + 1
    plain = make()
    for split in ("train", "validation", "test"):
        pairs = data.table(split).pairs("ordered")
        batch, images = data.data(split)[pairs], plain.data(split)[pairs].images
        assert batch.pixels is None
        torch.testing.assert_close(batch.features, Means().trunk(images), rtol=0, atol=1e-6)
    again = make(seed=3)  # the views are divided otherwise, in a run of its own
    again.cache_features(extractor)
    list(again.train_dataloader()), list(again.val_dataloader())
    assert extractor.shown == 3 * (12 + 4) + 2


class Moving(torch.nn.Module):
    """A backbone that is really moved, if only to another type; its head is to be trained afterwards."""

    def __init__(self) -> None:
        super().__init__()
        self.head = torch.nn.Linear(3, 2)

    def to(self, device: torch.device) -> object:
        return self.double()

    def trunk(self, images: torch.Tensor) -> torch.Tensor:
        return images.mean(dim=(2, 3))

    def fingerprint(self) -> str:
        return "moving"


def test_test_views_can_be_cropped_as_photographs_are_and_others_are_not(make, root):
    for file in root.glob("*/*/rgb/*.png"):
        pixels = np.zeros((64, 64, 4), dtype=np.uint8)
        pixels[40:50, 5:25] = [200, 0, 0, 255]
        Image.fromarray(pixels).save(file)
    for crop in (False, True):
        module = make(crop=crop, image_size=256)
        for split in ("test", "train"):
            shown = (np.asarray(module.data(split).images[0])[..., 1] < 128).nonzero()
            height, width = (np.ptp(each) + 1 for each in shown)
            cropped = crop and split == "test"
            assert width == pytest.approx(200 if cropped else 80, abs=2)
            assert height == pytest.approx(width / 2, abs=2)
            assert shown[0].mean() == pytest.approx(127.5 if cropped else 180, abs=2)


def test_a_backbone_moved_to_compute_features_can_still_be_trained(make):
    backbone, data = Moving(), make()
    data.cache_features(backbone)
    data.prepare_data()
    assert backbone.head.weight.dtype == torch.float64
    assert not any(parameter.is_inference() for parameter in backbone.parameters())


def test_features_belong_to_the_weights_and_the_images(make):
    first, other = Means(1.0), Means(-2.0)
    for extractor in (first, other, first):
        data = make()
        data.cache_features(extractor)
        view = data.data("test")[np.array([[0, 1]])]
        expected = extractor.weight * as_images(torch.tensor(make().data("test").images[:2])).mean(dim=(2, 3))
        torch.testing.assert_close(view.features, expected, rtol=0, atol=1e-6)
    assert (first.shown, other.shown) == (3 * 4 + 2, 3 * 4 + 1)
    data = make(image_size=8)
    data.cache_features(first)
    data.data("test")
    assert first.shown == 2 * 3 * 4 + 3


def test_features_do_not_depend_on_the_number_of_threads(make, tmp_path, monkeypatch):
    backbone = torch.nn.Conv2d(3, 8, 7, dtype=torch.float32).requires_grad_(False)

    class Convolved(Means):
        def trunk(self, images: torch.Tensor) -> torch.Tensor:
            return backbone(images).flatten(1)

    found = []
    for threads, cores in ((1, 1), (2, 3)):
        monkeypatch.setattr("lp_framework.data.module.cores", lambda cores=cores: cores)
        torch.set_num_threads(threads)
        try:
            data = make(cache=str(tmp_path / f"cache_{cores}"))
            data.cache_features(Convolved())
            found.append(np.array(data.data("train").features))
            assert torch.get_num_threads() == threads
        finally:
            torch.set_num_threads(1)
    np.testing.assert_array_equal(*found)


class Squares(Means):
    """The same weights and the same name, but other code, as when a plugin is mended."""

    def trunk(self, images: torch.Tensor) -> torch.Tensor:
        return super().trunk(images**2)


def test_features_of_earlier_code_are_not_reused(make):
    for extractor in (Means(), Squares()):
        data = make()
        data.cache_features(extractor)
        view = data.data("test")[np.array([[0, 1]])]
        images = as_images(torch.tensor(make().data("test").images[:2]))
        torch.testing.assert_close(view.features, type(extractor)().trunk(images), rtol=0, atol=1e-6)


class Patches(Means):
    """Features of another shape and type: a token for every quarter of the image, in half precision."""

    def trunk(self, images: torch.Tensor) -> torch.Tensor:
        return images.unflatten(2, (2, -1)).unflatten(4, (2, -1)).mean(dim=(3, 5)).flatten(2).mT.half()

    def fingerprint(self) -> str:
        return "patches"


def test_features_may_have_any_shape_and_type(make):
    data = make()
    data.cache_features(Patches())
    pairs = data.table("test").pairs("ordered")
    features = data.data("test")[pairs].features
    assert features.dtype == torch.float16
    torch.testing.assert_close(features, Patches().trunk(make().data("test")[pairs].images), rtol=0, atol=1e-3)
    assert features.shape[1:] == (4, 3)


def test_nothing_is_printed_where_there_is_no_terminal(make, capfd):
    data = make()
    data.cache_features(Means())
    data.prepare_data()
    assert capfd.readouterr() == ("", "")


# ---------------------------------------------------------------- epochs


def wanted(table, protocol: str = "ordered") -> list[list[int]]:
    return sorted(table.pairs(protocol).tolist())


def test_training_goes_through_all_ordered_pairs_of_the_training_views(make):
    data = make()
    loader = data.train_dataloader()
    assert sorted(pairs_of(loader)) == wanted(data.table("train"))
    assert len(list(loader)) == len(loader) > 1


def test_epochs_of_training_differ_and_repeat_by_seed(make):
    def epoch(number: int, seed: int = 0) -> list[list[int]]:
        loader = make(seed=seed).train_dataloader()
        loader.sampler.set_epoch(number)
        return pairs_of(loader)

    assert epoch(0) == epoch(0) != epoch(1)
    assert epoch(0, seed=1) != epoch(0)


def test_validation_goes_through_all_ordered_pairs_in_one_order(make):
    data = make()
    assert sorted(pairs_of(data.val_dataloader())) == wanted(data.table("validation"))
    assert pairs_of(data.val_dataloader()) == pairs_of(make().val_dataloader())


@pytest.mark.parametrize("protocol", ["ordered", "per_view"])
def test_evaluation_goes_through_the_test_views(make, protocol):
    data = make()
    data.evaluate_on(protocol, seed=0)
    loader = data.test_dataloader()
    assert sorted(pairs_of(loader)) == wanted(data.table("test"), protocol)
    for batch in loader:
        assert batch.pixels is not None and len(batch) <= EVALUATION_PAIRS
        reference, query = batch.poses[batch.reference], batch.poses[batch.query]
        assert torch.equal(batch.relative_poses(), relative_pose(reference, query).float())


def test_ifusions_pairs_are_of_the_first_five_training_views_on_disk(make, root):
    expected = {root / name / "train" / "rgb" / f"{i:03d}.png" for name in ("cup", "tram", "vase") for i in range(5)}
    for seed in range(3):
        data = make(seed=seed)
        data.evaluate_on("ifusion", seed=0)
        loader = data.test_dataloader()
        views = {view for pair in pairs_of(loader) for view in pair}
        assert {loader.dataset.table.files[view] for view in views} == expected


def distinct(shares: list[list[list[int]]]) -> list[list[int]]:
    return sorted({tuple(pair): pair for pair in itertools.chain(*shares)}.values())


@pytest.mark.parametrize("world", [2, 3])
def test_processes_share_the_pairs_out(make, world):
    shares: dict[str, list[list[list[int]]]] = {"train": [], "validation": [], "evaluation": []}
    for rank in range(world):
        data = make()
        data.trainer = SimpleNamespace(global_rank=rank, world_size=world)
        shares["train"].append(pairs_of(data.train_dataloader()))
        shares["validation"].append(pairs_of(data.val_dataloader()))
        shares["evaluation"].append(pairs_of(data.test_dataloader()))
    assert sorted(itertools.chain(*shares["train"])) == wanted(data.table("train"))
    assert distinct(shares["validation"]) == wanted(data.table("validation"))
    assert distinct(shares["evaluation"]) == wanted(data.table("test"))


# ---------------------------------------------------------------- data sets that are rendered


class Grey(Renderer):
    """Draws plain views and counts them."""

    name = "grey"

    def __init__(self) -> None:
        self.drawn = 0

    def views(self, scene, camera_to_world, resolution, field_of_view_degrees):
        for _ in camera_to_world:
            self.drawn += 1
            yield View(np.full((resolution, resolution, 4), 200, np.uint8))


@pytest.fixture
def meshes(tmp_path) -> Path:
    """A folder with two boxes, painted so that nothing is warned of."""
    folder = tmp_path / "meshes"
    folder.mkdir()
    for name, width in (("brick", 2.0), ("cube", 1.0)):
        box = trimesh.creation.box(extents=(width, 1, 1))
        box.visual.vertex_colors = [200, 30, 30, 255]
        box.export(folder / f"{name}.ply")
    return folder


@pytest.fixture
def mesh_data(meshes, tmp_path):
    """`mesh_data()`: the views of that folder."""

    def build(renderer: Renderer | None = None, path: Path = meshes, **changes) -> MeshData:
        settings = {"resolution": 8, "test_views": 2, "workers": 1}
        renderer = Grey() if renderer is None else renderer
        return MeshData(renderer, str(path), views=str(tmp_path / "rendered"), **{**settings, **changes})

    return build


def test_meshes_are_rendered_on_first_use_only_and_then_not_even_loaded(mesh_data, monkeypatch, capfd):
    first = Grey()
    mesh_data(first).prepare()
    assert first.drawn == 2 * (216 + 2)

    def fail(path: Path) -> None:
        raise AssertionError("loaded again")

    monkeypatch.setattr(rendered, "load_scene", fail)
    second = Grey()
    data = mesh_data(second)
    data.prepare()
    assert second.drawn == 0 and capfd.readouterr() == ("", "")
    assert data.names() == ["brick", "cube"] and [len(data.views(name, "test")) for name in data.names()] == [2, 2]
    assert labels_of(data) == labels_of(data, "train") == dict.fromkeys(["brick", "cube"], ("unlabelled", None))


def test_the_render_command_sees_another_mesh_under_the_name(mesh_data, meshes):
    mesh_data().prepare(check_meshes=True)
    mesh_data().prepare(check_meshes=True)
    (meshes / "brick.ply").replace(meshes / "cube.ply")
    with pytest.raises(UserError, match=r"cube: the views in .* were rendered differently \(from another mesh"):
        mesh_data().prepare(check_meshes=True)


def test_a_changed_protocol_is_always_detected(mesh_data):
    mesh_data().prepare()
    with pytest.raises(UserError, match=r"rendered differently \(test_views was 2, is 3\)"):
        mesh_data(test_views=3).prepare()


def test_a_broken_mesh_is_named_and_the_others_are_rendered(mesh_data, meshes, tmp_path):
    (meshes / "broken.ply").write_text("not a mesh")
    with pytest.raises(UserError, match=r"1 of 3 objects could not be rendered: broken: .*broken\.ply") as caught:
        mesh_data().prepare()
    assert "brick" not in str(caught.value)
    assert sorted(path.name for path in (tmp_path / "rendered").iterdir() if path.is_dir()) == ["brick", "cube"]
    (meshes / "broken.ply").unlink()
    renderer = Grey()
    mesh_data(renderer).prepare()
    assert renderer.drawn == 0


def test_other_files_among_the_views_are_ignored(mesh_data, meshes, tmp_path):
    write_object(tmp_path / "rendered", "cup", train=12)
    mesh_data().prepare()
    (meshes / "brick.ply").unlink()
    assert mesh_data().names() == ["cube"]
    assert RenderingsData(str(tmp_path / "rendered")).names() == ["brick", "cube", "cup"]


def labels_of(source: ViewSource, split: str = "test") -> dict[str, tuple[str, bool | None]]:
    views = [source.views(name, split) for name in source.names()]
    return {each.name: (each.ambiguity, each.unique_answer) for each in views}


def test_labels_apply_to_existing_views_without_changing_files(mesh_data, tmp_path):
    mesh_data().prepare()
    before = {path: path.read_bytes() for path in (tmp_path / "rendered").rglob("*.*") if path.is_file()}
    file = tmp_path / "labels.yaml"
    file.write_text("brick: {ambiguity: twofold, reason: two ends alike}\ncube: {ambiguity: unique}\n")
    data = mesh_data(Grey(), labels=str(file))
    data.prepare()
    assert labels_of(data) == labels_of(data, "train") == {"brick": ("twofold", True), "cube": ("unique", True)}
    file.write_text("brick: {ambiguity: continuous}\ncube: {ambiguity: continuous, unique_answer: true}\n")
    data = mesh_data(labels=str(file))
    data.prepare(check_meshes=True)
    assert labels_of(data) == {"brick": ("continuous", False), "cube": ("continuous", True)}
    assert labels_of(mesh_data()) == {"brick": ("unlabelled", None), "cube": ("unlabelled", None)}
    assert {path: path.read_bytes() for path in (tmp_path / "rendered").rglob("*.*") if path.is_file()} == before


def test_labels_are_rendered_into_new_views(mesh_data, tmp_path):
    file = tmp_path / "labels.yaml"
    file.write_text("{brick: {ambiguity: twofold}, cube: {ambiguity: continuous}}")
    mesh_data(labels=str(file)).prepare()
    expected = {"brick": ("twofold", True), "cube": ("continuous", False)}
    assert labels_of(mesh_data()) == labels_of(RenderingsData(str(tmp_path / "rendered"))) == expected


def test_one_file_of_labels_serves_seen_and_unseen_objects(mesh_data, tmp_path):
    file = tmp_path / "labels.yaml"
    file.write_text("{brick: {ambiguity: twofold}, cube: {ambiguity: continuous}}")
    halves = [mesh_data(labels=str(file), unseen=1, objects=which).objects() for which in ("seen", "unseen")]
    assert {obj.name: obj.ambiguity for half in halves for obj in half} == {"brick": "twofold", "cube": "continuous"}


def test_files_that_are_not_meshes_are_ignored(mesh_data, meshes):
    (meshes / "readme.txt").write_text("two boxes")
    (meshes / "._cube.ply").write_text("what some systems leave behind")
    (meshes / "cube.PLY.bak").write_text("")
    (meshes / "brick.ply").rename(meshes / "brick.PLY")
    assert [obj.name for obj in mesh_data().objects()] == ["brick", "cube"]


def test_two_meshes_of_one_name(mesh_data, meshes):
    trimesh.creation.box().export(meshes / "cube.stl")
    with pytest.raises(UserError, match="several objects have the same name: cube"):
        mesh_data().prepare()


def test_folders_without_meshes(mesh_data, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file.ply").write_text("")
    for name, message in (
        ("nowhere", r"nowhere: there is no such folder of meshes; give data\.path=FOLDER"),
        ("file.ply", r"file\.ply: there is no such folder of meshes"),
        ("empty", r"empty: holds no meshes; looked for .*\.glb"),
    ):
        with pytest.raises(UserError, match=message):
            mesh_data(path=tmp_path / name).prepare()
    assert not (tmp_path / "rendered").exists()


def test_the_embedded_objects_are_rendered_with_their_labels(tmp_path, monkeypatch):
    quick = [replace(obj, load=partial(trimesh.Scene, trimesh.creation.box())) for obj in rendered.toy_objects()]
    monkeypatch.setattr(rendered, "toy_objects", lambda: quick)
    source = ToyData(Grey(), str(tmp_path / "toy"), 8, test_views=2, workers=1)
    data = PairDataModule(source, cache=str(tmp_path), image_size=8)
    data.prepare_data()
    table = data.table("test")
    labels = {obj.name: (obj.ambiguity, obj.unique_answer) for obj in source.objects()}
    assert table.names == sorted(labels) and len(table.names) == 12
    assert dict(zip(table.names, zip(table.ambiguities, table.unique_answer, strict=True), strict=True)) == labels
    assert data.table("train").counts == [208] * 12 and data.table("validation").counts == [8] * 12


def test_the_data_sets_are_known_by_name():
    assert registry.get("data", "toy") is ToyData
    assert registry.get("data", "meshes") is MeshData
    assert registry.get("data", "renderings") is RenderingsData


def test_a_missing_folder_of_views(tmp_path):
    with pytest.raises(UserError, match=r"nowhere: there is no such folder of views"):
        PairDataModule(RenderingsData(str(tmp_path / "nowhere")), cache=str(tmp_path)).prepare_data()
