"""What commands print and write: tables, progress, the file of a result, the folder of a run."""

import contextlib
import itertools
import os
import queue
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Self

from adacd_hil.cli.exit_codes import CommandError
from adacd_hil.clock import wall_ns
from adacd_hil.file_access import Replacement, replace_file, tidied
from adacd_hil.log.recording.run_folder import check_free, is_there
from adacd_hil.terminal import fit_table, in_line, terminal_columns


def format_table(head: Sequence[str], rows: Sequence[Sequence[str]], right: Sequence[int] = ()) -> str:
    """Align rows under a head; columns in `right` to the right. An empty head is left out."""
    lines = [tuple(head), *map(tuple, rows)] if any(head) else [*map(tuple, rows)]
    return "\n".join(fit_table(lines, right, terminal_columns()))


class Progress:
    """Lines on stderr about work in progress; their end waits for the last one, but not for ever.

    A thread of their own prints them: a stuck terminal must not stop the arm.
    """

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

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Print what is queued and end."""
        self._lines.put(None)
        self._thread.join(self.CLOSE_TIMEOUT_S)


@contextmanager
def tried(out: Path | None) -> Iterator[None]:
    """Before the block, make the folder of a result and a file in it that goes again; None: there is no file.

    A folder that was made and holds nothing afterwards goes, too. Raises CommandError.
    """
    if out is None:
        yield
        return
    with tidied(out.parent):
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            Replacement(out).discard()
        except FileExistsError as error:
            raise CommandError(f"{out} can't be written: {error.filename} is no folder") from error
        except OSError as error:
            raise CommandError(f"{out} can't be written: {error.strerror}") from error
        yield


def tell(said: str, out: Path | None, content: str, has_all: bool) -> None:
    """Write `content` to the file of a result, and print what is said of it.

    Where the file can't be written its content is printed, too, unless what is said has all of it. Raises CommandError.
    """
    failure = None
    if out is not None:
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            replace_file(out, content)
        except OSError as error:
            failure = error
    print(said)
    if failure is None:
        return
    if not has_all:
        print(f"\n{content}", end="")
    raise CommandError(f"{out} can't be written: {failure.strerror}; what was found is printed above") from failure


RUNS = Path("runs")
LATEST = "latest"
_DATE = "%Y-%m-%dT%H-%M-%S"


@dataclass(frozen=True)
class RunFolder:
    """The folder of a run. `links`: what leads to it once the run has started."""

    path: Path
    links: tuple[Path, ...] = ()

    def link(self, progress: Callable[[str], None] = lambda _: None) -> None:
        """Let the links lead to it; one whose place something else has is left out, and that is told."""
        for link in self.links:
            try:
                _lead(link, self.path)
            except OSError as error:
                progress(f"link {link} is not set: {error.strerror}")


@contextmanager
def run_folder(out: Path | None, log_names: tuple[str, ...], name: str) -> Iterator[RunFolder]:
    """Choose the folder of a run: `out`, or where that is None a new one below `runs`, by date.

    log_names: of the logs that will be made. name: of the command; a link to its last run has it. When the block ends,
    a folder that was made for the run and holds nothing is removed. Raises LogExistsError when `out` has such a log,
    LogError, OSError.
    """
    if out is not None:
        for log_name in log_names:
            check_free(out / log_name)
        with tidied(out):
            yield RunFolder(out)
        return
    with tidied(RUNS):
        path = _make_dated()
        try:
            yield RunFolder(path, (RUNS / LATEST, RUNS / name))
        finally:
            with contextlib.suppress(OSError):  # it holds something
                path.rmdir()


def _make_dated() -> Path:
    RUNS.mkdir(parents=True, exist_ok=True)
    date = datetime.fromtimestamp(wall_ns() // 1_000_000_000).strftime(_DATE)
    for number in itertools.count(1):
        path = RUNS / (date if number == 1 else f"{date}_{number}")
        with contextlib.suppress(FileExistsError):
            path.mkdir()
            return path
    raise AssertionError


def _lead(link: Path, path: Path) -> None:
    """Make a link to `path`, or let one that is there lead to it, in one step. Raises OSError."""
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
