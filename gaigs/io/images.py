"""Grey PNG images of data sets."""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from PIL import Image
from torch import Tensor


class GreyImages:
    """8-bit grey PNGs (rows, columns), decoded when first requested and then kept at one byte a pixel.

    Raises:
        ValueError: A file has no PNG header, or another mode or shape; when requested: its pixels are damaged.
    """

    def __init__(self, files: Sequence[Path], shape: tuple[int, int]):
        for file in files:
            with _opened(file) as image:  # reads the header only
                mode, (width, height) = image.mode, image.size
            if (mode, height, width) != ("L", *shape):
                raise ValueError(
                    f"{file}: expected 8-bit grey (Pillow's mode L) of {shape[0]} x {shape[1]} pixels, got mode {mode} "
                    f"of {height} x {width}"
                )
        self.files = files
        self._pixels = torch.empty(len(files), *shape, dtype=torch.uint8)
        self._decoded = torch.zeros(len(files), dtype=torch.bool)

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, indices: Int[Tensor, " k"]) -> Float[Tensor, "k rows columns"]:
        """Images with pixels in [0, 1], float32."""
        for k in indices[~self._decoded[indices]].tolist():
            with _opened(self.files[k]) as image:
                image.verify()  # compares the checksums, which decoding does not
            with _opened(self.files[k]) as image:
                self._pixels[k] = torch.from_numpy(np.array(image))
            self._decoded[k] = True
        return self._pixels[indices].float() / 255


@contextmanager
def _opened(file: Path) -> Iterator[Image.Image]:
    """A PNG file with its header read; a ``ValueError`` if it is damaged or Pillow warns of it."""
    try:
        with warnings.catch_warnings(action="error"), Image.open(file, formats=["PNG"]) as image:
            yield image
    except Exception as error:  # a damaged file makes Pillow raise exceptions of many types
        raise ValueError(f"cannot parse {file}: no whole PNG image ({error}); copy it again") from error
