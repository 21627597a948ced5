from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from data_pipelines.sources.rlds import images
from data_pipelines.sources.rlds.dataset import RldsDataset
from data_pipelines.sources.rlds.images import decode_image, fit_image
from tests.data_pipelines.fakes import REAL_DATA, png


def test_jpeg_is_decoded_with_the_fast_dct_of_tensorflow():
    """The accurate DCT differs by up to 14 grey levels on these frames; equality would mean
    that pixels are no longer those other RLDS readers see."""
    jpeg = RldsDataset(REAL_DATA).record(0)["steps/observation/image_0"][0]
    ours, accurate = decode_image(jpeg), np.asarray(Image.open(io.BytesIO(jpeg)))
    assert ours.shape == (64, 64, 3) and ours.dtype == np.uint8
    error = np.abs(ours.astype(int) - accurate)
    assert 0 < error.mean() < 3 and error.max() < 20


def test_png_is_lossless_and_grey_becomes_rgb():
    image = np.random.default_rng(0).integers(0, 255, (5, 7, 3)).astype(np.uint8)
    assert np.array_equal(decode_image(png(image)), image)
    grey = decode_image(png(image[..., 0]))
    assert np.array_equal(grey, np.repeat(image[..., :1], 3, axis=2))


@pytest.mark.parametrize("kind", ["WebP", "BMP"])
def test_formats_that_are_rare_in_records_are_decoded(kind):
    image, data = np.random.default_rng(0).integers(0, 255, (5, 7, 3)).astype(np.uint8), io.BytesIO()
    Image.fromarray(image).save(data, kind, lossless=True)
    assert np.array_equal(decode_image(data.getvalue()), image)
    with pytest.raises(ValueError, match=f"of a damaged {kind} image"):
        decode_image(data.getvalue()[:30])


def test_depths_of_16_bits_are_no_picture():
    with pytest.raises(ValueError, match="16-bit grey values, such as depths, which are not an image"):
        decode_image(png(np.arange(0, 6400, 100, np.uint16).reshape(8, 8)))


@pytest.mark.parametrize("data", [b"", b"text", b"\xff\xd8\xff\x00 broken", b"\x89PNG broken"])
def test_bytes_that_are_no_image_are_refused(data):
    with pytest.raises(ValueError):
        decode_image(data)


@pytest.mark.parametrize("end", [20, -30])
def test_a_png_that_was_cut_off_is_one(end):
    """It was called no image."""
    data = png(np.random.default_rng(0).integers(0, 256, (8, 8, 3), np.uint8))
    with pytest.raises(ValueError, match="bytes of a damaged PNG image"):
        decode_image(data[:end])


def test_image_that_would_fill_the_memory_is_refused(monkeypatch):
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 10)
    with pytest.raises(ValueError, match="too large for a frame"):
        decode_image(png(np.zeros((8, 8, 3), np.uint8)))


@pytest.mark.parametrize("kind", ["JPEG", "PNG"])
def test_image_of_too_many_pixels_is_refused_before_it_is_decoded(kind, monkeypatch):
    """A header of a few bytes: nothing of its size is allocated."""
    data = io.BytesIO()
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(data, kind)
    encoded = data.getvalue()
    assert decode_image(encoded).shape == (8, 8, 3)
    monkeypatch.setattr(images, "MAX_PIXELS", 63)
    with pytest.raises(ValueError, match=r"too large for a frame \(64 pixels, more than 63\)"):
        decode_image(encoded)


def test_jpeg_that_claims_billions_of_pixels_is_refused():
    data = io.BytesIO()
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(data, "JPEG")
    encoded = bytearray(data.getvalue())
    at = encoded.index(b"\xff\xc0") + 5  # height and width of the frame header
    encoded[at : at + 4] = b"\xff\x00\xff\x00"
    with pytest.raises(ValueError, match="4,261,478,400 pixels"):
        decode_image(bytes(encoded))


def test_other_formats_are_not_tried():
    data = io.BytesIO()
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(data, "TIFF")
    with pytest.raises(ValueError, match="that are no JPEG, PNG, WebP or BMP image"):
        decode_image(data.getvalue())


@pytest.mark.parametrize("shape", [(40, 64), (64, 40), (720, 1280), (1440, 1920), (31, 33)])
def test_the_central_square_is_kept_whatever_the_aspect(shape):
    """A ramp along each axis tells where a pixel came from."""
    height, width = shape
    side = min(shape)
    image = np.zeros((height, width, 3), np.uint8)
    image[..., 0] = np.linspace(0, 250, height)[:, None]
    image[..., 1] = np.linspace(0, 250, width)[None]
    out = fit_image(image, 16).astype(float)
    assert out.shape == (16, 16, 3)
    centres = (np.arange(16) + 0.5) / 16 * side - 0.5
    rows = (centres + (height - side) / 2) * 250 / (height - 1)
    columns = (centres + (width - side) / 2) * 250 / (width - 1)
    inner = slice(1, -1)  # the filter is cut at the border
    assert np.abs(out[..., 0] - rows[:, None])[inner].max() < 2.5
    assert np.abs(out[..., 1] - columns[None])[:, inner].max() < 2.5


def resize_and_crop(image: np.ndarray, size: int) -> np.ndarray:
    """By definition, in float: a triangle filter on the whole image, of which the central
    square is evaluated, with no rounding of the longer side in between."""
    scale = min(image.shape[:2]) / size
    out = image.astype(float)
    for axis in (0, 1):
        length = image.shape[axis]
        centres = (np.arange(size) + 0.5 - size / 2) * scale + length / 2
        distance = np.abs(np.arange(length) + 0.5 - centres[:, None])
        weights = np.clip(1 - distance / max(scale, 1), 0, None)
        out = np.moveaxis(np.tensordot(weights / weights.sum(axis=1, keepdims=True), out, (1, axis)), 0, axis)
    return out


@pytest.mark.parametrize("size", [64, 96])
@pytest.mark.parametrize(
    "shape",
    [(480, 640), (640, 480), (720, 1280), (1280, 720), (1080, 1920), (97, 211), (64, 1500), (50, 41), (9, 9)],
)
def test_resizing_equals_its_definition_at_every_aspect(shape, size):
    """Portrait, landscape, beyond the 1024 pixels where the release distorts, odd margins, enlarged."""
    rng = np.random.default_rng(shape[0])
    coarse = Image.fromarray(rng.integers(0, 256, (9, 13, 3)).astype(np.uint8))
    image = np.asarray(coarse.resize(shape[::-1], Image.Resampling.BICUBIC))
    noisy = np.clip(image + rng.normal(0, 20, image.shape), 0, 255).astype(np.uint8)
    out = fit_image(noisy, size)
    assert out.shape == (size, size, 3) and out.dtype == np.uint8
    assert np.abs(out - resize_and_crop(noisy, size)).max() <= 1.5  # two passes of rounding


def test_down_scaling_is_antialiased():
    checks = np.indices((64, 64)).sum(axis=0) % 2 * 255
    out = fit_image(np.repeat(checks[..., None], 3, axis=2).astype(np.uint8), 16)
    assert np.abs(out.astype(int) - 127).max() < 8


def test_an_image_of_the_right_size_is_untouched():
    image = np.random.default_rng(0).integers(0, 255, (16, 16, 3)).astype(np.uint8)
    assert fit_image(image, 16) is image
