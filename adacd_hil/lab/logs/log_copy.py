"""A log made of the records of another: recovered or cut. It appears when it is whole.

Records stay as they are, but for the numbers of their channels.
"""

import contextlib
import struct
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

import numpy as np
from mcap.records import Attachment, Channel, Header
from numpy.typing import NDArray

from adacd_hil.file_access import open_input
from adacd_hil.file_replacement import Replacement
from adacd_hil.lab.logs.log_info import read_info
from adacd_hil.lab.logs.record_scan import read_header
from adacd_hil.lab.logs.salvaged_log import SalvagedLog
from adacd_hil.log.log_files import (
    ENDING_KEY,
    PART_KEY,
    PRODUCT,
    ROS_PROFILE,
    SUMMARY_METADATA,
    LogError,
    failing_as,
    is_part_name,
)
from adacd_hil.log.log_parts import COPY_ENDINGS, DROPPED_KEY
from adacd_hil.log.mcap.chunked_file import ChunkedFile
from adacd_hil.log.mcap.chunks import Contents
from adacd_hil.log.mcap.mcap_records import CHANNEL_NUMBERS, read_end
from adacd_hil.log.types.record_arrays import FRAME_TOPICS

_MESSAGE_HEAD = struct.Struct("<BQHIQQ")
"""A message record before its payload: opcode, length, channel, sequence, log time, publish time."""


class LogCopy:
    """A log in the making: a hidden file until `finish`. It may replace another copy, but no recording.

    Without `finish`, the end of its `with` block removes the hidden file.
    """

    def __init__(self, path: Path, log: SalvagedLog, topics: Collection[str] | None = None) -> None:
        """Begin a log at `path` that is copied from `log`; topics: those that are copied, None: all.

        An empty file, a link, and a result of `recover` or `cut` at `path` may be replaced. Raises LogError if any
        other file is there, `path` is the log itself or has the name of another log's part, or it can't be created.
        """
        if path.exists() and any(part.exists() and path.samefile(part) for part in log.parts.values()):
            raise LogError(f"{path} is the log itself; --out names another file")
        if is_part_name(path):
            raise LogError(f"log {path} would be taken for a part of the log beside it; give another name")
        is_copy = _is_copy(path)
        if path.is_file() and not path.is_symlink() and path.stat().st_size and not is_copy:
            raise LogError(f"log {path} can't be created: what is there is no result of these commands")
        self._path = path
        self._log = log
        self._wanted = topics
        with failing_as(f"log {path} can't be created"):
            self._replacement = Replacement(path, is_log=is_copy)
            self._hidden = self._replacement.beside.open("wb")
        self._file = ChunkedFile(self._write, _common_profile(log.parts.values()))
        self._metadata: set[str] = set()
        self._topics: dict[int, str] = {}  # by the copy's number of the channel
        self._counts: Counter[int] = Counter()  # messages of each of its channels
        self._numbers = np.full(CHANNEL_NUMBERS, -1, np.int32)  # of each channel of the source

    @property
    def messages(self) -> int:
        """Number of messages copied so far."""
        return self._file.messages

    def add_attachment(self, attachment: Attachment) -> None:
        """Copy an attachment."""
        self._file.add_attachment(attachment)

    def add_messages(self, contents: Contents, is_chosen: NDArray[np.bool_] | None = None) -> None:
        """Copy messages of a chunk, those where `is_chosen` (n,) is True; None: all.

        Metadata and channels that the source has read since the last call are copied first. Messages of topics that
        aren't copied, or without a definition, are left out. Raises LogError if the copy can't be written.
        """
        self._follow()
        numbers = self._numbers[contents.channels]
        is_taken = numbers >= 0 if is_chosen is None else (numbers >= 0) & is_chosen
        if not is_taken.any():
            return
        self._counts.update(numbers[is_taken].tolist())
        for place in np.flatnonzero(is_taken).tolist():
            start, end = int(contents.starts[place]), int(contents.ends[place])
            *_, sequence, log_ns, publish_ns = _MESSAGE_HEAD.unpack_from(contents.data, start)
            payload = contents.data[start + _MESSAGE_HEAD.size : end]
            self._file.add_message(int(numbers[place]), log_ns, payload, publish_ns, sequence)
            self._file.end_packet()

    def _follow(self) -> None:
        """Copy the metadata, and define the channels of copied topics, that the source has read since the last call.

        The number of the part is left out of the metadata.
        """
        for name in [name for name in self._log.metadata if name not in self._metadata]:
            self._metadata.add(name)
            table = self._log.metadata[name]
            self._file.add_metadata(name, {key: text for key, text in table.items() if key != PART_KEY})
        for number, channel in self._log.definitions.channels.items():
            if self._numbers[number] < 0 and (self._wanted is None or channel.topic in self._wanted):
                self._define(channel)

    def _define(self, channel: Channel) -> None:
        """Define a channel of the source in the copy, unless its schema is lost.

        Raises LogError if there are too many channels.
        """
        schema_id = 0
        if channel.schema_id:
            schema = self._log.definitions.schemas.get(channel.schema_id)
            if schema is None:
                return
            schema_id = self._file.define_schema(schema.name, schema.encoding, schema.data)
        if len(self._topics) + 1 >= CHANNEL_NUMBERS:
            raise LogError(f"more than {CHANNEL_NUMBERS - 1} channels don't go into one file")
        number = self._file.define_channel(channel.topic, channel.message_encoding, schema_id, channel.metadata)
        self._numbers[channel.id] = number
        self._topics[number] = channel.topic

    def finish(self, ending: str, more: Mapping[str, str]) -> None:
        """End the log with a summary, and give the file its name.

        ending: why it ends. more: further entries of the summary. Raises LogError if it can't be written.
        """
        self._follow()
        self._file.flush()
        summary = {
            "frames": str(sum(count for number, count in self._counts.items() if self._topics[number] in FRAME_TOPICS)),
            "messages": str(self._file.messages),
            DROPPED_KEY: str(self._log.dropped),
            ENDING_KEY: ending,
            "source": self._log.path.name,
            **more,
        }
        self._file.add_metadata(SUMMARY_METADATA, summary)
        self._file.complete()
        with failing_as(f"log {self._path} can't be written"):
            self._hidden.close()
            self._replacement.commit(is_durable=True)

    def _write(self, data: bytes, _packets: int) -> None:
        with failing_as(f"log {self._path} can't be written"):
            self._hidden.write(data)

    def __enter__(self) -> "LogCopy":
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):
            self._hidden.close()
        self._replacement.discard()  # no effect once it has been committed


def _common_profile(sources: Iterable[Path]) -> str:
    """Return ROS_PROFILE if all files have it, else "". Logs of ours without a profile count as having it."""
    headers = [read_header(path) for path in sources]
    return ROS_PROFILE if headers and all(header is not None and _is_ros(header) for header in headers) else ""


def _is_ros(header: Header) -> bool:
    return header.profile == ROS_PROFILE or (header.profile == "" and header.library.startswith(f"{PRODUCT} "))


def _is_copy(path: Path) -> bool:
    """Return whether a file is a whole log that `recover` or `cut` made, so that it may be overwritten."""
    try:
        with open_input(path) as file:
            return read_end(file) is not None and read_info(path).ending in COPY_ENDINGS
    except (OSError, LogError):
        return False
