"""A latched fault: drives that go on are stopped, and the user's way out of it.

Nothing of before the fault survives: what waits in the socket and in the interface's transmit queue is dropped, so that
no old command reaches a drive when the bus comes back; then the devices are booted anew, fresh feedback is awaited, and
the drives are enabled at the present position with zero torque first.
"""

from collections.abc import Callable

from adacd_hil.clock import Clock
from adacd_hil.control.operator import FaultAnswer, Operator
from adacd_hil.control.pacing import MOST_FRAMES
from adacd_hil.device.arm import Arm
from adacd_hil.device.arm_watch import RateLimitedEvents
from adacd_hil.device.drive import Cia402State
from adacd_hil.device.network import Master
from adacd_hil.log.recording.recorder import Recorder
from adacd_hil.records import Event, FaultReason
from adacd_hil.wire.bus import BusError, Tap

_LOOK_NS = 10_000_000
"""How often the user is asked and the bus is read while a fault is latched."""
_RETRY_NS = 500_000_000
"""How often a bus that can't be emptied yet, such as an interface that is down, is tried again."""


class Recovery:
    """The way out: the user acknowledges, the bus is emptied, and everything begins again."""

    def __init__(
        self,
        tap: Tap,
        clock: Clock,
        operator: Operator,
        recorder: Recorder,
        progress: Callable[[str], None],
        is_interrupted: Callable[[], bool],
    ) -> None:
        self._tap, self._clock, self._operator = tap, clock, operator
        self._recorder, self._progress = recorder, progress
        self._is_interrupted = is_interrupted

    def empty(self) -> bool:
        """Drop what waits in the bus; False, with the reason in the log, when that isn't possible yet."""
        try:
            self._tap.recover()
        except BusError as error:
            self._say("error", f"the transmit queue could not be emptied: {error}")
            return False
        self._say("info", "transmit queue emptied")
        return True

    def await_acknowledgement(self) -> bool:
        """Wait for the user's answer to a fault; True when the run is to begin again, on an emptied bus."""
        start_ns = self._clock.now_ns()
        is_announced = False
        while not self._is_interrupted():
            answer = self._operator.answer_fault((self._clock.now_ns() - start_ns) * 1e-9)
            if answer is FaultAnswer.END:
                return False
            if answer is FaultAnswer.RECOVER:
                return self._await_bus()
            if not is_announced:
                self._progress("the fault is latched: `ack` begins again, `finish` ends the run")
                is_announced = True
            self._idle(_LOOK_NS)
        return False

    def _await_bus(self) -> bool:
        self._say("info", "fault acknowledged")
        while not self._is_interrupted():
            if self.empty():
                return True
            self._idle(_RETRY_NS)
        return False

    def _idle(self, duration_ns: int) -> None:
        """Let time pass; what the bus still carries goes to the log."""
        self._clock.sleep_until_ns(self._clock.now_ns() + duration_ns)
        self._tap.held_ns = None
        try:
            for _ in range(MOST_FRAMES):
                if self._tap.receive(0.0) is None:
                    break
        except BusError:
            pass  # said when it ended the run, and again when it is to be emptied
        self._recorder.cycle(self._clock.now_ns(), [], self._tap.take())

    def _say(self, level: str, line: str) -> None:
        self._recorder.event(self._clock.now_ns(), Event(level, "recovery", line))
        self._progress(line)


PATIENCE_CYCLES = 10
"""Cycles in which a quick stop by command shows in a drive's status: it acts at the next SYNC, and the status comes
with that one; eight more for lost frames."""


class StopEscalation(RateLimitedEvents):
    """The second stage of a stop: NMT takes a drive out of Operation enabled that is still in it after FAULT.

    The first stage is a quick stop by command. Where somebody else commands the drive, too, or where it doesn't hear,
    that is not enough: in Pre-operational it takes no command from anybody, and by its own watchdog it faults and
    brakes.
    """

    def __init__(self, arm: Arm, master: Master) -> None:
        super().__init__()
        self._arm, self._master = arm, master
        self._due = 0

    def step(self, cycles: int, t_ns: int, fault: FaultReason) -> None:
        """Send NMT pre-operational where it is due; `cycles`: since FAULT. Raises BusError.

        Without patience where somebody else is heard: who would command a drive against a quick stop.
        """
        patience = 1 if fault is FaultReason.FOREIGN_FRAMES else PATIENCE_CYCLES
        if cycles < max(self._due, patience):
            return
        for drive in self._arm.drives:
            if drive.state is Cia402State.OPERATION_ENABLED:
                self._due = cycles + PATIENCE_CYCLES
                self._master.leave_operational(drive.node_id)
                text = f"{drive.name} is in Operation enabled {cycles} cycles after FAULT: NMT pre-operational"
                self.say(t_ns, drive.name, Event("error", "stop", text))
