"""Text tables: columns as wide as what is in them, and on a terminal no line wider than it."""

from collections.abc import Sequence

from adacd_hil.terminal import fit_table, terminal_columns


def format_table(head: Sequence[str], rows: Sequence[Sequence[str]], right: Sequence[int] = ()) -> str:
    """Align rows under a head; columns in `right` to the right. An empty head is left out."""
    lines = [tuple(head), *map(tuple, rows)] if any(head) else [*map(tuple, rows)]
    return "\n".join(fit_table(lines, right, terminal_columns()))
