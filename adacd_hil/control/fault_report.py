"""What the log's line of a fault says: the causes, by the fault's reason, and what is wrong with the devices."""

from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

from adacd_hil.control.self_checks import SelfChecks
from adacd_hil.device.arm import Arm
from adacd_hil.device.arm_report import ArmReport
from adacd_hil.device.arm_watch import ArmWatch
from adacd_hil.device.network import Master
from adacd_hil.records import JOINTS, ArmState, FaultReason, SchemeState
from adacd_hil.scheme.pipeline.pipeline import Pipeline
from adacd_hil.settings.configuration import Settings


class FaultReport:
    """Knows who can say why, for every reason."""

    def __init__(
        self,
        settings: Settings,
        arm: Arm,
        watch: ArmWatch,
        pipeline: Pipeline,
        checks: SelfChecks,
        master: Master,
    ) -> None:
        self._commission = CommissionReport(settings, arm)
        report = ArmReport(arm)
        self._report, self._watch, self._checks, self._master = report, watch, checks, master
        self._causes: dict[FaultReason, tuple[Callable[[], list[str]], ...]] = {
            FaultReason.DATA_AGE: (report.describe_gaps,),
            FaultReason.BLIND: (report.describe_gaps,),
            FaultReason.LIMIT: (report.describe_excess,),
            FaultReason.DEADLINE: (lambda: [watch.deadline.describe()],),
            FaultReason.COMMISSION_TIMEOUT: (
                pipeline.describe_withheld,
                self._commission.describe,
                report.describe_excess,
            ),
            FaultReason.ENABLE_TIMEOUT: (report.describe_disabled,),
            FaultReason.ADAPT_TIMEOUT: (pipeline.describe_missing,),
        }

    def note(self, state: SchemeState, arm: ArmState) -> None:
        """Take in a cycle; `state`: that of the scheme after the cycle before."""
        self._commission.note(state, arm)

    def describe(self, fault: FaultReason) -> list[str]:
        """Say what has led to a fault, one line each: the causes by its reason first."""
        return [
            *([self._checks.line] if fault is self._checks.reason else ()),
            *(line for describe in self._causes.get(fault, ()) for line in describe()),
            *self._report.describe_faults(),
            *self._watch.lost,
            *self._master.describe_emergencies(),
        ]


_STATES = (SchemeState.INIT, SchemeState.COMMISSION)


class _RestBound(NamedTuple):
    """What every joint of an arm at rest stays below. `says`: of a joint that doesn't."""

    says: str
    setting: str
    bound: float
    unit: str


class _Unrest(NamedTuple):
    """A joint over a bound."""

    joint: int
    over: _RestBound


class CommissionReport:
    """Why an arm does not get through INIT and COMMISSION: what kept it from being ready, and in how many cycles."""

    def __init__(self, settings: Settings, arm: Arm) -> None:
        self._arm = arm
        speed, torque = settings.safety.rest_velocity_rad_s, settings.safety.rest_torque_Nm
        self._speed = _RestBound("moves: |dq|", "safety.rest_velocity_rad_s", speed, "rad/s")
        self._torque = _RestBound("is loaded: |tau_J|", "safety.rest_torque_Nm", torque, "Nm")
        self._cycles = 0
        self._causes: Counter[str | _Unrest] = Counter()
        self._worst: dict[_Unrest, float] = {}

    def note(self, state: SchemeState, arm: ArmState) -> None:
        """Take in a cycle; `state`: that of the scheme after the cycle before."""
        if state not in _STATES:
            return
        self._cycles += 1
        if not arm.is_complete:
            self._causes.update(f"{name}: no usable frame in time" for name in self._arm.missing_names())
        if arm.fault is not FaultReason.NONE:
            self._causes[f"fault {arm.fault.name}"] += 1
        for joint in range(JOINTS):
            for over, value in ((self._speed, arm.dq[joint]), (self._torque, arm.tau_J[joint])):
                if not abs(value) < over.bound:
                    cause = _Unrest(joint, over)
                    self._causes[cause] += 1
                    self._worst[cause] = max(self._worst.get(cause, 0.0), abs(float(value)))

    def describe(self) -> list[str]:
        """Name the causes, the most frequent first, one line each; empty when nothing was wrong in any cycle."""
        return [
            f"{self._text(cause)} in {count} of {self._cycles} cycles" for cause, count in self._causes.most_common()
        ]

    def _text(self, cause: str | _Unrest) -> str:
        if isinstance(cause, str):
            return cause
        says, setting, bound, unit = cause.over
        return f"joint {cause.joint + 1} {says} up to {self._worst[cause]:.3g} {unit}, {setting} = {bound:g} {unit},"
