"""Reading and writing of files: new files replace none, and replacements happen in one step.

Only regular files are read, and only up to a size: a device has no end, and opening a FIFO waits for its writer. Files
are not written through a link, into a FIFO or a device, so that only the named path changes. A replacement is written
beside the file and renamed: at each moment the path holds the whole old file or the whole new one.
"""

import contextlib
import errno
import fcntl
import itertools
import os
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path

MOST_TEXT_BYTES = 4 << 20
"""Limit for a configuration, scenario, contract, EDS or URDF; the largest in the package has 0.1 MB."""
_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_LOG_MAGIC = b"\x89MCAP0\r\n"
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_LOCKS = Path("/proc/locks")
_ANOTHER = "another one is there already, which is left as it is"


def open_input(path: Path) -> BufferedReader:
    """Open a regular file for reading. Raises OSError that names it."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except ValueError as error:  # a NUL in the name
        raise OSError(0, str(error), str(path)) from None
    try:
        mode = os.fstat(descriptor).st_mode
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(0, "it is a folder", str(path))
        if not stat.S_ISREG(mode):
            raise OSError(0, "it is no regular file", str(path))
        return open(descriptor, "rb")  # noqa: PTH123 (it is a descriptor)
    except OSError:
        os.close(descriptor)
        raise


def read_input(path: Path, most_bytes: int = MOST_TEXT_BYTES) -> bytes:
    """Read a whole regular file of at most so many bytes. Raises OSError that names it."""
    with open_input(path) as file:
        data = file.read(most_bytes + 1)
    if data is None:  # as of /proc/kmsg, which is a regular file
        raise OSError(0, "it has nothing to read at present", str(path))
    if len(data) > most_bytes:
        raise OSError(0, f"it has more than {most_bytes} bytes", str(path))
    return data


def exists(path: Path) -> bool:
    """Return whether a file or folder of that name exists; False for a name that no file can have."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


class InUseError(Exception):
    """A file that another process is writing; the message is one line."""


def create_file(path: Path) -> int:
    """Create a file and return its descriptor, locked for as long as that, or a copy of it, is open.

    Raises FileExistsError for whatever is there, a dangling link included; OSError.
    """
    descriptor = os.open(path, _NEW, 0o666)
    with contextlib.suppress(OSError):  # a file system without locks: `check_unused` can't see the writer then
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return descriptor


def check_unused(path: Path) -> None:
    """Raise InUseError if a process is writing a file that `create_file` made, with its process id where it is known.

    A file that can't be opened passes.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        raise InUseError(f"{path} is being written by {_owner(descriptor)}") from None
    except OSError:
        return
    finally:
        os.close(descriptor)


def _owner(descriptor: int) -> str:
    """Name the process that holds the lock of a file; proc(5), /proc/locks."""
    status = os.fstat(descriptor)
    place = f"{os.major(status.st_dev):02x}:{os.minor(status.st_dev):02x}:{status.st_ino}"
    with contextlib.suppress(OSError):
        for line in _LOCKS.read_text(encoding="ascii", errors="replace").splitlines():
            words = line.split()
            if len(words) >= 6 and words[1] == "FLOCK" and words[5] == place and words[4] != "0":
                return f"process {words[4]}"
    return "another process"


def is_disk_full(error: BaseException | None) -> bool:
    """Return whether an error, or an error that caused it, means that the disk or the quota is full."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in _NO_ROOM:
            return True
        error = error.__cause__ or error.__context__
    return False


def in_words(error: BaseException) -> str:
    """Describe an error in one line; an OSError by file and reason, without its number."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return str(error)


class Replacement:
    """A new file, `beside`, that takes the place of `path` when it is committed."""

    def __init__(self, path: Path, is_log: bool = False) -> None:
        """Create the new file. `commit` replaces a link itself, not the link's target.

        is_log: a log may be replaced. Raises OSError, also if a FIFO, a device, a folder or (unless is_log) a log is
        there.
        """
        _check_replaceable(path, is_log)
        self.path = path
        self.beside = _create_beside(path)

    def commit(self, is_durable: bool = False) -> None:
        """Rename the new file to `path`; is_durable: after its contents are on the disk. Raises OSError."""
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

    See `Replacement`. Raises OSError.
    """
    replacement = Replacement(path)
    try:
        yield replacement.beside
    except BaseException:
        replacement.discard()
        raise
    replacement.commit(is_durable)


def replace_file(path: Path, content: bytes | str) -> None:
    """Write a whole file in one step, text as UTF-8; see `Replacement`. Raises OSError."""
    with replacing(path) as beside:
        beside.write_bytes(content.encode() if isinstance(content, str) else content)


def replace_files(folder: Path, contents: Mapping[str, bytes | str]) -> tuple[Path, ...]:
    """Write whole files, by name, into a folder, which is made if missing; return their paths. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in contents.items():
        replace_file(folder / name, content)
    return tuple(folder / name for name in contents)


def is_anothers(path: Path, head: bytes) -> bool:
    """Return whether the file exists, isn't empty, and doesn't begin with `head`: then it may not be replaced.

    Raises OSError.
    """
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(head)) not in (b"", head)


def _check_replaceable(path: Path, is_log: bool) -> None:
    """Raise OSError if the path is a folder, a FIFO, a socket, a device or (unless is_log) a log."""
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
    for number in itertools.count():
        beside = path.with_name(f".{path.name}.{os.getpid()}-{number}.part")
        with contextlib.suppress(FileExistsError):  # left by a process of this id that was killed
            os.close(os.open(beside, _NEW, 0o666))
            return beside
    raise AssertionError


def dangling_link(path: Path) -> Path | None:
    """Return the first link on a path, or the path itself, whose target doesn't exist; None if there is none."""
    for place in (path, *path.parents):
        with contextlib.suppress(OSError):
            if place.is_symlink() and not place.exists():
                return place
    return None


def place_file(path: Path, content: bytes) -> None:
    """Write a file unless it exists with the same content. Raises FileExistsError for other content, OSError."""
    try:
        descriptor = os.open(path, _NEW, 0o666)
    except FileExistsError:
        if path.is_file() and path.stat().st_size == len(content) and path.read_bytes() == content:
            return
        raise FileExistsError(errno.EEXIST, _ANOTHER, str(path)) from None
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
    except OSError:
        path.unlink()
        raise


@contextmanager
def tidied(path: Path) -> Iterator[None]:
    """When the block ends, remove a folder and its parents as far as they are empty and didn't exist before."""
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # not empty: it stays, and so do those above
            for folder in made:
                folder.rmdir()
