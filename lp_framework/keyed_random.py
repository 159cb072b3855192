"""Random draws keyed by what they belong to (seed, pair, start, step), not by the order in which they are drawn.

A counter-based generator: the value at a key is a hash of the key. Draws are therefore independent of batching, order,
number of processes and resumption. They are made on the CPU so that they are equal for all devices and no device needs
float64. Keys may be on any device, but fetching them synchronizes with it.
"""

from __future__ import annotations

import hashlib
import math

import torch
from torch import Tensor


def stable_id(text: str) -> int:
    """A 63-bit integer for a string, the same in every process (unlike `hash`)."""
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little") >> 1


# Unsigned 64-bit constants as int64 with the same bits.
_GOLDEN, _MIX_1, _MIX_2 = (c - (1 << 64) for c in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))


def _shift(bits: Tensor, count: int) -> Tensor:
    """Logical (unsigned) right shift of int64."""
    return (bits >> count) & ((1 << (64 - count)) - 1)


def _mix(bits: Tensor) -> Tensor:
    """The finaliser of SplitMix64 (Steele, Lea and Flood 2014); int64 arithmetic wraps as uint64's does."""
    bits = (bits ^ _shift(bits, 30)) * _MIX_1
    bits = (bits ^ _shift(bits, 27)) * _MIX_2
    return bits ^ _shift(bits, 31)


def on_cpu(keys: Tensor) -> Tensor:
    """Move keys to the CPU; keys on the meta device have no values and become 0."""
    return torch.zeros(keys.shape, dtype=keys.dtype) if keys.is_meta else keys.cpu()


def to_device(draws: Tensor, device: torch.device) -> Tensor:
    """Move draws to a device, asynchronously where that is reliable (not on Apple's)."""
    return draws.to(device, non_blocking=device.type not in ("cpu", "mps"))


def keyed_bits(*keys: Tensor | int, count: int) -> Tensor:
    """Random int64 bits `[..., count]` for integer keys that broadcast to `[...]`."""
    state = torch.zeros((), dtype=torch.int64)
    for key in keys:
        state = _mix(state * 3 + (on_cpu(key) if isinstance(key, Tensor) else key) + _GOLDEN)
    return _mix(state[..., None] + torch.arange(1, count + 1) * _GOLDEN)


def keyed_uniform(*keys: Tensor | int, count: int) -> Tensor:
    """Uniform draws in the open interval (0, 1), float64 `[..., count]`, for integer keys that broadcast to `[...]`.

    >>> keyed_uniform(0, torch.tensor([7, 7, 8]), count=2)[:, 0].diff().tolist()[0]
    0.0
    """
    # 52 bits: with 53 the half would be rounded away, and the largest draw would be 1.
    return (_shift(keyed_bits(*keys, count=count), 12).double() + 0.5) * 2.0**-52


def keyed_normal(*keys: Tensor | int, count: int) -> Tensor:
    """Standard normal draws, float64 `[..., count]`, for integer keys that broadcast to `[...]` (Box-Muller)."""
    half = (count + 1) // 2
    uniform = keyed_uniform(*keys, count=2 * half)
    length, angle = (-2 * uniform[..., :half].log()).sqrt(), 2 * math.pi * uniform[..., half:]
    return torch.cat([length * angle.cos(), length * angle.sin()], dim=-1)[..., :count]
