"""Lines on stderr about work in progress, printed by a thread of their own: a stuck terminal must not stop the arm."""

import queue
import sys
import threading

from adacd_hil.terminal import in_line


class Progress:
    """Prints lines in order; `close` waits for the last one, but not for ever."""

    CLOSE_TIMEOUT_S = 2.0

    def __init__(self) -> None:
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._print, name="progress", daemon=True)
        self._thread.start()

    def __call__(self, line: str) -> None:
        """Queue a line."""
        self._lines.put(line)

    def _print(self) -> None:
        while (line := self._lines.get()) is not None:
            print(in_line(line), file=sys.stderr, flush=True)

    def close(self) -> None:
        """Print what is queued and end."""
        self._lines.put(None)
        self._thread.join(self.CLOSE_TIMEOUT_S)
