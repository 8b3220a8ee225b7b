"""The desired motion of an arm, state by state, without a run."""

import numpy as np

from adacd_hil.control.reference import Reference
from adacd_hil.records import ArmState, FaultReason, Reaction, SchemeOutput, SchemeState, Vector
from adacd_hil.settings.configuration import Settings

START_DEG = (-30.0, -60.0)


class Desired:
    """A reference without a run: its arm is where the desired motion says, while `follows`."""

    def __init__(self, settings: Settings) -> None:
        self.ages = (0, 0)
        self.q, self.dq = np.radians(START_DEG), np.zeros(2)
        self.q_d, self.dq_d, self.ddq_d = self.q.copy(), np.zeros(2), np.zeros(2)
        self.reference = Reference(settings, self.q_d, self.dq_d, self.ddq_d)
        self.state, self.reaction = SchemeState.INIT, Reaction.NONE
        self.cycle = 0
        self.follows = True

    def step(
        self, state: SchemeState, reaction: Reaction = Reaction.NONE, tau: tuple[float, float] = (0, 0), cycles: int = 1
    ) -> Vector:
        """Return the desired motion (n, 3, 2)."""
        rows = []
        for _ in range(cycles):
            arm = ArmState(
                self.cycle, 0, 1, self.q, self.dq, np.zeros(2), self.ages, (0, 0), True, True, FaultReason.NONE
            )
            output = SchemeOutput(
                self.cycle, state, self.state, FaultReason.NONE, 0, True, np.zeros(7),
                np.array(tau, dtype=np.float64), None, np.zeros(1), reaction,
            )  # fmt: skip
            self.reference.step(arm, output)
            self.state, self.reaction = state, reaction
            if self.follows:
                self.q, self.dq = self.q_d.copy(), self.dq_d.copy()
            rows.append([self.q_d.copy(), self.dq_d.copy(), self.ddq_d.copy()])
            self.cycle += 1
        return np.array(rows)
