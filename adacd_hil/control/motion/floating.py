"""Floating: the arm gives way to whoever pushes it.

    tau_d = share (F_v dq + F_c tanh(dq / v_0)) + g(q) - D dq

Less than all of the friction is compensated and D damps, so what moves comes to rest by itself. A joint that still
moves by what it did before the contact is braked first, as hard as the controller can, until it stands or moves with
the push. Beyond the speed limit and near the position limits the controller's gains hold against more.

Shapes: vectors (2,); theta (p,). Units: rad, rad/s, Nm.
"""

import numpy as np

from adacd_hil.records import JOINTS, Vector
from adacd_hil.scheme.model import regressor
from adacd_hil.settings.configuration import Settings

TURNED_rad_s = 0.05
"""Slower than this a joint counts as standing, and Coulomb friction is compensated in proportion."""


FIRM = 3.0
"""The controller's velocity gain times this holds the speed limit: 110 1/s for joint 2 of profile P unloaded, a third
of what the delays would bear."""


class Floating:
    """The torque of a floating arm, in place of the controller's."""

    def __init__(self, settings: Settings) -> None:
        wish = settings.reaction
        self._damping = wish.damping_Nm_s
        self._share = wish.friction_share
        self._speed_limit = np.radians(wish.yield_limit_deg_s).tolist()
        self._bound = (settings.arm.position_limit_rad - np.radians(wish.position_margin_deg)).tolist()
        self._Kp, self._Kd = settings.controller.Kp, settings.controller.Kd
        self._is_braking = [True] * JOINTS

    def begin(self) -> None:
        """Start anew: brake what moves."""
        self._is_braking = [True] * JOINTS

    def torque(self, q: Vector, dq: Vector, tau_ext_hat: Vector, theta: Vector, tau_d: Vector) -> None:
        """Fill the desired torque; theta is the model of friction and gravity, zeros for none."""
        tau_d[:] = regressor.inverse_dynamics(q, np.zeros(JOINTS), np.zeros(JOINTS), theta)
        friction = theta[regressor.F_V1 : regressor.F_C2 + 1]
        for i in range(JOINTS):
            speed = float(dq[i])
            if abs(speed) < TURNED_rad_s or speed * float(tau_ext_hat[i]) > 0.0:
                self._is_braking[i] = False
            if self._is_braking[i]:
                tau_d[i] -= self._Kd[i] * speed
                continue
            compensated = friction[i] * speed + friction[JOINTS + i] * np.tanh(speed / TURNED_rad_s)
            tau_d[i] += self._share * compensated - self._damping[i] * speed
            over = abs(speed) - self._speed_limit[i]
            if over > 0.0:
                tau_d[i] -= np.copysign(FIRM * self._Kd[i] * over, speed)
            beyond = abs(float(q[i])) - self._bound[i]
            if beyond > 0.0:
                tau_d[i] -= np.copysign(self._Kp[i] * beyond, q[i]) + self._Kd[i] * speed
