"""What the devices send at one time, handed to the bus at once: a system call costs as much as some frames."""

from adacd_hil.wire.bus import Bus


class Departure:
    """Gathers frames until they are let go."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._frames: list[tuple[int, bytes]] = []

    def send(self, can_id: int, data: bytes) -> None:
        """Let a frame wait for the others."""
        self._frames.append((can_id, data))

    def go(self) -> None:
        """Send what waits. Raises BusError; what could not be sent is dropped, as by a controller that is reset."""
        if self._frames:
            frames, self._frames = self._frames, []
            self._bus.send_all(frames)
