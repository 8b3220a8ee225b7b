"""An MCAP file made of finished records: definitions and messages in chunks, then the summary.

Viewers need message indexes, statistics and summary offsets; a damaged file needs small chunks, and CRCs of chunks and
of the whole data section.

Messages come as finished records, many at a time. mcap's own writer takes them one by one, at 4 µs each, and has no
place where a finished chunk could be handed over; so the order of the records is ours, and their encoding mcap's. The
file is the one that mcap's writer would make, byte for byte.
"""

import struct
from collections.abc import Iterable
from typing import Protocol

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
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
from mcap.writer import LIBRARY_IDENTIFIER
from numpy.typing import NDArray

from adacd_hil import __version__
from adacd_hil.log.log_files import PRODUCT
from adacd_hil.log.mcap.record_layout import INDEX_ENTRY, MAGIC, crc32

LIBRARY = f"{PRODUCT} {__version__}; {LIBRARY_IDENTIFIER}"
CHUNK_BYTES = 256 * 1024
FLUSH_PERIOD_NS = 250_000_000
"""A chunk spans at most so much time, so that little is lost with a killed process."""
_CHUNK_MARGIN = 16 * 1024
"""A chunk is closed after the message that overruns it; our longest message has two texts of 4 KiB."""
COMPRESSION_LEVEL = 3
"""1 saves 1 µs per cycle of a run and makes its file 1 % larger; lz4 saves 2 µs and makes it 31 % larger."""
INDEX_HEAD = struct.Struct("<BQHI")
FOOTER_HEAD = struct.Struct("<BQQQ")


class Target(Protocol):
    """The target that a file is written to."""

    def write(self, data: bytes, packets: int = 0) -> int:
        """Write a part of the file; return its length. packets: number of log packets that are whole with it."""

    def tell(self) -> int:
        """Return how many bytes of the file have been written."""


class ChunkedFile:
    """One MCAP file over a target."""

    def __init__(self, target: Target, library: str, profile: str = "") -> None:
        self.messages = 0
        self.record_bytes = 0
        """Bytes of the chunks so far, before compression."""
        self.counts: dict[int, int] = {}
        """Messages of each channel so far, chunk by chunk."""
        self._target = target
        self._crc = 0
        self._compressor = zstandard.ZstdCompressor(COMPRESSION_LEVEL)
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunk_indexes = bytearray()  # encoded: as objects they would fill 80 MB in an hour
        self._chunk_count = 0
        self._start_ns, self._end_ns = 2**63, 0  # log times of the first and the last message
        self._attachment_indexes: list[AttachmentIndex] = []
        self._metadata_indexes: list[MetadataIndex] = []
        self._chunk = bytearray()
        self._entries: list[tuple[NDArray[np.uint16], NDArray[np.void]]] = []  # of the chunk: channels, index entries
        self._packets = 0  # that are complete with the chunk
        self._put(MAGIC)
        self._put(encode(Header(profile=profile, library=library)))

    def _put(self, data: bytes, packets: int = 0) -> None:
        """Write a part of the data section. packets: number of log packets that are whole with it."""
        self._crc = crc32(data, self._crc)
        self._target.write(data, packets)

    def add_attachment(self, attachment: Attachment) -> None:
        """Write an attachment."""
        offset = self._target.tell()
        record = encode(attachment)
        self._put(record)
        self._attachment_indexes.append(
            AttachmentIndex(
                offset=offset,
                length=len(record),
                log_time=attachment.log_time,
                create_time=attachment.create_time,
                data_size=len(attachment.data),
                name=attachment.name,
                media_type=attachment.media_type,
            )
        )

    def add_metadata(self, name: str, metadata: dict[str, str]) -> None:
        """Write a metadata record."""
        offset = self._target.tell()
        record = encode(Metadata(name=name, metadata=metadata))
        self._put(record)
        self._metadata_indexes.append(MetadataIndex(offset=offset, length=len(record), name=name))

    def define_schema(self, schema: Schema) -> None:
        """Define a schema, in the chunk in progress."""
        self._schemas.append(schema)
        self._chunk += encode(schema)

    def define_channel(self, channel: Channel) -> None:
        """Define a channel, in the chunk in progress. Its schema must be defined before it."""
        self._channels.append(channel)
        self._chunk += encode(channel)

    def add_messages(
        self,
        records: NDArray[np.uint8],
        channels: NDArray[np.uint16],
        log_times_ns: NDArray[np.int64],
        ends: NDArray[np.int64],
        packet_ends: NDArray[np.int64],
    ) -> None:
        """Add message records that follow each other in `records`, and write the chunks that are full.

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
            entries = np.empty(stop - first, INDEX_ENTRY)
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
        """Write the chunk in progress, if it holds a message."""
        if self._entries:
            self._end_chunk()

    def flush_definitions(self) -> None:
        """Write the chunk in progress, then the definitions that no message follows, as records of their own."""
        self.flush()
        self._put(bytes(self._chunk))
        self._chunk = bytearray()

    def _end_chunk(self) -> None:
        channels = np.concatenate([channels for channels, _ in self._entries])
        entries = np.concatenate([entries for _, entries in self._entries])
        compressed = self._compressor.compress(self._chunk)
        chunk = Chunk(
            compression="zstd",
            data=compressed,
            message_start_time=int(entries["log_time"].min()),
            message_end_time=int(entries["log_time"].max()),
            uncompressed_crc=crc32(self._chunk),
            uncompressed_size=len(self._chunk),
        )
        offset = self._target.tell()
        record = encode(chunk)
        index, offsets = self._index(channels, entries)
        # In one write, so that a full disk doesn't part them.
        self._put(record + index, self._packets)
        self._chunk_indexes += encode(
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
        """Return the message indexes of a chunk, one per channel in the order of first messages; count the messages.

        Returns the encoded records, and where among them that of each channel begins.
        """
        order = np.argsort(channels, kind="stable")
        groups = np.split(order, np.flatnonzero(np.diff(channels[order])) + 1)
        index = bytearray()
        offsets = {}
        for places in sorted(groups, key=lambda places: int(places[0])):
            channel = int(channels[places[0]])
            offsets[channel] = len(index)
            self.counts[channel] = self.counts.get(channel, 0) + len(places)
            size = len(places) * INDEX_ENTRY.itemsize
            index += INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 2 + 4 + size, channel, size)
            index += entries[places].data
        return bytes(index), offsets

    def complete(self) -> None:
        """Write the chunk in progress, the summary and the footer, with which the file ends."""
        self.flush()
        self._put(encode(DataEnd(self._crc)))
        start = self._target.tell()
        data = b""
        offsets = b""
        for opcode, group in self._summary_groups():
            place = SummaryOffset(group_opcode=opcode, group_start=start + len(data), group_length=len(group))
            offsets += encode(place)
            data += group
        offset_start = start + len(data)
        data += offsets
        footer_head = FOOTER_HEAD.pack(Opcode.FOOTER, 8 + 8 + 4, start, offset_start)
        footer = Footer(
            summary_start=start,
            summary_offset_start=offset_start,
            summary_crc=crc32(footer_head, crc32(data)),
        )
        self._target.write(data + encode(footer) + MAGIC)

    def _summary_groups(self) -> tuple[tuple[Opcode, bytes], ...]:
        statistics = Statistics(
            attachment_count=len(self._attachment_indexes),
            channel_count=len(self._channels),
            channel_message_counts=self.counts,
            chunk_count=self._chunk_count,
            message_count=self.messages,
            message_end_time=self._end_ns,
            message_start_time=self._start_ns if self._chunk_count else 0,
            metadata_count=len(self._metadata_indexes),
            schema_count=len(self._schemas),
        )
        return (
            (Opcode.SCHEMA, _encode_all(self._schemas)),
            (Opcode.CHANNEL, _encode_all(self._channels)),
            (Opcode.STATISTICS, encode(statistics)),
            (Opcode.CHUNK_INDEX, bytes(self._chunk_indexes)),
            (Opcode.ATTACHMENT_INDEX, _encode_all(self._attachment_indexes)),
            (Opcode.METADATA_INDEX, _encode_all(self._metadata_indexes)),
        )


def _encode_all(records: Iterable[McapRecord]) -> bytes:
    return b"".join(map(encode, records))


def encode(record: McapRecord) -> bytes:
    """Return an MCAP record as bytes, with its opcode and length."""
    builder = RecordBuilder()
    record.write(builder)
    encoded: bytes = builder.end()  # type: ignore[no-untyped-call]
    return encoded
