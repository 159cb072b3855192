"""Where Zero123's weights come from: a checkpoint of the training code, a diffusers folder, the Hugging Face hub."""

from __future__ import annotations

import re
from pathlib import Path

from lp_framework.errors import UserError
from lp_framework.priors.zero123 import folders
from lp_framework.priors.zero123.networks import Dtype, Networks, assemble, require_packages
from lp_framework.priors.zero123.original import Averages, read_original

HUB_ID = re.compile(r"[\w-][\w.-]*/[\w-][\w.-]*")


def load_networks(path: str, revision: str | None, weights: Averages, dtype: Dtype) -> Networks:
    """The networks of an original checkpoint file, of a folder in diffusers' layout, or of a hub id `owner/name`.

    `weights` chooses between a checkpoint's moving averages and its raw weights; a folder holds one of them, chosen
    when it was made. Raises `UserError` where the weights cannot be had or do not fit.
    """
    require_packages()
    place = Path(path)
    if place.is_dir():
        if not folders.is_folder(place):
            raise UserError(f"{path}: is no folder of Zero123 in diffusers' layout, it holds no unet/config.json")
    elif not place.exists() and HUB_ID.fullmatch(path) and place.suffix not in (".ckpt", ".pt", ".pth"):
        place = download(path, revision)
    elif revision is not None:
        raise UserError(f"prior.revision={revision} is for ids of the Hugging Face hub, and {path} is a file")
    if place.is_dir():
        if weights == "raw":
            raise UserError(
                f"{path}: is a converted folder, which holds one set of weights; prior.weights=raw is for a .ckpt file"
            )
        return assemble(path, *folders.read_folder(place), dtype)
    return assemble(path, *read_original(place, weights), dtype)


def download(hub_id: str, revision: str | None) -> Path:
    """The local folder of a hub repository: of each network its config and the best file of its weights.

    What has been downloaded before is used without asking, where there is no network. Raises `UserError` otherwise.
    """
    from huggingface_hub import HfApi, snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError

    try:
        names = HfApi().list_repo_files(hub_id, revision=revision)
        folder = snapshot_download(hub_id, revision=revision, allow_patterns=_needed(names))
    except HFValidationError as error:
        raise UserError(f"{hub_id}: is neither a file, nor a folder, nor an id of the Hugging Face hub") from error
    except HfHubHTTPError as error:
        status = error.response.status_code if error.response is not None else "no"
        at = f" at revision {revision}" if revision else ""
        raise UserError(
            f"{hub_id}: no such file or folder, and the Hugging Face hub does not give it{at} (answer {status})"
        ) from error
    except Exception as error:  # no network: each HTTP library that the hub's package has used tells it its own way
        try:
            folder = snapshot_download(hub_id, revision=revision, local_files_only=True)
        except (LocalEntryNotFoundError, OSError):
            raise UserError(
                f"{hub_id}: no such file or folder, and the Hugging Face hub cannot be reached; "
                "give prior.path= a checkpoint file or a folder that you have"
            ) from error
    path = Path(folder)
    if not folders.is_folder(path):
        raise UserError(f"{hub_id}: is no repository of Zero123 in diffusers' layout, it holds no unet/config.json")
    return path


def _needed(names: list[str]) -> list[str]:
    """Of a repository's files those that loading reads."""
    needed = []
    for part in ("unet", "vae", "image_encoder", *folders.PROJECTIONS):
        best = [f"{part}/{name}" for name in folders.weight_files(part) if f"{part}/{name}" in names]
        needed += [f"{part}/config.json", *best[:1]]
    return needed
