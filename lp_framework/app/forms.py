"""Parts that the tabs share: choices with their settings from `conf/`, the progress of a request, images and plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import plotly.graph_objects as go
import yaml
from dash import ALL, MATCH, Dash, Input, Output, State, ctx, dcc, html, no_update
from numpy.typing import NDArray
from omegaconf import OmegaConf

from lp_framework import catalogue
from lp_framework.analysis.pairs import ShownPair
from lp_framework.app.jobs import Jobs
from lp_framework.app.workbench import Choice
from lp_framework.errors import UserError
from lp_framework.report.page import picture
from lp_framework.report.plots import map_plot, surface_plot

# Settings that only the command line offers (files of the machine that runs the app) or that the app decides.
NOT_OFFERED = ("name", "path", "weights", "trajectory")
SIDE = 256  # pixels of an image
TICK = 400  # milliseconds between updates of a request's progress


def field(label: str, *content: Any) -> html.Div:
    """A labelled part of a form."""
    return html.Div([html.Label(label), *content], className="field")


def choice(tab: str, group: str, label: str, value: str, names: Sequence[str]) -> html.Div:
    """A dropdown of a group's choices, with the chosen one's settings collapsed."""
    key = {"tab": tab, "group": group}
    settings = html.Details([html.Summary("settings"), html.Div(id={**key, "part": "settings"})], className="settings")
    dropdown = dcc.Dropdown(list(names), value, id={**key, "part": "choice"}, clearable=False, searchable=False)
    return field(label, dropdown, html.Small(id={**key, "part": "summary"}), settings)


def settings_of(tab: str, group: str, name: str) -> list[Any]:
    """An input for each setting of a choice, with the comment from its YAML file."""
    rows: list[Any] = []
    for key, block in catalogue.read(f"{group}/{name}").settings.items():
        value, _, comment = block[-1].partition(": ")[2].partition(" # ")
        if key in NOT_OFFERED or (len(block) > 1 and not block[0].startswith("#")):
            continue
        comment = comment or " ".join(line.strip("# ") for line in block[:-1])
        identity = {"tab": tab, "group": group, "setting": key}
        rows.append(field(key, dcc.Input(value.strip(), id=identity, debounce=True), html.Small(comment)))
    return rows or [html.Small("It has no settings.")]


def chosen(group: str, name: str, states: Sequence[Mapping[str, Any]]) -> Choice:
    """A choice with the inputs that differ from its YAML file; `UserError` for an invalid value."""
    own, settings = catalogue.values(group, name), {}
    for state in states:
        key, text = state["id"]["setting"], state["value"]
        try:
            read: Any = OmegaConf.to_container(OmegaConf.create(f"{key}: {text}"))
        except yaml.YAMLError as error:
            raise UserError(f"{group}, {key}: '{text}' is not a number, word or [list]") from error
        if key in own and read[key] != own[key]:
            settings[key] = read[key]
    return Choice(name, settings)


def progress(tab: str) -> html.Div:
    """The progress bar and cancel button of a tab's request; hidden while nothing runs."""
    return html.Div(
        [
            html.Progress(id=f"{tab}-bar", max="1"),
            html.Span(id=f"{tab}-step", role="status"),
            html.Button("Cancel", id=f"{tab}-cancel", className="quiet"),
            dcc.Interval(id=f"{tab}-tick", interval=TICK, disabled=True),
            dcc.Store(id=f"{tab}-job"),
            dcc.Store(id=f"{tab}-done"),
        ],
        id=f"{tab}-progress",
        className="progress",
        hidden=True,
    )


def register_choices(app: Dash) -> None:
    """Update the summary and the settings when another choice is made."""

    @app.callback(
        Output({"tab": MATCH, "group": MATCH, "part": "settings"}, "children"),
        Output({"tab": MATCH, "group": MATCH, "part": "summary"}, "children"),
        Input({"tab": MATCH, "group": MATCH, "part": "choice"}, "value"),
    )
    def fill(name: str) -> tuple[list[Any], str]:
        tab, group = ctx.outputs_grouping[0]["id"]["tab"], ctx.outputs_grouping[0]["id"]["group"]
        return settings_of(tab, group, name), catalogue.read(f"{group}/{name}").summary


def register_progress(app: Dash, jobs: Jobs, tab: str) -> None:
    """Follow a tab's request: `TAB-job` holds its name; `TAB-done` receives it when the request ends."""
    # Dash does not allow circular callbacks; the interval breaks the circle.
    app.clientside_callback(
        "(job) => [job === null, job === null]",
        Output(f"{tab}-progress", "hidden"),
        Output(f"{tab}-tick", "disabled"),
        Input(f"{tab}-job", "data"),
        prevent_initial_call=True,
    )

    @app.callback(
        Output(f"{tab}-progress", "hidden", allow_duplicate=True),
        Output(f"{tab}-tick", "disabled", allow_duplicate=True),
        Output(f"{tab}-bar", "value"),
        Output(f"{tab}-step", "children"),
        Output(f"{tab}-done", "data"),
        Input(f"{tab}-tick", "n_intervals"),
        State(f"{tab}-job", "data"),
        prevent_initial_call=True,
    )
    def follow(_: int, job: str) -> tuple[bool, bool, str | None, str, Any]:
        if jobs.is_done(job):
            return True, True, None, "", job
        share, step = jobs.state(job)
        return False, False, f"{share:.3f}", step, no_update

    @app.callback(
        Output(f"{tab}-cancel", "n_clicks"),
        Input(f"{tab}-cancel", "n_clicks"),
        State(f"{tab}-job", "data"),
        prevent_initial_call=True,
    )
    def cancel(_: int, job: str) -> Any:
        jobs.cancel(job)
        return no_update


def folded(title: str, content: Sequence[Any]) -> html.Details:
    """A collapsed part of a form whose defaults suit most visitors."""
    return html.Details([html.Summary(title), html.Div(content, className="form")], className="method")


def slider(label: str, name: str, steps: tuple[float, float, float], marks: Mapping[float, str]) -> html.Div:
    """A slider with `steps` (minimum, maximum, step), initially 0."""
    named = {value: text.replace("-", "\N{MINUS SIGN}") for value, text in marks.items()}
    return field(label, dcc.Slider(*steps, value=0, marks=named, id=name))


def image(pixels: NDArray, caption: str) -> html.Figure:
    """An image `[H, W, 3 or 4]` (uint8) above its caption."""
    return html.Figure([html.Img(src=picture(pixels, SIDE), alt=caption), html.Figcaption(caption)], className="view")


def plot(name: str, height: int) -> html.Figure:
    """A plot of the figure in the store `NAME-figure`, in the page's colours; see `register_plot`."""
    graph = dcc.Graph(id=name, config={"displaylogo": False, "displayModeBar": False}, style={"height": f"{height}px"})
    return html.Figure([dcc.Store(id=f"{name}-figure"), graph])


def register_plot(app: Dash, name: str) -> None:
    """Draw `NAME-figure` with the page's CSS variables resolved."""
    app.clientside_callback(
        "(figure) => window.inPageColours(figure)", Output(name, "figure"), Input(f"{name}-figure", "data")
    )


def for_page(figure: go.Figure) -> dict[str, Any]:
    """A figure as JSON for `plot`, without the animation of the static page."""
    content: dict[str, Any] = figure.update_layout(meta=None).to_plotly_json()
    return content


def landscape_plots(pair: ShownPair, landscape: str) -> tuple[go.Figure, go.Figure]:
    """The map and the surface of one of a pair's landscapes, by name, with the trajectories of its starts."""
    pair = replace(pair, landscapes={landscape: pair.landscapes[landscape]})
    return map_plot(pair), surface_plot(pair)


def selected(tab: str) -> list[State]:
    """The callback states that hold a tab's choices and their settings; see `choices`."""
    return [
        State({"tab": tab, "group": ALL, "part": "choice"}, "value"),
        State({"tab": tab, "group": ALL, "setting": ALL}, "value"),
    ]


def choices() -> dict[str, Choice]:
    """The choices by group, read from the states of `selected` inside a callback; `UserError` as in `chosen`."""
    states = [state for states in ctx.states_list if isinstance(states, list) for state in states]
    names = {state["id"]["group"]: state["value"] for state in states if "part" in state["id"]}
    settings = [state for state in states if "setting" in state["id"]]
    return {
        group: chosen(group, name, [state for state in settings if state["id"]["group"] == group])
        for group, name in names.items()
    }
