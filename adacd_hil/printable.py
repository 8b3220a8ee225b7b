"""Text from files or the bus made printable, so that it can't control a terminal."""

import re

_CONTROL = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f"  # C0 but for tab and newline, DEL, C1
    "\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]"  # controls of writing direction, invisible line ends
)
_MOST_LETTERS = 2000


def plain(text: str) -> str:
    """Escape control characters of a text, except tabs and newlines, as JSON does, with four hexadecimal digits."""
    return _CONTROL.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def in_line(text: str) -> str:
    """Escape control characters as `plain` does, and also tabs and newlines, so that the text stays in its line."""
    return plain(text).replace("\n", "\\u000a").replace("\t", "\\u0009")


def one_line(text: object) -> str:
    """Put a text into one line, without control characters, cut at 2000 letters."""
    line = plain(" ".join(str(text).split()))
    return line if len(line) <= _MOST_LETTERS else f"{line[:_MOST_LETTERS]} …"
