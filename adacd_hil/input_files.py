"""Files that are read: regular ones only, and whole ones up to a size.

A device never ends, a FIFO without a writer never begins: neither is opened for reading.
"""

import os
import stat
from io import BufferedReader
from pathlib import Path

MOST_TEXT_BYTES = 4 << 20
"""Of a configuration, a scenario, a contract, an EDS, a URDF; the largest that comes with the package has 0.1 MB."""


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
