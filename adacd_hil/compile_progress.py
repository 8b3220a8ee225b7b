"""Progress of compiling: how many functions are compiled, and the listeners that show it.

Compiling takes the better part of a minute, once per version of the program. Listeners register with `listening`; they
don't import numba, which takes long, too.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from adacd_hil.printable import number_of

Listener = Callable[[str], None]
"""Called with the line to show.

It is called at the beginning and end of each compilation, and every 20 ms while this process waits for another one
that compiles."""

_listeners: list[Listener] = []


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Have `listener` called about progress of compiling while the block lasts, besides those of blocks around it.

    The thread that compiles calls it, whichever that is.
    """
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)


def call_listeners(count: int) -> None:
    """Call the listeners with a line that says how many functions this process has compiled so far."""
    for listener in _listeners:
        listener(f"compiling, {number_of(count, 'function')} so far, once per version")
