"""Standard output and error of both programs: the one door through which text reaches a terminal, a pipe or a file.

Nothing that a file or the bus says controls a terminal: control characters are escaped as in JSON, which reads them
back; within a line of ours (`in_line`) so are the ends of lines, or it could say lines of its own. A reader that goes
away, as `head` does, is no error. An output that blocks holds nobody up once the user has asked for the end.
"""

import _thread
import contextlib
import errno
import io
import os
import re
import select
import shutil
import signal
import stat
import sys
import textwrap
import threading
from collections.abc import Iterable, Sequence
from types import FrameType
from typing import TextIO

_CONTROL = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f"  # C0 but for tab and newline, DEL, C1
    "\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]"  # what turns the order of letters, or ends lines unseen
)
_MOST_LETTERS = 2000
_POLL_MS = 100
_PATIENCE_POLLS = 5
"""How long a blocked output is waited for after the user has asked for the end: 0.5 s."""
_NOBODY_READS = (errno.EPIPE, errno.EIO)
"""The other end of the pipe is closed, the terminal has hung up."""
_MOMENT_S = 0.02
_PIECE = 1024
"""Bytes that a pipe or a terminal takes without blocking when it is ready: POSIX has PIPE_BUF of at least 512."""


def plain(text: str) -> str:
    """Escape control characters of a text, but for tabs and newlines, by `u` and four hexadecimal digits."""
    return _CONTROL.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def in_line(text: str) -> str:
    """Escape control characters as `plain` does, and tabs and newlines, too: a text stays within the line it is in."""
    return plain(text).replace("\n", "\\u000a").replace("\t", "\\u0009")


def one_line(text: object) -> str:
    """Put a text into one line, free of control characters and not longer than anybody reads."""
    line = plain(" ".join(str(text).split()))
    return line if len(line) <= _MOST_LETTERS else f"{line[:_MOST_LETTERS]} …"


def terminal_columns() -> int | None:
    """Give the width of the terminal that standard output is; None where it is none and COLUMNS is not set."""
    try:
        is_terminal = sys.stdout.isatty()
    except ValueError:  # it is closed
        is_terminal = False
    return shutil.get_terminal_size().columns if is_terminal or "COLUMNS" in os.environ else None


def fit_table(lines: Sequence[Sequence[str]], right: Sequence[int] = (), width: int | None = None) -> list[str]:
    """Align lines of cells; columns in `right` to the right. A table wider than `width` is told in parts.

    A cell is one line, whatever is in it.

    Each part begins with the first column and has as many of the others as there is room for. Where one alone has no
    room its cells are parted between words, on lines of their own.
    """
    if not lines:
        return []
    lines = [[in_line(cell) for cell in line] for line in lines]
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
    if width is None or sum(widths) + len(_GAP) * (len(widths) - 1) <= width or len(widths) == 1:
        return _aligned(lines, range(len(widths)), widths, right)
    parts: list[list[int]] = [[0]]
    for column in range(1, len(widths)):
        taken = sum(widths[place] + len(_GAP) for place in parts[-1])
        if len(parts[-1]) > 1 and taken + widths[column] > width:
            parts.append([0])
        parts[-1].append(column)
    told: list[str] = []
    for part in parts:
        told += [""] if told else []
        room = max(width - widths[0] - len(_GAP), _LEAST_ROOM)
        cells = lines if len(part) > 2 or widths[part[-1]] <= room else _parted(lines, part, room)
        told += _aligned(cells, part, widths, right)
    return told


def fold(text: str, width: int | None) -> str:
    """Part lines that are longer than `width` between words; what follows is indented two letters more.

    A word that is longer, as a path, is left whole, so that it can be copied. None: nothing is parted.
    """
    if width is None:
        return text
    folded: list[str] = []
    for line in text.split("\n"):
        indent = " " * min(len(line) - len(line.lstrip()) + 2, max(0, width - _LEAST_ROOM))
        is_long = len(line) > width
        folded += _parts(line, width, indent) if is_long else [line]
    return "\n".join(folded)


def _parts(line: str, width: int, indent: str) -> list[str]:
    return textwrap.wrap(
        line, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False, replace_whitespace=False
    )


_GAP = "  "
_LEAST_ROOM = 20
"""Letters that a cell is given, however narrow the terminal."""


def _aligned(
    lines: Sequence[Sequence[str]], columns: Iterable[int], widths: Sequence[int], right: Sequence[int]
) -> list[str]:
    return [
        _GAP.join(
            line[column].rjust(widths[column]) if column in right else line[column].ljust(widths[column])
            for column in columns
        ).rstrip()
        for line in lines
    ]


def _parted(lines: Sequence[Sequence[str]], part: Sequence[int], room: int) -> list[list[str]]:
    """Part the cells of a part's last column between words."""
    found = []
    for line in lines:
        for row, text in enumerate(textwrap.wrap(line[part[-1]], room, break_long_words=False) or [""]):
            cells = list(line) if row == 0 else [""] * len(line)
            cells[part[-1]] = text
            found.append(cells)
    return found


class Terminal(io.TextIOBase):
    """A standard stream. What is written goes out at once."""

    def __init__(self, descriptor: int, name: str, is_needed: bool) -> None:
        """Write to `descriptor`. is_needed: a full disk behind it is an error; otherwise nobody is told."""
        self.name = name
        self._descriptor = descriptor
        self._is_needed = is_needed
        self._is_gone = False  # nobody reads, or nobody would wait
        self._patience = -1  # polls to wait for an output that blocks; negative: for ever
        self._lock = threading.Lock()
        try:
            self._is_ready = stat.S_ISREG(os.fstat(descriptor).st_mode)  # a file never blocks
        except OSError:
            self._is_gone = True

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """UTF-8, whatever the locale."""
        return "utf-8"

    @property
    def errors(self) -> str:  # type: ignore[override]
        """What isn't a character, as in names of files, is written in hexadecimal."""
        return "backslashreplace"

    def fileno(self) -> int:
        """Return the descriptor."""
        return self._descriptor

    def isatty(self) -> bool:
        """Whether a terminal is behind it."""
        return not self._is_gone and os.isatty(self._descriptor)

    def writable(self) -> bool:
        """Tell that it can be written."""
        return True

    def write(self, text: str) -> int:
        """Write a text, free of control characters. Raises OSError where the stream is needed."""
        if not isinstance(text, str):
            raise TypeError(f"{self.name} takes text, not {type(text).__name__}")
        self.write_raw(plain(text))
        return len(text)

    def write_raw(self, text: str) -> None:
        """Write a text as it is: of our own making, with what moves a cursor. Raises OSError."""
        data = text.encode(self.encoding, self.errors)
        if not data or self._is_gone or not self._acquire():
            return
        try:
            self._put(memoryview(data))
        except OSError as error:
            self._leave()
            if self._is_needed and error.errno not in _NOBODY_READS:
                raise OSError(error.errno, f"{self.name} can't be written: {error.strerror}") from None
        finally:
            self._lock.release()

    def hurry(self) -> None:
        """From now on, wait for an output that blocks for half a second only. Safe in a signal handler."""
        self._patience = _PATIENCE_POLLS

    def _acquire(self) -> bool:
        """Wait for whoever writes at present; False when patience ends."""
        polls = 0
        while not self._lock.acquire(timeout=_POLL_MS / 1000):
            polls += 1
            if 0 <= self._patience < polls:
                return False
        return True

    def _put(self, view: memoryview) -> None:
        poll = select.poll()
        poll.register(self._descriptor, select.POLLOUT)
        polls = 0
        while view and not self._is_gone:
            if not self._is_ready and not poll.poll(_POLL_MS):
                polls += 1
                self._is_gone = 0 <= self._patience < polls
                continue
            with contextlib.suppress(BlockingIOError):  # whoever shares the other end has made it so
                view = view[os.write(self._descriptor, view if self._is_ready else view[:_PIECE]) :]

    def _leave(self) -> None:
        """Write nothing more; what others write to this descriptor goes nowhere."""
        self._is_gone = True
        with contextlib.suppress(OSError):
            nowhere = os.open(os.devnull, os.O_WRONLY | os.O_CLOEXEC)
            os.dup2(nowhere, self._descriptor)
            os.close(nowhere)


def hurry() -> None:
    """Let no output hold up the end any more. Safe in a signal handler."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, Terminal):
            stream.hurry()


def write_screen(text: str) -> None:
    """Write to standard output what moves the cursor of a terminal: own escape sequences around plain text."""
    if isinstance(sys.stdout, Terminal):
        sys.stdout.write_raw(text)
    else:
        sys.stdout.write(text)
        sys.stdout.flush()


def moves_cursor(stream: TextIO) -> bool:
    """Tell whether a stream is a terminal that can overwrite a line; TERM=dumb can't."""
    try:
        return stream.isatty() and os.environ.get("TERM", "dumb") != "dumb"
    except ValueError:  # it is closed
        return False


def has_colour(stream: TextIO) -> bool:
    """Tell whether colours may be written: to a terminal that isn't dumb, unless NO_COLOR is set, to anything."""
    return moves_cursor(stream) and not os.environ.get("NO_COLOR")


def write_line(stream: TextIO, text: str, is_over: bool, has_end: bool) -> None:
    """Write a line, over the one that the cursor is in where `is_over`; without `has_end` the cursor stays in it."""
    if not has_end:
        text = text[: shutil.get_terminal_size().columns - 1]
    whole = f"{_ERASE_LINE if is_over else ''}{plain(text)}{_LINE_END if has_end else ''}"
    if isinstance(stream, Terminal):
        stream.write_raw(whole)
    else:
        stream.write(whole)
        stream.flush()


_ERASE_LINE = "\r\x1b[2K"
_LINE_END = "\n"


def open_terminals() -> None:
    """Put the door before both streams of this process, for good; Ctrl-C ends a wait for one that blocks.

    Where a standard descriptor is closed it is opened to nowhere, so that no file of ours takes its place.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number, which is this one
    sys.stdout = Terminal(1, "standard output", is_needed=True)
    sys.stderr = Terminal(2, "standard error", is_needed=False)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not ignored, as in the background
        signal.signal(signal.SIGINT, _interrupt)
        sys.unraisablehook = _ask_again


def is_interrupted(error: BaseException | None) -> bool:
    """Tell whether Ctrl-C is behind an error: a compiled module that is being imported makes an ImportError of it."""
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return True
        error = error.__cause__ or error.__context__
    return False


def _ask_again(lost: "sys.UnraisableHookArgs") -> None:
    """Interrupt again, a moment later, where a Ctrl-C came in what raises nothing, as when compiled code is loaded."""
    if not issubclass(lost.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(lost)
        return
    again = threading.Timer(_MOMENT_S, _thread.interrupt_main)
    again.daemon = True
    with contextlib.suppress(RuntimeError):  # the process ends anyway
        again.start()


def _interrupt(number: int, frame: FrameType | None) -> None:
    hurry()
    signal.default_int_handler(number, frame)
