"""A journal of an evaluation's results, from which an interrupted run resumes.

    <run>/unfinished/evaluation.json     what is evaluated: configuration, checkpoint, fingerprints; and the versions
    <run>/unfinished/rank_0.jsonl ...    one checksummed line per batch of pairs, one file per process

The folder exists while the evaluation is unfinished. If a line is truncated or altered, its checksum does not match,
and its pairs are solved again. JSON round-trips numbers exactly, including NaN.
"""

from __future__ import annotations

import json
import os
import shutil
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lp_framework.atomic import writing
from lp_framework.data.files import read_record
from lp_framework.errors import UserError
from lp_framework.evaluation.metrics import SolvedBatch
from lp_framework.evaluation.tables import RESULT, write_text

FOLDER = "unfinished"
SUBJECT = "evaluation.json"
# Settings that may change when resuming.
MOVABLE = ("trainer.accelerator", "trainer.devices", "trainer.num_nodes", "trainer.strategy", "pictures")


class Journal:
    """The journal of the run in `folder`; `subject` describes the evaluation by nested names and numbers."""

    def __init__(self, folder: Path, subject: Mapping[str, Any]) -> None:
        self.folder, self.run, self.subject = folder / FOLDER, folder, dict(subject)

    def begin(self, views: str) -> list[SolvedBatch]:
        """Return the batches solved before on data with the fingerprint `views`, or start a new journal and remove the
        results of a finished evaluation. Raises `UserError` for a journal of another evaluation."""
        now = {**self.subject, "views": views}
        if to_resume(self.run, now) is not None:
            return list(self._read())
        shutil.rmtree(self.folder, ignore_errors=True)
        (self.run / RESULT).unlink(missing_ok=True)
        self.folder.mkdir(parents=True)
        write_text(self.folder / SUBJECT, json.dumps(now, indent=2) + "\n")
        return []

    def append(self, batch: SolvedBatch, rank: int) -> None:
        """Save a batch solved by the process of this rank; it is on disk when this returns."""
        fields = batch._asdict().items()
        values = {name: each.tolist() if isinstance(each, torch.Tensor) else each for name, each in fields}
        text = json.dumps(values, separators=(",", ":")).encode()
        line = b"%08x %s\n" % (zlib.crc32(text), text)
        path = self.folder / f"rank_{rank}.jsonl"
        with writing(path), path.open("ab+") as file:
            if file.tell() > 0:
                file.seek(-1, os.SEEK_END)
                line = line if file.read(1) == b"\n" else b"\n" + line  # after a truncated line
            file.write(line)
            file.flush()
            os.fsync(file.fileno())

    def finish(self) -> None:
        """Remove the journal, once all results are written."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _read(self) -> Iterator[SolvedBatch]:
        for file in sorted(self.folder.glob("rank_*.jsonl")):
            for line in file.read_bytes().split(b"\n"):
                checksum, _, text = line.partition(b" ")
                if checksum == b"%08x" % zlib.crc32(text):
                    # NumPy converts lists of numbers to 64-bit arrays.
                    values: dict[str, Any] = {
                        name: torch.from_numpy(np.array(value)) if isinstance(value, list) else value
                        for name, value in json.loads(text).items()
                    }
                    yield SolvedBatch(**values)


def unfinished(folder: Path) -> dict[str, Any] | None:
    """The subject of the unfinished evaluation in a run's folder, or None if there is none."""
    subject = read_record(folder / FOLDER / SUBJECT)
    whole = isinstance(subject.get("config"), dict) and isinstance(subject.get("checkpoint", ...), str | None)
    return subject if whole else None


def to_resume(folder: Path, subject: Mapping[str, Any]) -> dict[str, Any] | None:
    """The subject of the `unfinished` evaluation if it contains `subject`, otherwise None. Raises `UserError` for
    another evaluation with solved batches."""
    before = unfinished(folder)
    changed = "" if before is None else changes(before, subject)
    if changed and any((folder / FOLDER).glob("rank_*.jsonl")):
        raise UserError(
            f"{folder}: contains another unfinished evaluation ({changed}); "
            f"choose another folder or remove {folder / FOLDER}"
        )
    return None if changed else before


def changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Describe up to three changes of a subject that affect results; empty if there are none.

    Keys missing from `now` count as unchanged, and a setting missing on one side counts as off there.

    >>> changes({"config": {"seed": 1, "solver": {"gamma": 0.3}}}, {"config": {"seed": 1, "solver": {"gamma": 0}}})
    'solver.gamma was 0.3, is 0'
    """
    there, here = _compared(before), _compared({**before, **now})
    found = []
    for key in sorted({*there, *here}):
        one, other = there.get(key), here.get(key)
        if one != other and ((key in there and key in here) or one or other):
            found.append(f"different {key}" if key in ("views", "weights") else f"{key} was {one}, is {other}")
    return "; ".join(found[:3])


def _compared(subject: Mapping[str, Any]) -> dict[str, Any]:
    """A subject by dotted keys, without settings that do not affect results."""
    left_out = {"plugins", "resume", "checkpoint", *MOVABLE}
    settings = {key: value for key, value in dotted(subject["config"]).items() if key not in left_out}
    return settings | {key: value for key, value in subject.items() if key not in ("config", "versions")}


def dotted(config: Mapping[str, Any]) -> dict[str, Any]:
    """Flatten a config to dotted keys; a list is one value.

    >>> dotted({"seed": 1, "start": {"name": "ring", "count": 4}})
    {'seed': 1, 'start.name': 'ring', 'start.count': 4}
    """
    found: dict[str, Any] = {}
    for key, value in config.items():
        if isinstance(value, Mapping):
            found |= {f"{key}.{name}": each for name, each in dotted(value).items()}
        else:
            found[str(key)] = value
    return found
