"""Ctrl-C before a command has begun: while a program imports what it is made of, which takes a few tenths of a second.

An exception would come up anywhere in others' modules, which turn it into errors of their own. There is nothing to put
away so early, and the process ends at once.
"""

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def ending_at_once(status: int, line: str = "") -> Iterator[None]:
    """Let Ctrl-C in the block end the process with a status, and a line on standard error where one is given.

    Where the signal is ignored, as in the background, or already handled, nothing changes.
    """

    def end(_number: int, _frame: FrameType | None) -> None:
        try:
            os.write(2, f"{line}\n".encode() if line else b"")
        finally:
            os._exit(status)

    previous: Callable[..., object] | int | None = signal.getsignal(signal.SIGINT)
    if previous is not signal.default_int_handler:
        yield
        return
    signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)
