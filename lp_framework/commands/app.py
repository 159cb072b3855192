"""`app`: the web app, served until Ctrl-C."""

from __future__ import annotations

import logging
import socket
from pathlib import Path

import torch
from omegaconf import DictConfig

from lp_framework.analysis.fields import Draws
from lp_framework.commands.building import begin
from lp_framework.errors import UserError, optional_import

TIMESTEPS = (100, 300, 500, 700, 900)  # a prior's energy averages over these, with one noise each, as in `landscape`
RADIUS = 1.4  # of the first camera, as in `estimate`


def run(config: DictConfig) -> None:
    """Print the address and serve the app."""
    optional_import("dash", "app", "pip install 'lp_framework[app]'")
    from werkzeug.serving import make_server

    from lp_framework.app.jobs import Jobs
    from lp_framework.app.server import make_app
    from lp_framework.app.visitors import Visitors
    from lp_framework.app.workbench import Choice, Workbench

    most = config.upload_megabytes
    if not isinstance(most, int | float) or not most > 0:
        raise UserError(f"upload_megabytes must be a positive number, got {most}")
    _, device, components = begin(config)
    data = components["data"]
    data.evaluate_on("ordered", config.seed)
    settings = dict(components.settings["prior"])
    first = torch.tensor([0.0, 0.0, RADIUS], dtype=torch.float64)
    draws = Draws(TIMESTEPS, noises=1, seed=config.seed)
    bench = Workbench(device, data, Choice(settings.pop("name"), settings), draws, first, config.seed)
    jobs, visitors = Jobs(), Visitors()
    planned = config.data.get("test_views")  # None: the views already exist
    views = {name: planned or len(data.source.views(name, "test")) for name in data.source.names()}
    app = make_app(bench, jobs, visitors, config.object, views, Path(config.folder), most)
    logging.getLogger("werkzeug").setLevel(logging.ERROR)  # else it prints a line per request
    try:
        listening = socket.create_server((config.host, config.port))
    except (OSError, OverflowError, TypeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"host={config.host} port={config.port}: the app cannot listen there ({reason})") from error
    port = listening.getsockname()[1]
    print(f"app: http://{config.host}:{port} (Ctrl-C ends it)", flush=True)
    try:
        make_server(config.host, port, app.server, threaded=True, fd=listening.fileno()).serve_forever()
    finally:
        jobs.close()
        visitors.close()
