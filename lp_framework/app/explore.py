"""The tab that explores a landscape: its energy, views generated at any pose, and where solvers end from there."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import plotly.graph_objects as go
from dash import Dash, Input, Output, State, ctx, dcc, html, no_update

from lp_framework import catalogue
from lp_framework.analysis.confidence import in_words
from lp_framework.analysis.pairs import ShownPair, words
from lp_framework.app import forms
from lp_framework.app.jobs import Jobs
from lp_framework.app.workbench import Place, Request, Scene, Workbench
from lp_framework.errors import UserError
from lp_framework.report.plots import add_targets, add_trajectory

TAB = "explore"
OWN = "two_stage_without_noise"  # the solver whose trajectories are shown at first
SOLVERS = [OWN, "ifusion", "gauss_newton"]  # that descend from the chosen pose
COLOURS = (
    "#E6399B",
    "#17A398",
    "#7B5CD6",
    "#D08700",
    "#3E8EDE",
    "#8A8D91",
)  # of the solvers' trajectories from the chosen pose
FIRST, SECOND = 0, 4  # the views shown at first, as in the command `landscape`


def layout(views: Mapping[str, int], first: str, checkpoints: Sequence[str], prior: str) -> html.Div:
    """The tab; `views` are the numbers of test views by object, `first` is the object shown at first."""
    names = [{"label": words(each), "value": each} for each in views]
    chosen, solvers = first if first in views else next(iter(views)), catalogue.choices("solver")
    numbers = list(range(views[chosen]))
    pair = [
        forms.field("Object", dcc.Dropdown(names, chosen, id="explore-object", clearable=False)),
        forms.field("Reference view", dcc.Dropdown(numbers, FIRST, id="explore-reference", clearable=False)),
        forms.field("Query view", dcc.Dropdown(numbers, min(SECOND, numbers[-1]), id="explore-query", clearable=False)),
        html.Button("Show the landscape", id="explore-show", className="main"),
    ]
    method = [
        forms.field("Model", dcc.Dropdown(list(checkpoints), "score", id="explore-checkpoint", clearable=False)),
        forms.choice(TAB, "prior", "Prior", prior, catalogue.choices("prior")),
        forms.choice(TAB, "solver", "Solver", OWN, solvers),
        forms.choice(TAB, "start", "Starts", "ring", catalogue.choices("start")),
    ]
    sliders = [
        forms.slider("Latitude", "explore-latitude", (-60, 60, 1), {each: f"{each}°" for each in (-60, 0, 60)}),
        forms.slider("Longitude", "explore-longitude", (0, 360, 1), {each: f"{each}°" for each in (0, 180, 360)}),
        forms.slider("Radius", "explore-radius", (-0.8, 0.8, 0.01), {each: f"{each:g}" for each in (-0.8, 0, 0.8)}),
        forms.field("Descend from the pose by", dcc.Dropdown(solvers, SOLVERS, id="explore-solvers", multi=True)),
    ]
    shown = [
        html.Div([html.Div(id="explore-views"), html.Div(id="explore-view")], className="views small"),
        html.P("Click on the map or the surface, or move a slider, to choose a relative pose.", className="note"),
        dcc.RadioItems(id="explore-landscape", className="radio", inline=True),
        html.Div([forms.plot("explore-map", 400), forms.plot("explore-surface", 400)], className="plots"),
        html.Div(sliders, className="form"),
        html.Div(id="explore-place"),
    ]
    return html.Div(
        [
            html.Div(pair, className="form"),
            forms.folded("Method", method),
            html.P(id="explore-error", className="error", role="alert"),
            forms.progress(TAB),
            html.Div(shown, id="explore-shown", hidden=True),
            *(dcc.Store(id=f"explore-{name}") for name in ("scene", "at", "chosen")),
        ]
    )


def register(app: Dash, jobs: Jobs, bench: Workbench, views: Mapping[str, int]) -> None:
    """Register the tab's callbacks."""
    for name in ("explore-map", "explore-surface"):
        forms.register_plot(app, name)
    forms.register_progress(app, jobs, TAB)

    @app.callback(
        Output("explore-reference", "options"),
        Output("explore-query", "options"),
        Output("explore-reference", "value"),
        Output("explore-query", "value"),
        Input("explore-object", "value"),
        State("explore-reference", "value"),
        State("explore-query", "value"),
        prevent_initial_call=True,
    )
    def number(name: str, reference: int, query: int) -> Any:
        numbers = list(range(views[name]))
        return numbers, numbers, min(reference, numbers[-1]), min(query, numbers[-1])

    @app.callback(
        Output(f"{TAB}-job", "data"),
        Output("explore-error", "children"),
        Input("explore-show", "n_clicks"),
        Input("explore-at", "data"),
        State("explore-scene", "data"),
        State("explore-solvers", "value"),
        State("explore-object", "value"),
        State("explore-reference", "value"),
        State("explore-query", "value"),
        State("explore-checkpoint", "value"),
        State(f"{TAB}-job", "data"),
        *forms.selected(TAB),
        prevent_initial_call=True,
    )
    def ask(
        _: int,
        at: Any,
        scene: str,
        solvers: list[str],
        name: str,
        reference: int,
        query: int,
        checkpoint: str,
        last: str,
        *__: Any,
    ) -> Any:
        jobs.cancel(last)
        try:
            if ctx.triggered_id == "explore-at":
                known = jobs.result(scene)
                return jobs.submit(lambda: bench.place(known, at, solvers)), ""
            made = forms.choices()
            request = Request(made["solver"], made["start"], made["prior"], checkpoint)
            return jobs.submit(lambda: bench.scene(name, reference, query, request)), ""
        except UserError as error:
            return no_update, str(error)

    @app.callback(
        Output("explore-error", "children", allow_duplicate=True),
        Output("explore-scene", "data"),
        Output("explore-shown", "hidden"),
        Output("explore-views", "children"),
        Output("explore-landscape", "options"),
        Output("explore-landscape", "value"),
        Output("explore-view", "children"),
        Output("explore-place", "children"),
        Output("explore-chosen", "data"),
        Output("explore-radius", "value"),
        Input(f"{TAB}-done", "data"),
        prevent_initial_call=True,
    )
    def show(job: str) -> Any:
        try:
            found = jobs.result(job)
        except UserError as error:
            return str(error), *[no_update] * 9
        if isinstance(found, Place):
            view = forms.image((255 * found.view).round().astype("uint8"), "generated by the prior at this pose")
            return "", *[no_update] * 5, view, _place(found), job, no_update
        names, truth = list(found.pair.landscapes), found.pair.truth
        radius = 0.0 if truth is None else round(float(truth[2]), 2)  # the radius of the landscapes
        return "", job, False, _views(found), names, names[0], [], [], None, radius

    @app.callback(
        Output("explore-map-figure", "data"),
        Output("explore-surface-figure", "data"),
        Input("explore-landscape", "value"),
        Input("explore-chosen", "data"),
        Input("explore-scene", "data"),
        prevent_initial_call=True,
    )
    def draw(landscape: str | None, chosen: str | None, scene: str | None) -> Any:
        if landscape is None or scene is None:
            return no_update, no_update
        try:
            known, place = jobs.result(scene), jobs.result(chosen) if chosen else None
        except UserError:
            return no_update, no_update
        return tuple(map(forms.for_page, figures(known, landscape, place)))

    @app.callback(
        Output("explore-latitude", "value"),
        Output("explore-longitude", "value"),
        Input("explore-map", "clickData"),
        Input("explore-surface", "clickData"),
        prevent_initial_call=True,
    )
    def click(on_map: Any, on_surface: Any) -> tuple[float, float]:
        point = (on_map if ctx.triggered_id == "explore-map" else on_surface)["points"][0]
        return round(point["y"]), round(point["x"]) % 360

    @app.callback(
        Output("explore-at", "data"),
        Input("explore-latitude", "value"),
        Input("explore-longitude", "value"),
        Input("explore-radius", "value"),
        Input("explore-solvers", "value"),
        State("explore-scene", "data"),
        prevent_initial_call=True,
    )
    def at(latitude: float, longitude: float, radius: float, _: list[str], scene: str | None) -> Any:
        return no_update if scene is None else [math.radians(latitude), math.radians(longitude), radius]


def figures(scene: Scene, landscape: str, place: Place | None) -> tuple[go.Figure, go.Figure]:
    """The map and the surface of one of a scene's landscapes, with the trajectories from a place."""
    relief = scene.pair.landscapes[landscape]
    seen, raised = forms.landscape_plots(scene.pair, landscape)
    for (name, pair), colour in zip(place.solved.items() if place else (), cycle(COLOURS), strict=False):
        path = pair.ends if pair.trajectories is None else pair.trajectories[0]
        add_trajectory(seen, path, words(name), colour)
        add_trajectory(raised, path, words(name), colour, relief)
    add_targets(seen, relief)
    return seen, raised


def _views(scene: Scene) -> list[html.Figure]:
    reference, query, truth = scene.pair.reference, scene.pair.query, scene.pair.truth
    assert truth is not None  # views of a data set
    place = in_words(float(truth[0]), float(truth[1]))
    return [forms.image(reference.image, "the reference"), forms.image(query.image, f"the query; true pose: {place}")]


def _place(place: Place) -> list[Any]:
    """A place's energies, and where each solver ends from there."""
    latitude, longitude, radius = place.pose
    head = f"Latitude {math.degrees(latitude):.0f}°, longitude {math.degrees(longitude):.0f}°, radius {radius:.2f}"
    energies = [f"{name}: {value:.4g}" for name, value in place.energies.items()]
    ends = {name: end_of(pair) for name, pair in place.solved.items()}
    rows = [
        html.Tr([html.Th([html.I(style={"background": colour}), words(name)]), *map(html.Td, end)])
        for (name, end), colour in zip(ends.items(), cycle(COLOURS), strict=False)
    ]
    rows += [html.Tr([html.Th(words(name)), html.Td(why, colSpan=3)]) for name, why in place.refusals.items()]
    heads = ("descent from there by", "ends at", "rotation error", "energy")
    table = html.Table(
        [
            html.Thead(html.Tr([html.Th(heads[0]), *(html.Th(each, className="number") for each in heads[1:])])),
            html.Tbody(rows),
        ]
    )
    parts = [html.H3(head.replace("-", "\N{MINUS SIGN}")), html.P("; ".join(energies))]
    return [*parts, html.Div(table, className="scrolls")] if rows else parts


def end_of(pair: ShownPair) -> tuple[str, str, str]:
    """Where a solver ends, how far from the truth, and its energy there."""
    pair = pair.finite()
    number = pair.chosen
    if number is None:
        return "no pose", "", ""
    latitude, longitude, _ = pair.ends[number].tolist()
    return in_words(latitude, longitude), f"{pair.rotation_errors[number]:.0f}°", f"{pair.energies[number]:.4g}"
