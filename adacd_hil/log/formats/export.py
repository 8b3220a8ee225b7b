"""Recordings to tables: topics of our logs as they are, and frames of any recording decoded by a contract."""

import contextlib
import fnmatch
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode

from adacd_hil.input_files import open_input
from adacd_hil.log.channels import DECODED
from adacd_hil.log.errors import LogError
from adacd_hil.log.formats.frame_log import open_frames
from adacd_hil.log.formats.signal_tables import Tables, event_columns, frame_columns, series_columns
from adacd_hil.log.mcap.chunk_contents import read_contents
from adacd_hil.log.mcap.mcap_records import MAGIC, RawRecord, parse, scan
from adacd_hil.log.mcap.opening import ChunkError, Opening
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
    is_mcap = path.suffix.lower() == ".mcap"
    defined = _topics(path) if is_mcap else []
    raw = [topic for topic in defined if topic.rsplit("/", 1)[-1] in _RAW]
    topics = [topic for topic in defined if topic not in raw]
    if topics:
        return _export_topics(path, out, kind, choose_topics(topics, wanted, raw), progress)
    if is_mcap and wanted and not raw:
        raise LogError(f"{path} has no topic that can be read")
    return _export_frames(path, out, kind, wanted, codec, progress)


def choose_topics(
    topics: Collection[str], wanted: Collection[str], raw: Collection[str] = (), owner: str = "the log"
) -> list[str]:
    """Choose topics by names or patterns. Raises LogError for one that fits none, with the nearest.

    raw: topics of frames, of which no table is made. owner: who has the topics, for the error.
    """
    if not wanted:
        return list(topics)
    chosen: list[str] = []
    for pattern in wanted:
        found = _matching(topics, pattern)
        if not found:
            if frames := _matching(raw, pattern):
                raise LogError(f"topic {frames[0]} holds frames, which become no table: --format candump, blf or asc")
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
    source = open_frames(path)
    owner = f"{path} has frames only, and their contract {codec.path.name}"
    chosen = choose_topics([DECODED + name for name in codec.messages], wanted, owner=owner)
    pieces = iter(source)
    with Tables(out, kind, {"contract": codec.path.name}) as tables:
        for frames in pieces:
            for name, columns in frame_columns(frames, codec):
                if DECODED + name in chosen:
                    tables.write(DECODED + name, columns)
            progress(sum(tables.rows.values()))
    return TableSummary(tables.rows, source.problem)


def _topics(path: Path) -> list[str]:
    """List the topics that the first chunk of an MCAP file defines. Raises LogError when it is none."""
    topics: list[str] = []
    try:
        file = open_input(path)
    except OSError as error:
        raise LogError(f"log {path} can't be read: {error.strerror}") from None
    with file:
        if file.read(len(MAGIC)) != MAGIC:
            raise LogError(f"{path} is not an MCAP file")
        with contextlib.suppress(OSError, LogError, ChunkError):  # who reads the log says what is wrong with it
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
    return list(dict.fromkeys(topics))
