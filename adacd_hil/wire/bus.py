"""The bus interface: one Protocol for SocketCAN, the embedded bus, and every other python-can interface.

A tap around a bus records every frame in both directions, for the log.
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from adacd_hil.clock import Clock


class BusError(OSError):
    """The bus failed while running; one line."""


class BusMissingError(BusError):
    """The bus can't be opened; the message is one line."""


class TransmitQueueError(BusError):
    """The transmit queue stays full: no node acknowledges, or it is too short. Frames in it are outdated."""


class SilenceError(BusError):
    """No device answered a SYNC in lockstep, where the run can't continue without an answer."""


class InterfaceDownError(BusError):
    """The interface was taken down or has vanished. This bus end stays closed until `recover`."""


class BusOffError(BusError):
    """The controller has left the bus after too many errors. `frame` is the error frame that reported it."""

    def __init__(self, message: str, frame: "Frame") -> None:
        super().__init__(message)
        self.frame = frame


class QueueBytes(NamedTuple):
    """Fill of a bus end's queues, in bytes of the kernel's memory: about 700 a frame."""

    received: int
    sent: int


NOTHING_QUEUED = QueueBytes(0, 0)


class Frame(NamedTuple):
    """One CAN frame. t_ns: host time of its reception or transmission.

    The identifier of an error frame holds its error class; `adacd_hil.wire.error_frames` decodes it.
    """

    can_id: int
    data: bytes
    t_ns: int
    is_error: bool = False


class Bus(Protocol):
    """One end of a CAN bus. Subclasses may leave out methods that have a body here."""

    channel: str

    @property
    def waiting_frames(self) -> tuple[int, ...]:
        """Identifiers of frames handed over but not yet on the bus, which SYNC would overtake now; () if unknown."""
        return ()

    @property
    def frames_lost(self) -> int:
        """Number of received frames so far that were dropped as this end didn't read them in time; 0 if unknown."""
        return 0

    def queue_bytes(self) -> QueueBytes:
        """Return the fill of both queues, zeros if this end has none; a system call if the kernel keeps them."""
        return NOTHING_QUEUED

    def send(self, can_id: int, data: bytes) -> None:
        """Queue a frame for transmission. Raises BusError, such as TransmitQueueError and InterfaceDownError."""

    def send_all(self, frames: Sequence[tuple[int, bytes]]) -> None:
        """Queue several frames in this order, together if possible.

        Raises BusError, such as TransmitQueueError and InterfaceDownError.
        """
        for can_id, data in frames:
            self.send(can_id, data)

    def receive(self, timeout_s: float) -> Frame | None:
        """Return the next frame, or None after `timeout_s`.

        Raises BusError, such as BusOffError and InterfaceDownError.
        """

    def recover(self) -> None:
        """Drop all queued frames of both directions, here and in the interface, so that no outdated frame passes.

        Raises BusError when that isn't possible yet; may be called again.
        """

    def close(self) -> None:
        """Release the bus; ignore a second call."""


class Tap(Bus):
    """Records the frames of a bus; `take_passed` returns those since the last call, oldest first, True for sent ones.

    `held_ns`, if set, is the stamp of sent frames instead of a new reading of the clock.
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
        """Identifiers of sent frames that SYNC would overtake, as far as the wrapped bus knows."""
        return self._bus.waiting_frames

    @property
    def frames_lost(self) -> int:
        """Number of received frames that the wrapped bus has dropped."""
        return self._bus.frames_lost

    def queue_bytes(self) -> QueueBytes:
        """Return the fill of the wrapped bus's queues."""
        return self._bus.queue_bytes()

    def send(self, can_id: int, data: bytes) -> None:
        """Record and send a frame; it stays recorded if the wrapped bus can't send it, which raises BusError."""
        # Recorded before sending: on the embedded bus the answers come while `send` runs.
        t_ns = self._clock.now_ns() if self.held_ns is None else self.held_ns
        self._passed.append((True, Frame(can_id, data, t_ns)))
        self._bus.send(can_id, data)

    def send_all(self, frames: Sequence[tuple[int, bytes]]) -> None:
        """Record and send several frames with one stamp.

        Raises BusError if the wrapped bus can't send them; they stay recorded.
        """
        t_ns = self._clock.now_ns() if self.held_ns is None else self.held_ns
        self._passed += [(True, Frame(can_id, data, t_ns)) for can_id, data in frames]
        self._bus.send_all(frames)

    def receive(self, timeout_s: float) -> Frame | None:
        """Return the next frame, or None after `timeout_s`, and record it unless it was put back by `unread`.

        Raises BusError of the wrapped bus; the error frame of a BusOffError is recorded, too.
        """
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
        """Put a received frame back, one at most; the next `receive` returns it and doesn't record it again."""
        self._unread = frame

    def take_passed(self) -> list[tuple[bool, Frame]]:
        """Return the frames recorded since the last call, oldest first, and forget them.

        In a pair with the frame: True if it was sent, False if received.
        """
        passed, self._passed = self._passed, []
        return passed

    def recover(self) -> None:
        """Drop all queued frames of the wrapped bus and the one put back; recorded ones stay.

        Raises BusError when the wrapped bus can't recover yet.
        """
        self._unread = None
        self._bus.recover()

    def close(self) -> None:
        """Close the wrapped bus."""
        self._bus.close()
