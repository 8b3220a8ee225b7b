"""The scheme: one ArmState in, one SchemeOutput out. No clock, no input or output; the same live and in replay.

A cycle: the present state selects the kernel's tasks, the kernel's findings move the supervisor, and the new state has
its actions: an adaptation begins or ends, a contact's report begins or becomes final. The actions
that differ between the schemes are methods of `PaperPipeline` and `CertifiedPipeline`; `new_pipeline` chooses one.

The cycle is compiled (`kernel.cycle`), the same live and in a replay. A few cycles have tasks for Python. `_finish`
runs them in the same cycle, before the decision is issued.

**The interval** between two samples is that between the SYNCs on which they were taken: a sample that arrives late was
still taken in time. It is 0 where it is unknown or not to be used.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
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
    Reaction,
    Request,
    SchemeOutput,
    SchemeState,
    Vector,
    certified_layout,
    scheme_layout,
)
from adacd_hil.scheme.contact import course
from adacd_hil.scheme.identify.certificate import Certificate
from adacd_hil.scheme.kernel.cycle import BEFORE_CONTACT, DECISION, REPORT, RunMemory, new_course
from adacd_hil.scheme.kernel.kernel_samples import SAMPLE, Numbers, fill_sample, samples_of
from adacd_hil.scheme.model.regressor import inverse_dynamics
from adacd_hil.scheme.supervisor import supervisor
from adacd_hil.settings.configuration import Settings
from adacd_hil.structured import Structured


class SchemeBatch(NamedTuple):
    """SchemeOutputs of n cycles, as columns.

    cycle (n,) int64; state, previous_state, fault, reaction (n,) uint8; contact_joints (n,) int64, bit i for joint i +
    1; is_model_valid (n,) bool; block (n, size), see `layout_of`. contacts: k reports, contact_places (k,) int64 the
    indices of their cycles.
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


_STATES, _FAULTS, _REACTIONS = tuple(SchemeState), tuple(FaultReason), tuple(Reaction)
"""Members of each enumeration, by number."""


def layout_of(settings: Settings) -> Layout:
    """Return the layout of the values that the selected scheme writes per cycle, its block."""
    count = len(settings.estimator.parameter_names)
    if settings.scheme == "certified":
        return certified_layout(count, settings.further_count, settings.channel_count)
    return scheme_layout(count)


class Pipeline(ABC):
    """Adaptation and contact detection for one run: the compiled cycle, and a scheme's rare tasks in Python.

    numbers: the kernel's arrays. tau_ext_hat (2,): external torque that is reported in each cycle, Nm, a view.
    theta_ff: model for the feedforward, from the last finished adaptation, or refined since; zeros before the first,
    and after REVOKED.
    """

    tau_ext_hat: Vector
    _cycle: Callable[..., int]
    _end: Callable[..., int]
    _run: Callable[..., tuple[int, int]]
    _cycle_arrays: tuple[Vector | Structured, ...]
    """Arrays of the compiled cycle, in its order."""
    _end_arrays: tuple[Vector | Structured, ...]

    def __init__(self, settings: Settings, numbers: Numbers) -> None:
        self.numbers = numbers
        self.theta_ff = np.zeros(len(settings.estimator.parameter_names))
        self._course_constants, self._course_memory = new_course(settings)
        self._course: RunMemory = self._course_memory[0]
        self._sample, self._decision = np.zeros(1, SAMPLE), np.zeros(1, DECISION)
        self._block = np.zeros((1, numbers.values.size))

    @property
    def state(self) -> SchemeState:
        """The scheme's state after the last cycle."""
        return SchemeState(self._course.supervisor.state)

    def _set_valid(self, is_valid: bool) -> None:
        """Set whether the model may be fed forward."""
        self._course.is_model_valid = is_valid

    def compile_cycle(self) -> None:
        """Compile each function of the cycle by a call on copies, so that no later cycle compiles."""
        inverse_dynamics(np.zeros(2), np.zeros(2), np.zeros(2), self.theta_ff, 0.0)
        supervisor.doubt(self._course_memory["supervisor"].copy()[0])
        course.goes_on(self._course.contact)
        samples, decisions, blocks = np.zeros(1, SAMPLE), np.zeros(1, DECISION), np.zeros_like(self._block)
        self._cycle(samples, decisions, blocks, 0, *(array.copy() for array in self._cycle_arrays))
        self._end(samples, decisions, 0, *(array.copy() for array in self._end_arrays))

    def compile_longest(self) -> None:
        """Compile about half of `compile_cycle`'s work, for a second process at the same time.

        Do nothing for a scheme whose compilation takes only a moment.
        """

    @abstractmethod
    def _follow(self, asked: int, previous: SchemeState, cycle: int, observation: int) -> None:
        """Run a scheme's tasks of BEFORE_CONTACT, such as a new state's first actions, before the contact's course.

        asked: bits of the tasks, see `kernel.cycle`. previous: state before this cycle. observation: the cycle's
        findings, see `findings`.
        """

    @abstractmethod
    def _report(self, cycle: int) -> ContactReport:
        """Return the report of the present contact, due in this cycle."""

    def _attend(self, asked: int) -> None:
        """Run a scheme's tasks in `asked`, bits of `kernel.cycle`, at the end of a cycle; none by default."""

    def describe_missing(self) -> list[str]:
        """Return the conditions that an adaptation still waits for, a line each.

        [] in the paper's scheme, also while it waits for eq. (15), excitation or motion.
        """
        return []

    def describe_withheld(self) -> list[str]:
        """Return the contradictions for which a certificate is withheld, as lines; [] without one.

        [] also in the paper's scheme.
        """
        return []

    @property
    def certificates(self) -> tuple[Certificate, ...]:
        """The run's certificates that were not taken back, oldest first; () in the paper's scheme."""
        return ()

    def take_events(self) -> list[Event]:
        """Return the events since the last call, such as a new certificate, and clear them.

        Empty for the paper's scheme.
        """
        return []

    def step(self, arm: ArmState, request: Request = Request.NONE) -> SchemeOutput:
        """Process the sample and request of one cycle; return its state, torques and a contact's report, if due."""
        fill_sample(self._sample, arm, request)
        asked = self._cycle(self._sample, self._decision, self._block, 0, *self._cycle_arrays)
        contact = self._finish(asked, self._sample, self._decision, 0) if asked else None
        state, previous_state, fault, reaction, contact_joints, _, is_model_valid = self._decision.item()
        return SchemeOutput(
            cycle=arm.cycle,
            state=_STATES[state],
            previous_state=_STATES[previous_state],
            fault=_FAULTS[fault],
            contact_joints=contact_joints,
            is_model_valid=bool(is_model_valid),
            theta_ff=self.theta_ff,
            tau_ext_hat=self.tau_ext_hat.copy(),
            contact=contact,
            block=self._block[0].copy(),
            reaction=_REACTIONS[reaction],
        )

    def run(self, arms: ArmBatch, requests: NDArray[np.uint8]) -> SchemeBatch:
        """Process n cycles, the same as `step` on each, and return their outputs as columns, without `theta_ff`.

        requests (n,): values of `Request`.
        """
        count = arms.cycle.size
        samples, decisions = samples_of(arms, requests), np.zeros(count, DECISION)
        blocks = np.empty((count, self.numbers.values.size))
        contacts: dict[int, ContactReport] = {}
        place, asked = self._run(samples, decisions, blocks, 0, self._cycle_arrays)
        while place < count:
            contact = self._finish(asked, samples, decisions, place)
            if contact is not None:
                contacts[place] = contact
            place, asked = self._run(samples, decisions, blocks, place + 1, self._cycle_arrays)
        columns = {
            name: np.ascontiguousarray(decisions[name]) for name in DECISION.names or () if name != "observation"
        }
        return SchemeBatch(
            cycle=np.ascontiguousarray(samples["cycle"]),
            **columns,
            block=blocks,
            contacts=list(contacts.values()),
            contact_places=np.array(list(contacts), dtype=np.int64),
        )

    def _finish(self, asked: int, samples: Structured, decisions: Structured, place: int) -> ContactReport | None:
        """Run the tasks that the compiled cycle leaves to Python; return a due report, or None.

        asked: bits of the tasks. With BEFORE_CONTACT the cycle is not over: its rest runs here, completes the decision
        in place and gives the tasks still to do. place: index of the cycle in samples and decisions.
        """
        cycle = int(samples["cycle"][place])
        if asked & BEFORE_CONTACT:
            previous, observation = SchemeState(decisions["previous_state"][place]), decisions["observation"][place]
            self._follow(asked, previous, cycle, int(observation))
            asked = self._end(samples, decisions, place, *self._end_arrays)
        report = self._report(cycle) if asked & REPORT else None
        self._attend(asked)
        return report
