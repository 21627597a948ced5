"""Decoding of camera images, and resizing to square frames: uint8 [H, W, 3], RGB."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
import simplejpeg
from PIL import Image, UnidentifiedImageError

from hma_jax.runtime.cores import usable_cores

JPEG_MAGIC = b"\xff\xd8\xff"
BY_PILLOW = {"PNG": b"\x89PNG\r\n\x1a\n", "WebP": b"RIFF", "BMP": b"BM"}
"""Formats that Pillow decodes, and the bytes that they begin with."""

MAX_PIXELS = 2**25
"""Largest number of pixels of an image that is decoded: more than 8K video has. A damaged header of a few bytes can
claim billions."""

MAX_THREADS = 8
"""Threads that decode frames, unless a user asks for more."""


def decoding_threads() -> int:
    """One per core, up to MAX_THREADS: decoding runs outside the interpreter's lock."""
    return min(usable_cores(), MAX_THREADS)


def decode_image(data: bytes) -> np.ndarray:
    """uint8 [H, W, 3] from JPEG, PNG, WebP or BMP bytes (grey images become RGB, alpha is dropped).

    The fast DCT is the default of TensorFlow's decoder, so pixels equal those of RLDS pipelines built on
    TensorFlow. Every image is decoded at its own size: libjpeg could shrink it while decoding at half the cost, but
    with another filter than `fit_image`, and a tokenizer would then be trained on frames other than those that it
    encodes. Raises ValueError if the bytes are not an image, have more than MAX_PIXELS, or are a depth image.
    """
    if data.startswith(JPEG_MAGIC):
        _check_pixels(data, *simplejpeg.decode_jpeg_header(data)[:2])
        return simplejpeg.decode_jpeg(data, colorspace="RGB", fastdct=True)
    try:
        with Image.open(io.BytesIO(data), formats=[*map(str.upper, BY_PILLOW)]) as image:
            _check_pixels(data, *image.size)
            if image.mode.startswith("I"):  # made RGB, nearly all of them would be white
                raise ValueError(f"{len(data)} bytes of 16-bit grey values, such as depths, which are not an image")
            return np.asarray(image.convert("RGB"))
    except (UnidentifiedImageError, OSError, SyntaxError) as error:  # the last one is for broken PNG chunks
        format = next((name for name, magic in BY_PILLOW.items() if data.startswith(magic)), None)
        what = f"of a damaged {format} image" if format else "that are no JPEG, PNG, WebP or BMP image"
        raise ValueError(f"{len(data)} bytes {what}") from error
    except Image.DecompressionBombError as error:
        raise ValueError(f"{len(data)} bytes of an image that is too large for a frame ({error})") from error


def _check_pixels(data: bytes, height: int, width: int) -> None:
    if height * width > MAX_PIXELS:
        raise ValueError(
            f"{len(data)} bytes of an image that is too large for a frame ({height * width:,} pixels, more than "
            f"{MAX_PIXELS:,})"
        )


def fit_image(image: np.ndarray, size: int) -> np.ndarray:
    """The central square of `image` [H, W, 3], resampled to [size, size, 3].

    Equals resizing the shorter side to `size` and cropping the centre, in one step and
    without rounding the longer side. Down-scaling is antialiased.
    DIFFERS: the release resamples without antialiasing, and images longer than 1024 pixels
    go through a first resize of the wrong aspect ratio (reference section 5.1).
    """
    height, width = image.shape[:2]
    if (height, width) == (size, size):
        return image
    side = min(height, width)
    left, top = (width - side) / 2, (height - side) / 2
    box = (left, top, left + side, top + side)
    return np.asarray(Image.fromarray(image).resize((size, size), Image.Resampling.BILINEAR, box=box))


def fit_images(images: Sequence[np.ndarray] | np.ndarray, size: int) -> np.ndarray:
    """`fit_image` of each, uint8 [n, size, size, 3]; the array itself if it is of that size."""
    if isinstance(images, np.ndarray) and images.shape[1:3] == (size, size):
        return images
    return np.stack([fit_image(image, size) for image in images])
