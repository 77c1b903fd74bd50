"""Grey images: headers are checked at once, pixels when they are asked for."""

import re

import numpy as np
import pytest
import torch
from PIL import Image

from gaigs.io.images import GreyImages

SHAPE = (90, 360)


@pytest.fixture
def files(tmp_path):
    """Three images of random pixels."""
    found = [tmp_path / f"{k}.png" for k in range(3)]
    for k, file in enumerate(found):
        Image.fromarray(np.random.default_rng(k).integers(0, 256, SHAPE, dtype=np.uint8)).save(file)
    return found


def test_an_image_is_decoded_once_and_when_asked(files):
    images = GreyImages(files, SHAPE)
    first = images[torch.tensor([0, 2, 0])]
    assert first.dtype == torch.float32
    expected = [np.random.default_rng(k).integers(0, 256, SHAPE, dtype=np.uint8) for k in (0, 2, 0)]
    np.testing.assert_allclose(first, np.stack(expected) / 255, atol=1e-7)
    assert len(images) == 3
    assert images[torch.tensor([], dtype=torch.long)].shape == (0, *SHAPE)
    for file in files:
        file.unlink()
    assert torch.equal(images[torch.tensor([2, 0])], first[1:])
    with pytest.raises(
        ValueError, match=r"cannot parse .*1\.png: no whole PNG image \(.*\); copy it again"
    ):
        images[torch.tensor([0, 1])]


def save(array):
    return lambda file: Image.fromarray(array).save(file)


def cut(size):
    return lambda file: file.write_bytes(file.read_bytes()[:size])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (save(np.zeros((90, 361), np.uint8)), "of 90 x 360 pixels, got mode L of 90 x 361"),
        (
            lambda file: Image.new("L", (360, 90)).save(file, format="jpeg"),
            "no whole PNG image (cannot identify image",
        ),
        *((cut(size), "no whole PNG image (") for size in (0, 20, 40)),
    ],
)
def test_a_header_with_a_defect_is_refused_at_once(files, damage, message):
    damage(files[1])
    with pytest.raises(ValueError, match=rf"1\.png: .*{re.escape(message)}"):
        GreyImages(files, SHAPE)


GREY = np.random.default_rng(1).integers(0, 256, SHAPE, dtype=np.uint8)


@pytest.mark.parametrize(
    "image",
    [
        Image.fromarray(np.stack((GREY,) * 3, -1)),
        Image.fromarray(np.stack((GREY, np.full_like(GREY, 255)), -1)),
        Image.fromarray(np.stack((GREY,) * 3, -1)).convert("RGBA"),
        Image.fromarray(GREY).convert("P"),
        Image.fromarray(GREY.astype(np.uint16) * 257),
    ],
    ids=lambda image: image.mode,
)
def test_grey_values_are_read_from_every_kind_of_png(files, image):
    plain = GreyImages(files, SHAPE)[torch.tensor([1])]
    image.save(files[1])
    assert torch.equal(GreyImages(files, SHAPE)[torch.tensor([1, 0])][:1], plain)


def test_sixteen_bits_are_kept(files):
    fine = np.arange(90 * 360, dtype=np.uint16).reshape(SHAPE)
    Image.fromarray(fine).save(files[1])
    np.testing.assert_allclose(
        GreyImages(files, SHAPE)[torch.tensor([1])][0], fine / 65535, rtol=1e-6
    )


@pytest.mark.parametrize(
    ("channel", "value", "message"),
    [
        (
            1,
            GREY[3, 5] ^ 1,
            "expected grey values, got the colour [{0}, {1}, {0}] in row 3, column 5",
        ),
        (3, 254, "expected no transparent pixel, got one in row 3, column 5"),
    ],
)
def test_colours_and_transparent_pixels_are_no_grey_values(files, channel, value, message):
    pixels = np.stack((GREY, GREY, GREY, np.full_like(GREY, 255)), -1)
    pixels[3, 5, channel] = value
    Image.fromarray(pixels).save(files[1])
    with pytest.raises(
        ValueError, match=rf"1\.png: {re.escape(message.format(GREY[3, 5], value))}"
    ):
        GreyImages(files, SHAPE)[torch.tensor([1])]


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "P"])
def test_a_colour_map_is_named(files, mode):
    ramp = np.stack((GREY, 255 - GREY, np.full_like(GREY, 80)), -1)
    Image.fromarray(ramp).convert(mode).save(files[1])
    with pytest.raises(
        ValueError,
        match=r"^[^ ]*1\.png: expected grey values, got the colour .*; as of a colour map: store the",
    ):
        GreyImages(files, SHAPE)[torch.tensor([1])]


@pytest.mark.parametrize("place", [45, 100, 6000, 20000, -60, -5000])
def test_a_damaged_byte_is_no_other_pixel(files, place):
    content = bytearray(files[1].read_bytes())
    content[place] ^= 0x10
    files[1].write_bytes(content)
    with pytest.raises(ValueError, match=r"1\.png: no whole PNG image"):
        GreyImages(files, SHAPE)[torch.tensor([1])]
