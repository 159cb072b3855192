"""A mock GPU, `mock`: its tensors wrap CPU tensors, but mixing them with CPU tensors raises, as on a GPU.

It detects code that would fail on a GPU: tensors created on the wrong device, conversion of device tensors to NumPy,
networks that were not moved. It also counts host-device synchronizations and can disable float64, like Apple's GPUs.
Importing this module registers PyTorch's third-party device for the whole process.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.backend_registration import _DummyBackendModule, _setup_privateuseone_for_python_backend


class _Module(_DummyBackendModule):
    """The backend module that PyTorch requires; autocast is supported only as far as it can be disabled."""

    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        return [torch.bfloat16]


_setup_privateuseone_for_python_backend("mock", _Module())
MOCK = torch.device("mock:0")

aten = torch.ops.aten
COPIES = {aten._to_copy.default, aten.copy_.default}  # between any devices
EAGER = {  # lazy flags on a view, which kernels of the wrapped tensors ignore
    aten._conj.default: aten.conj_physical.default,
    aten._neg_view.default: aten.neg.default,
}
INDEXING = {aten.index.Tensor, aten.index_put.default, aten.index_put_.default}  # CPU indices may address GPU tensors


class MockTensor(Tensor):
    """A tensor on the mock device; `wrapped` is the CPU tensor that holds its values."""

    wrapped: Tensor

    @staticmethod
    def __new__(cls, cpu: Tensor) -> MockTensor:
        if cpu.dtype in Unsupported.dtypes:
            raise TypeError(f"mock:0 has no {cpu.dtype}; use float32 there")
        result = Tensor._make_wrapper_subclass(
            cls, cpu.shape, strides=cpu.stride(), storage_offset=cpu.storage_offset(), dtype=cpu.dtype, device=MOCK
        )
        result.wrapped = cpu
        return result

    def __repr__(self) -> str:
        return f"mock {self.wrapped!r}"

    def tolist(self) -> Any:
        return self.cpu().tolist()

    def numpy(self, *arguments: object, **named: object) -> Any:
        raise TypeError("can't convert mock:0 device type tensor to numpy. Use Tensor.cpu() to copy the tensor first.")

    def __reduce_ex__(self, protocol: Any) -> Any:
        return self.wrapped.__reduce_ex__(protocol)  # saved as a CPU tensor

    __array__ = numpy
    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, operator: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _compute(operator, args, kwargs or {})


class Unsupported:
    """The dtypes that the device does not support."""

    dtypes: tuple[torch.dtype, ...] = ()


class Syncs:
    """Counts synchronizations of the host with the device: values read, and blocking copies from the host."""

    count = 0


@contextmanager
def mock_device(double: bool = True) -> Iterator[None]:
    """Enable the device `MOCK`; without `double`, it does not support float64."""
    Unsupported.dtypes = () if double else (torch.float64, torch.complex128)
    overwrite = torch.__future__.get_overwrite_module_params_on_conversion()
    torch.__future__.set_overwrite_module_params_on_conversion(True)  # otherwise parameters keep their wrapped tensor
    try:
        with _Mode():
            yield
    finally:
        torch.__future__.set_overwrite_module_params_on_conversion(overwrite)
        Unsupported.dtypes = ()


class _Mode(TorchDispatchMode):
    def __torch_dispatch__(self, operator: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _compute(operator, args, kwargs or {})


def _compute(operator: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    """Run an operation whose tensors are all on the same device."""
    tensors = [*_tensors(args), *_tensors(kwargs.values())]
    on_mock = [each for each in tensors if isinstance(each, MockTensor)]
    requested = None if kwargs.get("device") is None else torch.device(kwargs["device"]).type
    if not on_mock and requested != MOCK.type:
        return operator(*args, **kwargs)
    # In inference mode, PyTorch has not decomposed composite operations yet.
    if torch.is_inference_mode_enabled() or any(each.is_inference() for each in tensors):
        with _Mode():
            result = operator.decompose(*args, **kwargs)
        if result is not NotImplemented:
            return result
    on_cpu = [each for each in tensors if not isinstance(each, MockTensor)]
    if on_mock and operator not in COPIES | INDEXING and any(each.ndim for each in on_cpu):  # CPU scalars are allowed
        raise RuntimeError(f"{operator}: expected all tensors to be on the same device, but found mock:0 and cpu")
    to_cpu = operator is aten._to_copy.default and requested not in (None, MOCK.type)
    to_mock = operator in COPIES and bool(on_cpu) and not kwargs.get("non_blocking")
    Syncs.count += operator is aten._local_scalar_dense.default or to_cpu or to_mock
    named = {name: _unwrapped(each) for name, each in kwargs.items()}
    result = EAGER.get(operator, operator)(*map(_unwrapped, args), **named)
    if to_cpu:
        return result
    if operator is aten.copy_.default:
        return args[0]
    known = {id(each.wrapped): each for each in on_mock}  # in-place operations return their argument
    return _wrapped(result, known)


def _tensors(values: Iterable[Any]) -> Iterator[Tensor]:
    """The tensors among arguments and in lists of them; PyTorch's pytrees would take most of the time."""
    for each in values:
        if isinstance(each, Tensor):
            yield each
        elif isinstance(each, (list, tuple)):
            yield from _tensors(each)


def _unwrapped(value: Any) -> Any:
    """The CPU version of an argument."""
    if isinstance(value, MockTensor):
        return value.wrapped
    if isinstance(value, (list, tuple)):
        return type(value)(map(_unwrapped, value))
    return torch.device("cpu") if isinstance(value, torch.device) and value.type == MOCK.type else value


def _wrapped(value: Any, known: dict[int, MockTensor]) -> Any:
    """The mock version of a result."""
    if isinstance(value, (list, tuple)):
        return type(value)(_wrapped(each, known) for each in value)
    if isinstance(value, Tensor):
        return known[id(value)] if id(value) in known else MockTensor(value)
    return value


# ---------------------------------------------------------------- kernels that PyTorch calls outside of any mode

_library = torch.library.Library("aten", "IMPL")


def _kernel(name: str) -> Callable[[Callable[..., Tensor]], Callable[..., Tensor]]:
    def add(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
        _library.impl(name, function, "PrivateUse1")
        return function

    return add


@_kernel("empty.memory_format")
def _empty(size: Sequence[int], dtype: torch.dtype | None = None, *_: object, **__: object) -> Tensor:
    return MockTensor(torch.empty(size, dtype=dtype))


@_kernel("empty_strided")
def _empty_strided(size: Any, stride: Any, dtype: torch.dtype | None = None, *_: object, **__: object) -> Tensor:
    return MockTensor(torch.empty_strided(size, stride, dtype=dtype))


@_kernel("_copy_from")
def _copy_from(source: Tensor, target: Tensor, *_: object, **__: object) -> Tensor:
    return _compute(aten.copy_.default, (target, source), {})
