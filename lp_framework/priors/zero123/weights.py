"""Sources of Zero123's weights: a checkpoint of the training code, a diffusers folder, or the Hugging Face hub.

Published folders use two names for the pose projection and its tensors: `cc_projection` (`projection.weight`) and
`clip_camera_projection` (`proj.weight`).
"""

from __future__ import annotations

import json
import re
from pathlib import Path

from safetensors.torch import save_file

from lp_framework.data.files import expecting, read_json, written_folder
from lp_framework.errors import UserError, one_line
from lp_framework.priors.zero123.networks import Configs, Dtype, Networks, Weights, assemble, packages
from lp_framework.priors.zero123.original import Averages, read_original
from lp_framework.priors.zero123.tensor_files import StoredTensor, read_safetensors, read_state_dict

PARTS, PROJECTIONS = ("unet", "vae", "image_encoder"), ("cc_projection", "clip_camera_projection")
WEIGHT_FILES = [  # of diffusers and transformers, in order of preference
    f"{stem}{variant}.{suffix}"
    for suffix in ("safetensors", "safetensors.index.json", "bin")
    for variant in ("", ".fp16")
    for stem in ("diffusion_pytorch_model", "pytorch_model" if suffix == "bin" else "model")
]
OLD_VAE_NAMES = {"query": "to_q", "key": "to_k", "value": "to_v", "proj_attn": "to_out.0"}  # before diffusers 0.18
IGNORED = ("vision_model.embeddings.position_ids",)  # before transformers 4.31
HUB_ID = re.compile(r"[\w-][\w.-]*/[\w-][\w.-]*")


def load_networks(path: str, revision: str | None, weights: Averages, dtype: Dtype) -> Networks:
    """Load the networks from an original checkpoint file, a folder in diffusers' layout, or a hub id `owner/name`;
    raises `UserError` if the weights are unavailable or do not fit."""
    packages()
    place = Path(path)
    if not place.exists() and HUB_ID.fullmatch(path) and place.suffix not in (".ckpt", ".pt", ".pth"):
        place = download(path, revision)
    elif revision is not None:
        raise UserError(f"prior.revision={revision} is for ids of the Hugging Face hub, and {path} is a file")
    if not place.exists():
        raise UserError(
            f"{path}: there is no such file or folder; get 105000.ckpt or zero123-xl.ckpt from the authors of Zero123 "
            "and run `lp convert` on it (see Zero123 in the README), or give an id of the Hugging Face hub, owner/name"
        )
    if not place.is_dir():
        return assemble(path, *read_original(place, weights), dtype)
    if weights == "raw":
        raise UserError(f"{path}: is a folder, which holds one set of weights; prior.weights=raw is for a .ckpt file")
    return assemble(path, *read_folder(place), dtype)


def download(hub_id: str, revision: str | None) -> Path:
    """Download the config and the preferred weights file of each network; returns the local folder.

    If the hub does not respond, an earlier download is used; raises `UserError` if there is none.
    """
    from huggingface_hub import HfApi, snapshot_download

    try:
        names, needed = HfApi().list_repo_files(hub_id, revision=revision), []
        for part in (*PARTS, *PROJECTIONS):
            best = [f"{part}/{name}" for name in WEIGHT_FILES if f"{part}/{name}" in names]
            shards = [f"{part}/*.safetensors"] if best and best[0].endswith(".index.json") else []
            needed += [f"{part}/config.json", *best[:1], *shards]
        folder = snapshot_download(hub_id, revision=revision, allow_patterns=needed)
    except Exception as error:  # the hub's package has used several HTTP libraries, each with its own errors
        try:
            folder = snapshot_download(hub_id, revision=revision, local_files_only=True)
        except Exception:
            at = f" at revision {revision}" if revision else ""
            raise UserError(
                f"{hub_id}: no such file or folder, and the Hugging Face hub does not provide it{at} "
                f"({one_line(error)}); set prior.path to a checkpoint file or a folder that you have"
            ) from error
    return Path(folder)


def read_folder(path: Path) -> tuple[Configs, Weights]:
    """Read configs and tensors of the four networks in a folder; `UserError` if a file is missing or unreadable."""
    projection = next((path / name for name in PROJECTIONS if (path / name).is_dir()), None)
    if projection is None:
        raise UserError(f"{path}: holds no pose projection, a folder {' or '.join(PROJECTIONS)}")
    weights = {part: _weights(path / part) for part in PARTS}
    old = re.compile(rf"(\.attentions\..*\.)({'|'.join(OLD_VAE_NAMES)})(?=\.\w+$)")
    vae = weights["vae"].items()
    weights["vae"] = {old.sub(lambda found: found[1] + OLD_VAE_NAMES[found[2]], name): each for name, each in vae}
    weights["cc_projection"] = {name.partition(".")[2]: stored for name, stored in _weights(projection).items()}
    return {part: read_json(path / part / "config.json") for part in PARTS}, weights


def _weights(folder: Path) -> dict[str, StoredTensor]:
    file = next((folder / name for name in WEIGHT_FILES if (folder / name).is_file()), None)
    if file is None:
        raise UserError(f"{folder}: holds no weights; looked for {', '.join(WEIGHT_FILES)}")
    read = read_state_dict if file.suffix == ".bin" else read_safetensors
    files = [file]
    if file.suffix == ".json":  # the index of sharded weights
        with expecting(f"{file}: names no files of weights; download it again"):
            files = [file.with_name(name) for name in sorted({*read_json(file)["weight_map"].values()})]
    tensors = {name: stored for each in files for name, stored in read(each).items()}
    return {name: stored for name, stored in tensors.items() if name not in IGNORED}


def write_folder(networks: Networks, path: Path) -> None:
    """Write the networks atomically as safetensors in diffusers' layout (`cc_projection`); `UserError` on failure."""
    projection = networks.cc_projection
    sizes = {"in_channel": projection.in_features, "out_channel": projection.out_features}
    tensors = {f"projection.{name}": tensor for name, tensor in projection.state_dict().items()}
    with written_folder(path) as partial:
        for part in PARTS:
            getattr(networks, part).save_pretrained(partial / part)
        folder = partial / "cc_projection"
        folder.mkdir()
        (folder / "config.json").write_text(json.dumps({"_class_name": "CCProjection", **sizes}, indent=2) + "\n")
        save_file(tensors, folder / "diffusion_pytorch_model.safetensors", metadata={"format": "pt"})
