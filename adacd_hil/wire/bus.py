"""Where frames enter and leave: one seam over SocketCAN, the embedded bus, and every other python-can interface.

The embedded bus joins host and emulator in one process, without threads: what the host sends is handled before `send`
returns. A tap around a bus remembers every frame that passes, both ways, for the log.
"""

from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

from adacd_hil.clock import Clock


class BusError(OSError):
    """The bus failed while running; one line."""


class BusMissingError(BusError):
    """The bus can't be opened; one line with what there is."""


class TransmitQueueError(BusError):
    """The transmit queue stays full: nobody acknowledges, or it is too short. What waits in it is old by then."""


class SilenceError(BusError):
    """No device answered a SYNC in lockstep, where nothing goes on without an answer."""


class InterfaceDownError(BusError):
    """The interface was taken down or has vanished. The bus end stays dead until `recover`."""


class BusOffError(BusError):
    """The controller has left the bus after too many errors. `frame` is the error frame that said so."""

    def __init__(self, message: str, frame: "Frame") -> None:
        super().__init__(message)
        self.frame = frame


class QueueBytes(NamedTuple):
    """What waits in a bus end's queues, in bytes of the kernel's memory: about 700 a frame."""

    received: int
    sent: int


NOTHING_QUEUED = QueueBytes(0, 0)


class Frame(NamedTuple):
    """One CAN frame. t_ns: host time of its reception or transmission.

    An error frame has the error class for its identifier; `adacd_hil.wire.kernel_frames` reads it.
    """

    can_id: int
    data: bytes
    t_ns: int
    is_error: bool = False


class Bus(Protocol):
    """One end of a CAN bus. Those that derive from it may leave what has a body here."""

    channel: str

    @property
    def waiting_frames(self) -> tuple[int, ...]:
        """Identifiers of what was sent and would be overtaken by SYNC now, as far as this end can know."""
        return ()

    @property
    def frames_lost(self) -> int:
        """Count of received frames that were dropped because this end didn't read them in time, as far as it knows."""
        return 0

    def queue_bytes(self) -> QueueBytes:
        """Look at how much waits to be read and to be sent; where the kernel keeps the queues, a system call."""
        return NOTHING_QUEUED

    def send(self, can_id: int, data: bytes) -> None:
        """Hand a frame to the bus. Raises BusError, of it TransmitQueueError and InterfaceDownError."""

    def send_all(self, frames: Sequence[tuple[int, bytes]]) -> None:
        """Hand some frames to the bus, in this order and at once where that is possible. Raises as `send`."""
        for can_id, data in frames:
            self.send(can_id, data)

    def receive(self, timeout_s: float) -> Frame | None:
        """Return the next frame, or None when none came within `timeout_s`.

        Raises BusError, of it BusOffError and InterfaceDownError.
        """

    def receive_some(self, timeout_s: float, most: int) -> list[Frame]:  # noqa: ARG002 (this one has no more at once)
        """Return the next frame and, up to `most` in all, those that are there with it; [] when none came in time.

        An error frame is returned alone. Raises as `receive`.
        """
        frame = self.receive(timeout_s)
        return [] if frame is None else [frame]

    def recover(self) -> None:
        """Drop everything queued both ways, here and in the interface, so that no old frame gets out or in.

        Raises BusError when that isn't possible yet; may be called again.
        """

    def close(self) -> None:
        """Release the bus; twice is once."""


class EmbeddedBus(Bus):
    """The host's end of a bus within one process; the device's end is `attach` and `deliver`.

    Frames that the device sends from within the host's `send` are in the host's queue when `send` returns. Waiting is
    pointless, so `receive` never does.
    """

    def __init__(self, clock: Clock) -> None:
        self.channel = "embedded"
        self._clock = clock
        self._received: deque[Frame] = deque()
        self._device: Callable[[Frame], None] | None = None

    def attach(self, device: Callable[[Frame], None]) -> None:
        """Connect the device's receiver."""
        self._device = device

    def deliver(self, can_id: int, data: bytes, is_error: bool = False) -> None:
        """Send from the device to the host, or report an error as the host's controller does."""
        self._received.append(Frame(can_id, data, self._clock.now_ns(), is_error))

    def send(self, can_id: int, data: bytes) -> None:
        """Hand a frame to the device; it has acted on it when this returns."""
        if self._device is not None:
            self._device(Frame(can_id, data, self._clock.now_ns()))

    def receive(self, timeout_s: float) -> Frame | None:  # noqa: ARG002 (the protocol's signature)
        """Return the next frame, or None."""
        return self._received.popleft() if self._received else None

    def receive_some(self, timeout_s: float, most: int) -> list[Frame]:  # noqa: ARG002 (the protocol's signature)
        """Return up to `most` frames."""
        return take_first(self._received, most)

    def recover(self) -> None:
        """Drop what the host has not read."""
        self._received.clear()

    def close(self) -> None:
        """Disconnect the device."""
        self._device = None


def take_first(received: deque[Frame], most: int) -> list[Frame]:
    """Take up to `most` frames off a queue, none behind an error frame and that one alone."""
    frames: list[Frame] = []
    while received and len(frames) < most:
        if received[0].is_error:
            return frames or [received.popleft()]
        frames.append(received.popleft())
    return frames


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

    def receive_some(self, timeout_s: float, most: int) -> list[Frame]:
        """Receive and remember frames that are there together. Raises BusError."""
        if self._unread is not None or most == 1:
            frame = self.receive(timeout_s)
            return [] if frame is None else [frame]
        try:
            frames = self._bus.receive_some(timeout_s, most)
        except BusOffError as error:
            self._passed.append((False, error.frame))
            raise
        self._passed += [(False, frame) for frame in frames]
        return frames

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
