"""Conversion of packets to MCAP message records, hundreds of packets at a time.

Python costs about 6 µs per message, numpy about 2 µs per array operation, however long the array: so the frames, the
decoded messages and the bodies of a quarter of a second are each turned into records of one size as a whole, from a
template, and then placed in the order of the packets. A third of the remaining time is compression and checksums. It is
not compiled: importing numba takes as long as writing 20 s of a run, and 60 MB.

A record: opcode, length, channel, sequence 0, log time, publish time, then the payload; MCAP specification, Message.
The order: cycle after cycle, each frame followed by its decoded message, then the bodies, /joint_states after /scheme.
"""

import functools
import struct
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from adacd_hil.log.mcap.record_layout import MESSAGE_HEAD, RECORD_HEAD_BYTES, record_dtype
from adacd_hil.log.recording.log_file import McapFile
from adacd_hil.log.recording.packet import (
    EVENT,
    IS_ERROR,
    IS_TX,
    Columns,
    gather,
    long_data,
    sums_within,
    unpack,
    unpack_event,
    windows,
)
from adacd_hil.log.types.message_types import (
    CAN_FRAME_DTYPE,
    ENCAPSULATION,
    END_OF_TIME_NS,
    FD_FRAME_DTYPE,
    JOINT_STATE_DTYPE,
    MAX_DATA,
    pack_can_frame,
    pack_fd_frame,
    pack_joint_state,
    pack_log,
)
from adacd_hil.log.types.topics import ChannelId
from adacd_hil.records import JOINTS, Event
from adacd_hil.wire.codec_columns import ColumnCodec, MessageTable
from adacd_hil.wire.frame_lengths import CLASSIC_BYTES, MAX_STANDARD_ID

_HEAD = struct.Struct("<BQHIQQ")
_CHANNEL = slice(9, 11)
_TIMES = slice(15, MESSAGE_HEAD)
_BODY = MESSAGE_HEAD + len(ENCAPSULATION) + 8
"""Offset of a body in a record, bytes: after the stamp, with which all types begin."""
_STAMP = slice(_BODY - 8, _BODY)
_NO_STAMP = bytes(8)
_CAN_FRAME_RECORD = record_dtype(CAN_FRAME_DTYPE)
_JOINT_STATE_RECORD = record_dtype(JOINT_STATE_DTYPE)

Numbers = NDArray[np.int64]
Rows = NDArray[np.uint8]
Watch = Callable[[Rows, NDArray[np.uint16], Numbers, Numbers], None]
"""Takes consecutive records, the file's ids of their channels, their log times, and the end of each."""


class _Group(NamedTuple):
    """Records of one size: (n, size) bytes, still without channel, times and stamp."""

    rows: Rows
    slots: Numbers  # (n,) which records of the batch they are
    channels: NDArray[np.uint16] | int  # the file's numbers
    t_ns: Numbers  # (n,) stamps, and log times where these don't run backwards
    publish_ns: Numbers  # (n,)


class PacketWriter:
    """Turns packets into messages of a file."""

    def __init__(
        self,
        file: McapFile,
        messages: tuple[MessageTable, ...],
        epoch_ns: int,
        watch: Watch | None = None,
    ) -> None:
        """Write to `file`; `watch`, if given, gets every batch of records, too.

        messages: of the DBC, whose frames are decoded. epoch_ns: added to the packets' times.
        """
        self.frames = 0
        self.dropped = 0  # packets that didn't reach the writer
        self._lost = 0  # packets that reached it and were lost; the next packet's event reports them
        self._file = file
        self._watch = watch
        self._epoch_ns = epoch_ns
        self._latest_ns = np.zeros(1 + max(file.ids.values()), np.int64)
        self._is_known = np.zeros(2**16, np.bool_)
        self._is_known[list(file.ids)] = True
        known = sorted({message.can_id: index for index, message in enumerate(messages)}.items())
        self._can_ids = np.array([can_id for can_id, _ in known], np.int64)
        self._decoders = [ColumnCodec(messages[index]) for _, index in known]
        self._decoded_ids = [file.ids[ChannelId.DECODED_FIRST + index] for _, index in known]
        self._lengths = np.array([decoder.length for decoder in self._decoders], np.int64)
        scheme: Any = file.types[ChannelId.SCHEME].dtype.fields if ChannelId.SCHEME in file.types else {}
        starts = {name: MESSAGE_HEAD + scheme[name][1] for name in ("q", "dq", "tau_J") if name in scheme}
        self._joint_slices = {name: slice(start, start + 8 * JOINTS) for name, start in starts.items()}
        self._least_scheme = max((place.stop for place in self._joint_slices.values()), default=_BODY) - _BODY

    def begin_file(self, file: McapFile) -> None:
        """Write later packets to another file with the same topics."""
        self._file = file

    def lose(self, count: int) -> None:
        """Count packets that can't be written; an event before the next packet reports them."""
        self._lost += count

    def write_packets(self, data: Rows, starts: Numbers, sizes: Numbers) -> int:
        """Write the contents of the packets in `data`; return the number of invalid packets, which are skipped.

        data: bytes (b,), with packet.ROOM behind the last packet; starts, sizes: of the packets (n,).
        """
        packets = unpack(data, starts, sizes)
        is_right = self._is_right(packets)
        if not is_right.all():
            packets = unpack(data, packets.starts[is_right], packets.sizes[is_right])
        if len(packets.heads):
            self._write(packets)
        return len(starts) - len(packets.heads)

    def _is_right(self, packets: Columns) -> NDArray[np.bool_]:
        """Return for each packet whether the file can hold all of it."""
        messages, frames = packets.messages, packets.frames
        is_short = (messages["channel"] == ChannelId.SCHEME) & (messages["size"] < self._least_scheme)
        is_wrong_message = is_short | ~self._is_known[messages["channel"]]
        is_wrong_frame = (frames["length"] > MAX_DATA) | ~self._has_stamp(frames["t_ns"])
        wrong = (
            sums_within(is_wrong_message, packets.message_counts)[1]
            + sums_within(is_wrong_frame, packets.frame_counts)[1]
        )
        return np.asarray(self._has_stamp(packets.heads["t_ns"]) & (wrong == 0))

    def _has_stamp(self, t_ns: Numbers) -> NDArray[np.bool_]:
        """Return for each time, in ns of the run's clock, whether it fits into a stamp."""
        time_ns = t_ns + self._epoch_ns
        return np.asarray((time_ns >= 0) & (time_ns < END_OF_TIME_NS))

    def _write(self, packets: Columns) -> None:
        """Write packets: make their records in groups of one size, and place them in the packets' order."""
        heads, frames, messages = packets.heads, packets.frames, packets.messages
        dropped = heads["dropped"].astype(np.int64)
        missing = np.diff(dropped, prepend=self.dropped)
        self.dropped = int(dropped[-1])
        missing[0] += self._lost
        self._lost = 0
        self.frames += len(frames)

        decoders = self._decoders_of(frames)
        before_frames, frame_sums = sums_within(1 + (decoders >= 0), packets.frame_counts)
        is_scheme = messages["channel"] == ChannelId.SCHEME
        before_messages, message_sums = sums_within(1 + is_scheme, packets.message_counts)
        has_notice = missing != 0
        is_event = heads["kind"] == EVENT
        slot_counts = has_notice + frame_sums + message_sums + is_event
        firsts = np.cumsum(slot_counts) - slot_counts
        frame_slots = np.repeat(firsts + has_notice, packets.frame_counts) + before_frames
        message_slots = np.repeat(firsts + has_notice + frame_sums, packets.message_counts) + before_messages

        time_ns = heads["t_ns"] + self._epoch_ns
        frame_publish_ns = np.repeat(time_ns, packets.frame_counts)
        groups = [
            *self._frame_groups(packets, frame_slots, frame_publish_ns),
            *self._decoded_groups(packets, decoders, frame_slots + 1, frame_publish_ns),
            *self._body_groups(packets, message_slots, np.repeat(time_ns, packets.message_counts)),
        ]
        for index in np.flatnonzero(has_notice).tolist():
            event = Event("warning", "log", f"{missing[index]} packets are missing before this")
            groups.append(self._event_group(event, firsts[index], time_ns[index]))
        for index in np.flatnonzero(is_event).tolist():
            event = unpack_event(packets, index)
            groups.append(self._event_group(event, firsts[index] + has_notice[index], time_ns[index]))
        self._lay_down(groups, int(slot_counts.sum()), firsts + slot_counts)

    def _decoders_of(self, frames: NDArray[Any]) -> Numbers:
        """Return the index of each frame's decoder (f,); -1 for frames without one."""
        if not len(self._can_ids):
            return np.full(len(frames), -1)
        can_ids = frames["can_id"].astype(np.int64)
        found = np.minimum(np.searchsorted(self._can_ids, can_ids), len(self._can_ids) - 1)
        fits = (self._can_ids[found] == can_ids) & (self._lengths[found] == frames["length"])
        return np.where(fits & (frames["flags"] & IS_ERROR == 0), found, -1)

    def _frame_groups(self, packets: Columns, slots: Numbers, publish_ns: Numbers) -> Iterator[_Group]:
        """Yield the records of the frames: those of up to 8 bytes in one group, longer ones in a group per length."""
        frames = packets.frames
        is_long = frames["length"] > CLASSIC_BYTES
        places = np.flatnonzero(~is_long)
        if len(places):
            rows = _rows(pack_can_frame(_NO_STAMP, 0, b"", 0, False), len(places))
            records = rows.view(_CAN_FRAME_RECORD)[:, 0]
            records["length"] = frames["length"][places]
            records["data"] = frames["data"][places]
            ids = (ChannelId.TO_CAN_BUS, ChannelId.FROM_CAN_BUS)
            yield self._frame_group(frames[places], rows, records, ids, slots[places], publish_ns[places])
        for length in np.unique(frames["length"][is_long]).tolist():
            places = np.flatnonzero(frames["length"] == length)
            rows = _rows(pack_fd_frame(_NO_STAMP, 0, bytes(length), False), len(places))
            records = rows.view(_fd_frame_record(length))[:, 0]
            records["data"] = long_data(packets, places)[:, :length]
            ids = (ChannelId.TO_CAN_BUS_FD, ChannelId.FROM_CAN_BUS_FD)
            yield self._frame_group(frames[places], rows, records, ids, slots[places], publish_ns[places])

    def _frame_group(
        self,
        frames: NDArray[Any],
        rows: Rows,
        records: NDArray[Any],
        ids: tuple[ChannelId, ChannelId],
        slots: Numbers,
        publish_ns: Numbers,
    ) -> _Group:
        """Fill the fields that all frames have, and return the records as a group.

        records: a view of `rows`. ids: channels of sent and of received frames.
        """
        records["can_id"] = frames["can_id"]
        records["is_extended"] = frames["can_id"] > MAX_STANDARD_ID
        records["is_error"] = frames["flags"] & IS_ERROR != 0
        sent, received = (np.uint16(self._file.ids[channel]) for channel in ids)
        channels = np.where(frames["flags"] & IS_TX, sent, received)
        return _Group(rows, slots, channels, frames["t_ns"] + self._epoch_ns, publish_ns)

    def _decoded_groups(
        self, packets: Columns, decoders: Numbers, slots: Numbers, publish_ns: Numbers
    ) -> Iterator[_Group]:
        """Yield the records of decoded frames, a group per message of the DBC."""
        for number in np.unique(decoders[decoders >= 0]).tolist():
            decoder = self._decoders[number]
            places = np.flatnonzero(decoders == number)
            is_long = decoder.length > CLASSIC_BYTES
            data = long_data(packets, places) if is_long else packets.frames["data"][places]
            rows = _rows(ENCAPSULATION + _NO_STAMP + bytes(8 * decoder.count), len(places))
            decoder.decode(data[:, : decoder.length], rows[:, _BODY:].view(np.float64))
            t_ns = packets.frames["t_ns"][places] + self._epoch_ns
            yield _Group(rows, slots[places], self._decoded_ids[number], t_ns, publish_ns[places])

    def _body_groups(self, packets: Columns, slots: Numbers, time_ns: Numbers) -> Iterator[_Group]:
        """Yield the records of our own topics, a group per topic, and the joint states that /scheme contains."""
        messages = packets.messages
        kinds = messages.view(np.uint32)
        for kind in np.unique(kinds):
            places = np.flatnonzero(kinds == kind)
            channel, size = messages[places[0]].tolist()
            rows = _rows(ENCAPSULATION + _NO_STAMP + bytes(size), len(places))
            if size:
                rows[:, _BODY:] = (
                    gather(packets.data, packets.body_starts[places], size).view(np.uint8).reshape(-1, size)
                )
            yield _Group(rows, slots[places], self._file.ids[channel], time_ns[places], time_ns[places])
            if channel == ChannelId.SCHEME:
                joint_rows = _rows(pack_joint_state(_NO_STAMP, *[bytes(8 * JOINTS)] * 3), len(places))
                joint_states = joint_rows.view(_JOINT_STATE_RECORD)[:, 0]
                for name, place in self._joint_slices.items():
                    joint_states[name] = rows[:, place].view(np.float64)
                joint_id = self._file.ids[ChannelId.JOINT_STATES]
                yield _Group(joint_rows, slots[places] + 1, joint_id, time_ns[places], time_ns[places])

    def _event_group(self, event: Event, slot: int, time_ns: int) -> _Group:
        times_ns = np.array([time_ns])
        rows = _rows(pack_log(_NO_STAMP, event), 1)
        return _Group(rows, np.array([slot]), self._file.ids[ChannelId.EVENTS], times_ns, times_ns)

    def _lay_down(self, groups: list[_Group], count: int, packet_ends: Numbers) -> None:
        """Complete the `count` records of the groups and write them in the order of their slots.

        packet_ends: the slot behind the last one of each packet.
        """
        channels = np.empty(count, np.uint16)
        log_ns = np.empty(count, np.int64)
        sizes = np.empty(count, np.int64)
        for group in groups:
            channels[group.slots] = group.channels
            log_ns[group.slots] = group.t_ns
            sizes[group.slots] = group.rows.shape[1]
        self._make_monotonic(log_ns, channels)
        ends = np.cumsum(sizes)
        records = np.empty(ends[-1] if count else 0, np.uint8)
        for group in groups:
            rows, size = group.rows, group.rows.shape[1]
            rows[:, _CHANNEL].view(np.uint16)[:, 0] = group.channels
            times = rows[:, _TIMES].view(np.int64)
            times[:, 0] = log_ns[group.slots]
            times[:, 1] = group.publish_ns
            stamps = rows[:, _STAMP].view(np.uint32)
            stamps[:, 0], stamps[:, 1] = np.divmod(group.t_ns, 1_000_000_000)
            windows(records, size)[ends[group.slots] - size] = rows.view(f"V{size}")[:, 0]
        self._file.add_messages(records, channels, log_ns, ends, packet_ends)
        if self._watch is not None:
            self._watch(records, channels, log_ns, ends)

    def _make_monotonic(self, log_ns: Numbers, channels: NDArray[np.uint16]) -> None:
        """Raise, in place, log times that would run backwards in their topic, which readers don't expect."""
        order = np.argsort(channels, kind="stable")
        for places in np.split(order, np.flatnonzero(np.diff(channels[order])) + 1):
            if not len(places):
                continue
            channel = channels[places[0]]
            times = log_ns[places]
            times[0] = max(times[0], self._latest_ns[channel])
            log_ns[places] = np.maximum.accumulate(times)
            self._latest_ns[channel] = log_ns[places[-1]]


def _rows(payload: bytes, count: int) -> Rows:
    """Return `count` equal records of a payload (count, size), without channel and times."""
    length = MESSAGE_HEAD + len(payload) - RECORD_HEAD_BYTES
    record = _HEAD.pack(Opcode.MESSAGE, length, 0, 0, 0, 0) + payload
    return np.repeat(np.frombuffer(record, np.uint8)[np.newaxis], count, axis=0)


@functools.cache
def _fd_frame_record(length: int) -> "np.dtype[Any]":
    """Return the record type of an FD frame of `length` bytes, as far as it differs from the template."""
    fields: Any = record_dtype(FD_FRAME_DTYPE).fields
    names = ("can_id", "is_extended", "is_error", "data")
    return np.dtype(
        {
            "names": names,
            "formats": [*(fields[name][0] for name in names[:-1]), ("u1", (length,))],
            "offsets": [fields[name][1] for name in names],
            "itemsize": fields["data"][1] + length,
        }
    )
