"""`render`: meshes to views on disk."""

from __future__ import annotations

from omegaconf import DictConfig

from lp_framework import registry
from lp_framework.commands.building import Components, plain
from lp_framework.data.sets.rendered import RenderedData
from lp_framework.errors import UserError


def run(config: DictConfig) -> None:
    """Render the objects of `data` not rendered yet."""
    source = Components(plain(config))["data"].source
    if not isinstance(source, RenderedData):
        choices = [name for name in registry.names("data") if issubclass(registry.get("data", name), RenderedData)]
        raise UserError(f"data={config.data.name} has no meshes to render; choose one of {', '.join(choices)}")
    source.prepare(check_meshes=True)
    print(f"views: {source.path}")
