"""How each cycle went, for the log: lateness, ages, what the work took, what was left of the period, what waits."""

from adacd_hil.clock import Clock
from adacd_hil.control.exchange import Exchange
from adacd_hil.control.realtime import Tick
from adacd_hil.device.arm import Arm
from adacd_hil.records import ArmState, CycleRecord, Event
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.bus import Tap

_REPEAT_NS = 1_000_000_000


class Evidence:
    """Makes the record of each cycle."""

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
