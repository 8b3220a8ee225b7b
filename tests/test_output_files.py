"""Files that are written: new ones replace nothing, replacements come in one step, and nothing else is touched."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from adacd_hil.log.mcap.chunked_file import MAGIC
from adacd_hil.output_files import (
    InUseError,
    Replacement,
    check_unused,
    create_file,
    place_file,
    replace_file,
    replacing,
    tidied,
)

HOLDER = """
import sys
from pathlib import Path
from adacd_hil.output_files import create_file
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
        place_file(path, b"new")
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


@pytest.mark.parametrize(
    ("path", "reason"),
    [("/dev/null", "a device"), ("/dev/full", "a device"), ("fifo", "a FIFO"), ("folder", "it is a folder")],
)
def test_what_is_no_file_is_not_replaced(path: str, reason: str, tmp_path: Path) -> None:
    things(tmp_path)
    with pytest.raises(OSError, match=reason):
        replace_file(tmp_path / path, "new")
    assert not list(tmp_path.glob(".*"))


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
    place_file(tmp_path / "file", b"content")
    place_file(tmp_path / "file", b"content")
    with pytest.raises(FileExistsError, match="another one is there already"):
        place_file(tmp_path / "file", b"content.")
    assert (tmp_path / "file").read_bytes() == b"content"


def test_only_folders_that_were_made_and_are_empty_go(tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    for used, kept in ((False, []), (True, ["file"])):
        path = tmp_path / "old" / "new" / "newer"
        with tidied(path):
            path.mkdir(parents=True)
            if used:
                (path / "file").touch()
        assert [file.name for file in tmp_path.glob("old/new/newer/*")] == kept
        assert (tmp_path / "old" / "new").exists() is used
    assert (tmp_path / "old").exists()
