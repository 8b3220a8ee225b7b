"""One exchange with the arm: SYNC out, feedback and torque in. The first half of every cycle, torque or no torque.

SYNC comes in, too, where another host sends it. With it: commands that missed their SYNC and trouble of the bus, as
events, and the record of how a cycle went.
"""

from adacd_hil.clock import Clock
from adacd_hil.control.pacing import Tick
from adacd_hil.device.arm import Arm
from adacd_hil.device.arm_watch import Notices, Recurrence
from adacd_hil.device.network import Master
from adacd_hil.records import ArmState, CycleRecord, Event
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.bus import NOTHING_QUEUED, Frame, SilenceError, Tap
from adacd_hil.wire.error_frames import TroubleKind, decode_error

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


class LateCommands(Notices):
    """Commands that missed their SYNC, as events.

    The commands of cycle k act at SYNC k + 1, pipelined ones at k + 2. Those that are not on the bus when that SYNC
    goes out act one later.
    """

    def __init__(self, is_pipelined: bool = False) -> None:
        super().__init__()
        self._cycles = 2 if is_pipelined else 1  # from a command to the SYNC at which it acts
        self.count = 0
        """Of the present cycle."""

    def note(self, cycle: int, count: int, t_ns: int) -> None:
        """Take note of the commands that still wait as SYNC of `cycle` goes out, at `t_ns`."""
        self.count = count
        if count == 0:
            return
        from_cycle = cycle - self._cycles
        what = f"1 command of cycle {from_cycle}" if count == 1 else f"{count} commands of cycle {from_cycle}"
        text = f"{what} missed SYNC {cycle}, so acting one later"
        self.say(t_ns, "late", Event("warning", "late commands", text), count)


class TroubleReport(Notices):
    """What the bus's controller reports in error frames, as events.

    A controller that nobody answers reports thousands of times a second; every frame is in the log anyway.
    """

    def accept(self, frame: Frame) -> None:
        """Take an error frame."""
        trouble = decode_error(frame)
        level = "info" if trouble.kind is TroubleKind.ERROR_ACTIVE else "warning"
        self.say(frame.t_ns, trouble.kind, Event(level, "bus", trouble.text))


_REPEAT_NS = 1_000_000_000


class Evidence:
    """How each cycle went, for the log: lateness, ages, what the work took, what was left of the period, what waits."""

    def __init__(self, settings: Settings, bus: Tap, arm: Arm, exchange: Exchange, clock: Clock) -> None:
        self._bus, self._arm, self._exchange = bus, arm, exchange
        self._clock = clock
        self._period_ns = settings.bus.period_ns
        self._is_following = settings.bus.follows
        self._said_lost = bus.frames_lost
        self._silent_until_ns = 0
        self._events: list[Event] = []

    def record(self, tick: Tick, arm: ArmState, overruns: int, log_queue_bytes: int) -> CycleRecord:
        """Sum up the cycle that began with `tick`, whose commands have just been handed to the bus.

        `overruns`: periods skipped since the run began. `log_queue_bytes`: what waits for the log's writer.
        """
        exchange = self._exchange
        command_ns = self._clock.now_ns()
        frames_lost = self._bus.frames_lost
        if frames_lost != self._said_lost and command_ns >= self._silent_until_ns:
            self._tell(frames_lost, command_ns)
        # Where SYNC is followed, it is the grid point itself, however late this host woke up for it.
        late_ns = 0 if self._is_following else tick.lateness_ns
        return CycleRecord(
            cycle=tick.cycle,
            lateness_ns=tick.lateness_ns,
            feedback_ns=exchange.feedback_ns - exchange.sync_ns,
            command_ns=command_ns - exchange.sync_ns,
            compute_ns=command_ns - exchange.feedback_ns,
            slack_ns=exchange.sync_ns - late_ns + self._period_ns - command_ns,
            data_age=max(*arm.age_q, *arm.age_tau_J),
            overruns=overruns,
            frames_missing=self._arm.missing_frames,
            commands_late=exchange.late_commands.count,
            frames_lost=frames_lost,
            receive_queue_bytes=exchange.queues.received,
            transmit_queue_bytes=exchange.queues.sent,
            log_queue_bytes=log_queue_bytes,
        )

    def _tell(self, frames_lost: int, t_ns: int) -> None:
        count, self._said_lost = frames_lost - self._said_lost, frames_lost
        self._silent_until_ns = t_ns + _REPEAT_NS
        what = "1 received frame" if count == 1 else f"{count} received frames"
        self._events.append(Event("warning", "bus", f"{what} dropped by the kernel: this host reads too late"))

    def take_events(self) -> list[Event]:
        """Return and forget the events since the last call: frames that were lost, at most once a second."""
        events, self._events = self._events, []
        return events
