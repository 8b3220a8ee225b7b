"""Writes frames from anywhere to an MCAP file with the topics and types of our logs."""

import re
from typing import IO

from adacd_hil.log.frames.mcap_frames import CHANNEL_KEY, ERROR_STATE_KEY, RATE_SWITCH_KEY, RecordedFrame
from adacd_hil.log.log_files import (
    CLOSED,
    ENDING_KEY,
    EPOCH_KEY,
    QOS_KEY,
    ROS_PROFILE,
    RUN_METADATA,
    SUMMARY_METADATA,
)
from adacd_hil.log.mcap.chunked_file import FLUSH_PERIOD_NS, ChunkedFile
from adacd_hil.log.types.message_types import (
    CAN_FRAME,
    END_OF_TIME_NS,
    FD_FRAME,
    pack_can_frame,
    pack_fd_frame,
    pack_stamp,
)


class FrameWriter:
    """Writes frames as an MCAP file to a stream, which stays open. The file is whole after `finish`."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._frames = 0  # of the first CAN channel, which has the topics of our logs
        self._stream = stream
        self._file = ChunkedFile(lambda data, _: stream.write(data), ROS_PROFILE)
        self._file.add_metadata(RUN_METADATA, {EPOCH_KEY: "0"})
        self._ids: dict[tuple[str, bool, bool, bool, bool], int] = {}
        self._latest_ns: dict[str, int] = {}  # log time of each topic
        self._topics: dict[int, str] = {}
        self._first_channel: str | None = None
        self._flushed_ns: int | None = None

    def write_frame(self, frame: RecordedFrame) -> None:
        """Write a frame to the stream, or keep it for its chunk, which spans at most `FLUSH_PERIOD_NS`.

        Its publish time is its own; its log time is at least that of the frame before on its topic. Raises ValueError
        for a time below 0 or beyond the range of ROS stamps.
        """
        if not 0 <= frame.t_ns < END_OF_TIME_NS:
            raise ValueError(f"t_ns = {frame.t_ns} is not within 0 and {END_OF_TIME_NS} ns")
        if self._flushed_ns is None or not 0 <= frame.t_ns - self._flushed_ns < FLUSH_PERIOD_NS:
            self._file.flush()
            self._stream.flush()
            self._flushed_ns = frame.t_ns
        key = (frame.channel, frame.is_fd, frame.is_tx, frame.has_rate_switch, frame.has_error_state)
        channel_id = self._ids.get(key)
        if channel_id is None:
            channel_id = self._ids[key] = self._add_channel(frame)
        topic = self._topics[channel_id]
        log_time_ns = self._latest_ns[topic] = max(frame.t_ns, self._latest_ns.get(topic, 0))
        stamp = pack_stamp(frame.t_ns)
        if frame.is_fd:
            payload = pack_fd_frame(stamp, frame.can_id, frame.data, frame.is_error, frame.is_extended)
        else:
            payload = pack_can_frame(
                stamp, frame.can_id, frame.data, frame.length, frame.is_error, frame.is_remote, frame.is_extended
            )
        self._file.add_message(channel_id, log_time_ns, payload, frame.t_ns)
        self._file.end_packet()
        self._frames += frame.channel == self._first_channel

    def _add_channel(self, frame: RecordedFrame) -> int:
        """Register an MCAP schema, if new, and an MCAP channel for frames like this one; return the channel's id.

        Topics of all CAN channels but the first begin with the channel's name.
        """
        kind = FD_FRAME if frame.is_fd else CAN_FRAME
        schema = self._file.define_schema(kind.name, "ros2msg", kind.text.encode())
        metadata = {QOS_KEY: "", **({CHANNEL_KEY: frame.channel} if frame.channel else {})}
        if frame.is_fd:
            metadata[RATE_SWITCH_KEY] = str(int(frame.has_rate_switch))
            metadata[ERROR_STATE_KEY] = str(int(frame.has_error_state))
        if self._first_channel is None:
            self._first_channel = frame.channel
        prefix = "" if frame.channel == self._first_channel else f"/{_topic_name(frame.channel)}"
        way = "to_can_bus" if frame.is_tx else "from_can_bus"
        topic = f"{prefix}/{way}{'_fd' if frame.is_fd else ''}"
        channel_id = self._file.define_channel(topic, "cdr", schema, metadata)
        self._topics[channel_id] = topic
        return channel_id

    def finish(self) -> None:
        """Write the summary, with which the file ends. Call it once."""
        counts = {"frames": str(self._frames), "messages": str(self._file.messages), "dropped": "0"}
        self._file.flush()
        self._file.add_metadata(SUMMARY_METADATA, {**counts, ENDING_KEY: CLOSED})
        self._file.complete()
        self._stream.flush()


def _topic_name(channel: str) -> str:
    """Return a CAN channel's name in letters that a ROS 2 topic may have; "can" before it if it begins with none."""
    spelled = re.sub(r"[^A-Za-z0-9]+", "_", channel).strip("_")
    return spelled if spelled[:1].isalpha() else f"can{spelled}"
