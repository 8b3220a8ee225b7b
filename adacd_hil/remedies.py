"""The known name that is most like a word, and the hint at it in an error message."""

from collections.abc import Collection, Iterable
from difflib import SequenceMatcher

_SHORTEST, _LONGEST = 2, 64
"""Fewest and most letters of a word that is compared with names."""
_LIKE = 0.66
"""Least share of common letters of a word and the name that is meant: "amr" and "arm" have 0.67, "Kx" and "Kp" 0.5."""


def nearest_name(word: str, known: Iterable[str]) -> str | None:
    """Return the known name that is most like `word` in each of its dotted parts; None if none is like it.

    Like it: each part has a share of common letters of at least `_LIKE`. None, too, for a word that is shorter than
    `_SHORTEST` or longer than `_LONGEST`. Case is ignored. A short unit may be missing: `threshold` is like
    `threshold_Nm`. Of equally near names the first is returned.
    """
    if not _SHORTEST <= len(word) <= _LONGEST:
        return None
    found = ((_likeness(word.casefold(), name.casefold()), name) for name in known)
    likeness, name = max(found, key=lambda pair: pair[0], default=(0.0, ""))
    return name if likeness >= _LIKE else None


def hint(word: str, known: Collection[str]) -> str:
    """Return "did you mean 'NAME'?" with the nearest known name of a word, else "known: " and all names or "none"."""
    near = nearest_name(word, known)
    return f"did you mean {near!r}?" if near else f"known: {', '.join(known) or 'none'}"


def _likeness(word: str, name: str) -> float:
    """Return the least likeness of the dotted parts of word and name, 0 to 1; 0 if their numbers of parts differ."""
    parts = word.split("."), name.split(".")
    if len(parts[0]) != len(parts[1]):
        return 0.0
    return min(SequenceMatcher(None, *pair).ratio() for pair in zip(*parts, strict=True))
