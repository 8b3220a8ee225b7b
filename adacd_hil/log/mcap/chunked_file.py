"""An MCAP file in small chunks, by mcap's writer; a chunk, with its index, is handed on in one call.

A damaged file needs small chunks, and CRCs of chunks and of the whole data section. A chunk ends behind a packet, so
who counts packets knows which of them are on the disk.

mcap's writer keeps 1.5 KB a chunk in memory until the file ends: 3 MB for a part of 512 MiB, some 60 MB for an hour of
a run at 1 kHz whose parts have no limit.
"""

from collections.abc import Callable

from mcap.records import Attachment
from mcap.writer import LIBRARY_IDENTIFIER, Writer

from adacd_hil import __version__
from adacd_hil.log.log_files import PRODUCT
from adacd_hil.log.mcap.record_layout import MESSAGE_HEAD

LIBRARY = f"{PRODUCT} {__version__}; {LIBRARY_IDENTIFIER}"
CHUNK_BYTES = 240 * 1024
"""A chunk ends behind the packet that fills it."""
FLUSH_PERIOD_NS = 250_000_000
"""A chunk spans at most so much time, so that little is lost with a killed process."""
_UNLIMITED = 1 << 62
"""Chunk size for mcap's writer, whose own limit would end a chunk within a packet."""


class ChunkedFile:
    """One MCAP file that is written chunk by chunk. messages: their number so far.

    Nothing of a message is written before its chunk: call `complete` at the end.
    """

    def __init__(self, write: Callable[[bytes, int], object], profile: str = "", library: str = LIBRARY) -> None:
        """Begin a file. write: takes its next bytes, and the number of log packets that are complete with them."""
        self.messages = 0
        self.record_bytes = 0
        """Bytes of the messages so far, before compression."""
        self._write = write
        self._stream = _Stream()
        self._chunk_full = CHUNK_BYTES  # value of `record_bytes` at which the chunk in progress is full
        self._packets = 0  # that are complete with the chunk
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._writer = Writer(self._stream, chunk_size=_UNLIMITED, enable_data_crcs=True)  # type: ignore[arg-type]
        self._writer.start(profile, library)

    def add_attachment(self, attachment: Attachment) -> None:
        """Write an attachment."""
        self._writer.add_attachment(
            attachment.create_time, attachment.log_time, attachment.name, attachment.media_type, attachment.data
        )
        self._pass_on()

    def add_metadata(self, name: str, metadata: dict[str, str]) -> None:
        """Write a metadata record."""
        self._writer.add_metadata(name, metadata)
        self._pass_on()

    def define_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Define a schema in the chunk in progress.

        Return its number in the file, that of an equal one if there is one.
        """
        key = name, encoding, data
        if key not in self._schemas:
            self._schemas[key] = self._writer.register_schema(*key)
        return self._schemas[key]

    def define_channel(self, topic: str, message_encoding: str, schema: int, metadata: dict[str, str]) -> int:
        """Define a channel, in the chunk in progress; return its number in the file. schema: 0 for none."""
        return self._writer.register_channel(topic, message_encoding, schema, metadata)

    def add_message(self, channel: int, log_ns: int, payload: bytes, publish_ns: int, sequence: int = 0) -> None:
        """Add a message to the chunk in progress.

        channel: its number from `define_channel`. log_ns, publish_ns: its times in the file. sequence: the publisher's
        count; 0 for none.
        """
        self._writer.add_message(channel, log_ns, payload, publish_ns, sequence)
        self.messages += 1
        self.record_bytes += MESSAGE_HEAD + len(payload)

    def end_packet(self) -> None:
        """Count a packet as complete; write the chunk in progress if its messages have CHUNK_BYTES."""
        self._packets += 1
        if self.record_bytes >= self._chunk_full:
            self.flush()

    def flush(self) -> None:
        """Write the chunk in progress, if it holds a message, with the number of packets that it completes."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        if self._pass_on(self._packets):
            self._packets = 0
        self._chunk_full = self.record_bytes + CHUNK_BYTES

    def complete(self) -> None:
        """Write the chunk in progress, the summary and the footer, with which the file ends."""
        self.flush()
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._pass_on()

    def _pass_on(self, packets: int = 0) -> bool:
        """Hand on all bytes that mcap's writer has made since the last call; return False if there are none.

        packets: number of log packets that are complete with them.
        """
        data = self._stream.take()
        if data:
            self._write(data, packets)
        return bool(data)


class _Stream:
    """The stream of mcap's writer, which writes a chunk and its index one after the other."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._position = 0

    def write(self, data: bytes) -> int:
        self._parts.append(bytes(data))
        self._position += len(data)
        return len(data)

    def tell(self) -> int:
        return self._position

    def flush(self) -> None:
        """Do nothing: the parts stay for `take`."""

    def take(self) -> bytes:
        data = b"".join(self._parts)
        self._parts.clear()
        return data
