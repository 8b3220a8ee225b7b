"""Plays a terminal of a size to a process, and says what stands on it in the end."""

import fcntl
import os
import pty
import re
import struct
import sys
import termios
from pathlib import Path
from typing import NamedTuple

_SEQUENCE = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
_ERASE_LINE = "\x1b[2K"


class Shown(NamedTuple):
    """text: as it was written. status: of the process."""

    text: str
    status: int

    @property
    def sequences(self) -> set[str]:
        """Which escape sequences were written."""
        return set(_SEQUENCE.findall(self.text))

    @property
    def lines(self) -> list[str]:
        """What stands on the terminal in the end, without colours: an erased line is gone, a carriage return goes back.

        No line is folded by the terminal: whoever writes more than it has columns is seen.
        """
        shown = []
        for line in self.text.split("\r\n"):
            cells = ""
            for piece in line.split("\r"):
                kept = cells if _ERASE_LINE not in piece else ""
                written = _SEQUENCE.sub("", piece)
                cells = written + kept[len(written) :]
            shown.append(cells)
        return shown


def show_on_terminal(program: str, *words: str, columns: int = 60, **environment: str) -> Shown:
    """Run a Python program whose streams are all a terminal with colours, 24 lines high."""
    kept = {key: value for key, value in os.environ.items() if key not in ("COLUMNS", "LINES", "NO_COLOR", "TERM")}
    process, terminal = pty.fork()
    if not process:
        try:
            fcntl.ioctl(0, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
            whole = {**kept, "TERM": "xterm", "PYTHONPATH": str(Path.cwd()), **environment}
            os.execve(sys.executable, [sys.executable, "-c", program, *words], whole)
        finally:
            os._exit(127)
    written = b""
    try:
        while piece := os.read(terminal, 65536):
            written += piece
    except OSError:  # the process has gone
        pass
    finally:
        os.close(terminal)
    _, status = os.waitpid(process, 0)
    return Shown(written.decode(), os.waitstatus_to_exitcode(status))
