"""Damage to files, for fuzz tests of readers: truncated, flipped or replaced bytes, and JSON that is well formed but
meaningless."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from hypothesis import strategies as st

from lp_framework.errors import UserError

T = TypeVar("T")

NONSENSE: st.SearchStrategy[Any] = st.one_of(
    st.sampled_from([None, True, False, "", "x", "../..", "\x00", "\ud800", "nan", "1e9", [], {}, [[]], [{}]]),
    st.sampled_from([float("nan"), float("inf"), float("-inf"), 1e308, 1e-320, 10**30, -(10**400), 2**63, -1, 0, 0.5]),
    st.recursive(
        st.one_of(st.none(), st.integers(), st.floats(), st.text(max_size=4)),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
        max_leaves=4,
    ),
    st.sampled_from([3, 60]).map(lambda depth: json.loads("[" * depth + "]" * depth)),
)


@st.composite
def damaged(draw: st.DrawFn, whole: bytes) -> bytes:
    """The bytes of a file cut short, with bits turned, with stretches replaced, left out or repeated, or others."""
    data = bytearray(whole)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(data)))
        upto = min(len(data), at + draw(st.integers(0, 64)))
        match draw(st.sampled_from(["turn", "cut", "replace", "leave out", "repeat", "other"])):
            case "turn" if at < len(data):
                data[at] ^= 1 << draw(st.integers(0, 7))
            case "cut":
                del data[at:]
            case "replace":
                data[at:upto] = draw(st.binary(min_size=upto - at, max_size=upto - at))
            case "leave out":
                del data[at:upto]
            case "repeat":
                data[at:at] = data[at:upto]
            case "other" if len(data) < 8 or draw(st.integers(0, 9)) == 0:
                data = bytearray(draw(st.binary(max_size=64)))
    return bytes(data)


@st.composite
def misshapen(draw: st.DrawFn, whole: Any) -> Any:
    """The value of a JSON file with one to three of its parts left out, repeated or made nonsense."""
    value = copy.deepcopy(whole)
    for _ in range(draw(st.integers(1, 3))):
        holder: Any = None
        key: Any = None
        inner = value
        while isinstance(inner, list | dict) and inner and (holder is None or draw(st.integers(0, 4))):
            keys = sorted(inner) if isinstance(inner, dict) else range(len(inner))
            holder, key = inner, draw(st.sampled_from(list(keys)))
            inner = holder[key]
        match draw(st.sampled_from(["nonsense", "nonsense", "leave out", "repeat", "wrap", "whole"])):
            case "nonsense" if holder is not None:
                holder[key] = copy.deepcopy(draw(NONSENSE))  # drawn values are shared
            case "leave out" if holder is not None:
                del holder[key]
            case "repeat" if isinstance(holder, list):
                holder.append(inner)
            case "wrap" if holder is not None:
                holder[key] = [inner]
            case "whole" if draw(st.integers(0, 9)) == 0:
                value = copy.deepcopy(draw(NONSENSE))
    return value


def json_damage(whole: Any) -> st.SearchStrategy[bytes]:
    """The bytes of a JSON file with either kind of damage."""
    text = json.dumps(whole).encode()
    deep = st.sampled_from([b"[" * 20_000, b'{"a":' * 20_000, b"1" * 5000, b"\xff\xfe" + text, b"\xef\xbb\xbf" + text])
    return st.one_of(misshapen(whole).map(lambda value: json.dumps(value).encode()), damaged(text), deep)


def snapshot(folder: Path) -> dict[str, bytes]:
    """All files in and below a folder with their contents."""
    return {str(file.relative_to(folder)): file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()}


def read_or_reported(read: Callable[[], T], *named: Path | str) -> T | None:
    """What `read` gives, or None where it raises the one exception that it may: a `UserError` in one sentence that
    names the file, or one of several."""
    try:
        return read()
    except UserError as error:
        sentence = str(error)
        assert "\n" not in sentence, sentence
        assert any(str(name) in sentence for name in named), sentence
        return None
