"""Recordings to tables: topics of our logs as they are, and frames of any recording decoded by a contract."""

import fnmatch
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode

from adacd_hil.input_files import open_input
from adacd_hil.log.channels import DECODED
from adacd_hil.log.chunk_data import ChunkError, Opening
from adacd_hil.log.editing.chunk_contents import read_contents
from adacd_hil.log.editing.record_scan import RawRecord, parse, scan
from adacd_hil.log.errors import LogError
from adacd_hil.log.formats.frame_log import open_frames
from adacd_hil.log.formats.tables import Tables, event_columns, frame_columns, series_columns
from adacd_hil.log.mcap_walk import MAGIC
from adacd_hil.log.stream import LogStream
from adacd_hil.nearest_name import nearest_name
from adacd_hil.wire.codec import Codec

_EVENTS = "/events"
_RAW = ("to_can_bus", "from_can_bus", "to_can_bus_fd", "from_can_bus_fd")
"""Ends of the topics of frames, which other formats are for."""


class TableSummary(NamedTuple):
    """What was written: rows of each file. `problem`: what is missing of the recording, one line."""

    rows: Mapping[Path, int]
    problem: str


def export_tables(
    path: Path,
    out: Path,
    kind: str,
    wanted: Collection[str],
    codec: Codec,
    progress: Callable[[int], None] = lambda _: None,
) -> TableSummary:
    """Write the tables of a recording into the folder `out`.

    wanted: topics or patterns such as `decoded/*`, with or without the first slash; empty: all. codec:
    decodes the frames of recordings that have no decoded topics. progress: is told the rows so far.
    Raises LogError when the recording can't be read, lacks a topic, or a table can't be written.
    """
    topics = _topics(path) if path.suffix.lower() == ".mcap" else []
    topics = [topic for topic in topics if topic.rsplit("/", 1)[-1] not in _RAW]
    if topics:
        return _export_topics(path, out, kind, choose_topics(topics, wanted), progress)
    return _export_frames(path, out, kind, wanted, codec, progress)


def choose_topics(topics: Collection[str], wanted: Collection[str]) -> list[str]:
    """Choose topics by names or patterns. Raises LogError for one that fits none, with the nearest."""
    if not wanted:
        return list(topics)
    chosen: list[str] = []
    for pattern in wanted:
        slashed = "/" + pattern.strip("/")
        found = [t for t in topics if any(fnmatch.fnmatchcase(t, form) for form in (slashed, DECODED + pattern))]
        if not found:
            near = nearest_name(slashed, topics)
            hint = f"did you mean {near}" if near else f"there are {', '.join(topics)}"
            raise LogError(f"the log has no topic {pattern}, {hint}")
        chosen += found
    return list(dict.fromkeys(chosen))


def _export_topics(
    path: Path, out: Path, kind: str, topics: list[str], progress: Callable[[int], None]
) -> TableSummary:
    stream = LogStream(path, topics)
    with Tables(out, kind, stream.metadata) as tables:
        for piece in stream:
            for topic, series in piece.series.items():
                if topic in topics:
                    tables.write(topic, series_columns(series, stream.epoch_ns))
            if events := stream.events(piece):
                tables.write(_EVENTS, event_columns(events))
            progress(sum(tables.rows.values()))
    return TableSummary(tables.rows, stream.problem)


def _export_frames(
    path: Path, out: Path, kind: str, wanted: Collection[str], codec: Codec, progress: Callable[[int], None]
) -> TableSummary:
    chosen = choose_topics([DECODED + name for name in codec.messages], wanted)
    source = open_frames(path)
    pieces = iter(source)
    with Tables(out, kind, {"contract": codec.path.name}) as tables:
        for frames in pieces:
            for name, columns in frame_columns(frames, codec):
                if DECODED + name in chosen:
                    tables.write(DECODED + name, columns)
            progress(sum(tables.rows.values()))
    return TableSummary(tables.rows, source.problem)


def _topics(path: Path) -> list[str]:
    """List the topics that the first chunk of an MCAP file defines."""
    topics: list[str] = []
    try:
        with open_input(path) as file:
            if file.read(len(MAGIC)) != MAGIC:
                return []
            for record in scan(file):
                if not isinstance(record, RawRecord):
                    break
                if record.opcode == Opcode.CHANNEL:
                    topics.append(parse(record.opcode, record.body).topic)
                elif record.opcode == Opcode.CHUNK:
                    contents = read_contents(Opening().open_checked(parse(record.opcode, record.body)))
                    channels = (found for found in contents.definitions if found.opcode == Opcode.CHANNEL)
                    topics += [parse(channel.opcode, channel.body).topic for channel in channels]
                    break
    except (OSError, LogError, ChunkError):
        pass  # who reads the log says what is wrong with it
    return list(dict.fromkeys(topics))
