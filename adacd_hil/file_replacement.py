"""Replacement of files in one step.

A replacement is written beside the file and renamed: at each moment the path holds the whole old file or the whole new
one. Nothing is written through a link, into a FIFO or a device, so that only the named path changes.
"""

import contextlib
import errno
import itertools
import os
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from adacd_hil.file_access import NEW

_LOG_MAGIC = b"\x89MCAP0\r\n"


class Replacement:
    """A new file, `beside`, that takes the place of `path` when it is committed."""

    def __init__(self, path: Path, is_log: bool = False) -> None:
        """Create the new file. `commit` replaces a link itself, not the link's target.

        is_log: a log may be replaced. Raises OSError if the new file can't be created, or a FIFO, a device, a folder or
        (unless is_log) a log is at `path`.
        """
        _check_replaceable(path, is_log)
        self.path = path
        self.beside = _create_beside(path)

    def commit(self, is_durable: bool = False) -> None:
        """Rename the new file to `path`; is_durable: only once its contents are on the disk.

        Raises OSError if that fails; then the new file is removed, and `path` is unchanged.
        """
        try:
            if is_durable:
                with self.beside.open("rb") as file:
                    os.fsync(file.fileno())
            self.beside.replace(self.path)
        except OSError:
            self.discard()
            raise

    def discard(self) -> None:
        """Remove the new file."""
        with contextlib.suppress(OSError):
            self.beside.unlink()


@contextmanager
def replacing(path: Path, is_durable: bool = False) -> Iterator[Path]:
    """Yield the path of a new file that takes the place of `path` when the block ends without error.

    It is removed if the block ends with one. is_durable: its contents are on the disk before it replaces `path`. Raises
    OSError if it can't be created or renamed, or a folder, FIFO, device or log is at `path`.
    """
    replacement = Replacement(path)
    try:
        yield replacement.beside
    except BaseException:
        replacement.discard()
        raise
    replacement.commit(is_durable)


def replace_file(path: Path, content: bytes | str) -> None:
    """Write a whole file in one step, text as UTF-8; replace an old one.

    Raises OSError if it can't be written, or a folder, FIFO, device or log has its name.
    """
    with replacing(path) as beside:
        beside.write_bytes(content.encode() if isinstance(content, str) else content)


def replace_files(folder: Path, contents: Mapping[str, bytes | str]) -> tuple[Path, ...]:
    """Write whole files, by name, into a folder, which is made if missing; return their paths.

    All are written beside the old ones before the first is replaced, as by `replace_file`, in their order. Raises
    OSError if the folder can't be made or a file not be written, and none is replaced; after a rename that failed the
    files before it are.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        for name, content in reversed([*contents.items()]):  # the stack commits the last one first
            beside = stack.enter_context(replacing(folder / name))
            beside.write_bytes(content.encode() if isinstance(content, str) else content)
    return tuple(folder / name for name in contents)


def has_other_head(path: Path, head: bytes) -> bool:
    """Return whether a file exists, isn't empty, and doesn't begin with `head`: then it may not be replaced.

    False for a folder. Raises OSError if it can't be read.
    """
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(head)) not in (b"", head)


def _check_replaceable(path: Path, is_log: bool) -> None:
    """Raise OSError if the path is a folder, a FIFO, a socket, a device or a log, which begins as MCAP.

    is_log: a log passes. A missing path passes. A link passes: the link itself is replaced, whatever its target.
    """
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, "it is a folder; give the name of a file", str(path))
    if not (stat.S_ISREG(mode) or stat.S_ISLNK(mode)):
        raise OSError(errno.EINVAL, "it is a FIFO, a socket or a device; give the name of a file", str(path))
    if stat.S_ISREG(mode) and not is_log:
        with path.open("rb") as file:
            if file.read(len(_LOG_MAGIC)) == _LOG_MAGIC:
                raise FileExistsError(errno.EEXIST, "it is a log, which is not replaced; give another name", str(path))


def _create_beside(path: Path) -> Path:
    """Create an empty hidden file beside `path`, and return its path. Raises OSError if it can't be created."""
    for number in itertools.count():
        beside = path.with_name(f".{path.name}.{os.getpid()}-{number}.part")
        with contextlib.suppress(FileExistsError):  # left by a process of this id that was killed
            os.close(os.open(beside, NEW, 0o666))
            return beside
    raise AssertionError


def dangling_link(path: Path) -> Path | None:
    """Return the path, or the lowest folder above it, that is a link without a target; None if there is none."""
    for place in (path, *path.parents):
        with contextlib.suppress(OSError):
            if place.is_symlink() and not place.exists():
                return place
    return None


@contextmanager
def removing_empty_folders(path: Path) -> Iterator[None]:
    """When the block ends, remove a folder and its parents as far as they are empty and didn't exist before it.

    If the folder itself is missing then, its parents stay.
    """
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # not empty: it stays, and so do those above
            for folder in made:
                folder.rmdir()
