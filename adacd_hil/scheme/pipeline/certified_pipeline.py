"""Tasks of the certified scheme alone: it learns with a certificate, watches it, and takes it back.

The paper's scheme runs beside on the same stream and makes no decision: it adapts with this one and ends by eq. (15);
its would-be alarms are in the block.
"""

import numpy as np

from adacd_hil.records import JOINTS, ContactReport, Event, SchemeState
from adacd_hil.scheme.contact import course
from adacd_hil.scheme.contact.contact_report import compile_recalled, new_rows, recalled_report
from adacd_hil.scheme.detect import sensitivity, sight
from adacd_hil.scheme.detect.margin_watch import MarginWatch
from adacd_hil.scheme.identify import anchor, certificate, doubt, earlier, termination
from adacd_hil.scheme.identify.certificate import Certificate
from adacd_hil.scheme.identify.doubt import Doubt
from adacd_hil.scheme.kernel import certified_kernel, certified_memory, paper_kernel
from adacd_hil.scheme.kernel.cycle import (
    ACCEPTED,
    FORGET,
    PUSHED,
    REFUSED,
    SECOND,
    TOOK_OVER,
    await_push,
    certified_cycle,
    end_certified,
    run_certified,
)
from adacd_hil.scheme.model import filter_bank
from adacd_hil.scheme.pipeline.certificate_watch import CertificateWatch
from adacd_hil.scheme.pipeline.pipeline import Pipeline
from adacd_hil.scheme.supervisor import supervisor
from adacd_hil.scheme.supervisor.findings import CONTACT_SHIFT
from adacd_hil.scheme.supervisor.transitions import SchemeEvent
from adacd_hil.settings.configuration import Settings

FORGOTTEN_S = 1.0
"""Time from a stop to the check whether the arm at rest is pushed: the slowest filter has forgotten 40 Nm by then."""


class CertifiedPipeline(Pipeline):
    """Adaptation with a certificate. A certified model stays valid while another payload is learnt on top of it."""

    _cycle, _end, _run = staticmethod(certified_cycle), staticmethod(end_certified), staticmethod(run_certified)

    def __init__(self, settings: Settings) -> None:
        super().__init__(settings, certified_memory.numbers_of(settings))
        self._settings = settings
        self._k, self._m = self.numbers.constants[0], self.numbers.memory[0]
        self._names = certified_memory.parameter_names(settings)
        self.tau_ext_hat = self._m.filters.y[filter_bank.WIDE]  # for the reactions: fast, and smooth
        self._paper = paper_kernel.numbers_of(settings)[:3]
        self._rows = new_rows(settings)
        shared = self._course_constants, self._course_memory, self._rows
        self._cycle_arrays = *self.numbers, *self._paper, *shared
        self._end_arrays = *self.numbers[:3], *shared
        self._is_payload = False
        self._margin = MarginWatch()
        self._push_cycles = round(FORGOTTEN_S / settings.bus.period_s)
        self._warned: set[str] = set()
        self._events: list[Event] = []
        self._watch = CertificateWatch(self._k, self._m, settings.history.date_utc)
        self._doubt = Doubt(settings, self._k, self._m)

    def compile_cycle(self) -> None:
        """Compile each function of the cycle by a call on copies, so that no later cycle compiles."""
        constants, memory = self.numbers.constants, self.numbers.memory.copy()
        k, m = constants[0], memory[0]
        certified_kernel.begin_adaptation(constants, memory, False, True)
        certified_kernel.begin_test(constants, memory)
        certified_kernel.begin_refinement(constants, memory)
        earlier.is_keeping(m)
        earlier.forget(m)
        certificate.forget(m)
        anchor.accept(m, np.zeros(JOINTS), np.ones(JOINTS))
        anchor.tightest(k, m, 0)
        doubt.begin(k, m)
        sensitivity.raise_strain(m, doubt.MOST_STRAIN)
        compile_recalled(self._settings)
        paper_kernel.begin_adaptation(*(array.copy() for array in self._paper))
        super().compile_cycle()

    def compile_longest(self) -> None:
        """Compile the learning from a sample and the paper's scheme, about half of `compile_cycle`'s work."""
        constants, memory, block, _ = self.numbers
        certified_kernel.improve(constants[0], memory.copy()[0], block.copy()[0], False, certified_kernel.LEARN)
        constants, memory, block = self._paper
        paper_kernel.step(constants, memory.copy(), block.copy(), 1, 1, paper_kernel.LEARN)

    def describe_missing(self) -> list[str]:
        """Return the lines of a present refusal, and a line for each condition that the fit misses; [] without any."""
        return [*self._watch.describe(), *termination.describe_missing(self._k, self._m, self._names)]

    def describe_withheld(self) -> list[str]:
        """Return the lines of a present refusal, see `CertificateWatch.describe`; [] without a refusal."""
        return self._watch.describe()

    @property
    def certificates(self) -> tuple[Certificate, ...]:
        """The run's certificates that were not taken back, oldest first."""
        return self._watch.certificates

    def take_events(self) -> list[Event]:
        """Return the events since the last call, and clear them."""
        events, self._events = self._events, []
        return events

    def _follow(self, asked: int, previous: SchemeState, cycle: int, observation: int) -> None:
        """Carry out the tasks that a cycle's result asks for.

        Report an acceptance or a refusal. At a new state weigh the contact, which may stop the arm, and run the state's
        first actions. After a refusal that stays in ADAPT learn anew. At TOOK_OVER update the feedforward. asked: bits
        of the tasks, see `kernel.cycle`. previous: state before this cycle. observation: the cycle's findings, see
        `findings`.
        """
        state = self.state
        if asked & ACCEPTED:
            self._events.append(self._watch.accept())
        if asked & REFUSED:
            self._add_event(self._watch.refuse())
        if state is not previous:
            state = self._weigh(state, previous, cycle, observation >> CONTACT_SHIFT != 0)
            self._add_event(self._watch.enter(previous, state))
            self._enter(state, previous)
        elif asked & REFUSED and state is SchemeState.ADAPT:
            self._learn_anew(is_first=False)
        if asked & TOOK_OVER:
            self._feed_forward()
        self._course.is_refusing = self._watch.is_refusing

    def _report(self, cycle: int) -> ContactReport:
        return recalled_report(self._settings, self._course.contact, self._rows, cycle)

    def _attend(self, asked: int) -> None:
        """Run the tasks in `asked`, bits of `kernel.cycle`, at a cycle's end.

        FORGET: learn anew without the samples of a touch. SECOND: judge the margin. PUSHED: report a push on the arm at
        rest.
        """
        if asked & FORGET:
            self._learn_anew(is_first=False)
        if asked & SECOND:
            self._judge_margin()
        if asked & PUSHED:
            self._events.append(self._watch.push(self._m.filters.y[filter_bank.SLOW]))

    def _add_event(self, event: Event | None) -> None:
        if event is not None:
            self._events.append(event)

    def _judge_margin(self) -> None:
        """Add the last second's largest residuals over their thresholds to the margin, and set these shares to 0.

        Report a margin that has shrunk, see `MarginWatch.warning`, or smallest pushes over those of the test, see
        `sight.describe_dim`. A warning is reported once, until it has ended.
        """
        self._margin.add_block(sensitivity.take_peak_shares(self._m))
        dim = "; ".join(sight.describe_dim(self._m))
        for name, warning in (("margin", self._margin.warning), ("sight", dim)):
            if warning and name not in self._warned:
                self._events.append(Event("warning", name, warning))
            self._warned = self._warned | {name} if warning else self._warned - {name}

    def _weigh(self, state: SchemeState, previous: SchemeState, cycle: int, is_touched: bool) -> SchemeState:
        """Store the beginning or end of a contact in MONITOR, and the time of going on; return the state after that.

        A common cause of contacts takes the certificate back and stops the arm, unless the reaction lets the arm go on.
        Otherwise report a contact that followed soon on another, and let a joint over its threshold at the stop be
        checked for a push FORGOTTEN_S later. is_touched: a joint is over its threshold in this cycle.
        """
        if previous is SchemeState.MONITOR and state is SchemeState.REACT:
            is_contradicted = self._course.supervisor.cause == SchemeEvent.CONTRADICTED
            self._doubt.begin_contact(cycle, is_touched, self._watch.contradiction() if is_contradicted else None)
        is_over = previous is SchemeState.REACT and state in (SchemeState.MONITOR, SchemeState.STOPPED)
        if is_over and self._course.supervisor.origin == SchemeState.MONITOR:
            verdict = self._doubt.end_contact(cycle)
            if verdict is not None and not course.goes_on(self._course.contact):
                self._events.append(self._watch.doubt(verdict))
                supervisor.doubt(self._course.supervisor)
                return self.state
            again = self._doubt.describe_again()
            self._add_event(Event("info", "touch", again) if again else None)
            if is_touched and state is SchemeState.STOPPED:
                await_push(self._m, self._push_cycles)
        if state is SchemeState.MONITOR:
            self._doubt.go_on(cycle)
        return state

    def _enter(self, state: SchemeState, previous: SchemeState) -> None:
        """Run the first actions of ADAPT, CERTIFY, and of MONITOR after a passed test."""
        if state is SchemeState.ADAPT:
            self._begin_adaptation(previous)
        elif state is SchemeState.CERTIFY:
            certified_kernel.begin_test(*self.numbers[:2])
        elif state is SchemeState.MONITOR and previous is SchemeState.CERTIFY:
            certified_kernel.begin_refinement(*self.numbers[:2])
            self._margin.forget()
            self._warned.clear()
            self._doubt.forget()
            self._set_valid(True)
            self._feed_forward()

    def _begin_adaptation(self, previous: SchemeState) -> None:
        """Begin an adaptation: of a payload if the arm is certified, of the whole arm if not, or after a failed test.

        At REVOKED, a request of the user or the acknowledgement of a doubted model, revoke the certificate first. The
        paper's scheme beside begins one with a first attempt, too. After a contact an interrupted adaptation begins
        anew as it was.
        """
        cause = self._course.supervisor.cause
        is_first = cause in (SchemeEvent.REVOKED, SchemeEvent.ENABLED, SchemeEvent.PAYLOAD_CHANGED)
        if cause == SchemeEvent.REVOKED:
            self._revoke()
        if is_first:
            self._is_payload = bool(self._course.is_model_valid)
            paper_kernel.begin_adaptation(*self._paper)
        elif previous is SchemeState.CERTIFY:
            self._is_payload = False
        self._learn_anew(is_first)

    def _learn_anew(self, is_first: bool) -> None:
        """Begin to learn from the prior, or from the certified arm with a payload; drop the present fit.

        is_first: the adaptation begins; False: it begins again, also after the last report of a contact that
        interrupted it. It may have learnt the beginning of that contact, or an earlier one that has ended. The arm goes
        on only with a model that claims no knowledge.
        """
        certified_kernel.begin_adaptation(*self.numbers[:2], self._is_payload, is_first)

    def _revoke(self) -> None:
        """Take back the certificate for the user and add the event; drop the kept beliefs.

        Set the feedforward's model to 0, and mark it as not valid.
        """
        self._set_valid(False)
        self.theta_ff = np.zeros(self.theta_ff.size)
        self._events.append(self._watch.revoke())
        earlier.forget(self._m)

    def _feed_forward(self) -> None:
        """Copy the parameters of the model in use to `theta_ff`, the feedforward's model."""
        self.theta_ff = np.array(self._m.models.theta[: self.theta_ff.size])
