"""Rendering objects to views on disk by the paper's protocol (appendix, Dataset Construction).

The layout is that of `data.views`, with one `render.json` per object that records how it was rendered and from which
files.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import threading
import warnings
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch.utils.data import DataLoader

from lp_framework.atomic import DiskFull, written
from lp_framework.data.cache import cores, tracked
from lp_framework.data.camera_files import nerf_transforms, view_cameras
from lp_framework.data.files import differences, locked, raise_failures, read_record, written_folder
from lp_framework.data.meshes import MeshObject, fingerprint
from lp_framework.data.rendering.renderer import Renderer
from lp_framework.data.views import DEPTH_UNIT, FIELD_OF_VIEW_DEGREES, write_transforms
from lp_framework.errors import UserError, check_settings
from lp_framework.geometry import camera_to_world

RECORD = "render.json"
# Settings that records omit at these values, for compatibility with older records.
OMITTED = {"train_views": None, "depth": False, "field_of_view_range": None}


@dataclass(frozen=True)
class ViewProtocol:
    """Camera placement: by default 9 latitudes x 24 longitudes, 216 training views, as in the paper.

    Training views lie on a grid of latitudes (both ends included) and longitudes (degrees), each at a random radius
    (scene units). Test views are random in the same ranges; so are the training views if their number `train_views` is
    given. With `depth`, depths are saved too. With `field_of_view_range` (degrees), each object has its own field of
    view, drawn from the range; the distance is scaled so that the object appears as large as with
    `field_of_view_degrees`.
    """

    resolution: int = 512
    field_of_view_degrees: float = FIELD_OF_VIEW_DEGREES
    lowest_latitude_degrees: float = -30.0
    highest_latitude_degrees: float = 30.0
    latitude_step_degrees: float = 7.5
    longitude_step_degrees: float = 15.0
    nearest_radius: float = 1.2
    farthest_radius: float = 2.0
    test_views: int = 8
    seed: int = 0
    train_views: int | None = None
    depth: bool = False
    field_of_view_range: list[float] | None = None

    def __post_init__(self) -> None:
        low, high = self.lowest_latitude_degrees, self.highest_latitude_degrees
        steps = {key: getattr(self, key) for key in ("latitude_step_degrees", "longitude_step_degrees")}
        few, fields = self.train_views, self.field_of_view_range
        check_settings(
            "data",
            ("resolution", self.resolution, self.resolution >= 1, "at least 1"),
            ("test_views", self.test_views, self.test_views >= 0, "at least 0"),
            ("train_views", few, few is None or few >= 1, "at least 1, or null for the grid"),
            *((key, step, step > 0, "positive") for key, step in steps.items()),
            ("field_of_view_range", fields, fields is None or (len(fields) == 2 and 0 < fields[0] <= fields[1] < 180),
             "two angles between 0 and 180 degrees in ascending order, or null"),
            ("lowest_latitude_degrees", low, -90 <= low <= high <= 90, f"from -90 to the highest, {high}"),
        )  # fmt: skip

    def of_object(self, name: str) -> ViewProtocol:
        """The protocol of one object, with a fixed field of view."""
        if self.field_of_view_range is None:
            return self
        low, high = self.field_of_view_range
        angle = self._random(name, "field of view").uniform(low, high)
        nearer = math.tan(math.radians(self.field_of_view_degrees) / 2) / math.tan(math.radians(angle) / 2)
        near, far = self.nearest_radius * nearer, self.farthest_radius * nearer
        return replace(
            self, field_of_view_degrees=angle, field_of_view_range=None, nearest_radius=near, farthest_radius=far
        )

    def training_poses(self, object_name: str) -> NDArray[np.float64]:
        """View poses `[V, 3]` (radians, radians, scene units); on the grid, ordered by latitude.

        Random values depend only on the seed and the object's name, not on the other objects.
        """
        if self.train_views is not None:
            return self._random_poses(object_name, "train", self.train_views)
        latitudes = _steps(self.lowest_latitude_degrees, self.highest_latitude_degrees, self.latitude_step_degrees)
        longitudes = _steps(0.0, 360.0, self.longitude_step_degrees)
        longitudes = longitudes[longitudes < 360.0 - 1e-9]
        latitude, longitude = np.meshgrid(np.radians(latitudes), np.radians(longitudes), indexing="ij")
        radius = self._random(object_name, "train").uniform(self.nearest_radius, self.farthest_radius, latitude.size)
        return np.stack([latitude.reshape(-1), longitude.reshape(-1), radius], axis=1)

    def test_poses(self, object_name: str) -> NDArray[np.float64]:
        """View poses `[V, 3]` (radians, radians, scene units), uniform in the ranges; seeded like `training_poses`."""
        return self._random_poses(object_name, "test", self.test_views)

    def _random_poses(self, object_name: str, split: str, count: int) -> NDArray[np.float64]:
        lowest = [math.radians(self.lowest_latitude_degrees), 0.0, self.nearest_radius]
        highest = [math.radians(self.highest_latitude_degrees), 2 * math.pi, self.farthest_radius]
        return self._random(object_name, split).uniform(lowest, highest, (count, 3))

    def _random(self, object_name: str, split: str) -> np.random.Generator:
        return np.random.default_rng([self.seed, zlib.crc32(object_name.encode()), zlib.crc32(split.encode())])


def _steps(start: float, end: float, step: float) -> NDArray[np.floating]:
    """`start`, `start + step`, ... up to `end`, which is included if the step divides the range."""
    return start + step * np.arange(math.floor((end - start) / step + 1e-9) + 1)


def render_object(
    obj: MeshObject,
    root: str | Path,
    protocol: ViewProtocol,
    renderer: Renderer,
    files: Mapping[str, str] | None = None,
) -> None:
    """Render an object into `<root>/<name>`, completely or not at all, unless it exists already; `files` is the record
    of its `Origin`. Raises `UserError` if it does not load, or if its folder has other contents or cannot be
    written."""
    folder, scene = Path(root) / obj.name, obj.load()
    made_from = {"mesh": fingerprint(scene)} | ({} if files is None else {"files": files})
    if folder.exists():
        changes, record = _changes(folder, protocol), read_record(folder / RECORD)
        if not changes and record.get("mesh") != made_from["mesh"]:
            changes = "from another mesh, or by an earlier version"
        if changes:  # reported once if it is the same for several objects
            advice = "choose another folder of views or delete them"
            raise UserError(f"the views in {root} were rendered differently ({changes}); {advice}")
        if record != record | made_from:  # the same mesh in other files
            with written(folder / RECORD) as partial:
                partial.write_text(json.dumps(record | made_from, indent=1))
        return
    labels = {"ambiguity": obj.ambiguity, "unique_answer": obj.unique_answer}
    settings = {key: value for key, value in asdict(protocol).items() if key not in OMITTED or value != OMITTED[key]}
    record = {"object": obj.name, **made_from, "renderer": renderer.name, **labels, "protocol": settings}
    protocol = protocol.of_object(obj.name)
    splits = {"train": protocol.training_poses(obj.name), "test": protocol.test_poses(obj.name)}

    with written_folder(folder) as partial:
        cameras = camera_to_world(torch.from_numpy(np.concatenate(list(splits.values()))))
        views = renderer.views(scene, cameras, protocol.resolution, protocol.field_of_view_degrees)
        for split, poses in splits.items():
            for kind in ("rgb", "depth") if protocol.depth else ("rgb",):
                (partial / split / kind).mkdir(parents=True)
            names = [f"{index:03d}.png" for index in range(len(poses))]
            for name in names:
                pixels, depth = next(views)
                Image.fromarray(pixels).save(partial / split / "rgb" / name, compress_level=1)
                if protocol.depth:
                    if depth is None:
                        raise UserError(f"renderer={renderer.name} does not provide depth; set data.depth=false")
                    levels = np.rint(depth / DEPTH_UNIT).clip(0, 65535).astype(np.uint16)
                    Image.fromarray(levels).save(partial / split / "depth" / name, compress_level=1)
            placed = torch.from_numpy(poses)
            shown = view_cameras(names, placed, protocol.resolution, protocol.field_of_view_degrees)
            transforms = nerf_transforms(shown, placed)
            if obj.ambiguity != "unlabelled":
                transforms |= labels
            write_transforms(partial / split, **transforms)
        (partial / RECORD).write_text(json.dumps(record, indent=1))


def _changes(folder: Path, protocol: ViewProtocol) -> str:
    """Describe how an object's views differ from what is wanted (see `differences`). Labels are not rendered and may
    differ; existing depths that were not requested are ignored."""
    record = read_record(folder / RECORD)
    if not isinstance(record.get("protocol"), dict):
        return f"it has no valid {RECORD}"
    wanted = {key: value for key, value in asdict(protocol).items() if value or key != "depth"}
    return differences({**OMITTED, **record["protocol"]}, wanted)


def render_objects(
    objects: Iterable[MeshObject],
    root: str | Path,
    protocol: ViewProtocol,
    renderer: Renderer,
    workers: int | None = None,
    check_meshes: bool = True,
) -> None:
    """Render objects into `<root>/<name>`, in `workers` processes (None: one per CPU core); finished ones are skipped.

    `check_meshes` also loads the meshes of finished objects to verify that the views were made from them; without it,
    only those with changed files are loaded. Runs that share a folder take turns. A `UserError` of one object does not
    stop the others, unless the disk is full; an error at the end lists them all.
    """
    todo = [obj for obj in objects if check_meshes or not _is_finished(obj, Path(root) / obj.name, protocol)]
    if not todo:
        return
    workers = min(cores() if workers is None else workers, len(todo))
    failures: dict[str, str] = {}
    with locked(Path(root), ".render.lock"):
        jobs = [(obj, obj.origin and obj.origin.record()) for obj in todo]
        done: DataLoader[tuple[UserError | None, list[str]]] = DataLoader(
            jobs,  # type: ignore[arg-type]  # a list is enough
            batch_size=None,
            collate_fn=partial(_work, root=root, protocol=protocol, renderer=renderer),
            num_workers=workers if workers > 1 else 0,
            multiprocessing_context="spawn" if workers > 1 else None,  # an OpenGL context does not survive a fork
            worker_init_fn=_begin_worker,
            generator=torch.Generator(),  # keeps the global random state unchanged for a training that renders first
        )
        try:
            for obj, (failure, messages) in zip(todo, tracked(done, "rendering", len(todo)), strict=True):
                for message in messages:
                    warnings.warn(message, stacklevel=2)
                if isinstance(failure, DiskFull):
                    raise failure
                if failure is not None:
                    failures[obj.name] = str(failure)
        except RuntimeError as error:
            if not str(error).startswith("DataLoader worker"):
                raise
            what = "a rendering process was killed, perhaps for lack of memory; finished views are kept"
            raise UserError(f"{what}, run the same command again with fewer workers") from error
    raise_failures(failures, len(todo), "rendered")


def _is_finished(obj: MeshObject, folder: Path, protocol: ViewProtocol) -> bool:
    """Whether an object's views exist as wanted and, if its files are available, were made from these."""
    sound = not _changes(folder, protocol)
    return sound and (obj.origin is None or obj.origin.is_of(read_record(folder / RECORD).get("files")))


def _work(
    job: tuple[MeshObject, dict[str, str] | None], root: str | Path, protocol: ViewProtocol, renderer: Renderer
) -> tuple[UserError | None, list[str]]:
    """Render one object; returns its `UserError`, if any, and its warnings."""
    failure = None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        try:
            render_object(job[0], root, protocol, renderer, job[1])
        except UserError as error:
            failure = error
    # Other categories, such as NumPy's division by zero, are of no use to users.
    return failure, [" ".join(str(each.message).split()) for each in caught if issubclass(each.category, UserWarning)]


def _begin_worker(_: int) -> None:
    # The workers use all cores already; more threads in Mesa's software OpenGL would only compete with them.
    os.environ.setdefault("LP_NUM_THREADS", "1")
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Exit when the parent is killed; otherwise this process would keep writing, into the next run's folder."""
    if parent := multiprocessing.parent_process():
        parent.join()
        os._exit(1)
