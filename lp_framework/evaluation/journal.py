"""An evaluation's results as they come, from which a killed run goes on.

    <run>/unfinished/evaluation.json     what is evaluated: configuration, checkpoint, fingerprints; and the versions
    <run>/unfinished/rank_0.jsonl ...    a line a batch of pairs, behind its checksum; a file a process

The folder is there while the evaluation is unfinished. A line that a kill cut short, or that was altered, does not
match its checksum, and its pairs are solved again. JSON keeps every bit of a number, NaN included.
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
# What may change on the way.
MOVABLE = ("trainer.accelerator", "trainer.devices", "trainer.num_nodes", "trainer.strategy", "pictures")


class Journal:
    """The journal of the run in `folder`, of an evaluation that `subject` describes: names and numbers, nested."""

    def __init__(self, folder: Path, subject: Mapping[str, Any]) -> None:
        self.folder, self.run, self.subject = folder / FOLDER, folder, dict(subject)

    def begin(self, views: str) -> list[SolvedBatch]:
        """What has been solved before, of data with the fingerprint `views`; else the journal is begun and the results
        of a finished evaluation are removed. `UserError` for a journal of another one."""
        now = {**self.subject, "views": views}
        if begun(self.run, now) is not None:
            return list(self._read())
        shutil.rmtree(self.folder, ignore_errors=True)
        (self.run / RESULT).unlink(missing_ok=True)
        self.folder.mkdir(parents=True)
        write_text(self.folder / SUBJECT, json.dumps(now, indent=2) + "\n")
        return []

    def append(self, batch: SolvedBatch, rank: int) -> None:
        """Keep a batch that the process of this rank has solved; it is on disk when this returns."""
        fields = batch._asdict().items()
        values = {name: each.tolist() if isinstance(each, torch.Tensor) else each for name, each in fields}
        text = json.dumps(values, separators=(",", ":")).encode()
        line = b"%08x %s\n" % (zlib.crc32(text), text)
        path = self.folder / f"rank_{rank}.jsonl"
        with writing(path), path.open("ab+") as file:
            if file.tell() > 0:
                file.seek(-1, os.SEEK_END)
                line = line if file.read(1) == b"\n" else b"\n" + line  # after a line that was cut short
            file.write(line)
            file.flush()
            os.fsync(file.fileno())

    def finish(self) -> None:
        """Remove the journal, when all that is made of it is there."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _read(self) -> Iterator[SolvedBatch]:
        for file in sorted(self.folder.glob("rank_*.jsonl")):
            for line in file.read_bytes().split(b"\n"):
                checksum, _, text = line.partition(b" ")
                if checksum == b"%08x" % zlib.crc32(text):
                    # Of lists, which NumPy gives the 64 bits that their numbers have.
                    values: dict[str, Any] = {
                        name: torch.from_numpy(np.array(value)) if isinstance(value, list) else value
                        for name, value in json.loads(text).items()
                    }
                    yield SolvedBatch(**values)


def unfinished(folder: Path) -> dict[str, Any] | None:
    """What the unfinished evaluation in a run's folder is of, None where there is none."""
    subject = read_record(folder / FOLDER / SUBJECT)
    whole = isinstance(subject.get("config"), dict) and isinstance(subject.get("checkpoint", ...), str | None)
    return subject if whole else None


def begun(folder: Path, subject: Mapping[str, Any]) -> dict[str, Any] | None:
    """What `unfinished` says where it is of this subject, or more than it; None where there is none, `UserError` for
    another one that has solved anything."""
    before = unfinished(folder)
    changed = "" if before is None else changes(before, subject)
    if changed and any((folder / FOLDER).glob("rank_*.jsonl")):
        raise UserError(
            f"{folder}: holds another unfinished evaluation ({changed}); "
            f"give another folder, or remove {folder / FOLDER}"
        )
    return None if changed else before


def changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """In words, what of a subject has changed on which results depend, up to three of it; empty where nothing has.

    What `now` does not hold has not changed, and a setting that one side does not know is off there.

    >>> changes({"config": {"seed": 1, "solver": {"gamma": 0.3}}}, {"config": {"seed": 1, "solver": {"gamma": 0}}})
    'solver.gamma is 0.3 there, 0 here'
    """
    there, here = _compared(before), _compared({**before, **now})
    said = []
    for key in sorted({*there, *here}):
        one, other = there.get(key), here.get(key)
        if one != other and ((key in there and key in here) or one or other):
            said.append(f"other {key}" if key in ("views", "weights") else f"{key} is {one} there, {other} here")
    return ", ".join(said[:3])


def _compared(subject: Mapping[str, Any]) -> dict[str, Any]:
    """A subject by dotted keys, without the settings that change no result."""
    left_out = {"plugins", "resume", "checkpoint", *MOVABLE}
    settings = {key: value for key, value in dotted(subject["config"]).items() if key not in left_out}
    return settings | {key: value for key, value in subject.items() if key not in ("config", "versions")}


def dotted(config: Mapping[str, Any]) -> dict[str, Any]:
    """A config's values by their dotted keys; a list is one value.

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
