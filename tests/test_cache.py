import errno
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from view_folders import draw_view, random_poses, write_object

from lp_framework.data import cache
from lp_framework.data.cache import cached_array, decoded_views
from lp_framework.data.files import content_key
from lp_framework.errors import UserError

ROOT = Path(__file__).parents[1]
SHAPE = (3, 5, 7)
TRUTH = np.arange(105, dtype=np.float32).reshape(SHAPE)


class Fill:
    """Computes the expected array in two blocks and counts the calls."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self):
        self.calls += 1
        yield TRUTH[:2]
        yield TRUTH[2:]


@pytest.fixture
def fill() -> Fill:
    return Fill()


@pytest.fixture
def array(tmp_path, fill):
    """`array()` requests the expected array from the cache."""
    return lambda: cached_array(tmp_path / "cache", "key", len(TRUTH), fill)


@pytest.fixture
def files(tmp_path) -> list[Path]:
    """Five images of 16 pixels."""
    return sorted((write_object(tmp_path, "cup", train=5) / "train" / "rgb").iterdir())


@pytest.fixture
def opened(monkeypatch) -> list[Path]:
    """The images that have been opened since."""
    paths, original = [], Image.open

    def counting(path):
        paths.append(path)
        return original(path)

    monkeypatch.setattr(Image, "open", counting)
    return paths


# ---------------------------------------------------------------- arrays


def test_an_array_is_filled_once_and_then_mapped(array, fill, tmp_path):
    for _ in range(3):
        result = array()
        assert isinstance(result, np.memmap) and not result.flags.writeable
        np.testing.assert_array_equal(result, TRUTH)
    assert fill.calls == 1
    assert sorted(path.name for path in (tmp_path / "cache").iterdir()) == ["key.json", "key.lock", "key.npy"]


def test_keys_are_kept_apart(tmp_path, fill):
    for key in ("a", "b", "a"):
        np.testing.assert_array_equal(cached_array(tmp_path, key, len(TRUTH), fill), TRUTH)
    assert fill.calls == 2


@pytest.mark.parametrize("dtype", [np.uint8, np.float16, np.int64, bool])
@pytest.mark.parametrize("shape", [(), (9,), (2, 3, 1, 2)])
def test_arrays_of_any_shape_and_type_are_kept(tmp_path, shape, dtype):
    blocks = [np.ones((count, *shape), dtype) for count in (1, 3)]
    for _ in range(2):
        kept = cached_array(tmp_path, "key", 4, lambda: blocks)
        assert kept.shape == (4, *shape) and kept.dtype == dtype and kept.all()


def test_an_array_with_another_number_of_rows_is_recomputed(array, tmp_path):
    array()
    wider = cached_array(tmp_path / "cache", "key", 2, lambda: [np.full((2, 9), 7, np.uint8)])
    assert wider.shape == (2, 9) and wider.dtype == np.uint8 and (wider == 7).all()
    with pytest.raises(ValueError, match="the blocks of key have 2 rows, expected 3"):
        cached_array(tmp_path / "cache", "key", 3, lambda: [np.full((2, 9), 7, np.uint8)])


def npy(tmp_path: Path) -> Path:
    return tmp_path / "cache" / "key.npy"


def note(tmp_path: Path) -> Path:
    return tmp_path / "cache" / "key.json"


def test_a_truncated_array_is_detected_at_every_length(array, fill, tmp_path):
    array()
    whole = npy(tmp_path).read_bytes()
    for length in {0, 1, 5, 6, 9, 10, 60, 127, 128, 129, len(whole) // 2, len(whole) - 1}:
        npy(tmp_path).write_bytes(whole[:length])
        before = fill.calls
        np.testing.assert_array_equal(array(), TRUTH)
        assert fill.calls == before + 1, length


def test_altered_bytes_are_detected_in_the_data_and_harmless_in_the_header(array, fill, tmp_path):
    array()
    whole = npy(tmp_path).read_bytes()
    header = len(whole) - TRUTH.nbytes
    for place in [*range(header), *range(header, len(whole), 9), len(whole) - 1]:
        damaged = bytearray(whole)
        damaged[place] ^= 1
        npy(tmp_path).write_bytes(damaged)
        before = fill.calls
        np.testing.assert_array_equal(array(), TRUTH)
        assert place < header or fill.calls == before + 1, place


@pytest.mark.parametrize(
    "text",
    [None, "", "{", "garbage", "[]", "3", "null", "{}", '{"shape": 3, "dtype": 4, "checksum": "5"}', "[" * 99999],
)
def test_a_missing_or_damaged_record_is_recomputed(array, fill, tmp_path, text):
    array()
    note(tmp_path).unlink()
    if text is not None:
        note(tmp_path).write_text(text)
    for _ in range(2):
        np.testing.assert_array_equal(array(), TRUTH)
    assert fill.calls == 2


def test_a_file_that_is_not_an_array_is_recomputed(array, fill, tmp_path):
    array()
    for content in (b"PK\x03\x04 a zip file", b"\x80\x04 a pickle", b"text"):
        npy(tmp_path).write_bytes(content)
        np.testing.assert_array_equal(array(), TRUTH)
    npy(tmp_path).unlink()
    np.testing.assert_array_equal(array(), TRUTH)
    assert fill.calls == 5


def test_leftovers_of_a_killed_run_are_ignored(array, fill, tmp_path):
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache" / "key.partial.npy").write_bytes(b"half an array")
    (tmp_path / "cache" / "key.partial.json").write_text("half a no")
    np.testing.assert_array_equal(array(), TRUTH)
    assert sorted(path.name for path in (tmp_path / "cache").iterdir()) == ["key.json", "key.lock", "key.npy"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_a_fill_that_fails_half_way_leaves_nothing(array, fill, tmp_path, error):
    def half():
        yield TRUTH[:1]
        raise error

    with pytest.raises(error):
        cached_array(tmp_path / "cache", "key", len(TRUTH), half)
    assert [path.name for path in (tmp_path / "cache").iterdir() if path.suffix != ".lock"] == []
    np.testing.assert_array_equal(array(), TRUTH)
    assert fill.calls == 1


def test_a_rebuild_that_fails_does_not_spoil_what_others_have_mapped(array, tmp_path):
    mapped = array()
    note(tmp_path).write_text("garbage")

    def half():
        yield -TRUTH[:1]
        raise RuntimeError

    with pytest.raises(RuntimeError):
        cached_array(tmp_path / "cache", "key", len(TRUTH), half)
    np.testing.assert_array_equal(mapped, TRUTH)
    array()
    np.testing.assert_array_equal(mapped, TRUTH)


# ---------------------------------------------------------------- disks


def test_a_full_disk_is_a_user_error_before_more_than_a_block_is_computed(array, fill, tmp_path, monkeypatch):
    def full(*_arguments: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full, raising=False)
    with pytest.raises(UserError, match=r"cache: the cache cannot be written \(No space left.*data\.cache=FOLDER"):
        array()
    assert fill.calls == 1
    assert [path.name for path in (tmp_path / "cache").iterdir() if path.suffix != ".lock"] == []
    monkeypatch.undo()
    np.testing.assert_array_equal(array(), TRUTH)


def test_a_disk_that_is_full_at_the_end_is_a_user_error(array, tmp_path, monkeypatch):
    def full(*_arguments: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(UserError, match="No space left"):
        array()
    assert [path.name for path in (tmp_path / "cache").iterdir() if path.suffix != ".lock"] == []


def test_a_cache_has_its_disk_space_before_it_is_filled(tmp_path):
    if not hasattr(os, "posix_fallocate"):
        pytest.skip("this system cannot reserve disk space")
    reserved = []

    def look():
        yield np.zeros((1, 1000), np.uint8)
        (partial,) = tmp_path.glob("*.partial.npy")
        reserved.append(partial.stat().st_blocks * 512)
        yield np.zeros((999, 1000), np.uint8)

    cached_array(tmp_path, "key", 1000, look)
    assert reserved[0] >= 1_000_000  # a sparse file has next to nothing, and its pages meet a full disk with SIGBUS


def test_a_folder_that_cannot_be_made(tmp_path, fill):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UserError, match=r"file/cache: the cache cannot be written"):
        cached_array(tmp_path / "file" / "cache", "key", len(TRUTH), fill)


# ---------------------------------------------------------------- processes


def process(tmp_path: Path, fill_body: str) -> subprocess.Popen:
    """A process that requests the array with its own fill function and prints the sum."""
    code = f"""
        import os, signal, time
        import numpy as np
        from lp_framework.data.cache import cached_array

        def fill():
            with open("fills", "a") as log:
                log.write("x")
            whole = np.arange(105, dtype=np.float32).reshape(3, 5, 7)
            yield whole[:1]
            {fill_body}
            yield whole[1:]

        print(cached_array("cache", "key", 3, fill).sum())
    """
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(code)], cwd=tmp_path, env=environment, stdout=subprocess.PIPE, text=True
    )


@pytest.mark.heavy
def test_processes_that_want_the_same_array_fill_it_once(tmp_path, array, fill):
    running = [process(tmp_path, "time.sleep(0.5)") for _ in range(2)]
    assert [float(each.communicate(timeout=60)[0]) for each in running] == [TRUTH.sum()] * 2
    assert (tmp_path / "fills").read_text() == "x"
    np.testing.assert_array_equal(array(), TRUTH)
    assert fill.calls == 0


@pytest.mark.heavy
def test_killing_a_process_that_fills_the_cache_is_harmless(tmp_path, array, fill):
    killed = process(tmp_path, "os.kill(os.getpid(), signal.SIGKILL)")
    assert killed.wait(timeout=60) == -signal.SIGKILL
    killed.communicate()
    assert (tmp_path / "cache" / "key.partial.npy").exists()
    np.testing.assert_array_equal(array(), TRUTH)
    assert fill.calls == 1


# ---------------------------------------------------------------- keys


def test_keys_follow_the_content_not_the_place(tmp_path, files):
    key = content_key(files, "views", 16)
    copies = [tmp_path / f"copy_{index}.bin" for index in range(len(files))]
    for copy, file in zip(copies, files, strict=True):
        copy.write_bytes(file.read_bytes())
    assert content_key(copies, "views", 16) == key
    assert content_key(files[::-1], "views", 16) != key
    assert content_key(files[:-1], "views", 16) != key
    assert content_key(files, "views", 17) != key
    data = copies[2].read_bytes()
    copies[2].write_bytes(data[:-1])
    copies[3].write_bytes(data[-1:] + copies[3].read_bytes())  # the same bytes in a row, divided otherwise
    assert content_key(copies, "views", 16) != key


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(UserError, match=r"gone\.png: cannot be read \(No such file"):
        content_key([tmp_path / "gone.png"])


# ---------------------------------------------------------------- decoded views


def test_an_image_is_decoded_once(files, tmp_path, opened):
    key, first = decoded_views(files, 16, tmp_path / "cache")
    assert sorted(opened) == files
    again, second = decoded_views(files, 16, tmp_path / "cache")
    assert len(opened) == len(files) and again == key
    np.testing.assert_array_equal(first, second)
    assert first.shape == (5, 16, 16, 3) and first.dtype == np.uint8


def test_the_same_images_elsewhere_are_not_decoded_again(files, tmp_path, opened):
    key, _ = decoded_views(files, 16, tmp_path / "cache")
    files[0].parent.rename(tmp_path / "moved")
    assert decoded_views([tmp_path / "moved" / file.name for file in files], 16, tmp_path / "cache")[0] == key
    assert len(opened) == len(files)


def test_a_changed_pixel_is_decoded_again(files, tmp_path):
    key, first = decoded_views(files, 16, tmp_path / "cache")
    pixels = np.array(Image.open(files[3]))
    pixels[8, 8, 0] ^= 1
    Image.fromarray(pixels).save(files[3])
    other, second = decoded_views(files, 16, tmp_path / "cache")
    assert other != key
    assert np.argwhere(first != second).tolist() == [[3, 8, 8, 0]]


@pytest.mark.parametrize("alpha", [0, 1, 127, 128, 254, 255])
def test_composition_over_white_is_exact(tmp_path, alpha):
    colours = np.arange(256, dtype=np.uint8).reshape(16, 16)
    layers = [colours, colours.T, 255 - colours, np.full_like(colours, alpha)]
    Image.fromarray(np.stack(layers, axis=-1)).save(tmp_path / "000.png")
    _, images = decoded_views([tmp_path / "000.png"], 16, tmp_path / "cache")
    a = alpha / 255
    exact = a * np.stack(layers[:3], axis=-1) + (1 - a) * 255
    np.testing.assert_array_equal(images[0], np.round(exact))


def test_other_image_modes_are_converted(tmp_path):
    grey = np.arange(256, dtype=np.uint8).reshape(16, 16)
    image = Image.fromarray(grey)
    files = [tmp_path / f"{mode}.png" for mode in ("L", "RGB", "LA", "P")]
    for file in files:
        image.convert(file.stem).save(file)
    _, images = decoded_views(files, 16, tmp_path / "cache")
    for pixels in images:
        np.testing.assert_array_equal(pixels, np.repeat(grey[..., None], 3, axis=-1))


def test_smaller_views_are_means_and_constant_images_stay_constant(files, tmp_path):
    _, full = decoded_views(files, 16, tmp_path / "cache")
    _, half = decoded_views(files, 8, tmp_path / "cache")
    means = full.reshape(5, 8, 2, 8, 2, 3).astype(float).mean(axis=(2, 4))
    assert half.shape == (5, 8, 8, 3) and np.abs(half - means).max() <= 1  # rounded once along each axis
    Image.new("RGB", (30, 30), (10, 20, 30)).save(tmp_path / "plain.png")
    for size in (8, 13, 64):
        _, plain = decoded_views([tmp_path / "plain.png"], size, tmp_path / "cache")
        assert (plain == [10, 20, 30]).all()


def test_a_transparent_pixels_colour_does_not_bleed_into_smaller_views(tmp_path):
    pixels = np.zeros((16, 16, 4), np.uint8)  # transparent black
    pixels[:, :8] = [200, 0, 0, 255]
    Image.fromarray(pixels).save(tmp_path / "000.png")
    _, images = decoded_views([tmp_path / "000.png"], 8, tmp_path / "cache")
    assert (images[0, :, :4] == [200, 0, 0]).all() and (images[0, :, 4:] == 255).all()


# ---------------------------------------------------------------- other versions of the decoder


@pytest.mark.parametrize("crop", [False, True])
def test_views_decoded_differently_are_not_reused_but_their_content_key_is_the_same(tmp_path, monkeypatch, crop):
    pixels = np.zeros((64, 64, 4), np.uint8)
    pixels[20:40, 10:50] = (200, 0, 0, 255)
    Image.fromarray(pixels).save(tmp_path / "view.png")

    def decoded() -> tuple[str, np.ndarray]:
        return decoded_views([tmp_path / "view.png"], 16, tmp_path / "cache", crop)

    with monkeypatch.context() as patch:
        patch.setattr(cache, "on_white", lambda image: np.zeros((*image.size, 3), np.uint8))  # as black as it gets
        key, wrong = decoded()
    again, right = decoded()
    assert (wrong == 0).all() and right.max() == 255 and again == key


def test_16_bit_views_decoded_differently_are_not_reused(tmp_path, monkeypatch):
    levels = np.arange(256, dtype=np.uint16).reshape(16, 16) * 257
    Image.fromarray(levels).save(tmp_path / "view.png")
    with monkeypatch.context() as patch:
        patch.setattr(cache, "eight_bit", lambda image: image)  # Pillow's own conversion cuts off above 255
        _, wrong = decoded_views([tmp_path / "view.png"], 16, tmp_path / "cache")
    _, right = decoded_views([tmp_path / "view.png"], 16, tmp_path / "cache")
    assert wrong[0, 1:].min() == 255
    np.testing.assert_array_equal(right[0, ..., 0], levels // 257)


# ---------------------------------------------------------------- images that are none


def refused(files: list[Path], cache: Path) -> str:
    """What decoding says is wrong: one line; nothing is left in the cache."""
    with pytest.raises(UserError) as caught:
        decoded_views(files, 16, cache)
    assert [path.name for path in cache.iterdir() if path.suffix != ".lock"] == []
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_truncated_image_at_any_length_is_named(files, tmp_path):
    whole = files[2].read_bytes()
    for length in [0, 4, 8, 20, 33, 40, 60, len(whole) // 2, len(whole) - 30]:
        files[2].write_bytes(whole[:length])
        assert refused(files, tmp_path / "cache").startswith(f"{files[2]}: is not a readable image")


def test_damaged_images_are_named_or_shown(files, tmp_path):
    random = np.random.default_rng(0)
    whole = np.frombuffer(files[1].read_bytes(), np.uint8)
    refusals = 0
    for place in random.choice(len(whole), 60, replace=False):
        damaged = whole.copy()
        damaged[place] ^= 1 << random.integers(8)
        files[1].write_bytes(damaged.tobytes())
        try:
            decoded_views(files, 16, tmp_path / "cache")
        except UserError as error:
            refusals += 1
            assert str(error).startswith(f"{files[1]}: is ")
    assert refusals > 30


def test_text_in_place_of_an_image_is_named(files, tmp_path):
    files[0].write_text("version https://git-lfs.github.com/spec/v1")
    assert refused(files, tmp_path / "cache").startswith(f"{files[0]}: is not a readable image")


def test_an_image_too_large_to_be_a_view_is_named(files, tmp_path, monkeypatch):
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)  # Pillow's guard against decompression bombs, at twice this
    assert "is not a readable image" in refused(files, tmp_path / "cache")


def test_images_must_be_square(files, tmp_path):
    Image.new("RGBA", (16, 12)).save(files[4])
    assert refused(files, tmp_path / "cache") == f"{files[4]}: is 16 x 12 pixels; views must be square"


def test_images_may_have_different_sizes(files, tmp_path):
    Image.fromarray(draw_view(random_poses(1, "x")[0], 24)).save(files[3])
    _, images = decoded_views(files, 16, tmp_path / "cache")
    assert images.shape == (5, 16, 16, 3)


def test_views_of_16_bits_are_those_of_8(tmp_path):
    levels = np.random.default_rng(0).integers(0, 256, (8, 8), dtype=np.uint8)
    for name, pixels in (("eight", levels), ("sixteen", levels.astype(np.uint16) * 257)):
        (tmp_path / name).mkdir()
        Image.fromarray(pixels).save(tmp_path / name / "000.png")
    eight, sixteen = (
        decoded_views([tmp_path / name / "000.png"], 8, tmp_path / "c")[1] for name in ("eight", "sixteen")
    )
    assert np.array_equal(eight, sixteen) and np.array_equal(eight[0, ..., 0], levels)
