"""What a real adapter does and the embedded bus doesn't: a bounded transmit queue that waits for acknowledgement.

A CAN controller repeats a frame until some node acknowledges it. With nobody there (power off, cable out, emergency
stop) the frames behind it wait in the interface's queue, up to `txqueuelen` of them; then sending fails. They wait for
as long as the interface is up and go out, in order, when the bus returns, however old they are (almond-bot/axol#187).
"""

from collections import deque

from adacd_hil.wire.bus import Bus, Frame, InterfaceDownError, TransmitQueueError
from adacd_hil.wire.lockstep_bus import DEFAULT_QUEUE_LENGTH

MAX_LENGTH = 512


class QueuedBus(Bus):
    """Wraps one end of a bus. Nothing waits: a queue that is full fails at once, where SocketCAN fails after 50 ms."""

    def __init__(self, bus: Bus, length: int = DEFAULT_QUEUE_LENGTH) -> None:
        """Hold up to `length` frames, 1…512. Raises ValueError."""
        if not 1 <= length <= MAX_LENGTH:
            raise ValueError(f"length of the transmit queue = {length} frames is not within 1…{MAX_LENGTH}")
        self.channel = bus.channel
        self._bus = bus
        self._length = length
        self._waiting: deque[tuple[int, bytes]] = deque()
        self._is_acknowledged = True
        self._is_up = True
        self._is_dead = False  # the interface has been down since the last recovery

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

    @property
    def is_up(self) -> bool:
        """Whether the interface is up; taking it down drops what waits."""
        return self._is_up

    @is_up.setter
    def is_up(self, is_up: bool) -> None:
        self._is_up = is_up
        if not is_up:
            self._is_dead = True
            self._waiting.clear()

    def _drain(self) -> None:
        # One at a time: a device that receives may answer, switch, or take the interface down.
        while self._waiting and self._is_acknowledged:
            self._bus.send(*self._waiting.popleft())

    def _require_alive(self) -> None:
        if self._is_dead:
            state = "was down and is up again" if self._is_up else "is down"
            raise InterfaceDownError(f"interface {self.channel} {state}")

    def send(self, can_id: int, data: bytes) -> None:
        """Send, or queue while nobody acknowledges. Raises TransmitQueueError, InterfaceDownError, BusError."""
        self._require_alive()
        if len(self._waiting) >= self._length:
            raise TransmitQueueError(f"transmit queue of {self.channel} is full with {self._length} frames")
        self._waiting.append((can_id, bytes(data)))
        self._drain()

    def receive(self, timeout_s: float) -> Frame | None:
        """Return the next frame, or None after `timeout_s`. Raises InterfaceDownError, BusError."""
        self._require_alive()
        return self._bus.receive(timeout_s)

    def recover(self) -> None:
        """Drop what waits and what was received. Raises InterfaceDownError while the interface is down."""
        if not self._is_up:
            raise InterfaceDownError(f"interface {self.channel} is down")
        self._waiting.clear()
        self._is_dead = False
        self._bus.recover()

    def close(self) -> None:
        """Close the bus behind it. What waits is the interface's, and stays."""
        self._bus.close()
