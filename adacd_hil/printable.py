"""Text for people: from files or the bus, made printable so that it can't control a terminal; a count with its noun."""

import re

_CONTROL = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f"  # C0 but for tab and newline, DEL, C1
    "\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]"  # controls of writing direction, invisible line ends
)
_MOST_LETTERS = 2000


def plain(text: str) -> str:
    """Return a text, its control characters, except tabs and newlines, escaped as in JSON by four hex digits."""
    return _CONTROL.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def in_line(text: str) -> str:
    """Return a text escaped as by `plain`, tabs and newlines, too, so that it stays in its line."""
    return plain(text).replace("\n", "\\u000a").replace("\t", "\\u0009")


def one_line(text: object) -> str:
    """Return a text in one line, white space as single spaces, control characters escaped, cut at 2000 letters."""
    line = plain(" ".join(str(text).split()))
    return line if len(line) <= _MOST_LETTERS else f"{line[:_MOST_LETTERS]} …"


def number_of(count: int, noun: str) -> str:
    """Return a count and its noun, such as "2 cycles"; the noun, given in the singular, gets an s unless it is one."""
    return f"{count} {noun}{'' if count == 1 else 's'}"
