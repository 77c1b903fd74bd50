"""Files are written whole or not at all."""

import errno
import os
import re
import resource
from pathlib import Path

import numpy as np
import pytest
import torch

import gaigs
from gaigs import checkpoint
from gaigs.gaussians import write_ply
from gaigs.io.files import atomic_write, file_message
from gaigs.radio_maps import RadioMap

FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_file_takes_its_place_once_it_is_whole(tmp_path):
    path = tmp_path / "scores.npz"
    path.write_text("old")
    with atomic_write(path) as part:
        part.write_text("new")
        assert path.read_text() == "old"
        assert part.suffix == ".npz", "many writers choose the format by it"
    assert path.read_text() == "new"
    assert [*tmp_path.iterdir()] == [path]


@pytest.mark.parametrize("error", [FULL, ValueError("no"), KeyboardInterrupt()], ids=["disk", "value", "ctrl-c"])
@pytest.mark.parametrize("begun", [True, False])
def test_where_writing_fails_all_is_as_before(error, begun, tmp_path):
    path = tmp_path / "scores.npz"
    path.write_text("old")

    def write():
        with atomic_write(path) as part:
            if begun:
                part.write_text("ne")
            raise error

    with pytest.raises(type(error)):
        write()
    assert path.read_text() == "old"
    assert [*tmp_path.iterdir()] == [path]


@pytest.mark.parametrize(
    ("error", "number", "cause"),
    [(FULL, errno.ENOSPC, "No space left on device"), (OSError("7 requested and 3 written"), None, "7 requested")],
)
def test_the_error_names_file_cause_and_remedy(error, number, cause, tmp_path):
    def write():
        with atomic_write(tmp_path / "scores.npz"):
            raise error

    with pytest.raises(
        OSError, match=rf"scores\.npz could not be written \({cause}.*\)\ncheck that .* and try again"
    ) as told:
        write()
    assert told.value.errno == number


def test_a_folder_that_is_not_there_is_named(tmp_path):
    values = RadioMap(np.zeros((1, 2, 2)), np.arange(2.0), np.arange(2.0), 1.0, ("west",))
    with pytest.raises(
        FileNotFoundError, match=r"nowhere/floor\.npz could not be written \(No such file or directory\)"
    ):
        values.save(tmp_path / "nowhere" / "floor.npz")


def test_a_folder_that_was_removed_is_not_made_anew(tmp_path):
    def write():
        with atomic_write(tmp_path / "removed" / "last.ckpt") as part:
            part.parent.mkdir()  # as Lightning does
            part.write_text("new")

    with pytest.raises(FileNotFoundError, match=r"last\.ckpt could not be written \(No such file or directory\)"):
        write()
    assert not [*tmp_path.iterdir()]


def test_a_file_is_on_the_disk_before_it_takes_its_place(tmp_path, monkeypatch):
    path = tmp_path / "scores.npz"
    path.write_text("old")

    def fail(_):
        assert path.read_text() == "old"
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    def write():
        with atomic_write(path) as part:
            part.write_text("new")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match=r"scores\.npz could not be written \(Input/output error\)"):
        write()
    assert path.read_text() == "old"
    assert [*tmp_path.iterdir()] == [path]


@pytest.mark.parametrize(
    ("error", "begins"),
    [
        (FULL, "a file in run could not be written (No space left on device)\ncheck that its folder"),
        (
            OSError(errno.ENOENT, os.strerror(errno.ENOENT), "log/metrics.csv"),
            "log/metrics.csv could not be read or written",
        ),
        (
            OSError(errno.EACCES, os.strerror(errno.EACCES), "data"),
            "data could not be read or written (Permission denied)",
        ),
        (OSError(errno.ENOSPC, "run/best.ckpt could not"), "run/best.ckpt could not"),
        (FileNotFoundError("nowhere must be the folder of a data set"), "nowhere must be"),
    ],
)
def test_an_error_of_the_system_becomes_a_sentence_and_others_stay(error, begins):
    assert file_message(error, Path("run")).startswith(begins)


def test_nothing_is_written_otherwise():
    """``part`` is what ``atomic_write`` gives; ``file`` and ``stream`` are opened at such a place."""
    written = re.compile(r"(\S+)\.write_text\(|np\.savez\w*\(\s*([^,]+),|\.savefig\(([^,)]+)")
    root = Path(gaigs.__file__).parent
    places = {
        (str(file.relative_to(root)), next(filter(None, found.groups())))
        for file in root.rglob("*.py")
        for found in written.finditer(file.read_text(encoding="utf-8"))
    }
    assert len(places) > 5
    assert {target for _, target in places} == {"part", "file", "stream"}, places


WRITERS = {
    "best.ckpt": lambda path: checkpoint.write({"weights": torch.rand(10**5)}, path),
    "floor.npz": lambda path: RadioMap(
        np.random.default_rng(0).random((1, 200, 200)), np.arange(200.0), np.arange(200.0), 1.0, ("west",)
    ).save(path),
    "gaussians.ply": lambda path: write_ply(
        path,
        {"means": torch.rand(9999, 3), "quats": torch.rand(9999, 4), "log_scales": torch.rand(9999, 3)}
        | {"opacity_logits": torch.rand(9999), "signal": torch.rand(9999, 1, 1)},
        "many",
    ),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_file_that_may_not_grow_so_large(name, tmp_path):
    """As under a quota; unlike a full file system it takes no root to try."""
    (tmp_path / name).write_text("old")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**16, limits[1]))
    try:
        with pytest.raises(OSError, match=rf"{name} could not be written"):
            WRITERS[name](tmp_path / name)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert (tmp_path / name).read_text() == "old"
    assert [*tmp_path.iterdir()] == [tmp_path / name]
