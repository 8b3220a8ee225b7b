"""The bus in lockstep: frames take their time, win arbitration by identifier, and carry modelled stamps.

It stands between the host and a bus that has no time of its own (the embedded bus, vcan) and moves the host's virtual
clock. The devices hand their frames over when SYNC is through, or later. Whenever the bus is free the lowest identifier
of those that wait is sent, and is through after its number of bits; then it is received. The host's own frames wait in
its transmit queue:

    identifier  the lowest is sent first, as by a controller with a mailbox for each. SYNC goes out when it is due, or
                one frame later; a command that has not begun by then acts one SYNC later.
    fifo        in the order in which they were handed over, as in Linux's default queue. SYNC waits behind a late
                command, and every frame behind one that loses to the devices'.

The host's frames reach the devices in the order in which they are through.

How devices let time pass: `adacd_hil.wire.time_marks`. The host waits for devices that send no marks by its
monotonic clock.
"""

from collections import deque
from collections.abc import Iterable
from typing import Final

from adacd_hil.clock import MonotonicClock, VirtualClock
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.bus import Bus, Frame, SilenceError, TransmitQueueError
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.contract_attributes import read_bitrates
from adacd_hil.wire.frame_time import FrameTime, exact_time, worst_time
from adacd_hil.wire.time_marks import (
    DEVICE_MARK,
    HOST_MARK,
    NEVER_NS,
    MarkKind,
    answers_to_sync,
    pack_mark,
    unpack_mark,
)

DEFAULT_QUEUE_LENGTH: Final = 10
"""Linux's default `txqueuelen` of a CAN interface (CAN_DEFAULT_TX_QUEUE_LEN, drivers/net/can/dev)."""
DEFAULT_DATA_BITRATE: Final = 5_000_000
_CYCLIC_PERIODS: Final = 2
"""For so many periods after a SYNC devices live by SYNC; after that the host lets time pass by ADVANCE."""


Offer = tuple[int, int, int, bytes]
"""A frame that waits for the bus; the smaller one wins: identifier, order among all, from when on it waits, data."""


class LockstepBus(Bus):
    """The host's end of a modelled bus. Single-threaded."""

    def __init__(
        self,
        bus: Bus,
        clock: VirtualClock,
        frame_time: FrameTime,
        *,
        period_ns: int,
        sync_id: int = 0x080,
        answers: Iterable[int] = (),
        patience_s: float = 2.0,
        queue_length: int = DEFAULT_QUEUE_LENGTH,
        is_fifo: bool = False,
    ) -> None:
        """Take over a bus, the one behind. frame_time: duration of a frame, ns. period_ns: between SYNCs.

        sync_id: identifier of SYNC. answers: identifiers that devices send on every SYNC. patience_s: longest wait for
        devices, by the host's monotonic clock, whatever other frames come. queue_length: frames that wait at most while
        no node acknowledges. is_fifo: the host's frames leave in the order in which they were handed over.
        """
        self.channel = bus.channel
        self._bus = bus
        self._clock = clock
        self._frame_time = frame_time
        self._period_ns = period_ns
        self._sync_id = sync_id
        self._answers = frozenset(answers)
        self._patience_s = patience_s
        self._wall = MonotonicClock()
        self._deadline_ns = 0
        """End of the present wait for devices, by the host's monotonic clock."""
        self._queue_length = queue_length
        self._is_fifo = is_fifo
        self._queue: list[Offer] = []  # the host's
        self._offered: list[Offer] = []  # the devices'
        self._received: deque[Frame] = deque()
        """Frames that the bus has sent."""
        self._free_ns = 0
        """When the last frame was through."""
        self.sync_ns = -NEVER_NS
        """When the last SYNC was through."""
        self._count = 0
        self._granted_ns = 0
        """Up to here the devices have lived, as long as no SYNC comes."""
        self._is_acknowledged = True
        self._is_marked = False
        """Whether the devices send marks."""
        self._is_attached = False

    @property
    def waiting_frames(self) -> tuple[int, ...]:
        """Identifiers of the host's frames that SYNC would overtake now, oldest first; in a fifo always empty.

        Frames that start before now are transmitted first. Raises SilenceError or BusError as `send`.
        """
        if self._is_fifo or not self._queue:
            return ()
        self._transmit_before(self._clock.now_ns())
        return tuple([offer[0] for offer in self._queue])

    def send(self, can_id: int, data: bytes) -> None:
        """Queue a frame at the clock's present time.

        The first call of `send` or `receive` drops frames from before, and gives the devices the clock's time. Frames
        that start before now are transmitted first if the queue is full. Raises TransmitQueueError if it stays full as
        no node acknowledges, SilenceError if no device answers a SYNC, BusError if the bus behind fails.
        """
        now_ns = self._clock.now_ns()
        if not self._is_attached:
            self._attach()
        if len(self._queue) >= self._queue_length:
            self._transmit_before(now_ns)
            if not self._is_acknowledged and len(self._queue) >= self._queue_length:
                raise TransmitQueueError(
                    f"transmit queue of {self.channel} is full with {self._queue_length} frames: nobody acknowledges"
                )
        self._count += 1
        self._queue.append((can_id, self._count, now_ns, data))

    def receive(self, timeout_s: float) -> Frame | None:
        """Return the next frame, with the clock at its end unless that is past; or None, the clock after `timeout_s`.

        Raises SilenceError if no device answers a SYNC, BusError if the bus behind fails.
        """
        if not self._is_attached:
            self._attach()
        limit_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while True:
            if self._received:
                if self._received[0].t_ns > limit_ns:
                    break
                frame = self._received.popleft()
                self._clock.sleep_until_ns(frame.t_ns)
                return frame
            if not self._transmit_next(limit_ns) and not self._let_pass(limit_ns):
                break
        self._clock.sleep_until_ns(limit_ns)
        return None

    def recover(self) -> None:
        """Drop the waiting frames of host and devices, and the received ones, here and in the bus behind.

        Raises BusError when the bus behind can't recover yet.
        """
        self._bus.recover()
        self._queue.clear()
        self._offered.clear()
        self._received.clear()

    def close(self) -> None:
        """Send the queued frames, then close the bus behind it; frames that no node acknowledges are not sent.

        Raises SilenceError if no device answers a queued SYNC, BusError if the bus behind fails. The bus behind is
        closed in any case.
        """
        try:
            self._transmit_before(NEVER_NS)
        finally:
            self._bus.close()

    def _transmit_before(self, limit_ns: int) -> None:
        """Transmit in turn all waiting frames, of host and devices, that start before `limit_ns`."""
        while self._transmit_next(limit_ns):
            pass

    def _transmit_next(self, limit_ns: int) -> bool:
        """Transmit the next waiting frame of host or devices that starts before `limit_ns`; return False without one.

        While no node acknowledges, the host's frames stay in the queue. If the devices' time is not yet at the start,
        they are first asked for frames up to then.
        """
        queue = self._queue
        while True:
            waiting = self._offered
            if queue and self._is_acknowledged:
                waiting = [*waiting, *(queue[:1] if self._is_fifo else queue)]
            if not waiting:
                return False
            start_ns = max(min([offer[2] for offer in waiting]), self._free_ns)
            if start_ns >= limit_ns:
                return False
            if not (self._is_marked and start_ns > self._granted_ns and not self._is_cyclic(start_ns)):
                break
            self._ask(start_ns)  # the devices may have something that comes first
        winner = min([offer for offer in waiting if offer[2] <= start_ns])
        can_id, _, _, data = winner
        self._free_ns = start_ns + self._frame_time(can_id, data)
        if winner in self._offered:
            self._offered.remove(winner)
            self._received.append(Frame(can_id, data, self._free_ns))
        else:
            queue.remove(winner)
            self._forward(can_id, data)
        return True

    def _forward(self, can_id: int, data: bytes) -> None:
        """Give a frame that the host has transmitted to the devices; after SYNC take their answers.

        Raises SilenceError as `_take_answers`, BusError if the bus behind fails.
        """
        self._bus.send(can_id, data)
        if can_id == self._sync_id:
            self.sync_ns = self._free_ns
            self._take_answers()

    def _take_answers(self) -> None:
        """Queue the frames that devices send on the SYNC just sent, until all answers are in or the patience is over.

        From a first mark on queue all up to END, see `_take_marked`. Raises SilenceError when answers are expected and
        neither one nor a mark comes.
        """
        self._begin_wait()
        missing = count = len(self._answers)
        while missing:
            frame = self._receive()
            if frame is None:
                break
            if frame.can_id == DEVICE_MARK:
                self._take_marked(frame)
                return
            self._offer(frame, self.sync_ns)
            missing -= frame.can_id in self._answers
        if 0 < count == missing:
            raise SilenceError(f"silence on {self.channel} for {self._patience_s:g} s")

    def _take_marked(self, mark: Frame) -> None:
        """Queue the devices' frames up to the mark END, or silence, each from its release on.

        A release is the time after SYNC that the last mark RELEASE gave. `mark`: the first one.
        """
        offset_ns = 0
        frame: Frame | None = mark
        while frame is not None:
            if frame.can_id != DEVICE_MARK:
                self._offer(frame, self.sync_ns + offset_ns)
            else:
                kind, time_ns = unpack_mark(frame.data) or (MarkKind.END, 0)
                if kind is MarkKind.END:
                    return
                if kind is MarkKind.RELEASE:
                    offset_ns = time_ns
                else:
                    self._note(kind)
            frame = self._receive()

    def _begin_wait(self) -> None:
        """Give the devices `patience_s` from now on."""
        self._deadline_ns = self._wall.now_ns() + round(self._patience_s * 1e9)

    def _receive(self) -> Frame | None:
        """Return the next frame of the bus behind within the present wait, else None.

        After its end, for as long again, still return the frames that are there: the host itself may have been late.
        """
        left_s = (self._deadline_ns - self._wall.now_ns()) * 1e-9
        return self._bus.receive(max(left_s, 0.0)) if left_s > -self._patience_s else None

    def _offer(self, frame: Frame, t_ns: int) -> None:
        """Queue a device's frame to compete for the bus from `t_ns` on; an error frame is received at once."""
        if frame.is_error:
            self._received.append(frame._replace(t_ns=t_ns))
            return
        self._count += 1
        self._offered.append((frame.can_id, self._count, t_ns, frame.data))

    def _is_cyclic(self, t_ns: int) -> bool:
        """Return whether a time is within `_CYCLIC_PERIODS` of the last SYNC.

        Then the devices' time advances by SYNC; later by ADVANCE.
        """
        return t_ns - self.sync_ns < _CYCLIC_PERIODS * self._period_ns

    def _let_pass(self, limit_ns: int) -> bool:
        """Ask the devices to let time pass up to `limit_ns`; return False if no frame can come before.

        For devices that send no marks, wait by the host's monotonic clock. Return False at once while `_is_cyclic`:
        then time passes for the devices by SYNC alone.
        """
        now_ns = self._clock.now_ns()
        if self._is_cyclic(now_ns):
            return False
        if not self._is_marked:
            return now_ns < limit_ns and self._wait_until(limit_ns)
        return self._ask(limit_ns) or self._granted_ns < limit_ns

    def _ask(self, until_ns: int) -> bool:
        """Let the devices run until `until_ns` or their first frame, and return whether a frame came.

        Queue their frames and store the time that they grant. False also means that no device answered within the
        patience.
        """
        self._bus.send(HOST_MARK, pack_mark(MarkKind.ADVANCE, until_ns))
        self._begin_wait()
        return self._await_grant()

    def _attach(self) -> None:
        """Drop old frames, send the clock's time to the devices, and find out whether they send marks."""
        self._is_attached = True
        self._begin_wait()
        while self._wall.now_ns() < self._deadline_ns and self._bus.receive(0.0) is not None:
            pass
        self._ask(self._clock.now_ns())

    def _await_grant(self) -> bool:
        """Queue frames until the devices grant time, or the patience is over; return whether a frame came.

        Store whether the devices send marks, and the granted time.
        """
        came: list[Frame] = []
        while (frame := self._receive()) is not None:
            if frame.can_id != DEVICE_MARK:
                came.append(frame)
                continue
            kind, time_ns = unpack_mark(frame.data) or (MarkKind.END, 0)
            if kind is MarkKind.GRANT:
                self._is_marked = True
                self._granted_ns = time_ns
                break
            self._note(kind)
        else:
            self._is_marked = False  # the devices that sent them have gone
        for frame in came:
            self._offer(frame, max(self._granted_ns, self._free_ns))
        return bool(came)

    def _wait_until(self, limit_ns: int) -> bool:
        """Let time pass by the host's monotonic clock up to `limit_ns`; return whether something came before.

        A frame that comes is queued.
        """
        now_ns, start_ns = self._clock.now_ns(), self._wall.now_ns()
        frame = self._bus.receive((limit_ns - now_ns) * 1e-9)
        if frame is None:
            return False
        self._clock.sleep_until_ns(min(now_ns + self._wall.now_ns() - start_ns, limit_ns))
        if frame.can_id != DEVICE_MARK:
            self._offer(frame, max(self._free_ns, self._clock.now_ns()))
        elif (mark := unpack_mark(frame.data)) is not None:
            self._note(mark[0])
        return True

    def _note(self, kind: MarkKind) -> None:
        """Store whether a device acknowledges frames, by a mark DARK or LIT; ignore other marks."""
        if kind in (MarkKind.DARK, MarkKind.LIT):
            self._is_acknowledged = kind is MarkKind.LIT


def make_lockstep_bus(bus: Bus, clock: VirtualClock, codec: Codec, settings: Settings) -> LockstepBus:
    """Return a modelled bus of a contract, with the stuffing and queue of `settings.lockstep`, at the rates of its DBC.

    A DBC without rates means 1 and 5 Mbit/s. Raises CodecError for one without the message Sync or one of ANSWERS.
    """
    bitrate, data_bitrate = read_bitrates(codec)
    make = worst_time if settings.lockstep.stuffing == "worst" else exact_time
    frame_time = make(bitrate, data_bitrate or DEFAULT_DATA_BITRATE)
    return LockstepBus(
        bus,
        clock,
        frame_time,
        period_ns=settings.bus.period_ns,
        sync_id=codec.message("Sync").can_id,
        answers=answers_to_sync(codec),
        patience_s=settings.bus.feedback_timeout_ms * 1e-3,
        is_fifo=settings.lockstep.queue == "fifo",
    )
