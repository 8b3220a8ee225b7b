"""A contact from detection to its end: its reports and the reaction to it, joined for a pipeline.

Per cycle, after the kernel and the supervisor: `step`. It looks at the state reached, so it must see every cycle.
"""

from adacd_hil.records import ContactLevel, ContactReport, Reaction, SchemeState, Vector
from adacd_hil.scheme.contact.contact_report import ContactReporter
from adacd_hil.scheme.contact.reaction import ReactionChoice
from adacd_hil.scheme.kernel.loop import TouchWatch
from adacd_hil.scheme.supervisor.supervisor import REACTING, Supervisor
from adacd_hil.scheme.supervisor.transitions import CONTACT_SHIFT, Calm, Observation
from adacd_hil.settings.configuration import Settings

_COLLISION = int(Observation.COLLISION)


class ContactCourse:
    """The contact that the arm is about, if there is one."""

    def __init__(self, settings: Settings) -> None:
        self._reporter = ContactReporter(settings)
        self._response = ReactionChoice(settings)
        self._is_reacting = False
        self._link = 0

    def compile(self) -> None:
        """Run every compiled function once."""
        self._reporter.compile()

    @property
    def is_reporting(self) -> bool:
        """Whether a report is out that is not final yet."""
        return self._reporter.is_open

    @property
    def reaction(self) -> Reaction:
        """What control is to do about it."""
        return self._response.reaction

    @property
    def goes_on(self) -> bool:
        """Whether the arm moves on along its path."""
        return self._response.goes_on

    def calm(self, calm: Calm, cycle: int) -> Calm:
        """Narrow the bounds to those within which, from this cycle on, only `pass_by` is to be called."""
        if self._is_reacting and self._link:
            calm = self._response.calm(calm, self._link)
        return self._reporter.calm(calm, cycle)

    @property
    def watch(self) -> TouchWatch:
        """What a loop over calm cycles does and watches."""
        history = self._reporter.history
        return TouchWatch(history.rows, history.count, *self._response.judged)

    def pass_by(self, cycles: int) -> None:
        """Count calm cycles, whose samples are in the history."""
        self._reporter.history.count += cycles
        if self._is_reacting and self._link:
            self._response.pass_by(cycles)

    def step(
        self,
        cycle: int,
        supervisor: Supervisor,
        observation: int,
        q: Vector,
        tau_ext_hat: Vector,
        tau_ext_wide_hat: Vector,
        sigma: Vector,
        threshold: Vector,
        is_model_valid: bool,
    ) -> ContactReport | None:
        """Take in one cycle and return the report that is due in it, if one is.

        supervisor: after its step. observation: the kernel's. Vectors (2,): tau_ext_hat filtered, for the reaction;
        tau_ext_wide_hat filter undone, sigma its standard deviation, threshold the lower ones in force, for the report.
        """
        self._reporter.observe(q, tau_ext_wide_hat, sigma, threshold)
        state, joints = supervisor.state, observation >> CONTACT_SHIFT
        level = ContactLevel.COLLISION if observation & _COLLISION else ContactLevel.CONTACT
        if state not in REACTING:
            self._leave(state)
            return None
        if not self._is_reacting:
            self._is_reacting = True
            if not joints:
                self._response.hold()
                return None
            self._reporter.begin(cycle)
            self._link = 2 if joints & 2 else 1
            self._response.begin(level, self._link, tau_ext_hat, is_model_valid)
        elif self._link:
            self._response.step(level, self._link, supervisor.is_latched, tau_ext_hat, is_model_valid)
        if not self._reporter.is_open:
            return None
        response = self._response
        report = self._reporter.report(cycle, joints, response.level, response.reaction, response.is_two_sided)
        if report is not None:
            self._link = report.link
        return report

    def _leave(self, state: SchemeState) -> None:
        """Forget the contact that is over."""
        if self._is_reacting:
            self._is_reacting, self._link = False, 0
            self._response.end()
        if state is SchemeState.FAULT:
            self._reporter.cancel()
