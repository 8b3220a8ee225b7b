"""How a program starts from the console: it imports its commands so that Ctrl-C ends it no less quietly then.

The imports take a few tenths of a second. An exception would come up anywhere in others' modules, which turn it into
errors of their own. There is nothing to put away so early, and the process ends at once.
"""

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn


def start_program(load: Callable[[], Callable[[], NoReturn]], interrupted: int, line: str = "") -> NoReturn:
    """Run what `load` imports; interrupted: status after Ctrl-C, before the command line takes care of it."""
    try:
        with _ending_at_once(interrupted, line):
            main = load()
        main()
    except KeyboardInterrupt:
        sys.exit(interrupted)


@contextmanager
def _ending_at_once(status: int, line: str) -> Iterator[None]:
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
