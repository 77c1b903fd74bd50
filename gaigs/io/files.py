"""Files that are written whole or not at all."""

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path

UNWRITTEN = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)
"""Errors of the system that only writing meets."""


@contextlib.contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Where to write a file that takes its place once it is whole; the name ends as the file's own does.

    Where the writing fails or is stopped, nothing of it is left, and what was there before stands. It is on the disk
    before it takes its place, so that after a power cut there is the one file or the other.

    Raises:
        OSError: It cannot be written, e.g. as the disk is full or the folder is gone; with the number of the cause.
    """
    path = Path(path)
    part = path.with_name(f"{path.stem}.part{path.suffix}")
    try:
        if not path.parent.is_dir():  # which some writers would make anew, though it was removed
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))
        yield part
        with open(part, "r+b") as written:
            try:
                os.fsync(written.fileno())
            except OSError as error:
                if error.errno != errno.EINVAL:  # a file system that knows no such thing
                    raise
        part.replace(path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            part.unlink()
        if not isinstance(error, OSError):
            raise
        told = _unwritten(path, error)
        raise (OSError(told) if error.errno is None else OSError(error.errno, told)) from error


def write_text(path: str | Path, text: str) -> None:
    """Writes a text file in UTF-8, whole or not at all, as ``atomic_write`` has it.

    Raises:
        OSError: It cannot be written.
    """
    with atomic_write(path) as part:
        part.write_text(text, encoding="utf-8")


def sentence(error: OSError, folder: Path) -> str:
    """What a user can do about an error: its own words, or, where it has but those of the system, ours.

    Args:
        error: Of a file.
        folder: Where it is written, if the error names no file.
    """
    if error.errno is None or error.strerror != os.strerror(error.errno):
        return str(error.strerror or error)
    path = error.filename or f"a file in {folder}"
    if error.errno in UNWRITTEN:
        return _unwritten(path, error)
    return (
        f"{path} could not be read or written ({error.strerror}); see that its folder is there, that both may be used, "
        "and try again"
    )


def _unwritten(path: object, error: OSError) -> str:
    return (
        f"{path} could not be written ({error.strerror or error}); see that its folder is there, can be written to and "
        "has room, and try again"
    )
