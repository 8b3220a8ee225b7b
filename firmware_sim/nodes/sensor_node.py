"""An emulated joint torque sensor: a CiA 404 analogue input whose process value is the torque in the contract's LSB.

The sensor sends the value on every SYNC. If the frame has an end-to-end header, the header's status carries the low
bits of 0x6150, so that a frame shows the overload that spoils its value.

In Operational, where a host uses the measurement, SDO only clears the error history. A master requests autozero in
Pre-operational; the sensor takes its samples at the following SYNCs, in any state.

Source: CiA 404, objects 0x6125, 0x6150, 0x9130.
"""

import math
from collections.abc import Callable

from adacd_hil.wire.codec import Codec
from firmware_sim.canopen.object_dictionary import Abort, refuse
from firmware_sim.nodes.device import Application, EmulatedDevice

STATUS_NOT_VALID = 0x01
STATUS_POSITIVE_OVERLOAD = 0x02
STATUS_NEGATIVE_OVERLOAD = 0x04
AUTOZERO_SIGNATURE = int.from_bytes(b"zero", "little")
"""The value that 0x6125 accepts."""
AUTOZERO_SAMPLES = 64
"""Samples whose mean becomes the zero: an eighth of the noise of one."""

_EVENTS = frozenset({(0x6150, 1), (0x1001, 0)})


class SensorNode(Application):
    """One torque sensor on the bus. It takes no commands; odd SYNCs cause EMCYs only."""

    def __init__(
        self,
        device: EmulatedDevice,
        codec: Codec,
        number: int,
        converter_ends: tuple[int, int],
        temperature_C: Callable[[], float],
        count_Nm: float,
    ) -> None:
        """Connect the node to its device, whose application it becomes.

        `number`: 1 or 2, as in the DBC's names. `converter_ends`: lowest and highest counts that the converter gives,
        which mean overload. `temperature_C`: of the joint, 0x2111. `count_Nm`: torque sent for a converter's count.
        Raises CodecError when the DBC lacks the sensor's torque.
        """
        self.device = device
        self.has_news = False
        """Whether a status change has not been sent yet."""
        self._pdos = device.pdos
        self._lowest_count, self._highest_count = converter_ends
        message = codec.message(f"Sensor{number}Torque")
        signal = message.values[message.place("torque")]
        per_Nm = round(1.0 / signal.scale)
        is_exact = math.isclose(per_Nm * signal.scale, 1.0, rel_tol=1e-12)  # most contracts have decimal fractions
        self._lsbs_per_count = count_Nm * per_Nm if is_exact else count_Nm / signal.scale
        self._ends = signal.raw_low, signal.raw_high
        self._status = STATUS_NOT_VALID  # not measured yet
        self._torque = self._counts = 0
        self._zero_counts = 0.0
        self._autozero_left = self._autozero_sum = 0
        self._error_bits = 0
        device.serve(0x2000, 1, lambda: codec.wire_version)
        device.serve(0x2000, 2, lambda: codec.layout_digest)
        device.serve(0x2110, 1, lambda: round(self._counts * self._lsbs_per_count))
        device.serve(0x2111, 0, lambda: max(-0x8000, min(0x7FFF, round(100.0 * temperature_C()))))
        device.serve(0x6150, 1, lambda: self._status)
        device.serve(0x9130, 1, lambda: self._torque)
        device.watch(0x6125, 1, check=self._start_autozero)
        device.watch(0x6131, 1, check=self._check_unchanged(0x6131))
        device.watch(0x6132, 1, check=self._check_unchanged(0x6132))
        self._pdos.events = _EVENTS
        self._pdos.header_status = lambda: self._status
        device.attach(self)

    def on_sync(self, counts: int) -> None:
        """Take the torque sampled at this SYNC, in the converter's counts; update status and a running autozero.

        The mean of `AUTOZERO_SAMPLES` samples becomes the zero of the torque that is sent, from the last of them on. A
        torque beyond the signal's range is limited to it.
        """
        status = self._error_bits
        if counts >= self._highest_count:
            status |= STATUS_POSITIVE_OVERLOAD | STATUS_NOT_VALID
        elif counts <= self._lowest_count:
            status |= STATUS_NEGATIVE_OVERLOAD | STATUS_NOT_VALID
        if status != self._status:
            self._status = status
            self.has_news = True
        if self._autozero_left:
            self._autozero(counts)
        torque = round((counts - self._zero_counts) * self._lsbs_per_count)
        lowest, highest = self._ends
        self._torque = torque if lowest <= torque <= highest else lowest if torque < lowest else highest
        self._counts = counts
        if self._pdos.compare():
            self.has_news = True

    def set_error(self, bits: int) -> None:
        """Set error bits of the status 0x6150 from the next sample on; 0: no error."""
        self._error_bits = bits

    def poll(self, t_ns: int) -> int:
        """Act on timers that are due, send event-driven frames of new values; return when the next timer is due.

        Both times are ns of the bench, not of the node's own clock.
        """
        clock = self.device.clock
        t_ns = clock.own_ns(t_ns)
        due_ns = self.device.poll(t_ns)
        if self.has_news:
            self.has_news = False
            self._pdos.notify()
        return clock.bench_ns(min(due_ns, self._pdos.poll(t_ns)))

    def note_error(self) -> None:
        """Set `has_news`: the error register may have changed, so the next `poll` sends the status frame."""
        self.has_news = True

    @property
    def is_at_work(self) -> bool:
        """Whether the sensor is in Operational, where a host relies on its measurement."""
        return self.device.is_operational

    def restart_node(self, is_node_reset: bool) -> None:
        """With `is_node_reset`, forget zero, torque and a running autozero, and mark the value as invalid.

        At a reset of the communication do nothing.
        """
        if is_node_reset:
            self._status = STATUS_NOT_VALID
            self._torque = self._counts = 0
            self._zero_counts = 0.0
            self._autozero_left = 0

    def _start_autozero(self, signature: int) -> None:
        if signature != AUTOZERO_SIGNATURE:
            refuse(Abort.CANNOT_STORE)
        self._autozero_left = AUTOZERO_SAMPLES
        self._autozero_sum = 0

    def _autozero(self, counts: int) -> None:
        self._autozero_sum += counts
        self._autozero_left -= 1
        if self._autozero_left == 0:
            self._zero_counts = self._autozero_sum / AUTOZERO_SAMPLES

    def _check_unchanged(self, index: int) -> Callable[[int], None]:
        """Return a write check for sub-index 1 of an object that refuses all but the present value (VALUE_RANGE)."""

        def check(value: int) -> None:
            if value != self.device.value(index, 1):
                refuse(Abort.VALUE_RANGE)

        return check
