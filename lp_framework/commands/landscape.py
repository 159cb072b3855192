"""`landscape`: the prior's energy over relative poses, of a pair of views or around each object of a data set."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from rich import box
from rich.console import Console
from rich.table import Table
from torch import Tensor

from lp_framework.commands import pair_landscape
from lp_framework.commands.building import Components, orderly_console, plain, run_folder, seed_run, versions
from lp_framework.commands.device import choose_device
from lp_framework.data.cache import tracked
from lp_framework.data.module import PairDataModule
from lp_framework.data.pairs import ViewTable
from lp_framework.errors import UserError
from lp_framework.evaluation.ambiguity import Ambiguity, ambiguity
from lp_framework.evaluation.azimuth import NEAR_DEGREES, Profile, azimuth_energies, profile, within
from lp_framework.evaluation.landscape import Landscape, landscape_grid, prior_landscapes
from lp_framework.evaluation.tables import write_json
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import pairs_of
from lp_framework.viz.azimuth import AzimuthPanel, azimuth_figure
from lp_framework.viz.html.run_page import write_run_page
from lp_framework.viz.style import save_figure

PAIRS = 8  # an object, for its ambiguity
OF_A_PAIR = ("reference", "query", "masks", "solver", "start")  # settings that the overview has no use for


@orderly_console()
@torch.no_grad()
def run(config: DictConfig) -> None:
    """The landscape of a pair of views where one is named, else the overview of all objects."""
    check(config)
    folder = run_folder()
    seed_run(config.seed)
    if config.object is not None or config.images is not None:
        pair_landscape.run(config, folder)
    else:
        overview(config, folder)


def check(config: DictConfig) -> None:
    """`UserError` for settings that no landscape has."""
    for key, least in (("azimuths", 2), ("noises", 1), ("batch", 1)):
        if not isinstance(config[key], int) or config[key] < least:
            raise UserError(f"{key} must be a whole number, at least {least}, got {config[key]}")
    for key in ("latitude_limit_degrees", "latitude_step_degrees", "longitude_step_degrees"):
        if not isinstance(config[key], int | float):
            raise UserError(f"{key} must be a number, got {config[key]}")
    steps = list(config.timesteps) if isinstance(config.timesteps, Sequence) else []
    if not steps or not all(isinstance(each, int) for each in steps):
        raise UserError(f"timesteps must list whole numbers, one at least, got {config.timesteps}")
    if config.object is None and config.images is None:
        given = (override.partition("=")[0] for override in HydraConfig.get().overrides.task)
        for key in given:
            if key.partition(".")[0] in OF_A_PAIR:
                raise UserError(f"{key} is of the landscape of a pair; give object=NAME or images=[A.png,B.png], too")
    if config.object is not None and config.images is not None:
        raise UserError("give object=NAME for views of the data set or images=[A.png,B.png], not both")


def overview(config: DictConfig, folder: Path) -> None:
    """Write `azimuth.json` and `azimuth.png` into this run's folder, and print a row an object."""
    grid = landscape_grid(config.latitude_limit_degrees, config.latitude_step_degrees, config.longitude_step_degrees)
    device = choose_device(config.accelerator)
    components = Components(plain(config))
    prior: Prior = components["prior"].to(device)
    data = components["data"]
    data.evaluate_on(config.protocol, config.seed)
    data.prepare_data()
    table = data.table(data.evaluation_split())
    azimuths = torch.arange(config.azimuths) * (2 * math.pi / config.azimuths)
    energies, truth, objects = [], [], []
    for batch in tracked(list(data.test_dataloader()), "energies around the objects"):
        pairs = pairs_of(batch, table, device)
        poses = batch.relative_poses()
        energies.append(
            azimuth_energies(
                prior, pairs, poses.to(device), azimuths, config.timesteps, config.noises, config.seed, config.batch
            ).cpu()
        )
        truth.append(poses[:, 1])
        objects.append(batch.objects[batch.reference])
    rows = summarise(table, torch.cat(energies), azimuths, torch.cat(truth), torch.cat(objects))
    for row, score in zip(rows, ambiguities(config, data, prior, grid, device), strict=True):
        row["ambiguity_score"] = score.record()
    record = {"objects": rows, **overall(rows), "config": plain(config), "versions": versions()}
    write_json(folder / "azimuth.json", record)
    panels = [
        AzimuthPanel(row["object"], row["ambiguity"], row["degrees"], row["energy"], row["within"]) for row in rows
    ]
    pictures = save_figure(azimuth_figure(panels), folder / "azimuth")
    console = Console(width=None if Console().is_terminal else 110, highlight=False)
    console.print(terminal_table(f"{config.data.name}, prior={config.prior.name}", rows, record))
    if unanswered := [row["object"] for row in rows if not row["ambiguity_score"]["unique_answer"]]:
        console.print(f"without a unique answer to this prior: {', '.join(unanswered)}", soft_wrap=True)
    console.print(f"results: {folder / 'azimuth.json'}", soft_wrap=True)
    console.print(f"picture: {pictures[0]}", soft_wrap=True)
    console.print(f"page:    {write_run_page(folder, 'landscape')}", soft_wrap=True)


def ambiguities(
    config: DictConfig, data: PairDataModule, prior: Prior, grid: tuple[Tensor, Tensor], device: torch.device
) -> list[Ambiguity]:
    """The ambiguity of every object, by the landscapes of up to `PAIRS` pairs of the protocol `per_view`."""
    split = data.evaluation_split()
    table, batches = data.table(split), data.data(split)
    pairs = table.pairs("per_view", config.seed)  # a row a view
    found = []
    for index in tracked(range(len(table.names)), "ambiguity of the objects"):
        batch = batches[pairs[table.views_of(index)[:PAIRS]]]
        own = pairs_of(batch, table, device)
        truth = batch.relative_poses()
        energies = prior_landscapes(
            prior, own, truth[:, 2], *grid, config.timesteps, config.noises, config.seed, config.batch
        ).cpu()
        radii = truth[:, 2].tolist()
        found.append(ambiguity([Landscape(*grid, *each) for each in zip(radii, energies, strict=True)], truth[:, 1]))
    return found


def summarise(
    table: ViewTable, energies: Tensor, azimuths: Tensor, truth: Tensor, objects: Tensor
) -> list[dict[str, Any]]:
    """A row an object: its share of pairs `within` the limit, its profile and the minima of that."""
    near = within(energies, azimuths, truth)
    rows = []
    for index, name in enumerate(table.names):
        mask = objects == index
        curve: Profile = profile(energies[mask], azimuths, truth[mask])
        rows.append(
            {
                "object": name, "ambiguity": table.ambiguities[index], "unique_answer": table.unique_answer[index],
                "pairs": int(mask.sum()), "within": near[mask].double().mean().item(),
                "relief": curve.relief, "minima": [minimum._asdict() for minimum in curve.minima()],
                "degrees": curve.degrees.tolist(), "energy": curve.energy.tolist(),
            }
        )  # fmt: skip
    return rows


def overall(rows: list[dict[str, Any]]) -> dict[str, float | None]:
    """The share of pairs within the limit, over all objects and over those with a unique answer."""

    def share(chosen: list[dict[str, Any]]) -> float | None:
        pairs = sum(row["pairs"] for row in chosen)
        return sum(row["within"] * row["pairs"] for row in chosen) / pairs if pairs else None

    return {"within": share(rows), "within_unique_answer": share([row for row in rows if row["unique_answer"]])}


def terminal_table(title: str, rows: list[dict[str, Any]], record: dict[str, Any]) -> Table:
    """A row an object, then the shares over all of them."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("object", no_wrap=True)
    table.add_column("class", no_wrap=True)
    table.add_column(f"within {NEAR_DEGREES:g}°", justify="right")
    table.add_column("relief", justify="right")
    table.add_column("minima (degrees from truth: height)", no_wrap=True)
    table.add_column("flatness", justify="right", no_wrap=True)
    table.add_column("verdict", no_wrap=True)
    for row in sorted(rows, key=lambda row: -row["within"]):
        minima = ", ".join(f"{minimum['degrees']:+.0f}: {minimum['height']:.2f}" for minimum in row["minima"][:4])
        score = row["ambiguity_score"]
        table.add_row(
            row["object"], row["ambiguity"], f"{row['within']:.2f}", f"{row['relief']:.1%}", minima,
            f"{score['flatness']:.2f}", score["verdict"],
        )  # fmt: skip
    table.add_section()
    for name, key in (("all objects", "within"), ("unique answer", "within_unique_answer")):
        if record[key] is not None:
            table.add_row(name, "", f"{record[key]:.3f}", "", "")
    return table
