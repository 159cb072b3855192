"""Zero123's energy recorded and replayed: with a mock of CUDA graphs, and on a GPU if there is one."""

from __future__ import annotations

import copy
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only

from lp_framework.benchmarks.zero123 import NARROW
from lp_framework.priors.base import ViewCode
from lp_framework.priors.zero123 import cuda_graph
from lp_framework.priors.zero123.networks import Networks
from lp_framework.priors.zero123.prior import Chunks, Zero123Prior

SIDE = 8  # of the latents


class Graph(TorchDispatchMode):
    """What a CUDA graph is to its user: the operations of a stretch of code, on the same memory again and again.

    Numbers that the host had then stay as they were, results are written over by the next replay, and to read a value
    while it records is an error.
    """

    def __init__(self) -> None:
        super().__init__()
        self.operations: list[tuple[Any, ...]] = []

    def __torch_dispatch__(self, operator: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if operator is torch.ops.aten._local_scalar_dense.default:
            raise RuntimeError("operation not permitted when stream is capturing")
        # Other tensors on the same memory, which a parameter may leave.
        args, kwargs = tree_map_only(torch.Tensor, torch.Tensor.detach, (args, kwargs or {}))
        made = operator(*args, **kwargs)
        self.operations.append((operator, args, kwargs, made))
        return made

    def replay(self) -> None:
        for operator, args, kwargs, made in self.operations:
            for old, new in zip(tree_leaves(made), tree_leaves(operator(*args, **kwargs)), strict=True):
                if isinstance(old, torch.Tensor) and old.data_ptr() != new.data_ptr():
                    old.copy_(new)

    def pool(self) -> int:
        return 7


class Stream:
    def wait_stream(self, other: Stream) -> None:
        """They are one."""


@pytest.fixture
def pools(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Lets CPUs have such graphs; the memory that each recording was given."""
    given: list[Any] = []

    @contextmanager
    def recording(graph: Graph, pool: Any, stream: Stream, capture_error_mode: str) -> Iterator[None]:
        given.append(pool)
        with graph:
            yield

    for name, stand_in in (
        ("CUDAGraph", Graph), ("graph", recording), ("Stream", Stream), ("current_stream", Stream),
        ("stream", lambda stream: nullcontext()), ("device", lambda device: nullcontext()),
    ):  # fmt: skip
        monkeypatch.setattr(torch.cuda, name, stand_in)
    monkeypatch.setattr(torch._C, "_cuda_clearCublasWorkspaces", lambda: None, raising=False)
    monkeypatch.setattr(cuda_graph, "can_record", lambda device: True)
    return given


def prior_of(seed: int = 0, **settings: Any) -> Zero123Prior:
    torch.manual_seed(seed)
    prior = Zero123Prior(Networks(NARROW), **settings)
    prior.latent_shape = (4, SIDE, SIDE)
    return prior


def problem(count: int, seed: int, device: str = "cpu") -> tuple[ViewCode, ViewCode, Any, Any, Any]:
    """Arguments of `denoising_error`."""
    generator = torch.Generator().manual_seed(seed)
    latents = torch.randn(2, count, 4, SIDE, SIDE, generator=generator).to(device)
    source = ViewCode(latents[1], torch.randn(count, 1, 32, generator=generator).to(device))
    pose = torch.randn(count, 3, generator=generator).to(device)
    timestep = torch.randint(1000, (count,), generator=generator).to(device)
    noise = torch.randn(count, 4, SIDE, SIDE, generator=generator).to(device)
    return ViewCode(latents[0], source.embedding), source, pose, timestep, noise


def energies_and_slopes(prior: Zero123Prior, count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    target, source, pose, timestep, noise = problem(count, seed, prior.alphas_cumprod.device.type)
    pose = pose.requires_grad_()
    energies = prior.denoising_error(target, source, pose, timestep, noise)
    (slopes,) = torch.autograd.grad((energies * torch.arange(1, count + 1, device=pose.device)).sum(), pose)
    return energies.detach(), slopes


def test_replays_of_each_batch_size_give_what_the_function_gives(pools):
    plain, graphed = prior_of(max_batch=3), prior_of(max_batch=3, cuda_graph=True)
    found = [energies_and_slopes(graphed, count, seed) for count, seed in ((5, 0), (5, 1), (2, 2), (5, 3))]
    for (count, seed), both in zip(((5, 0), (5, 1), (2, 2), (5, 3)), found, strict=True):
        torch.testing.assert_close(both, energies_and_slopes(plain, count, seed), rtol=1e-5, atol=1e-8)
    assert pools == [None, 7]  # recorded for 3 and for 2 samples, in the same memory


def test_a_moved_prior_is_recorded_again(pools):
    graphed = prior_of(cuda_graph=True)
    energies_and_slopes(graphed, 2, 0)
    with torch.no_grad():
        for parameter in graphed.parameters():
            parameter.data = 0.9 * parameter.data  # as a move: other memory
    stale = energies_and_slopes(graphed, 2, 0)[0]
    graphed.to(torch.float32)
    wanted = prior_of()
    with torch.no_grad():
        for parameter in wanted.parameters():
            parameter.mul_(0.9)
    fresh = energies_and_slopes(wanted, 2, 0)[0]
    torch.testing.assert_close(energies_and_slopes(graphed, 2, 0)[0], fresh, rtol=1e-5, atol=1e-8)
    assert not torch.allclose(stale, fresh, rtol=1e-3)  # the stand-in does keep addresses, as a GPU does


def test_a_deleted_prior_is_freed_immediately_and_a_copy_has_its_own_recordings(pools):
    """Not when the garbage collector comes by: a GPU that is full does not call it."""
    graphed = prior_of(cuda_graph=True)
    energies_and_slopes(graphed, 2, 0)
    copied = copy.deepcopy(graphed)
    assert graphed.replayed.recordings and not copied.replayed.recordings
    unet = weakref.ref(graphed.unet)
    del graphed
    assert unet() is None


def test_recordings_are_freed_before_a_batch_is_halved():
    def fits(part: slice) -> slice:
        if kept or part.stop - part.start > 3:
            raise torch.cuda.OutOfMemoryError("out of memory")
        return part

    kept = ["a recording"]
    chunks = Chunks(3, release=lambda: bool(kept) and kept.pop() is not None)
    assert [(part.start, part.stop) for part in chunks.run(fits, 5)] == [(0, 3), (3, 5)]
    assert chunks.size == 3
    assert len(chunks.run(fits, 2)) == 1
    chunks.size = 4
    assert len(chunks.run(fits, 4)) == 2 and chunks.size == 2


def test_without_a_gpu_the_setting_changes_nothing():
    one, other = (energies_and_slopes(prior_of(cuda_graph=each), 2, 0) for each in (True, False))
    assert all(map(torch.equal, one, other))


@pytest.mark.heavy
@pytest.mark.gpu
def test_replays_on_a_gpu():
    plain, graphed = prior_of().cuda(), prior_of(cuda_graph=True).cuda()
    for count, seed in ((4, 0), (4, 1), (2, 2), (4, 3)):
        for one, other in zip(
            energies_and_slopes(graphed, count, seed), energies_and_slopes(plain, count, seed), strict=True
        ):
            torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-5)
