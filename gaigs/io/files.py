"""Atomic writes: a file is complete or missing."""

import contextlib
import errno
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

LOCK = ".lock"
"""Name of the file in a folder that a run holds; a killed run leaves it, unlocked."""


@contextlib.contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yields a temporary path with the same suffix, which finally replaces the file.

    The file is replaced after the temporary file is on the disk. Several writers do not disturb
    each other; the last one to end wins. If writing fails or is interrupted, the temporary file is
    removed and the old file stays.
    """
    path = Path(path)
    part = path.with_name(f"{path.stem}.gaigs-{secrets.token_hex(4)}.part{path.suffix}")
    try:
        if not path.parent.is_dir():  # some writers would create a folder that was removed
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))
        yield part
        with open(part, "r+b") as written:
            try:
                os.fsync(written.fileno())
            except OSError as error:
                if error.errno != errno.EINVAL:  # a file system without fsync
                    raise
        part.replace(path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            part.unlink()
        if not isinstance(error, OSError):
            raise
        message = _unwritten(path, error)
        arguments = [message] if error.errno is None else [error.errno, message]
        raise OSError(*arguments) from error


def remove_parts(folder: Path) -> None:
    """Removes the temporary files that killed writers have left in a folder."""
    for part in folder.glob("*.gaigs-????????.part*"):
        part.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Writes a text file in UTF-8 by ``atomic_write``."""
    with atomic_write(path) as part:
        part.write_text(text, encoding="utf-8")


def file_message(error: OSError, folder: Path) -> str:
    """The message for an ``OSError``: from gaigs, or file, cause and remedy of a system error."""
    if error.errno is None or error.strerror != os.strerror(error.errno):
        return str(error.strerror or error)
    path = error.filename or f"a file in {folder}"
    # Only writing raises these.
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS):
        return _unwritten(path, error)
    return (
        f"{path} could not be read or written ({error.strerror})\n"
        "check its folder and permissions, and try again"
    )


def _unwritten(path: object, error: OSError) -> str:
    """The message for a file that could not be written: cause and remedy."""
    cause = error.strerror or error
    return (
        f"{path} could not be written ({cause})\n"
        "check that its folder exists and has room, and try again"
    )
