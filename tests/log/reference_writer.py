"""The straightforward log: one packet at a time, each message packed by itself, mcap's own writer.

What `PacketWriter` and `McapFile` make must be this, byte for byte.
"""

import io
import struct

import mcap.writer

from adacd_hil import __version__
from adacd_hil.log.log_files import FIELDS_KEY, RUN_METADATA, SUMMARY_METADATA
from adacd_hil.log.types.message_types import (
    ENCAPSULATION,
    body_struct,
    pack_can_frame,
    pack_fd_frame,
    pack_joint_state,
    pack_log,
)
from adacd_hil.log.types.topics import SCHEME, ChannelId
from adacd_hil.records import Event, scheme_layout

SCHEME_BLOCK = body_struct(SCHEME.head, has_block=True).size


class MemorySink(io.BytesIO):
    """A sink that can be looked into; mcap's writer takes it too."""

    packets = 0

    def write(self, data, packets=0):
        self.packets += packets
        return super().write(data)


class ReferenceWriter:
    def __init__(self, sink, channels, attachments, metadata, messages, epoch_ns, parameter_count):
        self._epoch_ns = epoch_ns
        self._by_id = {message.can_id: (index, message) for index, message in enumerate(messages)}
        slices = scheme_layout(parameter_count).slices
        self._joints = [slices[name] for name in ("q", "dq", "tau_J")]
        self._dropped = 0
        self._writer = mcap.writer.Writer(sink, chunk_size=240 * 1024, enable_crcs=True, enable_data_crcs=True)
        self._writer.start("ros2", f"adacd-hil {__version__}; {mcap.writer.LIBRARY_IDENTIFIER}")
        for name, data in attachments.items():
            kind = "application/toml" if name.endswith(".toml") else "text/plain"
            self._writer.add_attachment(0, 0, name, kind, data)
        self._writer.add_metadata(RUN_METADATA, metadata)
        self._ids, schema_ids = {}, {}
        for channel in channels:
            kind = channel.type
            if kind.name not in schema_ids:
                schema_ids[kind.name] = self._writer.register_schema(kind.name, "ros2msg", kind.text.encode())
            fields = {"offered_qos_profiles": ""}
            if kind.fields:
                fields[FIELDS_KEY] = " ".join(kind.fields)
            self._ids[channel.id] = self._writer.register_channel(channel.topic, "cdr", schema_ids[kind.name], fields)
        self._latest_ns = dict.fromkeys(self._ids, 0)

    def _add(self, channel, log_time_ns, publish_time_ns, payload):
        self._latest_ns[channel] = log_time_ns = max(log_time_ns, self._latest_ns[channel])
        self._writer.add_message(self._ids[channel], log_time_ns, payload, publish_time_ns)

    def _look_at(self, time_ns, dropped):
        if dropped != self._dropped:
            notice = Event("warning", "log", f"{dropped - self._dropped} packets are missing before this")
            self._add(ChannelId.EVENTS, time_ns, time_ns, pack_log(stamp(time_ns), notice))
            self._dropped = dropped

    def event(self, t_ns, dropped, event):
        time_ns = t_ns + self._epoch_ns
        self._look_at(time_ns, dropped)
        self._add(ChannelId.EVENTS, time_ns, time_ns, pack_log(stamp(time_ns), event))

    def cycle(self, t_ns, dropped, messages, frames):
        time_ns = t_ns + self._epoch_ns
        self._look_at(time_ns, dropped)
        for is_tx, frame in frames:
            self._frame(is_tx, frame, time_ns)
        for channel, body in messages:
            self._add(channel, time_ns, time_ns, ENCAPSULATION + stamp(time_ns) + body)
            if channel == ChannelId.SCHEME:
                parts = [body[SCHEME_BLOCK + 8 * s.start : SCHEME_BLOCK + 8 * s.stop] for s in self._joints]
                self._add(ChannelId.JOINT_STATES, time_ns, time_ns, pack_joint_state(stamp(time_ns), *parts))

    def _frame(self, is_tx, frame, publish_ns):
        time_ns = frame.t_ns + self._epoch_ns
        if len(frame.data) > 8:
            channel = ChannelId.TO_CAN_BUS_FD if is_tx else ChannelId.FROM_CAN_BUS_FD
            payload = pack_fd_frame(stamp(time_ns), frame.can_id, frame.data, frame.is_error)
        else:
            channel = ChannelId.TO_CAN_BUS if is_tx else ChannelId.FROM_CAN_BUS
            payload = pack_can_frame(stamp(time_ns), frame.can_id, frame.data, len(frame.data), frame.is_error)
        self._add(channel, time_ns, publish_ns, payload)
        index, message = self._by_id.get(frame.can_id, (0, None))
        if message is not None and not frame.is_error and len(frame.data) == message.length:
            values = message.decode(frame.data)
            body = struct.pack(f"<{len(values)}d", *values)
            self._add(ChannelId.DECODED_FIRST + index, time_ns, publish_ns, ENCAPSULATION + stamp(time_ns) + body)

    def flush(self):
        self._writer.flush()

    def finish(self, summary):
        self._writer.flush()
        self._writer.add_metadata(SUMMARY_METADATA, summary)
        self._writer.finish()


def stamp(time_ns):
    return struct.pack("<II", *divmod(time_ns, 1_000_000_000))
