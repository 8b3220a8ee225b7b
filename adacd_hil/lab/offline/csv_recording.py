"""A recording in a CSV file: head, rows, and hints at the key of the map that would make a cell readable.

A row is skipped if it has fewer cells than the head, or a cell that isn't a number; an empty cell is a missing value.
A row of units below the head, perhaps a comment, is compared with the map.
"""

import csv
import io
import math
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Final, NamedTuple, TextIO

from adacd_hil.file_access import open_input
from adacd_hil.lab.offline.recorded_columns import RecordedColumns, RecordedRows
from adacd_hil.lab.offline.recording_map import ISO, TIME_S, RecordingMap, unit_of
from adacd_hil.log.log_files import LogError
from adacd_hil.log.time_window import TimeWindow
from adacd_hil.remedies import hint, nearest_name
from adacd_hil.settings.schema import ConfigError

DELIMITERS: Final = (",", ";", "\t", " ")
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_CUT, _UNREADABLE = "cut short", "that can't be read"
_KINDS_OF_FILE: Final = (
    (b"PK\x03\x04", "a spreadsheet or an archive: save it as CSV"),
    (b"\x1f\x8b", "compressed: gunzip it"),
    (b"\xff\xfe", "UTF-16: save it as UTF-8"),
    (b"\xfe\xff", "UTF-16: save it as UTF-8"),
    (b"MATLAB", "a MATLAB file: adacd_hil.api.detect takes arrays"),
    (b"\x93NUMPY", "a numpy array: adacd_hil.api.detect takes arrays"),
    (b"\x89HDF", "an HDF5 file: adacd_hil.api.detect takes arrays"),
    (b"PAR1", "a Parquet file: save it as CSV"),
    (b"LOGG", "a BLF of frames: `adacd-hil log export --format csv --dbc` makes tables of it"),
    (b"<?xml", "XML, no recording: if it is the URDF, the map names it, `arm.urdf`"),
    (b"<robot", "a URDF: the map names it, `arm.urdf`"),
)


class _Column(NamedTuple):
    """A column to read. name: as in errors, "" for times that the file lacks. place: index from 0.

    read: parses a cell, or raises ValueError. unit: as in the map.
    """

    name: str
    place: int
    read: Callable[[str], float]
    unit: str = ""


def read_csv(path: Path, described: RecordingMap, span: TimeWindow | None) -> RecordedColumns:
    """Read the columns that a map names from a CSV file; rows that can't be read are dropped and counted.

    span: as of `RecordedRows`; reading ends behind it. Raises ConfigError if the map doesn't name positions or torques,
    or gives neither times nor a period. Raises ConfigError, too, if the file lacks a named column, seems to have
    another delimiter, or has a row of other units. Raises LogError if the file can't be read, or as
    `RecordedRows.columns`.
    """
    for key in ("q", "tau_J"):
        if not getattr(described.columns, key):
            raise ConfigError(f"missing key `columns.{key}`: which columns of {path}?")
    rows = _rows(path, described)
    first = next(rows, None)
    if first is None:
        raise LogError(f"recording {path} is empty")
    head = _head(path, first[1], described)
    columns = _columns(path, head if described.csv.has_header else [], len(head), described)
    has_time = bool(columns[0].name)
    read = RecordedRows(path, len(columns), described.time_s if has_time else 1.0, span)
    if not has_time:
        read.notes.append(f"no column of times: a row every {described.sampling.period_s:g} s (sampling.period_s)")
    if not described.csv.has_header:
        rows = chain([first], rows)
    for number, row in _numbers(path, rows, columns, described, len(head), read):
        read.append(number, row)
        if read.is_past_span:
            break
    names = [column.name for column in columns[1 : len(columns) - bool(described.columns.contact)]]
    return read.columns(described, names, has_touches=bool(described.columns.contact))


def _head(path: Path, first: list[str], described: RecordingMap) -> list[str]:
    """Return the cells of the first row as of `head_of`.

    Raises ConfigError if the map says that there is a header, its delimiter gives one column, and another one over two.
    """
    heads = head_of(first)
    if described.csv.has_header and len(heads) == 1:
        for delimiter in DELIMITERS:
            if delimiter != described.csv.delimiter and len(heads[0].split(delimiter)) > 2:
                raise ConfigError(f"recording {path} has one column; with `csv.delimiter` = {delimiter!r} it has more")
    return heads


def trimmed(cells: list[str]) -> list[str]:
    """Return the stripped cells of a row without empty ones at its end: a delimiter may end every row."""
    while cells and not cells[-1].strip():
        cells = cells[:-1]
    return [cell.strip() for cell in cells]


def head_of(cells: list[str]) -> list[str]:
    """Return the cells of a head as of `trimmed`, without a "#" at its begin. Raises ValueError if all are empty."""
    first, *others = trimmed(cells)
    return [first.removeprefix("#").strip(), *others]


def _rows(path: Path, described: RecordingMap) -> Iterator[tuple[int, list[str]]]:
    """Yield the number of each row's last line in the file, from 1, and its cells.

    The first `csv.skip_rows` lines are skipped, but counted in the numbers. Empty rows are skipped, too. Raises
    LogError as `opened_text` and `split_rows`.
    """
    form = described.csv
    with opened_text(path) as file:
        for _ in range(form.skip_rows):
            next(file, "")
        for number, cells in split_rows(path, file, form.delimiter):
            if any(map(str.strip, cells)):
                yield number + form.skip_rows, cells


@contextmanager
def opened_text(path: Path) -> Iterator[TextIO]:
    """Open a text file for the block, without its byte-order mark if it has one.

    Raises LogError if the file can't be read or its first bytes are those of another format. An OSError, and a
    UnicodeDecodeError for text that isn't UTF-8, become a LogError when they leave the block.
    """
    try:
        with open_input(path) as file:
            begin = file.peek(16)
            for magic, kind in _KINDS_OF_FILE:
                if begin.startswith(magic):
                    raise LogError(f"recording {path} is {kind}")
            yield io.TextIOWrapper(file, encoding="utf-8-sig", newline="")
    except UnicodeDecodeError:
        raise LogError(f"recording {path} is no text in UTF-8") from None
    except OSError as error:
        raise LogError(f"recording {path}: {error.strerror or error}") from None


def split_rows(path: Path, lines: Iterable[str], delimiter: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the number of each row's last line, from 1, and its cells: a quoted cell may have several lines.

    A delimiter " " is any white space, but none behind a "#" that begins the line, and quotes mean nothing then. Raises
    LogError, with `path`, for bad CSV.
    """
    if delimiter == " ":
        yield from enumerate((re.sub(r"^\s*#\s+", "#", line).split() for line in lines), start=1)
        return
    rows = csv.reader(lines, delimiter=delimiter)
    try:
        for cells in rows:
            yield rows.line_num, cells
    except csv.Error as error:
        raise LogError(f"recording {path}, row {rows.line_num}: {error}") from None


def _columns(path: Path, heads: list[str], cells: int, described: RecordingMap) -> list[_Column]:
    """Return the columns to read in the order time, positions, torques, velocities, touches.

    heads: the file's, [] without a header. cells: number of them in a row. Raises ConfigError if the file lacks one of
    the map's columns.
    """
    columns, units = described.columns, described.units
    number = partial(read_number, decimal=",") if described.csv.decimal == "," else float
    contact = (columns.contact,) if columns.contact else ()
    found = [_time_column(path, heads, cells, described)]
    for names, unit in ((columns.q, units.q), (columns.tau_J, units.tau_J), (columns.dq, units.dq), (contact, "")):
        found += [_Column(name, _place(path, name, heads, cells), number, unit) for name in names]
    return found


def _time_column(path: Path, heads: list[str], cells: int, described: RecordingMap) -> _Column:
    """Return the time column. If the map gives a period and the file no such column, return one with the name "".

    Raises ConfigError if there are neither times nor a period, the file has several columns of the name, or the name
    looks misspelt.
    """
    name, units = described.columns.time, described.units
    read = _time_reader(iso_seconds if units.time == ISO else Decimal, described.csv.decimal)
    has_period = described.sampling.period_s > 0.0
    if name:
        try:
            return _Column(name, _place(path, name, heads, cells), read, units.time)
        except ConfigError as error:
            if not has_period or name in heads or nearest_name(name, heads) is not None:
                raise ConfigError(f"{error}; without times, give their distance by `sampling.period_s`") from None
    elif not has_period:
        raise ConfigError("missing key `columns.time`; where there are no times `sampling.period_s` is the period")
    return _Column("", 0, read)


def _place(path: Path, name: str, heads: list[str], cells: int) -> int:
    """Return the index, from 0, of a column by its head, or else by its number from 1.

    cells: number of columns. Raises ConfigError if the file has no such column, or several.
    """
    if heads.count(name) > 1:
        raise ConfigError(f"recording {path} has {heads.count(name)} columns {name!r}; write a column's number, from 1")
    if name in heads:
        return heads.index(name)
    if name.isdecimal() and 1 <= int(name) <= cells:
        return int(name) - 1
    raise ConfigError(f"recording {path} has no column {name!r}; {hint(name, heads or (f'1 to {cells}',))}")


def _numbers(
    path: Path,
    rows: Iterable[tuple[int, list[str]]],
    columns: list[_Column],
    described: RecordingMap,
    width: int,
    into: RecordedRows,
) -> Iterator[tuple[int, list[float]]]:
    """Yield each row's number in the file and its values, the time first; an empty cell is nan.

    Without a time column a row's time is its count, dropped rows included, times the map's period. Rows with too few
    cells, more filled ones than `width`, or a cell that isn't a number are dropped and counted in `into`. A row of
    units is skipped with a note in `into`. width: number of cells of a row. Raises ConfigError as `_below_units`.
    """
    has_time = bool(columns[0].name)
    wanted = columns if has_time else columns[1:]
    plain = [(column.place, column.read) for column in wanted]
    for count, (number, cells) in enumerate(_below_units(path, iter(rows), wanted, into)):
        if len(cells) < width:
            into.drop(_CUT, f"row {number}: it has {len(cells)} cells of {width}")
            continue
        try:
            row = [read(cells[place]) for place, read in plain]
        except (ValueError, OverflowError):
            row, wrong = _read_unusual_row(cells, wanted)
            if wrong:
                column, text = wrong[0]
                remedy = _remedy(text, column, described)
                into.drop(_UNREADABLE, f"row {number}: column {column.name!r} is {text!r}, no number{remedy}")
                continue
        if any(map(str.strip, cells[width:])):
            into.drop(_UNREADABLE, f"row {number}: it has {len(cells)} cells, more than the head's {width}")
            continue
        yield number, row if has_time else [count * described.sampling.period_s, *row]


def _below_units(
    path: Path, rows: Iterator[tuple[int, list[str]]], wanted: list[_Column], into: RecordedRows
) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows but comments, and but rows of units above the first row of numbers, which are noted in `into`.

    A row is of units if one of its wanted cells is a unit, or if some are texts without digits, the others empty; a
    comment if all are texts, one of them a unit. Raises ConfigError if a text in a row of units isn't the column's unit
    in the map.
    """
    for number, cells in rows:
        is_comment = cells[0].startswith("#")
        texts = [cells[0].removeprefix("#"), *cells[1:]]
        row, wrong = _read_unusual_row(texts, [column for column in wanted if column.place < len(cells)])
        names_unit = any(unit_of(text) for _, text in wrong)
        if is_comment and not (names_unit and len(wrong) == len(wanted)):
            continue
        is_text = (
            wrong and not any(map(math.isfinite, row)) and not re.search(r"\d", "".join(text for _, text in wrong))
        )
        if not (names_unit or is_text):
            yield number, cells
            break
        for column, text in wrong:
            if column.unit not in ("", ISO, unit_of(text)):
                raise ConfigError(
                    f"recording {path}, row {number}: {text!r} in column {column.name!r} is neither a number nor its "
                    f"unit in the map, {column.unit!r}: correct `units`, or delete the row"
                )
        into.notes.append(f"row {number} names units ({', '.join(text for _, text in wrong)})")
    yield from (row for row in rows if not row[1][0].startswith("#"))


def _read_unusual_row(cells: list[str], wanted: list[_Column]) -> tuple[list[float], list[tuple[_Column, str]]]:
    """Return the numbers of a row, nan for empty cells, and the columns and texts of cells that are no numbers.

    These cells are missing from the numbers.
    """
    row, wrong = [], []
    for column in wanted:
        text = cells[column.place].strip()
        try:
            row.append(column.read(text) if text else math.nan)
        except (ValueError, OverflowError):
            wrong.append((column, text))
    return row, wrong


def _remedy(text: str, column: _Column, described: RecordingMap) -> str:
    """Return the key of the map that would make a cell readable, as words that end a sentence, "" if there is none."""
    if described.csv.decimal == "." and text.count(",") == 1 and is_number(text, ","):
        return ': `csv.decimal` = "," reads it'
    return f': `units.time` = "{ISO}" reads it' if column.unit in TIME_S and is_iso_time(text) else ""


def read_number(text: str, decimal: str) -> float:
    """Parse a number as `float` does, nan and inf included; `decimal` "," means that commas are read as points.

    Raises ValueError if the text is none.
    """
    return float(text.replace(",", ".") if decimal == "," else text)


def _time_reader(read: Callable[[str], Decimal], decimal: str) -> Callable[[str], float]:
    """Return a function that parses a time, and subtracts the first finite time that it has parsed.

    read: parses a text with a decimal point. The function raises ValueError for a text that is no time. Times in ns
    since 1970 have more digits than a float.
    """
    first: Decimal | None = None

    def read_time(text: str) -> float:
        nonlocal first
        try:
            moment = read(text.strip().replace(decimal, "."))
            if first is None and moment.is_finite():
                first = moment
            return float(moment - (first or 0))
        except ArithmeticError:
            raise ValueError(text) from None

    return read_time


def iso_seconds(text: str) -> Decimal:
    """Parse a date and time of ISO 8601, UTC unless it has an offset, as s since 1970, to the µs.

    Raises ValueError if the text is none.
    """
    moment = datetime.fromisoformat(text)
    since = (moment if moment.tzinfo else moment.replace(tzinfo=UTC)) - _EPOCH
    return since // timedelta(microseconds=1) * Decimal("1e-6")


def is_number(text: str, decimal: str) -> bool:
    """Return whether a text is a number with this decimal sign; nan and inf are numbers, too."""
    return _is_readable(text, partial(read_number, decimal=decimal))


def is_iso_time(text: str) -> bool:
    """Return whether a text is a date, or a date and time, of ISO 8601."""
    return _is_readable(text, iso_seconds)


def _is_readable(text: str, read: Callable[[str], object]) -> bool:
    try:
        read(text)
    except ValueError:
        return False
    return True
