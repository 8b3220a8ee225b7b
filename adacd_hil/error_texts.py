"""Texts and kinds of errors of the operating system."""

import errno
import os

from adacd_hil.printable import in_line

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def is_disk_full(error: BaseException | None) -> bool:
    """Return whether an error, or one that caused it, means that the disk or quota is full, or a file too large.

    The text counts, too: a log's writer process reports its error as text.
    """
    while error is not None:
        if getattr(error, "errno", 0) in _NO_ROOM or any(os.strerror(number) in str(error) for number in _NO_ROOM):
            return True
        error = error.__cause__ or error.__context__
    return False


def error_text(error: BaseException) -> str:
    """Return the text of an error; of an OSError file, its line ends escaped, and reason, without its number."""
    if isinstance(error, OSError) and error.strerror:
        return f"{in_line(str(error.filename))}: {error.strerror}" if error.filename else error.strerror
    return str(error)
