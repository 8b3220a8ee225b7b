"""The file of a run: header, attachments and metadata first, then chunks, then the summary.

Attachments and metadata come before the first chunk, so that they survive when the file is cut.
"""

from pathlib import PurePath

from mcap.records import Attachment, Schema
from mcap.records import Channel as ChannelRecord
from mcap.writer import LIBRARY_IDENTIFIER

from adacd_hil import __version__
from adacd_hil.log.channels import Channel
from adacd_hil.log.chunked_file import ChunkedFile
from adacd_hil.log.sink import Sink

PRODUCT = "adacd-hil"
LIBRARY = f"{PRODUCT} {__version__}; {LIBRARY_IDENTIFIER}"
RUN_METADATA = "run"
SUMMARY_METADATA = "summary"
PART_KEY = "part"
"""Of the metadata `run`: number of the part, from 0."""
ENDING_KEY = "ending"
"""Of the summary: why the part ended."""
CONTINUED = "continued"
"""The ending of a part that another follows."""
ROS_PROFILE = "ros2"
"""Of the header: every channel is CDR with a schema of ROS 2, so rosbags and rosbag2 take the file."""
QOS_KEY = "offered_qos_profiles"
"""Channel metadata that the profile asks for; nobody offered one."""
FIELDS_KEY = "fields"
"""Channel metadata: our names of the fields, which ROS would have in lower case."""
_MEDIA_TYPES = {".toml": "application/toml", ".json": "application/json"}


class McapFile(ChunkedFile):
    """One file of a run, over a sink."""

    def __init__(
        self, sink: Sink, channels: tuple[Channel, ...], attachments: dict[str, bytes], metadata: dict[str, str]
    ) -> None:
        super().__init__(sink, LIBRARY, ROS_PROFILE)
        self.ids: dict[int, int] = {}
        """The file's number of each channel, by ours."""
        for name, data in attachments.items():
            media_type = _MEDIA_TYPES.get(PurePath(name).suffix, "text/plain")
            self.attach(Attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=data))
        self.add_metadata(RUN_METADATA, metadata)
        self._define(channels)
        self.head_bytes = sink.tell()
        """Bytes before the first chunk."""

    def _define(self, channels: tuple[Channel, ...]) -> None:
        """Give schemas and channels numbers from 1; the first chunk begins with them."""
        schema_ids: dict[str, int] = {}
        for number, channel in enumerate(channels, start=1):
            name, text = channel.type.name, channel.type.text
            if name not in schema_ids:
                schema_ids[name] = len(schema_ids) + 1
                self.define_schema(Schema(id=schema_ids[name], name=name, encoding="ros2msg", data=text.encode()))
            record = ChannelRecord(
                id=number,
                topic=channel.topic,
                message_encoding="cdr",
                schema_id=schema_ids[name],
                metadata={QOS_KEY: "", **({FIELDS_KEY: " ".join(channel.type.fields)} if channel.type.fields else {})},
            )
            self.define_channel(record)
            self.ids[channel.id] = number

    def finish(self, summary: dict[str, str]) -> None:
        """End the file, with what is to be said of it."""
        self.flush()
        self.add_metadata(SUMMARY_METADATA, summary)
        self.complete()
