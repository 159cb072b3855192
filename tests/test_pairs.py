import itertools
import math
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from view_folders import FIELD_OF_VIEW, random_poses

from lp_framework.data.pairs import (
    PROTOCOLS,
    BlockSampler,
    PairData,
    ViewTable,
    as_images,
    in_batches,
    shard_batches,
)
from lp_framework.data.views import ObjectViews
from lp_framework.errors import UserError
from lp_framework.geometry import camera_to_world, relative_pose

NAMES = "abcdefgh"


def views_of(name: str, count: int) -> ObjectViews:
    """Views whose files are not there; nothing here opens them."""
    files = [Path(f"{name}/test/rgb/{index:03d}.png") for index in range(count)]
    cameras = camera_to_world(torch.from_numpy(random_poses(count, name)))
    return ObjectViews(name, "test", "unlabelled", None, files, cameras, torch.full((count,), FIELD_OF_VIEW))


def table_of(*counts: int, names: str = NAMES) -> ViewTable:
    return ViewTable([views_of(name, count) for name, count in zip(names, counts, strict=False)])


def all_pairs(table: ViewTable) -> set[tuple[int, int]]:
    """All ordered pairs of different views of one object, spelt out."""
    objects = [range(sum(table.counts[:i]), sum(table.counts[: i + 1])) for i in range(len(table.counts))]
    return {pair for views in objects for pair in itertools.permutations(views, 2)}


def listed(pairs) -> list[tuple[int, int]]:
    return [(int(reference), int(query)) for reference, query in pairs]


counts_of_objects = st.lists(st.integers(2, 21), min_size=1, max_size=4)


# ---------------------------------------------------------------- the table and its protocols


def test_a_table_numbers_views_object_by_object():
    table = table_of(3, 5, 2)
    assert len(table) == 10 and table.names == ["a", "b", "c"]
    assert [table.views_of(index).tolist() for index in range(3)] == [[0, 1, 2], [3, 4, 5, 6, 7], [8, 9]]
    assert table.object_of_view.tolist() == [0] * 3 + [1] * 5 + [2] * 2
    for index, name in enumerate("abc"):
        for number, view in enumerate(table.views_of(index)):
            assert table.files[view] == Path(f"{name}/test/rgb/{number:03d}.png")
            torch.testing.assert_close(table.cameras[view], camera_to_world(table.poses[view]), rtol=0, atol=1e-12)


@settings(deadline=None, derandomize=True)
@given(counts_of_objects)
def test_ordered_pairs_are_all_of_them_once(counts):
    table = table_of(*counts)
    pairs = listed(table.pairs("ordered"))
    assert len(pairs) == sum(count * (count - 1) for count in counts)
    assert set(pairs) == all_pairs(table)


def test_eight_test_views_of_twelve_objects_make_672_pairs():
    assert len(ViewTable([views_of(name, 8) for name in "abcdefghijkl"]).pairs("ordered")) == 672


@settings(deadline=None, derandomize=True)
@given(counts_of_objects, st.integers(0, 1000))
def test_per_view_pairs_have_each_view_once_as_query(counts, seed):
    table = table_of(*counts)
    pairs = table.pairs("per_view", seed)
    assert pairs[:, 1].tolist() == list(range(len(table)))
    assert set(listed(pairs)) <= all_pairs(table)
    np.testing.assert_array_equal(pairs, table.pairs("per_view", seed))


def test_per_view_references_are_drawn_evenly_and_by_seed():
    table = table_of(5)
    drawn = Counter(pair for seed in range(400) for pair in listed(table.pairs("per_view", seed)))
    assert set(drawn) == all_pairs(table) and max(abs(count - 100) for count in drawn.values()) < 50
    assert listed(table.pairs("per_view", 0)) != listed(table.pairs("per_view", 1))


def test_per_view_references_do_not_depend_on_the_other_objects():
    alone, among = table_of(7, names="b"), table_of(4, 7, 3, names="abc")
    expected = alone.pairs("per_view", 5) + 4  # b's views start at 4
    np.testing.assert_array_equal(among.pairs("per_view", 5)[4:11], expected)


def test_ifusion_pairs_are_the_twenty_of_the_first_five_views():
    table = table_of(9, 6, 3)
    pairs = listed(table.pairs("ifusion"))
    assert pairs[:20] == list(itertools.permutations(range(5), 2))
    assert pairs[20:40] == list(itertools.permutations(range(9, 14), 2))
    assert pairs[40:] == list(itertools.permutations(range(15, 18), 2))  # there are but three


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_an_object_with_one_view_has_no_pairs(protocol):
    with pytest.raises(UserError, match="object 'b' has 1 view here; a pair needs two"):
        table_of(3, 1).pairs(protocol)


def test_a_misspelt_protocol():
    with pytest.raises(UserError, match=r"protocol='orderd' is not known; did you mean 'ordered'"):
        table_of(3).pairs("orderd")


# ---------------------------------------------------------------- ids


def ids_by_names(table: ViewTable) -> dict[tuple[str, str], int]:
    pairs = table.pairs("ordered")
    ids = PairData(table, None, None)[pairs].ids
    assert ids.dtype == torch.int64 and len(ids.unique()) == len(pairs) and (ids >= 0).all()
    return {(str(table.files[r]), str(table.files[q])): id for (r, q), id in zip(pairs, ids.tolist(), strict=True)}


def test_pair_ids_depend_on_the_pair_alone():
    alone, among = ids_by_names(table_of(4, names="b")), ids_by_names(table_of(3, 6, 5, names="abc"))
    assert len(alone) == 12 and alone.items() <= among.items()


def test_pair_ids_follow_the_pairs_in_any_order():
    table = table_of(3, 4)
    pairs = table.pairs("ordered")
    data = PairData(table, None, None)
    order = np.random.default_rng(0).permutation(len(pairs))
    assert torch.equal(data[pairs[order]].ids, data[pairs].ids[order])


def test_pair_ids_do_not_depend_on_where_the_data_lies():
    here, there = views_of("a", 3), views_of("a", 3)
    moved = replace(there, files=[Path("/x") / f for f in there.files], field_of_view=there.field_of_view + 0.1)
    pairs = np.array([[0, 1], [1, 2]])
    batches = [PairData(ViewTable([views]), None, None)[pairs] for views in (here, moved)]
    assert torch.equal(batches[0].ids, batches[1].ids)


# ---------------------------------------------------------------- blocks


@st.composite
def block_samplers(draw) -> list[BlockSampler]:
    """One sampler a rank."""
    table = table_of(*draw(counts_of_objects))
    block, batch_pairs = draw(st.integers(1, 9)), draw(st.sampled_from([1, 40, 200, 1000, 10**6]))
    ranks, seed, epoch = draw(st.integers(1, 4)), draw(st.integers(0, 5)), draw(st.integers(0, 5))
    samplers = [BlockSampler(table, batch_pairs, block, seed, rank, ranks) for rank in range(ranks)]
    for sampler in samplers:
        sampler.set_epoch(epoch)
    return samplers


def units_of(sampler: BlockSampler) -> int:
    """How many pairs of blocks there are, counted one by one."""
    blocks = [math.ceil(count / sampler.block) for count in sampler.table.counts]
    return sum(max(1, len(list(itertools.combinations(range(number), 2)))) for number in blocks)


@settings(deadline=None, derandomize=True, max_examples=150)
@given(block_samplers())
def test_an_epoch_has_every_ordered_pair_once_over_all_ranks(samplers):
    drawn = Counter(pair for sampler in samplers for batch in sampler for pair in listed(batch))
    assert set(drawn) == all_pairs(samplers[0].table)
    batches, units = len(samplers[0]) * len(samplers), units_of(samplers[0])
    assert max(drawn.values()) == math.ceil(batches / units) if batches > units else set(drawn.values()) == {1}


@settings(deadline=None, derandomize=True, max_examples=150)
@given(block_samplers())
def test_every_rank_has_equally_many_batches_and_none_is_empty(samplers):
    for sampler in samplers:
        batches = list(sampler)
        assert len(batches) == len(sampler) == len(samplers[0]) > 0
        assert all(len(batch) > 0 for batch in batches)


@settings(deadline=None, derandomize=True, max_examples=100)
@given(block_samplers())
def test_a_batch_has_few_views_and_no_pair_twice(samplers):
    for batch in samplers[0]:
        assert len(set(listed(batch))) == len(batch)
        assert len(np.unique(batch)) <= 2 * samplers[0].block * samplers[0].units_per_batch


@pytest.mark.parametrize(("counts", "block"), [((16, 24), 8), ((8, 8, 12), 4), ((208,), 8)])
def test_a_view_serves_at_least_a_block_of_pairs(counts, block):
    for batch in BlockSampler(table_of(*counts), 1024, block, seed=0):
        assert len(batch) / len(np.unique(batch)) >= block


def test_batches_have_about_the_requested_size():
    sizes = [len(batch) for batch in BlockSampler(table_of(208, 208), 1024, 8, seed=0)]
    assert abs(np.mean(sizes) / 1024 - 1) < 0.1 and max(sizes) < 1.2 * 1024 and min(sizes) > 0.8 * 1024


@pytest.mark.parametrize("count", [2, 5, 8, 9, 15, 16, 17])  # below a block of 8, just one, and around two
def test_blocks_that_do_not_divide(count):
    table = table_of(count)
    drawn = Counter(pair for batch in BlockSampler(table, 64, 8, seed=3) for pair in listed(batch))
    assert drawn == Counter(all_pairs(table))


def test_the_order_depends_on_seed_and_epoch_alone():
    def order(seed: int, epoch: int) -> list[tuple[int, int]]:
        sampler = BlockSampler(table_of(10, 13), 60, 4, seed)
        sampler.set_epoch(epoch)
        list(sampler)  # going through it changes nothing
        return [pair for batch in sampler for pair in listed(batch)]

    orders = {key: order(*key) for key in itertools.product(range(3), range(3))}
    assert all(order(*key) == found for key, found in orders.items())
    assert len({tuple(found) for found in orders.values()}) == 9


def test_batches_mix_objects():
    batch = next(iter(BlockSampler(table_of(24, 24, 24, 24), 1024, 8, seed=0)))
    assert len(np.unique(batch // 24)) > 1


@pytest.mark.parametrize("ranks", [2, 3, 5])
def test_all_ranks_together_cover_the_pairs_of_one_process(ranks):
    table = table_of(11, 20)
    samplers = [BlockSampler(table, 100, 4, 1, rank, ranks) for rank in range(ranks)]
    shares = [{pair for batch in sampler for pair in listed(batch)} for sampler in samplers]
    assert set.union(*shares) == all_pairs(table)
    assert sum(map(len, shares)) == len(all_pairs(table))  # disjoint


def test_an_object_with_one_view_cannot_be_trained_on():
    with pytest.raises(UserError, match="object 'b' has 1 view to train on"):
        BlockSampler(table_of(8, 1), 100, 4, seed=0)


# ---------------------------------------------------------------- lists


@settings(deadline=None, derandomize=True)
@given(st.integers(1, 60), st.integers(1, 25), st.integers(1, 5))
def test_a_list_goes_through_in_order_with_repeats_at_the_end_only(count, batch_pairs, ranks):
    pairs = np.arange(2 * count).reshape(count, 2)
    shares = [shard_batches(in_batches(pairs, batch_pairs), rank, ranks) for rank in range(ranks)]
    in_turn = [batch for turn in zip(*shares, strict=True) for batch in turn]
    batches = math.ceil(count / batch_pairs)
    np.testing.assert_array_equal(np.concatenate(in_turn[:batches]), pairs)
    assert all(len(batch) == batch_pairs for batch in in_turn[: batches - 1])
    assert len(in_turn) - batches < ranks
    for extra, batch in enumerate(in_turn[batches:]):
        np.testing.assert_array_equal(batch, in_turn[extra % batches])


# ---------------------------------------------------------------- batches


@pytest.fixture
def data() -> PairData:
    table = table_of(6, 9)
    random = np.random.default_rng(0)
    images = random.integers(0, 256, (len(table), 4, 4, 3), dtype=np.uint8)
    return PairData(table, images, None)


def test_a_batch_has_each_view_once_and_points_to_it(data):
    for pairs in BlockSampler(data.table, 60, 4, seed=0):
        batch = data[pairs]
        views = np.unique(pairs)
        assert len(batch) == len(pairs) and batch.images.shape == (len(views), 3, 4, 4)
        for side, column in ((batch.reference, 0), (batch.query, 1)):
            assert torch.equal(batch.cameras[side], data.table.cameras[torch.from_numpy(pairs[:, column])])
            assert torch.equal(batch.images[side], as_images(torch.from_numpy(data.images[pairs[:, column]])))
            assert torch.equal(batch.poses[side], data.table.poses[torch.from_numpy(pairs[:, column])])
            assert torch.equal(batch.objects[side], data.table.object_of_view[torch.from_numpy(pairs[:, column])])
        assert torch.equal(batch.objects[batch.reference], batch.objects[batch.query])
        assert batch.pairs.tolist() == pairs.tolist()
        assert batch.names == [data.table.view_names[view] for view in views]


def test_relative_poses_are_the_true_ones(data):
    pairs = data.table.pairs("ordered")
    reference, query = (data.table.poses[torch.from_numpy(side)] for side in pairs.T)
    found = data[pairs].relative_poses()
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, relative_pose(reference, query).float(), rtol=0, atol=0)


def test_a_batch_of_one_pair_and_of_a_repeated_pair(data):
    batch = data[np.array([[4, 2]])]
    assert len(batch) == 1 and len(batch.images) == 2
    assert torch.equal(batch.poses[batch.query], data.table.poses[[2]])
    batch = data[np.array([[4, 2], [4, 2], [2, 4]])]
    assert len(batch) == 3 and len(batch.images) == 2


def test_features_take_the_place_of_images(data):
    features = np.random.default_rng(1).normal(size=(len(data.table), 5)).astype(np.float32)
    batch = PairData(data.table, data.images, features)[np.array([[7, 12], [12, 8]])]
    assert batch.pixels is None and batch.features.dtype == torch.float32
    np.testing.assert_array_equal(batch.features[batch.reference], features[[7, 12]])
    np.testing.assert_array_equal(batch.features[batch.query], features[[12, 8]])


def test_views_may_be_some_rows_of_larger_arrays(data):
    rows = np.random.default_rng(0).permutation(20)[: len(data.table)]
    larger = np.zeros((20, *data.images.shape[1:]), np.uint8)
    larger[rows] = data.images
    pairs = np.array([[7, 12], [12, 8]])
    assert torch.equal(PairData(data.table, larger, rows=rows)[pairs].images, data[pairs].images)


def test_a_batch_does_not_write_into_the_cache(tmp_path, recwarn):
    pixels = np.full((2, 4, 4, 3), 100, np.uint8)
    np.save(tmp_path / "images.npy", pixels)
    mapped = np.load(tmp_path / "images.npy", mmap_mode="r")
    batch = PairData(table_of(2), mapped, None)[np.array([[0, 1]])]
    batch.pixels.zero_()
    np.testing.assert_array_equal(mapped, pixels)
    assert [str(warning.message) for warning in recwarn] == []


def test_images_run_from_minus_one_to_one_exactly():
    pixels = torch.arange(256, dtype=torch.uint8).repeat_interleave(3).reshape(1, 16, 16, 3)
    images = as_images(pixels)
    assert images.dtype == torch.float32 and images.shape == (1, 3, 16, 16)
    assert images.min() == -1 and images.max() == 1
    assert images.unique().numel() == 256
    np.testing.assert_allclose((images[0, 1].flatten() + 1) * 127.5, np.arange(256), atol=1e-4)


def test_channels_and_rows_keep_their_places():
    pixels = torch.zeros(2, 4, 6, 3, dtype=torch.uint8)
    pixels[1, 3, 5, 2] = 255
    assert torch.argwhere(as_images(pixels) > 0).tolist() == [[1, 2, 3, 5]]
