"""Files: only regular ones are read, nothing that is there is lost by writing, and no input holds a command up."""

import os
import pty
import resource
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from adacd_hil.error_texts import error_text
from adacd_hil.file_access import InUseError, check_unused, create_file, exists, open_input, read_input, write_new_file
from adacd_hil.file_replacement import Replacement, removing_empty_folders, replace_file, replace_files, replacing
from adacd_hil.log.log_files import LogError
from adacd_hil.log.mcap.record_layout import MAGIC
from adacd_hil.log.recording.recorder import Recorder


def test_the_text_of_an_error_names_the_file_in_one_line_and_no_number(tmp_path):
    with pytest.raises(FileNotFoundError) as raised:
        read_input(tmp_path / "a\nb")
    assert error_text(raised.value) == f"{tmp_path}/a\\u000ab: No such file or directory"


def test_a_log_without_a_free_descriptor_is_refused_in_words(tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    highest = max(int(file.name) for file in Path("/proc/self/fd").iterdir())
    taken = [os.open(os.devnull, os.O_RDONLY)]
    while taken[-1] < highest:
        taken.append(os.open(os.devnull, os.O_RDONLY))
    # Three more, for the log's file and the two sockets: none for the buffer.
    resource.setrlimit(resource.RLIMIT_NOFILE, (taken[-1] + 1 + 3, hard))
    try:
        with pytest.raises(LogError, match=r"MiB: Too many open files$"):
            Recorder(tmp_path / "run.mcap")
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        for descriptor in taken:
            os.close(descriptor)


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


HOLDER = """
import sys
from pathlib import Path
from adacd_hil.file_access import create_file
create_file(Path(sys.argv[1]))
print("held", flush=True)
sys.stdin.read()
"""


def things(folder: Path) -> dict[str, Path]:
    """Make one of everything that a path may lead to."""
    (folder / "target").write_text("kept")
    (folder / "file").write_text("kept")
    (folder / "link").symlink_to("target")
    (folder / "dangling").symlink_to("nowhere")
    (folder / "folder").mkdir()
    os.mkfifo(folder / "fifo")
    return {name: folder / name for name in ("file", "link", "dangling", "folder", "fifo")}


@pytest.mark.parametrize("name", ["file", "link", "dangling", "folder", "fifo"])
def test_a_new_file_takes_the_place_of_nothing(name: str, tmp_path: Path) -> None:
    path = things(tmp_path)[name]
    with pytest.raises(FileExistsError):
        create_file(path)
    with pytest.raises(FileExistsError):
        write_new_file(path, b"new")
    assert (tmp_path / "target").read_text() == (tmp_path / "file").read_text() == "kept"
    assert not (tmp_path / "nowhere").exists()


def test_a_replacement_takes_the_place_of_a_file_and_of_a_link_but_not_of_its_target(tmp_path: Path) -> None:
    paths = things(tmp_path)
    for name in ("file", "link", "dangling"):
        replace_file(paths[name], "new")
        assert not paths[name].is_symlink()
        assert paths[name].read_text() == "new"
    assert (tmp_path / "target").read_text() == "kept"
    assert not (tmp_path / "nowhere").exists()


@pytest.mark.parametrize(("name", "reason"), [("fifo", "a FIFO"), ("folder", "it is a folder"), ("device", "a device")])
def test_what_is_no_file_is_not_replaced(name: str, reason: str, tmp_path: Path) -> None:
    ours, terminal = pty.openpty()  # in a folder where nobody can make a file, if the check is broken
    path = Path(os.ttyname(terminal)) if name == "device" else things(tmp_path)[name]
    with pytest.raises(OSError, match=reason):
        replace_file(path, "new")
    assert not list(tmp_path.glob(".*"))
    os.close(ours)
    os.close(terminal)


def test_only_a_log_takes_the_place_of_a_log(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    path.write_bytes(MAGIC + b"records")
    with pytest.raises(OSError, match="it is a log, which is not replaced"):
        replace_file(path, "new")
    assert path.read_bytes() == MAGIC + b"records"
    replacement = Replacement(path, is_log=True)
    replacement.beside.write_bytes(MAGIC)
    replacement.commit()
    assert path.read_bytes() == MAGIC


def test_a_replacement_that_fails_leaves_what_was_there_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("kept")

    def write_half() -> None:
        with replacing(path) as beside:
            beside.write_text("half")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        write_half()
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("file", "kept")]


def test_what_a_killed_process_left_beside_is_not_written_to(tmp_path: Path) -> None:
    left = tmp_path / f".file.{os.getpid()}-0.part"
    left.symlink_to(tmp_path / "target")
    replace_file(tmp_path / "file", "new")
    assert (tmp_path / "file").read_text() == "new"
    assert not (tmp_path / "target").exists()


def test_a_file_in_use_names_the_process_that_writes_it(tmp_path: Path) -> None:
    path = tmp_path / "log"
    command = [sys.executable, "-c", HOLDER, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(InUseError, match=f"is being written by process {holder.pid}$"):
            check_unused(path)
        holder.communicate()
    check_unused(path)


def test_a_file_that_is_there_already_with_the_same_contents_is_fine(tmp_path: Path) -> None:
    write_new_file(tmp_path / "file", b"content")
    write_new_file(tmp_path / "file", b"content")
    with pytest.raises(FileExistsError, match="another one is there already"):
        write_new_file(tmp_path / "file", b"content.")
    assert (tmp_path / "file").read_bytes() == b"content"


def test_only_folders_that_were_made_and_are_empty_go(tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    for used, kept in ((False, []), (True, ["file"])):
        path = tmp_path / "old" / "new" / "newer"
        with removing_empty_folders(path):
            path.mkdir(parents=True)
            if used:
                (path / "file").touch()
        assert [file.name for file in tmp_path.glob("old/new/newer/*")] == kept
        assert (tmp_path / "old" / "new").exists() is used
    assert (tmp_path / "old").exists()


def test_of_several_files_none_is_replaced_if_one_can_t_be_written(tmp_path: Path) -> None:
    contents = {"a.toml": "new", "folder": "new", "z.toml": "new"}
    (tmp_path / "folder").mkdir()
    for name in ("a.toml", "z.toml"):
        (tmp_path / name).write_text("kept")
    with pytest.raises(IsADirectoryError):
        replace_files(tmp_path, contents)
    assert sorted(file.name for file in tmp_path.iterdir()) == sorted(contents)
    assert [(tmp_path / name).read_text() for name in ("a.toml", "z.toml")] == ["kept", "kept"]
    (tmp_path / "folder").rmdir()
    assert replace_files(tmp_path, contents) == tuple(tmp_path / name for name in contents)
    assert {(tmp_path / name).read_text() for name in contents} == {"new"}
