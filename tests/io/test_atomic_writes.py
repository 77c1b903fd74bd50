"""A file is written completely or not at all."""

import errno
import os
import resource
from pathlib import Path

import pytest
import torch

from gaigs.io.files import atomic_write, file_message
from gaigs.model import checkpoint

FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_file_replaces_the_old_one_when_complete(tmp_path):
    path = tmp_path / "scores.npz"
    path.write_text("old")
    with atomic_write(path) as part:
        part.write_text("new")
        assert path.read_text() == "old"
        assert part.suffix == ".npz", "many writers choose the format by it"
    assert path.read_text() == "new"
    assert [*tmp_path.iterdir()] == [path]


def test_two_writers_of_a_file_never_meet(tmp_path):
    path = tmp_path / "scores.npz"
    with atomic_write(path) as one:
        one.write_text("one")
        with atomic_write(path) as two:
            two.write_text("another")
        assert path.read_text() == "another"
        assert one.read_text() == "one"
    assert path.read_text() == "one"
    assert [*tmp_path.iterdir()] == [path]


@pytest.mark.parametrize(
    "error", [FULL, ValueError("no"), KeyboardInterrupt()], ids=["disk", "value", "ctrl-c"]
)
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


def test_a_folder_that_was_removed_is_not_made_anew(tmp_path):
    def write():
        with atomic_write(tmp_path / "removed" / "last.ckpt") as part:
            part.parent.mkdir()  # as Lightning does
            part.write_text("new")

    with pytest.raises(
        FileNotFoundError, match=r"last\.ckpt could not be written \(No such file or directory\)"
    ):
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
        (
            FULL,
            "a file in run could not be written (No space left on device)\ncheck that its folder",
        ),
        (
            OSError(errno.ENOENT, os.strerror(errno.ENOENT), "a.csv"),
            "a.csv could not be read or written (No such file",
        ),
        (OSError(errno.ENOSPC, "run/best.ckpt could not"), "run/best.ckpt could not"),
        (FileNotFoundError("nowhere must be the folder of a data set"), "nowhere must be"),
    ],
)
def test_an_error_of_the_system_becomes_a_sentence_and_others_stay(error, begins):
    assert file_message(error, Path("run")).startswith(begins)


def test_a_file_that_may_not_grow_so_large_leaves_the_old_one(tmp_path):
    """As under a quota."""
    path = tmp_path / "best.ckpt"
    path.write_text("old")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**16, limits[1]))
    try:
        with pytest.raises(OSError, match=r"best\.ckpt could not be written"):
            checkpoint.write({"weights": torch.rand(10**5)}, path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_text() == "old"
    assert [*tmp_path.iterdir()] == [path]
