"""Conversion of packets to MCAP messages.

The order: cycle after cycle, each frame followed by its decoded message, then the bodies, /joint_states after /scheme.
"""

import struct
from collections import defaultdict
from typing import Any

from adacd_hil.log.recording.log_file import McapFile
from adacd_hil.log.recording.packet import Packet
from adacd_hil.log.recording.processes import LoggedMessage
from adacd_hil.log.types.message_types import (
    ENCAPSULATION,
    END_OF_TIME_NS,
    pack_can_frame,
    pack_fd_frame,
    pack_joint_state,
    pack_log,
    pack_stamp,
)
from adacd_hil.log.types.topics import ChannelId
from adacd_hil.records import JOINTS, Event
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.frame_lengths import CLASSIC_BYTES
from adacd_hil.wire.message_table import MessageTable

_BODY = len(ENCAPSULATION) + len(pack_stamp(0))
"""Offset of a body in a payload, bytes: after the stamp, with which all types begin."""


class PacketWriter:
    """Writes the contents of packets as messages of a file."""

    def __init__(self, file: McapFile, messages: tuple[MessageTable, ...], epoch_ns: int) -> None:
        """Write to `file`. messages: of the DBC, whose frames are decoded. epoch_ns: added to the packets' times."""
        self.frames = 0
        self.dropped = 0  # packets that didn't reach the writer
        self.shown: list[LoggedMessage] | None = None
        """Messages that are collected for the live view; None: they aren't."""
        self._lost = 0  # packets that reached it and were lost; the next packet's event reports them
        self._file = file
        self._epoch_ns = epoch_ns
        self._latest_ns: dict[int, int] = defaultdict(int)  # log time of each of our channels
        self._decoders = {
            message.can_id: (channel, message) for channel, message in enumerate(messages, ChannelId.DECODED_FIRST)
        }
        scheme: Any = file.types[ChannelId.SCHEME].dtype.fields if ChannelId.SCHEME in file.types else {}
        starts = [scheme[name][1] for name in ("q", "dq", "tau_J") if name in scheme]
        self._joint_slices = [slice(start, start + 8 * JOINTS) for start in starts]
        self._least_scheme = max((place.stop for place in self._joint_slices), default=_BODY) - _BODY

    def begin_file(self, file: McapFile) -> None:
        """Write later packets to another file with the same topics."""
        self._file = file

    def lose(self, count: int) -> None:
        """Count packets that can't be written; an event before the next packet reports their number."""
        self._lost += count

    def write_packet(self, packet: Packet) -> bool:
        """Write the content of a packet; return False, and write none of it, if the file can't hold all of it.

        It can't hold a message without a channel, a /scheme message that is too short, or a time beyond a stamp's
        range. If packets are missing since the last one, write an event with their number first. Behind a /scheme
        message write one of /joint_states.
        """
        if not self._fits(packet):
            return False
        time_ns = packet.t_ns + self._epoch_ns
        missing = packet.dropped - self.dropped + self._lost
        self.dropped, self._lost = packet.dropped, 0
        if missing:
            self._add_event(time_ns, Event("warning", "log", f"{missing} packets are missing before this"))
        for is_tx, frame in packet.frames:
            self._add_frame(is_tx, frame, time_ns)
        stamp = pack_stamp(time_ns)
        for channel, body in packet.messages:
            payload = ENCAPSULATION + stamp + body
            self._add(channel, time_ns, time_ns, payload)
            if channel == ChannelId.SCHEME:
                joint_state = pack_joint_state(stamp, *(payload[place] for place in self._joint_slices))
                self._add(ChannelId.JOINT_STATES, time_ns, time_ns, joint_state)
        if packet.event is not None:
            self._add_event(time_ns, packet.event)
        self._file.end_packet()
        return True

    def _fits(self, packet: Packet) -> bool:
        """Return whether the file has a channel for each message, /scheme is long enough, and times fit a stamp."""
        for channel, body in packet.messages:
            if channel not in self._file.ids or (channel == ChannelId.SCHEME and len(body) < self._least_scheme):
                return False
        return self._has_stamp(packet.t_ns) and all(self._has_stamp(frame.t_ns) for _, frame in packet.frames)

    def _has_stamp(self, t_ns: int) -> bool:
        """Return whether a time, in ns of the run's clock, fits into a stamp."""
        return 0 <= t_ns + self._epoch_ns < END_OF_TIME_NS

    def _add_frame(self, is_tx: bool, frame: Frame, publish_ns: int) -> None:
        """Add a frame, and its decoded message if the DBC has its identifier with this length.

        is_tx: sent, not received, so that it goes to another topic; so does a frame of more than CLASSIC_BYTES.
        publish_ns: time of its cycle in the file. Error frames are not decoded.
        """
        self.frames += 1
        can_id, data, t_ns, is_error = frame
        t_ns += self._epoch_ns
        stamp = pack_stamp(t_ns)
        if len(data) > CLASSIC_BYTES:
            channel = ChannelId.TO_CAN_BUS_FD if is_tx else ChannelId.FROM_CAN_BUS_FD
            payload = pack_fd_frame(stamp, can_id, data, is_error)
        else:
            channel = ChannelId.TO_CAN_BUS if is_tx else ChannelId.FROM_CAN_BUS
            payload = pack_can_frame(stamp, can_id, data, len(data), is_error)
        self._add(channel, t_ns, publish_ns, payload)
        number, message = self._decoders.get(can_id, (0, None))
        if message is not None and len(data) == message.length and not is_error:
            values = message.decode(data)
            body = struct.pack(f"<{len(values)}d", *values)
            self._add(number, t_ns, publish_ns, ENCAPSULATION + stamp + body)

    def _add_event(self, time_ns: int, event: Event) -> None:
        self._add(ChannelId.EVENTS, time_ns, time_ns, pack_log(pack_stamp(time_ns), event))

    def _add(self, channel: int, t_ns: int, publish_ns: int, payload: bytes) -> None:
        """Add a message; raise its log time to the topic's last one if earlier: readers expect ascending times.

        Collect it in `shown`, too, unless that is None.
        """
        log_ns = self._latest_ns[channel]
        if t_ns > log_ns:
            log_ns = self._latest_ns[channel] = t_ns
        number = self._file.ids[channel]
        self._file.add_message(number, log_ns, payload, publish_ns)
        if self.shown is not None:
            self.shown.append(LoggedMessage(number, log_ns, publish_ns, payload))
