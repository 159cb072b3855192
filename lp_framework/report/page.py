"""The page of a run, and that of a set of runs: one self-contained HTML file, from templates and the runs' files.

What is missing or damaged of a run is told in its place.
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
from functools import cache, partial
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

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
LARGEST = 5_000_000  # letters of runs' parts on the page of a set; the rest of the runs are in the table alone
MOST_PLOTS = 4_000_000  # letters that the plots of one run's pairs may take; the last ones are left out beyond it
MOST_CAMERAS = 40
WORST = 20  # pairs in the table of the worst
NOTES = ("answer", "probability", "verdict", "second_longitude_degrees", "second_probability")  # of a photograph
POSE = ("latitude_degrees", "longitude_degrees", "radius")
# What a damaged file leads to; `UserError` is a `ValueError`.
BROKEN = (OSError, ValueError, KeyError, TypeError, AttributeError, IndexError, RecursionError, UndefinedError)
HEADINGS = dict(zip([*ERRORS, *COSTS], ["Rot. (deg)", "Trans.", "s/pair", "passes"], strict=True))
T = TypeVar("T")
Record = Mapping[str, Any]
About = tuple[str, str, Mapping[str, str]]  # title, subtitle, and the most important numbers by name
Sections = Sequence[tuple[str, str, Callable[[Record], Mapping[str, Any]]]]  # title, template, and what fills it


class Section(NamedTuple):
    """A part of a page under its heading; the content is HTML."""

    title: str
    content: str


class RunPart(NamedTuple):
    """A run on a page: what it is in a few words, its most important numbers by name, and its sections."""

    title: str
    subtitle: str
    numbers: Mapping[str, str]
    sections: Sequence[Section]


def run_part(folder: Path, file: str, about: Callable[[Record], About], sections: Sections) -> RunPart:
    """By the record in its JSON `file`, empty where that is missing, with these sections and its configuration."""
    record, missing = dict[str, Any](), ""
    try:
        record = _read(folder / file, lambda text: dict(json.loads(text)))
    except UserError as error:
        missing = str(error)

    def reason(error: Exception) -> str:
        damaged = f"its files are damaged ({type(error).__name__}: {str(error).partition(chr(10))[0]})"
        return str(error) if isinstance(error, UserError) else missing or damaged

    def section(title: str, template: str, values: Callable[[Record], Mapping[str, Any]]) -> Section:
        try:
            return Section(title, render(f"{template}.html.j2", **values(record)))
        except BROKEN as error:
            return Section(title, render("note.html.j2", text=f"Not shown: {reason(error)}."))

    try:
        title, subtitle, numbers = about(record)
    except BROKEN as error:
        title, subtitle, numbers = folder.name, f"run without results: {reason(error)}", {}
    config = record.get("config") or tried(lambda: saved_config(folder / "config.yaml"), None)
    text = yaml.safe_dump(config, sort_keys=False, allow_unicode=True) if isinstance(config, Mapping) else None
    last = {"config": text, "versions": record.get("versions"), "folder": folder}
    shown = [*sections, ("Configuration and versions", "configuration", lambda _: last)]
    return RunPart(title, subtitle, numbers, [section(*each) for each in shown])


def render(template: str, **values: Any) -> str:
    """A template of this package with these values, in which text is escaped."""
    return _ENVIRONMENT.get_template(template).render(values)


def tried(value: Callable[[], T], otherwise: T) -> T:
    """A value that is made of a run's files, or another where they are damaged."""
    try:
        return value()
    except BROKEN:
        return otherwise


def read_rows(file: Path) -> list[dict[str, str]]:
    """The rows of a CSV file with a heading; `UserError` where it is missing or damaged."""
    return _read(file, lambda text: list(csv.DictReader(io.StringIO(text, newline=""))))


def _read(file: Path, parse: Callable[[str], T]) -> T:
    try:
        return parse(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError(f"there is no {file.name}") from None
    except (OSError, ValueError, TypeError, RecursionError, csv.Error) as error:
        raise UserError(f"{file.name} is damaged ({error})") from error


def packed(content: go.Figure | str) -> str:
    """A figure or a text for the page's script, compressed, in letters."""
    text = content if isinstance(content, str) else content.to_json()
    return base64.b64encode(gzip.compress(text.encode(), 6, mtime=0)).decode()


def picture(image: NDArray, side: int) -> str:
    """An image `[H, W, 3 or 4]` (uint8) as an address that holds it (WebP), shrunk to at most `side` pixels."""
    shrunk = Image.fromarray(image)
    shrunk.thumbnail((side, side), Image.Resampling.LANCZOS)
    content = io.BytesIO()
    shrunk.save(content, "webp", quality=82)
    return f"data:image/webp;base64,{base64.b64encode(content.getvalue()).decode()}"


def sheet(file: Path) -> str:
    """A printed figure (PNG file) as an address that holds it."""
    return f"data:image/png;base64,{base64.b64encode(file.read_bytes()).decode()}"


def number(name: str, value: float) -> str:
    """A metric's value, rounded as is usual for it."""
    if not math.isfinite(value):
        return "inf"
    if name == "rotation_error":
        return f"{value:.2f}" if value < 100 else f"{value:.0f}"
    digits = {"network_passes_per_pair": ".0f", "seconds_per_pair": ".3g"}
    return format(value, digits.get(name, ".3f"))


def metric(metrics: Mapping[str, float | None], key: str) -> str:
    """A metric in print; a solver with one answer has no success rates, and null is infinity."""
    value = metrics.get(key, math.nan)
    return number(key, math.inf if value is None else value) if key in metrics else "-"


def write_run_page(folder: Path, kind: Kind) -> Path:
    """Write `report.html` into the folder of a finished run, from what is there."""
    return write_report_page(folder / PAGE, [(folder, kind)], [])


def write_report_page(path: Path, runs: Sequence[tuple[Path, Kind]], above: Sequence[Section]) -> Path:
    """Write the page of several runs, or of one: the sections `above`, the runs in tables, and each to be opened."""
    if len(runs) == 1:
        ((folder, kind),) = runs
        part = PARTS[kind][1](folder)
        *sections, configuration = part.sections
        part = part._replace(sections=[*sections, *above, configuration])
    else:
        part = RunPart("Report", f"{len(runs)} runs", {}, [*above, *_sections_of_several(runs)])
    templates = resources.files("lp_framework.report") / "templates"
    text = render(
        "page.html.j2",
        part=part,
        style=(templates / "page.css").read_text(encoding="utf-8"),
        script=(templates / "page.js").read_text(encoding="utf-8"),
        plotly=_plotly() if any("data-figure=" in section.content for section in part.sections) else "",
        version=importlib.metadata.version("lp_framework"),
    )
    write_text(path, text)
    return path


@cache
def _plotly() -> str:
    """plotly.js, packed: a third of its size, so that every run of a sweep can have a page."""
    return packed(get_plotlyjs())


def _sections_of_several(runs: Sequence[tuple[Path, Kind]]) -> list[Section]:
    """A table for the runs of each command, and all that each of them shows, while there is room."""
    listed: list[dict[str, Any]] = []
    room = LARGEST
    for number, (folder, kind) in enumerate(runs):
        part = PARTS[kind][1](folder)
        content = render("run.html.j2", part=part)
        fits = len(content) <= room
        room -= len(content) if fits else 0
        shown = content if fits else None
        listed.append({"number": number, "folder": folder, "kind": kind, "part": part, "content": shown})
    sections = []
    for kind in dict.fromkeys(kind for _, kind in runs):
        heading, some = PARTS[kind][0], [run for run in listed if run["kind"] == kind]
        sections.append(Section(heading, render("runs.html.j2", caption=heading, runs=some)))
    return [*sections, Section("Run by run", render("opened.html.j2", runs=listed))]


def _evaluation(folder: Path) -> RunPart:
    sections: Sections = [
        ("Summary", "summary", lambda result: {"rows": summary_rows(result), "result": result}),
        ("Pairs, failures first", "pairs", partial(_pairs, folder)),
        ("Objects", "objects", lambda result: _objects(result, read_rows(folder / "pairs.csv"))),
        ("Errors", "errors", lambda _: _errors(read_rows(folder / "pairs.csv"))),
    ]
    return run_part(folder, RESULT, _about_evaluation, sections)


def _about_evaluation(result: Record) -> About:
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
            "seconds a pair": f"{result['seconds_per_pair']:.3g}",
        },
    )


def _pairs(folder: Path, record: Record) -> dict[str, Any]:
    """The pairs that a run keeps beside its pictures, each with its plots (packed, by kind) and the steps they show."""
    if record.get("config", {}).get("pictures") is False:
        raise UserError("the run was made with pictures=false")
    examples = read_examples(folder / "pictures" / EXAMPLES)
    shown: list[dict[str, Any]] = []
    room = MOST_PLOTS
    for example in examples:
        kinds = {"map": plots.map_plot, "cameras": plots.pair_cameras_plot}
        if example.landscapes:
            kinds["surface"] = plots.surface_plot
        drawn = {kind: packed(draw(example)) for kind, draw in kinds.items()}
        room -= sum(map(len, drawn.values()))
        if shown and room < 0:
            break
        shown.append({"example": example, "plots": drawn, "steps": plots.frame_steps(example)})
    return {"pairs": shown, "left_out": len(examples) - len(shown)}


def _objects(result: Record, rows: Sequence[Mapping[str, str]]) -> dict[str, Any]:
    found = {name: metrics for name, metrics in result["per_object"].items() if metrics is not None}
    order = sorted(found, key=lambda name: (found[name]["R(R)@15"], found[name].get("SR(R)@30", 0), name))
    classes, counts = {row["object"]: row["ambiguity"] for row in rows}, Counter(row["object"] for row in rows)
    return {"objects": {name: found[name] for name in order}, "classes_of": classes, "counts": counts}


def _errors(rows: Sequence[Mapping[str, str]]) -> dict[str, Any]:
    rotation = np.array([float(row["rotation_error_degrees"]) for row in rows])
    classes = np.array([row["ambiguity"] for row in rows])
    figure = plots.errors_plot({name: rotation[classes == name] for name in CLASS_COLOURS if name in classes})
    order = np.argsort(-np.nan_to_num(rotation, nan=math.inf), kind="stable")[:WORST]
    worst = [(rows[place], rotation[place], float(rows[place]["translation_error"])) for place in order]
    return {"figure": figure, "worst": worst}


def _training(folder: Path) -> RunPart:
    sections = [
        ("Losses", "losses", lambda _: _losses(folder)),
        ("Last values", "last", lambda report: {"final": report["final"]}),
    ]
    return run_part(folder, "training.json", partial(_about_training, folder), sections)


def _about_training(folder: Path, report: Record) -> About:
    config = saved_config(folder / "config.yaml")
    losses, _ = read_losses(folder / "metrics.csv")
    best = {"best validation loss": f"{np.nanmin(losses['val/loss'].value):.4g}"} if "val/loss" in losses else {}
    title = f"{words(config['model']['name'])} model, trained on {config['data']['name']}"
    if not report:
        return title, "training that has not finished", best
    counts = {key: str(report[key]) for key in ("epochs", "steps") if key in report}
    return title, f"training over {report['epochs']} epochs, seed {report['seed']}", best | counts


def _losses(folder: Path) -> dict[str, Any]:
    losses, rate = read_losses(folder / "metrics.csv")
    if not losses:
        raise UserError("no loss was logged")
    return {"figure": plots.losses_plot(losses, rate)}


def _estimate(folder: Path) -> RunPart:
    sections: Sections = [
        ("Cameras", "cameras", lambda _: _cameras(folder)),
        ("Poses", "poses", partial(_poses, folder)),
    ]
    return run_part(folder, RESULT, partial(_about_estimate, folder), sections)


def _about_estimate(folder: Path, result: Record) -> About:
    rows = read_rows(folder / "poses.csv")
    found = sum(row["valid"] == "True" for row in rows)
    verdicts = Counter(row.get("verdict") for row in rows)
    judged = {each: str(verdicts[each]) for each in ("trust", "doubtful", "do not trust") if verdicts[each]}
    return (
        f"Cameras by {words(result['config']['solver']['name'])}",
        "camera poses of photographs; the first is the reference",
        {"photographs": str(len(rows)), "with a pose": str(found), **judged, "seconds": f"{result['seconds']:.3g}"},
    )


def _cameras(folder: Path) -> dict[str, Any]:
    rows = [row for row in read_rows(folder / "poses.csv") if row["valid"] == "True"]
    if not rows:
        raise UserError("no photograph has a pose")
    shown = rows[:MOST_CAMERAS]
    poses = np.array([[float(row[key]) for key in POSE] for row in shown])
    poses[:, :2] = np.radians(poses[:, :2])
    field_of_view = float(_read(folder / "transforms.json", json.loads)["camera_angle_x"])
    figure = plots.cameras_plot(poses, [_image(folder, row) for row in shown], field_of_view)
    return {"figure": figure, "shown": len(shown), "count": len(rows)}


def _poses(folder: Path, result: Record) -> dict[str, Any]:
    rows = read_rows(folder / "poses.csv")
    keys = [*POSE, *(f"relative_{key}" for key in POSE)]
    poses = [[float(row[key]) for key in keys] if row["valid"] == "True" else None for row in rows]
    images = [tried(partial(_image, folder, row), None) for row in rows]
    names = [Path(row["file"]).name for row in rows]
    energies = [row["energy"] for row in rows]
    notes = [[row.get(key, "") for key in NOTES] for row in rows] if any(row.get("verdict") for row in rows) else None
    masks = [tried(partial(_mask, folder, row), None) for row in rows] if result.get("masks_by") else None
    return {
        "rows": list(zip(names, images, poses, energies, strict=True)),
        **{"notes": notes, "masks": masks, "masks_by": result.get("masks_by")},
    }


def _mask(folder: Path, row: Mapping[str, str]) -> NDArray:
    """The mask `[H, W, 3]` that the run made for a row's image."""
    with Image.open(folder / "masks" / Path(row["image"]).name) as mask:
        return np.asarray(mask.convert("RGB"))


def _image(folder: Path, row: Mapping[str, str]) -> NDArray:
    """The prepared image `[S, S, 4]` of a row; only what lies in the run's own folder is read."""
    with Image.open(folder / "images" / Path(row["image"]).name) as image:
        return np.asarray(image.convert("RGBA"))


def _landscape(folder: Path) -> RunPart:
    if (folder / "landscape.json").is_file():
        sections: Sections = [
            ("Landscape", "pairs", partial(_pairs, folder)),
            ("Pictures", "pictures", lambda _: {"files": _sheets(folder)}),
        ]
        return run_part(folder, "landscape.json", _about_landscape, sections)
    return run_part(folder, "azimuth.json", _about_azimuths, [("Objects", "azimuths", lambda record: record)])


def _about_landscape(record: Record) -> About:
    files = " and ".join(Path(record[name]).name for name in ("reference", "query"))
    name = record["config"]["object"]
    numbers = {"minima": str(len(record["minima"])), "flatness along longitude": f"{record['flatness']:.2f}"}
    answer = next((each for each in record["descents"] if each["chosen"]), None)
    if answer is not None and answer["rotation_error"] is not None:
        numbers["rotation error of the answer"] = f"{answer['rotation_error']:.1f}°"
    title = f"Landscape of {files}" if name is None else f"Landscape of {words(name)}, {files}"
    return title, "the energy of the prior over the relative pose of a pair, and the ways of a solver over it", numbers


def _sheets(folder: Path) -> list[Path]:
    files = [folder / f"{name}.png" for name in ("landscape", "fields") if (folder / f"{name}.png").is_file()]
    if not files:
        raise UserError("there is no landscape.png")
    return files


def _about_azimuths(record: Record) -> About:
    names = {"within": "least energy within 15°, all objects", "within_unique_answer": "the same, unique answer"}
    return (
        f"Landscapes of {record['config']['data']['name']}, prior {record['config']['prior']['name']}",
        "the energy of the prior around each object, all but the azimuth true",
        {label: f"{record[key]:.1%}" for key, label in names.items() if record.get(key) is not None},
    )


# By the command, with the heading of its runs in a table of several.
PARTS: Mapping[Kind, tuple[str, Callable[[Path], RunPart]]] = {
    "eval": ("Evaluations", _evaluation), "train": ("Trainings", _training),
    "estimate": ("Estimates", _estimate), "landscape": ("Landscapes", _landscape),
}  # fmt: skip

_ENVIRONMENT = Environment(
    loader=PackageLoader("lp_framework.report"),
    autoescape=lambda name: not str(name).endswith(".md.j2"),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_ENVIRONMENT.filters |= {"metric": metric, "picture": picture, "sheet": sheet, "words": words, "packed": packed}
_ENVIRONMENT.tests |= {"finite": math.isfinite}
_ENVIRONMENT.globals |= {
    "classes": list(CLASS_COLOURS),
    "failure": ROTATION_THRESHOLDS[-1],
    "metrics": {key: HEADINGS.get(key, key) for key in (*COLUMNS, *ERRORS)},
    "pi": math.pi,
}
