"""Where a run puts its files: a folder that is given, or a new one by date, to which links lead."""

import contextlib
import itertools
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from adacd_hil.clock import wall_ns
from adacd_hil.log.recording.run_folder import check_free, is_there
from adacd_hil.output_files import tidied

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
