"""The MCAP file: header, attachments and metadata first, then chunks, then the summary.

Settings follow what viewers need: empty profile, message indexes, statistics and summary offsets on; and what a
damaged file needs: small chunks, CRCs of chunks and of the whole data section.
"""

from pathlib import PurePath
from typing import IO, Any, cast

from mcap.writer import LIBRARY_IDENTIFIER, CompressionType, Writer

from adacd_hil import __version__
from adacd_hil.log.channels import Channel
from adacd_hil.log.sink import Sink

CHUNK_BYTES = 256 * 1024
_CHUNK_MARGIN = 16 * 1024
"""mcap closes a chunk after the message that overruns it; none of ours is longer than two texts of 4 KiB."""
RUN_METADATA = "run"
SUMMARY_METADATA = "summary"
FIELDS_KEY = "fields"
"""Channel metadata: our names of the fields, which ROS would have in lower case."""
_MEDIA_TYPES = {".toml": "application/toml", ".json": "application/json"}


class McapFile:
    """One log file over a sink."""

    def __init__(
        self, sink: Sink, channels: tuple[Channel, ...], attachments: dict[str, bytes], metadata: dict[str, str]
    ) -> None:
        self.messages = 0
        self._writer = Writer(
            cast(IO[Any], sink),
            chunk_size=CHUNK_BYTES - _CHUNK_MARGIN,
            compression=CompressionType.ZSTD,
            enable_crcs=True,
            enable_data_crcs=True,
        )
        self._writer.start(profile="", library=f"adacd-hil {__version__}; {LIBRARY_IDENTIFIER}")
        for name, data in attachments.items():
            media_type = _MEDIA_TYPES.get(PurePath(name).suffix, "text/plain")
            self._writer.add_attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=data)
        self._writer.add_metadata(RUN_METADATA, metadata)
        self._ids = self._register(channels)
        self._latest_ns = dict.fromkeys(self._ids, 0)

    def _register(self, channels: tuple[Channel, ...]) -> dict[int, int]:
        """Register schemas and channels; return the file's number of each channel."""
        schema_ids: dict[str, int] = {}
        ids = {}
        for channel in channels:
            name, text = channel.type.name, channel.type.text
            if name not in schema_ids:
                schema_ids[name] = self._writer.register_schema(name, "ros2msg", text.encode())
            metadata = {FIELDS_KEY: " ".join(channel.type.fields)} if channel.type.fields else {}
            ids[channel.id] = self._writer.register_channel(channel.topic, "cdr", schema_ids[name], metadata)
        return ids

    def add(self, channel_id: int, log_time_ns: int, publish_time_ns: int, payload: bytes) -> None:
        """Add a message; its log time is moved up where it would run backwards in its topic."""
        log_time_ns = max(log_time_ns, self._latest_ns[channel_id])
        self._latest_ns[channel_id] = log_time_ns
        self._writer.add_message(self._ids[channel_id], log_time_ns, payload, publish_time_ns)
        self.messages += 1

    def flush(self) -> None:
        """End the chunk in progress, if it holds a message."""
        self._writer.flush()  # type: ignore[no-untyped-call]

    def finish(self, summary: dict[str, str]) -> None:
        """End the file."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._writer.add_metadata(SUMMARY_METADATA, summary)
        self._writer.finish()  # type: ignore[no-untyped-call]
