"""Recordings to tables in Parquet or CSV, one file each: topics of our logs, and frames decoded by a contract.

A stretch of the log is in memory at a time. A table begins with `t_ns` (of the run's clock) and `cycle_t_ns` (of the
cycle that it was logged with, by which tables are joined); a field of several numbers becomes as many columns,
`tau_J_1`, `tau_J_2`. Booleans stay booleans, states and reasons are the numbers that the schemas name.
"""

import csv
import errno
import fnmatch
import itertools
import math
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.extras import install_command
from adacd_hil.file_replacement import has_other_head, replacing
from adacd_hil.lab.logs.joint_states import joint_state_columns
from adacd_hil.log.frames.frame_log import of_one_channel, open_frames
from adacd_hil.log.log_files import SUFFIX, LogError, failing_as
from adacd_hil.log.reader import LoggedEvent, LogStream, Series
from adacd_hil.log.types.record_arrays import FRAME_TOPICS
from adacd_hil.log.types.topics import DECODED, EVENTS
from adacd_hil.remedies import nearest_name
from adacd_hil.wire.dbc_decoder import DbcDecoder

_LONGEST_STEM = 60
"""Letters of the name of a file, so that it has room in 255 bytes."""

_HEADS = {"csv": b"t_ns,", "parquet": b"PAR1"}
"""First bytes of the tables that this module writes."""

Columns = Mapping[str, Any]
"""Columns of a table by name, of equal length: arrays or lists."""
AddRows = Callable[[Columns], None]
"""Adds rows to a table."""


def series_columns(series: Series, epoch_ns: int) -> dict[str, Any]:
    """Return the columns of a topic's table by name; a field of n numbers becomes n columns.

    First come `t_ns`, and `cycle_t_ns`, the publish time on the same scale. epoch_ns: offset of the file's times from
    t_ns.
    """
    columns: dict[str, Any] = {
        "t_ns": series.t_ns,
        "cycle_t_ns": series.records["publish_time"].astype(np.int64) - epoch_ns,
    }
    for name in series.fields:
        values = series[name]
        if values.ndim == 1:
            columns[name] = values
        else:
            columns |= {f"{name}_{place}": values[:, place - 1] for place in range(1, values.shape[1] + 1)}
    return columns


def event_columns(events: Iterable[LoggedEvent]) -> dict[str, Any]:
    """Return the columns t_ns, level, name and message of the table of /events."""
    rows = [(t_ns, *event) for t_ns, event in events]
    return {name: [row[place] for row in rows] for place, name in enumerate(("t_ns", "level", "name", "message"))}


def frame_columns(frames: NDArray[Any], decoder: DbcDecoder) -> Iterator[tuple[str, dict[str, Any]]]:
    """Decode frames of RECORDED_FRAME_DTYPE by a DBC; yield name and columns of each message that occurs.

    A signal that a frame lacks, because it is short or multiplexed, is NaN. Error and remote frames are left out, and
    so are frames without a message in the DBC. If the DBC is a contract, frames of another length than their message
    are left out, too. A signal that is named like `t_ns` or `cycle_t_ns` gets a "_" at its end.
    """
    frames = frames[~frames["is_error"] & ~frames["is_remote"]]
    there = set(frames["can_id"].tolist())
    for message in decoder.messages.values():
        if message.can_id not in there:
            continue
        is_own = (frames["can_id"] == message.can_id) & (frames["is_extended"] == message.is_extended)
        found = frames[is_own]
        found = found[np.array([message.takes(length) for length in found["length"].tolist()], np.bool_)]
        if not len(found):
            continue
        pairs = zip(found["data"], found["length"].tolist(), strict=True)
        rows = [message.decode(data[:length].tobytes()) for data, length in pairs]
        columns: dict[str, Any] = {"t_ns": found["t_ns"], "cycle_t_ns": found["cycle_t_ns"]}
        for name in message.units:
            values = np.array([row.get(name, math.nan) for row in rows], np.float64)
            columns[name if name not in columns else f"{name}_"] = values
        yield message.name, columns


class Tables:
    """Files of tables in one folder, each begun with its first rows.

    They appear at the end of the `with` block, if no error ends it.
    """

    def __init__(self, folder: Path, kind: str, metadata: Mapping[str, str]) -> None:
        """Make the folder for tables of a kind, "csv" or "parquet"; `metadata` goes into Parquet files.

        Raises LogError if the folder can't be made, or if pyarrow is missing.
        """
        self.rows: dict[Path, int] = {}
        """Number of rows of each file."""
        self._folder = folder
        self._kind = kind
        self._metadata = dict(metadata)
        self._paths: dict[str, Path] = {}
        self._tables: dict[str, AddRows] = {}
        self._files = ExitStack()
        if kind == "parquet":
            import_pyarrow()
        with failing_as(f"{folder} can't be made a folder"):
            folder.mkdir(parents=True, exist_ok=True)

    def add_rows(self, topic: str, columns: Columns) -> None:
        """Add rows to a topic's table; the first call begins the file, even without rows.

        Raises LogError if the file can't be written, or if what is there is no table.
        """
        path = self._paths.get(topic) or self._path(topic)
        with failing_as(f"{path} can't be written"):
            if topic not in self._tables:
                if has_other_head(path, _HEADS[self._kind]):  # as a recording may be, which is CSV, too
                    raise FileExistsError(errno.EEXIST, "what is there is no table of this command", str(path))
                beside = self._files.enter_context(replacing(path))
                is_csv = self._kind == "csv"
                table = _csv_table(beside, columns) if is_csv else _parquet_table(beside, columns, self._metadata)
                self._tables[topic] = self._files.enter_context(table)
                self.rows[path] = 0
                self._tables[topic](columns)
            elif len(columns["t_ns"]):
                self._tables[topic](columns)
        self.rows[path] += len(columns["t_ns"])

    def _path(self, topic: str) -> Path:
        """Return the path of a topic's file; a number tells topics apart whose names give the same file name."""
        stem = re.sub(r"[^\w.-]", "_", topic.strip("/"))[:_LONGEST_STEM] or "_"
        stems = itertools.chain((stem,), (f"{stem}_{number}" for number in itertools.count(2)))
        paths = (self._folder / f"{stem}.{self._kind}" for stem in stems)
        self._paths[topic] = next(path for path in paths if path not in self.rows)
        return self._paths[topic]

    def __enter__(self) -> "Tables":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Complete all files and give them their names; remove them after an error. Raises LogError if that fails."""
        with failing_as(f"{self._folder} can't be written"):
            self._files.__exit__(kind, value, trace)


@contextmanager
def _csv_table(path: Path, head: Columns) -> Iterator[AddRows]:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(head)

        def add_rows(columns: Columns) -> None:
            lists = [values.tolist() if isinstance(values, np.ndarray) else values for values in columns.values()]
            writer.writerows(zip(*lists, strict=True))

        yield add_rows


@contextmanager
def _parquet_table(path: Path, head: Columns, metadata: dict[str, str]) -> Iterator[AddRows]:
    arrow, parquet = import_pyarrow()
    schema = arrow.table(dict(head)).schema.with_metadata(metadata)
    with parquet.ParquetWriter(path, schema, compression="zstd") as writer:
        yield lambda columns: writer.write_table(arrow.table(dict(columns)))


def import_pyarrow() -> tuple[Any, Any]:
    """Return the modules pyarrow and pyarrow.parquet.

    Raises LogError with the command to install if they are missing.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        hint = f"Parquet is written with pyarrow: {install_command('tables')}, or choose csv"
        raise LogError(hint) from None
    return pyarrow, pyarrow.parquet


_RAW = tuple(name.removeprefix("/") for name in FRAME_TOPICS)
"""Ends of the topics of frames, which other formats are for."""


class TableSummary(NamedTuple):
    """Number of rows of each written file.

    `problem`: one line on the missing part of the recording, "" if it is whole. `notes`: a line each on messages that
    were decoded in part.
    """

    rows: Mapping[Path, int]
    problem: str
    notes: Sequence[str] = ()


def export_tables(
    path: Path,
    out: Path,
    kind: str,
    wanted: Collection[str],
    decoder: DbcDecoder,
    progress: Callable[[int], None] = lambda _: None,
) -> TableSummary:
    """Write the tables of a recording into the folder `out`; return their numbers of rows.

    kind: "csv" or "parquet". wanted: topics or patterns such as `decoded/*`, with or without the first slash; empty:
    all. decoder: decodes the frames of recordings that have no other topics. progress: called with the number of rows
    so far. Raises LogError if the recording can't be read, lacks a topic, or a table can't be written.
    """
    is_mcap = path.suffix.lower() == SUFFIX
    defined = _topics(path) if is_mcap else []
    raw = [topic for topic in defined if topic.rsplit("/", 1)[-1] in _RAW]
    topics = [topic for topic in defined if topic not in raw]
    if topics:
        return _export_topics(path, out, kind, choose_topics(topics, wanted, raw), progress)
    if is_mcap and wanted and not raw:
        raise LogError(f"{path} has no topic that can be read")
    return _export_frames(path, out, kind, wanted, decoder, progress)


def choose_topics(
    topics: Collection[str], wanted: Collection[str], raw: Collection[str] = (), owner: str = "the log"
) -> list[str]:
    """Return the topics that fit names or patterns, each once; wanted empty: all.

    Raises LogError if one of `wanted` fits no topic.

    wanted: each with or without the first slash or `DECODED`. raw: topics of frames, of which no table is made. owner:
    the source of the topics, for the error.
    """
    if not wanted:
        return list(topics)
    chosen: list[str] = []
    for pattern in wanted:
        found = _matching(topics, pattern)
        if not found:
            if frames := _matching(raw, pattern):
                raise LogError(f"topic {frames[0]} holds frames, which become no table: `can_logconvert` converts them")
            near = nearest_name("/" + pattern.strip("/"), topics) or nearest_name(DECODED + pattern, topics)
            hint = f"did you mean {near}" if near else f"there are {', '.join(topics)}"
            raise LogError(f"{owner} has no topic {pattern}, {hint}")
        chosen += found
    return list(dict.fromkeys(chosen))


def _matching(topics: Collection[str], pattern: str) -> list[str]:
    forms = ("/" + pattern.strip("/"), DECODED + pattern)
    return [topic for topic in topics if any(fnmatch.fnmatchcase(topic, form) for form in forms)]


def _export_topics(
    path: Path, out: Path, kind: str, topics: list[str], progress: Callable[[int], None]
) -> TableSummary:
    stream = LogStream(path, topics)
    keys: dict[tuple[str, tuple[str, ...]], str] = {}  # tables of joint states: a choice of joints has its own
    with Tables(out, kind, stream.metadata) as tables:
        for piece in stream:
            others = stream.joint_states(piece)
            for topic, series in piece.series.items():
                if topic in topics and topic not in others and (len(series) or stream.metadata):
                    tables.add_rows(topic, series_columns(series, stream.epoch_ns))
            for topic, payloads in others.items():
                for names, columns in joint_state_columns(payloads):
                    is_first = all(other != topic for other, _ in keys)
                    key = keys.setdefault((topic, names), topic if is_first else f"{topic}_{names[0]}_{len(keys)}")
                    tables.add_rows(key, columns)
            if events := stream.events(piece):
                tables.add_rows(EVENTS.name, event_columns(events))
            progress(sum(tables.rows.values()))
        if not tables.rows and not stream.problem:
            raise LogError(f"{path} makes no table: messages of varying size are not exported: {', '.join(topics)}")
    return TableSummary(tables.rows, stream.problem)


def _export_frames(
    path: Path, out: Path, kind: str, wanted: Collection[str], decoder: DbcDecoder, progress: Callable[[int], None]
) -> TableSummary:
    source = open_frames(path)
    owner = f"{path} has frames only, and their contract {decoder.path.name}"
    chosen = choose_topics([DECODED + name for name in decoder.messages], wanted, owner=owner)
    can_ids = [message.can_id for message in decoder.messages.values()]
    known = (frames[np.isin(frames["can_id"], can_ids)] for frames in source)
    pieces = of_one_channel(known, source.channels, path)
    with Tables(out, kind, {"contract": decoder.path.name}) as tables:
        for frames in pieces:
            for name, columns in frame_columns(frames, decoder):
                if DECODED + name in chosen:
                    tables.add_rows(DECODED + name, columns)
            progress(sum(tables.rows.values()))
    notes = [
        f"{name}: of {count} frames only the signals that are in every frame are decoded: {reason}"
        for name, message in decoder.messages.items()
        if DECODED + name in chosen
        for reason, count in message.partly_decoded.items()
    ]
    return TableSummary(tables.rows, source.problem, notes)


def _topics(path: Path) -> list[str]:
    """Return the topics that a log defines within its first 5000 cycles; a shorter log is read to its end.

    A cycle has messages of one publish time. path: of an MCAP file. Raises LogError if it can't be read.
    """
    stream = LogStream(path, is_ahead=False)
    next(iter(stream), None)
    return list(stream.topics)
