"""Devices with one frame per SYNC, and the frames of one SYNC: held until all are in, then read in one compiled call.

That is possible where nothing is unusual: every device has answered every SYNC of late, and each frame is the next
right one. Whatever else comes, the frames held so far go through the classes of each device, one by one, in the order
in which they came; the result is the same.

One of these devices is the joint torque sensor: process value, status, checks. A saturated sensor repeats its value and
goes on counting: its torque is fresh and its status says overload. A silent one ages. Torque is the device's own, with
its own zero: sign and tare belong to `adacd_hil.device.arm`. Source: CiA 404, clause 7.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from enum import IntFlag
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.compiled import Structured
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.codec import Codec, MessageCodec
from adacd_hil.wire.codec_columns import SIGNAL_ROW, signal_rows
from adacd_hil.wire.cyclic_codec import CYCLIC_MESSAGE, NO_SPEED, PROFILE_NUMBERS, read_cycle

NO_CYCLE = -2
"""Before any, the first of which is 0: the one before it is no cycle either."""
_MOST_BYTES = 64


class CyclicFrame(NamedTuple):
    """A device's frame of every cycle.

    main: the signal by which a frame without end-to-end header is judged: it changes by `speed`, a signal of its rate
    of change ("": none), times the time, within jump + rate * time.
    """

    message: MessageCodec
    main: str
    speed: str = ""
    jump: float = 0.0
    rate: float = 0.0


class CyclicDevice(ABC):
    """A device that answers every SYNC with one frame, and may send its status in another.

    is_protected: whether the cyclic frame carries an end-to-end header; else it is checked by plausibility.
    sample_cycle: of the values in use; -1 before the first.
    """

    def __init__(self, codec: Codec, name: str, frame: CyclicFrame, period_s: float) -> None:
        """Raise CodecError when the contract lacks a signal."""
        message = frame.message
        self.name = name
        self.node_id = codec.node_id(message.name)
        self.cyclic_frame = frame
        self.cyclic_length = message.length
        """Bytes of its cyclic frame."""
        self.is_protected = message.is_protected
        self.end_to_end = message.receiver()
        self.status_message = codec.messages.get(f"{name}Status")
        self._status_receiver = None if self.status_message is None else self.status_message.receiver()
        self.sample_cycle = -1
        self.implausible_frames = 0
        self._period_s = period_s
        self._main_at = message.place(frame.main)
        self._received: float | None = None  # main value of the last frame that came
        self._received_cycle = 0

    def accept_cyclic(self, data: bytes, cycle: int) -> bool:
        """Take one cyclic frame of `cycle`; False when a check fails and it changes nothing."""
        if len(data) != self.cyclic_length:
            self.implausible_frames += 1
            return False
        if self.is_protected:
            if not self.end_to_end.check(data).is_valid:
                return False
            values = self.cyclic_frame.message.decode_values(data)
        else:
            values = self.cyclic_frame.message.decode_values(data)
            last, self._received = self._received, values[self._main_at]
            cycles, self._received_cycle = cycle - self._received_cycle, cycle
            if last is not None and not self._is_plausible(values, last, cycles):
                self.implausible_frames += 1
                return False
        self._use(data, values, cycle)
        return True

    def follow(self, data: bytes, values: Sequence[float], cycle: int) -> None:
        """Take the values of the cyclic frame that follows the last one and was checked elsewhere."""
        if self.is_protected:
            self.end_to_end.follow()
        else:
            self._received, self._received_cycle = values[self._main_at], cycle
        self._use(data, values, cycle)

    def accept_status(self, data: bytes, cycle: int) -> bool:
        """Take one status frame of `cycle`; False when its length or check is wrong and it changes nothing."""
        message, receiver = self.status_message, self._status_receiver
        if message is None or receiver is None or len(data) != message.length:
            return False
        is_valid = receiver.check(data).is_valid
        if is_valid:
            self._use_status(message.decode_values(data), cycle)
        return is_valid

    @property
    @abstractmethod
    def values(self) -> tuple[float, ...]:
        """What is in use, the main value first."""

    @abstractmethod
    def _is_plausible(self, values: Sequence[float], last: float, cycles: int) -> bool:
        """Say whether a frame may come so many cycles after one with the main value `last`."""

    @abstractmethod
    def _use(self, data: bytes, values: Sequence[float], cycle: int) -> None:
        """Bring the values of a checked cyclic frame into use."""

    @abstractmethod
    def _use_status(self, values: Sequence[float], cycle: int) -> None:
        """Bring the values of a checked status frame into use."""

    @property
    def is_steady(self) -> bool:
        """Whether the last cyclic frame that came is in use, and the next is to follow it without loss."""
        if self.is_protected:
            return self.end_to_end.counter is not None
        return self._received == self.values[0] and self._received_cycle == self.sample_cycle

    def skip(self, count: int) -> None:
        """Take so many cyclic frames for right that were taken elsewhere; the next one is compared with none."""
        if self.is_protected:
            self.end_to_end.skip(count)
        self._received = None

    def miss(self) -> None:
        """Note a cycle in which no cyclic frame came."""
        self.end_to_end.miss()


def lay_out_frames(frames: Sequence[CyclicFrame], is_brief: bool = False) -> tuple[Structured, Structured]:
    """Lay the messages of a cycle out for compiled code, and the rows of their values: of all, or of main and speed."""
    messages = np.zeros(len(frames), CYCLIC_MESSAGE)
    rows: list[NDArray[Any]] = []
    for entry, (message, main, speed, jump, rate) in zip(messages, frames, strict=True):
        names = [signal.name for signal in message.values]
        chosen = [name for name in (main, speed) if name] if is_brief else names
        table = signal_rows(message.signals)[len(message.signals) - len(names) :]
        entry["length"], entry["profile"] = message.length, PROFILE_NUMBERS[message.protection]
        entry["data_ids"][: len(message.data_ids)] = list(message.data_ids)
        entry["first"], entry["count"] = sum(map(len, rows)), len(chosen)
        entry["main"], entry["speed"] = chosen.index(main), chosen.index(speed) if speed else NO_SPEED
        entry["jump"], entry["rate"] = jump, rate
        rows.append(table[[names.index(name) for name in chosen]])
    return messages, np.concatenate(rows) if rows else np.zeros(0, SIGNAL_ROW)


class CycleFrames:
    """Holds the frames of a cycle.

    is_open: whether frames are held at all in this cycle. held: each with the place of its device, as they came.
    """

    def __init__(self, devices: Sequence[CyclicDevice], period_s: float) -> None:
        """Lay out what the compiled code reads, and compile it."""
        self.is_open = False
        self.held: list[tuple[int, Frame]] = []
        self._devices, self._period_s = devices, period_s
        self._messages, self._rows = lay_out_frames([device.cyclic_frame for device in devices])
        self._lengths = self._messages["length"].tolist()
        self._place_of = {device.cyclic_frame.message.can_id: place for place, device in enumerate(devices)}
        self._data = np.zeros((len(devices), _MOST_BYTES), np.uint8)
        self._bytes = self._data.reshape(-1).data
        self._counters = np.zeros(len(devices), np.int64)
        self._last = np.zeros(len(devices))
        self._values = np.zeros((len(devices), max(self._messages["count"].tolist())))
        self._places = 0
        self._all = (1 << len(devices)) - 1
        self.read_cycle = NO_CYCLE
        """The last cycle whose frames were all read here, and nothing of it by the devices' classes."""
        self._read()

    def _read(self) -> bool:
        return read_cycle(
            self._data, self._messages, self._rows, self._counters, self._last, self._period_s, self._values
        )

    def begin(self, cycle: int) -> bool:
        """Take over from the devices' classes before a cycle; False where one's last frame is not in use."""
        devices = self._devices
        if not all(device.is_steady and device.sample_cycle == cycle - 1 for device in devices):
            return False
        self._counters[:] = [device.end_to_end.counter or 0 for device in devices]
        self._last[:] = [device.values[0] for device in devices]
        return True

    def hold(self, place: int, frame: Frame) -> bool:
        """Hold a frame; False, and nothing is held, when it isn't the device's first of this cycle or of its length."""
        length, bit = len(frame.data), 1 << place
        if self._places & bit or length != self._lengths[place]:
            return False
        begin = place * _MOST_BYTES
        self._bytes[begin : begin + length] = frame.data
        self.held.append((place, frame))
        self._places |= bit
        return True

    def hold_all(self, frames: Sequence[Frame], sync_ns: int) -> bool:
        """Hold frames that are one of each device, of its length and behind SYNC; else False, and nothing is held."""
        if len(frames) != len(self._devices) or self._places:
            return False
        held, places = [], 0
        for frame in frames:
            can_id, data, t_ns, is_error = frame
            place = self._place_of.get(can_id)
            if place is None or is_error or t_ns < sync_ns or len(data) != self._lengths[place]:
                return False
            begin = place * _MOST_BYTES
            self._bytes[begin : begin + len(data)] = data
            held.append((place, frame))
            places |= 1 << place
        if places != self._all:
            return False
        self.held, self._places = held, places
        return True

    @property
    def are_all_in(self) -> bool:
        """Whether the frames of all devices are held."""
        return self._places == self._all

    def read(self, cycle: int) -> list[list[float]] | None:
        """Return the values of each device's frame, all being in; None unless each is the next right one."""
        if not self._read():
            return None
        self.read_cycle = cycle
        return self._values.tolist()  # type: ignore[no-any-return]

    def close(self) -> list[tuple[int, Frame]]:
        """Hold nothing more in this cycle; return what is held."""
        held, self.held = self.held, []
        self._places = 0
        self.is_open = False
        return held


class SensorStatus(IntFlag):
    """Bits of 0x6150, analogue input status."""

    NOT_VALID = 1
    POSITIVE_OVERLOAD = 2
    NEGATIVE_OVERLOAD = 4


STATUS_BITS = 0x07
_STATUSES = tuple(SensorStatus(bits) for bits in range(STATUS_BITS + 1))
USABLE = tuple(status for status in _STATUSES if not status & SensorStatus.NOT_VALID)
"""Statuses with which a torque may be used; an overloaded one is a bound."""
_OVERLOAD = SensorStatus.POSITIVE_OVERLOAD | SensorStatus.NEGATIVE_OVERLOAD
_STATUS_IN_HEADER = {0: None, 2: (1, 4), 4: (3, 0)}
"""Byte and shift of the sender's status, by the length of the end-to-end header: none, Profile 2, Profile 5."""


class TorqueSensor(CyclicDevice):
    """The torque sensor of joint 1 or 2."""

    def __init__(
        self,
        codec: Codec,
        joint: int,
        period_s: float = 0.001,
        torque_rate_Nm_s: float = math.inf,
        torque_range_Nm: float = 0.0,
    ) -> None:
        """`torque_rate_Nm_s` bounds the torque of unprotected frames; at `torque_range_Nm`, if not 0, is overload.

        Raises CodecError when the contract lacks a message or signal.
        """
        name = f"Sensor{joint}"
        message = self.torque_message = codec.message(f"{name}Torque")
        super().__init__(codec, name, CyclicFrame(message, "torque", rate=torque_rate_Nm_s), period_s)
        self._torque_rate_Nm_s = torque_rate_Nm_s
        self.torque_range_Nm = torque_range_Nm
        names = [signal.name for signal in message.values]
        self._status_at = names.index("status") if "status" in names else None
        self.status_in_header = _STATUS_IN_HEADER[message.header_bytes]
        self._slow_status_at = -1 if self.status_message is None else self.status_message.place("status")
        self.torque_Nm = 0.0
        """As the device gives it: its sign, its own auto-zero, not tared."""
        self.status = SensorStatus(0)
        """What either of its frames says: a sensor that contradicts itself isn't believed.

        A status frame counts until the next one. One that is taken back before the second torque frame after it doesn't
        count: so a sensor begins.
        """
        self._cyclic_bits = 0
        self._slow_bits = 0
        self._heard_bits = 0  # of the last status frame

    def _is_plausible(self, values: Sequence[float], last: float, cycles: int) -> bool:
        # Two frames of one cycle, late and present, may lie a period apart.
        return abs(values[self._main_at] - last) <= self._torque_rate_Nm_s * (max(1, cycles) * self._period_s)

    def _use(self, data: bytes, values: Sequence[float], cycle: int) -> None:
        torque = self.torque_Nm = values[self._main_at]
        self.sample_cycle = cycle
        if self._status_at is not None:
            self._cyclic_bits = int(values[self._status_at]) & STATUS_BITS
        elif self.status_in_header is not None:
            byte, shift = self.status_in_header
            self._cyclic_bits = data[byte] >> shift & STATUS_BITS
        elif self.torque_range_Nm:
            self._cyclic_bits = _judge_range(torque, self.torque_range_Nm)
        else:
            self._slow_bits = self._heard_bits  # nothing else says it
        self.status = _STATUSES[self._cyclic_bits | self._slow_bits]
        self._slow_bits = self._heard_bits

    @property
    def values(self) -> tuple[float]:
        """Torque in use, Nm."""
        return (self.torque_Nm,)

    def _use_status(self, values: Sequence[float], cycle: int) -> None:  # noqa: ARG002 (as of all devices)
        self._heard_bits = int(values[self._slow_status_at]) & STATUS_BITS
        self._slow_bits &= self._heard_bits
        self.status = _STATUSES[self._cyclic_bits | self._heard_bits]

    @property
    def is_steady(self) -> bool:
        """Also, whether no status frame is about to count."""
        counted = self._cyclic_bits | self._slow_bits
        return super().is_steady and self._slow_bits == self._heard_bits and self.status == counted

    @property
    def is_overloaded(self) -> bool:
        """Whether the torque is beyond the sensor's range: fresh, but not the torque that acts."""
        return bool(self.status & _OVERLOAD)


def _judge_range(torque: float, range_Nm: float) -> SensorStatus:
    if torque >= range_Nm:
        return SensorStatus.NOT_VALID | SensorStatus.POSITIVE_OVERLOAD
    if torque <= -range_Nm:
        return SensorStatus.NOT_VALID | SensorStatus.NEGATIVE_OVERLOAD
    return SensorStatus(0)
