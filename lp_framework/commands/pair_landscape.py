"""`landscape` of one pair of views: the prior's energy over their relative pose, and the ways of a solver over it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from omegaconf import DictConfig
from rich import box
from rich.console import Console
from rich.table import Table
from torch import Tensor

from lp_framework.api import move, view_set
from lp_framework.commands.building import Components, plain, versions, warn_of_photographs
from lp_framework.commands.device import choose_device
from lp_framework.data.module import PairDataModule
from lp_framework.data.photographs import photograph_files, prepared_photographs
from lp_framework.errors import UserError
from lp_framework.evaluation.examples import EXAMPLES, Example, View, recording, save_examples
from lp_framework.evaluation.landscape import Landscape, landscape_grid, model_landscape, prior_landscapes
from lp_framework.evaluation.tables import write_arrays, write_json
from lp_framework.figures.generated import generated_views
from lp_framework.figures.shown_pairs import shown_pairs, words
from lp_framework.geometry import apply_relative_pose, camera_to_world, rotation_error, wrap_angle
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import Pairs, Solution
from lp_framework.solvers.langevin import Langevin
from lp_framework.solvers.progress import shown_progress
from lp_framework.viz.fields import FieldMap, field_figure
from lp_framework.viz.html.run_page import write_run_page
from lp_framework.viz.landscape import pair_figure, surface_figure
from lp_framework.viz.pictures import ExactModel, as_pixels, way, with_field
from lp_framework.viz.style import save_figure

STEPS, GUIDANCE = 50, 3.0  # of DDIM, for what the prior generates at the ends


class Shown(NamedTuple):
    """A pair with its title and the names of its files; `truth` and the reference's view pose `[3]` where known."""

    title: str
    files: list[str]
    pairs: Pairs
    truth: Tensor | None
    reference: Tensor | None

    def image(self, index: Tensor) -> NDArray:
        """Pixels `[H, W, 3]` of `pairs.reference` or `pairs.query`."""
        return as_pixels(self.pairs.images[index[0]])


class Descent(NamedTuple):
    """What a solver did from N starts that came to a pose: trajectories `[N, S, 3]` (S is 1 where it keeps none), the
    index of the answer, longitudes of the starts (degrees, [0, 360); none of a solver that makes its own), rotation
    errors (degrees) where the truth is known, and the energies by which it chose."""

    trajectories: Tensor
    chosen: int | None
    starts: list[float] | None
    errors: list[float] | None
    energies: list[float]

    @property
    def ends(self) -> Tensor:
        """`[N, 3]`."""
        return self.trajectories[:, -1]

    def captions(self) -> list[str]:
        """For each trajectory where it came from and how far off it ended."""
        count = len(self.trajectories)
        begun = [""] * count if self.starts is None else [f"{start:.0f}°" for start in self.starts]
        off = [""] * count if self.errors is None else [f"{error:.0f}° off" for error in self.errors]
        return [": ".join(filter(None, parts)) for parts in zip(begun, off, strict=True)]


def run(config: DictConfig, folder: Path) -> None:
    """Write `landscape.npz`, `landscape.json` and the pictures `landscape`, `surface` and `fields`; print the minima.

    Of photographs, whose truth is not known, the slice is at relative radius 0, and there are no fields.
    """
    latitude, longitude = landscape_grid(
        config.latitude_limit_degrees, config.latitude_step_degrees, config.longitude_step_degrees
    )
    device = choose_device(config.accelerator)
    components = Components(plain(config))
    shown = photographs(config, device) if config.images is not None else data_pair(config, components["data"], device)
    solver, prior = components["solver"], components["prior"].to(device)
    move(solver, device)
    model = components["model"].to(device) if shown.truth is not None else None
    starts = components["start"].make(shown.pairs, config.seed)
    radius = torch.zeros(1) if shown.truth is None else shown.truth[2:]
    with shown_progress():
        energies = prior_landscapes(
            prior, shown.pairs, radius, latitude, longitude, config.timesteps, config.noises, config.seed, config.batch
        )
        solution = recording(solver).solve(shown.pairs, starts, config.seed)
    landscape = Landscape(latitude, longitude, radius.item(), energies[0].cpu())
    descent = descended(shown, solution, starts)

    arrays = landscape_arrays(landscape, descent, shown.truth)
    pictures = [save_figure(drawn(config, shown, landscape, descent, prior), folder / "landscape")[0]]
    truth = None if shown.truth is None else shown.truth.numpy()
    pictures += save_figure(surface_figure(landscape, truth, shown.title), folder / "surface")[:1]
    if isinstance(model, PoseModel) and shown.truth is not None:
        field = model_landscape(model, shown.pairs, radius, latitude, longitude)
        arrays["model_score"] = field.score[0].cpu().numpy()
        if field.energy is not None:
            arrays["model_energy"] = field.energy[0].cpu().numpy()
        pictures += save_figure(fields_drawn(shown, model, starts, config.seed), folder / "fields")[:1]
    write_arrays(folder / "landscape.npz", arrays)
    write_json(folder / "landscape.json", summary(config, shown, landscape, descent, components.checkpoint))
    save_examples(folder / "pictures" / EXAMPLES, [example(config, shown, landscape, descent)])
    report(config, folder, shown, landscape, descent, pictures)


def data_pair(config: DictConfig, data: PairDataModule, device: torch.device) -> Shown:
    """Two test views of the data set's `object`."""
    for key in ("reference", "query"):
        if not isinstance(config[key], int):
            raise UserError(f"{key} must be the number of a test view, got {config[key]}")
    data.evaluate_on("ordered", config.seed)
    data.prepare_data()
    pair = shown_pairs(data, [str(config.object)], [(config.reference, config.query)], device)
    files = data.table("test").files
    views = data.table("test").views_of(data.table("test").names.index(config.object))
    return Shown(
        f"{words(config.object)} ({pair.ambiguities[0]}), views {config.reference} and {config.query}",
        [str(files[views[number]]) for number in (config.reference, config.query)],
        pair.pairs,
        pair.truth[0],
        pair.poses[0, 0],
    )


def photographs(config: DictConfig, device: torch.device) -> Shown:
    """The two files of `images`, prepared as `estimate` prepares them."""
    files = photograph_files(config.images)
    if len(files) != 2:
        raise UserError(f"images: a landscape is of two files, got {len(files)}")
    prepared = prepared_photographs(files, config.masks, config.remove_background, config.crop)
    warn_of_photographs(plain(config.prior))
    pairs = view_set(prepared, device).pairs([0], [1])
    return Shown(f"{files[0].name} and {files[1].name}", [str(file) for file in files], pairs, None, None)


def descended(shown: Shown, solution: Solution, starts: Tensor) -> Descent:
    """What the solver did with the pair, of the starts that came to a pose."""
    sound = solution.poses[0].isfinite().all(dim=-1).nonzero()[:, 0]
    own = solution.poses.shape != starts.shape
    paths = solution.poses[0, :, None] if solution.trajectory is None else solution.trajectory[0]
    ends = solution.poses[0, sound].detach().cpu()
    errors = None
    if shown.truth is not None and shown.reference is not None:
        cameras = [camera_to_world(apply_relative_pose(shown.reference, x.double())) for x in (ends, shown.truth)]
        errors = rotation_error(*cameras).tolist()
    chosen = (sound == solution.chosen[0]).nonzero()
    return Descent(
        paths[sound].detach().cpu(),
        int(chosen) if len(chosen) else None,
        None if own else (starts[0, sound, 1].rad2deg() % 360).tolist(),
        errors,
        solution.energies[0, sound].detach().cpu().tolist(),
    )


def landscape_arrays(landscape: Landscape, descent: Descent, truth: Tensor | None) -> dict[str, NDArray]:
    """What goes into `landscape.npz`: radians and scene units."""
    arrays = {
        "latitude": landscape.latitude, "longitude": landscape.longitude, "radius": torch.tensor(landscape.radius),
        "energy": landscape.energy, "trajectories": descent.trajectories,
    }  # fmt: skip
    if truth is not None:
        arrays["truth"] = truth
    return {name: each.numpy() for name, each in arrays.items()}


def drawn(config: DictConfig, shown: Shown, landscape: Landscape, descent: Descent, prior: Prior) -> Figure:
    """The picture of the pair, with what the prior generates at the ends."""
    source = prior.encode(shown.pairs.images[shown.pairs.reference])
    ends = descent.ends
    views = list(generated_views(prior, source, ends, STEPS, GUIDANCE, config.seed)) if len(ends) else []
    count = len(landscape.minima())
    radius = f"{landscape.radius:+.2f}".replace("-", "\u2212")
    note = (
        f"{count} local {'minimum' if count == 1 else 'minima'} at the "
        f"{'' if shown.truth is None else 'true '}relative radius {radius}; mean of "
        f"{config.noises * len(config.timesteps)} noises at timesteps {', '.join(map(str, config.timesteps))}"
    )
    return pair_figure(
        shown.image(shown.pairs.reference), shown.image(shown.pairs.query), landscape, descent.trajectories.numpy(),
        None if shown.truth is None else shown.truth.numpy(), descent.chosen, views, descent.captions(), shown.title,
        note, f"Energy of prior {config.prior.name}, ways of {words(config.solver.name)}",
    )  # fmt: skip


def fields_drawn(shown: Shown, model: PoseModel, starts: Tensor, seed: int) -> Figure:
    """The learned field beside the exact one, with the ways of the first stage without noise over both."""
    assert shown.truth is not None
    field = "exp(-E) and score" if model.has_energy else "score"
    maps: list[FieldMap] = []
    for title, guide in (
        (f"Learned {field}", model),
        (f"Exact {field} (oracle)", ExactModel(model.kernel, shown.truth, model.has_energy)),
    ):  # fmt: skip
        solver = Langevin(guide, gamma=0.0, trajectory=True)  # type: ignore[arg-type]  # an ExactModel has all it asks
        solution = solver.solve(shown.pairs, starts, seed)
        maps.append(with_field(way("", solution, starts), title, guide, shown.pairs, shown.truth))
    note = "ways of the first stage without noise (langevin, gamma 0)"
    reference, query = (shown.image(side) for side in (shown.pairs.reference, shown.pairs.query))
    return field_figure(reference, query, shown.truth.numpy(), maps, shown.title, note)


def example(config: DictConfig, shown: Shown, landscape: Landscape, descent: Descent) -> Example:
    """What the page plays; photographs are shown from the reference camera that `estimate` takes for granted."""
    reference = torch.tensor([0.0, 0.0, 1.4]) if shown.reference is None else shown.reference
    query = reference if shown.truth is None else apply_relative_pose(reference.double(), shown.truth.double())
    left, right = (
        View(Path(file).name, np.rint(255 * shown.image(index)).astype(np.uint8), pose.double().numpy())
        for file, index, pose in zip(
            shown.files, (shown.pairs.reference, shown.pairs.query), (reference, query), strict=True
        )
    )
    count = len(descent.ends)
    return Example(
        shown.title,
        "unlabelled",
        f"the ways of {words(config.solver.name)}",
        left,
        right,
        truth=None if shown.truth is None else shown.truth.double().numpy(),
        starts=None if descent.starts is None else descent.trajectories[:, 0].double().numpy(),
        trajectories=descent.trajectories.double().numpy() if descent.trajectories.shape[1] > 1 else None,
        ends=descent.ends.double().numpy(),
        energies=np.array(descent.energies),
        chosen=descent.chosen or 0,
        rotation_errors=np.full(count, np.nan) if descent.errors is None else np.array(descent.errors),
        translation_errors=np.full(count, np.nan),
        landscapes={"energy of the prior": landscape},
    )


def summary(
    config: DictConfig, shown: Shown, landscape: Landscape, descent: Descent, checkpoint: Path | None
) -> dict[str, Any]:
    """What goes into `landscape.json`; angles in degrees."""
    begun = [None] * len(descent.ends) if descent.starts is None else descent.starts
    errors = [None] * len(descent.ends) if descent.errors is None else descent.errors
    return {
        "reference": shown.files[0],
        "query": shown.files[1],
        "truth": None if shown.truth is None else in_degrees(shown.truth),
        "radius": landscape.radius,
        "minima": [
            {**minimum._asdict(), "latitude": math.degrees(minimum.latitude),
             "longitude": math.degrees(minimum.longitude)} for minimum in landscape.minima()
        ],
        "flatness": landscape.flatness(),
        "descents": [
            {"start_longitude": start, "end": in_degrees(end), "rotation_error": error, "energy": energy,
             "chosen": number == descent.chosen}
            for number, (start, end, error, energy) in enumerate(
                zip(begun, descent.ends, errors, descent.energies, strict=True)
            )
        ],
        "checkpoint": str(checkpoint) if checkpoint else None,
        "seed": config.seed,
        "config": plain(config),
        "versions": versions(),
    }  # fmt: skip


def in_degrees(pose: Tensor) -> list[float]:
    """A relative pose `[3]` as degrees, degrees in [0, 360), scene units."""
    latitude, longitude, radius = pose.tolist()
    return [math.degrees(latitude), math.degrees(longitude) % 360, radius]


def report(
    config: DictConfig, folder: Path, shown: Shown, landscape: Landscape, descent: Descent, pictures: list[Path]
) -> None:
    """Print the minima, the ends and the files."""
    console = Console(width=None if Console().is_terminal else 110, highlight=False)
    table = Table(title=f"{shown.title}, prior={config.prior.name}", title_justify="left", box=box.SIMPLE_HEAD,
                  pad_edge=False)  # fmt: skip
    for column in ("", "latitude", "longitude", "height", "prominence", "from the truth"):
        table.add_column(column, justify="right" if column else "left", no_wrap=True)
    if shown.truth is not None:
        latitude, longitude, _ = in_degrees(shown.truth)
        table.add_row("truth", f"{latitude:.0f}°", f"{longitude:.0f}°")
    for number, minimum in enumerate(landscape.minima(), start=1):
        away = "" if shown.truth is None else f"{longitude_distance(minimum.longitude, shown.truth):.0f}° in longitude"
        table.add_row(
            f"minimum {number}", f"{math.degrees(minimum.latitude):.0f}°", f"{math.degrees(minimum.longitude):.0f}°",
            f"{minimum.height:.2f}", f"{minimum.prominence:.2f}", away,
        )  # fmt: skip
    table.add_section()
    for number, end in enumerate(descent.ends):
        latitude, longitude, _ = in_degrees(end)
        name = words(config.solver.name) + ("" if descent.starts is None else f" from {descent.starts[number]:.0f}°")
        mark = " (answer)" if number == descent.chosen else ""
        error = "" if descent.errors is None else f"{descent.errors[number]:.0f}°{mark}"
        table.add_row(name, f"{latitude:.0f}°", f"{longitude:.0f}°", "", "", error)
    console.print(table)
    console.print(f"results:  {folder / 'landscape.json'}, landscape.npz", soft_wrap=True)
    console.print(f"pictures: {', '.join([str(pictures[0]), *(each.name for each in pictures[1:])])}", soft_wrap=True)
    console.print(f"page:     {write_run_page(folder, 'landscape')}", soft_wrap=True)


def longitude_distance(longitude: float, truth: Tensor) -> float:
    """Degrees between a relative longitude (radians) and that of the truth `[3]`."""
    return math.degrees(wrap_angle(torch.tensor(longitude) - truth[1]).abs().item())
