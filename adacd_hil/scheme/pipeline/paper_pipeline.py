"""The scheme: one ArmState in, one SchemeOutput out. No clock, no input or output; the same live and in replay.

A cycle: the state reached so far says what the numbers do (`kernel.step`), the numbers say where the supervisor goes,
and the new state leaves its traces: an adaptation begins or ends, a collision's report begins or becomes final.

`theta_hat` is the live estimate, after this cycle's correction; tau_f_hat of the same block was predicted before it.
`theta_ff` is what the last finished adaptation left. `is_model_valid` says that theta_ff may be fed forward: an
adaptation has finished and its mass matrix is positive definite everywhere. It stays so during later adaptations.
"""

import numpy as np

from adacd_hil.records import (
    ArmState,
    ContactReport,
    Event,
    Reaction,
    Request,
    SchemeOutput,
    SchemeState,
    scheme_layout,
)
from adacd_hil.scheme.contact.contact_report import Isolation
from adacd_hil.scheme.identify.last_certificate import Certificate
from adacd_hil.scheme.kernel import paper_kernel
from adacd_hil.scheme.kernel.loop import Numbers, Recorded, Samples, run_paper
from adacd_hil.scheme.model.regressor import inverse_dynamics, is_positive_definite
from adacd_hil.scheme.pipeline.batch import RunsBatches
from adacd_hil.scheme.pipeline.intervals import Intervals
from adacd_hil.scheme.supervisor.supervisor import Supervisor
from adacd_hil.scheme.supervisor.transitions import CONTACT_SHIFT, Calm, SchemeEvent
from adacd_hil.settings.configuration import Settings

_MODES = {
    state: (paper_kernel.LEARN if state is SchemeState.ADAPT else 0)
    | (paper_kernel.ARMED if state in (SchemeState.MONITOR, SchemeState.REACT, SchemeState.STOPPED) else 0)
    for state in SchemeState
}


class Pipeline(RunsBatches):
    """Adaptation and collision detection for one run."""

    def __init__(self, settings: Settings) -> None:
        count = len(settings.estimator.parameter_names)
        places = scheme_layout(count).slices
        self._constants = paper_kernel.constants_of(settings)
        self._memory = paper_kernel.new_memory(count)
        self._block = paper_kernel.new_block(count)
        self._values = self._block.view(np.float64)
        self._q = self._values[places["q"]]
        self._dq = self._values[places["dq"]]
        self._tau_J = self._values[places["tau_J"]]
        self._period_s = self._values[places["period_s"]]
        self._intervals = Intervals(settings)
        self._theta_hat = places["theta_hat"]
        self._tau_ext_hat = places["tau_ext_hat"]
        self._integral = self._memory[0]["integral"]
        self._peak = self._memory[0]["peak"]
        self._supervisor = Supervisor(settings)
        window_cycles = round(settings.detector.isolation_window_s / settings.bus.period_s)
        self._isolation = Isolation(window_cycles, settings.filter.a_rad_s)
        self._reaction = Reaction.NONE
        self._theta_ff = np.zeros(count)
        self._is_model_valid = False

    def compile(self) -> None:
        """Run every compiled function of the cycle once, on copies, so that nothing compiles later."""
        memory, block = self._memory.copy(), self._block.copy()
        paper_kernel.begin_adaptation(self._constants, memory, block)
        paper_kernel.step(self._constants, memory, block, 1, 1, paper_kernel.LEARN)
        inverse_dynamics(np.zeros(2), np.zeros(2), np.zeros(2), self._theta_ff)

    def describe_missing(self) -> list[str]:
        """Say what an adaptation that takes too long is waiting for. The paper's condition is one: eq. (15)."""
        return []

    def describe_withheld(self) -> list[str]:
        """Say what contradicts a certificate that is withheld: the paper has no certificate."""
        return []

    @property
    def certificates(self) -> tuple[Certificate, ...]:
        """The certificates of the run: the paper has none."""
        return ()

    def take_events(self) -> list[Event]:
        """Return what is worth a line since the last call: nothing, the paper watches no margin."""
        return []

    def step(self, arm: ArmState, request: Request = Request.NONE) -> SchemeOutput:
        """Take in one cycle."""
        self._q[:] = arm.q
        self._dq[:] = arm.dq
        self._tau_J[:] = arm.tau_J
        self._period_s[0] = self._intervals.since_last(arm)
        observation = paper_kernel.step(
            self._constants, self._memory, self._block, int(arm.is_complete), int(arm.steps), self._mode
        )
        return self._conclude(arm, request, observation)

    @property
    def _mode(self) -> int:
        """What the numbers do in the state reached so far."""
        return _MODES[self._supervisor.state] | (paper_kernel.REPORTING if self._isolation.is_open else 0)

    def _conclude(self, arm: ArmState, request: Request, observation: int) -> SchemeOutput:
        supervisor, isolation = self._supervisor, self._isolation
        previous = supervisor.state
        state = supervisor.step(arm, request, observation, isolation.is_open)
        joints = observation >> CONTACT_SHIFT
        block = self._values.copy()
        if state is not previous:
            self._enter(state, previous, arm.cycle, joints)
        contact = self._report(arm.cycle, joints) if isolation.is_open else None
        return SchemeOutput(
            cycle=arm.cycle,
            state=state,
            previous_state=previous,
            fault=supervisor.fault,
            contact_joints=joints,
            is_model_valid=self._is_model_valid,
            theta_hat=block[self._theta_hat],
            theta_ff=self._theta_ff,
            tau_ext_hat=block[self._tau_ext_hat],
            contact=contact,
            block=block,
            reaction=self._reaction,
        )

    def _calm(self, cycle: int) -> Calm:  # noqa: ARG002
        return self._isolation.calm(self._supervisor.calm(self._isolation.is_open))

    def _advance(self, samples: Samples, recorded: Recorded, first: int, last: int, calm: Calm) -> int:
        numbers = Numbers(self._constants, self._memory, self._block, self._values)
        return run_paper(numbers, samples, recorded, first, last, self._mode, calm)

    def _pass_by(self, cycles: int) -> None:
        pass

    def _standing(self) -> tuple[Reaction, bool]:
        return self._reaction, self._is_model_valid

    def _enter(self, state: SchemeState, previous: SchemeState, cycle: int, joints: int) -> None:
        """Do what a new state begins with, and what the previous one ends with."""
        if previous is SchemeState.ADAPT and state is SchemeState.MONITOR:
            self._theta_ff = self._values[self._theta_hat].copy()
            self._is_model_valid = is_positive_definite(self._theta_ff)
        if state is SchemeState.ADAPT and self._supervisor.cause is SchemeEvent.REVOKED:
            self._theta_ff = np.zeros(self._theta_ff.size)
            self._is_model_valid = False
        if state is SchemeState.ADAPT:
            paper_kernel.begin_adaptation(self._constants, self._memory, self._block)
        elif state is SchemeState.REACT:
            self._reaction = Reaction.WITHDRAW if joints else Reaction.STOP  # without a contact, the arm is only held
            if joints:
                self._isolation.begin(cycle)
        elif state is SchemeState.FAULT:
            self._isolation.cancel()

    def _report(self, cycle: int, joints: int) -> ContactReport | None:
        """Return the report that begins or becomes final in this cycle, if one does."""
        tau_ext_hat = self._values[self._tau_ext_hat]
        return self._isolation.report(cycle, joints, tau_ext_hat, self._integral, self._peak)
