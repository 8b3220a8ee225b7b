"""What the log's line of a fault says: the causes, by the fault's reason, and what is wrong with the devices."""

from collections.abc import Callable

from adacd_hil.control.commission_report import CommissionReport
from adacd_hil.control.self_checks import SelfChecks
from adacd_hil.device.arm import Arm
from adacd_hil.device.arm_report import ArmReport
from adacd_hil.device.arm_watch import ArmWatch
from adacd_hil.device.network import Master
from adacd_hil.records import ArmState, FaultReason, SchemeState
from adacd_hil.scheme.pipeline.certified_pipeline import CertifiedPipeline
from adacd_hil.scheme.pipeline.paper_pipeline import Pipeline
from adacd_hil.settings.configuration import Settings


class FaultReport:
    """Knows who can say why, for every reason."""

    def __init__(
        self,
        settings: Settings,
        arm: Arm,
        watch: ArmWatch,
        pipeline: Pipeline | CertifiedPipeline,
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
