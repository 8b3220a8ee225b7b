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
import signal
import stat
import sys
import textwrap
import threading
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


def terminal_columns(stream: "TextIO | Terminal | None" = None) -> int | None:
    """Give the width to which text for a stream, else standard output, is laid out; None: a line stays a line.

    It is COLUMNS where that is set, else the width of the terminal that the stream is. What isn't a terminal has none,
    but for standard output where COLUMNS is set.
    """
    is_output = stream is None or stream is sys.stdout
    stream = stream or sys.stdout
    told = os.environ.get("COLUMNS", "")
    columns = int(told) if told.isdecimal() and len(told) <= _MOST_DIGITS else 0
    if not _is_terminal(stream):
        return max(columns, _LEAST_COLUMNS) if columns and is_output else None
    with contextlib.suppress(OSError):  # it has hung up since
        columns = columns or os.get_terminal_size(stream.fileno()).columns
    return max(columns or _COLUMNS, _LEAST_COLUMNS)


def _is_terminal(stream: "TextIO | Terminal") -> bool:
    try:
        return stream.isatty()
    except ValueError:  # it is closed
        return False


_COLUMNS, _LEAST_COLUMNS, _MOST_DIGITS = 80, 20, 5
"""Of a terminal that doesn't say how wide it is; what words need; of COLUMNS."""
_FIRST_FIELD = re.compile(r"\s*(?:\S+ )*\S+\s{2,}")


def fold(text: str, width: int | None) -> str:
    """Part lines that are longer than `width` between words. None: nothing is parted.

    What follows stands below the text of a line that begins with a word and a gap, as a time, else it is indented two
    letters more. A word that is longer, as a path, is left whole, so that it can be copied.
    """
    if width is None:
        return text
    return "\n".join(part for line in text.split("\n") for part in _parts(line, width))


def _parts(line: str, width: int) -> list[str]:
    if len(line.expandtabs()) <= width:
        return [line]
    field = _FIRST_FIELD.match(line, 0, width // 3)
    hang = field.end() if field else len(line) - len(line.lstrip()) + 2
    parts = wrap_words(line, width, " " * min(hang, width // 2))
    if line.endswith(" ") and len(parts[-1]) < width:  # a question: what is typed stands apart from it
        parts[-1] += " "
    return parts


def wrap_words(text: str, width: int, indent: str, is_breaking: bool = False) -> list[str]:
    """Part a line between words, but not a number from its unit; what follows the first part has the indent.

    is_breaking: a word that is longer than a part is parted, too.
    """
    parts = textwrap.wrap(
        keep_units(text, _KEPT_GAP, width - len(indent)),
        width,
        subsequent_indent=indent,
        break_long_words=is_breaking,
        break_on_hyphens=False,
        replace_whitespace=False,
    )
    return [part.replace(_KEPT_GAP, " ") for part in parts] or [""]


def keep_units(text: str, gap: str, most: int | None = None) -> str:
    """Put `gap` for the space between a number and its unit, unless both have more than `most` letters."""
    return _QUANTITY.sub(
        lambda found: found[0] if most and len(found[0]) > most else f"{found[1]}{gap}{found[2]}", text
    )


_KEPT_GAP = "\x00"
"""Stands for a space at which no line ends; no plain text has it."""
_UNITS = "%|A|Hz|kHz|K|N|Nm|bit|bytes|cm|deg|h|kg|m|min|mm|ms|rad|s|µs"
_QUANTITY = re.compile(rf"(?<!\S)(\S*\d) ((?:{_UNITS})(?!\w)\S*)")
_MARKS = {
    **dict.fromkeys(("FAILED", "error:", "fault:", "adacd-hil:", "firmware-sim:"), 31),
    **dict.fromkeys(("WARNING", "warning:"), 33),
    "ok": 32,
    "next:": 1,
}
"""Words that are red, yellow, green or bold where a line begins with them, after its time."""
_MARK = re.compile(rf"^(\s*\d+\.\d\d s  |)({'|'.join(map(re.escape, _MARKS))})(?!\S)", re.MULTILINE)


def for_people(text: str, stream: "TextIO | Terminal") -> str:
    """Lay a text out for a stream: free of control characters but its own, folded, with colours where it has them."""
    return painted(fold(plain(text), terminal_columns(stream)), stream)


def painted(text: str, stream: "TextIO | Terminal") -> str:
    """Give marks in a plain text their colours, where the stream has them."""
    if not has_colour(stream):
        return text
    return _MARK.sub(lambda found: f"{found[1]}\x1b[{_MARKS[found[2]]}m{found[2]}\x1b[0m", text)


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
        self.write_raw(plain(text) if self._is_needed else for_people(text, self))
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


def write_screen(text: str, stream: TextIO | None = None) -> None:
    """Write what moves a cursor or has colours to a stream, else standard output: own sequences around plain text."""
    stream = stream or sys.stdout
    if isinstance(stream, Terminal):
        stream.write_raw(text)
    else:
        stream.write(text)
        stream.flush()


def write_told(text: str) -> None:
    """Write a result for people to standard output, as it is laid out there, and the end of its line."""
    write_screen(for_people(f"{text}\n", sys.stdout))


def moves_cursor(stream: "TextIO | Terminal") -> bool:
    """Tell whether a stream is a terminal that can overwrite a line; TERM=dumb can't."""
    return _is_terminal(stream) and os.environ.get("TERM", "dumb") != "dumb"


def has_colour(stream: "TextIO | Terminal") -> bool:
    """Tell whether colours may be written: to terminals that aren't dumb.

    NO_COLOR, set to anything, refuses them; else FORCE_COLOR and CLICOLOR_FORCE, but for 0, ask for them everywhere.
    """
    if os.environ.get("NO_COLOR"):
        return False
    if any(os.environ.get(name, "0") not in ("", "0") for name in ("FORCE_COLOR", "CLICOLOR_FORCE")):
        return True
    return moves_cursor(stream)


def write_line(stream: TextIO, text: str, is_over: bool, has_end: bool) -> None:
    """Write a line, over the one that the cursor is in where `is_over`; without `has_end` the cursor stays in it."""
    shown = (
        f"{for_people(text, stream)}{_LINE_END}"
        if has_end
        else plain(text)[: (terminal_columns(stream) or _COLUMNS) - 1]
    )
    write_screen(f"{_ERASE_LINE if is_over else ''}{shown}", stream)


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
