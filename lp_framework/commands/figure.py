"""`figure`: a figure of the paper, for any data, prior and models."""

from __future__ import annotations

from omegaconf import DictConfig
from rich.console import Console

from lp_framework.commands.building import begin
from lp_framework.evaluation.tables import write_json
from lp_framework.figures.base import PaperFigure
from lp_framework.solvers.progress import shown_progress
from lp_framework.viz.style import save_figure


def run(config: DictConfig) -> None:
    """Write `figure_NAME.png` and `.pdf` into this run's folder, and `figure.json` with its caption."""
    folder, device, components = begin(config)
    figure: PaperFigure = components["figure"]
    if "data" in components.needs("figure"):
        components.test_views()
    for part in figure.networks():
        part.to(device)
    with shown_progress():
        drawn, caption = figure.draw(figure.analyse(config.seed, device))
    files = save_figure(drawn, folder / f"figure_{config.figure.name}")
    record = {"files": [file.name for file in files], "caption": caption, **components.record()}
    write_json(folder / "figure.json", record)
    console = Console(soft_wrap=True, highlight=False)
    console.print(f"caption: {caption}", markup=False)
    console.print(f"picture: {files[0]}, {files[1].name}", markup=False)
