"""Files that are read, and files that are written: new ones that replace nothing, and replacements in one step.

Only regular files are read, and whole ones up to a size: a device never ends, a FIFO without a writer never begins.
Writing neither follows a link nor goes into a FIFO or a device, so that nothing is changed but what was named. A
replacement is written beside and renamed: at no moment is there half a file, or none where there was one.
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
"""Of a configuration, a scenario, a contract, an EDS, a URDF; the largest that comes with the package has 0.1 MB."""
_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_LOG_MAGIC = b"\x89MCAP0\r\n"
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_LOCKS = Path("/proc/locks")
_PIECE = 1 << 20
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
    """Tell whether there is a file or folder of that name; one that no file can have is not there."""
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
    with contextlib.suppress(OSError):  # a file system without locks: then nobody is told who writes
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return descriptor


def check_unused(path: Path) -> None:
    """Raise InUseError when a process is writing a file that `create_file` made, with the process id where it's known.

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
    """Tell whether an error, or one that it was made of, says that there is no room for what is written."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in _NO_ROOM:
            return True
        error = error.__cause__ or error.__context__
    return False


def in_words(error: BaseException) -> str:
    """Describe an error: of the system's by the file and its reason, without its number."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return str(error)


class Replacement:
    """A new file, `beside`, that takes the place of `path` when it is committed."""

    def __init__(self, path: Path, is_log: bool = False) -> None:
        """Create the file beside. A link is replaced, and its target left as it is.

        is_log: a log may be replaced. Raises OSError, also when a FIFO, a device, a folder or, otherwise, a log is
        there.
        """
        _check_replaceable(path, is_log)
        self.path = path
        self.beside = _create_beside(path)

    def commit(self, is_durable: bool = False) -> None:
        """Take the place of `path`; `is_durable`: not before the contents are on the disk. Raises OSError."""
        try:
            if is_durable:
                with self.beside.open("rb") as file:
                    os.fsync(file.fileno())
            self.beside.replace(self.path)
        except OSError:
            self.discard()
            raise

    def discard(self) -> None:
        """Remove the file beside."""
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


@contextmanager
def placing(path: Path, dated_lines: int = 0) -> Iterator[Path]:
    """Yield the path of a new file that takes the place of none but an empty one, or of the same already.

    For what leaves no mark of who made it: another one may be a user's own. dated_lines: so many at the beginning may
    differ, as with the date of writing. See `Replacement`. Raises FileExistsError when the block has ended and another
    one is there, OSError.
    """
    with replacing(path) as beside:
        yield beside
        if path.is_file() and path.stat().st_size and not _is_same(path, beside, dated_lines):
            raise FileExistsError(errno.EEXIST, _ANOTHER, str(path))


def _is_same(one: Path, other: Path, dated_lines: int) -> bool:
    """Compare two files from behind their first lines on."""
    with one.open("rb") as left, other.open("rb") as right:
        for _ in range(dated_lines):
            left.readline(_PIECE)
            right.readline(_PIECE)
        while piece := left.read(_PIECE):
            if piece != right.read(len(piece)):
                return False
        return not right.read(1)


def replace_file(path: Path, content: bytes | str) -> None:
    """Write a whole file in one step, text as UTF-8; see `Replacement`. Raises OSError."""
    with replacing(path) as beside:
        beside.write_bytes(content.encode() if isinstance(content, str) else content)


def replace_files(folder: Path, contents: Mapping[str, bytes | str]) -> tuple[Path, ...]:
    """Write whole files, by their names, into a folder that is made if need be; return their paths. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in contents.items():
        replace_file(folder / name, content)
    return tuple(folder / name for name in contents)


def is_anothers(path: Path, head: bytes) -> bool:
    """Tell whether a file is there that has something, and doesn't begin as those do that may be replaced.

    Raises OSError.
    """
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(head)) not in (b"", head)


def _check_replaceable(path: Path, is_log: bool) -> None:
    """Raise OSError when what is there can't be replaced or shouldn't be."""
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
    """Find the link on the way to a path, or the path itself, that leads to nothing; None where there is none."""
    for place in (path, *path.parents):
        with contextlib.suppress(OSError):
            if place.is_symlink() and not place.exists():
                return place
    return None


def place_file(path: Path, content: bytes) -> None:
    """Write a file that is new, or the same already. Raises FileExistsError for another one, OSError."""
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
    """When the block ends, remove a folder and those above it, as far as they are empty and were not there before."""
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # not empty: it stays, and so do those above
            for folder in made:
                folder.rmdir()
