"""The tab that estimates the cameras of photographs."""

from __future__ import annotations

import base64
import io
import re
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from dash import Dash, Input, Output, State, ctx, dcc, html, no_update
from dash.dcc.express import send_bytes

from lp_framework import catalogue
from lp_framework.analysis.confidence import Answer, in_words
from lp_framework.analysis.estimates import Estimate
from lp_framework.analysis.landscapes import Landscape
from lp_framework.analysis.pairs import ShownPair, words
from lp_framework.app import forms
from lp_framework.app.jobs import Jobs
from lp_framework.app.visitors import Visitor, Visitors
from lp_framework.app.workbench import Request, Workbench
from lp_framework.data.photographs import read_image
from lp_framework.errors import UserError
from lp_framework.report.estimate_files import write_estimate
from lp_framework.report.plots import cameras_plot

TAB = "estimate"
EXAMPLE_VIEWS = 3  # an example consists of the first test views of an object
BACKGROUNDS = {
    "cut": "Cut out the object: by its mask, else by transparency, else automatically",
    "white": "Use the images as they are: square, with the object on white",
}
NEARLY_AS_DEEP = 0.1  # of the landscape's range: warn of a second minimum at most this much above the lowest one


class Result(NamedTuple):
    """What the tab shows of an estimate: the numbers, the pairs with their landscapes, and the folder of its files."""

    found: Estimate
    pairs: Sequence[ShownPair]
    folder: Path


def layout(objects: Sequence[str], checkpoints: Sequence[str], prior: str) -> html.Div:
    """The tab; `objects` are the ready examples."""
    drop: list[Any] = ["Drop two or more photographs of one object here, or ", html.A("choose files", href="#")]
    masks: list[Any] = [html.A("Add masks", href="#"), ", named like their photographs (optional)"]
    names = [{"label": words(each), "value": each} for each in objects]
    sources = [
        dcc.Dropdown(names, id="example", placeholder="or choose an example"),
        dcc.Upload(masks, id="masks", multiple=True, className="drop small"),
    ]
    method = [
        forms.field("Background", dcc.RadioItems(BACKGROUNDS, "cut", id="background", className="radio")),
        forms.field("Model", dcc.Dropdown(list(checkpoints), "general", id="estimate-checkpoint", clearable=False)),
        forms.choice(TAB, "solver", "Solver", "sharp", catalogue.choices("solver")),
        forms.choice(TAB, "start", "Starts", "modes", catalogue.choices("start")),
        forms.choice(TAB, "prior", "Prior", prior, catalogue.choices("prior")),
    ]
    choose = [
        forms.field("Pair", dcc.Dropdown(id="estimate-pair", clearable=False)),
        forms.field("Landscape", dcc.Dropdown(id="estimate-landscape", clearable=False)),
    ]
    landscapes = [
        html.H3("The landscape, with the trajectories of all starts"),
        html.Div(choose, className="form"),
        html.Div([forms.plot("estimate-map", 400), forms.plot("estimate-surface", 400)], className="plots"),
    ]
    shown = [
        html.Div(id="estimate-words"),
        html.Button("Download everything", id="estimate-download", className="quiet"),
        dcc.Download(id="estimate-files"),
        html.H3("The cameras around the object"),
        forms.plot("estimate-cameras", 420),
        html.Div(landscapes, id="estimate-landscapes"),
    ]
    return html.Div(
        [
            dcc.Upload(drop, id="photographs", multiple=True, className="drop"),
            html.Div(sources, className="form"),
            html.Div(id="thumbnails", className="views"),
            forms.folded("Method", method),
            html.Button("Estimate the cameras", id="estimate-run", className="main"),
            html.Button("Clear", id="estimate-clear", className="quiet"),
            html.P(id="estimate-error", className="error", role="alert"),
            forms.progress(TAB),
            html.Div(shown, id="estimate-shown", hidden=True),
        ]
    )


def register(app: Dash, jobs: Jobs, bench: Workbench, visitors: Visitors) -> None:
    """Register the tab's callbacks."""
    for name in ("estimate-cameras", "estimate-map", "estimate-surface"):
        forms.register_plot(app, name)
    forms.register_progress(app, jobs, TAB)

    @app.callback(
        Output("thumbnails", "children"),
        Output("estimate-error", "children", allow_duplicate=True),
        Output("example", "value"),
        Output("photographs", "contents"),
        Output("masks", "contents"),
        Output("estimate-shown", "hidden", allow_duplicate=True),
        Input("photographs", "contents"),
        Input("masks", "contents"),
        Input("example", "value"),
        Input("estimate-clear", "n_clicks"),
        State("photographs", "filename"),
        State("masks", "filename"),
        State("visitor", "data"),
        State(f"{TAB}-job", "data"),
        prevent_initial_call=True,
    )
    def take(
        photographs: Any, masks: Any, example: str | None, _: Any, names: Any, mask_names: Any, name: str, job: str
    ) -> Any:
        visitor, what = visitors[name], ctx.triggered_id
        try:
            if what == "estimate-clear":
                visitor.take_files([])
            elif what == "example" and example is not None:
                visitor.take_files(jobs.now(lambda: bench.example(example, EXAMPLE_VIEWS)))
            elif what == "photographs" and photographs:
                visitor.take_photographs(_decoded(names, photographs))
            elif what == "masks" and masks:
                visitor.take_masks(_decoded(mask_names, masks))
            else:  # triggered by the outputs below, which reset the inputs
                return [no_update] * 6
            jobs.cancel(job)
            return _thumbnails(visitor), "", example if what == "example" else None, None, None, True
        except UserError as error:
            visitor.take_files([])
            return [], own_names(str(error), visitor.folder), None, None, None, True

    @app.callback(
        Output(f"{TAB}-job", "data"),
        Output("estimate-error", "children"),
        Output("estimate-shown", "hidden", allow_duplicate=True),
        Input("estimate-run", "n_clicks"),
        State("background", "value"),
        State("estimate-checkpoint", "value"),
        State("visitor", "data"),
        State(f"{TAB}-job", "data"),
        *forms.selected(TAB),
        prevent_initial_call=True,
    )
    def run(_: int, background: str, checkpoint: str, name: str, last: str, *__: Any) -> Any:
        visitor = visitors[name]
        try:
            made = forms.choices()
            request = Request(made["solver"], made["start"], made["prior"], checkpoint)
            if len(visitor.files) < 2:
                raise UserError("at least two photographs of one object are needed; drop them above")
            files, masks, folder = list(visitor.files), visitor.masks, visitor.new_folder()

            def work() -> Result:
                found, pairs = bench.estimate(files, masks, background == "cut", request)
                write_estimate(folder, found, {})
                # Only the prepared images are shown; the photographs may be large.
                return Result(replace(found, photographs=()), pairs, folder)

            jobs.cancel(last)
            return jobs.submit(work), "", True
        except UserError as error:
            return no_update, str(error), True

    @app.callback(
        Output("estimate-error", "children", allow_duplicate=True),
        Output("estimate-shown", "hidden"),
        Output("estimate-words", "children"),
        Output("estimate-cameras-figure", "data"),
        Output("estimate-pair", "options"),
        Output("estimate-pair", "value"),
        Output("estimate-landscape", "options"),
        Output("estimate-landscape", "value"),
        Output("estimate-landscapes", "hidden"),
        Input(f"{TAB}-done", "data"),
        State("visitor", "data"),
        prevent_initial_call=True,
    )
    def show(job: str, name: str) -> Any:
        try:
            result: Result = jobs.result(job)
        except UserError as error:
            return own_names(str(error), visitors[name].folder), True, *[no_update] * 7
        found = result.found
        sound = np.isfinite(found.absolute.numpy()).all(axis=1)
        images = [np.asarray(each.image) for each, kept in zip(found.prepared, sound, strict=True) if kept]
        cameras = cameras_plot(found.absolute.numpy()[sound], images, result.pairs[0].reference.field_of_view)
        pairs = [{"label": pair.object, "value": place} for place, pair in enumerate(result.pairs)]
        names = list(result.pairs[0].landscapes)
        return (
            "",
            False,
            [*_words(result), *_notes(jobs.warnings(job), result.folder)],
            forms.for_page(cameras),
            pairs,
            0,
            names,
            names[0] if names else None,
            not names,  # if the solver uses neither a model nor a prior
        )

    @app.callback(
        Output("estimate-map-figure", "data"),
        Output("estimate-surface-figure", "data"),
        Input("estimate-pair", "value"),
        Input("estimate-landscape", "value"),
        Input(f"{TAB}-done", "data"),
        prevent_initial_call=True,
    )
    def draw(place: int | None, landscape: str | None, job: str) -> Any:
        try:
            pair = jobs.result(job).pairs[place or 0].finite()
        except (UserError, IndexError):
            return no_update, no_update
        if landscape is None or landscape not in pair.landscapes:
            return no_update, no_update
        return tuple(map(forms.for_page, forms.landscape_plots(pair, landscape)))

    @app.callback(
        Output("estimate-files", "data"),
        Output("estimate-error", "children", allow_duplicate=True),
        Input("estimate-download", "n_clicks"),
        State(f"{TAB}-done", "data"),
        prevent_initial_call=True,
    )
    def download(_: int, job: str) -> Any:
        try:
            return send_bytes(_archive(jobs.result(job).folder), "cameras.zip"), ""
        except UserError as error:
            return no_update, str(error)


def _decoded(names: Sequence[str], contents: Sequence[str]) -> list[tuple[str, bytes]]:
    """Decode the files of an upload: names and contents."""
    return [(name, base64.b64decode(content.partition(",")[2])) for name, content in zip(names, contents, strict=True)]


def _thumbnails(visitor: Visitor) -> list[Any]:
    captions = [f"{file.name}{', the reference' if number == 0 else ''}" for number, file in enumerate(visitor.files)]
    shown = [
        forms.image(np.asarray(read_image(file)), text) for file, text in zip(visitor.files, captions, strict=True)
    ]
    masks = [] if visitor.masks is None else sorted(file.name for file in visitor.masks.iterdir())
    return [*shown, html.P(f"masks: {', '.join(masks)}", className="note")] if masks else shown


def _words(result: Result) -> list[html.Div]:
    """The answers in words, with their verdicts and warnings."""
    found, parts = result.found, []
    for place, pair in enumerate(result.pairs):
        relative = found.relative[place + 1].tolist()
        answer = found.answers[place] if found.answers else None
        line: list[Any] = [
            html.Strong(in_words(*relative[:2])),
            f" from {pair.reference.file.name} to {pair.query.file.name}",
        ]
        lines = [html.P(line, className="answer")]
        if answer is not None and answer.verdict:
            lines.append(html.P(f"{answer.verdict.capitalize()}: {answer.reason}.", className="note"))
        lines += [html.P(text, className="warning") for text in warnings_of(answer, pair)]
        parts.append(html.Div(lines))
    return parts


def _notes(warnings: Sequence[str], folder: Path) -> list[html.P]:
    """Logged warnings, with the visitor's file names."""
    return [html.P(own_names(text, folder.parent), className="warning") for text in warnings]


def own_names(text: str, folder: Path) -> str:
    """Remove the folders of a visitor's uploads from a sentence."""
    return re.sub(rf"{re.escape(str(folder))}/\w+/", "", text)


def warnings_of(answer: Answer | None, pair: ShownPair) -> list[str]:
    """Alternatives to a pair's answer: the model's second answer, or else second minima of nearly the lowest energy."""
    if answer is not None and answer.second_words:
        return [f"It may also be {answer.second_words}."]
    return [text for name, landscape in pair.landscapes.items() if (text := second_minimum(name, landscape))]


def second_minimum(name: str, landscape: Landscape) -> str:
    """Describe a second minimum whose energy is nearly that of the lowest one; empty if there is none."""
    minima = landscape.minima()
    if len(minima) < 2 or minima[1].height > NEARLY_AS_DEEP:
        return ""
    other = minima[1]
    where = in_words(other.latitude, other.longitude)
    return f"The {name} has a second minimum at {where}, only {other.height:.0%} of its range above the lowest one."


def _archive(folder: Path) -> bytes:
    """Pack a folder as a ZIP file."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(folder.rglob("*")):
            archive.write(file, Path("cameras") / file.relative_to(folder))
    return content.getvalue()
