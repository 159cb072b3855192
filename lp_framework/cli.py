"""The command line: `python -m lp_framework COMMAND [overrides]`, also installed as `lp`.

Heavy imports wait until the command is known, so that the overview appears instantly.
"""

from __future__ import annotations

import importlib.metadata
import os
import signal
import sys
from typing import NoReturn

from lp_framework.errors import UserError, among, printable

COMMANDS = {  # the module of a command is lp_framework.commands.NAME
    "train": "Train a score, energy or matching model of the relative pose, or a prior",
    "eval": "Estimate the poses of a data set's test views and report recall, success rate and errors",
    "report": "Collect finished evaluations in tables and figures, beside the paper's numbers",
    "estimate": "Estimate the camera poses of photographs of one object",
    "views": "Generate novel views around an object with a prior",
    "landscape": "Show a prior's energy over relative poses: for a pair of views, or around each object",
    "figure": "Draw a figure of the paper with your own data, prior and models",
    "app": "Start the web app: photographs, landscapes and finished runs in a browser",
    "render": "Render meshes to views on disk",
    "convert": "Convert a Zero123 checkpoint or a training run into a folder of safetensors that loads in seconds",
    "bench": "Measure speed and memory side by side with simple baselines",
    "plugins": "List every model, prior, solver, ... with its origin and settings",
}

EXAMPLES = {
    "lp train": "train on the embedded objects",
    "lp train model=energy trainer.max_epochs=5": "choose another model and change a setting",
    "lp eval --multirun solver.gamma=0,0.3 start=ring,grid": "run every combination, each in its own folder",
    "lp train --help": "show the settings and choices of a command",
    "lp train --cfg job": "print the configuration without running",
    "lp plugins": "list everything that can be chosen",
}


def main() -> int:
    """Run the command of `sys.argv`.

    Returns the exit status: 0 for success, 1 for bad input, 2 for an invalid command line, 130 after Ctrl-C, and 143
    after SIGTERM, which `kill` and cluster schedulers send; it is handled like Ctrl-C.
    """
    stopped_by = signal.SIGINT

    def terminate(*_: object) -> NoReturn:
        nonlocal stopped_by
        stopped_by = signal.SIGTERM
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, terminate)
    command, *arguments = sys.argv[1:] or ["--help"]
    full_error = os.environ.get("HYDRA_FULL_ERROR") == "1"  # the user wants tracebacks
    try:
        if command in ("--help", "-h"):
            _print_overview()
        elif command == "--version":
            print(f"lp_framework {importlib.metadata.version('lp_framework')}")
        elif command not in COMMANDS:
            print(f"error: there is no command '{printable(command)}'{among(command, COMMANDS)}", file=sys.stderr)
            return 2
        elif command == "plugins":
            from lp_framework.commands import plugins

            plugins.main(arguments)
        else:
            from lp_framework import hydra_app

            hydra_app.run(command, arguments)
    except KeyboardInterrupt as stop:
        print(str(stop) or "interrupted", file=sys.stderr)
        return 128 + stopped_by
    except BrokenPipeError:  # the reader of the pipe, such as head, has exited
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except UserError as error:
        if full_error:
            raise
        print(f"error: {printable(str(error))}", file=sys.stderr)
        return error.status
    return 0


def _print_overview() -> None:
    print("lp_framework: the camera viewpoint between photographs of one object\n")
    print("Usage: python -m lp_framework COMMAND [key=value ...], or lp COMMAND ...\n")
    for title, rows in (("Commands", COMMANDS), ("Examples", EXAMPLES)):
        width = max(map(len, rows))
        print(f"{title}\n", *(f"  {left:{width}}  {right}" for left, right in rows.items()), "", sep="\n")
    print("Set HYDRA_FULL_ERROR=1 to see the traceback of an error.")
