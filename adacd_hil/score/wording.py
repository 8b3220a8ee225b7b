"""One wording of each score, for the terminal, the page and the comments of a configuration."""

from typing import Final

from adacd_hil.printable import number_of

NONE: Final = "–"


def why_not_found(is_armed: bool) -> str:
    """Return in words why a contact was not found: missed, or detection was not armed."""
    return "missed" if is_armed else "not armed"


def found_text(found: int, contacts: int) -> str:
    """Return as text how many contacts were found, such as "3 of 4"."""
    return f"{found} of {contacts}"


def unjudged_sentence(count: int) -> str:
    """Return one line that says how many alarms the truth does not cover; "" without any."""
    return f"the truth doesn't cover {number_of(count, 'detection')}, not judged" if count else ""
