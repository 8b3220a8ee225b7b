"""The files that a log consists of: run.mcap, then run_001.mcap, run_002.mcap and so on."""

import re
from pathlib import Path

_DIGITS, _MOST_DIGITS = 3, 5


def part_path(path: Path, number: int) -> Path:
    """Name a part of the log `path`; part 0 is `path` itself."""
    return path.with_name(f"{path.stem}_{number:0{_DIGITS}d}{path.suffix}") if number else path


def is_part_name(path: Path) -> bool:
    """Tell whether a file of this name would be taken for a part of a log that lies beside it."""
    match = re.fullmatch(rf"(.+)_\d{{{_DIGITS},{_MOST_DIGITS}}}", path.stem)
    return match is not None and path.with_name(f"{match[1]}{path.suffix}").exists()


def find_parts(path: Path) -> dict[int, Path]:
    """Find the parts of the log `path` that exist, by their numbers, in order. Raises OSError."""
    pattern = re.compile(rf"{re.escape(path.stem)}_(\d{{{_DIGITS},{_MOST_DIGITS}}}){re.escape(path.suffix)}")
    matches = (pattern.fullmatch(entry.name) for entry in path.parent.iterdir())
    numbers = {int(match[1]) for match in matches if match}
    if path.exists():
        numbers.add(0)
    named = {number: part_path(path, number) for number in sorted(numbers)}
    return {number: part for number, part in named.items() if part.exists()}
