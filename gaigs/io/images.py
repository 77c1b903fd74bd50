"""PNG images of grey values."""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int, UInt
from PIL import Image
from torch import Tensor


class GreyImages:
    """PNGs of grey values (rows, columns), decoded at the first request and then cached.

    A pixel takes one or two bytes. White is 255 in 8-bit images and 65535 in 16-bit ones. Colour
    images must have equal channels, and no pixel may be transparent.
    """

    def __init__(self, files: Sequence[Path], shape: tuple[int, int]):
        # Pillow's modes that may hold grey values.
        allowed = {"1", "L", "LA", "P", "RGB", "RGBA", "I", "I;16", "I;16B"}
        modes = set()
        for file in files:
            with _opened(file) as image:  # reads the header only
                mode = image.mode
                width, height = image.size
            if mode not in allowed or (height, width) != shape:
                expected = f"grey values of {shape[0]} x {shape[1]} pixels"
                raise ValueError(
                    f"{file}: expected {expected}, got mode {mode} of {height} x {width}"
                )
            modes.add(mode)
        self.files = files
        dtype = np.uint16 if any("I" in mode for mode in modes) else np.uint8
        self._pixels = np.empty((len(files), *shape), dtype)
        self._decoded = torch.zeros(len(files), dtype=torch.bool)

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, indices: Int[Tensor, " k"]) -> Float[Tensor, "k rows columns"]:
        """Images with pixels in [0, 1], float32."""
        for k in indices[~self._decoded[indices]].tolist():
            with _opened(self.files[k]) as image:
                image.verify()  # compares the checksums, which decoding does not
            with _opened(self.files[k]) as image:
                image.load()
            grey = _grey(self.files[k], image)
            dtype = self._pixels.dtype
            scale = 257 if dtype == np.uint16 and grey.dtype == np.uint8 else 1  # 255 is 65535
            self._pixels[k] = grey.astype(dtype) * dtype.type(scale)
            self._decoded[k] = True
        white = np.float32(np.iinfo(self._pixels.dtype).max)
        pixels = self._pixels[indices.numpy()].astype(np.float32)  # (k, rows, columns)
        return torch.from_numpy(pixels / white)


def _grey(file: Path, image: Image.Image) -> UInt[np.ndarray, "rows columns"]:
    """The grey values of an image; a ``ValueError`` for colours and transparent pixels."""
    if image.mode.startswith("I"):
        return np.array(image).astype(np.uint16)
    if image.mode in ("1", "L"):
        return np.array(image.convert("L"))
    channels = np.array(image.convert("RGBA"))
    coloured = np.argwhere(np.ptp(channels[..., :3], -1) > 0)
    for row, column in coloured[:1]:
        got = f"the colour {channels[row, column, :3].tolist()} in row {row}, column {column}"
        if len(coloured) > channels[..., 0].size / 10:
            got += "; as of a colour map: store the grey amplitudes"
        raise ValueError(f"{file}: expected grey values, got {got}")
    for row, column in np.argwhere(channels[..., 3] < 255)[:1]:
        raise ValueError(
            f"{file}: expected no transparent pixel, got one in row {row}, column {column}"
        )
    return channels[..., 0]


@contextmanager
def _opened(file: Path) -> Iterator[Image.Image]:
    """A PNG file after reading its header; a ``ValueError`` if damaged or if Pillow warns."""
    try:
        with warnings.catch_warnings(action="error"), Image.open(file, formats=["PNG"]) as image:
            yield image
    # A damaged file makes Pillow raise exceptions of many types.
    except Exception as error:
        raise ValueError(
            f"cannot parse {file}: no whole PNG image ({error}); copy it again"
        ) from error
