"""Faults: the host's own checks, the causes in the log, and the recovery.

`SelfChecks` compares commands with their effects: torque, motion, the devices' parameters, and the first motion with
the configuration. A failed check is passed to the scheme as a request for FAULT, so that a log replays to the same
decision. `FaultReport` lists the causes, by the fault's reason, and the devices' errors.

After a latched fault, drives that stay enabled are stopped (`StopEscalation`), and the user decides how to continue.
Frames from before the fault are dropped from the socket and the interface's transmit queue, so that no old command
reaches a drive when the bus returns; then the devices are booted again, fresh feedback is awaited, and the drives are
enabled at the present position with zero torque first.
"""

import math
from collections import Counter
from collections.abc import Callable

from adacd_hil.clock import Clock
from adacd_hil.control.first_motion import FirstMotion
from adacd_hil.control.operator import FaultAnswer, Operator
from adacd_hil.control.pacing import MOST_FRAMES
from adacd_hil.device.arm import Arm
from adacd_hil.device.arm_report import describe_disabled, describe_excess, describe_faults, describe_gaps
from adacd_hil.device.arm_watch import ArmWatch, EventSource, RateLimitedEvents
from adacd_hil.device.device_setup import ParameterWatch
from adacd_hil.device.drive import Cia402State, Drive
from adacd_hil.device.network import Master
from adacd_hil.log.recording.recorder import Recorder
from adacd_hil.records import BEGINNING, JOINTS, REACTING, ArmState, Event, FaultReason, Request, SchemeState, Vector
from adacd_hil.scheme.pipeline.pipeline import Pipeline
from adacd_hil.scheme.supervisor.supervisor import POWERED
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.bus import BusError, Tap

TORQUE_STATUSES = 2
"""Statuses in a row that must show a wrong torque. A single one may be of the moment in which a command was late."""
TORQUE_S = 0.05
"""Shortest time for which a drive's torque must differ: five times the settling time of a slow current loop."""
_RUN_AWAY = (FaultReason.LIMIT, FaultReason.FOLLOWING)
_JUDGED = POWERED.difference(REACTING)
"""States in which the arm follows an undisturbed motion."""


class SelfChecks:
    """Checks every cycle of an enabled arm. `reason`, `line`: of the first failure; before, NONE and empty."""

    def __init__(
        self, settings: Settings, arm: Arm, parameters: ParameterWatch, q_d: Vector, first_motion: FirstMotion
    ) -> None:
        """`q_d` (2,): memory of the desired position, rad; `judge` reads in it that of the cycle before."""
        self._first_motion = first_motion
        period_s = settings.bus.period_s
        self._arm, self._parameters, self._q_d = arm, parameters, q_d
        self._window_rad = [math.radians(deg) for deg in settings.controller.following_window_deg]
        self._following_cycles = max(1, round(settings.controller.following_timeout_s / period_s))
        self._torque_share = settings.arm.torque_error_share
        self._torque_cycles = max(1, round(TORQUE_S / period_s))
        self._away_cycles = 0
        self._wrong: dict[str, tuple[int, int]] = {}  # by drive: first cycle, number of statuses
        self.reason = FaultReason.NONE
        self.line = ""

    def judge(self, arm: ArmState, state: SchemeState) -> Request:
        """Return the request to fault for changed parameters, wrong torque, wrong configuration or lagging motion.

        Else NONE, and while the drives are not enabled. Motion is not judged in a reaction or a stop. Store the first
        failure in `reason` and `line`. `state`: of the scheme after the previous cycle. Call it once per cycle.
        """
        if not arm.is_enabled:
            return Request.NONE
        if self._parameters.first_difference:
            return self._fail(FaultReason.TAMPERED, Request.FAULT_TAMPERED, self._parameters.first_difference)
        line = self._judge_torque(arm.cycle)
        if line:
            return self._fail(FaultReason.TORQUE, Request.FAULT_TORQUE, line)
        if self._first_motion.line:
            return self._fail(FaultReason.MISCONFIGURED, Request.FAULT_MISCONFIGURED, self._first_motion.line)
        line = self._judge_motion(arm) if state in _JUDGED else self._skip_motion()
        return self._fail(FaultReason.FOLLOWING, Request.FAULT_FOLLOWING, line) if line else Request.NONE

    def suspicions(self, fault: FaultReason) -> list[str]:
        """Return [line] on likely wrong settings if the first motion suggests them and `fault` is LIMIT or FOLLOWING.

        Else [].
        """
        line = self._first_motion.suspicion() if fault in _RUN_AWAY else ""
        return [line] if line else []

    def _fail(self, reason: FaultReason, request: Request, line: str) -> Request:
        """Store `reason` and `line` unless an earlier failure is stored; return `request`."""
        if self.reason is FaultReason.NONE:
            self.reason, self.line = reason, line
        return request

    def _skip_motion(self) -> str:
        """Set the time outside the following window to 0; return "", for no failure."""
        self._away_cycles = 0
        return ""

    def _judge_motion(self, arm: ArmState) -> str:
        """Return a line if the arm has been outside its following window for the timeout, else "".

        The window, `controller.following_window_deg`, is around the desired position; one joint outside is enough.
        """
        (q1, q2), (desired1, desired2), (window1, window2) = arm.q.tolist(), self._q_d.tolist(), self._window_rad
        errors = abs(q1 - desired1), abs(q2 - desired2)
        is_near = errors[0] <= window1 and errors[1] <= window2
        self._away_cycles = 0 if is_near else self._away_cycles + arm.periods
        if self._away_cycles < self._following_cycles:
            return ""
        joint = max(range(JOINTS), key=lambda k: errors[k] / self._window_rad[k])
        return (
            f"joint {joint + 1}: {math.degrees(errors[joint]):.1f} deg from the desired position, "
            f"controller.following_window_deg = {math.degrees(self._window_rad[joint]):g} deg"
        )

    def _judge_torque(self, cycle: int) -> str:
        """Return a line for the first drive whose torque was outside its recent commands' range for too long, else "".

        Outside: by more than `arm.torque_error_share` of its rated torque. Too long: TORQUE_STATUSES in a row, and
        TORQUE_S. Only a torque of this cycle is judged.
        """
        for drive, rated_Nm in zip(self._arm.drives, self._arm.limits.rated_torque_Nm, strict=True):
            if drive.torque_cycle != cycle:
                continue
            excess = self._excess(drive)
            if excess <= 1000.0 * self._torque_share:
                self._wrong.pop(drive.name, None)
                continue
            since, count = self._wrong.get(drive.name, (cycle, 0))
            self._wrong[drive.name] = since, count + 1
            if count + 1 >= TORQUE_STATUSES and cycle - since >= self._torque_cycles:
                return (
                    f"{drive.name}: torque {drive.torque_actual_permille / 10:.1f} % of {rated_Nm:g} Nm rated at the "
                    f"joint, {drive.recent_permille[-1] / 10:.1f} % commanded, "
                    f"arm.torque_error_share = {100.0 * self._torque_share:g} %"
                )
        return ""

    @staticmethod
    def _excess(drive: Drive) -> float:
        """Return by how much a drive's torque is outside the range of its recent commands, per mille of rated torque.

        0 within the range. A drive that reports a limit of its own may have less torque, down to zero.
        """
        low, high = min(drive.recent_permille), max(drive.recent_permille)
        if drive.is_limited:
            low, high = min(low, 0), max(high, 0)
        actual = drive.torque_actual_permille
        return max(low - actual, actual - high, 0)


class FaultReport:
    """Lists the causes of a fault, from the arm, its devices, the scheme and the host's own checks."""

    def __init__(
        self,
        settings: Settings,
        arm: Arm,
        watch: ArmWatch,
        pipeline: Pipeline,
        checks: SelfChecks,
        master: Master,
    ) -> None:
        self.commission = CommissionReport(settings, arm)
        self._arm, self._watch, self._checks, self._master = arm, watch, checks, master
        self._causes: dict[FaultReason, tuple[Callable[[], list[str]], ...]] = {
            FaultReason.DATA_AGE: (lambda: describe_gaps(arm),),
            FaultReason.BLIND: (lambda: describe_gaps(arm),),
            FaultReason.LIMIT: (lambda: describe_excess(arm),),
            FaultReason.COMMISSION_TIMEOUT: (
                pipeline.describe_withheld,
                self.commission.list_unrest,
                lambda: describe_excess(arm),
            ),
            FaultReason.ENABLE_TIMEOUT: (lambda: describe_disabled(arm),),
            FaultReason.ADAPT_TIMEOUT: (pipeline.describe_missing,),
        }

    def list_causes(self, fault: FaultReason) -> list[str]:
        """Return the causes of a fault as lines: first those of its reason, then those of host, devices and bus."""
        return [
            *([self._checks.line] if fault is self._checks.reason else ()),
            *self._checks.suspicions(fault),
            *(line for describe in self._causes.get(fault, ()) for line in describe()),
            *self._watch.deadline.describe_misses(),
            *describe_faults(self._arm),
            *self._watch.lost,
            *self._master.describe_emergencies(),
        ]


BOUNDS = "bounds"
"""Name of the event that tells a value outside its bounds before the drives are enabled: shown at once."""


class CommissionReport(EventSource):
    """Counts the reasons why an arm stays in INIT or COMMISSION, by cycles; tells values outside their bounds at once.

    `events`: one for each device whose values are outside.
    """

    def __init__(self, settings: Settings, arm: Arm) -> None:
        super().__init__()
        self._arm = arm
        self._bounded = [device for device in arm.devices if device.has_bounds]
        torque = settings.safety.rest_torque_Nm
        self._bounds = (
            ("moves: |dq|", "safety.rest_velocity_rad_s", settings.safety.rest_velocity_rad_s, "rad/s"),
            ("is loaded: |tau_J|", "safety.rest_torque_Nm", torque, "Nm"),
        )
        """Upper bounds for every joint of an arm at rest: text for a joint beyond it, setting, value, unit."""
        tilt_deg, hangs_deg = settings.mounting_deg
        self._weight = f"correct the mounting, arm.mounting_deg = [{tilt_deg:g}, {hangs_deg:g}]"
        if not settings.estimator.gravity:
            self._weight = "the mounting is not flat: estimator.gravity = true and arm.mounting_deg"
        self._weight += f", and safety.rest_torque_Nm = {torque:g} Nm"
        self._cycles = 0
        self._causes: Counter[str | tuple[int, int]] = Counter()  # a joint beyond a bound: joint, place of the bound
        self._worst: dict[tuple[int, int], float] = {}

    def count_cycle(self, state: SchemeState, arm: ArmState) -> None:
        """Count the reasons for which an arm in INIT or COMMISSION stays there in this cycle; else do nothing.

        Add an event for each device with a value outside its bounds, once. state: of the scheme after the cycle before.
        """
        if state not in BEGINNING:
            return
        self._cycles += 1
        for device in tuple(self._bounded):
            if lines := device.describe_known_excess():
                self._bounded.remove(device)
                text = f"{'; '.join(lines)}: no drive is enabled before"
                self.events.append(Event("warning", BOUNDS, text))
        if not arm.is_complete:
            self._causes.update(f"{name}: no usable frame in time" for name in self._arm.missing_names())
        if arm.fault is not FaultReason.NONE:
            self._causes[f"fault {arm.fault.name}"] += 1
        for place, values in enumerate((arm.dq, arm.tau_J)):
            for joint, value in enumerate(values.tolist()):
                if not abs(value) < self._bounds[place][2]:
                    self._causes[joint, place] += 1
                    self._worst[joint, place] = max(self._worst.get((joint, place), 0.0), abs(value))

    def list_unrest(self) -> list[str]:
        """Return a line for each counted reason, the most frequent first; empty if no cycle had one.

        After a reason of torque, a last line has the remedy if it is the arm's own weight.
        """
        lines = [
            f"{self._text(cause)} in {count} of {self._cycles} cycles" for cause, count in self._causes.most_common()
        ]
        if any((joint, 1) in self._causes for joint in range(JOINTS)):
            lines.append(f"if that is the arm's own weight: {self._weight}")
        return lines

    def _text(self, cause: str | tuple[int, int]) -> str:
        """Return a counted cause as text; a joint beyond a bound with its largest value."""
        if isinstance(cause, str):
            return cause
        joint, place = cause
        says, setting, bound, unit = self._bounds[place]
        return f"joint {joint + 1} {says} up to {self._worst[cause]:.3g} {unit}, {setting} = {bound:g} {unit},"


_LOOK_NS = 10_000_000
"""Interval at which the user's answer and the bus are read while a fault is latched."""
_RETRY_NS = 500_000_000
"""Interval between attempts to empty a bus, for instance while its interface is down."""


class Recovery:
    """Recovery from a latched fault: the user acknowledges, the bus is emptied, the run starts again."""

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
        """Drop all frames that wait to be received or sent; log, print and return whether that was possible."""
        try:
            self._tap.recover()
        except BusError as error:
            self._say("error", f"the transmit queue could not be emptied: {error}")
            return False
        self._say("info", "transmit queue emptied")
        return True

    def await_acknowledgement(self) -> bool:
        """Wait for the user's answer to a fault, and empty the bus if it is to recover.

        Return True to start again; False to end the run, also when it is interrupted meanwhile.
        """
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
        """Log and print that the fault is acknowledged; then try to empty the bus, each _RETRY_NS.

        Return True once it is empty, False if the run is interrupted.
        """
        self._say("info", "fault acknowledged")
        while not self._is_interrupted():
            if self.empty():
                return True
            self._idle(_RETRY_NS)
        return False

    def _idle(self, duration_ns: int) -> None:
        """Wait for `duration_ns`, then take and log the frames that have arrived meanwhile, without acting on them."""
        self._clock.sleep_until_ns(self._clock.now_ns() + duration_ns)
        self._tap.held_ns = None
        try:
            for _ in range(MOST_FRAMES):
                if self._tap.receive(0.0) is None:
                    break
        except BusError:
            pass  # logged when it ended the run, and again if it can't be emptied
        self._recorder.cycle(self._clock.now_ns(), [], self._tap.take_passed())

    def _say(self, level: str, line: str) -> None:
        self._recorder.event(self._clock.now_ns(), Event(level, "recovery", line))
        self._progress(line)


PATIENCE_CYCLES = 10
"""Cycles until a quick stop by command shows in a drive's status: it acts at the next SYNC, whose status shows it;
eight more for lost frames."""
STOP = "stop"
"""Name of the event that tells that a drive didn't obey the quick stop: shown at once."""


class StopEscalation(RateLimitedEvents):
    """Second stage of a stop: NMT takes a drive out of Operation enabled if it is still enabled after FAULT.

    The first stage is a quick stop by command. It fails if another node commands the drive, too, or if the drive
    doesn't receive. In Pre-operational the drive takes no commands; its own watchdog makes it fault and brake.
    """

    def __init__(self, arm: Arm, master: Master) -> None:
        super().__init__()
        self._arm, self._master = arm, master
        self._due = 0

    @property
    def enabled(self) -> list[Drive]:
        """The drives that last reported Operation enabled."""
        return [drive for drive in self._arm.drives if drive.state is Cia402State.OPERATION_ENABLED]

    def step(self, cycles: int, t_ns: int, fault: FaultReason) -> None:
        """Send NMT pre-operational to each drive that is still enabled PATIENCE_CYCLES after FAULT, and report it.

        `cycles`: since FAULT. Repeat after as many cycles. After FOREIGN_FRAMES begin in the next cycle: another node
        may command the drive against the quick stop. Raises BusError if a frame can't be sent.
        """
        patience = 1 if fault is FaultReason.FOREIGN_FRAMES else PATIENCE_CYCLES
        if cycles < max(self._due, patience):
            return
        for drive in self.enabled:
            self._due = cycles + PATIENCE_CYCLES
            self._master.leave_operational(drive.node_id)
            text = f"{drive.name} last reported Operation enabled, {cycles} cycles after FAULT: NMT pre-operational"
            self.report(t_ns, drive.name, Event("error", STOP, text))
