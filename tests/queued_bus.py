"""What a real adapter does and the embedded bus doesn't: a bounded transmit queue that waits for acknowledgement.

A CAN controller repeats a frame until some node acknowledges it. With nobody there (power off, cable out, emergency
stop) the frames behind it wait in the interface's queue, up to `txqueuelen` of them; then sending fails. They wait for
as long as the interface is up and go out, in order, when the bus returns, however old they are (almond-bot/axol#187).
"""

from collections import deque

from adacd_hil.wire.bus import Bus, Frame, TransmitQueueError


class QueuedBus(Bus):
    """Wraps one end of a bus; up to `length` frames wait. A full queue fails at once, that of SocketCAN after 50 ms."""

    def __init__(self, bus: Bus, length: int) -> None:
        self.channel = bus.channel
        self._bus = bus
        self._length = length
        self._waiting: deque[tuple[int, bytes]] = deque()
        self._is_acknowledged = True

    @property
    def waiting_frames(self) -> tuple[int, ...]:
        """Identifiers of the frames in the transmit queue, oldest first."""
        return tuple(can_id for can_id, _ in self._waiting)

    @property
    def is_acknowledged(self) -> bool:
        """Whether some node acknowledges what is sent; when one begins to, all that waits goes out, oldest first."""
        return self._is_acknowledged

    @is_acknowledged.setter
    def is_acknowledged(self, is_acknowledged: bool) -> None:
        self._is_acknowledged = is_acknowledged
        self._drain()

    def _drain(self) -> None:
        # One at a time: a device that receives may answer or switch.
        while self._waiting and self._is_acknowledged:
            self._bus.send(*self._waiting.popleft())

    def send(self, can_id: int, data: bytes) -> None:
        """Send, or queue while nobody acknowledges. Raises TransmitQueueError, BusError."""
        if len(self._waiting) >= self._length:
            raise TransmitQueueError(f"transmit queue of {self.channel} is full with {self._length} frames")
        self._waiting.append((can_id, bytes(data)))
        self._drain()

    def receive(self, timeout_s: float) -> Frame | None:
        return self._bus.receive(timeout_s)

    def recover(self) -> None:
        """Drop what waits and what was received."""
        self._waiting.clear()
        self._bus.recover()

    def close(self) -> None:
        """Close the bus behind it. What waits is the interface's, and stays."""
        self._bus.close()
