"""One joint torque sensor as the host sees it: process value, status, checks. Source: CiA 404, clause 7.

A saturated sensor repeats its value and goes on counting: its torque is fresh and its status says overload. A silent
one ages. Torque is the device's own, with its own zero: sign and tare belong to `adacd_hil.device.arm`.
"""

import math
from collections.abc import Sequence
from enum import IntFlag

from adacd_hil.device.cycle_frames import CyclicFrame
from adacd_hil.device.drive import find_signal
from adacd_hil.wire.codec import Codec


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


class TorqueSensor:
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
        self.name = name
        self.node_id = codec.node_id(f"{name}Torque")
        self.torque_message = codec.message(f"{name}Torque")
        self.status_message = codec.messages.get(f"{name}Status")
        self.end_to_end = self.torque_message.receiver()
        self._period_s = period_s
        self.torque_rate_Nm_s = torque_rate_Nm_s
        self.torque_range_Nm = torque_range_Nm
        names = [signal.name for signal in self.torque_message.values]
        self._torque_at = find_signal(self.torque_message, "torque")
        self._status_at = names.index("status") if "status" in names else None
        self.status_in_header = _STATUS_IN_HEADER[self.torque_message.header_bytes]
        self._slow_status_at = None if self.status_message is None else find_signal(self.status_message, "status")
        self._status_receiver = None if self.status_message is None else self.status_message.receiver()
        self.cyclic_length = self.torque_message.length
        """Bytes of its cyclic frame."""
        self.is_protected = self.torque_message.header_bytes > 0
        """Whether the torque carries an end-to-end header; else it is checked by plausibility."""
        self._received_torque_Nm: float | None = None
        self._received_cycle = 0
        self.torque_Nm = 0.0
        """As the device gives it: its sign, its own auto-zero, not tared."""
        self.sample_cycle = -1
        """Cycle of the torque in use; -1 before the first."""
        self.implausible_frames = 0
        self.status = SensorStatus(0)

    def accept_torque(self, data: bytes, cycle: int) -> bool:
        """Take one torque frame of `cycle`; False when a check fails and it changes nothing."""
        if len(data) != self.torque_message.length:
            self.implausible_frames += 1
            return False
        if self.is_protected and not self.end_to_end.check(data).is_valid:
            return False
        values = self.torque_message.decode_values(data)
        if not (self.is_protected or self._is_plausible(values[self._torque_at], cycle)):
            return False
        self._use(data, values, cycle)
        return True

    def follow(self, data: bytes, values: Sequence[float], cycle: int) -> None:
        """Take the values of the torque frame that follows the last one and was checked elsewhere."""
        if self.is_protected:
            self.end_to_end.follow()
        else:
            self._received_torque_Nm, self._received_cycle = values[self._torque_at], cycle
        self._use(data, values, cycle)

    def _is_plausible(self, torque: float, cycle: int) -> bool:
        last, self._received_torque_Nm = self._received_torque_Nm, torque
        # Two frames of one cycle, late and present, may lie a period apart.
        elapsed_s = max(1, cycle - self._received_cycle) * self._period_s
        self._received_cycle = cycle
        if last is not None and not abs(torque - last) <= self.torque_rate_Nm_s * elapsed_s:
            self.implausible_frames += 1
            return False
        return True

    def _use(self, data: bytes, values: Sequence[float], cycle: int) -> None:
        torque = self.torque_Nm = values[self._torque_at]
        self.sample_cycle = cycle
        if self._status_at is not None:
            self.status = _STATUSES[int(values[self._status_at]) & STATUS_BITS]
        elif self.status_in_header is not None:
            byte, shift = self.status_in_header
            self.status = _STATUSES[data[byte] >> shift & STATUS_BITS]
        elif self.torque_range_Nm:
            self.status = _judge_range(torque, self.torque_range_Nm)

    @property
    def values(self) -> tuple[float]:
        """Torque in use, Nm."""
        return (self.torque_Nm,)

    @property
    def cyclic_frame(self) -> CyclicFrame:
        """Describe the torque frame."""
        return CyclicFrame(self.torque_message, "torque", rate=self.torque_rate_Nm_s)

    @property
    def is_steady(self) -> bool:
        """Whether the last torque that came is in use, and the next is to follow it without loss."""
        if self.is_protected:
            return self.end_to_end.counter is not None
        return self._received_torque_Nm == self.torque_Nm and self._received_cycle == self.sample_cycle

    def skip(self, count: int) -> None:
        """Take so many torque frames for right that were taken elsewhere; the next one is compared with none."""
        if self.is_protected:
            self.end_to_end.skip(count)
        self._received_torque_Nm = None

    def miss(self) -> None:
        """Note a cycle in which no torque came."""
        self.end_to_end.miss()

    def accept_status(self, data: bytes, cycle: int) -> bool:  # noqa: ARG002 (as of all frames)
        """Take one status frame; False when it has the wrong length or fails its check and changes nothing."""
        message, receiver, at = self.status_message, self._status_receiver, self._slow_status_at
        if message is None or receiver is None or at is None or len(data) != message.length:
            return False
        is_valid = receiver.check(data).is_valid
        if is_valid:
            self.status = _STATUSES[int(message.decode_values(data)[at]) & STATUS_BITS]
        return is_valid

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
