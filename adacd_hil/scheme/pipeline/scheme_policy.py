"""What one scheme does differently from the other: the base of the policies, and the paper's.

The paper's `theta_hat` is the live estimate, after this cycle's correction; tau_f_hat of the same block was predicted
before it.
"""

from abc import ABC, abstractmethod

import numpy as np

from adacd_hil.records import ContactReport, Event, Request, SchemeState, Vector, scheme_layout
from adacd_hil.scheme.contact.contact_report import IntegratedContact
from adacd_hil.scheme.contact.reaction import ContactCourse, PaperReaction
from adacd_hil.scheme.identify.certificate import Certificate
from adacd_hil.scheme.kernel import paper_kernel
from adacd_hil.scheme.kernel.kernel_samples import Numbers, Recorded, Samples
from adacd_hil.scheme.model.regressor import is_positive_definite
from adacd_hil.scheme.supervisor.supervisor import Supervisor
from adacd_hil.scheme.supervisor.transitions import Calm, SchemeEvent
from adacd_hil.settings.configuration import Settings


class SchemePolicy(ABC):
    """What a pipeline asks its scheme: the numbers of a cycle, and what a state begins and ends with.

    supervisor: of the pipeline. contacts: of the arm. tau_ext_hat (2,): external torque that is reported in each cycle,
    Nm, a view. theta_ff: what the last finished adaptation left, for the feedforward, zeros before. is_model_valid:
    theta_ff may be fed forward.
    """

    supervisor: Supervisor
    numbers: Numbers
    contacts: ContactCourse
    tau_ext_hat: Vector
    theta_ff: Vector
    is_model_valid: bool

    compiled_functions: tuple[object, ...]
    """The largest that `compile` runs."""

    @abstractmethod
    def compile(self) -> None:
        """Run every compiled function of the cycle once, on copies, so that nothing compiles later."""

    def compile_longest(self) -> None:
        """Compile about half of it, what `compile` comes to last; nothing where all of it takes a moment."""

    @abstractmethod
    def step(self, is_complete: int, steps: int) -> int:
        """Take in the sample that is in the block; return bits of `Observation`. Arguments as for the kernels."""

    @abstractmethod
    def run(self, samples: Samples, recorded: Recorded, first: int, last: int, calm: Calm) -> int:
        """Run the numbers to the first cycle that isn't calm, at most to `last`; return its row."""

    @abstractmethod
    def follow(self, previous: SchemeState, cycle: int, observation: int) -> SchemeState:
        """Do what a new state begins with, and what the previous one ends with; return where the arm is then.

        After the supervisor's step, in each cycle.
        """

    def step_beside(self, is_complete: int, steps: int) -> None:
        """Take the sample in beside what decides; arguments as for `step`, which comes before it."""

    def take(self, request: Request, observation: int) -> int:  # noqa: ARG002
        """Take in a request before the supervisor does; return the observation as it stands then."""
        return observation

    def report(self, cycle: int, observation: int) -> ContactReport | None:
        """Return the contact's report that is due, after all else in each cycle."""
        return self.contacts.step(cycle, self.supervisor, observation, self.is_model_valid)

    def calm(self, calm: Calm) -> Calm:
        """Narrow the bounds to those within which only `pass_by` is to be called."""
        return calm

    @property
    def is_calm(self) -> bool:
        """Whether the numbers of this cycle, beside its observation, leave everything as it is."""
        return True

    def observe_calm(self, passed: int) -> None:
        """Take in a calm cycle that `pass_by` will count; `passed`: calm ones before it, not counted yet."""
        self.contacts.evidence.observe_calm(passed)

    def pass_by(self, cycles: int) -> None:
        """Count calm cycles."""
        self.contacts.pass_by(cycles)

    def describe_missing(self) -> list[str]:
        """Say what an adaptation that takes too long is waiting for, a line each."""
        return []

    def describe_withheld(self) -> list[str]:
        """Say what contradicts a certificate that is withheld, a line each."""
        return []

    @property
    def certificates(self) -> tuple[Certificate, ...]:
        """The certificates of the run that were not taken back, in order."""
        return ()

    def take_events(self) -> list[Event]:
        """Return what is worth a line since the last call."""
        return []


_MODES = {
    state: (paper_kernel.LEARN if state is SchemeState.ADAPT else 0)
    | (paper_kernel.ARMED if state in (SchemeState.MONITOR, SchemeState.REACT, SchemeState.STOPPED) else 0)
    for state in SchemeState
}


class PaperPolicy(SchemePolicy):
    """The paper's scheme: no certificate, and one condition for what an adaptation waits for, eq. (15).

    A model is valid once an adaptation has finished with a mass matrix that is positive definite everywhere. It stays
    so during later adaptations.
    """

    def __init__(self, settings: Settings, supervisor: Supervisor) -> None:
        self.numbers = paper_kernel.numbers_of(settings)
        places = scheme_layout(len(settings.estimator.parameter_names)).slices
        memory, values = self.numbers.memory[0], self.numbers.values
        self.tau_ext_hat = values[places["tau_ext_hat"]]
        evidence = IntegratedContact(settings, self.tau_ext_hat, memory["integral"], memory["peak"])
        self.contacts = ContactCourse(evidence, PaperReaction(settings), self.tau_ext_hat)
        self._theta_hat = values[places["theta_hat"]]
        self.theta_ff = np.zeros(self._theta_hat.size)
        self.is_model_valid = False
        self.supervisor = supervisor

    compiled_functions = (paper_kernel.begin_adaptation, paper_kernel.step)

    def compile(self) -> None:
        """Run every compiled function of the cycle once, on copies."""
        constants, memory, block, _ = self.numbers
        memory, block = memory.copy(), block.copy()
        paper_kernel.begin_adaptation(constants, memory, block)
        paper_kernel.step(constants, memory, block, 1, 1, paper_kernel.LEARN)

    @property
    def _mode(self) -> int:
        """What the numbers do in the state reached so far."""
        return _MODES[self.supervisor.state] | (paper_kernel.REPORTING if self.contacts.is_reporting else 0)

    def step(self, is_complete: int, steps: int) -> int:
        """Take in the sample that is in the block."""
        constants, memory, block, _ = self.numbers
        return paper_kernel.step(constants, memory, block, is_complete, steps, self._mode)

    def run(self, samples: Samples, recorded: Recorded, first: int, last: int, calm: Calm) -> int:
        """Run the numbers to the first cycle that isn't calm."""
        return paper_kernel.run_paper(self.numbers, samples, recorded, first, last, self._mode, calm)

    def follow(self, previous: SchemeState, cycle: int, observation: int) -> SchemeState:  # noqa: ARG002
        """Begin an adaptation, or take over what it has come to."""
        state = self.supervisor.state
        if previous is SchemeState.ADAPT and state is SchemeState.MONITOR:
            self.theta_ff = self._theta_hat.copy()
            self.is_model_valid = is_positive_definite(self.theta_ff)
        elif state is SchemeState.ADAPT and previous is not state:
            if self.supervisor.cause is SchemeEvent.REVOKED:
                self.theta_ff = np.zeros(self.theta_ff.size)
                self.is_model_valid = False
            paper_kernel.begin_adaptation(self.numbers.constants, self.numbers.memory, self.numbers.block)
        return state
