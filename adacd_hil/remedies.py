"""Remedies in error messages: the nearest known name, the command that installs an extra."""

import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

_LONGEST = 64
_SLIPS = ((3, 0), (8, 1), (12, 2))
"""(length, slips): a shorter word may differ by so many slips: a letter added, lost or changed, or two swapped."""
_MOST_SLIPS = 3


def nearest_name(word: str, known: Iterable[str]) -> str | None:
    """Return the known name that differs from `word` by a few slips in each of its dotted parts, or by its ending.

    Case is ignored. Units may be missing: `threshold` stands for `threshold_Nm`. Of several names the nearest is
    returned, of equally near ones the first; None when no name is near.
    """
    if len(word) > _LONGEST:
        return None
    found = [(slips, name) for name in known if (slips := _slips_in_parts(word, name)) is not None]
    return min(found, key=lambda pair: pair[0])[1] if found else None


def _slips_in_parts(word: str, name: str) -> int | None:
    parts = [part.split(".") for part in (word.casefold(), name.casefold())]
    if len(parts[0]) != len(parts[1]):
        return None
    slips = [_slips(*pair) for pair in zip(*parts, strict=True)]
    return sum(count for count in slips if count is not None) if None not in slips else None


def _slips(word: str, name: str) -> int | None:
    """Count the slips between a word and a name; None when they are too many. An ending too few or too many is one."""
    pairs = [(word, name, 0)]
    pairs += [(word, form, 1) for form in _without_ending(name)]
    pairs += [(form, name, 1) for form in _without_ending(word)]
    counts = [ending + slips for *pair, ending in pairs if (slips := _distance(*pair)) <= _allowed(*pair)]
    shorter, longer = sorted((word, name), key=len)
    if longer.startswith(shorter) and _SLIPS[0][0] <= len(shorter) and len(longer) <= 2 * len(shorter):
        counts.append(1 + _MOST_SLIPS)
    return min(counts, default=None)


def _allowed(word: str, name: str) -> int:
    shorter = min(len(word), len(name))
    return next((slips for length, slips in _SLIPS if shorter < length), _MOST_SLIPS)


def _without_ending(name: str) -> Iterator[str]:
    """Yield the name without its last parts between underscores, as long as at least half of it is left."""
    while "_" in name:
        shorter = name.rpartition("_")[0]
        if 2 * len(shorter) < len(name):
            return
        name = shorter
        yield name


def _distance(word: str, name: str) -> int:
    """Count the least letters to insert, delete, replace or exchange with the next (optimal string alignment)."""
    before: list[int] = []
    last = list(range(len(name) + 1))
    for row, letter in enumerate(word, start=1):
        this = [row]
        for column, other in enumerate(name, start=1):
            cost = min(last[column] + 1, this[-1] + 1, last[column - 1] + (letter != other))
            if row > 1 and column > 1 and letter == name[column - 2] and word[row - 2] == other:
                cost = min(cost, before[column - 2] + 1)
            this.append(cost)
        before, last = last, this
    return last[-1]


_SOURCE_TREE = Path(__file__).resolve().parent.parent


def install_command(extra: str) -> str:
    """Return the command that installs an extra into this interpreter's environment, from the source tree if any.

    This package is in no registry: without a source tree the command names the package, and the user gives its file.
    """
    is_source = (_SOURCE_TREE / "pyproject.toml").is_file()
    source = "adacd-hil" if not is_source else "." if Path.cwd() == _SOURCE_TREE else str(_SOURCE_TREE)
    return f"{pip_command()} install {'-e ' if is_source else ''}'{source}[{extra}]'"


def pip_command() -> str:
    """Return the shortest command that runs this interpreter's pip."""
    executable = Path(sys.executable)
    pip = executable.with_name("pip")
    try:
        name = str((pip if pip.exists() else executable).relative_to(Path.cwd()))
    except ValueError:
        name = str(pip if pip.exists() else executable)
    return name if pip.exists() else f"{name} -m pip"
