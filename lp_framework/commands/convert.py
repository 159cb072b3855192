"""`convert`: turn an original Zero123 checkpoint, or a training run of this framework, into a safetensors folder."""

from __future__ import annotations

import logging
from pathlib import Path

from omegaconf import DictConfig

from lp_framework import registry
from lp_framework.errors import UserError, one_line, optional_import
from lp_framework.evaluation.tables import write_text
from lp_framework.models.checkpoints import FOLDER, find_checkpoint, read_checkpoint, write_model_folder
from lp_framework.priors.zero123.networks import DTYPES
from lp_framework.priors.zero123.weights import load_networks, write_folder
from lp_framework.report.model_card import CARD, model_card

log = logging.getLogger(__name__)

CARD_SETTINGS = ("results", "license", "hub")  # settings for models that are shared


def run(config: DictConfig) -> None:
    """Read `path` (with `weights` and `dtype`) and write the folder `output`, for use as `prior.path`.

    For the training run of a pose model, `output` is for use as `checkpoint`, with a model card if the run is complete.
    """
    registry.checked(load_networks, {"weights": config.weights, "dtype": config.dtype}, "")
    output = Path(config.output)
    if output.exists():
        raise UserError(f"output={output}: already exists; choose another folder or remove it")
    run_folder = Path(config.path)
    if (run_folder / FOLDER).is_dir():
        card = _card(run_folder, config)
        write_model_folder(read_checkpoint(find_checkpoint(run_folder)), run_folder, output, DTYPES[config.dtype])
        if card is not None:
            write_text(output / CARD, card)
        print(f"converted: {output} (use it with checkpoint={output}, or prior=tiny prior.path={output})")
        if config.hub is not None:
            print(f"uploaded:  {upload(output, config.hub)}")
        return
    for key in CARD_SETTINGS:
        if config[key] is not None:
            raise UserError(f"{key} applies only to training runs, and {run_folder} is not one")
    write_folder(load_networks(config.path, config.revision, config.weights, config.dtype), output)
    print(f"converted: {output} (use it with prior.path={output})")


def _card(run_folder: Path, config: DictConfig) -> str | None:
    """The model card; None, with a warning, if the run is unfinished and no setting requests a card."""
    requested = any(config[key] is not None for key in CARD_SETTINGS)
    try:
        return model_card(run_folder, config.hub or Path(config.output).name, config.license, config.results)
    except UserError as error:
        if requested:
            raise
        log.warning("%s", error)
        return None


def upload(folder: Path, hub_id: str) -> str:
    """Upload a folder to the Hugging Face hub, creating the repository if needed; returns its address."""
    hub = optional_import("huggingface_hub", f"hub={hub_id}", "pip install 'lp_framework[zero123]'")
    try:
        address = hub.create_repo(hub_id, exist_ok=True)
        hub.upload_folder(repo_id=hub_id, folder_path=folder)
    except (OSError, ValueError) as error:  # base classes of the hub's errors
        again = f"{folder} is written; to retry: `hf upload {hub_id} {folder}`"
        raise UserError(f"hub={hub_id}: the upload failed ({one_line(error)}); {again}") from error
    return str(address)
