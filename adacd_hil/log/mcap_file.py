"""The MCAP file: header, attachments and metadata first, then chunks, then the summary.

Settings follow what viewers need: empty profile, message indexes, statistics and summary offsets on; and what a
damaged file needs: small chunks, CRCs of chunks and of the whole data section.

Messages come as finished records, many at a time. mcap's own writer takes them one by one, at 4 µs each, and has no
place where a finished chunk could be handed over; so the order of the records is ours, and their encoding mcap's. The
file is the one that mcap's writer would make, byte for byte.
"""

import struct
import zlib
from collections.abc import Iterable
from pathlib import PurePath

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.records import Channel as ChannelRecord
from mcap.writer import LIBRARY_IDENTIFIER
from numpy.typing import NDArray

from adacd_hil import __version__
from adacd_hil.log.channels import Channel
from adacd_hil.log.mcap_walk import MAGIC
from adacd_hil.log.sink import Sink

CHUNK_BYTES = 256 * 1024
_CHUNK_MARGIN = 16 * 1024
"""A chunk is closed after the message that overruns it; none of ours is longer than two texts of 4 KiB."""
COMPRESSION_LEVEL = 3
"""1 saves 1 µs per cycle of a run and makes its file 1 % larger; lz4 saves 2 µs and makes it 31 % larger."""
RUN_METADATA = "run"
SUMMARY_METADATA = "summary"
PART_KEY = "part"
"""Of the metadata `run`: number of the part, from 0."""
ENDING_KEY = "ending"
"""Of the summary: why the part ended."""
CONTINUED = "continued"
"""The ending of a part that another follows."""
FIELDS_KEY = "fields"
"""Channel metadata: our names of the fields, which ROS would have in lower case."""
_MEDIA_TYPES = {".toml": "application/toml", ".json": "application/json"}
_INDEX_HEAD = struct.Struct("<BQHI")
_INDEX_ENTRY = np.dtype([("log_time", "<u8"), ("offset", "<u8")])
_FOOTER_HEAD = struct.Struct("<BQQQ")


class McapFile:
    """One log file over a sink."""

    def __init__(
        self, sink: Sink, channels: tuple[Channel, ...], attachments: dict[str, bytes], metadata: dict[str, str]
    ) -> None:
        self.messages = 0
        self.record_bytes = 0
        """Bytes of the chunks so far, before compression."""
        self.ids: dict[int, int] = {}
        """The file's number of each channel, by ours."""
        self._sink = sink
        self._crc = 0
        self._compressor = zstandard.ZstdCompressor(COMPRESSION_LEVEL)
        self._schemas: dict[str, Schema] = {}
        self._channels: list[ChannelRecord] = []
        self._chunk_indexes = bytearray()  # encoded: as objects they would fill 80 MB in an hour
        self._chunk_count = 0
        self._start_ns, self._end_ns = 2**63, 0  # log times of the first and the last message
        self._attachment_indexes: list[AttachmentIndex] = []
        self._metadata_indexes: list[MetadataIndex] = []
        self._counts: dict[int, int] = {}  # messages of each channel
        self._put(MAGIC)
        self._put(_encode(Header(profile="", library=f"adacd-hil {__version__}; {LIBRARY_IDENTIFIER}")))
        for name, data in attachments.items():
            self._attach(name, data)
        self._add_metadata(RUN_METADATA, metadata)
        # The first chunk begins with the definitions.
        self._chunk = bytearray(self._define(channels))
        self._entries: list[tuple[NDArray[np.uint16], NDArray[np.void]]] = []  # of the chunk: channels, index entries
        self._packets = 0  # that are complete with the chunk
        self.head_bytes = sink.tell()
        """Bytes before the first chunk."""

    def _put(self, data: bytes, packets: int = 0) -> None:
        """Write a part of the data section, which completes so many packets."""
        self._crc = zlib.crc32(data, self._crc)
        self._sink.write(data, packets)

    def _attach(self, name: str, data: bytes) -> None:
        media_type = _MEDIA_TYPES.get(PurePath(name).suffix, "text/plain")
        offset = self._sink.tell()
        record = _encode(Attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=data))
        self._put(record)
        self._attachment_indexes.append(
            AttachmentIndex(
                offset=offset,
                length=len(record),
                log_time=0,
                create_time=0,
                data_size=len(data),
                name=name,
                media_type=media_type,
            )
        )

    def _add_metadata(self, name: str, metadata: dict[str, str]) -> None:
        offset = self._sink.tell()
        record = _encode(Metadata(name=name, metadata=metadata))
        self._put(record)
        self._metadata_indexes.append(MetadataIndex(offset=offset, length=len(record), name=name))

    def _define(self, channels: tuple[Channel, ...]) -> bytes:
        """Give schemas and channels numbers from 1, and encode them."""
        definitions = b""
        for channel in channels:
            name, text = channel.type.name, channel.type.text
            if name not in self._schemas:
                schema = Schema(id=len(self._schemas) + 1, name=name, encoding="ros2msg", data=text.encode())
                self._schemas[name] = schema
                definitions += _encode(schema)
            record = ChannelRecord(
                id=len(self._channels) + 1,
                topic=channel.topic,
                message_encoding="cdr",
                schema_id=self._schemas[name].id,
                metadata={FIELDS_KEY: " ".join(channel.type.fields)} if channel.type.fields else {},
            )
            self._channels.append(record)
            self.ids[channel.id] = record.id
            definitions += _encode(record)
        return definitions

    def add(
        self,
        records: NDArray[np.uint8],
        channels: NDArray[np.uint16],
        log_times_ns: NDArray[np.int64],
        ends: NDArray[np.int64],
        packet_ends: NDArray[np.int64],
    ) -> None:
        """Add message records that follow each other in `records`.

        channels: the file's numbers (n,); log_times_ns (n,); ends: where each record ends in `records` (n,);
        packet_ends: how many of the records come before the end of each packet, in order.
        """
        self.messages += len(ends)
        starts = np.concatenate(([0], ends))
        first = 0
        while first < len(ends):
            start = int(starts[first])
            room = CHUNK_BYTES - _CHUNK_MARGIN - len(self._chunk)
            last = int(np.searchsorted(ends, start + room, side="right"))  # the first to overrun
            stop = min(last + 1, len(ends))
            entries = np.empty(stop - first, _INDEX_ENTRY)
            entries["log_time"] = log_times_ns[first:stop]
            entries["offset"] = starts[first:stop] + (len(self._chunk) - start)
            self._entries.append((channels[first:stop], entries))
            self._chunk += records[start : starts[stop]].data
            done = np.searchsorted(packet_ends, (first, stop), side="right")
            self._packets += int(done[1] - (done[0] if first else 0))
            if last < len(ends):
                self._end_chunk()
            first = stop

    def flush(self) -> None:
        """End the chunk in progress, if it holds a message."""
        if self._entries:
            self._end_chunk()

    def _end_chunk(self) -> None:
        channels = np.concatenate([channels for channels, _ in self._entries])
        entries = np.concatenate([entries for _, entries in self._entries])
        compressed = self._compressor.compress(self._chunk)
        chunk = Chunk(
            compression="zstd",
            data=compressed,
            message_start_time=int(entries["log_time"].min()),
            message_end_time=int(entries["log_time"].max()),
            uncompressed_crc=zlib.crc32(self._chunk),
            uncompressed_size=len(self._chunk),
        )
        offset = self._sink.tell()
        record = _encode(chunk)
        index, offsets = self._index(channels, entries)
        # In one write, so that a full disk doesn't part them.
        self._put(record + index, self._packets)
        self._chunk_indexes += _encode(
            ChunkIndex(
                message_start_time=chunk.message_start_time,
                message_end_time=chunk.message_end_time,
                chunk_start_offset=offset,
                chunk_length=len(record),
                message_index_offsets={channel: offset + len(record) + place for channel, place in offsets.items()},
                message_index_length=len(index),
                compression=chunk.compression,
                compressed_size=len(compressed),
                uncompressed_size=chunk.uncompressed_size,
            )
        )
        self._chunk_count += 1
        self._start_ns = min(self._start_ns, chunk.message_start_time)
        self._end_ns = max(self._end_ns, chunk.message_end_time)
        self.record_bytes += len(self._chunk)
        self._chunk = bytearray()
        self._entries = []
        self._packets = 0

    def _index(self, channels: NDArray[np.uint16], entries: NDArray[np.void]) -> tuple[bytes, dict[int, int]]:
        """Encode the message index of each channel, in the order of their first messages; count the messages.

        Returns the records, and where among them that of each channel begins.
        """
        order = np.argsort(channels, kind="stable")
        groups = np.split(order, np.flatnonzero(np.diff(channels[order])) + 1)
        index = bytearray()
        offsets = {}
        for places in sorted(groups, key=lambda places: int(places[0])):
            channel = int(channels[places[0]])
            offsets[channel] = len(index)
            self._counts[channel] = self._counts.get(channel, 0) + len(places)
            size = len(places) * _INDEX_ENTRY.itemsize
            index += _INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 2 + 4 + size, channel, size)
            index += entries[places].data
        return bytes(index), offsets

    def finish(self, summary: dict[str, str]) -> None:
        """End the file."""
        self.flush()
        self._add_metadata(SUMMARY_METADATA, summary)
        self._put(_encode(DataEnd(self._crc)))
        start = self._sink.tell()
        data = b""
        offsets = b""
        for opcode, group in self._summary_groups():
            place = SummaryOffset(group_opcode=opcode, group_start=start + len(data), group_length=len(group))
            offsets += _encode(place)
            data += group
        offset_start = start + len(data)
        data += offsets
        footer_head = _FOOTER_HEAD.pack(Opcode.FOOTER, 8 + 8 + 4, start, offset_start)
        footer = Footer(
            summary_start=start,
            summary_offset_start=offset_start,
            summary_crc=zlib.crc32(footer_head, zlib.crc32(data)),
        )
        self._sink.write(data + _encode(footer) + MAGIC)

    def _summary_groups(self) -> tuple[tuple[Opcode, bytes], ...]:
        statistics = Statistics(
            attachment_count=len(self._attachment_indexes),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=self._chunk_count,
            message_count=self.messages,
            message_end_time=self._end_ns,
            message_start_time=self._start_ns if self._chunk_count else 0,
            metadata_count=len(self._metadata_indexes),
            schema_count=len(self._schemas),
        )
        return (
            (Opcode.SCHEMA, _encode_all(self._schemas.values())),
            (Opcode.CHANNEL, _encode_all(self._channels)),
            (Opcode.STATISTICS, _encode(statistics)),
            (Opcode.CHUNK_INDEX, bytes(self._chunk_indexes)),
            (Opcode.ATTACHMENT_INDEX, _encode_all(self._attachment_indexes)),
            (Opcode.METADATA_INDEX, _encode_all(self._metadata_indexes)),
        )


def _encode_all(records: Iterable[McapRecord]) -> bytes:
    return b"".join(map(_encode, records))


def _encode(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    encoded: bytes = builder.end()  # type: ignore[no-untyped-call]
    return encoded
