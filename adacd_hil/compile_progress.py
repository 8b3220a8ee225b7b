"""Progress of compiling: how many functions are compiled, and the listeners that show it.

Compiling takes the better part of a minute, once per version of the program. Listeners register with `listening`; they
don't import numba, which takes long, too.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import ModuleType
from typing import Any

Listener = Callable[[Callable[[], str]], None]
"""Called with a function that returns the line; the listener calls that function to show it.

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


def functions_below(functions: Sequence[Any], is_all: bool = False) -> dict[str, Any]:
    """Return these compiled functions and all that they call, by full name.

    Calls are found by the names in the code: of functions, and of functions in modules. Left out, with the calls in
    them, are functions that numba doesn't compile (all of them if NUMBA_DISABLE_JIT is set) and, unless `is_all`,
    functions that this process has compiled or loaded already.
    """
    found: dict[str, Any] = {}
    waiting = list(functions)
    while waiting:
        function = waiting.pop()
        text = getattr(function, "py_func", None)
        if text is None or full_name(text) in found or (function.overloads and not is_all):
            continue
        found[full_name(text)] = function
        names = text.__code__.co_names
        for value in (text.__globals__[name] for name in names if name in text.__globals__):
            waiting += (
                [vars(value)[name] for name in names if name in vars(value)]
                if isinstance(value, ModuleType)
                else [value]
            )
    return found


def full_name(function: Any) -> str:
    """Return a function's name with its module."""
    return f"{function.__module__}.{function.__qualname__}"


class CompileCount:
    """Counts functions that are compiled, and calls the listeners.

    expected: the functions that will be needed, by full name; without them the count has no total. version_of: returns
    the version of a function in the cache on the disk, which another process may have written; None: not cached.
    """

    def __init__(self, expected: dict[str, Any], version_of: Callable[[Any], object]) -> None:
        self._expected, self._version_of = expected, version_of
        self._before = self._versions()
        self._done: set[str] = set()

    @property
    def is_expecting(self) -> bool:
        """Whether the count has a total."""
        return bool(self._expected)

    def count_function(self, function: Any) -> None:
        """Count a compiled function and all that it calls; call the listeners.

        If functions are expected, only these are counted.
        """
        self._done |= {
            name for name in functions_below([function], is_all=True) if not self._expected or name in self._expected
        }
        self.call_listeners()

    def call_listeners(self) -> None:
        """Call the listeners, each with a function that returns the present count as a line."""
        for listener in _listeners:
            listener(self._line)

    def _line(self) -> str:
        """Return the count as a line; include expected functions that another process has compiled meanwhile."""
        kept = self._versions().items()
        self._done |= {name for name, version in kept if version is not None and version != self._before[name]}
        done, total = len(self._done), len(self._expected)
        text = f"compiling {done} of {total} functions" if total else f"compiling, {done} functions so far"
        return f"{text}, once per version"

    def _versions(self) -> dict[str, object]:
        return {name: self._version_of(function) for name, function in self._expected.items()}
