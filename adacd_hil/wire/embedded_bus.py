"""The bus of a host and devices in one process, without threads: a device handles a frame before `send` returns."""

from collections import deque
from collections.abc import Callable

from adacd_hil.clock import Clock
from adacd_hil.wire.bus import Bus, Frame


class EmbeddedBus(Bus):
    """The host's end of a bus within one process; the device uses `attach` and `deliver`.

    Frames that the device sends during the host's `send` are in the host's queue when `send` returns. No frame can come
    later, so `receive` never waits.
    """

    def __init__(self, clock: Clock) -> None:
        self.channel = "embedded"
        self._clock = clock
        self._received: deque[Frame] = deque()
        self._device: Callable[[Frame], None] | None = None

    def attach(self, device: Callable[[Frame], None]) -> None:
        """Register the function that receives the host's frames, in place of an earlier one."""
        self._device = device

    def deliver(self, can_id: int, data: bytes, is_error: bool = False) -> None:
        """Send a frame from the device to the host; is_error: an error frame, as the host's controller reports it."""
        self._received.append(Frame(can_id, data, self._clock.now_ns(), is_error))

    def send(self, can_id: int, data: bytes) -> None:
        """Send a frame to the device, which has handled it when this returns; drop it without a device."""
        if self._device is not None:
            self._device(Frame(can_id, data, self._clock.now_ns()))

    def receive(self, timeout_s: float) -> Frame | None:  # noqa: ARG002 (the protocol's signature)
        """Return the next frame, or None; doesn't wait."""
        return self._received.popleft() if self._received else None

    def recover(self) -> None:
        """Drop the frames that the host has not read."""
        self._received.clear()

    def close(self) -> None:
        """Disconnect the device; later frames of the host are dropped."""
        self._device = None
