"""A device with one frame per SYNC: its checks, and the parts that drives and sensors share."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence

from adacd_hil.device.arm_watch import PATIENCE_PERIODS
from adacd_hil.device.profile import PlacedDevice
from adacd_hil.device.value_bounds import ValueBound, value_bounds
from adacd_hil.records import FaultReason
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.codec import Codec


class CyclicDevice(ABC):
    """A device that answers every SYNC with one frame, and may send its status in another.

    is_protected: whether the cyclic frame carries an end-to-end header; else it is checked by plausibility. values:
    those in use, the main one first. sample_cycle: cycle of the values in use; -1 before the first.
    """

    def __init__(self, settings: Settings, codec: Codec, placed: PlacedDevice, cyclic: str, main: str) -> None:
        """`cyclic`: the cyclic frame. `main`: its signal that is checked for plausibility without end-to-end header.

        The status may be PATIENCE_PERIODS periods old, rounded up to whole cycles; any age without a period. Raises
        CodecError when the contract lacks the cyclic frame, or a frame lacks `main` or a bounded signal.
        """
        self.name = placed.name
        self._message = message = codec.message(f"{placed.name}{cyclic}")
        self.node_id = codec.node_id(message.name)
        self.can_id = message.can_id  # of its cyclic frame
        self.cyclic_length = message.length
        """Bytes of its cyclic frame."""
        self.is_protected = message.is_protected
        self.end_to_end = message.receiver()
        self.status_message = codec.messages.get(f"{placed.name}Status")
        self._status_receiver = None if self.status_message is None else self.status_message.receiver()
        self.values: tuple[float, ...] = ()
        self.sample_cycle = -1
        self.implausible_frames = 0
        self._period_s = settings.bus.period_s
        self._main_at = message.place(main)
        self._received: float | None = None  # main value of the last frame that came
        self._received_cycle = 0
        status = placed.pdo("Status")
        self.status_age_limit = math.inf
        """Greatest permitted age of its status, in cycles; infinite without a status period."""
        if status is not None and status.event_timer_ms:
            self.status_age_limit = math.ceil(PATIENCE_PERIODS * status.event_timer_ms * 1e-3 / self._period_s)
        self._cyclic_bounds = value_bounds(placed.pdo(cyclic), message)
        self._status_bounds = value_bounds(status, self.status_message)
        self.has_bounds = bool(self._cyclic_bounds or self._status_bounds)
        """Whether its profile bounds a value."""
        self._cyclic_values: Sequence[float] = ()
        self._status_values: Sequence[float] = ()
        self.status_cycle = -1
        """Cycle of the last status frame; -1 before the first."""

    def accept_cyclic(self, data: bytes, cycle: int) -> bool:
        """Take one cyclic frame of `cycle`; return False for a wrong length or header, or no plausible main value.

        Then the values in use stay. A protected frame is checked by its header alone, whose status is counted in
        `end_to_end`. An unprotected frame is compared with the last one that came, usable or not; the first one passes.
        A wrong length or an implausible value is counted in `implausible_frames`.
        """
        if len(data) != self.cyclic_length:
            self.implausible_frames += 1
            return False
        if self.is_protected:
            if not self.end_to_end.check(data).is_valid:
                return False
            values = self._message.decode_values(data)
        else:
            values = self._message.decode_values(data)
            last, self._received = self._received, values[self._main_at]
            cycles, self._received_cycle = cycle - self._received_cycle, cycle
            if last is not None and not self._is_plausible(values, last, cycles):
                self.implausible_frames += 1
                return False
        self._cyclic_values = values
        self._use(data, values, cycle)
        return True

    def accept_status(self, data: bytes, cycle: int) -> bool:
        """Take one status frame of `cycle`; return False, and ignore it, if its length or end-to-end header is wrong.

        The receiver counts a wrong header. False also for a device without a status frame.
        """
        message, receiver = self.status_message, self._status_receiver
        if message is None or receiver is None or len(data) != message.length:
            return False
        is_valid = receiver.check(data).is_valid
        if is_valid:
            self._status_values, self.status_cycle = message.decode_values(data), cycle
            self._use_status(self._status_values, cycle)
        return is_valid

    @abstractmethod
    def fault(self, cycle: int, is_enabled: bool) -> FaultReason:
        """Return the device's fault in a cycle, NONE without one; `is_enabled`: whether all drives are enabled."""

    def has_excess(self, cycle: int) -> bool:
        """Return whether a bounded value is outside its bounds, or a status with bounded values missing or too old."""
        return self.has_bounds and (self._is_status_old(cycle) or any(self._excesses()))

    def describe_excess(self, cycle: int) -> list[str]:
        """Return a line per bounded value outside its bounds, and one for a missing or old status with such values."""
        lines = self.describe_known_excess()
        if self._is_status_old(cycle):
            lines.append(f"{self.name}: no status for more than {self.status_age_limit:g} cycles")
        return lines

    def describe_known_excess(self) -> list[str]:
        """Return a line per bounded value that is outside its bounds in the newest valid frame; none before one."""
        return [f"{self.name}: {bound.describe(values)}" for bound, values in self._excesses()]

    def _is_status_old(self, cycle: int) -> bool:
        is_old = not self._status_values or cycle - self.status_cycle > self.status_age_limit
        return bool(self._status_bounds) and is_old

    def _excesses(self) -> Iterator[tuple[ValueBound, Sequence[float]]]:
        """Yield (bound, values of its frame) for each bounded value outside its bounds in the newest valid frame."""
        for bounds, values in (
            (self._cyclic_bounds, self._cyclic_values),
            (self._status_bounds, self._status_values),
        ):
            for bound in bounds if values else ():
                if not bound.is_within(values):
                    yield bound, values

    @abstractmethod
    def _is_plausible(self, values: Sequence[float], last: float, cycles: int) -> bool:
        """Return whether a frame's main value can follow `last`, that of the frame before, after so many cycles."""

    @abstractmethod
    def _use(self, data: bytes, values: Sequence[float], cycle: int) -> None:
        """Store the values of a checked cyclic frame, and its cycle, as those in use."""

    @abstractmethod
    def _use_status(self, values: Sequence[float], cycle: int) -> None:
        """Store the status of a checked status frame as the one in use."""

    def miss(self) -> None:
        """Count a cycle in which no cyclic frame came, in `end_to_end`."""
        self.end_to_end.miss()
