"""A contact from detection to its end: its reports and the reaction to it, of either scheme.

Per cycle, after the kernel and the supervisor: `step`. It looks at the state reached, so it must see every cycle.
"""

from adacd_hil.records import ContactLevel, ContactReport, Reaction, SchemeState, Vector
from adacd_hil.scheme.contact.contact_report import ContactEvidence, ContactReporter
from adacd_hil.scheme.contact.reaction import ReactionChoice
from adacd_hil.scheme.supervisor.supervisor import REACTING, Supervisor
from adacd_hil.scheme.supervisor.transitions import COLLISION, CONTACT_SHIFT, Calm


class ContactCourse:
    """The contact that the arm is about, if there is one. tau_ext_hat (2,): filtered, for the reaction; a view."""

    def __init__(self, evidence: ContactEvidence, choice: ReactionChoice, tau_ext_hat: Vector) -> None:
        self._reporter = ContactReporter(evidence)
        self._choice = choice
        self._tau_ext_hat = tau_ext_hat
        self._is_reacting = False
        self._link = 0

    def compile(self) -> None:
        """Run every compiled function once."""
        self._reporter.evidence.compile()

    @property
    def is_reporting(self) -> bool:
        """Whether a report is out that is not final yet."""
        return self._reporter.is_open

    @property
    def reaction(self) -> Reaction:
        """What control is to do about it."""
        return self._choice.reaction

    @property
    def goes_on(self) -> bool:
        """Whether the arm moves on along its path."""
        return self._choice.goes_on

    @property
    def judged(self) -> tuple[tuple[float, float], float]:
        """A way, and the external torque along it, Nm, from which on a withdrawal certainly goes on."""
        return self._choice.judged

    def calm(self, calm: Calm, cycle: int) -> Calm:
        """Narrow the bounds to those within which, from this cycle on, only `pass_by` is to be called."""
        if self._is_reacting and self._link:
            calm = self._choice.calm(calm, self._link)
        return self._reporter.calm(calm, cycle)

    def pass_by(self, cycles: int) -> None:
        """Count calm cycles, which the evidence has taken in."""
        self._reporter.evidence.pass_by(cycles)
        if self._is_reacting and self._link:
            self._choice.pass_by(cycles)

    def step(self, cycle: int, supervisor: Supervisor, observation: int, is_model_valid: bool) -> ContactReport | None:
        """Take in one cycle and return the report that is due in it, if one is.

        supervisor: after its step. observation: the kernel's.
        """
        self._reporter.evidence.observe()
        state, joints = supervisor.state, observation >> CONTACT_SHIFT
        level = ContactLevel.COLLISION if observation & COLLISION else ContactLevel.CONTACT
        if state not in REACTING:
            self._leave(state)
            return None
        choice, tau_ext_hat = self._choice, self._tau_ext_hat
        if not self._is_reacting:
            self._is_reacting = True
            if not joints:
                choice.hold()
                return None
            self._reporter.begin(cycle)
            self._link = 2 if joints & 2 else 1
            choice.begin(level, self._link, tau_ext_hat, is_model_valid)
        elif self._link:
            choice.step(level, self._link, supervisor.is_latched, tau_ext_hat, is_model_valid)
        report = self._reporter.report(cycle, joints) if self._reporter.is_open else None
        if report is None:
            return None
        self._link = report.link
        return report._replace(level=choice.level, reaction=choice.reaction, is_two_sided=choice.is_two_sided)

    def _leave(self, state: SchemeState) -> None:
        """Forget the contact that is over."""
        if self._is_reacting:
            self._is_reacting, self._link = False, 0
            self._choice.end()
        if state is SchemeState.FAULT:
            self._reporter.cancel()
