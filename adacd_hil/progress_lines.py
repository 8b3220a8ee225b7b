"""Lines on standard error about work in progress, in both programs."""

import queue
import sys
import threading
from contextlib import ExitStack
from typing import Self

from adacd_hil.clock import MonotonicClock
from adacd_hil.compile_progress import listening
from adacd_hil.printable import in_line
from adacd_hil.terminal import moves_cursor, write_line


class Progress:
    """Prints lines on stderr about work in progress; its end waits for the last one, but not forever.

    A thread of its own prints: a stuck terminal must not stop the arm. Progress of compiling takes one line of a
    terminal, which the next line overwrites; into a file or pipe it is printed every few seconds.
    """

    CLOSE_TIMEOUT_S = 2.0
    COUNT_EVERY_NS = 1_000_000_000
    LINES_EVERY_NS = 4_000_000_000
    """Shortest time between two counts, on a terminal and elsewhere; code from the cache takes less than that."""

    def __init__(self) -> None:
        self._lines: queue.SimpleQueue[tuple[str, bool] | None] = queue.SimpleQueue()
        self._has_cursor = moves_cursor(sys.stderr)
        self._pause_ns = self.COUNT_EVERY_NS if self._has_cursor else self.LINES_EVERY_NS
        self._clock = MonotonicClock()
        self._is_counting = False
        self._begun_ns = self._counted_ns = 0
        self._thread = threading.Thread(target=self._print, name="progress", daemon=True)
        self._thread.start()
        self._listening = ExitStack()
        self._listening.enter_context(listening(self.count))

    def __call__(self, line: str) -> None:
        """Queue a line to be printed."""
        self._is_counting = False
        self._lines.put((line, False))

    def passing(self, line: str) -> None:
        """Queue a line that the next one overwrites on a terminal; elsewhere it is printed like any other."""
        self._is_counting = False
        self._lines.put((line, self._has_cursor))

    def count(self, line: str) -> None:
        """Queue `line` with the seconds since counting began, unless that or the last count is too recent.

        Too recent: less than COUNT_EVERY_NS ago on a terminal, LINES_EVERY_NS elsewhere. Counting begins anew after any
        other line. On a terminal the next line overwrites the count.
        """
        now_ns = self._clock.now_ns()
        if not self._is_counting:
            self._is_counting, self._begun_ns, self._counted_ns = True, now_ns, now_ns
        if now_ns - self._counted_ns >= self._pause_ns:
            self._counted_ns = now_ns
            self._lines.put((f"{line}, {(now_ns - self._begun_ns) / 1e9:.0f} s", self._has_cursor))

    def _print(self) -> None:
        """Print the queued lines until None comes; overwrite a passing one with the next."""
        is_overwritten = False
        while (queued := self._lines.get()) is not None:
            line, is_passing = queued
            write_line(sys.stderr, in_line(line), is_overwritten, has_end=not is_passing)
            is_overwritten = is_passing
        if is_overwritten:
            write_line(sys.stderr, "", is_overwritten, has_end=False)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """End once all queued lines are printed, after CLOSE_TIMEOUT_S at the latest."""
        self._listening.close()
        self._lines.put(None)
        self._thread.join(self.CLOSE_TIMEOUT_S)
