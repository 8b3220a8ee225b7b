"""Reading of files, and new files that replace none.

Only regular files are read, and only up to a size: a device has no end, and opening a FIFO waits for its writer. New
files are not written through a link.
"""

import contextlib
import errno
import fcntl
import os
import stat
from io import BufferedReader
from pathlib import Path

MOST_TEXT_BYTES = 4 << 20
"""Limit for a configuration, scenario, contract, EDS or URDF; the largest in the package has 0.1 MB."""
NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
"""Flags of `os.open` for a file that isn't there."""
_LOCKS = Path("/proc/locks")
_ANOTHER = "another one is there already, which is left as it is"


def open_input(path: Path) -> BufferedReader:
    """Return a regular file, open for reading.

    Raises OSError that names it if it can't be opened, or is a folder, FIFO, device or socket.
    """
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
    """Return the whole content of a regular file.

    Raises OSError that names it if it can't be read, is no regular file, or has more than `most_bytes`.
    """
    with open_input(path) as file:
        data = file.read(most_bytes + 1)
    if data is None:  # as of /proc/kmsg, which is a regular file
        raise OSError(0, "it has nothing to read at present", str(path))
    if len(data) > most_bytes:
        raise OSError(0, f"it has more than {most_bytes} bytes", str(path))
    return data


def exists(path: Path) -> bool:
    """Return whether a file or folder of that name exists; False, too, where that can't be found out."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


class InUseError(Exception):
    """A file that another process is writing; the message is one line."""


def create_file(path: Path) -> int:
    """Create a file and return its descriptor, locked for as long as that, or a copy of it, is open.

    On a file system without locks it isn't locked. Raises FileExistsError if anything has that name, be it a dangling
    link; OSError if it can't be created.
    """
    descriptor = os.open(path, NEW, 0o666)
    with contextlib.suppress(OSError):  # a file system without locks: `check_unused` can't see the writer then
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return descriptor


def check_unused(path: Path) -> None:
    """Raise InUseError if a process is writing a file that `create_file` made, with its process id where it is known.

    A file that can't be opened passes, and so does each file on a file system without locks.
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
    """Return words for the process that holds the lock of a file: `process` and its id, or `another process`.

    Source: proc(5), /proc/locks.
    """
    status = os.fstat(descriptor)
    place = f"{os.major(status.st_dev):02x}:{os.minor(status.st_dev):02x}:{status.st_ino}"
    with contextlib.suppress(OSError):
        for line in _LOCKS.read_text(encoding="ascii", errors="replace").splitlines():
            words = line.split()
            if len(words) >= 6 and words[1] == "FLOCK" and words[5] == place and words[4] != "0":
                return f"process {words[4]}"
    return "another process"


def write_new_file(path: Path, content: bytes) -> None:
    """Write a new file; do nothing if it exists with the same content.

    Raises FileExistsError for anything else of that name, OSError if it can't be written; an incomplete file is
    removed.
    """
    try:
        descriptor = os.open(path, NEW, 0o666)
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
