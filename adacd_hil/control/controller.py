"""Desired torque of the controller that follows a motion, and of an arm that floats.

Shapes: vectors (2,); theta (p,). Units: rad, rad/s, Nm.
"""

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, Vector
from adacd_hil.scheme.model import regressor
from adacd_hil.scheme.model.regressor import inverse_dynamics
from adacd_hil.settings.configuration import Settings

HANDOVER_S = 0.5
"""Blending time from old to new parameters. Switched at once, profile M's residual peaks at 0.071 Nm 7 ms later;
blended in 0.5 s it stays as before."""


class Controller:
    """The joint controller: PD on position and velocity, plus the model's feedforward."""

    def __init__(self, settings: Settings) -> None:
        self._Kp = np.array(settings.controller.Kp)
        self._Kd = np.array(settings.controller.Kd)
        self._level_rad = settings.level_rad
        self._has_feedforward = settings.controller.feedforward
        self._handover_cycles = max(1, round(HANDOVER_S / settings.bus.period_s))
        none = np.zeros(len(settings.estimator.parameter_names))
        self._theta = self._old = self._new = none
        self._cycles_left = 0

    def compile_law(self) -> None:
        """Compile `fill_torque` by a call, so that it doesn't compile in the cycle."""
        zeros = np.zeros(JOINTS)
        fill_torque(
            zeros, zeros, zeros, zeros, zeros, self._theta, self._Kp, self._Kd, self._level_rad, np.zeros(JOINTS)
        )

    def feed_forward(self, theta: Vector) -> None:
        """Begin to blend the feedforward to theta (p,) over HANDOVER_S.

        Do nothing for the same array object as in the last call, or if the settings have no feedforward.
        """
        if theta is self._new or not self._has_feedforward:
            return
        self._old, self._new = self._theta, theta
        self._cycles_left = self._handover_cycles

    def torque(self, q: Vector, dq: Vector, q_d: Vector, dq_d: Vector, ddq_d: Vector, tau_d: Vector) -> None:
        """Fill the desired torque `tau_d` (2,), Nm, as `fill_torque` with the blended parameters.

        Advance the blending by one cycle: call it once per cycle.
        """
        if self._cycles_left > 0:
            self._cycles_left -= 1
            share = self._cycles_left / self._handover_cycles
            self._theta = share * self._old + (1.0 - share) * self._new
        fill_torque(q, dq, q_d, dq_d, ddq_d, self._theta, self._Kp, self._Kd, self._level_rad, tau_d)


@compiled
def fill_torque(
    q: Vector,
    dq: Vector,
    q_d: Vector,
    dq_d: Vector,
    ddq_d: Vector,
    theta: Vector,
    Kp: Vector,
    Kd: Vector,
    level_rad: float,
    tau_d: Vector,
) -> None:
    """Fill tau_d (2,) = Kp (q_d - q) + Kd (dq_d - dq) + W(q_d, dq_d, ddq_d) theta, Nm.

    W: regressor of the arm's model. level_rad: q1 at which link 1 is level, for gravity.
    """
    feedforward = inverse_dynamics(q_d, dq_d, ddq_d, theta, level_rad)
    for i in range(JOINTS):
        tau_d[i] = Kp[i] * (q_d[i] - q[i]) + Kd[i] * (dq_d[i] - dq[i]) + feedforward[i]


TURNED_rad_s = 0.05
"""A slower joint counts as standing: Coulomb friction is compensated in proportion to its speed."""


FIRM = 3.0
"""Factor on the controller's velocity gain that holds the speed limit: 110 1/s for joint 2 of profile P unloaded, a
third of the gain at which the delays would make it unstable."""


class Floating:
    """Torque of an arm that yields to a push, in place of the controller's.

        tau_d = share (F_v dq + F_c tanh(dq / v_0)) + g(q) - D dq

    Part of the friction is compensated and D damps, so the arm comes to rest by itself. A joint that still moves from
    before the contact is first braked, as hard as the controller can, until it stands or moves with the push. After
    that, beyond the speed limit the controller's gains brake, and near a position limit they push back and brake.
    """

    def __init__(self, settings: Settings) -> None:
        wish = settings.reaction
        self._damping = wish.damping_Nm_s
        self._level_rad = settings.level_rad
        self._share = wish.friction_share
        self._speed_limit = np.radians(wish.yield_limit_deg_s).tolist()
        self._bound = (settings.arm.position_limit_rad - np.radians(wish.position_margin_deg)).tolist()
        self._Kp, self._Kd = settings.controller.Kp, settings.controller.Kd
        self._is_braking = [True] * JOINTS

    def begin(self) -> None:
        """Set all joints to be braked until they stand, or move with the push."""
        self._is_braking = [True] * JOINTS

    def torque(self, q: Vector, dq: Vector, tau_ext_hat: Vector, theta: Vector, tau_d: Vector) -> None:
        """Fill the desired torque `tau_d` (2,), Nm: gravity and a share of the friction by theta, less damping.

        A joint that still moves from before `begin` is only held against gravity and braked, until it stands or
        tau_ext_hat (2,) pushes it along its motion. After that, over the speed limit FIRM times the velocity gain
        brakes the excess, and within the margin of a position limit the controller's gains push back and brake. theta
        (p,): zeros for no model.
        """
        tau_d[:] = regressor.inverse_dynamics(q, np.zeros(JOINTS), np.zeros(JOINTS), theta, self._level_rad)
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
