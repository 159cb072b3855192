"""Photographs: reading any format, cutting out and framing the object, and messages for every mistake."""

from __future__ import annotations

import math
import sys
import types
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from drawn_photographs import drawn, placed
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image, features

from lp_framework.data.cache import decoded_views
from lp_framework.data.masks import mask_maker
from lp_framework.data.photograph_files import mask_beside, mask_files, photograph_files
from lp_framework.data.photographs import (
    EXTENT,
    SIZE,
    array_image,
    crop_to_object,
    cut_out,
    exif_focal,
    on_white,
    prepare,
    read_image,
    read_mask,
    read_photographs,
    save_upright,
    upright,
)
from lp_framework.errors import UserError


def object_box(image: Image.Image) -> tuple[int, int, int, int]:
    box = Image.fromarray((np.asarray(image)[..., 3] >= 128).astype(np.uint8) * 255).getbbox()
    assert box is not None
    return box


def saved(image: Image.Image, file: Path, **options) -> Path:
    image.save(file, **options)
    return file


# ---------------------------------------------------------------- framing


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 240), st.integers(0, 160))
def test_the_result_does_not_depend_on_the_objects_position(left: int, top: int):
    expected = crop_to_object(placed(drawn(), 120, 80), "a").image
    assert np.array_equal(crop_to_object(placed(drawn(), left, top), "a").image, expected)


def test_the_result_depends_on_the_objects_size_only_by_resampling():
    expected = on_white(crop_to_object(placed(drawn(), 10, 10), "a").image).astype(int)
    for scale in (2, 3, 5):
        larger = on_white(crop_to_object(placed(drawn(scale=scale), 0, 0, 400, 300), "a").image).astype(int)
        difference = np.abs(larger - expected)
        assert difference.mean() < 1.5 and np.median(difference) <= 1


@pytest.mark.parametrize(("width", "height"), [(60, 40), (40, 60), (50, 50), (500, 20)])
def test_the_object_is_centred_and_its_longest_side_fills_the_published_share(width: int, height: int):
    prepared = crop_to_object(placed(drawn(width, height), 3, 5, 600, 100), "a").image
    assert prepared.size == (SIZE, SIZE) == (256, 256) and EXTENT == 200
    left, top, right, bottom = object_box(prepared)
    pixel = EXTENT / max(width, height)  # one of the photograph
    assert abs(max(right - left, bottom - top) - EXTENT) <= pixel + 2
    assert abs(left + right - SIZE) <= 2 and abs(top + bottom - SIZE) <= 2
    source = object_box(Image.fromarray(drawn(width, height)))
    ratio = (source[2] - source[0]) / (source[3] - source[1])  # the shape is kept
    assert (right - left) / (bottom - top) == pytest.approx(ratio, rel=0.1)


def test_transparent_colours_are_invisible_and_the_background_is_white():
    image = drawn()
    hidden = image.copy()
    hidden[hidden[..., 3] == 0, :3] = [0, 255, 0]
    expected = on_white(crop_to_object(placed(image, 20, 20), "a").image)
    np.testing.assert_array_equal(on_white(crop_to_object(placed(hidden, 20, 20), "a").image), expected)
    assert (expected[0] == 255).all() and (expected[:, -1] == 255).all()


def test_on_white_is_straight_alpha():
    image = np.array([[[200, 100, 0, 255], [200, 100, 0, 0], [200, 100, 0, 51]]], dtype=np.uint8)
    assert on_white(Image.fromarray(image)).tolist() == [[[200, 100, 0], [255, 255, 255], [244, 224, 204]]]


def test_without_crop_a_rendered_view_is_what_evaluation_sees(tmp_path: Path):
    file = saved(placed(drawn(200, 100), 13, 60, 256, 256), tmp_path / "view.png")
    prepared = prepare(read_image(file), "view", crop=False)
    _, decoded = decoded_views([file], SIZE, tmp_path / "cache")
    np.testing.assert_array_equal(on_white(prepared), decoded[0])


def test_without_crop_an_image_without_background_is_taken_whole():
    image = Image.fromarray(drawn(64, 64)[..., :3])
    prepared = prepare(image, "a", crop=False)
    np.testing.assert_array_equal(on_white(prepared), np.asarray(image.resize((SIZE, SIZE), Image.Resampling.LANCZOS)))
    opaque = image.copy()
    opaque.putalpha(255)
    assert np.array_equal(prepare(opaque, "a", crop=False), prepared)
    with pytest.raises(UserError, match="a: is 64 x 32 pixels; with crop=false an image must be square"):
        prepare(image.crop((0, 0, 64, 32)), "a", crop=False)


# ---------------------------------------------------------------- masks


def in_modes(alpha: NDArray[np.uint8]) -> dict[str, Image.Image]:
    """A mask of two levels as people save them."""
    mask = alpha >= 128
    palette = Image.fromarray(mask.astype(np.uint8)).convert("P")
    palette.putpalette([0, 0, 0, 64, 0, 0] + [0] * 756)  # dark red, as segmentation sets have it
    white_first = Image.fromarray((~mask).astype(np.uint8)).convert("P")
    white_first.putpalette([255, 255, 255, 0, 0, 0] + [0] * 756)
    cutout = Image.new("RGBA", mask.shape[::-1], (9, 9, 9, 0))
    cutout.paste((9, 9, 9, 255), mask=Image.fromarray(mask))
    blue = np.zeros((*mask.shape, 3), np.uint8)
    blue[mask] = [0, 0, 255]
    opaque = Image.fromarray(mask.astype(np.uint8)).convert("RGBA")
    return {
        "grey": Image.fromarray(mask.astype(np.uint8) * 255),
        "one bit": Image.fromarray(mask),
        "zeros and ones": Image.fromarray(mask.astype(np.uint8)),
        "zeros and ones, opaque": opaque,
        "colour": Image.fromarray(mask.astype(np.uint8) * 255).convert("RGB"),
        "blue": Image.fromarray(blue),
        "palette": palette,
        "palette, white first": white_first,
        "16 bits": Image.fromarray(mask.astype(np.uint16) * 65535),
        "16 bits, zeros and ones": Image.fromarray(mask.astype(np.uint16)),
        "16 bits, 255": Image.fromarray(mask.astype(np.uint16) * 255),
        "16 bits, a number": Image.fromarray(mask.astype(np.uint16) * 1003),
        "32 bits": Image.fromarray(mask.astype(np.int32) * 100_003),
        "floats": Image.fromarray(mask.astype(np.float32)),
        "cut-out": cutout,
    }


@pytest.mark.parametrize("mode", in_modes(drawn()[..., 3]))
def test_a_mask_file_does_what_the_same_alpha_channel_does(mode: str, tmp_path: Path):
    image = np.asarray(placed(drawn(), 20, 30)).copy()
    mask = in_modes(image[..., 3])[mode]
    mask = saved(mask, tmp_path / f"mask.{'tif' if mask.mode in 'IF' else 'png'}")
    image[..., 3] = np.where(image[..., 3] >= 128, 255, 0)
    expected = prepare(Image.fromarray(image), "a")
    photograph = Image.fromarray(image[..., :3])
    assert np.array_equal(prepare(photograph, "a", read_mask(mask)), expected)
    photograph.putalpha(255)
    assert np.array_equal(prepare(photograph, "a", read_mask(mask)), expected)


def labelled(*numbers: int) -> NDArray[np.int64]:
    """A mask whose object has these numbers, in stripes."""
    inside = np.asarray(placed(drawn(120, 80), 20, 30))[..., 3] >= 128
    stripes = np.asarray(numbers)[np.arange(300) * len(numbers) // 160 % len(numbers)]
    return np.where(inside, stripes, 0)


@pytest.mark.parametrize(
    ("numbers", "dtype"),
    [((1, 2), np.uint8), ((1, 2, 3), np.uint16), ((80, 160, 240), np.uint8), ((26001, 26002), np.uint16)],
)
def test_the_labels_of_several_parts_are_the_object(numbers: tuple[int, ...], dtype: type):
    levels = labelled(*numbers)
    photograph = Image.new("RGB", (300, 200), (90, 120, 40))
    expected = prepare(photograph, "a", Image.fromarray(levels > 0))
    with pytest.warns(UserWarning, match=rf"a: its mask has {len(numbers)} labels; all of them count as the object"):
        assert np.array_equal(prepare(photograph, "a", Image.fromarray(levels.astype(dtype))), expected)
    palette = Image.fromarray(np.unique(levels, return_inverse=True)[1].astype(np.uint8).reshape(200, 300))
    palette.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0, 128, 128, 0] + [0] * 756)  # of DAVIS and VOC
    for mask in (palette, palette.convert("RGB")):
        with pytest.warns(UserWarning, match=f"{len(numbers)} labels"):
            assert np.array_equal(prepare(photograph, "a", mask), expected)


@pytest.mark.parametrize("factor", [2, 4])
def test_a_soft_mask_of_few_levels_is_not_taken_for_labels(factor: int):
    small = Image.fromarray((labelled(1)[:, ::-1] * 255).astype(np.uint8))
    levels = np.round(np.asarray(small.reduce(factor)) / 64) * 64
    mask = Image.fromarray(levels.clip(0, 255).astype(np.uint8))
    photograph = Image.new("RGB", mask.size)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        opacity = np.asarray(cut_out(photograph, "a", mask).getchannel("A"))
    np.testing.assert_array_equal(opacity, np.asarray(mask))


def test_a_picture_is_not_a_mask():
    picture = Image.fromarray(drawn()[..., :3])
    with pytest.raises(UserError, match=r"a: its mask is a picture of more than 16 colours; a mask is black and white"):
        prepare(picture, "a", picture)


def test_messages_about_masks_without_an_object():
    photograph, levels = Image.new("RGB", (300, 200)), np.asarray(placed(drawn(120, 80), 20, 30))[..., 3]
    with pytest.raises(UserError, match=r"a: none of its mask is at least half opaque \(at most 40%\)"):
        prepare(photograph, "a", Image.fromarray((levels * 0.4).astype(np.uint8)))
    for everywhere in (1, 100, 255):
        with pytest.raises(UserError, match="a: its mask marks no background, which must be black"):
            prepare(photograph, "a", Image.new("L", photograph.size, everywhere))


@pytest.mark.parametrize("size", [(300, 200), (900, 1200)])
def test_stray_pixels_far_from_the_object_are_removed(size: tuple[int, int]):
    """In masks and alpha channels; neither an island in a hole nor half of the object is a stray."""
    cut = np.asarray(placed(drawn(120, 80), 20, 30, *size)).copy()
    cut[60:64] = 0
    cut[66:74, 60:76, 3] = 0
    cut[70, 68, 3] = 255
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of two parts
        expected = prepare(Image.fromarray(cut), "a")
    stray = cut.copy()
    stray[-3, -2, 3], stray[-9:-6, 5:9, 3] = 255, 255
    message = "a: its mask has 13 pixels that lie apart from the object; they are left out"
    for image, mask in ((stray, None), (stray[..., :3], stray[..., 3])):
        with pytest.warns(UserWarning) as caught:
            mask = None if mask is None else Image.fromarray(mask)
            assert np.array_equal(prepare(Image.fromarray(image), "a", mask), expected)
        assert message in [str(each.message) for each in caught]
    separate = "a: its mask has 2 separate parts, all of which count as the object"
    assert (size == (300, 200)) == (separate in [str(each.message) for each in caught])  # in the other the gap is thin


def test_soft_masks_keep_their_edges():
    image = placed(drawn(), 20, 30)
    assert np.array_equal(prepare(image.convert("RGB"), "a", image.getchannel("A").convert("RGB")), prepare(image, "a"))


def test_a_mask_comes_before_the_alpha_channel():
    image = placed(drawn(), 20, 30)
    mask = Image.new("RGB", image.size)
    mask.paste("white", (40, 40, 60, 60))
    assert object_box(cut_out(image, "a", mask)) == (40, 40, 60, 60)


def test_the_least_opacity_is_background():
    """ID-Pose's cut-outs are 127 there."""
    image = np.asarray(placed(drawn(), 20, 30)).copy()
    image[..., 3] = np.where(image[..., 3] >= 128, 255, 0)
    expected = prepare(Image.fromarray(image), "a")
    image[image[..., 3] == 0] = [0, 0, 0, 127]
    assert np.array_equal(prepare(Image.fromarray(image), "a"), expected)


# ---------------------------------------------------------------- reading


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_the_orientation_of_the_camera_is_honoured(orientation: int, suffix: str, tmp_path: Path):
    right = Image.fromarray(np.kron(np.array([[250, 10, 80], [120, 200, 40]]), np.ones((16, 16))).astype(np.uint8))
    # What EXIF says has been done to the sensor's rows, undone.
    undo = {
        2: [Image.Transpose.FLIP_LEFT_RIGHT], 3: [Image.Transpose.ROTATE_180], 4: [Image.Transpose.FLIP_TOP_BOTTOM],
        5: [Image.Transpose.TRANSPOSE], 6: [Image.Transpose.ROTATE_90], 7: [Image.Transpose.TRANSVERSE],
        8: [Image.Transpose.ROTATE_270],
    }.get(orientation, [])  # fmt: skip
    stored = right
    for step in undo:
        stored = stored.transpose(step)
    exif = Image.Exif()
    exif[274] = orientation
    file = saved(stored, tmp_path / f"a.{suffix}", exif=exif)
    image = read_image(file)
    assert image.mode == "RGB" and image.size == right.size
    np.testing.assert_allclose(np.asarray(image)[..., 0].astype(int), np.asarray(right).astype(int), atol=6)
    with Image.open(file) as opened:
        assert np.array_equal(upright(opened), image)
    save_upright(file, tmp_path / f"copy.{suffix}")
    with Image.open(tmp_path / f"copy.{suffix}") as copy:  # of which others read the pixels alone
        assert copy.getexif().get(274, 1) == 1
        np.testing.assert_allclose(np.asarray(copy.convert("RGB")).astype(int), np.asarray(image).astype(int), atol=6)


FILM = 50 / math.hypot(36, 24)  # a focal length of 50 mm, in diagonals of the image


@pytest.mark.parametrize(
    ("tags", "expected"),
    [
        ({41989: 50}, FILM * 500),
        ({41989: 50, 37386: 9.0, 41486: 100.0}, FILM * 500),
        ({37386: 5.0, 41486: 2540.0}, 500.0),  # mm, and pixels per inch
        ({37386: 5.0, 41486: 1000.0, 41488: 3}, 500.0),  # per cm
        ({37386: 5.0, 41486: 2540.0, 40962: 800, 40963: 600}, 250.0),  # of the image before it was made smaller
        ({41989: 0, 37386: 5.0}, None),
        ({37386: 5.0, 41486: 0.0}, None),
        ({41989: "wide"}, None),
        ({}, None),
    ],
)
def test_the_focal_length_is_that_of_exif(tags: dict[int, float], expected: float | None, tmp_path: Path):
    exif = Image.Exif()
    exif[274] = 6
    exif.get_ifd(0x8769).update(tags)
    for suffix in ("jpg", "png", "webp"):
        file = saved(Image.new("RGB", (400, 300)), tmp_path / f"a.{suffix}", exif=exif)
        focal = exif_focal(read_image(file))
        assert focal is None if expected is None else focal == pytest.approx(expected)


def test_damaged_exif_data_are_ignored(tmp_path: Path):
    exif = Image.Exif()
    exif.get_ifd(0x8769)[41989] = 28
    file = saved(Image.new("RGB", (400, 300)), tmp_path / "a.jpg", exif=exif)
    assert exif_focal(read_image(file)) is not None
    file.write_bytes(file.read_bytes().replace(b"Exif\0\0MM", b"Exif\0\0XX"))
    assert exif_focal(read_image(file)) is None


GREY = np.array([[0, 64], [128, 255]], dtype=np.uint8)


@pytest.mark.parametrize(
    ("image", "mode"),
    [
        (Image.fromarray(GREY), "RGB"),
        (Image.fromarray(GREY.astype(np.uint16) * 257), "RGB"),
        (Image.fromarray(GREY.astype(np.int32) * 257), "RGB"),
        (Image.fromarray(GREY).convert("LA"), "RGBA"),
        (Image.fromarray(GREY).convert("RGB").convert("P", palette=Image.Palette.ADAPTIVE), "RGB"),
        (Image.fromarray(GREY).convert("RGBA"), "RGBA"),
    ],
    ids=["grey", "16 bits", "32 bits", "grey with alpha", "palette", "RGBA"],
)
def test_modes_are_read_with_their_levels(image: Image.Image, mode: str, tmp_path: Path):
    suffix = "tif" if image.mode == "I" else "png"
    read = read_image(saved(image, tmp_path / f"a.{suffix}"))
    assert read.mode == mode
    np.testing.assert_array_equal(np.asarray(read)[..., 0], GREY)
    np.testing.assert_array_equal(np.asarray(read)[..., 2], GREY)


def test_a_transparent_palette_colour_is_background(tmp_path: Path):
    image = Image.fromarray((drawn()[..., 3] >= 128).astype(np.uint8)).convert("P")
    image.putpalette([255, 0, 255, 10, 20, 30] + [0] * 756)
    frame = Image.new("P", (100, 100))
    frame.putpalette(image.getpalette())
    frame.paste(image, (20, 20))
    file = saved(frame, tmp_path / "a.png", transparency=0)
    prepared = prepare(read_image(file), "a")
    assert prepared.getpixel((0, 0))[3] == 0 and prepared.getpixel((128, 128)) == (10, 20, 30, 255)


def test_cmyk_photographs_are_read(tmp_path: Path):
    image = Image.new("RGB", (8, 8), (200, 100, 50)).convert("CMYK")
    read = read_image(saved(image, tmp_path / "a.jpg", quality=100))
    np.testing.assert_allclose(np.asarray(read)[4, 4], [200, 100, 50], atol=4)


def test_arrays_are_images():
    levels = drawn()
    assert np.array_equal(array_image(levels, "a"), levels)
    assert np.array_equal(array_image(levels / 255, "a"), levels)
    assert array_image(levels[..., :3].astype(np.float32) / 255, "a").mode == "RGB"


@pytest.mark.parametrize(
    ("array", "error"),
    [
        (np.zeros((4, 4)), r"a must be \[H, W, 3\] or \[H, W, 4\], got \[4, 4\]"),
        (np.zeros((3, 4, 5)), r"got \[3, 4, 5\]"),
        (np.zeros((0, 4, 3)), r"got \[0, 4, 3\]"),
        (np.full((4, 4, 3), 2.0), r"a must be uint8, or floats in \[0, 1\]"),
        (np.full((4, 4, 3), np.nan), r"floats in \[0, 1\]"),
        (np.zeros((4, 4, 3), dtype=np.int64), r"a must be uint8, or floats in \[0, 1\], got int64"),
    ],
)
def test_arrays_that_are_not_images(array, error: str):
    with pytest.raises(UserError, match=error):
        array_image(array, "a")


# ---------------------------------------------------------------- mistakes


def test_files_that_are_not_images(tmp_path: Path):
    with pytest.raises(UserError, match=r"none\.png: there is no such file$"):
        read_image(tmp_path / "none.png")
    (tmp_path / "text.png").write_text("not an image")
    whole = saved(Image.fromarray(drawn(200, 200)), tmp_path / "whole.png").read_bytes()
    (tmp_path / "cut.png").write_bytes(whole[: len(whole) // 2])
    for name in ("text.png", "cut.png"):
        with pytest.raises(UserError, match=rf"{name}: is not a readable image \("):
            read_image(tmp_path / name)
    with pytest.raises(UserError, match="is a folder; give an image file"):
        read_image(tmp_path)
    floats = saved(Image.fromarray(np.zeros((4, 4), dtype=np.float32)), tmp_path / "float.tif")
    with pytest.raises(
        UserError, match=r"float\.tif: is not a readable image \(ValueError: its pixels are floating-point numbers"
    ):
        read_image(floats)


def test_images_without_an_object():
    image = Image.new("RGB", (60, 40))
    black = Image.new("RGB", (60, 40))
    with pytest.raises(UserError, match="a: its mask is empty: none of it is at least half opaque"):
        prepare(image, "a", black)
    with pytest.raises(UserError, match="a: its mask is empty"):
        prepare(Image.new("RGBA", (60, 40)), "a")
    small = black.copy()
    small.paste("white", (10, 10, 25, 12))
    with pytest.raises(UserError, match="a: the object is 15 pixels long, but at least 16 are needed"):
        prepare(image, "a", small)
    small.paste("white", (10, 10, 26, 12))
    prepare(image, "a", small)
    with pytest.raises(UserError, match="a: its mask marks no background, which must be black"):
        prepare(image, "a", Image.new("RGB", (60, 40), "white"))
    with pytest.raises(UserError, match="a: is 60 x 40 pixels but its mask is 40 x 60"):
        prepare(image, "a", Image.new("RGB", (40, 60)))


@pytest.mark.parametrize("alpha", [None, 255, 128])
def test_an_image_without_mask_says_what_to_do(alpha: int | None):
    image = Image.new("RGB", (60, 40))
    if alpha is not None:
        image.putalpha(alpha)
    with pytest.raises(UserError) as error:
        prepare(image, "a.jpg")
    assert str(error.value) == (
        "a.jpg: has no transparent background (alpha channel) and no mask; give masks=FOLDER or "
        "remove_background=true, or crop=false if it shows the object on white already"
    )


def test_photographs_are_those_of_a_folder_by_name_or_of_a_list_as_given(tmp_path: Path):
    image = Image.fromarray(drawn())
    for name in ("b.png", "a.PNG", "c.webp", ".hidden.png"):
        image.save(tmp_path / name)
    for name in ("notes.txt", "cameras.json", ".DS_Store"):
        (tmp_path / name).touch()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert [file.name for file in photograph_files(tmp_path)] == ["a.PNG", "b.png", "c.webp"]
    assert photograph_files(["z.png", "a.png"]) == [Path("z.png"), Path("a.png")]


def test_photographs_are_sorted_naturally(tmp_path: Path):
    names = ["1.png", "2.png", "10.png", "IMG_09.png", "IMG_9.png", "IMG_10.png", "IMG_10 (2).png", "IMG_10 (10).png"]
    for name in sorted(names):
        Image.fromarray(drawn()).save(tmp_path / name)
    assert [file.name for file in photograph_files(tmp_path)] == names


def test_formats_of_phones_and_browsers_are_read_or_named(tmp_path: Path):
    image = Image.fromarray(drawn()[..., :3])
    for name, kind in (("a.jfif", "jpeg"), ("b.JPE", "jpeg"), ("c.gif", "gif")):
        image.save(tmp_path / name, kind)
    if features.check("avif"):
        image.save(tmp_path / "d.avif")
    for name in ("e.HEIC", "f.heif", "g.dng", "h.CR2", "i.jxl", "j.mov", "k"):
        (tmp_path / name).touch()
    message = r"files that are not read: e\.HEIC, f\.heif, g\.dng, h\.CR2, i\.jxl and 2 more; save photographs as PNG"
    with pytest.warns(UserWarning, match=message):
        files = photograph_files(tmp_path)
    assert [file.suffix for file in files] == [".jfif", ".JPE", ".gif", ".avif"][: len(files)] and len(files) >= 3
    for file in files:
        np.testing.assert_allclose(np.asarray(read_image(file))[20, 30].astype(int), drawn()[20, 30, :3], atol=12)


def test_too_few_photographs(tmp_path: Path):
    saved(Image.fromarray(drawn()), tmp_path / "a.png")
    for images, error in (
        (["a.png"], r"images=\['a\.png'\]: two or more are needed, got 1; give a list or a folder"),
        (tmp_path, rf"images={tmp_path}: two or more are needed, got 1; .*\(\.bmp, "),
        (tmp_path / "none", "none: there is no such folder; give a list"),
        (str(tmp_path / "a.png"), "a.png: is one image, but two or more are needed"),
    ):
        with pytest.raises(UserError, match=error):
            photograph_files(images)


@pytest.mark.parametrize("names", [("a-mask.png", "b-mask.png"), ("mask_a.png", "mask_b.png"), ()])
@pytest.mark.parametrize("mode", ["RGB", "RGBA"])
def test_masks_with_other_names_are_reported(names: tuple[str, ...], mode: str, tmp_path: Path):
    """Whether or not the photographs have alpha channels, which would do."""
    (tmp_path / "masks").mkdir()
    for name in names:
        placed(drawn(), 20, 30).getchannel("A").save(tmp_path / "masks" / name)
    files = [saved(placed(drawn(), 20, 30).convert(mode), tmp_path / name) for name in ("a.png", "b.png")]
    with pytest.raises(UserError) as caught:
        read_photographs(files, tmp_path / "masks", remove_background=False, crop=True)
    assert str(caught.value) == (
        f"{files[0]}: has no mask; looked for {tmp_path / 'masks' / 'a'}.png (or with another suffix), "
        f"found {', '.join(names) or 'nothing'}"
    )


def test_a_photograph_that_lacks_a_mask_others_have_is_named(rembg, tmp_path: Path):
    (tmp_path / "masks").mkdir()
    placed(drawn(), 20, 30).getchannel("A").save(tmp_path / "masks" / "a.png")
    a = saved(placed(drawn(), 20, 30).convert("RGB"), tmp_path / "a.png")
    b = saved(placed(drawn(), 20, 30), tmp_path / "b.png")
    c = saved(Image.new("RGB", (40, 40)), tmp_path / "c.png")
    lacking = r"b\.png: has no mask; looked for .*masks/b\.png \(.*\), found a\.png; its alpha channel is used"
    with pytest.warns(UserWarning, match=lacking):
        read = read_photographs([a, b], tmp_path / "masks", remove_background=False, crop=True)
    assert [each.mask is None for each in read] == [False, True]
    with pytest.raises(UserError, match=r"c\.png: has no mask; looked for .*masks/c\.png \(.*\), found a\.png$"):
        read_photographs([a, c], tmp_path / "masks", remove_background=False, crop=True)
    with pytest.warns(UserWarning, match="c.png: has no mask; .*; its whole picture is used"):
        read_photographs([a, c], tmp_path / "masks", remove_background=False, crop=False)


@pytest.mark.parametrize("name", ["{stem}_mask.png", "{stem}.mask.PNG", "{stem}.jpg.png", "dynamic_mask_{stem}.png"])
@pytest.mark.parametrize("place", ["", "masks"])
def test_masks_are_found_where_other_programs_put_them(name: str, place: str, tmp_path: Path):
    """And are not taken for photographs. Instant-ngp's mark what is *not* to be seen."""
    (tmp_path / "images" / place).mkdir(parents=True)
    cut = placed(drawn(), 20, 30)
    expected = prepare(cut.convert("RGB"), "a", cut.getchannel("A").point([0] * 128 + [255] * 128))
    for stem in ("2", "10"):
        saved(cut.convert("RGB"), tmp_path / "images" / f"{stem}.jpg", quality=100, subsampling=0)
        mask = cut.getchannel("A").point([0] * 128 + [255] * 128)
        if name.startswith("dynamic"):
            mask = mask.point(lambda level: 255 - level)
        saved(mask, tmp_path / "images" / place / name.format(stem=stem))
    files = photograph_files(tmp_path / "images")
    assert [file.name for file in files] == ["2.jpg", "10.jpg"]
    if not place:
        assert photograph_files(sorted((tmp_path / "images").iterdir())) == files[::-1]
    for masks in (None, tmp_path / "images" / place):
        for photograph in read_photographs(files, masks, remove_background=False, crop=True):
            prepared = photograph.prepared(True).image
            assert np.array_equal(prepared.getchannel("A"), expected.getchannel("A"))


def test_masks_of_nerfstudio_are_found_beside_the_images(tmp_path: Path, caplog):
    """In `masks/NAME.png` beside `images/`; an alpha channel comes before what is found there."""
    caplog.set_level("INFO")
    for folder in ("images", "masks"):
        (tmp_path / folder).mkdir()
    cut = placed(drawn(), 20, 30)
    plain = saved(cut.convert("RGB"), tmp_path / "images" / "frame_1.jpg")
    transparent = saved(cut, tmp_path / "images" / "frame_2.png")
    masks = [saved(cut.getchannel("A"), tmp_path / "masks" / f"frame_{index}.png") for index in (1, 2)]
    assert mask_beside(plain) == masks[0]
    read = read_photographs([plain, transparent], None, remove_background=False, crop=True)
    assert [each.mask is None for each in read] == [False, True]
    assert "using the masks beside the photographs: frame_1.png" in caplog.messages
    saved(cut.getchannel("A"), tmp_path / "images" / "frame_1_mask.png")
    saved(cut.getchannel("A"), tmp_path / "images" / "frame_1.mask.png")
    with pytest.raises(UserError, match=r"frame_1\.mask\.png and .*frame_1_mask\.png are both masks of .*frame_1\.jpg"):
        mask_beside(plain)
    assert mask_beside(Path("elsewhere") / "a.jpg") is None


def test_masks_are_found_by_name(tmp_path: Path):
    for name in ("a.png", "b.tif", "other.png"):
        Image.fromarray(drawn()[..., 3]).save(tmp_path / name)
    files = [Path("photos/a.jpg"), Path("photos/b.jpg"), Path("photos/c.jpg")]
    assert mask_files(files, tmp_path) == [tmp_path / "a.png", tmp_path / "b.tif", None]
    with pytest.raises(UserError, match=r"masks=none: there is no such folder"):
        mask_files(files, "none")
    with pytest.raises(
        UserError, match=r"x/a\.jpg and y/a\.jpg have the same name, so .* cannot tell their masks apart"
    ):
        mask_files([Path("x/a.jpg"), Path("y/a.jpg")], tmp_path)
    Image.fromarray(drawn()[..., 3]).save(tmp_path / "b.png")
    with pytest.raises(UserError, match=r"/b\.png and .*/b\.tif are both masks of photos/b\.jpg$"):
        mask_files(files, tmp_path)
    assert mask_files([Path("photos/a.jpg")], tmp_path) == [tmp_path / "a.png"]


# ---------------------------------------------------------------- background removal


@pytest.fixture
def rembg(monkeypatch: pytest.MonkeyPatch) -> Iterator[types.ModuleType]:
    """A mock that selects the brightest half and records its arguments."""
    module = types.ModuleType("rembg")
    module.sessions, module.modes = [], []  # type: ignore[attr-defined]

    def new_session(name: str) -> str:
        module.sessions.append(name)  # type: ignore[attr-defined]
        return f"session {name}"

    def remove(image: Image.Image, session: str, only_mask: bool) -> Image.Image:
        assert session == "session u2net" and only_mask
        module.modes.append(image.mode)  # type: ignore[attr-defined]
        return image.convert("L").point([0] * 128 + [255] * 128)

    module.new_session, module.remove = new_session, remove  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "rembg", module)
    mask_maker.cache_clear()
    yield module
    mask_maker.cache_clear()


def test_the_background_is_removed_without_alpha_or_mask(rembg):
    cut = placed(drawn(), 20, 30)
    assert np.array_equal(prepare(cut, "a", remove_background=True), prepare(cut, "a"))
    assert rembg.sessions == []  # its network is not even loaded
    photograph = Image.new("RGB", (100, 80), (20, 30, 40))
    photograph.paste((250, 240, 230), (30, 20, 70, 60))
    mask = photograph.convert("L").point([0] * 128 + [255] * 128).convert("RGB")
    for _ in range(2):
        assert np.array_equal(prepare(photograph, "a", remove_background=True), prepare(photograph, "a", mask))
    opaque = photograph.convert("RGBA")
    assert np.array_equal(prepare(opaque, "a", remove_background=True), prepare(photograph, "a", mask))
    assert rembg.sessions == ["u2net"] and rembg.modes == ["RGB"] * 3


def test_failures_of_background_removal(rembg, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(UserError, match="a: rembg found no background in it; give a mask"):
        prepare(Image.new("RGB", (60, 40), "white"), "a", remove_background=True)
    with pytest.raises(UserError, match="a: its mask is empty"):
        prepare(Image.new("RGB", (60, 40)), "a", remove_background=True)


def on_a_table(red: int = 200, size: int = 300) -> tuple[Image.Image, NDArray[np.bool_]]:
    """A photograph of an ellipse before a textured background, and where it is."""
    noise = np.random.default_rng(0).integers(150, 190, (size, size, 3), dtype=np.uint8)
    y, x = np.mgrid[:size, :size]
    shown = np.hypot((x - 0.5 * size) / 0.3, (y - 0.55 * size) / 0.2) < size
    return Image.fromarray(np.where(shown[..., None], np.uint8([red, 40, 30]), noise)), shown


def test_without_rembg_a_rough_mask_is_made_with_one_warning(rembg, monkeypatch, caplog, tmp_path: Path):
    def offline(name: str) -> None:
        raise ConnectionError("no route to host")

    mask_maker.cache_clear()
    rembg.new_session = offline
    image, shown = on_a_table()
    files = [saved(image, tmp_path / "a.png"), saved(image.convert("RGBA"), tmp_path / "b.png")]
    for photograph in read_photographs(files, None, remove_background=True, crop=True):
        assert photograph.made and photograph.mask.size == image.size
        mask = np.asarray(photograph.mask) >= 128
        assert (mask & shown).sum() > 0.97 * (mask | shown).sum()
        assert np.array_equal(photograph.prepared(True).image, prepare(image, "a", remove_background=True))
    (said,) = caplog.messages
    assert "GrabCut, because rembg cannot get its weights (no route to host); an alpha channel, masks=FOLDER" in said

    monkeypatch.setitem(sys.modules, "rembg", None)  # as if not installed
    mask_maker.cache_clear()
    caplog.clear()
    assert prepare(image, "a", remove_background=True).getpixel((0, 0))[3] == 0
    assert "because rembg is not installed (pip install 'lp_framework[masks]')" in caplog.text


def test_masks_are_not_made_where_there_are_any(rembg, tmp_path: Path):
    cut = saved(placed(drawn(), 20, 30), tmp_path / "a.png")
    plain = saved(placed(drawn(), 20, 30).convert("RGB"), tmp_path / "b.png")
    (tmp_path / "masks").mkdir()
    saved(placed(drawn(), 20, 30).getchannel("A"), tmp_path / "masks" / "b.png")
    with pytest.warns(UserWarning, match=r"a\.png: has no mask; .*; its alpha channel is used"):
        read = read_photographs([cut, plain], tmp_path / "masks", remove_background=True, crop=True)
    assert [each.made for each in read] == [False, False] and rembg.sessions == []


@pytest.mark.parametrize("size", [(3, 3), (60, 40), (900, 1400)])
def test_a_picture_of_one_colour_has_no_rough_mask(rembg, monkeypatch: pytest.MonkeyPatch, size: tuple[int, int]):
    monkeypatch.setitem(sys.modules, "rembg", None)
    mask_maker.cache_clear()
    with pytest.raises(UserError, match=r"a: (its mask is empty|GrabCut found no background|the object is 1 pixels)"):
        prepare(Image.new("RGB", size, (90, 120, 40)), "a", remove_background=True)


def test_an_object_cut_off_by_the_border_warns(caplog):
    whole, cut = placed(drawn(80, 60), 0, 40), placed(drawn(80, 60), -20, 40)
    prepare(whole, "whole.png")
    assert caplog.messages == []  # it touches the border
    prepare(cut, "cut.png")
    assert caplog.messages == [
        "cut.png: the image border seems to cut off the object; all of it should be in the picture"
    ]


def test_an_inverted_mask_is_reported(caplog):
    mask = placed(drawn(80, 60), 20, 40).getchannel("A").point(lambda level: 255 - level)
    prepare(Image.new("RGB", mask.size), "a", mask)
    assert caplog.messages == ["a: the whole image border counts as the object; a mask must be white on the object"]


# ---------------------------------------------------------------- cut-outs as they are published


def soft(left: int, top: int) -> NDArray[np.uint8]:
    """iFusion's: background of opacity 0, edges of all opacities."""
    return np.array(placed(drawn(200, 270), left, top, 512, 512))


def with_few_opacities(left: int, top: int) -> NDArray[np.uint8]:
    """A mask that has been drawn at twice the size."""
    image = soft(left, top)
    image[..., 3] = np.minimum(np.round(image[..., 3] / 64) * 64, 255)
    return image


def half_opaque(left: int, top: int) -> NDArray[np.uint8]:
    """ID-Pose's: black background of opacity 127, edges of those above."""
    image = soft(left, top)
    image[image[..., 3] == 0] = 0
    image[..., 3] = 127 + image[..., 3] // 2
    return image


@pytest.mark.parametrize("cut_out_as", [soft, with_few_opacities, half_opaque])
@pytest.mark.parametrize("place", [(40, 60), (250, 200)])
def test_published_kinds_of_cut_outs_are_framed(cut_out_as, place: tuple[int, int], tmp_path: Path):
    file = saved(Image.fromarray(cut_out_as(*place)), tmp_path / "000.png")
    prepared = prepare(read_image(file), file.name)
    left, top, right, bottom = object_box(prepared)
    assert abs(max(right - left, bottom - top) - EXTENT) <= 2 and abs(left + right - SIZE) <= 2
    corners = np.asarray(prepared)[[0, 0, -1, -1], [0, -1, 0, -1], 3]
    assert (corners == 0).all()
    assert (on_white(prepared)[:20] == 255).all()
