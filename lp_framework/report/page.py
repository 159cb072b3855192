"""The page of one run or of several: a self-contained HTML file, built from templates and the files of the runs.

A note replaces any part of a run that is missing or damaged.
"""

from __future__ import annotations

import base64
import csv
import gzip
import importlib.metadata
import io
import json
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import plotly.graph_objects as go
import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined, UndefinedError
from numpy.typing import NDArray
from PIL import Image
from plotly.offline import get_plotlyjs

from lp_framework.analysis.examples import EXAMPLES, read_examples
from lp_framework.analysis.pairs import words
from lp_framework.errors import UserError
from lp_framework.evaluation.metrics import ROTATION_THRESHOLDS
from lp_framework.evaluation.tables import COLUMNS, ERRORS, RESULT, summary_rows, write_text
from lp_framework.report import plots
from lp_framework.report.runs import COSTS, Kind, saved_config
from lp_framework.viz.curves import read_losses
from lp_framework.viz.style import CLASS_COLOURS

PAGE = "report.html"
LARGEST = 5_000_000  # characters of details on the page of several runs; further runs appear only in the table
WORST = 20  # pairs in the table of the worst pairs
TRAINING, LANDSCAPE, OVERVIEW = "training.json", "landscape.json", "azimuth.json"
RESULTS = (RESULT, TRAINING, LANDSCAPE, OVERVIEW)  # a finished run has one of these files
POSE = ("latitude_degrees", "longitude_degrees", "radius")
# Raised for missing or damaged files; `UserError` is a `ValueError`.
BROKEN = (
    OSError, ValueError, KeyError, TypeError, AttributeError, IndexError, RecursionError, UndefinedError, csv.Error,
)  # fmt: skip
HEADINGS = dict(zip([*ERRORS, *COSTS], ["Rot. (deg)", "Trans.", "s/pair", "passes"], strict=True))
About = tuple[str, str, Mapping[str, str]]  # title, subtitle, and the most important numbers by name


class RunPart(NamedTuple):
    """A run on a page: title and subtitle, its most important numbers by name, its sections (HTML) by title."""

    title: str
    subtitle: str
    numbers: Mapping[str, str]
    sections: Mapping[str, str]


class Contents(NamedTuple):
    """What the page shows for a kind of run: a heading for several runs, a description of the run, and sections by
    title, each a template and a function that fills it from the run's folder.
    """

    heading: str
    about: Callable[[Path], About]
    sections: Mapping[str, tuple[str, Callable[[Path], Mapping[str, Any]]]]


def run_part(folder: Path, contents: Contents) -> RunPart:
    """Read the run in `folder`; its last section is the configuration."""
    try:
        about = contents.about(folder)
    except BROKEN as error:
        about = folder.name, f"no results: {reason(error)}", {}
    sections = {}
    configuration = {"Configuration and versions": ("configuration", _configuration)}
    for title, (template, values) in {**contents.sections, **configuration}.items():
        try:
            sections[title] = render(f"{template}.html.j2", **values(folder))
        except BROKEN as error:
            sections[title] = render("note.html.j2", text=f"Not shown: {reason(error)}.")
    return RunPart(*about, sections)


def reason(error: Exception) -> str:
    """Why a part of a run cannot be shown."""
    if isinstance(error, UserError):
        return str(error)
    if isinstance(error, FileNotFoundError):
        return f"{Path(error.filename).name} is missing"
    return f"damaged files ({type(error).__name__}: {str(error).partition(chr(10))[0]})"


def render(template: str, **values: Any) -> str:
    """Render a template of this package with these values; text is escaped."""
    return _ENVIRONMENT.get_template(template).render(values)


def read_record(file: Path) -> dict[str, Any]:
    """Read the object in a JSON file."""
    return dict(json.loads(file.read_text(encoding="utf-8")))


def read_rows(file: Path) -> list[dict[str, str]]:
    """Read the rows of a CSV file with a header."""
    with file.open(newline="", encoding="utf-8") as content:
        return list(csv.DictReader(content))


def _configuration(folder: Path) -> dict[str, Any]:
    results = next((folder / name for name in RESULTS if (folder / name).is_file()), None)
    record = {} if results is None else read_record(results)
    config = dict(record.get("config") or saved_config(folder / "config.yaml"))
    text = yaml.safe_dump(config, sort_keys=False, allow_unicode=True)
    return {"config": text, "versions": record.get("versions"), "folder": folder}


def packed(content: go.Figure | str) -> str:
    """Compress a figure or text and encode it as ASCII for the page's script."""
    text = content if isinstance(content, str) else content.to_json()
    return base64.b64encode(gzip.compress(text.encode(), 6, mtime=0)).decode()


def picture(image: NDArray, side: int) -> str:
    """Encode an image `[H, W, 3 or 4]` (uint8) as a data URL (WebP), shrunk to at most `side` pixels."""
    shrunk = Image.fromarray(image)
    shrunk.thumbnail((side, side), Image.Resampling.LANCZOS)
    content = io.BytesIO()
    shrunk.save(content, "webp", quality=82)
    return f"data:image/webp;base64,{base64.b64encode(content.getvalue()).decode()}"


def sheet(file: Path) -> str:
    """Encode a saved figure (PNG file) as a data URL."""
    return f"data:image/png;base64,{base64.b64encode(file.read_bytes()).decode()}"


def number(name: str, value: float) -> str:
    """Format a metric's value with its usual rounding."""
    if not math.isfinite(value):
        return "inf"
    if name == "rotation_error":
        return f"{value:.2f}" if value < 100 else f"{value:.0f}"
    digits = {"network_passes_per_pair": ".0f", "seconds_per_pair": ".3g"}
    return format(value, digits.get(name, ".3f"))


def metric(metrics: Mapping[str, float | None], key: str) -> str:
    """Format a metric; solvers with a single answer have no success rates, and null is infinity."""
    value = metrics.get(key, math.nan)
    return number(key, math.inf if value is None else value) if key in metrics else "-"


def write_run_page(folder: Path, kind: Kind) -> Path:
    """Write `report.html` into the folder of a finished run, from the files in it."""
    return write_report_page(folder / PAGE, [(folder, kind)], {})


def write_report_page(path: Path, runs: Sequence[tuple[Path, Kind]], above: Mapping[str, str]) -> Path:
    """Write the page of one or more runs: the sections `above`, tables of the runs, and each run's details."""
    if len(runs) == 1:
        part = run_part(runs[0][0], contents_of(*runs[0]))
        *sections, configuration = part.sections.items()
        part = part._replace(sections=dict([*sections, *above.items(), configuration]))
    else:
        part = RunPart("Report", f"{len(runs)} runs", {}, {**above, **_sections_of_several(runs)})
    templates = resources.files("lp_framework.report") / "templates"
    text = render(
        "page.html.j2",
        part=part,
        style=(templates / "page.css").read_text(encoding="utf-8"),
        script=(templates / "page.js").read_text(encoding="utf-8"),
        plotly=packed(get_plotlyjs()) if any("data-figure=" in content for content in part.sections.values()) else "",
        version=importlib.metadata.version("lp_framework"),
    )
    write_text(path, text)
    return path


def _sections_of_several(runs: Sequence[tuple[Path, Kind]]) -> dict[str, str]:
    """A table of the runs of each command, and the details of those runs that fit."""
    listed: list[dict[str, Any]] = []
    room = LARGEST
    for number, (folder, kind) in enumerate(runs):
        contents = contents_of(folder, kind)
        part = run_part(folder, contents)
        content = render("run.html.j2", part=part)
        fits = len(content) <= room
        room -= len(content) if fits else 0
        run = {"number": number, "folder": folder, "part": part, "content": content if fits else None}
        listed.append({"heading": contents.heading, **run})
    sections = {}
    for heading in dict.fromkeys(run["heading"] for run in listed):
        some = [run for run in listed if run["heading"] == heading]
        sections[heading] = render("runs.html.j2", caption=heading, runs=some)
    return {**sections, "Details of each run": render("opened.html.j2", runs=listed)}


def _about_evaluation(folder: Path) -> About:
    result = read_record(folder / RESULT)
    config, unique = result["config"], result["metrics_unique_answer"]
    metrics, over = (result["metrics"], "all objects") if unique is None else (unique, "unique answer")
    median = metrics["rotation_error"]
    return (
        f"{words(config['solver']['name'])} on {config['data']['name']}",
        f"evaluation of {result['pairs']} pairs ({result['protocol']}), start={config['start']['name']}, "
        f"seed {result['seed']}",
        {
            **{f"{name}, {over}": f"{metrics[name]:.1%}" for name in ("R@5", "R@15", "R(R)@15")},
            f"median rotation error, {over}": "\N{INFINITY}" if median is None else f"{median:.1f}°",
            "pairs": str(result["pairs"]),
            "seconds per pair": f"{result['seconds_per_pair']:.3g}",
        },
    )


def _pairs(folder: Path) -> dict[str, Any]:
    """The pairs that a run saved with its pictures, each with its plots (packed, by kind) and the steps they show."""
    if not (folder / "pictures").is_dir():
        raise UserError("the run has no pictures (pictures=false)")
    shown = []
    for example in read_examples(folder / "pictures" / EXAMPLES):
        drawn = {kind: packed(figure) for kind, figure in plots.pair_plots(example).items()}
        shown.append({"example": example, "plots": drawn, "steps": plots.frame_steps(example)})
    return {"pairs": shown}


def _objects(folder: Path) -> dict[str, Any]:
    rows, result = read_rows(folder / "pairs.csv"), read_record(folder / RESULT)
    found = {name: metrics for name, metrics in result["per_object"].items() if metrics is not None}
    order = sorted(found, key=lambda name: (found[name]["R(R)@15"], found[name].get("SR(R)@30", 0), name))
    classes, counts = {row["object"]: row["ambiguity"] for row in rows}, Counter(row["object"] for row in rows)
    return {"objects": {name: found[name] for name in order}, "classes_of": classes, "counts": counts}


def _errors(folder: Path) -> dict[str, Any]:
    rows = read_rows(folder / "pairs.csv")
    rotation = np.array([float(row["rotation_error_degrees"]) for row in rows])
    classes = np.array([row["ambiguity"] for row in rows])
    figure = plots.errors_plot({name: rotation[classes == name] for name in CLASS_COLOURS if name in classes})
    order = np.argsort(-np.nan_to_num(rotation, nan=math.inf), kind="stable")[:WORST]
    worst = [(rows[place], rotation[place], float(rows[place]["translation_error"])) for place in order]
    return {"figure": figure, "worst": worst}


def _about_training(folder: Path) -> About:
    report = read_record(folder / TRAINING) if (folder / TRAINING).is_file() else {}
    config = saved_config(folder / "config.yaml")
    losses, _ = read_losses(folder / "metrics.csv")
    best = {"best validation loss": f"{np.nanmin(losses['val/loss'].value):.4g}"} if "val/loss" in losses else {}
    title = f"{words(config['model']['name'])} model, trained on {config['data']['name']}"
    if not report:
        return title, "unfinished training run", best
    counts = {key: str(report[key]) for key in ("epochs", "steps")}
    return title, f"trained for {report['epochs']} epochs, seed {report['seed']}", best | counts


def _losses(folder: Path) -> dict[str, Any]:
    losses, rate = read_losses(folder / "metrics.csv")
    if not losses:
        raise UserError("no losses were logged")
    return {"figure": plots.losses_plot(losses, rate)}


def _about_estimate(folder: Path) -> About:
    result = read_record(folder / RESULT)
    rows = read_rows(folder / "poses.csv")
    found = sum(row["valid"] == "True" for row in rows)
    verdicts = Counter(row.get("verdict") for row in rows)
    judged = {each: str(verdicts[each]) for each in ("trust", "doubtful", "do not trust") if verdicts[each]}
    return (
        f"Cameras by {words(result['config']['solver']['name'])}",
        "camera poses of photographs; the first is the reference",
        {"photographs": str(len(rows)), "poses found": str(found), **judged, "seconds": f"{result['seconds']:.3g}"},
    )


def _cameras(folder: Path) -> dict[str, Any]:
    rows = [row for row in read_rows(folder / "poses.csv") if row["valid"] == "True"]
    if not rows:
        raise UserError("no photograph has a pose")
    poses = np.array([[float(row[key]) for key in POSE] for row in rows])
    poses[:, :2] = np.radians(poses[:, :2])
    field_of_view = float(read_record(folder / "transforms.json")["camera_angle_x"])
    figure = plots.cameras_plot(poses, _images(folder, rows), field_of_view)
    return {"figure": figure}


def _poses(folder: Path) -> dict[str, Any]:
    rows = read_rows(folder / "poses.csv")
    return {
        "rows": list(zip(rows, _images(folder, rows), strict=True)),
        "masks": {file.name: _image(file) for file in (folder / "masks").glob("*.png")},
        "masks_by": read_record(folder / RESULT).get("masks_by"),
        "notes": any(row.get("verdict") for row in rows),
    }


def _images(folder: Path, rows: Sequence[Mapping[str, str]]) -> list[NDArray]:
    """The prepared images of rows; only files inside the run's own folder are read."""
    return [_image(folder / "images" / Path(row["image"]).name) for row in rows]


def _image(file: Path) -> NDArray:
    with Image.open(file) as image:
        return np.asarray(image.convert("RGBA"))


def _about_landscape(folder: Path) -> About:
    record = read_record(folder / LANDSCAPE)
    files = " and ".join(Path(record[name]).name for name in ("reference", "query"))
    name = record["config"]["object"]
    numbers = {"minima": str(len(record["minima"])), "flatness along longitude": f"{record['flatness']:.2f}"}
    answer = next((each for each in record["descents"] if each["chosen"]), None)
    if answer is not None and answer["rotation_error"] is not None:
        numbers["rotation error of the answer"] = f"{answer['rotation_error']:.1f}°"
    title = f"Landscape of {files}" if name is None else f"Landscape of {words(name)}, {files}"
    return title, "energy of the prior over the relative pose of a pair, with solver trajectories", numbers


def _about_azimuths(folder: Path) -> About:
    record = read_record(folder / OVERVIEW)
    names = {"within": "lowest energy within 15°, all objects", "within_unique_answer": "unique answers only"}
    return (
        f"Landscapes of {record['config']['data']['name']}, prior {record['config']['prior']['name']}",
        "energy of the prior around each object, at the true latitude and radius",
        {label: f"{record[key]:.1%}" for key, label in names.items() if record.get(key) is not None},
    )


CONTENTS: Mapping[str, Contents] = {
    "eval": Contents("Evaluations", _about_evaluation, {
        "Summary": ("summary", lambda folder: {"result": read_record(folder / RESULT)}),
        "Pairs, failures first": ("pairs", _pairs),
        "Objects": ("objects", _objects), "Errors": ("errors", _errors)}),
    "train": Contents("Training runs", _about_training, {
        "Losses": ("losses", _losses), "Final values": ("last", lambda folder: read_record(folder / TRAINING))}),
    "estimate": Contents("Estimates", _about_estimate, {
        "Cameras": ("cameras", _cameras), "Poses": ("poses", _poses)}),
    "landscape": Contents("Landscapes", _about_landscape, {
        "Landscape": ("pairs", _pairs),
        "Pictures": ("pictures", lambda folder: {  # photographs have no fields
            "files": [folder / "landscape.png", *folder.glob("fields.png")]})}),
    "overview": Contents("Landscapes", _about_azimuths, {
        "Objects": ("azimuths", lambda folder: read_record(folder / OVERVIEW))}),
}  # fmt: skip


def contents_of(folder: Path, kind: Kind) -> Contents:
    """What the page shows for a run; a `landscape` run is that of a pair or the overview of all objects."""
    return CONTENTS["overview" if kind == "landscape" and not (folder / LANDSCAPE).is_file() else kind]


_ENVIRONMENT = Environment(
    loader=PackageLoader("lp_framework.report"),
    autoescape=lambda name: not str(name).endswith(".md.j2"),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_ENVIRONMENT.filters |= {each.__name__: each for each in (metric, packed, picture, sheet, summary_rows, words)}
_ENVIRONMENT.filters["name"] = lambda path: Path(path).name
_ENVIRONMENT.tests |= {"finite": math.isfinite}
_ENVIRONMENT.globals |= {
    "classes": list(CLASS_COLOURS),
    "failure": ROTATION_THRESHOLDS[-1],
    "metrics": {key: HEADINGS.get(key, key) for key in (*COLUMNS, *ERRORS)},
    "pi": math.pi,
}
