"""The parts of a log to be read, and the counts in their summaries."""

from collections.abc import Collection, Mapping
from pathlib import Path

from adacd_hil.log.log_files import CLOSED, CONTINUED, LOG_NAME, LogError, find_parts, part_path

RECOVERED = "recovered"
"""The ending of a recovered log."""
CUT = "cut"
"""The ending of a stretch of a log."""
MERGED = "merged"
"""The ending of several logs in one, as earlier versions made it."""
COPY_ENDINGS = (RECOVERED, CUT, MERGED)
"""The endings of logs that are made of others."""
PLANNED_ENDINGS = (CLOSED, CONTINUED, *COPY_ENDINGS)
LOST_KEY = "lost"
"""Of the summary of a recovered log: its losses in words; missing without any."""
DROPPED_KEY = "dropped"
"""Of the summary: packets that are not in the log."""
_MOST_DIGITS = 19  # of 63 bits; Python refuses to read more than 4300


def log_in(given: str | Path) -> Path:
    """Return the given path of a log; for a folder the path of run.mcap in it.

    Raises LogError for a folder without run.mcap; a path that doesn't exist is returned as it is.
    """
    path = Path(given)
    if not path.is_dir():
        return path
    if not (path / LOG_NAME).exists():
        raise LogError(f"folder {path} has no {LOG_NAME}; name a log, or the folder of a run")
    return path / LOG_NAME


def parts_of(path: Path) -> dict[int, Path]:
    """Return the existing parts of the log `path` by number; {0: path} if none is found or can be listed."""
    try:
        return find_parts(path) or {0: path}
    except OSError:
        return {0: path}


def missing_parts(path: Path, parts: Collection[int], ending: str = "") -> list[Path]:
    """Return the paths of missing parts of the log `path`, [] if it is whole.

    These are the parts before the last existing one, and if `ending` is CONTINUED also the next. parts: the numbers of
    those that exist, at least one. ending: of the last one, from its summary.
    """
    last = max(parts)
    missing = [number for number in range(last) if number not in parts]
    if ending == CONTINUED:
        missing.append(last + 1)
    return [part_path(path, number) for number in missing]


def whole_number(text: str) -> int | None:
    """Return the number that a text is, of at most 63 bits; None for another text, as of a damaged log."""
    is_number = text.isdecimal() and len(text) <= _MOST_DIGITS and int(text) < 1 << 63
    return int(text) if is_number else None


def summary_count(texts: Mapping[str, str], key: str) -> int:
    """Return the count under a key in a log's summary; 0 if it is missing or not a number, see `whole_number`."""
    return whole_number(texts.get(key, "")) or 0
