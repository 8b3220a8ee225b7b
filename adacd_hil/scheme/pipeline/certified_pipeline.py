"""The certified scheme: one ArmState in, one SchemeOutput out, as `adacd_hil.scheme.pipeline.paper_pipeline`.

A cycle: the state reached so far says what the numbers do (`certified_kernel.step`), the numbers say where the
supervisor goes, and the new state leaves its traces. The paper's scheme runs beside on the same stream: it adapts when
this one does, ends by eq. (15), and its would-be alarms are in the block; it decides nothing.
"""

import numpy as np

from adacd_hil.records import (
    PARAMETER_UNITS,
    ArmState,
    Event,
    Reaction,
    Request,
    SchemeOutput,
    SchemeState,
    certified_layout,
)
from adacd_hil.scheme.detect import margin
from adacd_hil.scheme.detect.margin import MarginWatch
from adacd_hil.scheme.identify import earlier, termination
from adacd_hil.scheme.identify.doubt import Doubt
from adacd_hil.scheme.identify.last_certificate import Certificate
from adacd_hil.scheme.kernel import certified_kernel, certified_memory
from adacd_hil.scheme.kernel.loop import Numbers, Recorded, Samples, run_certified
from adacd_hil.scheme.kernel.paper_kernel import PaperShadow
from adacd_hil.scheme.model import filter_bank
from adacd_hil.scheme.model.regressor import inverse_dynamics
from adacd_hil.scheme.pipeline.batch import RunsBatches
from adacd_hil.scheme.pipeline.certificate_watch import CertificateWatch
from adacd_hil.scheme.pipeline.contact_course import ContactCourse
from adacd_hil.scheme.pipeline.intervals import Intervals
from adacd_hil.scheme.supervisor.supervisor import LEARNING, REACTING, Supervisor
from adacd_hil.scheme.supervisor.transitions import CONTACT_SHIFT, Calm, Observation, SchemeEvent
from adacd_hil.settings.configuration import Settings

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
_WITHHELD = int(Observation.WITHHELD)


class CertifiedPipeline(RunsBatches):
    """Adaptation with a certificate, and collision detection, for one run."""

    def __init__(self, settings: Settings) -> None:
        base = len(settings.estimator.parameter_names)
        self._names = certified_memory.parameter_names(settings)
        places = certified_layout(base, len(self._names) - base, settings.channel_count).slices
        self._constants = certified_memory.constants_of(settings)
        self._memory = certified_memory.new_memory(settings)
        self._block = certified_memory.new_block(settings)
        self._values = self._block.view(np.float64)
        self._q = self._values[places["q"]]
        self._dq = self._values[places["dq"]]
        self._tau_J = self._values[places["tau_J"]]
        self._period_s = self._values[places["period_s"]]
        self._promotions = self._values[places["promotions"]]
        self._intervals = Intervals(settings)
        self._theta_hat = places["theta_hat"]
        self._tau_ext_hat = self._memory[0]["y"][filter_bank.WIDE]  # what a reaction goes by: fast, and smooth
        self._tau_ext_wide_hat = self._values[places["tau_ext_wide_hat"]]
        self._sigma = self._memory[0]["wide_sigma"]
        self._threshold = self._memory[0]["wide_threshold"]
        self._paper = PaperShadow(settings)
        self._supervisor = Supervisor(settings)
        self._touch = ContactCourse(settings)
        self._theta_ff = np.zeros(base)
        self._has_certificate = False
        self._is_payload = False
        self._has_forgotten = False
        self._refined = 0.0
        self._peak_share = self._memory[0]["peak_share"]
        self._margin = MarginWatch(self._peak_share.size)
        self._second = round(1.0 / settings.bus.period_s)
        self._monitored = 0
        self._warned: set[str] = set()
        self._events: list[Event] = []
        self._watch = CertificateWatch(self._constants, self._memory, settings.history.date_utc)
        self._doubt = Doubt(settings, self._constants, self._memory)

    def compile(self) -> None:
        """Run every compiled function of the cycle once, on copies, so that nothing compiles later."""
        memory, block = self._memory.copy(), self._block.copy()
        certified_kernel.begin_adaptation(self._constants, memory, False, True)
        certified_kernel.step(self._constants, memory, block, 1, 1, _WATCH | certified_kernel.LEARN)
        certified_kernel.begin_test(self._constants, memory)
        certified_kernel.begin_refinement(self._constants, memory)
        earlier.forget(memory[0])
        inverse_dynamics(np.zeros(2), np.zeros(2), np.zeros(2), self._theta_ff)
        self._touch.compile()
        self._doubt.compile()
        self._paper.compile(self._block)

    def describe_missing(self) -> list[str]:
        """Say what an adaptation that takes too long is waiting for, a line each."""
        missing = termination.describe_missing(self._constants[0], self._memory[0], self._names, PARAMETER_UNITS)
        return [*self._watch.describe(), *missing]

    def describe_withheld(self) -> list[str]:
        """Say what contradicts a certificate that is withheld, a line each."""
        return self._watch.describe()

    @property
    def certificates(self) -> tuple[Certificate, ...]:
        """The certificates of the run that were not taken back, in order."""
        return self._watch.certificates

    def step(self, arm: ArmState, request: Request = Request.NONE) -> SchemeOutput:
        """Take in one cycle."""
        self._q[:] = arm.q
        self._dq[:] = arm.dq
        self._tau_J[:] = arm.tau_J
        self._period_s[0] = self._intervals.since_last(arm)
        is_complete, steps = int(arm.is_complete), int(arm.steps)
        observation = certified_kernel.step(self._constants, self._memory, self._block, is_complete, steps, self._mode)
        self._paper.step(self._block, is_complete, steps)
        return self._conclude(arm, request, observation)

    @property
    def _mode(self) -> int:
        """What the numbers do in the state reached so far."""
        supervisor = self._supervisor
        is_weighed = supervisor.state is SchemeState.REACT and supervisor.origin is SchemeState.MONITOR
        return _MODES.get(supervisor.state, 0) | (certified_kernel.WEIGH if is_weighed else 0)

    def _conclude(self, arm: ArmState, request: Request, observation: int) -> SchemeOutput:
        supervisor, touch = self._supervisor, self._touch
        previous = supervisor.state
        if request is Request.ACCEPT:
            observation &= ~_WITHHELD if self._watch.is_refusing else ~0
            self._events.append(self._watch.accept())
        state = supervisor.step(arm, request, observation, touch.is_reporting, touch.goes_on)
        if observation & _WITHHELD and previous is not SchemeState.MONITOR:
            self._say(self._watch.refuse(is_reading=previous is SchemeState.COMMISSION))
        if state is not previous:
            state = self._weigh(state, previous, arm.cycle, observation >> CONTACT_SHIFT != 0)
            self._say(self._watch.enter(previous, state))
            self._enter(state, previous)
        elif observation & _WITHHELD and state is SchemeState.ADAPT:
            certified_kernel.begin_adaptation(self._constants, self._memory, self._is_payload, False)
        if self._promotions[0] != self._refined:
            self._feed_forward()
        block = self._values.copy()
        contact = touch.step(
            arm.cycle,
            supervisor,
            observation,
            arm.q,
            self._tau_ext_hat,
            self._tau_ext_wide_hat,
            self._sigma,
            self._threshold,
            self._has_certificate,
        )
        self._forget_if_disturbed(state)
        self._watch_margin(state)
        return SchemeOutput(
            cycle=arm.cycle,
            state=state,
            previous_state=previous,
            fault=supervisor.fault,
            contact_joints=observation >> CONTACT_SHIFT,
            is_model_valid=self._has_certificate,
            theta_hat=block[self._theta_hat],
            theta_ff=self._theta_ff,
            tau_ext_hat=self._tau_ext_hat.copy(),
            contact=contact,
            block=block,
            reaction=touch.reaction,
        )

    def take_events(self) -> list[Event]:
        """Return what is worth a line since the last call: a margin that has shrunk, a certificate, none."""
        events, self._events = self._events, []
        return events

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
        for name, warning in (("margin", self._margin.warning), ("sight", margin.take_warning(self._memory[0]))):
            if warning and name not in self._warned:
                self._events.append(Event("warning", name, warning))
            self._warned = self._warned | {name} if warning else self._warned - {name}

    def _calm(self, cycle: int) -> Calm:
        supervisor, touch = self._supervisor, self._touch
        calm = touch.calm(supervisor.calm(touch.is_reporting, touch.goes_on), cycle)
        if supervisor.state is not SchemeState.MONITOR:
            return calm
        return calm._replace(cycles=min(calm.cycles, self._second - self._monitored - 1))

    def _advance(self, samples: Samples, recorded: Recorded, first: int, last: int, calm: Calm) -> int:
        paper = self._paper
        row, paper.mode = run_certified(
            Numbers(self._constants, self._memory, self._block, self._values),
            paper.numbers,
            samples,
            recorded,
            first,
            last,
            self._mode,
            paper.mode,
            calm,
            self._touch.watch,
            self._refined,
        )
        return row

    def _pass_by(self, cycles: int) -> None:
        self._touch.pass_by(cycles)
        self._monitored += cycles if self._supervisor.state is SchemeState.MONITOR else 0

    def _standing(self) -> tuple[Reaction, bool]:
        return self._touch.reaction, self._has_certificate

    def _weigh(self, state: SchemeState, previous: SchemeState, cycle: int, is_touched: bool) -> SchemeState:
        """Take in how a contact of the certified model goes on; return where the arm goes, STOPPED if it is doubted."""
        if previous is SchemeState.MONITOR and state is SchemeState.REACT:
            is_contradicted = self._supervisor.cause is SchemeEvent.CONTRADICTED
            self._doubt.begin(cycle, is_touched, self._watch.contradiction() if is_contradicted else None)
        is_over = previous is SchemeState.REACT and state in (SchemeState.MONITOR, SchemeState.STOPPED)
        if is_over and self._supervisor.origin is SchemeState.MONITOR:
            verdict = self._doubt.end(cycle)
            if verdict is not None and not self._touch.goes_on:
                self._events.append(self._watch.doubt(verdict))
                return self._supervisor.doubt()
            if is_touched and state is SchemeState.STOPPED:
                self._events.append(self._watch.push(self._memory[0]["y"][0]))
        if state is SchemeState.MONITOR:
            self._doubt.go_on(cycle)
        return state

    def _enter(self, state: SchemeState, previous: SchemeState) -> None:
        """Do what a new state begins with, and what the previous one ends with."""
        if state is SchemeState.ADAPT:
            self._begin_adaptation(previous)
        elif state is SchemeState.CERTIFY:
            certified_kernel.begin_test(self._constants, self._memory)
        elif state is SchemeState.MONITOR and previous is SchemeState.CERTIFY:
            certified_kernel.begin_refinement(self._constants, self._memory)
            self._margin.restart()
            self._warned.clear()
            self._doubt.forget()
            self._has_certificate = True
            self._feed_forward()

    def _begin_adaptation(self, previous: SchemeState) -> None:
        """Begin to learn anew: a payload on top of the certified arm, until that has failed; else everything."""
        cause = self._supervisor.cause
        if cause is SchemeEvent.REVOKED:
            self._revoke()
        elif cause in (SchemeEvent.ENABLED, SchemeEvent.PAYLOAD_CHANGED):
            self._is_payload = self._has_certificate
            self._paper.begin_adaptation()
        elif previous is SchemeState.CERTIFY:
            self._is_payload = False
        is_first = cause in (SchemeEvent.REVOKED, SchemeEvent.ENABLED, SchemeEvent.PAYLOAD_CHANGED)
        certified_kernel.begin_adaptation(self._constants, self._memory, self._is_payload, is_first)

    def _revoke(self) -> None:
        """Take back the certificate: nothing is known of the arm, and nothing is fed forward."""
        self._is_payload = self._has_certificate = False
        self._theta_ff = np.zeros(self._theta_ff.size)
        self._events.append(self._watch.revoke())
        earlier.forget(self._memory[0])
        self._paper.begin_adaptation()

    def _forget_if_disturbed(self, state: SchemeState) -> None:
        """Once a contact that interrupted an adaptation is reported, forget what this adaptation has learnt.

        It may have learnt the contact's beginning, or this may be no contact but an earlier one that was learnt. Then
        only a model that claims to know nothing lets the arm go on.
        """
        is_disturbed = state in REACTING and self._supervisor.origin in LEARNING
        is_reported = is_disturbed and not self._touch.is_reporting
        if is_reported and not self._has_forgotten:
            certified_kernel.begin_adaptation(self._constants, self._memory, self._is_payload, False)
        self._has_forgotten = is_reported

    def _feed_forward(self) -> None:
        """Take the model in use for the feedforward from now on."""
        self._theta_ff = np.array(self._memory[0]["theta"][: self._theta_ff.size])
        self._refined = float(self._promotions[0])
