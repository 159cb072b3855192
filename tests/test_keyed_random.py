import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from lp_framework.keyed_random import keyed_bits, keyed_normal, keyed_uniform, stable_id

integers = st.integers(-(2**63), 2**63 - 1)
MANY = torch.arange(20_000)


@pytest.mark.parametrize("seed", [0, 1, 2**62])
@pytest.mark.parametrize(
    ("draw", "law"), [(keyed_uniform, stats.uniform), (keyed_normal, stats.norm)], ids=["uniform", "normal"]
)
def test_draws_follow_their_distribution_along_keys_and_counts(draw, law, seed):
    for sample in (draw(seed, MANY, count=1)[:, 0], draw(seed, 5, count=20_001)):
        assert stats.kstest(sample.numpy(), law.cdf).pvalue > 1e-3


def test_the_normal_tails_are_there():
    normal = keyed_normal(3, MANY, count=20)
    for level in (2.0, 3.0, 4.0):
        expected = 2 * stats.norm.sf(level) * normal.numel()
        assert abs((normal.abs() > level).sum().item() - expected) < 5 * expected**0.5


def test_uniform_draws_lie_in_the_open_interval_whatever_the_bits(monkeypatch):
    uniform = keyed_uniform(0, MANY, count=50)
    assert uniform.dtype == torch.float64 and 0 < uniform.min() < 1e-5 and 1 - 1e-5 < uniform.max() < 1
    extremes = torch.tensor([0, 1, -1, -2, 2**63 - 1, -(2**63)])
    monkeypatch.setattr("lp_framework.keyed_random.keyed_bits", lambda *keys, count: extremes)
    assert ((keyed_uniform(0, count=6) > 0) & (keyed_uniform(0, count=6) < 1)).all()


@pytest.mark.parametrize("draw", [keyed_uniform, keyed_normal])
def test_neighbouring_keys_seeds_and_counts_are_uncorrelated(draw):
    first = draw(0, MANY, count=4)
    others = {
        "next key": draw(0, MANY + 1, count=4),
        "next seed": draw(1, MANY, count=4),
        "one more key": draw(0, MANY, 0, count=4),
        "key times a power of two": draw(0, MANY * 2**40, count=4)[1:],
        "next draw": first.roll(1, dims=1),
    }
    for name, other in others.items():
        correlation = np.corrcoef(first[-len(other) :].flatten(), other.flatten())[0, 1]
        assert abs(correlation) < 5 / other.numel() ** 0.5, name
    assert np.abs(np.corrcoef(first.T) - np.eye(4)).max() < 5 / len(first) ** 0.5


def test_one_flipped_bit_of_a_key_flips_half_of_the_bits():
    keys = torch.arange(500) * 7919
    before = keyed_bits(0, keys, count=1)
    for bit in range(63):
        changed = (before ^ keyed_bits(0, keys ^ (1 << bit), count=1)).flatten()
        flips = sum(((changed >> place) & 1).float().mean() for place in range(64)) / 64
        assert abs(flips - 0.5) < 0.02, bit


def test_no_two_keys_collide():
    grid = torch.arange(300)
    bits = keyed_bits(grid[:, None, None], grid[:, None], 0, count=3)
    assert len(torch.unique(bits)) == bits.numel()


def test_the_order_of_keys_matters():
    assert not torch.equal(keyed_uniform(1, 2, count=3), keyed_uniform(2, 1, count=3))
    assert not torch.equal(keyed_uniform(0, count=3), keyed_uniform(0, 0, count=3))


@settings(deadline=None, derandomize=True)
@given(st.lists(integers, min_size=1, max_size=4), st.integers(1, 7))
def test_a_batch_draws_what_its_members_draw_alone(keys, count):
    for draw in (keyed_uniform, keyed_normal):
        batch = draw(3, torch.tensor(keys), count=count)
        assert batch.shape == (len(keys), count)
        for row, key in zip(batch, keys, strict=True):
            assert torch.equal(row, draw(3, key, count=count))


def test_broadcasting_equals_one_by_one_and_follows_permutations():
    rows, columns = torch.tensor([5, -1, 2**60]), torch.arange(4)
    grid = keyed_normal(9, rows[:, None], columns, count=3)
    assert grid.shape == (3, 4, 3)
    for i, j in itertools.product(range(3), range(4)):
        assert torch.equal(grid[i, j], keyed_normal(9, int(rows[i]), int(columns[j]), count=3))
    order = torch.tensor([2, 0, 1])
    assert torch.equal(keyed_normal(9, rows[order, None], columns, count=3), grid[order])


def test_uniform_draws_do_not_depend_on_how_many_are_drawn():
    assert torch.equal(keyed_uniform(1, 2, count=9)[:4], keyed_uniform(1, 2, count=4))


@pytest.mark.parametrize("draw", [keyed_bits, keyed_uniform, keyed_normal])
def test_draws_are_on_the_cpu_wherever_the_keys_are(draw):
    drawn = draw(0, torch.arange(3, device="meta")[:, None], torch.arange(2), count=4)
    assert drawn.device == torch.device("cpu") and drawn.shape == (3, 2, 4)


def test_the_global_generator_is_left_alone():
    torch.manual_seed(0)
    expected = torch.rand(3)
    torch.manual_seed(0)
    keyed_normal(0, 1, count=5)
    assert torch.equal(torch.rand(3), expected)


def test_the_first_bits_of_splitmix64():
    # Reference: the published SplitMix64 seeded with 0 yields these numbers; no keys mean state 0.
    published = [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F]
    assert [value % 2**64 for value in keyed_bits(count=3).tolist()] == published


def test_draws_are_unchanged_between_versions():
    # Source: this package, as first published. They must never change: the results of old runs hang on them.
    assert stable_id("cup/000.png cup/001.png") == 8734955151959690502
    assert keyed_bits(0, 7, 3, count=2).tolist() == [-3271839209435239565, -2266794861325250843]
    uniform, normal = keyed_uniform(1, torch.tensor([2, 3]), count=2), keyed_normal(1, 2, count=3)
    expected = [[0.3643354726583158, 0.2281567708737674], [0.6305908980719551, 0.18017585948546688]]
    assert uniform.tolist() == expected
    assert normal.tolist() == pytest.approx([-0.4757920585099757, 0.23647946103838852, 1.3390229020678626], abs=1e-12)


def test_stable_ids_are_distinct_and_not_negative():
    ids = [stable_id(f"object {number}") for number in range(5000)]
    assert len(set(ids)) == len(ids) and min(ids) >= 0 and max(ids) < 2**63
    assert stable_id("a") != stable_id("b") and stable_id("é") == stable_id("\N{LATIN SMALL LETTER E WITH ACUTE}")
