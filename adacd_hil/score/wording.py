"""One wording of each score, for the terminal, the page and the comments of a configuration."""

from typing import Final

NONE: Final = "–"


def why_not_found(is_armed: bool) -> str:
    """Return why a contact was not found."""
    return "missed" if is_armed else "not armed"


def found_text(found: int, contacts: int) -> str:
    """Write how many contacts were found."""
    return f"{found} of {contacts}"


def number_of(count: int, noun: str) -> str:
    """Write a count with its noun."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def unjudged_sentence(count: int) -> str:
    """Write in one line how many alarms the truth does not cover; "" without one."""
    return f"the truth doesn't cover {number_of(count, 'detection')}, not judged" if count else ""
