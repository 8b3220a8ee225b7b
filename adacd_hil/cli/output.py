"""Output and end of commands: tables, suggestions, the file of a result, the folder of a run, exit status.

Every command uses the same exit statuses; a command that fails prints one line.
"""

import contextlib
import errno
import functools
import itertools
import os
import shlex
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

from adacd_hil import start
from adacd_hil.clock import wall_ns
from adacd_hil.error_texts import error_text, is_disk_full
from adacd_hil.file_replacement import Replacement, has_other_head, removing_empty_folders, replace_file
from adacd_hil.log.recording.run_folder import check_free, is_there
from adacd_hil.plain_values import json_text
from adacd_hil.printable import in_line, one_line
from adacd_hil.settings.toml_files import builtin_names
from adacd_hil.table_layout import fit_table
from adacd_hil.terminal import fold, painted, terminal_columns, write_result, write_screen

PROGRAM = "adacd-hil"

if TYPE_CHECKING:
    from adacd_hil.control.session import SessionSummary  # its import compiles, which takes seconds


Given = TypeVar("Given")
Done = TypeVar("Done")

ExitCode = start.ExitCode
explain_statuses = start.explain_statuses

_MEANINGS = {
    "OK": "done",
    "FAILURE": "failure",
    "USAGE": "wrong usage or configuration",
    "PARTIAL": "partial result (the log lost something, or a disk is full)",
    "SAFETY_STOP": "safety stop (a fault, or a bus or arm that failed, ended the run)",
    "BUS_MISSING": "bus or devices missing",
    "DETECTOR_MISSING": "a registered detector can't be used",
    "INTERRUPTED": "interrupted",
}


def epilog(**own: str) -> str:
    """Return the exit statuses for a command's help; own: meanings that this command alone has, by ExitCode's names."""
    return explain_statuses(**_MEANINGS | own)


EPILOG = epilog()


def tell(line: str) -> None:
    """Print a line on standard error, control characters escaped; for lines that are neither question nor result."""
    print(in_line(line), file=sys.stderr, flush=True)


def is_terminal() -> bool:
    """Return whether stdin is a terminal, on which a user can type answers."""
    return sys.stdin is not None and sys.stdin.isatty()


class CommandError(Exception):
    """Ends a command with one line and an exit code."""

    def __init__(self, line: str, code: ExitCode = ExitCode.FAILURE) -> None:
        super().__init__(line)
        self.code = code


def exit_code(summary: "SessionSummary") -> ExitCode:
    """Return the exit status of a run; the first that applies.

    BUS_MISSING: it didn't start. SAFETY_STOP: it broke off, or ended in a fault. PARTIAL: the log is incomplete.
    INTERRUPTED: the user interrupted it. Else OK.
    """
    from adacd_hil.records import FaultReason

    if summary.result is None:
        return ExitCode.SAFETY_STOP if summary.has_started else ExitCode.BUS_MISSING
    if summary.result.fault is not FaultReason.NONE:
        return ExitCode.SAFETY_STOP
    if not summary.log.is_complete:
        return ExitCode.PARTIAL
    return ExitCode.INTERRUPTED if summary.result.is_interrupted else ExitCode.OK


def _expected() -> tuple[tuple[type[BaseException], ExitCode], ...]:
    """Return the exceptions that a command reports in one line, each with its exit status; the first match counts.

    Imported only after an error: numpy and cantools take longer to import than help takes to print.
    """
    from adacd_hil.log.log_files import LogError, LogExistsError
    from adacd_hil.settings.schema import ConfigError, DetectorError
    from adacd_hil.wire.bus import BusError, BusMissingError
    from adacd_hil.wire.codec import CodecError

    return (
        (CommandError, ExitCode.FAILURE),
        (DetectorError, ExitCode.DETECTOR_MISSING),
        (ConfigError, ExitCode.USAGE),
        (CodecError, ExitCode.USAGE),
        (BusMissingError, ExitCode.BUS_MISSING),
        (BusError, ExitCode.SAFETY_STOP),
        (LogExistsError, ExitCode.USAGE),
        (LogError, ExitCode.FAILURE),
        (OSError, ExitCode.FAILURE),
        (MemoryError, ExitCode.FAILURE),
    )


def explained(command: Callable[..., ExitCode]) -> Callable[..., None]:
    """Return a command wrapped: it ends the process with its exit status; of an expected error it prints one line.

    Expected are the errors of `_expected`, and Ctrl-C. Other errors pass through.
    """

    @functools.wraps(command)
    def run(*args: Any, **kwargs: Any) -> None:
        try:
            code = command(*args, **kwargs)
        except (Exception, KeyboardInterrupt) as error:
            code = complain(error)
        sys.exit(code)

    return run


def _code_of(error: BaseException) -> ExitCode | None:
    """Return the exit status of an expected error, which a command reports in one line; None for any other error."""
    return next((code for kind, code in _expected() if isinstance(error, kind)), None)


_REMEDY = "; give another place, or let its owner change the rights"


def _is_forbidden(error: BaseException) -> bool:
    """Return whether an error, or its cause, refuses access to a file: no permission, or a read-only file system."""
    causes = (error, error.__cause__)
    return any(isinstance(one, OSError) and one.errno in (errno.EACCES, errno.EPERM, errno.EROFS) for one in causes)


def complain(error: BaseException) -> ExitCode:
    """Print an expected error, or an interrupt, in one line and return its exit status; raise any other error again.

    The status is PARTIAL if the disk is full; a CommandError has its own.
    """
    if isinstance(error, KeyboardInterrupt):
        print("adacd-hil: interrupted", file=sys.stderr)
        return ExitCode.INTERRUPTED
    code = _code_of(error)
    if code is None:
        raise error
    line = f"{error_text(error) or type(error).__name__}{_REMEDY if _is_forbidden(error) else ''}"
    print(f"adacd-hil: {one_line(line)}", file=sys.stderr)
    if is_disk_full(error):
        return ExitCode.PARTIAL
    return error.code if isinstance(error, CommandError) else code


def one_by_one(given: Iterable[Given], work: Callable[[Given], Done]) -> tuple[list[Done], list[Exception]]:
    """Return the results of `work` on each of the given ones, and the expected errors of those that it failed on.

    A failure doesn't stop the work on the others. Expected are the errors of `_expected`; any other error is raised.
    """
    done: list[Done] = []
    refused: list[Exception] = []
    for each in given:
        try:
            done.append(work(each))
        except Exception as error:
            if _code_of(error) is None:
                raise
            refused.append(error)
    return done, refused


def complain_of(refused: Iterable[Exception]) -> ExitCode:
    """Print each expected error in a line, those of equal text once.

    Return the exit status of the first error, OK without any.
    """
    codes = [complain(error) for error in {str(error): error for error in refused}.values()]
    return codes[0] if codes else ExitCode.OK


def text_of(lines: Iterable[str]) -> str:
    """Return lines as a text, the control characters and line ends in each of them escaped."""
    return "\n".join(map(in_line, lines))


def format_table(
    head: Sequence[str], rows: Sequence[Sequence[str]], right: Sequence[int] = (), is_cut: bool = False, names: int = 1
) -> str:
    """Return rows aligned under a head, as text that fits the terminal on standard output. A head of "" is left out.

    right: columns, from 0, that are aligned to the right. is_cut: cut cells to one line; else a cell that is too long
    takes several lines. names: number of columns, from the left, that identify a row: they are repeated where a wide
    table is split.
    """
    lines = [tuple(head), *map(tuple, rows)] if any(head) else [*map(tuple, rows)]
    return "\n".join(fit_table(lines, right, terminal_columns(), is_cut, names))


def show(text: str, *next_commands: str) -> None:
    """Print a result for people, folded to their terminal, and suggest the next commands on standard error."""
    write_result(text)
    suggest(*next_commands)


def answer(as_json: bool, described: Any, text: str, *next_commands: str) -> None:
    """Print a result on standard output: `described` as JSON if as_json, else `text`.

    With the text, suggest the next commands on standard error.
    """
    if as_json:
        print(json_text(described))
    else:
        show(text, *next_commands)


def as_called(command: str) -> str:
    """Return a command as its user can call it: with the path of this program if a shell doesn't find its name.

    The path is that by which the user called the program; if it doesn't end in the program's name, as with `python -m`,
    the command is returned unchanged. So is a command of another program.
    """
    called = PROGRAM if shutil.which(PROGRAM) or not sys.argv[0].endswith(PROGRAM) else sys.argv[0]
    return f"{quoted(Path(called))}{command.removeprefix(PROGRAM)}" if command.startswith(PROGRAM) else command


def suggest(*next_commands: str) -> None:
    """Print commands to run next on standard error, each as by `as_called`, folded to the terminal there."""
    for place, command in enumerate(next_commands):
        line = _as_typed(f"{'next:' if place == 0 else '     '} {in_line(as_called(command))}")
        write_screen(painted(f"{line}\n", sys.stderr), sys.stderr)


def _as_typed(line: str) -> str:
    """Return a line with a command folded to the width of the terminal on standard error, with backslashes for a shell.

    `line` itself if it fits or there is no terminal. A command with quotes is not folded; a comment behind a command
    that doesn't fit gets a line of its own.
    """
    columns = terminal_columns(sys.stderr)
    command, mark, comment = line.partition("   # ")
    if columns is None or len(line) <= columns:
        return line
    parts = [command] if "'" in command else fold(command, columns - len(_GOES_ON)).split("\n")
    return f"{_GOES_ON}\n".join(parts) + (f"\n      # {comment}" if mark else "")


_GOES_ON = " \\"


def quoted(path: Path) -> str:
    """Return a path quoted for a shell."""
    return shlex.quote(str(path))


RESULT_HEAD: Final = "# A result of adacd-hil. The next one may replace this file.\n"
"""First line of a TOML file that `print_and_write` writes: a file without it is the user's."""
_NO_RESULT: Final = "what is there is no result of adacd-hil; give another name"


def extendable(config: str) -> str:
    """Return the name or file of a configuration as a file in any folder can extend it."""
    return config if config in builtin_names() else str(Path(config).resolve())


@contextmanager
def writable_folder(out: Path | None, extended: str | None = None) -> Iterator[None]:
    """Make the folder of a result before the block, and test that the file `out` can be written; do nothing for None.

    A folder that was made and is empty at the end is removed. extended: the configuration that the result will extend.
    Raises CommandError if the file can't be written, is no earlier result, or is that configuration.
    """
    if out is None:
        yield
        return
    with removing_empty_folders(out.parent):
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            Replacement(out).discard()
            if has_other_head(out, RESULT_HEAD.encode()):
                raise FileExistsError(errno.EEXIST, _NO_RESULT, str(out))
        except OSError as error:
            is_parent = isinstance(error, FileExistsError) and error.filename != str(out)
            reason = f"{error.filename} is no folder" if is_parent else error.strerror
            raise CommandError(f"{out} can't be written: {reason}") from error
        if extended is not None and out.exists() and Path(extended).exists() and out.samefile(extended):
            raise CommandError(f"--out {out} is the configuration itself; give another name", ExitCode.USAGE)
        yield


def print_and_write(text: str, out: Path | None, content: str, has_all: bool) -> None:
    """Print a result's text, and write `content` to the file `out`, unless that is None; make its folder if missing.

    The file begins with RESULT_HEAD. has_all: the text contains `content`. If the file can't be written, print
    `content` too, unless has_all, and raise CommandError.
    """
    failure = None
    if out is not None:
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            replace_file(out, f"{RESULT_HEAD}{content}")
        except OSError as error:
            failure = error
    print(text) if has_all else write_result(text)
    if failure is None:
        return
    if not has_all:
        print(f"\n{content}", end="")
    raise CommandError(f"{out} can't be written: {failure.strerror}; the result is printed above") from failure


RUNS = Path("runs")
LATEST = "latest"
_DATE = "%Y-%m-%dT%H-%M-%S"


@dataclass(frozen=True)
class RunFolder:
    """The folder of a run. `links`: symbolic links that are set to it when the run has started."""

    path: Path
    links: tuple[Path, ...] = ()

    def link(self, progress: Callable[[str], None] = lambda _: None) -> None:
        """Set the links; report each that can't be set to `progress`, and go on.

        A link isn't set if a file or folder has its name.
        """
        for link in self.links:
            try:
                _lead(link, self.path)
            except OSError as error:
                progress(f"link {link} is not set: {error.strerror}")


@contextmanager
def run_folder(out: Path | None, log_names: tuple[str, ...], name: str) -> Iterator[RunFolder]:
    """Choose the folder of a run and yield it: `out`, or a new one by date below `runs` if that is None.

    log_names: file names of the logs that will be made. name: of the command, and of the link to its last run. When the
    block ends, a folder that was made and is empty is removed. Raises LogExistsError if `out` has such a log, except of
    a start that failed, LogError if that can't be examined, OSError if the new folder can't be made.
    """
    if out is not None:
        for log_name in log_names:
            check_free(out / log_name)
        with removing_empty_folders(out):
            yield RunFolder(out)
        return
    with removing_empty_folders(RUNS):
        path = _make_dated()
        try:
            yield RunFolder(path, (RUNS / LATEST, RUNS / name))
        finally:
            with contextlib.suppress(OSError):  # it isn't empty
                path.rmdir()


def _make_dated() -> Path:
    """Make a new folder in `runs`, named by the date, with a number if that is taken; return it.

    Raises OSError if it can't be made.
    """
    RUNS.mkdir(parents=True, exist_ok=True)
    date = datetime.fromtimestamp(wall_ns() // 1_000_000_000).strftime(_DATE)
    for number in itertools.count(1):
        path = RUNS / (date if number == 1 else f"{date}_{number}")
        with contextlib.suppress(FileExistsError):
            path.mkdir()
            return path
    raise AssertionError


def _lead(link: Path, path: Path) -> None:
    """Set or replace a symbolic link to `path`, in one step.

    Raises FileExistsError if a file or folder has its name, OSError if it can't be set.
    """
    if is_there(link) and not link.is_symlink():
        raise FileExistsError(0, f"there is a {'folder' if link.is_dir() else 'file'} of that name")
    beside = link.with_name(f".{link.name}.{os.getpid()}")
    beside.unlink(missing_ok=True)
    beside.symlink_to(os.path.relpath(path, link.parent))
    try:
        beside.replace(link)
    except OSError:
        beside.unlink()
        raise
