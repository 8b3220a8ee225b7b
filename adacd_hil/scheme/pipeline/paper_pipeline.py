"""The paper's scheme: without a certificate; an adaptation waits for eq. (15), with enough excitation and motion.

The paper's `theta_hat` is the live estimate, after this cycle's correction; tau_f_hat of the same block was predicted
before it.
"""

import numpy as np

from adacd_hil.records import ContactReport, SchemeState
from adacd_hil.scheme.contact.contact_report import integrated_report
from adacd_hil.scheme.kernel import paper_kernel
from adacd_hil.scheme.kernel.cycle import end_paper, paper_cycle, run_paper
from adacd_hil.scheme.model.regressor import is_positive_definite
from adacd_hil.scheme.pipeline.pipeline import Pipeline
from adacd_hil.scheme.supervisor.transitions import SchemeEvent
from adacd_hil.settings.configuration import Settings


class PaperPipeline(Pipeline):
    """Pipeline of the paper's scheme.

    A model is valid once an adaptation has finished with a mass matrix that is positive definite everywhere. It stays
    so during a later adaptation, unless the user has taken the model back (REVOKED).
    """

    _cycle, _end, _run = staticmethod(paper_cycle), staticmethod(end_paper), staticmethod(run_paper)

    def __init__(self, settings: Settings) -> None:
        super().__init__(settings, paper_kernel.numbers_of(settings))
        self._m: paper_kernel.PaperMemory = self.numbers.memory[0]
        self._a_rad_s = settings.filter.a_rad_s
        self.tau_ext_hat = self.numbers.block[0].tau_ext_hat
        self._cycle_arrays = *self.numbers, self._course_constants, self._course_memory
        self._end_arrays = self.numbers.block, self._course_constants, self._course_memory

    def compile_cycle(self) -> None:
        """Compile each function of the cycle by a call on copies, so that no later cycle compiles."""
        paper_kernel.begin_adaptation(*(array.copy() for array in self.numbers[:3]))
        super().compile_cycle()

    def _report(self, cycle: int) -> ContactReport:  # noqa: ARG002
        return integrated_report(self._course.contact, self.tau_ext_hat, self._m.integral, self._m.peak, self._a_rad_s)

    def _follow(self, asked: int, previous: SchemeState, cycle: int, observation: int) -> None:  # noqa: ARG002
        """Begin an adaptation on entering ADAPT; at its end use its estimate as the feedforward's model.

        The end is the change from ADAPT to MONITOR. The model is valid if its mass matrix is positive definite. After
        REVOKED set the model to 0, not valid, before the adaptation begins.
        """
        state = self.state
        if previous is SchemeState.ADAPT and state is SchemeState.MONITOR:
            self.theta_ff = self.numbers.block[0].theta_hat.copy()
            self._set_valid(is_positive_definite(self.theta_ff))
        elif state is SchemeState.ADAPT and previous is not state:
            if self._course.supervisor.cause == SchemeEvent.REVOKED:
                self.theta_ff = np.zeros(self.theta_ff.size)
                self._set_valid(False)
            paper_kernel.begin_adaptation(*self.numbers[:3])
