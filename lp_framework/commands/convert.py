"""`convert`: turn an original Zero123 checkpoint, or a training run of this framework, into a safetensors folder."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig

from lp_framework import registry
from lp_framework.errors import UserError, one_line, optional_import
from lp_framework.evaluation.tables import write_text
from lp_framework.models.checkpoints import FOLDER, find_checkpoint, read_checkpoint, write_model_folder
from lp_framework.priors.zero123.networks import DTYPES
from lp_framework.priors.zero123.weights import load_networks, write_folder
from lp_framework.report.model_card import CARD, model_card


def run(config: DictConfig) -> None:
    """Read `path` (with `weights` and `dtype`) and write the folder `output`, for use as `prior.path`.

    If `path` is the training run of a pose model, use it as `checkpoint` instead.
    """
    registry.checked(load_networks, {"weights": config.weights, "dtype": config.dtype}, "")
    output = Path(config.output)
    if output.exists():
        raise UserError(f"output={output}: exists already; give another folder or remove it")
    run_folder = Path(config.path)
    if (run_folder / FOLDER).is_dir():
        card = model_card(run_folder, config.hub or output.name, config.license, config.results)
        write_model_folder(read_checkpoint(find_checkpoint(run_folder)), run_folder, output, DTYPES[config.dtype])
        write_text(output / CARD, card)
        print(f"converted: {output} (use it with checkpoint={output}, or prior=tiny prior.path={output})")
        if config.hub is not None:
            print(f"uploaded:  {upload(output, config.hub)}")
        return
    for key in ("results", "license", "hub"):
        if config[key] is not None:
            raise UserError(f"{key} belongs to a training run; {run_folder} is none")
    write_folder(load_networks(config.path, config.revision, config.weights, config.dtype), output)
    print(f"converted: {output} (use it with prior.path={output})")


def upload(folder: Path, hub_id: str) -> str:
    """Upload a folder to the Hugging Face hub, creating the repository if needed; returns its address."""
    hub = optional_import("huggingface_hub", f"hub={hub_id}", "pip install 'lp_framework[zero123]'")
    try:
        address = hub.create_repo(hub_id, exist_ok=True)
        hub.upload_folder(repo_id=hub_id, folder_path=folder)
    except (OSError, ValueError) as error:  # base classes of the hub's errors
        again = f"{folder} is written; `hf upload {hub_id} {folder}` tries again"
        raise UserError(f"hub={hub_id}: the upload failed ({one_line(error)}); {again}") from error
    return str(address)
