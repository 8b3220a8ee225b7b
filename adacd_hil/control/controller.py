"""Joint PD plus identified feedforward: tau_d = Kp (q_d - q) + Kd (dq_d - dq) + W(q_d, dq_d, ddq_d) theta.

The feedforward's parameters change when an adaptation ends. They are led over in a straight line, because a step of
torque jerks the arm, and what the velocity's lag makes of that looks like a contact just when detection is armed.
"""

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, Vector
from adacd_hil.scheme.model.regressor import inverse_dynamics
from adacd_hil.settings.configuration import Settings

HANDOVER_S = 0.5
"""From the old parameters to the new. Switched at once, profile M's residual peaks at 0.071 Nm 7 ms later; led over
in 0.5 s it stays within what it is anyway."""


class Controller:
    """The joint controller."""

    def __init__(self, settings: Settings) -> None:
        self._Kp = np.array(settings.controller.Kp)
        self._Kd = np.array(settings.controller.Kd)
        self._has_feedforward = settings.controller.feedforward
        self._handover_cycles = max(1, round(HANDOVER_S / settings.bus.period_s))
        none = np.zeros(len(settings.estimator.parameter_names))
        self._theta = self._old = self._new = none
        self._cycles_left = 0

    def compile(self) -> None:
        """Run the compiled part once, so that nothing compiles in the cycle."""
        zeros = np.zeros(JOINTS)
        _torque(zeros, zeros, zeros, zeros, zeros, self._theta, self._Kp, self._Kd, np.zeros(JOINTS))

    def feed_forward(self, theta: Vector) -> None:
        """Use these parameters (p,) from now on; the same array again changes nothing."""
        if theta is self._new or not self._has_feedforward:
            return
        self._old, self._new = self._theta, theta
        self._cycles_left = self._handover_cycles

    def torque(self, q: Vector, dq: Vector, q_d: Vector, dq_d: Vector, ddq_d: Vector, tau_d: Vector) -> None:
        """Fill the desired torque `tau_d` (2,), Nm, from measured and desired motion; to be called once a cycle."""
        if self._cycles_left > 0:
            self._cycles_left -= 1
            share = self._cycles_left / self._handover_cycles
            self._theta = share * self._old + (1.0 - share) * self._new
        _torque(q, dq, q_d, dq_d, ddq_d, self._theta, self._Kp, self._Kd, tau_d)


@compiled
def _torque(
    q: Vector,
    dq: Vector,
    q_d: Vector,
    dq_d: Vector,
    ddq_d: Vector,
    theta: Vector,
    Kp: Vector,
    Kd: Vector,
    tau_d: Vector,
) -> None:
    feedforward = inverse_dynamics(q_d, dq_d, ddq_d, theta)
    for i in range(JOINTS):
        tau_d[i] = Kp[i] * (q_d[i] - q[i]) + Kd[i] * (dq_d[i] - dq[i]) + feedforward[i]
