"""A bus end that remembers what passed, so that the log holds every frame both ways."""

from collections.abc import Sequence

from adacd_hil.clock import Clock
from adacd_hil.wire.bus import Bus, BusOffError, Frame, QueueBytes


class Tap(Bus):
    """Wraps a bus; `take` returns and forgets the frames since the last call, oldest first, True for sent.

    `held_ns` stamps sent frames instead of the clock when it is set: the cycle has just read the clock itself.
    """

    def __init__(self, bus: Bus, clock: Clock) -> None:
        self.channel = bus.channel
        self._bus = bus
        self._clock = clock
        self._passed: list[tuple[bool, Frame]] = []
        self._unread: Frame | None = None
        self.held_ns: int | None = None

    @property
    def waiting_frames(self) -> tuple[int, ...]:
        """Identifiers of what was sent and would be overtaken by SYNC, as far as the bus behind it knows."""
        return self._bus.waiting_frames

    @property
    def frames_lost(self) -> int:
        """Count of received frames that the bus behind it knows to have dropped."""
        return self._bus.frames_lost

    def queue_bytes(self) -> QueueBytes:
        """Look at how much waits in the bus behind it."""
        return self._bus.queue_bytes()

    def send(self, can_id: int, data: bytes) -> None:
        """Send and remember a frame. Raises BusError."""
        # Remembered first: on the embedded bus the answers come while `send` runs.
        t_ns = self._clock.now_ns() if self.held_ns is None else self.held_ns
        self._passed.append((True, Frame(can_id, data, t_ns)))
        self._bus.send(can_id, data)

    def send_all(self, frames: Sequence[tuple[int, bytes]]) -> None:
        """Send and remember some frames. Raises BusError."""
        t_ns = self._clock.now_ns() if self.held_ns is None else self.held_ns
        self._passed += [(True, Frame(can_id, data, t_ns)) for can_id, data in frames]
        self._bus.send_all(frames)

    def receive(self, timeout_s: float) -> Frame | None:
        """Receive and remember a frame. Raises BusError."""
        if self._unread is not None:
            unread, self._unread = self._unread, None
            return unread
        try:
            frame = self._bus.receive(timeout_s)
        except BusOffError as error:
            self._passed.append((False, error.frame))
            raise
        if frame is not None:
            self._passed.append((False, frame))
        return frame

    def unread(self, frame: Frame) -> None:
        """Put a received frame back: it is the next one to be received."""
        self._unread = frame

    def take(self) -> list[tuple[bool, Frame]]:
        """Return the frames since the last call."""
        passed, self._passed = self._passed, []
        return passed

    def recover(self) -> None:
        """Drop everything queued in the bus behind it; what has passed stays. Raises BusError."""
        self._unread = None
        self._bus.recover()

    def close(self) -> None:
        """Close the bus behind it."""
        self._bus.close()
