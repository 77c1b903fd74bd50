"""Files of named arrays: numpy's .npz, MATLAB's .mat and HDF5."""

import contextlib
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.io
from numpy import ndarray


class ArrayFile(NamedTuple):
    """An open file: the names of its arrays, and the function that reads one."""

    names: list[str]
    read: Callable[[str], ndarray]


class ArrayFormat(NamedTuple):
    """A format of files of arrays."""

    # Opens a file as a context manager.
    open: Callable[[Path], contextlib.AbstractContextManager[ArrayFile]]
    description: str  # words for errors
    is_matlab: bool  # True if vectors may have two axes and whole numbers may be doubles


def array_format(file: Path) -> ArrayFormat:
    """The format of a file, from its first bytes or otherwise its name."""
    signature = b"\x89HDF\r\n\x1a\n"
    with file.open("rb") as stream:
        start = stream.read(520)
    # MATLAB 7.3 puts 512 bytes of its own in front.
    if signature in (start[:8], start[512:520]):
        return ArrayFormat(_open_hdf5, "an HDF5 file", is_matlab=True)
    if file.suffix.lower() == ".mat":
        return ArrayFormat(_open_mat, "a .mat file as MATLAB writes it", is_matlab=True)
    return ArrayFormat(_open_npz, "an .npz file as numpy.savez writes it", is_matlab=False)


@contextlib.contextmanager
def _open_npz(file: Path) -> Iterator[ArrayFile]:
    """An .npz file; a ``ValueError`` for a single array, or on reading a damaged array."""
    # Opened here, since numpy leaves a damaged file open; it warns of headers written by Python 2.
    with file.open("rb") as stream, warnings.catch_warnings(action="ignore"):
        content = np.load(stream, allow_pickle=False)
        if not isinstance(content, np.lib.npyio.NpzFile):
            raise ValueError(f"a single array of shape {content.shape}")

        def read(name: str) -> ndarray:
            with content.zip.open(f"{name}.npy") as member:
                array = np.lib.format.read_array(member, allow_pickle=False)
                # At the end of a member zipfile compares checksums.
                if member.read(1):
                    raise ValueError(f"more numbers than its shape {array.shape} has")
            return array

        yield ArrayFile([name.removesuffix(".npy") for name in content.zip.namelist()], read)


@contextlib.contextmanager
def _open_mat(file: Path) -> Iterator[ArrayFile]:
    """A MATLAB file before version 7.3."""

    def read(name: str) -> ndarray:
        return np.asarray(scipy.io.loadmat(file, variable_names=[name])[name])

    yield ArrayFile([name for name, *_ in scipy.io.whosmat(file)], read)


@contextlib.contextmanager
def _open_hdf5(file: Path) -> Iterator[ArrayFile]:
    """An HDF5 file, such as MATLAB's from version 7.3 on; an ``ImportError`` without h5py."""
    try:
        import h5py
    except ModuleNotFoundError as error:
        raise ImportError(f"{file} needs h5py: pip install 'gaigs[hdf5]'") from error
    with h5py.File(file, "r") as content:
        names: list[str] = []

        def note_array(name: str, item: object) -> None:
            # MATLAB keeps the entries of cell arrays below #refs#.
            if isinstance(item, h5py.Dataset) and not name.startswith("#refs#"):
                names.append(name)

        def read(name: str) -> ndarray:
            array = content[name][()]
            if array.dtype.names and len(array.dtype.names) == 2:  # MATLAB's complex numbers
                real, imaginary = (array[part] for part in array.dtype.names)
                array = real + 1j * imaginary
            # MATLAB's arrays have reversed axes, and an attribute.
            return array.T if "MATLAB_class" in content[name].attrs else array

        content.visititems(note_array)
        yield ArrayFile(names, read)
