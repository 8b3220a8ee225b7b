"""A joint moved by hand with its drive off: tells whether order and signs of the joints are right.

The hand drives the arm and the arm's sensor drives the idle motor, so the torque that the sensor sees opposes the
motion: the work ∫ tau_J dq must be negative. Symbols: q, dq, tau_J (2,) in joint coordinates.
"""

import math

import numpy as np

from adacd_hil.commission.diagnosis import Outcome, failed, ok, warning
from adacd_hil.commission.zero_torque import ZeroTorqueCycle
from adacd_hil.records import JOINTS, Vector

WORK_FLOOR_J = 1e-3
"""Work that counts: 10 degrees against 6 mNm. Noise and zero error make less on a joint that turns freely."""
_DOMINANCE = 2.0
"""How much further than the other joint the moved one must have gone."""


class HandMotion:
    """Watches the cycles in which the user moves joint `joint` (0, 1) toward +q. `zero_Nm` (2,): torque at rest."""

    WANTED_DEG = 10.0

    def __init__(self, joint: int, zero_Nm: Vector) -> None:
        self._joint = joint
        self._start: Vector | None = None
        self._last: Vector | None = None
        self._way = np.zeros(JOINTS)
        self._work_J = np.zeros(JOINTS)
        self._zero_Nm = zero_Nm

    @property
    def is_done(self) -> bool:
        """Whether a joint has been moved far enough."""
        return bool(np.abs(self._way).max() >= math.radians(self.WANTED_DEG))

    def observe(self, cycle: ZeroTorqueCycle) -> None:
        """Take in one cycle."""
        state = cycle.state
        if not state.is_complete:
            return
        if self._start is None or self._last is None:
            self._start = self._last = state.q
            return
        self._work_J += (state.tau_J - self._zero_Nm) * (state.q - self._last)
        self._last = state.q
        self._way = state.q - self._start

    def judge(self) -> Outcome:
        """Say what the motion told."""
        joint, number = self._joint, self._joint + 1
        ways_deg = np.degrees(self._way)
        moved = int(np.argmax(np.abs(self._way)))
        text = f"moved {ways_deg[0]:+.1f} and {ways_deg[1]:+.1f} deg, work {self._work_J[joint]:+.4f} J"
        if not self.is_done:
            return warning(f"not moved by {self.WANTED_DEG:g} deg in time ({text})", "run doctor --move again")
        if moved != joint:
            return failed(
                f"drive {moved + 1} reports the motion of joint {number} ({text})",
                "exchange the node ids of the drives, or their cables",
            )
        if abs(self._way[joint]) < _DOMINANCE * abs(self._way[1 - joint]):
            return warning(f"both joints moved ({text})", "hold the other joint and run doctor --move again")
        if self._way[joint] < 0.0:
            return failed(f"position decreases toward +q ({text})", f"reverse arm.sign of joint {number}")
        return self._judge_torque(text)

    def _judge_torque(self, text: str) -> Outcome:
        work_J = self._work_J[self._joint]
        if work_J > WORK_FLOOR_J:
            return failed(
                f"the torque has the motion's sign: it should oppose it ({text})",
                "reverse the torque sensor's sign (0x6126 or the maker's tool), or exchange the sensors",
            )
        if work_J > -WORK_FLOOR_J:
            return warning(f"right joint and direction; too little torque to tell its sign ({text})", "move it faster")
        return ok(f"right joint, right signs ({text})")
