"""What only the certified scheme does: it learns with a certificate, watches it, and takes it back.

The paper's scheme runs beside on the same stream: it adapts when this one does, ends by eq. (15), and its would-be
alarms are in the block; it decides nothing.
"""

import numpy as np

from adacd_hil.records import PARAMETER_UNITS, ContactReport, Event, Request, SchemeState
from adacd_hil.scheme.contact.contact_report import RecalledContact
from adacd_hil.scheme.contact.reaction import ContactCourse, ReactionChoice
from adacd_hil.scheme.detect import margin
from adacd_hil.scheme.detect.margin import MarginWatch
from adacd_hil.scheme.identify import anchor, earlier, termination
from adacd_hil.scheme.identify.certificate import Certificate
from adacd_hil.scheme.identify.doubt import Doubt
from adacd_hil.scheme.identify.doubt import begin as begin_doubt
from adacd_hil.scheme.kernel import certified_kernel, certified_memory, paper_kernel
from adacd_hil.scheme.kernel.kernel_samples import Recorded, Samples
from adacd_hil.scheme.kernel.paper_kernel import PaperShadow
from adacd_hil.scheme.model import filter_bank
from adacd_hil.scheme.pipeline.certificate_watch import CertificateWatch
from adacd_hil.scheme.pipeline.scheme_policy import SchemePolicy
from adacd_hil.scheme.supervisor.supervisor import LEARNING, REACTING, Supervisor
from adacd_hil.scheme.supervisor.transitions import CONTACT_SHIFT, WITHHELD, Calm, SchemeEvent
from adacd_hil.settings.configuration import Settings

FORGOTTEN_S = 1.0
"""An arm at rest is asked so long after a stop whether something pushes it: the slowest filter has forgotten 40 Nm."""
_WATCH = certified_kernel.WATCH
_MODES = {
    SchemeState.COMMISSION: certified_kernel.MEASURE,
    SchemeState.ENABLE: _WATCH,
    SchemeState.ADAPT: _WATCH | certified_kernel.LEARN,
    SchemeState.CERTIFY: _WATCH | certified_kernel.TEST,
    SchemeState.MONITOR: _WATCH | certified_kernel.REFINE,
    SchemeState.REACT: _WATCH,
    SchemeState.STOPPED: _WATCH,
    SchemeState.PAYLOAD: _WATCH,
}


class CertifiedPolicy(SchemePolicy):
    """Adaptation with a certificate. A model is valid while it has one, while another payload is learnt on it too."""

    def __init__(self, settings: Settings, supervisor: Supervisor) -> None:
        self.numbers = certified_memory.numbers_of(settings)
        m, out = self.numbers.memory[0], self.numbers.block[0]
        self._names = certified_memory.parameter_names(settings)
        self._promotions = out["promotions"]
        self.tau_ext_hat = m["y"][filter_bank.WIDE]  # what a reaction goes by: fast, and smooth
        self._evidence = RecalledContact(
            settings, out["q"], out["tau_ext_wide_hat"], m["wide_sigma"], m["wide_threshold"]
        )
        self.contacts = ContactCourse(self._evidence, ReactionChoice(settings), self.tau_ext_hat)
        self._paper = PaperShadow(settings)
        self.supervisor = supervisor
        self.theta_ff = np.zeros(len(settings.estimator.parameter_names))
        self.is_model_valid = False
        self._is_payload = False
        self._has_forgotten = False
        self._refined = 0.0
        self._peak_share = m["peak_share"]
        self._margin = MarginWatch(self._peak_share.size)
        self._period_s = settings.bus.period_s
        self._second = round(1.0 / self._period_s)
        self._monitored = 0
        self._until_push = 0
        self._warned: set[str] = set()
        self._events: list[Event] = []
        self._watch = CertificateWatch(self.numbers.constants, self.numbers.memory, settings.history.date_utc)
        self._doubt = Doubt(settings, self.numbers.constants, self.numbers.memory)

    compiled_functions = (
        certified_kernel.begin_adaptation,
        certified_kernel.step,
        certified_kernel.begin_test,
        certified_kernel.begin_refinement,
        paper_kernel.begin_adaptation,
        paper_kernel.step_shadow,
    )

    def compile(self) -> None:
        """Run every compiled function of the cycle once, on copies."""
        constants, memory, block, _ = self.numbers
        memory, block = memory.copy(), block.copy()
        certified_kernel.begin_adaptation(constants, memory, False, True)
        certified_kernel.step(constants, memory, block, 1, 1, _WATCH | certified_kernel.LEARN)
        certified_kernel.begin_test(constants, memory)
        certified_kernel.begin_refinement(constants, memory)
        earlier.forget(memory[0])
        begin_doubt(constants[0], memory[0])
        anchor.tightest(constants[0], memory[0], 0)
        self._doubt.compile()
        self._paper.compile(self.numbers.block)

    def compile_longest(self) -> None:
        """Compile how a sample is learnt from, half of what a step takes, and the paper's scheme."""
        constants, memory, block, _ = self.numbers
        certified_kernel.improve(constants[0], memory.copy()[0], block.copy()[0], False, certified_kernel.LEARN)
        self._paper.compile(block)

    def describe_missing(self) -> list[str]:
        """Say what an adaptation that takes too long is waiting for, a line each."""
        constants, memory, _, _ = self.numbers
        missing = termination.describe_missing(constants[0], memory[0], self._names, PARAMETER_UNITS)
        return [*self._watch.describe(), *missing]

    def describe_withheld(self) -> list[str]:
        """Say what contradicts a certificate that is withheld, a line each."""
        return self._watch.describe()

    @property
    def certificates(self) -> tuple[Certificate, ...]:
        """The certificates of the run that were not taken back, in order."""
        return self._watch.certificates

    def take_events(self) -> list[Event]:
        """Return what is worth a line since the last call."""
        events, self._events = self._events, []
        return events

    @property
    def _mode(self) -> int:
        """What the numbers do in the state reached so far."""
        supervisor = self.supervisor
        is_weighed = supervisor.state is SchemeState.REACT and supervisor.origin is SchemeState.MONITOR
        return _MODES.get(supervisor.state, 0) | (certified_kernel.WEIGH if is_weighed else 0)

    def step(self, is_complete: int, steps: int) -> int:
        """Take in the sample that is in the block."""
        constants, memory, block, _ = self.numbers
        return certified_kernel.step(constants, memory, block, is_complete, steps, self._mode)

    def step_beside(self, is_complete: int, steps: int) -> None:
        """Let the paper's scheme take the sample in."""
        self._paper.step(self.numbers.block, is_complete, steps)

    def run(self, samples: Samples, recorded: Recorded, first: int, last: int, calm: Calm) -> int:
        """Run the numbers to the first cycle that isn't calm."""
        row, self._paper.mode = certified_kernel.run_certified(
            self.numbers,
            self._paper.numbers,
            samples,
            recorded,
            first,
            last,
            self._mode,
            self._paper.mode,
            calm,
            self._evidence.history.rows,
            self._evidence.history.count,
            self.contacts.judged,
            self._refined,
        )
        return row

    def calm(self, calm: Calm) -> Calm:
        """Narrow the bounds to the next judgement of the margin, or of a push at rest."""
        if self.supervisor.state is SchemeState.MONITOR:
            return calm._replace(cycles=min(calm.cycles, self._second - self._monitored - 1))
        return calm._replace(cycles=min(calm.cycles, self._until_push - 1)) if self._until_push else calm

    @property
    def is_calm(self) -> bool:
        """Whether no model has taken over in this cycle."""
        return bool(self._promotions[0] == self._refined)

    def pass_by(self, cycles: int) -> None:
        """Count calm cycles, those of monitoring, and those until a push at rest is judged."""
        super().pass_by(cycles)
        self._monitored += cycles if self.supervisor.state is SchemeState.MONITOR else 0
        self._until_push = max(self._until_push - cycles, 0)

    def take(self, request: Request, observation: int) -> int:
        """Believe what was refused last if the user says so: then nothing is withheld in this cycle."""
        if request is Request.ACCEPT:
            observation &= ~WITHHELD if self._watch.is_refusing else ~0
            self._events.append(self._watch.accept())
        return observation

    def follow(self, previous: SchemeState, cycle: int, observation: int) -> SchemeState:
        """Take in what the kernel has found, and begin what a new state begins with."""
        state = self.supervisor.state
        if observation & WITHHELD and previous is not SchemeState.MONITOR:
            self._say(self._watch.refuse(is_reading=previous is SchemeState.COMMISSION))
        if state is not previous:
            state = self._weigh(state, previous, cycle, observation >> CONTACT_SHIFT != 0)
            self._say(self._watch.enter(previous, state))
            self._enter(state, previous)
        elif observation & WITHHELD and state is SchemeState.ADAPT:
            self._learn_anew(is_first=False)
        if self._promotions[0] != self._refined:
            self._feed_forward()
        return state

    def report(self, cycle: int, observation: int) -> ContactReport | None:
        """Return the contact's report that is due; forget what a touch has spoilt, and watch the margin."""
        contact = super().report(cycle, observation)
        self._forget_if_disturbed(self.supervisor.state)
        self._watch_margin(self.supervisor.state)
        self._watch_push(self.supervisor.state, observation >> CONTACT_SHIFT != 0)
        return contact

    def _say(self, event: Event | None) -> None:
        if event is not None:
            self._events.append(event)

    def _watch_margin(self, state: SchemeState) -> None:
        """Judge once a second of monitoring how far residuals stayed below thresholds, and what would be found."""
        self._monitored += 1 if state is SchemeState.MONITOR else 0
        if self._monitored < self._second:
            return
        self._monitored = 0
        self._margin.add(self._peak_share.copy())
        self._peak_share[:] = 0.0
        dim = "; ".join(margin.describe_dim(self.numbers.memory[0]))
        for name, warning in (("margin", self._margin.warning), ("sight", dim)):
            if warning and name not in self._warned:
                self._events.append(Event("warning", name, warning))
            self._warned = self._warned | {name} if warning else self._warned - {name}

    def _watch_push(self, state: SchemeState, is_touched: bool) -> None:
        """Say what pushes the arm at rest, once the filters have forgotten a hand that has gone."""
        if self._until_push == 0:
            return
        self._until_push = self._until_push - 1 if state is SchemeState.STOPPED else 0
        if self._until_push == 0 and is_touched and state is SchemeState.STOPPED:
            self._events.append(self._watch.push(self.numbers.memory[0]["y"][filter_bank.SLOW]))

    def _weigh(self, state: SchemeState, previous: SchemeState, cycle: int, is_touched: bool) -> SchemeState:
        """Take in how a contact of the certified model goes on; return where the arm goes, STOPPED if it is doubted."""
        if previous is SchemeState.MONITOR and state is SchemeState.REACT:
            is_contradicted = self.supervisor.cause is SchemeEvent.CONTRADICTED
            self._doubt.begin(cycle, is_touched, self._watch.contradiction() if is_contradicted else None)
        is_over = previous is SchemeState.REACT and state in (SchemeState.MONITOR, SchemeState.STOPPED)
        if is_over and self.supervisor.origin is SchemeState.MONITOR:
            verdict = self._doubt.end(cycle)
            if verdict is not None and not self.contacts.goes_on:
                self._events.append(self._watch.doubt(verdict))
                return self.supervisor.doubt()
            again = self._doubt.describe_again()
            self._say(Event("info", "touch", again) if again else None)
            if is_touched and state is SchemeState.STOPPED:
                self._until_push = round(FORGOTTEN_S / self._period_s)
        if state is SchemeState.MONITOR:
            self._doubt.go_on(cycle)
        return state

    def _enter(self, state: SchemeState, previous: SchemeState) -> None:
        """Do what a new state begins with, and what the previous one ends with."""
        if state is SchemeState.ADAPT:
            self._begin_adaptation(previous)
        elif state is SchemeState.CERTIFY:
            certified_kernel.begin_test(self.numbers.constants, self.numbers.memory)
        elif state is SchemeState.MONITOR and previous is SchemeState.CERTIFY:
            certified_kernel.begin_refinement(self.numbers.constants, self.numbers.memory)
            self._margin.restart()
            self._warned.clear()
            self._doubt.forget()
            self.is_model_valid = True
            self._feed_forward()

    def _begin_adaptation(self, previous: SchemeState) -> None:
        """Begin to learn anew: a payload on top of the certified arm, until that has failed; else everything."""
        cause = self.supervisor.cause
        if cause is SchemeEvent.REVOKED:
            self._revoke()
        elif cause in (SchemeEvent.ENABLED, SchemeEvent.PAYLOAD_CHANGED):
            self._is_payload = self.is_model_valid
            self._paper.begin_adaptation()
        elif previous is SchemeState.CERTIFY:
            self._is_payload = False
        is_first = cause in (SchemeEvent.REVOKED, SchemeEvent.ENABLED, SchemeEvent.PAYLOAD_CHANGED)
        self._learn_anew(is_first)

    def _learn_anew(self, is_first: bool) -> None:
        certified_kernel.begin_adaptation(self.numbers.constants, self.numbers.memory, self._is_payload, is_first)

    def _revoke(self) -> None:
        """Take back the certificate: nothing is known of the arm, and nothing is fed forward."""
        self._is_payload = self.is_model_valid = False
        self.theta_ff = np.zeros(self.theta_ff.size)
        self._events.append(self._watch.revoke())
        earlier.forget(self.numbers.memory[0])
        self._paper.begin_adaptation()

    def _forget_if_disturbed(self, state: SchemeState) -> None:
        """Once a contact that interrupted an adaptation is reported, forget what this adaptation has learnt.

        It may have learnt the contact's beginning, or this may be no contact but an earlier one that was learnt. Then
        only a model that claims to know nothing lets the arm go on.
        """
        is_disturbed = state in REACTING and self.supervisor.origin in LEARNING
        is_reported = is_disturbed and not self.contacts.is_reporting
        if is_reported and not self._has_forgotten:
            self._learn_anew(is_first=False)
        self._has_forgotten = is_reported

    def _feed_forward(self) -> None:
        """Take the model in use for the feedforward from now on."""
        self.theta_ff = np.array(self.numbers.memory[0]["theta"][: self.theta_ff.size])
        self._refined = float(self._promotions[0])
