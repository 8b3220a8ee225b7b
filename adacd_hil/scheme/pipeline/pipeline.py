"""The scheme: one ArmState in, one SchemeOutput out. No clock, no input or output; the same live and in replay.

A cycle: the state reached so far says what the kernel does, the kernel says where the supervisor goes, and the new
state leaves its traces: an adaptation begins or ends, a contact's report begins or becomes final. Where the schemes
differ, a policy says what is done: `PaperPolicy`, `CertifiedPolicy`.

**Calm cycles.** The supervisor changes its state rarely, and its numbers don't depend on it in between. Every cycle is
asked whether something could happen in it (`Calm`); where nothing could, it is only counted. `step` asks cycle by
cycle; recorded cycles go through a compiled loop up to the first that isn't calm, with the same bits. That one is
concluded, by the same code.

**The interval** between two samples is that between the SYNCs on which they were taken: a sample that comes late was
still taken in time. It is 0 where it is unknown or not to be used.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.records import (
    ArmBatch,
    ArmState,
    ContactReport,
    Event,
    FaultReason,
    Layout,
    Request,
    SchemeOutput,
    SchemeState,
    Vector,
    certified_layout,
    scheme_layout,
)
from adacd_hil.scheme.identify.certificate import Certificate
from adacd_hil.scheme.kernel.kernel_samples import Numbers, Recorded, samples_of
from adacd_hil.scheme.model.regressor import inverse_dynamics
from adacd_hil.scheme.pipeline.certified_policy import CertifiedPolicy
from adacd_hil.scheme.pipeline.scheme_policy import PaperPolicy, SchemePolicy
from adacd_hil.scheme.supervisor.supervisor import Supervisor
from adacd_hil.scheme.supervisor.transitions import (
    CONTACT_SHIFT,
    Calm,
    finding_of,
    findings_of,
)
from adacd_hil.settings.configuration import Settings


class SchemeBatch(NamedTuple):
    """SchemeOutputs of n cycles, as columns.

    cycle (n,) int64; state, previous_state, fault, reaction (n,) uint8; contact_joints (n,) int64; is_model_valid (n,)
    bool; block (n, size). contacts: k reports, contact_places (k,) int64 the rows of their cycles.
    """

    cycle: NDArray[np.int64]
    state: NDArray[np.uint8]
    previous_state: NDArray[np.uint8]
    fault: NDArray[np.uint8]
    reaction: NDArray[np.uint8]
    contact_joints: NDArray[np.int64]
    is_model_valid: NDArray[np.bool_]
    block: Vector
    contacts: list[ContactReport]
    contact_places: NDArray[np.int64]


_LONGEST_CALM = 1024
"""Cycles that are counted together at most."""
_NOTHING_CALM, _NOTHING_JUDGED = Calm(0, 0, 0), ((0.0, 0.0), 0.0)


def layout_of(settings: Settings) -> Layout:
    """Lay out the block of the pipeline that the settings ask for."""
    count = len(settings.estimator.parameter_names)
    if settings.scheme == "certified":
        return certified_layout(count, settings.further_count, settings.channel_count)
    return scheme_layout(count)


def arm_at(arms: ArmBatch, row: int) -> ArmState:
    """Return one row as an ArmState; its vectors are views."""
    age_q, age_tau_J = arms.age_q[row].tolist(), arms.age_tau_J[row].tolist()
    return ArmState(
        cycle=int(arms.cycle[row]),
        t_ns=int(arms.t_ns[row]),
        periods=int(arms.periods[row]),
        q=arms.q[row],
        dq=arms.dq[row],
        tau_J=arms.tau_J[row],
        age_q=(age_q[0], age_q[1]),
        age_tau_J=(age_tau_J[0], age_tau_J[1]),
        is_enabled=bool(arms.is_enabled[row]),
        is_complete=bool(arms.is_complete[row]),
        fault=FaultReason(arms.fault[row]),
        is_late=bool(arms.is_late[row]),
        steps=int(arms.steps[row]),
        sampled_ns=int(arms.sampled_ns[row]),
    )


class SampleIntervals:
    """Turns the stamps of fresh samples into the intervals that the scheme integrates over, s."""

    def __init__(self, settings: Settings) -> None:
        self._is_measuring = settings.realtime.sample_period == "measured"
        self._sampled_ns: int | None = None

    def since_last(self, arm: ArmState) -> float:
        """Take in one cycle; 0 for one without a fresh sample."""
        if not (self._is_measuring and arm.is_complete):
            return 0.0
        sampled_ns = arm.t_ns if arm.sampled_ns is None else arm.sampled_ns
        period_s = 0.0 if self._sampled_ns is None else (sampled_ns - self._sampled_ns) * 1e-9
        self._sampled_ns = sampled_ns
        return period_s

    def between(self, arms: ArmBatch) -> Vector:
        """Take in n cycles and return the interval before each (n,); 0 for one without a fresh sample."""
        periods_s = np.zeros(arms.cycle.size)
        sampled_ns = arms.sampled_ns[arms.is_complete]
        if not self._is_measuring or not sampled_ns.size:
            return periods_s
        first_ns = sampled_ns[0] if self._sampled_ns is None else self._sampled_ns
        periods_s[arms.is_complete] = np.diff(sampled_ns, prepend=first_ns) * 1e-9
        self._sampled_ns = int(sampled_ns[-1])
        return periods_s


class CalmStretch:
    """The calm cycles since the last one that was concluded, which nobody has counted yet."""

    def __init__(self) -> None:
        self.count = 0
        self._bounds, self._judged = _NOTHING_CALM, _NOTHING_JUDGED
        self._periods = 0
        self._observations = np.zeros(_LONGEST_CALM, dtype=np.int64)
        self._passed = np.zeros(_LONGEST_CALM, dtype=np.int64)

    def begin(self, bounds: Calm, judged: tuple[tuple[float, float], float]) -> None:
        """Draw the bounds for the cycles that follow. judged: of the contact, a way and the least torque along it."""
        self.count = self._periods = 0
        self._bounds, self._judged = bounds, judged

    def holds(self, arm: ArmState, observation: int, tau_ext_hat: Vector) -> bool:
        """Tell whether a cycle is within the bounds; `take` it then."""
        watched, expected, cycles, periods, due = self._bounds
        (way_1, way_2), least_Nm = self._judged
        torque_1, torque_2 = tau_ext_hat.tolist()
        return (
            self.count < min(cycles, _LONGEST_CALM)
            and (observation | finding_of(arm)) & watched == expected
            and self._periods + arm.periods < periods
            and arm.cycle < due
            and torque_1 * way_1 + torque_2 * way_2 >= least_Nm
        )

    def take(self, arm: ArmState, observation: int) -> None:
        """Keep what is to be counted of a calm cycle."""
        self._observations[self.count], self._passed[self.count] = observation, arm.periods
        self.count += 1
        self._periods += arm.periods

    @property
    def taken(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Observations and periods of the cycles (n,)."""
        return self._observations[: self.count], self._passed[: self.count]


class Pipeline:
    """Adaptation and contact detection for one run, by the scheme that the settings ask for."""

    def __init__(self, settings: Settings) -> None:
        self._supervisor = Supervisor(settings)
        self._policy: SchemePolicy = (
            CertifiedPolicy(settings, self._supervisor)
            if settings.scheme == "certified"
            else PaperPolicy(settings, self._supervisor)
        )
        self._intervals = SampleIntervals(settings)
        self._stretch = CalmStretch()
        self._open: tuple[ArmState, int, Vector] | None = None  # the calm cycle that is to be completed
        self._theta_hat = layout_of(settings).slices["theta_hat"]
        block = self.numbers.block[0]
        self._q, self._dq, self._tau_J, self._period_s = (block[name] for name in ("q", "dq", "tau_J", "period_s"))

    @property
    def numbers(self) -> Numbers:
        """What the kernel works on, for studies that look into it."""
        return self._policy.numbers

    def compile(self) -> None:
        """Run every compiled function of the cycle once, on copies, so that nothing compiles later."""
        inverse_dynamics(np.zeros(2), np.zeros(2), np.zeros(2), self._policy.theta_ff, 0.0)
        self._policy.contacts.compile()
        self._policy.compile()

    @property
    def compiled_functions(self) -> tuple[object, ...]:
        """The largest that `compile` runs."""
        return self._policy.compiled_functions

    def compile_longest(self) -> None:
        """Compile about half of it, what `compile` comes to last: for another process, at the same time."""
        self._policy.compile_longest()

    def describe_missing(self) -> list[str]:
        """Say what an adaptation that takes too long is waiting for, a line each; none of the paper's, eq. (15)."""
        return self._policy.describe_missing()

    def describe_withheld(self) -> list[str]:
        """Say what contradicts a certificate that is withheld, a line each."""
        return self._policy.describe_withheld()

    @property
    def certificates(self) -> tuple[Certificate, ...]:
        """The certificates of the run that were not taken back, in order; the paper has none."""
        return self._policy.certificates

    def take_events(self) -> list[Event]:
        """Return what is worth a line since the last call: a margin that has shrunk, a certificate."""
        return self._policy.take_events()

    def step(self, arm: ArmState, request: Request = Request.NONE) -> SchemeOutput:
        """Take in one cycle."""
        output = self.decide(arm, request)
        self.complete()
        return output

    def decide(self, arm: ArmState, request: Request = Request.NONE) -> SchemeOutput:
        """Take in one cycle; `theta_hat` and `block` of the output hold once `complete` has been called."""
        self.complete()
        self._q[:] = arm.q
        self._dq[:] = arm.dq
        self._tau_J[:] = arm.tau_J
        self._period_s[0] = self._intervals.since_last(arm)
        policy, stretch = self._policy, self._stretch
        observation = policy.step(int(arm.is_complete), int(arm.steps))
        if request is Request.NONE and stretch.holds(arm, observation, policy.tau_ext_hat) and policy.is_calm:
            block = np.empty(self.numbers.values.size)
            self._open = arm, observation, block
            return self._output(arm.cycle, self._supervisor.state, observation, None, block)
        policy.step_beside(int(arm.is_complete), int(arm.steps))
        self._count_calm()
        output = self._conclude(arm, request, observation)
        stretch.begin(self._calm(arm.cycle + 1), policy.contacts.judged)
        return output

    def complete(self) -> None:
        """Do what no decision of this cycle depends on; again, nothing."""
        if self._open is None:
            return
        (arm, observation, block), self._open = self._open, None
        policy, stretch = self._policy, self._stretch
        policy.step_beside(int(arm.is_complete), int(arm.steps))
        block[:] = self.numbers.values
        policy.observe_calm(stretch.count)
        stretch.take(arm, observation)

    def _count_calm(self) -> None:
        """Let the supervisor and the policy count the calm cycles since the last concluded one."""
        self.complete()
        stretch = self._stretch
        if stretch.count:
            self._supervisor.pass_by(*stretch.taken)
            self._policy.pass_by(stretch.count)
        stretch.begin(_NOTHING_CALM, _NOTHING_JUDGED)

    def _conclude(self, arm: ArmState, request: Request, observation: int) -> SchemeOutput:
        """Do what comes after the numbers in a cycle in which something could happen."""
        policy, supervisor, contacts = self._policy, self._supervisor, self._policy.contacts
        previous = supervisor.state
        observation = policy.take(request, observation)
        block = self.numbers.values.copy()
        supervisor.step(arm, request, observation, contacts.is_reporting, contacts.goes_on)
        policy.follow(previous, arm.cycle, observation)
        contact = policy.report(arm.cycle, observation)
        return self._output(arm.cycle, previous, observation, contact, block)

    def _output(
        self, cycle: int, previous: SchemeState, observation: int, contact: ContactReport | None, block: Vector
    ) -> SchemeOutput:
        policy, supervisor = self._policy, self._supervisor
        return SchemeOutput(
            cycle=cycle,
            state=supervisor.state,
            previous_state=previous,
            fault=supervisor.fault,
            contact_joints=observation >> CONTACT_SHIFT,
            is_model_valid=policy.is_model_valid,
            theta_hat=block[self._theta_hat],
            theta_ff=policy.theta_ff,
            tau_ext_hat=policy.tau_ext_hat.copy(),
            contact=contact,
            block=block,
            reaction=policy.contacts.reaction,
        )

    def run(self, arms: ArmBatch, requests: NDArray[np.uint8]) -> SchemeBatch:
        """Take in n cycles, as `step` does one by one. requests (n,): of `Request`."""
        count = arms.cycle.size
        policy, supervisor = self._policy, self._supervisor
        self._count_calm()
        samples = samples_of(arms, self._intervals.between(arms), findings_of(arms))
        recorded = Recorded(np.zeros(count, dtype=np.int64), np.empty((count, self.numbers.values.size)))
        state, previous_state, fault, reaction = (np.zeros(count, dtype=np.uint8) for _ in range(4))
        is_model_valid = np.zeros(count, dtype=np.bool_)
        contacts: dict[int, ContactReport] = {}
        looks = [*np.flatnonzero(requests).tolist(), count - 1]
        first = 0
        while first < count:
            while looks[0] < first:
                del looks[0]
            calm = self._calm(int(samples.cycle[first]))
            last = max(min(looks[0], first + calm.cycles), first)
            row = policy.run(samples, recorded, first, last, calm)
            if row > first:
                past = slice(first, row)
                supervisor.pass_by(recorded.observations[past], samples.periods[past])
                policy.pass_by(row - first)
                state[past] = previous_state[past] = supervisor.state
                fault[past] = supervisor.fault
                reaction[past], is_model_valid[past] = policy.contacts.reaction, policy.is_model_valid
            output = self._conclude(arm_at(arms, row), Request(requests[row]), int(recorded.observations[row]))
            state[row], previous_state[row], fault[row] = output.state, output.previous_state, output.fault
            reaction[row], is_model_valid[row] = output.reaction, output.is_model_valid
            recorded.observations[row] |= output.contact_joints << CONTACT_SHIFT
            if output.contact is not None:
                contacts[row] = output.contact
            first = row + 1
        return SchemeBatch(
            cycle=samples.cycle,
            state=state,
            previous_state=previous_state,
            fault=fault,
            reaction=reaction,
            contact_joints=recorded.observations >> CONTACT_SHIFT,
            is_model_valid=is_model_valid,
            block=recorded.blocks,
            contacts=list(contacts.values()),
            contact_places=np.array(list(contacts), dtype=np.int64),
        )

    def _calm(self, cycle: int) -> Calm:
        """Return bounds within which the next cycles, from this one on, need not be concluded."""
        contacts = self._policy.contacts
        calm = self._supervisor.calm(contacts.is_reporting, contacts.goes_on)
        return self._policy.calm(contacts.calm(calm, cycle))
