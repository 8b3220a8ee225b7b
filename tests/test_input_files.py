"""Only regular files are read, and text only up to a size: nothing that is named as an input holds a command up."""

import os
import socket
from pathlib import Path

import pytest

from adacd_hil.input_files import exists, open_input, read_input


def make_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))


def make_link_to_zero(path: Path) -> None:
    path.symlink_to("/dev/zero")


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (os.mkfifo, "it is no regular file"),
        (make_link_to_zero, "it is no regular file"),
        (make_socket, "No such device or address"),
        (Path.mkdir, "it is a folder"),
        (lambda path: path.symlink_to(path), "Too many levels of symbolic links"),
        (lambda path: None, "No such file or directory"),
    ],
)
def test_what_is_no_regular_file_is_refused_at_once_and_leaves_nothing_open(make, reason, tmp_path):
    path = tmp_path / "input"
    make(path)
    before = sorted(Path("/proc/self/fd").iterdir())
    with pytest.raises(OSError, match=reason) as error:
        open_input(path)
    assert error.value.strerror == reason
    assert sorted(Path("/proc/self/fd").iterdir()) == before


@pytest.mark.parametrize("name", ["a\0b", "\ud800"])
def test_a_name_that_no_file_can_have_is_refused_and_not_there(name):
    with pytest.raises(OSError, match=r"null byte|can't encode"):
        open_input(Path(name))
    assert not exists(Path(name))


def test_a_link_to_a_file_is_read(tmp_path):
    (tmp_path / "file").write_bytes(b"abc")
    (tmp_path / "link").symlink_to("file")
    assert read_input(tmp_path / "link") == b"abc"
    with open_input(tmp_path / "link") as file:
        assert file.read(2) == b"ab"


@pytest.mark.parametrize(("size", "is_read"), [(9, True), (10, True), (11, False), (1000, False)])
def test_a_text_is_read_whole_up_to_its_bound(size, is_read, tmp_path):
    path = tmp_path / "text"
    path.write_bytes(b"x" * size)
    if is_read:
        assert len(read_input(path, 10)) == size
    else:
        with pytest.raises(OSError, match="it has more than 10 bytes"):
            read_input(path, 10)


def test_a_file_whose_size_says_nothing_is_read_within_the_bound(tmp_path):
    path = tmp_path / "sparse"
    with path.open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(OSError, match="it has more than 4194304 bytes"):
        read_input(path)
    assert read_input(Path("/proc/self/status")).startswith(b"Name:")
