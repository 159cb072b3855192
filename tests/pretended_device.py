"""A pretended accelerator, `far`: its tensors are CPU tensors that mix with those of the CPU no more than a GPU's do.

Where there is no GPU it shows what would fail on one: a tensor made in the wrong place, an array of the device's
memory, a network that was left behind. And it counts when the host waits for the device. On request it refuses float64,
as Apple's GPUs do. Importing this module sets PyTorch's third-party device up, for the whole process.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map
from torch.utils.backend_registration import _DummyBackendModule, _setup_privateuseone_for_python_backend


class _Module(_DummyBackendModule):
    """What PyTorch asks a device for: this one knows autocasting, to the extent that it can be switched off."""

    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        return [torch.bfloat16]


_setup_privateuseone_for_python_backend("far", _Module())
FAR = torch.device("far:0")

aten = torch.ops.aten
COPIES = {aten._to_copy.default, aten.copy_.default}  # between any devices
AT_ONCE = {  # a flag on a view, which is not looked at below this module
    aten._conj.default: aten.conj_physical.default,
    aten._neg_view.default: aten.neg.default,
}
INDEXING = {aten.index.Tensor, aten.index_put.default, aten.index_put_.default}  # CPU indices may address GPU tensors


class FarTensor(Tensor):
    """A tensor on `far`; `near` is the CPU tensor that it is made of."""

    near: Tensor

    @staticmethod
    def __new__(cls, near: Tensor) -> FarTensor:
        if near.dtype in Refused.dtypes:
            raise TypeError(f"far:0 has no {near.dtype}; use float32 there")
        made = Tensor._make_wrapper_subclass(
            cls, near.shape, strides=near.stride(), storage_offset=near.storage_offset(), dtype=near.dtype, device=FAR
        )
        made.near = near
        return made

    def __repr__(self) -> str:
        return f"far {self.near!r}"

    def tolist(self) -> Any:
        return self.cpu().tolist()

    def numpy(self, *arguments: object, **named: object) -> Any:
        raise TypeError("can't convert far:0 device type tensor to numpy. Use Tensor.cpu() to copy the tensor first.")

    def __reduce_ex__(self, protocol: Any) -> Any:
        return self.near.__reduce_ex__(protocol)  # saved as what it is made of

    __array__ = numpy
    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, operator: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _compute(operator, args, kwargs or {})


class Refused:
    """What tensors on the device cannot be made of."""

    dtypes: tuple[torch.dtype, ...] = ()


class Waits:
    """How often the host has waited for the device: to read a value there, or to copy one there from its own memory."""

    count = 0


@contextmanager
def pretended(double: bool = True) -> Iterator[None]:
    """Within it tensors can be made on `FAR` and moved there; without `double` none of float64."""
    Refused.dtypes = () if double else (torch.float64, torch.complex128)
    overwrite = torch.__future__.get_overwrite_module_params_on_conversion()
    torch.__future__.set_overwrite_module_params_on_conversion(True)  # else a parameter keeps the `near` that it has
    try:
        with _Mode():
            yield
    finally:
        torch.__future__.set_overwrite_module_params_on_conversion(overwrite)
        Refused.dtypes = ()


class _Mode(TorchDispatchMode):
    def __torch_dispatch__(self, operator: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _compute(operator, args, kwargs or {})


def _compute(operator: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    """An operation on tensors of either device, none of them on both."""
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    # In inference mode, and of tensors from there, operations that are made of others come as they are.
    if torch.is_inference_mode_enabled() or any(each.is_inference() for each in tensors):
        with _Mode():
            made = operator.decompose(*args, **kwargs)
        if made is not NotImplemented:
            return made
    far, near = ([each for each in tensors if isinstance(each, FarTensor) == there] for there in (True, False))
    asked = None if kwargs.get("device") is None else torch.device(kwargs["device"]).type
    if not far and asked != FAR.type:
        return operator(*args, **kwargs)
    if far and operator not in COPIES | INDEXING and any(each.ndim for each in near):  # a number may come along
        raise RuntimeError(f"{operator}: expected all tensors to be on the same device, but found far:0 and cpu")
    leaves = operator is aten._to_copy.default and asked not in (None, FAR.type)
    arrives = operator in COPIES and bool(near) and not kwargs.get("non_blocking")
    Waits.count += operator is aten._local_scalar_dense.default or leaves or arrives
    made = AT_ONCE.get(operator, operator)(*tree_map(_near, args), **tree_map(_near, kwargs))
    if leaves:
        return made
    if operator is aten.copy_.default:
        return args[0]
    given = {id(each.near): each for each in far}  # what is changed in place is given back
    return tree_map(lambda leaf: given.get(id(leaf), FarTensor(leaf)) if isinstance(leaf, Tensor) else leaf, made)


def _near(leaf: object) -> object:
    """An argument as the CPU knows it."""
    if isinstance(leaf, torch.device) and leaf.type == FAR.type:
        return torch.device("cpu")
    return leaf.near if isinstance(leaf, FarTensor) else leaf


# ---------------------------------------------------------------- what PyTorch calls without asking a mode

_library = torch.library.Library("aten", "IMPL")


def _kernel(name: str) -> Callable[[Callable[..., Tensor]], Callable[..., Tensor]]:
    def add(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
        _library.impl(name, function, "PrivateUse1")
        return function

    return add


@_kernel("empty.memory_format")
def _empty(size: Sequence[int], dtype: torch.dtype | None = None, *_: object, **__: object) -> Tensor:
    return FarTensor(torch.empty(size, dtype=dtype))


@_kernel("empty_strided")
def _empty_strided(size: Any, stride: Any, dtype: torch.dtype | None = None, *_: object, **__: object) -> Tensor:
    return FarTensor(torch.empty_strided(size, stride, dtype=dtype))


@_kernel("_copy_from")
def _copy_from(source: Tensor, target: Tensor, *_: object, **__: object) -> Tensor:
    return _compute(aten.copy_.default, (target, source), {})
