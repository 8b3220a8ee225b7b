"""The devices' frames on their way to the bus: sent at once, or later where a fault delays them.

By SYNC, time stands still while the bench answers one, so the frames released within the next period go out together,
in the order of release. Marks tell a host in lockstep when each frame is released (`adacd_hil.wire.time_marks`); an
undisturbed answer needs none.
"""

import heapq
from collections.abc import Callable
from typing import NamedTuple

from adacd_hil.wire.bus import Bus
from adacd_hil.wire.time_marks import DEVICE_MARK, NEVER_NS, MarkKind, pack_mark
from firmware_sim.canopen.object_dictionary import Send


class Held(NamedTuple):
    """Something that is released later; the smaller one first."""

    due_ns: int
    order: int
    act: Callable[[], None]


class Outbox:
    """Sends and holds back."""

    def __init__(self, send: Send) -> None:
        self.sent = 0
        """Frames that went out so far."""
        self.is_paced = False
        """Whether a host in lockstep hears marks."""
        self._send = send
        self._held: list[Held] = []
        self._order = 0
        self._now_ns = 0
        self._is_open = False

    @property
    def due_ns(self) -> int:
        """When the next of what is held back is released."""
        return self._held[0].due_ns if self._held else NEVER_NS

    def put(self, can_id: int, data: bytes) -> None:
        """Send a frame; while an answer is collected, with it."""
        if self._is_open:
            self.put_later(self._now_ns, can_id, data)
        else:
            self.sent += 1
            self._send(can_id, data)

    def _put(self, can_id: int, data: bytes) -> None:
        self.sent += 1
        self._send(can_id, data)

    def put_later(self, due_ns: int, can_id: int, data: bytes) -> None:
        """Send a frame at `due_ns`."""
        self.hold(due_ns, lambda: self._put(can_id, data))

    def hold(self, due_ns: int, act: Callable[[], None]) -> None:
        """Do something at `due_ns`."""
        self._order += 1
        heapq.heappush(self._held, Held(due_ns, self._order, act))

    def release(self, now_ns: int) -> None:
        """Let go what is due by now."""
        while self._held and self._held[0].due_ns <= now_ns:
            heapq.heappop(self._held).act()

    def collect(self, now_ns: int) -> None:
        """Begin the answer to a SYNC that isn't plain: what is put from now on waits for `close`."""
        self._now_ns = now_ns
        self._is_open = True

    def close(self, sync_ns: int, until_ns: int) -> None:
        """Send all that is released before `until_ns`; in lockstep, say when after `sync_ns`, and when it is all."""
        self._is_open = False
        if self.is_paced:
            self.mark(MarkKind.RELEASE)
        released_ns = sync_ns
        while self._held and self._held[0].due_ns < until_ns:
            held = heapq.heappop(self._held)
            if self.is_paced and held.due_ns > released_ns:
                released_ns = held.due_ns
                self.mark(MarkKind.RELEASE, released_ns - sync_ns)
            held.act()
        if self.is_paced:
            self.mark(MarkKind.END)

    def mark(self, kind: MarkKind, t_ns: int = 0) -> None:
        """Send a mark."""
        self._send(DEVICE_MARK, pack_mark(kind, t_ns))


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
