"""The joint torque sensor: process value, status, checks.

A saturated sensor repeats its value and goes on counting: its torque is fresh and its status says overload. A silent
one ages. Torque is the device's own, with its own zero: sign and tare belong to `adacd_hil.device.arm`. Source: CiA
404, clause 7.
"""

from collections.abc import Sequence
from enum import IntFlag

from adacd_hil.device.cyclic_device import CyclicDevice
from adacd_hil.device.profile import PlacedDevice
from adacd_hil.records import FaultReason
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.codec import Codec


class SensorStatus(IntFlag):
    """Bits of 0x6150, analogue input status."""

    NOT_VALID = 1
    POSITIVE_OVERLOAD = 2
    NEGATIVE_OVERLOAD = 4


STATUS_BITS = sum(SensorStatus)
_STATUSES = tuple(SensorStatus(bits) for bits in range(STATUS_BITS + 1))
USABLE = tuple(status for status in _STATUSES if not status & SensorStatus.NOT_VALID)
"""Statuses with which a torque may be used; an overloaded one is a bound."""


class TorqueSensor(CyclicDevice):
    """The torque sensor of joint 1 or 2."""

    def __init__(self, settings: Settings, codec: Codec, placed: PlacedDevice) -> None:
        """Raise CodecError when the contract lacks a message or signal."""
        super().__init__(settings, codec, placed, "Torque", "torque")
        self._torque_rate_Nm_s = placed.settings.plausibility.torque_rate_Nm_s
        self.torque_range_Nm = placed.settings.plausibility.torque_range_Nm
        """Torque in either direction from which the sensor counts as overloaded and not valid; 0: none.

        Only if its torque frame carries no status.
        """
        names = [signal.name for signal in self._message.values]
        self._status_at = names.index("status") if "status" in names else None
        profile = self._message.profile
        self.status_in_header = None if profile is None else profile.status_place
        self._slow_status_at = -1 if self.status_message is None else self.status_message.place("status")
        self.values = (0.0,)
        """Torque, Nm, as the device gives it: its sign, its own auto-zero, not tared."""
        self.status = SensorStatus(0)
        """Bits of both of its frames together: a sensor whose frames contradict each other isn't trusted.

        The bits of a status frame count until the next one. If the torque frame tells a status, too, bits that are new
        in a status frame don't count from the first to the second torque frame after it: a sensor may start with a
        status frame that it withdraws at once.
        """
        self._cyclic_bits = 0
        self._slow_bits = 0
        self._heard_bits = 0  # of the last status frame

    def fault(self, cycle: int, is_enabled: bool) -> FaultReason:  # noqa: ARG002 (as of all devices)
        """Return SENSOR if the status has NOT_VALID, or a bounded value is outside its bounds; else NONE.

        SENSOR also if a status with bounded values is missing or too old; NONE for an overload alone. `is_enabled` has
        no effect here.
        """
        if self.status not in USABLE or self.has_excess(cycle):
            return FaultReason.SENSOR
        return FaultReason.NONE

    def _is_plausible(self, values: Sequence[float], last: float, cycles: int) -> bool:
        # Two frames of one cycle, late and present, may lie a period apart.
        return abs(values[self._main_at] - last) <= self._torque_rate_Nm_s * (max(1, cycles) * self._period_s)

    def _use(self, data: bytes, values: Sequence[float], cycle: int) -> None:
        torque = values[self._main_at]
        self.values = (torque,)
        self.sample_cycle = cycle
        if self._status_at is not None:
            self._cyclic_bits = int(values[self._status_at]) & STATUS_BITS
        elif self.status_in_header is not None:
            byte, shift = self.status_in_header
            self._cyclic_bits = data[byte] >> shift & STATUS_BITS
        elif self.torque_range_Nm:
            self._cyclic_bits = _judge_range(torque, self.torque_range_Nm)
        else:
            self._slow_bits = self._heard_bits  # only the status frame carries it
        self.status = _STATUSES[self._cyclic_bits | self._slow_bits]
        self._slow_bits = self._heard_bits

    def _use_status(self, values: Sequence[float], cycle: int) -> None:  # noqa: ARG002 (as of all devices)
        self._heard_bits = int(values[self._slow_status_at]) & STATUS_BITS
        self._slow_bits &= self._heard_bits
        self.status = _STATUSES[self._cyclic_bits | self._heard_bits]


def _judge_range(torque: float, range_Nm: float) -> SensorStatus:
    """Return NOT_VALID and the overload's bit for a torque at or beyond the end of the range, else no bits."""
    if torque >= range_Nm:
        return SensorStatus.NOT_VALID | SensorStatus.POSITIVE_OVERLOAD
    if torque <= -range_Nm:
        return SensorStatus.NOT_VALID | SensorStatus.NEGATIVE_OVERLOAD
    return SensorStatus(0)
