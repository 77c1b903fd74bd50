"""Files that are written whole or not at all."""

import contextlib
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def whole(path: str | Path) -> Iterator[Path]:
    """Where to write a file that takes its place once it is whole; the name ends as the file's own does.

    Where the writing fails or is stopped, nothing of it is left, and what was there before stands.

    Raises:
        OSError: It cannot be written, e.g. as the disk is full; with the number of the cause.
    """
    path = Path(path)
    part = path.with_name(f"{path.stem}.part{path.suffix}")
    try:
        yield part
        part.replace(path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            part.unlink()
        if not isinstance(error, OSError):
            raise
        told = (
            f"{path} could not be written ({error.strerror or error}); see that its folder is there, can be written "
            "to and has room, and try again"
        )
        raise (OSError(told) if error.errno is None else OSError(error.errno, told)) from error
