"""Policies, the differences between the schemes: their base class, and the paper's policy.

The paper's `theta_hat` is the live estimate, after this cycle's correction; tau_f_hat of the same block was predicted
before it.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np

from adacd_hil.records import ContactReport, Event, SchemeState, Vector, scheme_layout
from adacd_hil.scheme.contact import course
from adacd_hil.scheme.contact.contact_report import ContactEvidence, IntegratedContact, report_of
from adacd_hil.scheme.identify.certificate import Certificate
from adacd_hil.scheme.kernel import paper_kernel
from adacd_hil.scheme.kernel.cycle import DECISION, REPORT, end_paper, new_course, paper_cycle, run_paper
from adacd_hil.scheme.kernel.kernel_samples import SAMPLE, Numbers
from adacd_hil.scheme.model.regressor import is_positive_definite
from adacd_hil.scheme.supervisor import supervisor
from adacd_hil.scheme.supervisor.supervisor import Supervisor
from adacd_hil.scheme.supervisor.transitions import SchemeEvent
from adacd_hil.settings.configuration import Settings
from adacd_hil.structured import Structured


class SchemePolicy(ABC):
    """Interface of a scheme to its pipeline: the compiled cycle, and the first and last actions of a state.

    numbers: the kernel's arrays. tau_ext_hat (2,): external torque that is reported in each cycle, Nm, a view.
    theta_ff: model from the last finished adaptation, for the feedforward; zeros before the first.
    """

    numbers: Numbers
    evidence: ContactEvidence
    tau_ext_hat: Vector
    theta_ff: Vector

    compiled_functions: tuple[object, ...]
    """The largest compiled functions that `compile` runs."""
    _cycle: Callable[..., int]
    _end: Callable[..., int]
    _run: Callable[..., tuple[int, int]]
    _cycle_arrays: tuple[Vector | Structured, ...]
    """Arrays of the compiled cycle, in its order."""
    _end_arrays: tuple[Vector | Structured, ...]

    def __init__(self, settings: Settings) -> None:
        self._course_constants, self._course_memory = new_course(settings)
        self._contact = self._course_memory["contact"][0]
        self.supervisor = Supervisor(self._course_memory["supervisor"])

    @property
    def is_model_valid(self) -> bool:
        """Whether theta_ff may be fed forward."""
        return bool(self._course_memory["is_model_valid"][0])

    @is_model_valid.setter
    def is_model_valid(self, is_valid: bool) -> None:
        self._course_memory["is_model_valid"] = is_valid

    def compile(self) -> None:
        """Run each compiled function of the cycle once, on copies, so that no later call compiles."""
        supervisor.doubt(self._course_memory["supervisor"].copy()[0])
        course.goes_on(self._contact)
        self.evidence.compile()
        samples, decisions, blocks = np.zeros(1, SAMPLE), np.zeros(1, DECISION), np.zeros((1, self.numbers.values.size))
        self._cycle(samples, decisions, blocks, 0, *(array.copy() for array in self._cycle_arrays))
        self._end(samples, decisions, 0, *(array.copy() for array in self._end_arrays))

    def compile_longest(self) -> None:
        """Compile the second half of `compile`'s work; skip if the whole takes only a moment."""

    def cycle(self, samples: Structured, decisions: Structured, blocks: Vector) -> int:
        """Process the only cycle of the samples; return bits of its tasks for Python (`kernel.cycle`)."""
        return self._cycle(samples, decisions, blocks, 0, *self._cycle_arrays)

    def run(self, samples: Structured, decisions: Structured, blocks: Vector, first: int) -> tuple[int, int]:
        """Process cycles until one has a task for Python; return its place and the bits of its tasks."""
        return self._run(samples, decisions, blocks, first, self._cycle_arrays)

    def end(self, samples: Structured, decisions: Structured, place: int) -> int:
        """End a cycle that `follow` has attended to; return bits of further tasks for Python."""
        return self._end(samples, decisions, place, *self._end_arrays)

    @abstractmethod
    def follow(self, asked: int, previous: SchemeState, cycle: int, observation: int) -> None:
        """Run the first actions of a new state, and the last ones of the state before, after the supervisor's step."""

    def attend(self, asked: int, cycle: int) -> ContactReport | None:
        """Run the tasks at the end of a cycle; return the contact's report that is due, or None."""
        return report_of(self.evidence, self._contact, cycle) if asked & REPORT else None

    def describe_missing(self) -> list[str]:
        """Return the conditions that an adaptation still waits for, a line each."""
        return []

    def describe_withheld(self) -> list[str]:
        """Return the contradictions of a certificate that is withheld, a line each."""
        return []

    @property
    def certificates(self) -> tuple[Certificate, ...]:
        """The certificates of the run that were not taken back, in order."""
        return ()

    def take_events(self) -> list[Event]:
        """Return the events since the last call."""
        return []


class PaperPolicy(SchemePolicy):
    """The paper's scheme: without a certificate; an adaptation waits for a single condition, eq. (15).

    A model is valid once an adaptation has finished with a mass matrix that is positive definite everywhere. It stays
    so during later adaptations.
    """

    _cycle, _end, _run = staticmethod(paper_cycle), staticmethod(end_paper), staticmethod(run_paper)

    def __init__(self, settings: Settings) -> None:
        super().__init__(settings)
        self.numbers = paper_kernel.numbers_of(settings)
        places = scheme_layout(len(settings.estimator.parameter_names)).slices
        memory, values = self.numbers.memory[0], self.numbers.values
        self.tau_ext_hat = values[places["tau_ext_hat"]]
        self.evidence = IntegratedContact(settings, self.tau_ext_hat, memory["integral"], memory["peak"])
        course.fill_constants(settings, self.evidence.due_cycles, self._course_constants["contact"][0])
        self._theta_hat = values[places["theta_hat"]]
        self.theta_ff = np.zeros(self._theta_hat.size)
        self._cycle_arrays = *self.numbers, self._course_constants, self._course_memory
        self._end_arrays = self.numbers.block, self._course_constants, self._course_memory

    compiled_functions = (paper_kernel.begin_adaptation, paper_cycle)

    def compile(self) -> None:
        """Run every compiled function of the cycle once, on copies."""
        paper_kernel.begin_adaptation(*(array.copy() for array in self.numbers[:3]))
        super().compile()

    def follow(self, asked: int, previous: SchemeState, cycle: int, observation: int) -> None:  # noqa: ARG002
        """Begin an adaptation, or take over its result."""
        state = self.supervisor.state
        if previous is SchemeState.ADAPT and state is SchemeState.MONITOR:
            self.theta_ff = self._theta_hat.copy()
            self.is_model_valid = is_positive_definite(self.theta_ff)
        elif state is SchemeState.ADAPT and previous is not state:
            if self.supervisor.cause is SchemeEvent.REVOKED:
                self.theta_ff = np.zeros(self.theta_ff.size)
                self.is_model_valid = False
            paper_kernel.begin_adaptation(*self.numbers[:3])
