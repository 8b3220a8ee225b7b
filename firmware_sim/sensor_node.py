"""An emulated joint torque sensor: a CiA 404 analogue input whose process value is the torque in µNm.

On every SYNC it sends the value under an end-to-end header; the header's status nibble carries the low bits of
0x6150, so that an overload is seen in the very frame that it spoils. Source: CiA 404, objects 0x6125, 0x6150, 0x9130.
"""

from collections.abc import Callable

from adacd_hil.wire.codec import Codec
from firmware_sim.object_dictionary import EMCY_HEARTBEAT, NEVER_NS, Abort, Device, refuse
from firmware_sim.sensing import TORQUE_COUNTS, TORQUE_LSB_NM

STATUS_NOT_VALID = 0x01
STATUS_POSITIVE_OVERLOAD = 0x02
STATUS_NEGATIVE_OVERLOAD = 0x04
AUTOZERO_SIGNATURE = int.from_bytes(b"zero", "little")
"""What 0x6125 takes."""
AUTOZERO_SAMPLES = 64
"""Samples whose mean becomes the zero: an eighth of the noise of one."""

_LOWEST_COUNT, _HIGHEST_COUNT = TORQUE_COUNTS
_UNM_PER_COUNT = TORQUE_LSB_NM * 1e6


class SensorNode:
    """One torque sensor on the bus."""

    def __init__(self, device: Device, codec: Codec, number: int, send: Callable[[int, bytes], None]) -> None:
        """Connect the node to its device. `number`: 1 or 2, as in the DBC's names."""
        self.device = device
        self.has_news = False
        """Whether the status frame is due because of a change."""
        self._send = send
        self._message = codec.message(f"Sensor{number}Torque")
        self._torque_id = self._message.can_id
        self._status_id = codec.message(f"Sensor{number}Status").can_id
        self._frame = bytes(self._message.length)
        self._sender = self._message.sender()
        self._status = STATUS_NOT_VALID  # nothing measured yet
        self._torque_uNm = 0
        self._zero_counts = 0.0
        self._autozero_left = self._autozero_sum = 0
        self._is_sending_torque = self._is_sending_status = False
        self._status_period_ns = self._status_inhibit_ns = 0
        self._status_due_ns = NEVER_NS
        self._status_allowed_ns = 0
        device.serve(0x2000, 1, lambda: codec.wire_version)
        device.serve(0x2000, 2, lambda: codec.layout_digest)
        device.serve(0x2100, 1, lambda: self._frame[0])
        device.serve(0x2100, 2, lambda: self._frame[1])
        device.serve(0x6150, 1, lambda: self._status)
        device.serve(0x9130, 1, lambda: self._torque_uNm)
        device.watch(0x6125, 1, check=self._start_autozero)
        device.watch(0x6131, 1, check=self._check_unchanged(0x6131))
        device.watch(0x6132, 1, check=self._check_unchanged(0x6132))
        device.watch(0x1801, 3, self._set_status_inhibit)
        device.watch(0x1801, 5, self._set_status_period)
        self._set_status_period(device.value(0x1801, 5))
        device.attach(self)

    def on_sync(self, counts: int) -> None:
        """Take the torque that was sampled at this SYNC, in the converter's counts."""
        status = 0
        if counts >= _HIGHEST_COUNT:
            status = STATUS_POSITIVE_OVERLOAD | STATUS_NOT_VALID
        elif counts <= _LOWEST_COUNT:
            status = STATUS_NEGATIVE_OVERLOAD | STATUS_NOT_VALID
        if status != self._status:
            self._status = status
            self.has_news = True
        if self._autozero_left:
            self._autozero(counts)
        self._torque_uNm = round((counts - self._zero_counts) * _UNM_PER_COUNT)

    def send_torque(self) -> None:
        """Send what was sampled at the last SYNC, protected, with the status in the header."""
        if self._is_sending_torque:
            frame = self._message.encode_raw(self._torque_uNm)
            frame[1] = self._status << 4
            self._frame = protected = self._sender.protect(frame)
            self._send(self._torque_id, protected)

    def poll(self, t_ns: int) -> int:
        """Do what is due by time; return when something is due next."""
        due_ns = self.device.poll(t_ns)
        if self._is_sending_status:
            if (self.has_news and t_ns >= self._status_allowed_ns) or t_ns >= self._status_due_ns:
                self._send_status(t_ns)
            due_ns = min(due_ns, self._status_allowed_ns if self.has_news else self._status_due_ns)
        return due_ns

    def leave_operational(self, t_ns: int) -> None:
        """Do nothing: the frames end by themselves."""

    def lose_heartbeat(self, t_ns: int) -> None:
        """Report it."""
        self.has_news = True
        self.device.report_error(EMCY_HEARTBEAT, t_ns)

    def find_heartbeat(self, t_ns: int) -> None:
        """Clear the error."""
        self.has_news = True
        self.device.clear_error(t_ns)

    def refresh(self) -> None:
        """Take over which PDOs are exchanged; a new Operational begins with a status frame."""
        self._is_sending_torque = self.device.is_pdo_active(0x1800)
        was_sending = self._is_sending_status
        self._is_sending_status = self.device.is_pdo_active(0x1801)
        self.has_news |= self._is_sending_status and not was_sending

    def restart(self, is_node_reset: bool) -> None:
        """Count the frames anew; a node reset also forgets the zero."""
        self._sender = self._message.sender()
        if is_node_reset:
            self._status = STATUS_NOT_VALID
            self._torque_uNm = 0
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
        """Make a check that lets an object be written with the value that it has only."""

        def check(value: int) -> None:
            if value != self.device.value(index, 1):
                refuse(Abort.VALUE_RANGE)

        return check

    def _send_status(self, t_ns: int) -> None:
        self.has_news = False
        self._status_allowed_ns = t_ns + self._status_inhibit_ns
        self._status_due_ns = t_ns + self._status_period_ns if self._status_period_ns else NEVER_NS
        self._send(self._status_id, bytes([self._status, self.device.error_register]))

    def _set_status_inhibit(self, tenths_ms: int) -> None:
        self._status_inhibit_ns = tenths_ms * 100_000

    def _set_status_period(self, period_ms: int) -> None:
        self._status_period_ns = period_ms * 1_000_000
        self.has_news = True
