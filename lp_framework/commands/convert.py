"""`convert`: an original Zero123 checkpoint, or a training run of this framework, to a folder of safetensors."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig

from lp_framework import registry
from lp_framework.errors import UserError
from lp_framework.models.checkpoints import FOLDER, find_checkpoint, read_checkpoint, write_model_folder
from lp_framework.priors.zero123.networks import DTYPES
from lp_framework.priors.zero123.weights import load_networks, write_folder


def run(config: DictConfig) -> None:
    """Read `path` (with `weights` and `dtype`) and write the folder `output`, which `prior.path` then takes.

    Of a training run that holds a pose model, `checkpoint` takes it.
    """
    registry.checked(load_networks, {"weights": config.weights, "dtype": config.dtype}, "")
    output = Path(config.output)
    if output.exists():
        raise UserError(f"output={output}: exists already; give another folder or remove it")
    run_folder = Path(config.path)
    if (run_folder / FOLDER).is_dir():
        write_model_folder(read_checkpoint(find_checkpoint(run_folder)), run_folder, output, DTYPES[config.dtype])
        print(f"converted: {output} (use it with checkpoint={output}, or prior=tiny prior.path={output})")
        return
    write_folder(load_networks(config.path, config.revision, config.weights, config.dtype), output)
    print(f"converted: {output} (use it with prior.path={output})")
