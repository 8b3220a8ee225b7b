"""The common begin and end of every cycle, with or without torque: SYNC out, feedback in; commands out, a record.

If another host sends SYNC, this host receives it. A cycle is `turn`, its own decision, `leave`, `end`.
"""

from adacd_hil.clock import Clock
from adacd_hil.control.pacing import MOST_FRAMES, Pacer, Tick
from adacd_hil.device.arm import FEEDBACK_SHARE, Arm
from adacd_hil.device.arm_watch import RateLimitedEvents, Recurrence
from adacd_hil.device.network import Master
from adacd_hil.printable import number_of
from adacd_hil.records import ArmCommand, ArmState, CycleRecord, Event
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.bus import NOTHING_QUEUED, Frame, SilenceError, Tap
from adacd_hil.wire.error_frames import TroubleKind, decode_error

QUEUES_S = 0.01


class Exchange:
    """Reads and commands the arm once per cycle.

    `sync_ns`, `feedback_ns`: when SYNC went out or came, when the last cyclic frame came, or was given up. `events`:
    commands that missed their SYNC, trouble of the bus, frames that were lost.

    Frames that came before SYNC belong to the cycle before.
    """

    def __init__(self, settings: Settings, bus: Tap, arm: Arm, master: Master, pacer: Pacer, clock: Clock) -> None:
        """Prepare the first cycle. `clock`: measures durations within a cycle."""
        self.sync_ns = 0
        self.feedback_ns = 0
        self.queues = NOTHING_QUEUED
        """Queues just after SYNC, with SYNC if it is sent here; read every 10 ms, as each reading is a system call."""
        self.events = RateLimitedEvents()
        self._bus, self._arm, self._master = bus, arm, master
        self._pacer, self._clock = pacer, clock
        self._command_ids = tuple(drive.command_id for drive in arm.drives)
        self._is_following = settings.bus.follows
        self._acts_after = 2 if settings.bus.is_pipelined else 1  # cycles from a command to the SYNC at which it acts
        self._period_ns = settings.bus.period_ns
        self._heartbeats = Recurrence(settings.bus.heartbeat_ms * 1e-3, settings.bus.period_s)
        self._looks_at_queues = Recurrence(QUEUES_S, settings.bus.period_s)
        self._patience_s = FEEDBACK_SHARE * settings.bus.period_s
        self._commands_late = 0
        self._said_lost = bus.frames_lost

    def turn(self) -> tuple[Tick, ArmState]:
        """Wait for the next cycle, then read the arm by `read`; return the cycle's beginning and the arm's state."""
        tick = self._pacer.next()
        return tick, self.read(tick)

    def read(self, tick: Tick) -> ArmState:
        """Send SYNC, unless another host does, take the devices' frames until all are in, and return the arm's state.

        Wait no longer than FEEDBACK_SHARE of the period, nor beyond another host's next SYNC; the missing values are
        then old ones.

        Raises BusError if sending or receiving fails; in lockstep its SilenceError, if no device answers.
        """
        bus, arm = self._bus, self._arm
        for late in tick.late:
            self._accept(late)
        if not (self._is_following or arm.has_all_frames):
            self._take_late_frames()
        waiting = bus.waiting_frames
        self.sync_ns = bus.held_ns = tick.t_ns
        self._commands_late = sum(waiting.count(can_id) for can_id in self._command_ids) if waiting else 0
        if self._commands_late:
            self._say_late(tick.cycle)
        arm.synchronise(tick.cycle, tick.t_ns, tick.periods)
        if self._looks_at_queues.take_turn(tick.cycle):
            self.queues = bus.queue_bytes()
        for early in tick.ahead:
            self._accept(early)
        try:
            self.feedback_ns = self._await_feedback(tick.ahead[-1].t_ns if tick.ahead else tick.t_ns)
        except SilenceError as silence:
            names = ", ".join(arm.missing_names())
            raise SilenceError(f"no answer from {names} to SYNC of cycle {tick.cycle}: {silence}") from None
        return arm.state()

    def _say_late(self, cycle: int) -> None:
        """Report, at a limited rate, that `_commands_late` commands still wait when their SYNC, of `cycle`, goes out.

        They act one SYNC later.
        """
        count, from_cycle = self._commands_late, cycle - self._acts_after
        text = f"{number_of(count, 'command')} of cycle {from_cycle} missed SYNC {cycle}, so acting one later"
        self.events.report(self.sync_ns, "late", Event("warning", "late commands", text), count)

    def _await_feedback(self, last_ns: int) -> int:
        """Take frames until all of this cycle are in, their time is over, or another host's next SYNC comes.

        At most MOST_FRAMES are taken. Return the time of the last frame, ns, or the present time if some are missing.
        `last_ns`: time of the last frame taken so far.
        """
        bus, arm, sync_ns = self._bus, self._arm, self.sync_ns
        patience_s = self._patience_s
        for _ in range(MOST_FRAMES):
            if arm.has_all_frames:
                return last_ns
            frame = bus.receive(patience_s)
            if frame is None:
                break
            if self._is_following and frame.can_id == arm.sync_id and not frame.is_error:
                bus.unread(frame)
                break
            last_ns = frame.t_ns
            if not arm.accept(frame, last_ns < sync_ns):
                self._pass_on(frame)
            elapsed_s = (last_ns - sync_ns) * 1e-9
            if not 0.0 <= elapsed_s <= self._patience_s:  # a late frame, or a stamp of a wall clock that was set
                elapsed_s = (self._clock.now_ns() - sync_ns) * 1e-9
            patience_s = self._patience_s - elapsed_s
        return self._clock.now_ns()

    def _take_late_frames(self) -> None:
        """Take the frames, at most MOST_FRAMES, that wait before this cycle's SYNC: they belong to the cycle before."""
        for _ in range(MOST_FRAMES):
            late = self._bus.receive(0.0)
            if late is None:
                return
            self._accept(late)

    def _accept(self, frame: Frame) -> None:
        """Give a frame to the arm; pass it on if the arm doesn't take it."""
        if not self._arm.accept(frame):
            self._pass_on(frame)

    def _pass_on(self, frame: Frame) -> None:
        """Report an error frame as an event; give any other frame to the CANopen master.

        Call it with frames that the arm has not taken.
        """
        if frame.is_error:
            say_trouble(self.events, frame)
        else:
            self._master.accept(frame)

    def leave(self) -> int:
        """Return the present time, ns, and stamp the frames sent from now on with it, until the next cycle.

        In lockstep first move the clock by the modelled work. Call it once per cycle, before `end`.
        """
        self._bus.held_ns = leaving_ns = self._pacer.command_time(self.feedback_ns)
        return leaving_ns

    def end(self, tick: Tick, arm: ArmState, command: ArmCommand, log_queue_bytes: int = 0) -> CycleRecord:
        """Send the commands, and a heartbeat if one is due; return the record of the cycle's times and counts.

        `log_queue_bytes`: bytes that wait for the log's writer. Raises BusError if a frame can't be sent.
        """
        self._arm.send_command(command)
        record = self._record(tick, arm, log_queue_bytes)
        if self._heartbeats.take_turn(record.cycle):
            self._master.send_heartbeat()
        return record

    def _record(self, tick: Tick, arm: ArmState, log_queue_bytes: int) -> CycleRecord:
        """Return the record of a cycle whose commands have just left: its times, counts of missing frames, and queues.

        Report frames that the kernel has dropped since the last report, at a limited rate.
        """
        command_ns = self._clock.now_ns()
        frames_lost = self._bus.frames_lost
        if frames_lost != self._said_lost and self.events.is_due("lost", command_ns):
            count, self._said_lost = frames_lost - self._said_lost, frames_lost
            text = f"{number_of(count, 'received frame')} dropped by the kernel: this host reads too late"
            self.events.report(command_ns, "lost", Event("warning", "bus", text))
        # If SYNC is followed, it is the grid point itself, however late this host woke up for it.
        late_ns = 0 if self._is_following else tick.lateness_ns
        return CycleRecord(
            cycle=tick.cycle,
            lateness_ns=tick.lateness_ns,
            feedback_ns=self.feedback_ns - self.sync_ns,
            command_ns=command_ns - self.sync_ns,
            compute_ns=command_ns - self.feedback_ns,
            slack_ns=self.sync_ns - late_ns + self._period_ns - command_ns,
            data_age=max(*arm.age_q, *arm.age_tau_J),
            overruns=self._pacer.overruns,
            frames_missing=self._arm.missing_frames,
            commands_late=self._commands_late,
            frames_lost=frames_lost,
            receive_queue_bytes=self.queues.received,
            transmit_queue_bytes=self.queues.sent,
            log_queue_bytes=log_queue_bytes,
        )


def say_trouble(events: RateLimitedEvents, frame: Frame) -> None:
    """Add an event for an error frame of the bus's controller, limited in rate by kind of error.

    A controller without an acknowledging node signals thousands a second; every frame is in the log anyway.
    """
    kind, text = decode_error(frame)
    level = "info" if kind is TroubleKind.ERROR_ACTIVE else "warning"
    events.report(frame.t_ns, kind, Event(level, "bus", text))
