"""Start and end of a program from the console: exit statuses, and Ctrl-C during the imports without a traceback.

The imports take a few tenths of a second. A KeyboardInterrupt would be raised inside other packages' modules, which
turn it into errors of their own. No file or device is open so early, so the process ends at once.
"""

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import IntEnum
from types import FrameType
from typing import NoReturn


class ExitCode(IntEnum):
    """Exit statuses of the commands; their help explains them to the user."""

    OK = 0
    FAILURE = 1
    USAGE = 2
    PARTIAL = 3
    SAFETY_STOP = 4
    BUS_MISSING = 5
    DETECTOR_MISSING = 6
    INTERRUPTED = 130


def explain_statuses(**meanings: str) -> str:
    """Return the sentence of a help text with exit statuses; meanings: of each, by its name in ExitCode."""
    return f"Exit status: {'; '.join(f'{ExitCode[name]} {meaning}' for name, meaning in meanings.items())}."


def start_program(load: Callable[[], Callable[[], NoReturn]], interrupted: int, line: str = "") -> NoReturn:
    """Call `load`, which imports the command line, then call the function that it returns.

    interrupted: exit status after Ctrl-C. line: printed to standard error at a Ctrl-C in `load`, unless it is empty.
    """
    try:
        with _ending_at_once(interrupted, line):
            main = load()
        main()
    except KeyboardInterrupt:
        sys.exit(interrupted)


@contextmanager
def _ending_at_once(status: int, line: str) -> Iterator[None]:
    """End the process with `status` on Ctrl-C within the block, and print `line` to standard error if it isn't empty.

    If SIGINT is ignored, as in the background, or already handled, nothing changes.
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
