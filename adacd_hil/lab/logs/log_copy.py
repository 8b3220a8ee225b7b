"""A log made of the records of others: recovered, cut or merged. It appears when it is whole.

Records stay as they are, but for the numbers of their channels: each source has channels of its own, and schemas are
shared where they are equal.
"""

import contextlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.records import Attachment, Channel, Header, Schema
from numpy.typing import NDArray

from adacd_hil.file_access import Replacement, open_input
from adacd_hil.log.log_files import (
    COPY_ENDINGS,
    PRODUCT,
    ROS_PROFILE,
    SUMMARY_METADATA,
    LogError,
    failing_as,
    is_part_name,
)
from adacd_hil.log.log_info import read_info
from adacd_hil.log.mcap.chunked_file import LIBRARY, ChunkedFile
from adacd_hil.log.mcap.chunks import Contents
from adacd_hil.log.mcap.mcap_records import CHANNEL_NUMBERS, read_end, read_header

_CHANNEL = 9
"""Where the number of the channel is in a message record, bytes."""


class Messages(NamedTuple):
    """Message records one after the other, with the copy's numbers of channels. Columns (n,)."""

    records: NDArray[np.uint8]
    channels: NDArray[np.uint16]
    log_times: NDArray[np.int64]
    ends: NDArray[np.int64]

    def select(self, chosen: NDArray[np.int64]) -> "Messages":
        """Take the messages of these numbers, in this order."""
        starts = np.concatenate(([0], self.ends[:-1]))
        records, ends = _gather(self.records, starts[chosen], self.ends[chosen])
        return Messages(records, self.channels[chosen], self.log_times[chosen], ends)


class LogCopy:
    """The log in the making: a hidden file beside until `finish`, which replaces another copy, but no recording."""

    def __init__(self, path: Path, sources: Iterable[Path]) -> None:
        """Begin a log at `path` that is copied from others. Raises LogError."""
        self.path = path
        self._target = _CopyTarget(path)
        self.file = ChunkedFile(self._target, LIBRARY, _common_profile(sources))
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels = 0
        self._metadata: set[str] = set()

    def source(self, prefix: str = "", topics: frozenset[str] | None = None) -> "CopySource":
        """Begin to copy from another log: put `prefix` before its topics, copy only `topics` if given."""
        return CopySource(self, prefix, topics)

    def attach(self, attachment: Attachment) -> None:
        """Add an attachment."""
        self.file.attach(attachment)

    def add_all_metadata(self, records: Mapping[str, dict[str, str]]) -> None:
        """Add the metadata records whose names are new."""
        for name in [name for name in records if name not in self._metadata]:
            self._metadata.add(name)
            self.file.add_metadata(name, records[name])

    def add(self, messages: Messages) -> None:
        """Add messages."""
        if len(messages.ends):
            none_end = np.empty(0, np.int64)
            self.file.add(messages.records, messages.channels, messages.log_times, messages.ends, none_end)

    def define(self, channel: Channel, schema: Schema | None) -> int:
        """Define a channel of a source; return its number here."""
        schema_id = 0
        if schema is not None:
            key = schema.name, schema.encoding, schema.data
            if key not in self._schemas:
                self._schemas[key] = len(self._schemas) + 1
                self.file.define_schema(
                    Schema(id=self._schemas[key], data=schema.data, encoding=schema.encoding, name=schema.name)
                )
            schema_id = self._schemas[key]
        self._channels += 1
        if self._channels >= CHANNEL_NUMBERS:
            raise LogError(f"more than {CHANNEL_NUMBERS - 1} channels don't go into one file")
        self.file.define_channel(
            Channel(
                id=self._channels,
                topic=channel.topic,
                message_encoding=channel.message_encoding,
                metadata=channel.metadata,
                schema_id=schema_id,
            )
        )
        return self._channels

    def finish(self, summary: dict[str, str]) -> None:
        """End the log, say what is to be said of it, and give it its name. Raises LogError."""
        self.file.flush_definitions()
        self.file.add_metadata(SUMMARY_METADATA, summary)
        self.file.complete()
        self._target.commit()

    def __enter__(self) -> "LogCopy":
        return self

    def __exit__(self, *_: object) -> None:
        self._target.discard()


def _common_profile(sources: Iterable[Path]) -> str:
    """Return the profile that all logs fit; earlier ones of ours fit the one of ROS 2, but don't say so."""
    headers = [read_header(path) for path in sources]
    return ROS_PROFILE if headers and all(header is not None and _is_ros(header) for header in headers) else ""


def _is_ros(header: Header) -> bool:
    return header.profile == ROS_PROFILE or (header.profile == "" and header.library.startswith(f"{PRODUCT} "))


class CopySource:
    """One log that a copy takes records from."""

    def __init__(self, copy: LogCopy, prefix: str, topics: frozenset[str] | None) -> None:
        self._copy = copy
        self._prefix = prefix
        self._topics = topics
        self.topics: dict[int, str] = {}
        """Topics by the copy's number of their channel."""
        self._numbers: dict[int, tuple[Channel, int]] = {}
        self._map = np.full(CHANNEL_NUMBERS, -1, np.int32)

    def define(self, channels: Mapping[int, Channel], schemas: Mapping[int, Schema]) -> None:
        """Take in what the source has defined so far."""
        for number, channel in channels.items():
            if number in self._numbers or (channel.schema_id and channel.schema_id not in schemas):
                continue
            if self._topics is not None and channel.topic not in self._topics:
                continue
            named = Channel(
                number, self._prefix + channel.topic, channel.message_encoding, channel.metadata, channel.schema_id
            )
            self._map[number] = self._copy.define(named, schemas.get(channel.schema_id))
            self._numbers[number] = channel, int(self._map[number])
            self.topics[int(self._map[number])] = named.topic

    def take(self, contents: Contents, is_chosen: NDArray[np.bool_] | None = None) -> Messages:
        """Take messages of a chunk, those of channels that aren't copied left out."""
        numbers = self._map[contents.channels]
        is_taken = numbers >= 0 if is_chosen is None else (numbers >= 0) & is_chosen
        channels = numbers[is_taken].astype(np.uint16)
        data = np.frombuffer(contents.data, np.uint8)
        records, ends = _gather(data, contents.starts[is_taken], contents.ends[is_taken])
        starts = np.concatenate(([0], ends[:-1])) if len(ends) else ends
        records[starts + _CHANNEL] = channels & 0xFF
        records[starts + _CHANNEL + 1] = channels >> 8
        return Messages(records, channels, contents.log_times[is_taken].astype(np.int64), ends)


def _gather(
    data: NDArray[np.uint8], starts: NDArray[np.int64], ends: NDArray[np.int64]
) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Copy stretches of `data` one after the other; return them and where each ends."""
    lengths = ends - starts
    new_ends = np.cumsum(lengths)
    if len(starts) and (starts[1:] == ends[:-1]).all():
        return data[starts[0] : ends[-1]].copy(), new_ends
    shifts = starts - (new_ends - lengths)
    return data[np.arange(lengths.sum()) + np.repeat(shifts, lengths)], new_ends


class _CopyTarget:
    """A file beside the one that it becomes."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._position = 0
        if is_part_name(path):
            raise LogError(f"log {path} would be taken for a part of the log beside it; give another name")
        if path.is_file() and not path.is_symlink() and path.stat().st_size and not _is_copy(path):
            raise LogError(f"log {path} can't be created: what is there is no result of these commands")
        with failing_as(f"log {path} can't be created"):
            self._replacement = Replacement(path, is_log=_is_copy(path))
            self._file = self._replacement.beside.open("wb")

    def write(self, data: bytes, packets: int = 0) -> int:
        del packets
        try:
            self._file.write(data)
        except OSError as error:
            raise self._error(error) from None
        self._position += len(data)
        return len(data)

    def tell(self) -> int:
        return self._position

    def commit(self) -> None:
        try:
            self._file.close()
            self._replacement.commit(is_durable=True)
        except OSError as error:
            raise self._error(error) from None

    def discard(self) -> None:
        """Remove what was not committed."""
        with contextlib.suppress(OSError):
            self._file.close()
        self._replacement.discard()

    def _error(self, error: OSError) -> LogError:
        return LogError(f"log {self._path} can't be written: {error.strerror}")


def _is_copy(path: Path) -> bool:
    """Tell whether a file is a log that was made of others, so that it can be made again."""
    try:
        with open_input(path) as file:
            return read_end(file) is not None and read_info(path).ending in COPY_ENDINGS
    except (OSError, LogError):
        return False
