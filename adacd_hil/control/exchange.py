"""One exchange with the arm: SYNC out, feedback and torque in. The first half of every cycle, torque or no torque.

SYNC comes in, too, where another host sends it.
"""

from adacd_hil.clock import Clock
from adacd_hil.control.late_commands import LateCommands
from adacd_hil.control.realtime import Tick
from adacd_hil.control.trouble_report import TroubleReport
from adacd_hil.device.arm import Arm
from adacd_hil.device.arm_watch import Recurrence
from adacd_hil.device.network import Master
from adacd_hil.records import ArmState
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.bus import NOTHING_QUEUED, Frame, SilenceError, Tap

FEEDBACK_SHARE = 0.7
"""Part of the period in which feedback is awaited in real time. On a classic bus at 1 Mbit/s it is in after 565 µs at
the worst, and two commands need 230 µs before the next SYNC."""
QUEUES_S = 0.01
_MOST_FRAMES = 1000
"""Frames taken at once, so that a bus that somebody floods can't hold up the cycle: a classic one carries 21 per ms."""


class Exchange:
    """Reads the arm once per cycle.

    `sync_ns`, `feedback_ns`: when SYNC went out or came, when the last cyclic frame came, or was given up.

    Frames that came before SYNC belong to the cycle before.
    """

    def __init__(self, settings: Settings, bus: Tap, arm: Arm, master: Master, clock: Clock) -> None:
        self.sync_ns = 0
        self.feedback_ns = 0
        self.queues = NOTHING_QUEUED
        """What waited just after SYNC, SYNC included where it is sent here; looked at every 10 ms, a system call."""
        self.late_commands = LateCommands(settings.bus.is_pipelined)
        self.troubles = TroubleReport()
        self._bus, self._arm, self._master = bus, arm, master
        self._clock = clock
        self._command_ids = tuple(drive.command_id for drive in arm.drives)
        self._is_following = settings.bus.follows
        self._looks_at_queues = Recurrence(QUEUES_S, settings.bus.period_s)
        self._patience_s = FEEDBACK_SHARE * settings.bus.period_s

    def read(self, tick: Tick) -> ArmState:
        """Begin with SYNC and take in what the devices sampled on it.

        Raises BusError, of it SilenceError in lockstep.
        """
        bus, arm = self._bus, self._arm
        for late in tick.late:
            self._accept(late)
        if not (self._is_following or arm.has_all_frames):
            self._take_late_frames()
        waiting = bus.waiting_frames
        self.sync_ns = bus.held_ns = tick.t_ns
        late_count = sum(waiting.count(can_id) for can_id in self._command_ids) if waiting else 0
        self.late_commands.note(tick.cycle, late_count, self.sync_ns)
        arm.synchronise(tick.cycle, tick.t_ns, tick.periods)
        if self._looks_at_queues.is_due(tick.cycle):
            self.queues = bus.queue_bytes()
        for early in tick.ahead:
            self._accept(early)
        try:
            self.feedback_ns = self._await_feedback(tick.ahead[-1].t_ns if tick.ahead else tick.t_ns)
        except SilenceError as silence:
            names = ", ".join(arm.missing_names())
            raise SilenceError(f"no answer from {names} to SYNC of cycle {tick.cycle}: {silence}") from None
        return arm.state()

    def _await_feedback(self, last_ns: int) -> int:
        """Take frames until all of this cycle are in or the time for them is over; return when that was.

        `last_ns`: when the last frame came that is in already.
        """
        bus, arm, sync_ns = self._bus, self._arm, self.sync_ns
        patience_s = self._patience_s
        for _ in range(_MOST_FRAMES):
            if arm.has_all_frames:
                return last_ns
            frame = bus.receive(patience_s)
            if frame is None:
                break
            if self._is_following and frame.can_id == arm.sync_id and not frame.is_error:
                bus.unread(frame)
                break
            last_ns = frame.t_ns
            self._accept(frame, is_late=last_ns < sync_ns)
            elapsed_s = (last_ns - sync_ns) * 1e-9
            if not 0.0 <= elapsed_s <= self._patience_s:  # a late frame, or a stamp of a wall clock that was set
                elapsed_s = (self._clock.now_ns() - sync_ns) * 1e-9
            patience_s = self._patience_s - elapsed_s
        return self._clock.now_ns()

    def _take_late_frames(self) -> None:
        """Take what the cycle before lacks and has come by now."""
        for _ in range(_MOST_FRAMES):
            late = self._bus.receive(0.0)
            if late is None:
                return
            self._accept(late)

    def _accept(self, frame: Frame, is_late: bool = False) -> None:
        if frame.is_error:
            self.troubles.accept(frame)
        elif not self._arm.accept(frame, is_late):
            self._master.accept(frame)
