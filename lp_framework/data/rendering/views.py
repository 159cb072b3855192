"""From objects to views on disk by the paper's protocol (appendix, Dataset Construction).

The layout is iFusion's, `<root>/<object>/{train,test}/rgb/000.png ...` with a `transform.json` beside `rgb`, and one
`render.json` an object that says how it was rendered. An object is written into a hidden folder that is renamed when
all of it is there, so an object's folder is complete or absent, whatever stops the run.
"""

from __future__ import annotations

import errno
import json
import math
import multiprocessing
import os
import shutil
import threading
import warnings
import zlib
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from multiprocessing.sharedctypes import Synchronized
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import FileLock
from numpy.typing import NDArray
from PIL import Image
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from lp_framework.data.meshes import MeshObject, fingerprint
from lp_framework.data.rendering.renderer import Renderer
from lp_framework.errors import UserError
from lp_framework.geometry import camera_to_world, to_ifusion

RECORD = "render.json"


# ---------------------------------------------------------------- the protocol


@dataclass(frozen=True)
class ViewProtocol:
    """Where the cameras stand. The training views lie on a grid of latitudes and longitudes (degrees, the latitudes
    with both ends), each at a random radius (scene units); the test views are random in the same ranges.

    With the defaults 9 latitudes x 24 longitudes = 216 training views and 8 test views, as in the paper.
    """

    resolution: int = 512
    field_of_view_degrees: float = 49.1
    lowest_latitude_degrees: float = -30.0
    highest_latitude_degrees: float = 30.0
    latitude_step_degrees: float = 7.5
    longitude_step_degrees: float = 15.0
    nearest_radius: float = 1.2
    farthest_radius: float = 2.0
    test_views: int = 8
    seed: int = 0

    def __post_init__(self) -> None:
        for wrong, message in (
            (self.resolution < 1, f"resolution must be at least 1, not {self.resolution}"),
            (
                not 0 < self.field_of_view_degrees < 180,
                f"field_of_view_degrees must lie between 0 and 180, not {self.field_of_view_degrees}",
            ),
            (
                not -90 <= self.lowest_latitude_degrees <= self.highest_latitude_degrees <= 90,
                "the latitudes must satisfy -90 <= lowest <= highest <= 90 degrees, not "
                f"{self.lowest_latitude_degrees} and {self.highest_latitude_degrees}",
            ),
            (
                min(self.latitude_step_degrees, self.longitude_step_degrees) <= 0,
                f"the steps must be positive, not {self.latitude_step_degrees} and {self.longitude_step_degrees}",
            ),
            (
                not 0 < self.nearest_radius <= self.farthest_radius,
                f"the radii must satisfy 0 < nearest <= farthest, not {self.nearest_radius} and {self.farthest_radius}",
            ),
            (self.test_views < 0, f"test_views must not be negative, not {self.test_views}"),
        ):
            if wrong:
                raise UserError(f"view protocol: {message}")

    def training_poses(self, object_name: str) -> NDArray[np.float64]:
        """View poses `[V, 3]` (radians, radians, scene units) on the grid, latitude by latitude.

        The radii depend on the seed and the object's name alone, not on which other objects there are.
        """
        latitudes = _steps(self.lowest_latitude_degrees, self.highest_latitude_degrees, self.latitude_step_degrees)
        longitudes = _steps(0.0, 360.0, self.longitude_step_degrees)
        longitudes = longitudes[longitudes < 360.0 - 1e-9]
        latitude, longitude = np.meshgrid(np.radians(latitudes), np.radians(longitudes), indexing="ij")
        radius = self._random(object_name, "train").uniform(self.nearest_radius, self.farthest_radius, latitude.size)
        return np.stack([latitude.reshape(-1), longitude.reshape(-1), radius], axis=1)

    def test_poses(self, object_name: str) -> NDArray[np.float64]:
        """View poses `[V, 3]` (radians, radians, scene units), uniform in the ranges; keyed like `training_poses`."""
        lowest = [math.radians(self.lowest_latitude_degrees), 0.0, self.nearest_radius]
        highest = [math.radians(self.highest_latitude_degrees), 2 * math.pi, self.farthest_radius]
        return self._random(object_name, "test").uniform(lowest, highest, (self.test_views, 3))

    def views_per_object(self) -> int:
        """Training and test views together."""
        return len(self.training_poses("")) + self.test_views

    def _random(self, object_name: str, split: str) -> np.random.Generator:
        return np.random.default_rng([self.seed, zlib.crc32(object_name.encode()), zlib.crc32(split.encode())])


def _steps(start: float, end: float, step: float) -> NDArray[np.floating]:
    """`start`, `start + step`, ... up to `end`, which is among them when the step divides the range."""
    return start + step * np.arange(math.floor((end - start) / step + 1e-9) + 1)


# ---------------------------------------------------------------- one object


def render_object(
    obj: MeshObject,
    root: str | Path,
    protocol: ViewProtocol,
    renderer: Renderer,
    on_view: Callable[[int], None] = lambda views: None,
) -> bool:
    """Render an object into `<root>/<name>`, whole or not at all; False when it was there already.

    `on_view` is called with the number of views that have been made. Raises `UserError` when the object does not
    load, when its folder holds something else than the same object under the same protocol, or when it cannot be
    written; nothing of the object is left then.
    """
    folder = Path(root) / obj.name
    if obj.name in ("", ".", "..") or Path(obj.name).name != obj.name:
        raise UserError(f"'{obj.name}' cannot be an object's name, because it cannot be a folder's")
    scene = obj.load()
    record = {
        "object": obj.name,
        "mesh": fingerprint(scene),
        "renderer": renderer.name,
        "ambiguity": obj.ambiguity,
        "unique_answer": obj.unique_answer,
        "protocol": asdict(protocol),
    }
    if folder.exists():
        _check_record(folder, record)
        return False
    partial = folder.with_name(f".{obj.name}.partial")
    try:
        _remove(partial)  # of a run that was killed
        splits = {"train": protocol.training_poses(obj.name), "test": protocol.test_poses(obj.name)}
        cameras = camera_to_world(torch.from_numpy(np.concatenate(list(splits.values()))))
        images = renderer.views(scene, cameras, protocol.resolution, protocol.field_of_view_degrees)
        for split, poses in splits.items():
            (partial / split / "rgb").mkdir(parents=True)
            transforms = _transforms(torch.from_numpy(poses), protocol.field_of_view_degrees, obj)
            for frame in transforms["frames"]:
                path = partial / split / "rgb" / frame["file_path"]
                Image.fromarray(next(images)).save(path, compress_level=1)
                on_view(1)
            (partial / split / "transform.json").write_text(json.dumps(transforms, indent=1))
        (partial / RECORD).write_text(json.dumps(record, indent=1))
        os.rename(partial, folder)
    except OSError as error:
        _remove(partial)
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        raise UserError(
            f"{folder}: cannot be written ({'the disk is full' if full else error.strerror}); "
            "the objects finished so far are kept, run the same command again to render the rest"
        ) from error
    except BaseException:
        _remove(partial)
        raise
    return True


def _is_rendered(obj: MeshObject, root: str | Path, protocol: ViewProtocol) -> bool:
    """Whether `<root>/<name>` holds the object's views, by its record; the mesh is not looked at."""
    try:
        record = json.loads((Path(root) / obj.name / RECORD).read_text())
        return bool(record["protocol"] == asdict(protocol))
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return False


def _transforms(poses: torch.Tensor, field_of_view_degrees: float, obj: MeshObject) -> dict[str, Any]:
    """The contents of `transform.json`; iFusion's `latlon` counts latitude downwards, in degrees."""
    views = zip(camera_to_world(poses).tolist(), to_ifusion(poses).tolist(), strict=True)
    frames = [
        {"file_path": f"{index:03d}.png", "transform_matrix": matrix, "latlon": latlon}
        for index, (matrix, latlon) in enumerate(views)
    ]
    labels = {"ambiguity": obj.ambiguity, "unique_answer": obj.unique_answer}
    known = {} if obj.ambiguity == "unlabelled" else labels
    return {"camera_angle_x": math.radians(field_of_view_degrees), **known, "frames": frames}


def _check_record(folder: Path, record: dict[str, Any]) -> None:
    """`UserError` unless the folder was rendered from the same mesh under the same protocol; labels may differ, they
    are not rendered."""
    try:
        found = json.loads((folder / RECORD).read_text())
        old, new = ({**each["protocol"], "mesh": each["mesh"]} for each in (found, record))
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise UserError(
            f"{folder} exists and was not rendered by this program (it has no proper {RECORD}); "
            "choose another folder or delete it"
        ) from error
    differences = [
        f"{key} was {old.get(key)}, is {new.get(key)}" for key in {**old, **new} if old.get(key) != new.get(key)
    ]
    if differences:
        raise UserError(
            f"{folder} was rendered differently ({'; '.join(differences)}); choose another folder or delete this one"
        )


def _remove(folder: Path) -> None:
    if folder.exists():
        shutil.rmtree(folder)


# ---------------------------------------------------------------- many objects


def render_objects(
    objects: Iterable[MeshObject],
    root: str | Path,
    protocol: ViewProtocol,
    renderer: Renderer,
    workers: int | None = None,
    check_meshes: bool = True,
) -> None:
    """Render objects into `<root>/<name>`, several at once, with a progress bar; finished ones are skipped.

    `check_meshes` loads the meshes of finished ones too, to see that the views were made from them; without it a
    record of the same protocol is believed.
    `workers` is the number of processes, by default one a CPU core; 1 renders in this process. Two runs into one
    folder take turns. A `UserError` of one object does not stop the others; at the end one `UserError` lists them all.
    """
    todo = list(objects)
    names = [obj.name for obj in todo]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise UserError(f"several objects have the same name: {', '.join(twice)}")
    if not check_meshes:
        todo = [obj for obj in todo if not _is_rendered(obj, root, protocol)]
    if not todo:
        return
    try:
        Path(root).mkdir(parents=True, exist_ok=True)
        lock = FileLock(Path(root) / ".render.lock").acquire()
    except OSError as error:
        raise UserError(f"{root}: cannot be written ({error.strerror}); choose another folder") from error
    missing = [obj for obj in todo if not (Path(root) / obj.name).exists()]
    with lock, _progress(protocol.views_per_object() * len(missing)) as on_view:
        if workers is None:
            workers = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        if min(workers, len(todo)) > 1:
            failures = _in_processes(todo, root, protocol, renderer, min(workers, len(todo)), on_view)
        else:
            failures = _in_this_process(todo, root, protocol, renderer, on_view)
    if failures:
        raise UserError(f"{len(failures)} of {len(todo)} objects could not be rendered:\n  " + "\n  ".join(failures))


def _in_this_process(
    objects: list[MeshObject],
    root: str | Path,
    protocol: ViewProtocol,
    renderer: Renderer,
    on_view: Callable[[int], None],
) -> list[str]:
    failures = []
    for obj in objects:
        try:
            render_object(obj, root, protocol, renderer, on_view)
        except UserError as error:
            failures.append(f"{obj.name}: {error}")
    return failures


def _in_processes(
    objects: list[MeshObject],
    root: str | Path,
    protocol: ViewProtocol,
    renderer: Renderer,
    workers: int,
    on_view: Callable[[int], None],
) -> list[str]:
    context = multiprocessing.get_context("spawn")  # an OpenGL context does not survive a fork
    counter, stop = context.Value("L", 0), context.Event()
    executor = ProcessPoolExecutor(workers, mp_context=context, initializer=_start_worker, initargs=(counter, stop))
    failures, counted = {}, 0
    try:
        futures = {executor.submit(_work, obj, root, protocol, renderer): obj.name for obj in objects}
        pending = set(futures)
        while pending:
            done, pending = wait(pending, timeout=0.2, return_when=FIRST_COMPLETED)
            ready = counter.value
            on_view(ready - counted)
            counted = ready
            for future in done:
                failure, messages = future.result()
                for message in messages:
                    warnings.warn(message, stacklevel=2)
                if failure is not None:
                    failures[futures[future]] = failure
    except BrokenProcessPool as error:
        raise UserError(
            "a rendering process was killed, perhaps for lack of memory; the objects finished so far are kept, "
            "run the same command again with fewer workers"
        ) from error
    finally:
        stop.set()  # those still at work, after an interrupt or an error, give up at their next view
        executor.shutdown(wait=True, cancel_futures=True)
    return [f"{obj.name}: {failures[obj.name]}" for obj in objects if obj.name in failures]


@contextmanager
def _progress(views: int) -> Iterator[Callable[[int], None]]:
    """A progress bar over views, none where there are none; yields the function that advances it."""
    columns = TextColumn("rendering"), BarColumn(), MofNCompleteColumn(), TextColumn("views"), TimeRemainingColumn()
    with Progress(*columns, console=Console(stderr=True), disable=not views) as progress:
        task = progress.add_task("views", total=views)
        yield lambda ready: progress.advance(task, ready)


# ---------------------------------------------------------------- in a worker process

_counter: Synchronized[int]  # views ready, over all workers
_stop: Event


def _start_worker(counter: Synchronized[int], stop: Event) -> None:
    global _counter, _stop
    _counter, _stop = counter, stop
    # The workers fill the cores already; more threads in Mesa's software OpenGL would only get in each other's way.
    os.environ.setdefault("LP_NUM_THREADS", "1")
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process when its parent is killed; left alone it would go on writing, into the next run's folder."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _count(views: int) -> None:
    if _stop.is_set():
        raise KeyboardInterrupt
    with _counter.get_lock():
        _counter.value += views


def _work(
    obj: MeshObject, root: str | Path, protocol: ViewProtocol, renderer: Renderer
) -> tuple[str | None, list[str]]:
    """Render one object; the message of its `UserError`, if any, and those of its warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        try:
            render_object(obj, root, protocol, renderer, _count)
            failure = None
        except UserError as error:
            failure = str(error)
    return failure, [str(each.message) for each in caught if issubclass(each.category, UserWarning)]
