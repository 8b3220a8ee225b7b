"""Remedies in error messages: the nearest known name, the command that installs an extra."""

import sys
from collections.abc import Iterable
from difflib import SequenceMatcher
from pathlib import Path

_SHORTEST, _LONGEST = 2, 64
"""Fewest and most letters of a word that is compared with names."""
_LIKE = 0.66
"""Least share of common letters of a word and the name that is meant: "amr" and "arm" have 0.67, "Kx" and "Kp" 0.5."""


def nearest_name(word: str, known: Iterable[str]) -> str | None:
    """Return the known name that is most like `word` in each of its dotted parts; None if none is like it.

    None, too, for a word of less than 2 or more than 64 letters. Case is ignored. Units may be missing: `threshold`
    stands for `threshold_Nm`. Of equally near names the first is returned.
    """
    if not _SHORTEST <= len(word) <= _LONGEST:
        return None
    found = ((_likeness(word.casefold(), name.casefold()), name) for name in known)
    likeness, name = max(found, key=lambda pair: pair[0], default=(0.0, ""))
    return name if likeness >= _LIKE else None


def _likeness(word: str, name: str) -> float:
    parts = word.split("."), name.split(".")
    if len(parts[0]) != len(parts[1]):
        return 0.0
    return min(SequenceMatcher(None, *pair).ratio() for pair in zip(*parts, strict=True))


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
