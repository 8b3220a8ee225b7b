"""Admittance: the desired motion is that of a virtual mass with a damper under the external torque, joint by joint.

    mass ddq_d = tau_ext_hat (beyond its dead band) - drag dq_d

It begins with the motion of that moment, which the damper brakes. Acceleration, speed and position have bounds; speed
toward a position limit is no larger than what can be braked before it.

Shapes: vectors (2,). Units: rad, rad/s, rad/s², Nm.
"""

import math

import numpy as np

from adacd_hil.records import JOINTS, Vector
from adacd_hil.settings.configuration import Settings


class Admittance:
    """The virtual mass. `step` carries the desired motion on in place."""

    def __init__(self, settings: Settings) -> None:
        wish = settings.reaction
        self._period_s = settings.bus.period_s
        self._mass, self._drag, self._deadband = wish.mass_kg_m2, wish.drag_Nm_s, wish.deadband_Nm
        self._speed_limit = np.radians(wish.yield_limit_deg_s).tolist()
        self._acceleration_limit = np.radians(wish.acceleration_limit_deg_s2).tolist()
        self._bound = (settings.arm.position_limit_rad - np.radians(wish.position_margin_deg)).tolist()

    def step(self, tau_ext_hat: Vector, q_d: Vector, dq_d: Vector, ddq_d: Vector) -> None:
        """Take the desired motion (2,) each one period further."""
        for i in range(JOINTS):
            speed, tau = float(dq_d[i]), float(tau_ext_hat[i])
            push = math.copysign(max(abs(tau) - self._deadband[i], 0.0), tau)
            step = self._acceleration_limit[i] * self._period_s
            wanted = speed + self._period_s * (push - self._drag[i] * speed) / self._mass[i]
            limit = self._speed_limit[i]
            room = max(self._bound[i] - math.copysign(float(q_d[i]), wanted * float(q_d[i])), 0.0)
            limit = min(limit, math.sqrt(2.0 * self._acceleration_limit[i] * room))
            new = min(max(min(max(wanted, -limit), limit), speed - step), speed + step)
            q_d[i] += 0.5 * (speed + new) * self._period_s
            dq_d[i] = new
            ddq_d[i] = (new - speed) / self._period_s
