"""Tables for people: cells in columns, laid out to the width of a terminal.

In a table that is wider than the terminal, columns of words first get narrower, and their cells continue in further
lines. If that isn't enough, the table is printed in parts, each of which begins with the first column. On a screen that
is redrawn a row is one line, and cells are cut.
"""

import re
from collections.abc import Collection, Sequence
from itertools import zip_longest

from adacd_hil.printable import in_line
from adacd_hil.terminal import wrap_words

_GAP = "  "
_LEAST_ROOM, _LEAST_CUT = 16, 8
"""Letters to which a column of words may shrink: when cells wrap, when they are cut."""
_JOINT = re.compile(r"(?<=[/_,=:;])|(?<=\.)(?!\d)")
"""Places where a long word, such as a path or a key, may be split; never within a number."""


def fit_table(
    lines: Sequence[Sequence[str]],
    right: Collection[int] = (),
    width: int | None = None,
    is_cut: bool = False,
    names: int = 1,
) -> list[str]:
    """Return lines of cells as aligned text; columns in `right` to the right. Each cell is escaped to text of one line.

    No line is wider than `width`, of at least 20; None: no limit. A wider table is returned in parts, an empty line
    between them. is_cut: each row is one line, its cells cut. names: number of columns that identify a row; each part
    begins with them, or with the first alone if they leave no room for others. [] without lines.
    """
    if not lines:
        return []
    lines = [[in_line(cell) for cell in line] for line in lines]
    natural = [max(map(len, cells)) for cells in zip(*lines, strict=True)]
    if width is None or _sum(natural) <= width:
        return _aligned(lines, natural, right)
    least = [
        most if column in right else min(most, _LEAST_CUT if is_cut else _least_room(column, lines))
        for column, most in enumerate(natural)
    ]
    told: list[str] = []
    for part in _parts(least, width, names):
        widths = _shrunk([natural[column] for column in part], [least[column] for column in part], width)
        cells = ([line[column] for column in part] for line in lines)
        rows = [row for line in cells for row in (_cut(line, widths) if is_cut else _rows(line, widths))]
        told += [""] if told else []
        told += _aligned(rows, widths, [place for place, column in enumerate(part) if column in right])
    return told


def _sum(widths: Sequence[int]) -> int:
    return sum(widths) + len(_GAP) * (len(widths) - 1)


def _least_room(column: int, lines: Sequence[Sequence[str]]) -> int:
    """Return the smallest width of a column, in letters: the longest piece of a word, at least `_LEAST_ROOM`.

    Words of the first column stay whole; words of the others may split at the joints of a path or a key.
    """
    words = (word for line in lines for word in line[column].split())
    pieces = (piece for word in words for piece in (_JOINT.split(word) if column else [word]))
    return max(_LEAST_ROOM, *map(len, pieces), 0)


def _parts(least: Sequence[int], width: int, names: int) -> list[list[int]]:
    """Return the columns of each part of a wide table: the first `names`, then as many others as fit, one at least.

    least: smallest width of each column; width: of the terminal. If the first `names` leave no room for another column,
    only the first one is repeated.
    """
    if _sum([*least[:names], max(least[names:], default=0)]) > width:
        names = 1
    parts = [list(range(names))]
    for column in range(names, len(least)):
        if len(parts[-1]) > names and _sum([least[place] for place in (*parts[-1], column)]) > width:
            parts.append(list(range(names)))
        parts[-1].append(column)
    return parts


def _shrunk(natural: list[int], least: list[int], width: int) -> list[int]:
    """Return the widths of a part's columns: `natural`, the widest narrowed by turns until the part fits into `width`.

    No width falls below its `least`, unless the part can't fit otherwise.
    """
    widths = [min(one, width) for one in natural]
    while _sum(widths) > width:
        able = [place for place, one in enumerate(widths) if one > least[place]] or range(len(widths))
        widest = max(able, key=lambda place: widths[place])
        if widths[widest] <= 1:
            break
        widths[widest] -= 1
    return widths


def _rows(line: Sequence[str], widths: Sequence[int]) -> list[tuple[str, ...]]:
    """Return the rows of a line with its cells wrapped; each row has a cell per column, "" below a shorter cell.

    Continued lines of the first cell are indented, to tell them from a new row.
    """
    cells = [
        _wrapped(cell, width, "" if column else "  ")
        for column, (cell, width) in enumerate(zip(line, widths, strict=True))
    ]
    return list(zip_longest(*cells, fillvalue=""))


def _cut(line: Sequence[str], widths: Sequence[int]) -> list[list[str]]:
    """Return a line as its only row, each cell cut to its column's width."""
    return [[cell if len(cell) <= width else f"{cell[: width - 1]}…" for cell, width in zip(line, widths, strict=True)]]


def _wrapped(text: str, width: int, indent: str) -> list[str]:
    """Return the lines of a cell, wrapped to a width; `indent`, if narrower, begins each but the first."""
    if len(text) <= width:
        return [text]
    indent = indent if len(indent) < width else ""
    room = width - len(indent)
    words = (word if len(word) <= room else _broken(word, room) for word in text.split(" "))
    first, *others = wrap_words(" ".join(words), room, "", is_breaking=True)
    return [first, *(f"{indent}{other}" for other in others)]


def _broken(word: str, room: int) -> str:
    """Return a word longer than `room` with a space where it is split: at joints of a path or a key, as few as needed.

    A piece without a joint may stay longer than `room`.
    """
    parts = [""]
    for piece in _JOINT.split(word):
        if len(parts[-1]) + len(piece) > room:
            parts.append("")
        parts[-1] += piece
    return " ".join(filter(None, parts))


def _aligned(lines: Sequence[Sequence[str]], widths: Sequence[int], right: Collection[int]) -> list[str]:
    """Return rows as text, cells padded to their column's width; columns in `right` are aligned to the right."""
    return [
        _GAP.join(
            cell.rjust(width) if column in right else cell.ljust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    ]
