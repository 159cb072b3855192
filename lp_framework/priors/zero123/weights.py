"""Where Zero123's weights come from: a checkpoint of the training code, a diffusers folder, the Hugging Face hub."""

from __future__ import annotations

import re
from pathlib import Path

from lp_framework.errors import UserError, one_line
from lp_framework.priors.zero123 import folders
from lp_framework.priors.zero123.networks import Dtype, Networks, assemble, packages
from lp_framework.priors.zero123.original import Averages, read_original

HUB_ID = re.compile(r"[\w-][\w.-]*/[\w-][\w.-]*")


def load_networks(path: str, revision: str | None, weights: Averages, dtype: Dtype) -> Networks:
    """The networks of an original checkpoint file, of a folder in diffusers' layout, or of a hub id `owner/name`.

    `weights` chooses between a checkpoint's moving averages and its raw weights; a folder holds one of them, chosen
    when it was made. Raises `UserError` where the weights cannot be had or do not fit.
    """
    packages()
    place = Path(path)
    if not place.exists() and HUB_ID.fullmatch(path) and place.suffix not in (".ckpt", ".pt", ".pth"):
        place = download(path, revision)
    elif revision is not None:
        raise UserError(f"prior.revision={revision} is for ids of the Hugging Face hub, and {path} is a file")
    if not place.is_dir():
        return assemble(path, *read_original(place, weights), dtype)
    if not (place / "unet" / "config.json").is_file():
        raise UserError(f"{path}: is no folder of Zero123 in diffusers' layout, it holds no unet/config.json")
    if weights == "raw":
        raise UserError(f"{path}: is a folder, which holds one set of weights; prior.weights=raw is for a .ckpt file")
    return assemble(path, *folders.read_folder(place), dtype)


def download(hub_id: str, revision: str | None) -> Path:
    """The local folder of a hub repository: of each network its config and the best file of its weights.

    Without an answer, what has been downloaded before is used. Raises `UserError` where there is none.
    """
    from huggingface_hub import HfApi, snapshot_download

    try:
        needed = _needed(HfApi().list_repo_files(hub_id, revision=revision))
        folder = snapshot_download(hub_id, revision=revision, allow_patterns=needed)
    except Exception as error:  # each HTTP library that the hub's package has used tells it its own way
        try:
            folder = snapshot_download(hub_id, revision=revision, local_files_only=True)
        except Exception:
            at = f" at revision {revision}" if revision else ""
            raise UserError(
                f"{hub_id}: no such file or folder, and the Hugging Face hub does not give it{at} ({one_line(error)}); "
                "give prior.path= a checkpoint file or a folder that you have"
            ) from error
    return Path(folder)


def _needed(names: list[str]) -> list[str]:
    """Of a repository's files those that loading reads."""
    needed = []
    for part in (*folders.PARTS, *folders.PROJECTIONS):
        best = [f"{part}/{name}" for name in folders.WEIGHT_FILES if f"{part}/{name}" in names]
        needed += [f"{part}/config.json", *best[:1]]
    return needed
