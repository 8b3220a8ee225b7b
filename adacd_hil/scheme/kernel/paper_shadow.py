"""The paper's scheme beside the certified one: it adapts until eq. (15) holds, then compares with its thresholds.

It decides nothing; what it comes to is in the block of the scheme in charge.
"""

from adacd_hil.compiled import Structured, compiled
from adacd_hil.records import JOINTS
from adacd_hil.scheme.kernel import paper_kernel
from adacd_hil.scheme.supervisor.observation import Observation
from adacd_hil.settings.configuration import Settings

_ADAPTED = int(Observation.ADAPTED)


@compiled
def step(
    constants: Structured,
    memory: Structured,
    block: Structured,
    mode: int,
    main: Structured,
    is_complete: int,
    steps: int,
) -> int:
    """Take in the sample that the main scheme's block has, fill that block's fields, and return the next mode.

    constants, memory, block: of the paper's kernel. main: after the main kernel's step.
    """
    own, out = block[0], main[0]
    for i in range(JOINTS):
        own["q"][i], own["dq"][i], own["tau_J"][i] = out["q"][i], out["dq"][i], out["tau_J"][i]
    own["period_s"][0] = out["period_s"][0]
    observation = paper_kernel.step(constants, memory, block, is_complete, steps, mode)
    if observation & _ADAPTED:
        mode = paper_kernel.ARMED
    out["paper_is_armed"][0] = 1.0 if mode == paper_kernel.ARMED else 0.0
    for i in range(JOINTS):
        out["paper_tau_ext_hat"][i] = own["tau_ext_hat"][i]
        out["paper_threshold"][i] = own["threshold"][i]
    for j in range(own["theta_hat"].size):
        out["paper_theta_hat"][j] = own["theta_hat"][j]
    return mode


class PaperShadow:
    """The paper's scheme on the same stream."""

    def __init__(self, settings: Settings) -> None:
        count = len(settings.estimator.parameter_names)
        self.constants = paper_kernel.constants_of(settings)
        self.memory = paper_kernel.new_memory(count)
        self.block = paper_kernel.new_block(count)
        self.mode = 0

    @property
    def numbers(self) -> tuple[Structured, Structured, Structured]:
        """What its kernel works on: constants, memory, block."""
        return self.constants, self.memory, self.block

    def compile(self, main: Structured) -> None:
        """Run every compiled function once, on copies. main: the block of the scheme in charge."""
        memory, block = self.memory.copy(), self.block.copy()
        paper_kernel.begin_adaptation(self.constants, memory, block)
        step(self.constants, memory, block, paper_kernel.LEARN, main.copy(), 1, 1)

    def begin_adaptation(self) -> None:
        """Forget the past, as the scheme does whenever it adapts."""
        paper_kernel.begin_adaptation(self.constants, self.memory, self.block)
        self.mode = paper_kernel.LEARN

    def step(self, main: Structured, is_complete: int, steps: int) -> None:
        """Take in one cycle, and put what it comes to into the block of the scheme in charge."""
        self.mode = step(self.constants, self.memory, self.block, self.mode, main, is_complete, steps)
