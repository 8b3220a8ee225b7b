"""Any interface that python-can offers, if it does not echo own frames."""

import difflib
from typing import Any

import can

from adacd_hil.clock import Clock
from adacd_hil.wire.bus import BusError, BusMissingError, Frame

_ECHOING_INTERFACES = ("udp_multicast",)


class PythonCanBus:
    """Any other python-can interface."""

    def __init__(self, interface: str, channel: str, clock: Clock, bitrate: int | None = None) -> None:
        """Open it, at `bitrate` bit/s where the interface sets one. Raises BusMissingError."""
        if interface in _ECHOING_INTERFACES:
            raise BusMissingError(f"interface {interface} echoes own frames and can't carry a cycle; use socketcan")
        if interface not in can.VALID_INTERFACES:
            nearest = difflib.get_close_matches(interface, can.VALID_INTERFACES, n=1)
            hint = f"; did you mean {nearest[0]!r}?" if nearest else ""
            raise BusMissingError(f"unknown interface {interface!r}{hint}")
        self.channel = channel
        self._clock = clock
        try:
            options: dict[str, Any] = {} if bitrate is None else {"bitrate": bitrate}
            self._bus = can.Bus(channel, interface=interface, receive_own_messages=False, **options)
        except (OSError, can.CanError, ValueError) as error:
            raise BusMissingError(f"interface {interface}, channel {channel}: {error}") from None

    def send(self, can_id: int, data: bytes) -> None:
        """Send a frame. Raises BusError."""
        try:
            self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        except (OSError, can.CanError) as error:
            raise BusError(f"sending on {self.channel}: {error}") from None

    def receive(self, timeout_s: float) -> Frame | None:
        """Return the next frame, or None after `timeout_s`. Raises BusError."""
        try:
            message = self._bus.recv(timeout_s)
        except (OSError, can.CanError) as error:
            raise BusError(f"receiving on {self.channel}: {error}") from None
        if message is None:
            return None
        return Frame(message.arbitration_id, bytes(message.data), self._clock.now_ns(), message.is_error_frame)

    def close(self) -> None:
        """Shut the interface down."""
        self._bus.shutdown()
