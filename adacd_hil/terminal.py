"""Standard output and error of both programs: all text for a terminal, a pipe or a file passes here.

Text from files or the bus can't control a terminal: control characters are escaped as in JSON (`plain`). A reader
that goes away, as `head` does, is no error. An output that blocks delays the end by half a second at most once the user
has asked for it, by a signal.
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
from collections.abc import Callable, Iterator
from types import FrameType
from typing import TextIO

from adacd_hil.printable import plain

_POLL_MS = 100
_PATIENCE_POLLS = 5
"""Polls of a blocked output after the user's request to end: 0.5 s."""
_NOBODY_READS = (errno.EPIPE, errno.EIO)
"""The other end of the pipe is closed, or the terminal has hung up."""
_MOMENT_S = 0.02
_PIECE = 1024
"""Bytes that a pipe or a terminal takes without blocking when it is ready: POSIX has PIPE_BUF of at least 512."""


def terminal_columns(stream: "TextIO | Terminal | None" = None) -> int | None:
    """Return the width to which text for a stream (default: standard output) is laid out; None: lines are not folded.

    It is the environment variable COLUMNS, else the terminal's width, else 80; at least 20. A stream that isn't a
    terminal has none, except standard output if COLUMNS is set.
    """
    is_output = stream is None or stream is sys.stdout
    stream = stream or sys.stdout
    given = os.environ.get("COLUMNS", "")
    columns = int(given) if given.isdecimal() and len(given) <= _MOST_DIGITS else 0
    if not _is_terminal(stream):
        return max(columns, _LEAST_COLUMNS) if columns and is_output else None
    with contextlib.suppress(OSError):  # the terminal has hung up since
        columns = columns or os.get_terminal_size(stream.fileno()).columns
    return max(columns or _COLUMNS, _LEAST_COLUMNS)


def _is_terminal(stream: "TextIO | Terminal") -> bool:
    try:
        return stream.isatty()
    except ValueError:  # it is closed
        return False


_COLUMNS, _LEAST_COLUMNS, _MOST_DIGITS = 80, 20, 5
"""Width of a terminal that doesn't report one; smallest width used; longest COLUMNS that is accepted, digits."""
_FIRST_FIELD = re.compile(r"\s*(?:\S+ )*\S+\s{2,}")


def fold(text: str, width: int | None) -> str:
    """Return a text, its lines that are longer than `width` folded between words. None: nothing is folded.

    If a line begins with words and a gap, such as a time, within a third of the width, its continuation is aligned
    below the text after the gap, else it is indented by two letters more than the line. A longer word, such as a path,
    is left whole, so that it can be copied.
    """
    if width is None:
        return text
    return "\n".join(part for line in text.split("\n") for part in _parts(line, width))


def _parts(line: str, width: int) -> list[str]:
    """Return the lines into which `fold` folds a line; a space at its end, as of a prompt, stays if it fits."""
    if len(line.expandtabs()) <= width:
        return [line]
    field = _FIRST_FIELD.match(line, 0, width // 3)
    hang = field.end() if field else len(line) - len(line.lstrip()) + 2
    parts = wrap_words(line, width, " " * min(hang, width // 2))
    if line.endswith(" ") and len(parts[-1]) < width:  # a prompt keeps its space before the answer
        parts[-1] += " "
    return parts


def wrap_words(text: str, width: int, indent: str, is_breaking: bool = False) -> list[str]:
    """Return the parts of a line, wrapped between words but not between a number and its unit.

    `indent` begins each part but the first.

    is_breaking: words that are longer than a part are split, too.
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
    """Return a text with `gap` in place of the space between each number and its unit, if _UNITS has that.

    most: a number and unit of more letters in all keep their space; None: no limit.
    """
    return _QUANTITY.sub(
        lambda found: found[0] if most and len(found[0]) > most else f"{found[1]}{gap}{found[2]}", text
    )


_KEPT_GAP = "\x00"
"""Replaces a space at which no line may end; escaped text never contains it."""
_UNITS = "%|A|Hz|kHz|K|N|Nm|bit|bytes|cm|deg|h|kg|m|min|mm|ms|rad|s|µs"
_QUANTITY = re.compile(rf"(?<!\S)(\S*\d) ((?:{_UNITS})(?!\w)\S*)")
_MARKS = {
    **dict.fromkeys(("FAILED", "error:", "fault:", "adacd-hil:", "firmware-sim:"), 31),
    **dict.fromkeys(("WARNING", "warning:"), 33),
    "ok": 32,
    "next:": 1,
}
"""Words that are red, yellow, green or bold (SGR codes) at the beginning of a line, or after its time."""
_MARK = re.compile(rf"^(\s*\d+\.\d\d s  |)({'|'.join(map(re.escape, _MARKS))})(?!\S)", re.MULTILINE)


def for_people(text: str, stream: "TextIO | Terminal") -> str:
    """Return a text for a stream: control characters escaped, lines folded, marks coloured if it has colours."""
    return painted(fold(plain(text), terminal_columns(stream)), stream)


def painted(text: str, stream: "TextIO | Terminal") -> str:
    """Return an escaped text with marks that begin a line, such as `error:`, coloured if the stream has colours."""
    if not has_colour(stream):
        return text
    return _MARK.sub(lambda found: f"{found[1]}\x1b[{_MARKS[found[2]]}m{found[2]}\x1b[0m", text)


class Terminal(io.TextIOBase):
    """A standard stream without a buffer, safe for threads.

    Once its reader has gone, or a write has failed or given up, writes are dropped.
    """

    encoding = "utf-8"
    """Whatever the locale."""
    errors = "backslashreplace"
    """Characters that UTF-8 can't encode, as in file names, are written in hexadecimal."""

    def __init__(self, descriptor: int, name: str, is_needed: bool) -> None:
        """Write to `descriptor`. is_needed: the first error of writing, as of a full disk, is raised, else ignored.

        name: of the stream, in errors.
        """
        self.name = name
        self._descriptor = descriptor
        self._is_needed = is_needed
        self._is_gone = False  # the reader has gone, or the wait for it is over
        self._patience = -1  # polls to wait for an output that blocks; negative: forever
        self._lock = threading.Lock()
        try:
            self._is_ready = stat.S_ISREG(os.fstat(descriptor).st_mode)  # a file never blocks
        except OSError:
            self._is_gone = True

    def fileno(self) -> int:
        """Return the descriptor."""
        return self._descriptor

    def isatty(self) -> bool:
        """Return whether the stream is a terminal whose reader has not gone."""
        return not self._is_gone and os.isatty(self._descriptor)

    def writable(self) -> bool:
        """Return True."""
        return True

    def write(self, text: str) -> int:
        """Write a text with control characters escaped; return its length.

        Unless the stream is needed, `for_people` folds and colours the text. Raises TypeError for anything but text;
        OSError if a needed stream can't be written, unless its reader has gone.
        """
        if not isinstance(text, str):
            raise TypeError(f"{self.name} takes text, not {type(text).__name__}")
        self.write_raw(plain(text) if self._is_needed else for_people(text, self))
        return len(text)

    def write_raw(self, text: str) -> None:
        """Write a text without escaping, for our own cursor movements; drop it once the reader has gone.

        Raises OSError if the stream is needed and can't be written, unless its reader has gone. After a write that
        failed, later texts are dropped without an error.
        """
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
        """Let each write wait for a blocked output half a second in all, counting time before this call.

        After a write that gives up, drop all later output. Safe in a signal handler.
        """
        self._patience = _PATIENCE_POLLS

    def _acquire(self) -> bool:
        """Take the lock once no other thread writes, and return True; after `hurry`, False if that takes 0.5 s."""
        polls = 0
        while not self._lock.acquire(timeout=_POLL_MS / 1000):
            polls += 1
            if 0 <= self._patience <= polls:
                return False
        return True

    def _put(self, view: memoryview) -> None:
        """Write all bytes, and wait while the output blocks: forever, or after `hurry` half a second.

        After giving up, `_is_gone` is True. Raises OSError if a write fails, as on a full disk or a closed pipe.
        """
        poll = select.poll()
        poll.register(self._descriptor, select.POLLOUT)
        polls = 0
        while view and not self._is_gone:
            if not self._is_ready and not poll.poll(_POLL_MS):
                polls += 1
                self._is_gone = 0 <= self._patience <= polls
                continue
            with contextlib.suppress(BlockingIOError):  # another process has made the descriptor non-blocking
                view = view[os.write(self._descriptor, view if self._is_ready else view[:_PIECE]) :]

    def _leave(self) -> None:
        """Write nothing more, and lead the descriptor to /dev/null, so that other code's output is discarded, too."""
        self._is_gone = True
        with contextlib.suppress(OSError):
            nowhere = os.open(os.devnull, os.O_WRONLY | os.O_CLOEXEC)
            os.dup2(nowhere, self._descriptor)
            os.close(nowhere)


def hurry() -> None:
    """Shorten the wait of both standard streams, see `Terminal.hurry`. Safe in a signal handler."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, Terminal):
            stream.hurry()


@contextlib.contextmanager
def handling(handler: Callable[..., object] | signal.Handlers, *numbers: signal.Signals) -> Iterator[None]:
    """Handle these signals while the block runs; then restore their handlers."""
    previous = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, before in previous.items():
            signal.signal(number, before)


@contextlib.contextmanager
def on_interrupt(interrupt: Callable[[], None], *further: signal.Signals) -> Iterator[None]:
    """Call a function on SIGINT, SIGTERM and SIGHUP while the block runs; then restore the handlers.

    A signal also shortens the waits for a blocked output. further: signals that call the function, too. SIGHUP stays
    ignored if it was. Outside the main thread, change nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(*_: object) -> None:
        hurry()
        interrupt()

    numbers = [signal.SIGINT, signal.SIGTERM, *further]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # else it was started to outlive its terminal
        numbers.append(signal.SIGHUP)
    with handling(handle, *numbers):
        yield


def write_screen(text: str, stream: TextIO | None = None) -> None:
    """Write a text to a stream (default: standard output) as it is: the caller has escaped all but our own sequences.

    Raises OSError as `Terminal.write_raw`.
    """
    stream = stream or sys.stdout
    if isinstance(stream, Terminal):
        stream.write_raw(text)
    else:
        stream.write(text)
        stream.flush()


def write_result(text: str) -> None:
    """Write a result and a line end to standard output, laid out by `for_people`.

    Raises OSError if it can't be written, as on a full disk; not if its reader has gone.
    """
    write_screen(for_people(f"{text}\n", sys.stdout))


def moves_cursor(stream: "TextIO | Terminal") -> bool:
    """Return whether a stream is a terminal that can overwrite a line; not with TERM=dumb or without TERM."""
    return _is_terminal(stream) and os.environ.get("TERM", "dumb") != "dumb"


def has_colour(stream: "TextIO | Terminal") -> bool:
    """Return whether colours may be written: to the terminals of `moves_cursor`.

    NO_COLOR, unless empty, forbids them; otherwise FORCE_COLOR or CLICOLOR_FORCE, unless empty or 0, force them.
    """
    if os.environ.get("NO_COLOR"):
        return False
    if any(os.environ.get(name, "0") not in ("", "0") for name in ("FORCE_COLOR", "CLICOLOR_FORCE")):
        return True
    return moves_cursor(stream)


def write_line(stream: TextIO, text: str, is_over: bool, has_end: bool) -> None:
    """Write a line of text. `is_over`: first erase the line in which the cursor is.

    `has_end`: lay the text out and end the line; otherwise cut the text to the terminal's width, and leave the cursor
    behind it.
    """
    shown = (
        f"{for_people(text, stream)}{_LINE_END}"
        if has_end
        else plain(text)[: (terminal_columns(stream) or _COLUMNS) - 1]
    )
    write_screen(f"{_ERASE_LINE if is_over else ''}{shown}", stream)


_ERASE_LINE = "\r\x1b[2K"
_LINE_END = "\n"


def open_terminals() -> None:
    """Replace both standard streams of this process by `Terminal`s; Ctrl-C ends a wait for a blocked one.

    A standard descriptor that is closed is opened to /dev/null, so that no file of ours gets its number. If SIGINT is
    neither ignored nor handled by others, `_interrupt` handles it, and `_ask_again` is the hook for lost exceptions.
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
    """Return whether Ctrl-C caused an error: importing a compiled module turns it into an ImportError."""
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return True
        error = error.__cause__ or error.__context__
    return False


def _ask_again(lost: "sys.UnraisableHookArgs") -> None:
    """Interrupt again, a moment later, if a Ctrl-C was lost where exceptions are dropped: in loading compiled code.

    It is the hook for lost exceptions; others are printed, as by default.
    """
    if not issubclass(lost.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(lost)
        return
    again = threading.Timer(_MOMENT_S, _thread.interrupt_main)
    again.daemon = True
    with contextlib.suppress(RuntimeError):  # the process ends anyway
        again.start()


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Handle SIGINT: shorten the waits of both streams, and raise KeyboardInterrupt."""
    hurry()
    signal.default_int_handler(number, frame)
