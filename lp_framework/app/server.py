"""The app: its page, its tabs and its server."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any
from urllib.parse import quote

from dash import Dash, Input, Output, dcc, html
from flask import Response, abort, send_from_directory

from lp_framework.app import estimate, explore, forms
from lp_framework.app.jobs import Jobs
from lp_framework.app.visitors import Visitors
from lp_framework.app.workbench import Workbench
from lp_framework.models.checkpoints import SHIPPED, WEIGHTS
from lp_framework.report.page import PAGE

TABS = ("Estimate", "Explore", "Runs")
UNREACHABLE = "The app does not answer. If it has ended, start it again and reload this page."
MOST_RUNS = 200  # pages listed, newest first
HTML = """<!DOCTYPE html>
<html lang="en">
<head>
{{%metas%}}
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<link rel="icon" href="data:,">
<title>{{%title%}}</title>
{{%css%}}
<style>{style}</style>
<script>{script}</script>
</head>
<body>
{{%app_entry%}}
<footer>{{%config%}}{{%scripts%}}{{%renderer%}}</footer>
</body>
</html>
"""


def make_app(
    bench: Workbench, jobs: Jobs, visitors: Visitors, first: str, views: Mapping[str, int], runs: Path, megabytes: float
) -> Dash:
    """Make the app. `views` are the numbers of test views by object, `first` is the object shown first, `runs` is the
    folder of finished runs, `megabytes` the limit of one upload."""
    app = Dash("lp_framework", title="lp_framework", update_title="", assets_folder="")
    style = _text("report/templates/page.css") + _text("app/app.css")
    app.index_string = HTML.format(style=style, script=_text("app/app.js"))
    app.server.config["MAX_CONTENT_LENGTH"] = int(megabytes * 2**20 * 1.4)  # base64 takes more
    prior = bench.own_prior.name
    checkpoints = sorted(file.parent.name for file in SHIPPED.glob(f"*/{WEIGHTS}") if file.parent.name != "tiny")

    def page() -> html.Div:
        parts = (
            estimate.layout(list(views), checkpoints, prior),
            explore.layout(views, first, checkpoints, prior),
            _runs(runs),
        )
        names = [dcc.Tab(label=name, value=name) for name in TABS]
        return html.Div(
            [
                html.Header(
                    [html.H1("lp_framework"), html.P("The camera viewpoint between photographs of one object")]
                ),
                dcc.Store(id="visitor", data=secrets.token_urlsafe(16)),
                html.Main(
                    [
                        html.P(UNREACHABLE, className="error connection", role="alert"),
                        dcc.Tabs(names, TABS[0], id="tabs", mobile_breakpoint=0),
                        # Hidden tabs stay in the page, so that they keep their state.
                        *(
                            html.Div(content, id=f"tab-{name}", hidden=True)
                            for name, content in zip(TABS, parts, strict=True)
                        ),
                    ]
                ),
            ]
        )

    app.layout = page
    app.clientside_callback(
        f"(chosen) => window.shownTab(chosen, {list(TABS)})",
        *(Output(f"tab-{name}", "hidden") for name in TABS),
        Input("tabs", "value"),
    )
    forms.register_choices(app)
    estimate.register(app, jobs, bench, visitors)
    explore.register(app, jobs, bench, views)

    @app.server.errorhandler(413)
    def too_large(_: Exception) -> dict[str, Any]:
        """Answer an upload in Dash's format, in place of the callback."""
        sentence = f"these files are larger than {megabytes:g} MB together; upload fewer or smaller ones"
        emptied = {part: {"contents": None} for part in ("photographs", "masks")}
        return {"multi": True, "response": {"estimate-error": {"children": sentence}, **emptied}}

    @app.server.route("/runs/<path:file>")
    def run_page(file: str) -> Response:
        return send_from_directory(runs.absolute(), file) if Path(file).name == PAGE else abort(404)

    return app


def _runs(folder: Path) -> html.Div:
    """Links to the pages of finished runs, newest first."""
    pages = sorted(folder.rglob(PAGE), key=lambda file: file.stat().st_mtime, reverse=True)[:MOST_RUNS]
    links = [
        html.Li(html.A(str(page.parent), href=f"/runs/{quote(page.relative_to(folder).as_posix())}", target="_blank"))
        for page in pages
    ]
    none = html.P(f"There is no finished run with a page in {folder}.", className="note")
    return html.Div(html.Ul(links, className="runs") if links else none)


def _text(file: str) -> str:
    return resources.files("lp_framework").joinpath(file).read_text(encoding="utf-8")
