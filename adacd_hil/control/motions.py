"""Laws of motion: quintics from corner to corner and to rest, the excitation's Fourier series, the admittance.

Shapes: positions, velocities, accelerations (2,); coefficients (6, 2), lowest order first. Units: rad, s, Nm.
"""

import math

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, Vector
from adacd_hil.settings.configuration import Settings

PEAK_SPEED_FACTOR = 1.875
"""Peak speed of a rest-to-rest quintic over its mean speed."""


@compiled
def corner_to_corner(
    elapsed_s: float, amplitude: Vector, half_period_s: Vector, q: Vector, dq: Vector, ddq: Vector
) -> None:
    """Fill the motion from -amplitude to the other corner and back, each joint by its own half period."""
    for i in range(JOINTS):
        index = np.floor(elapsed_s / half_period_s[i])
        direction = 1.0 if index % 2.0 == 0.0 else -1.0
        x = elapsed_s / half_period_s[i] - index
        rate = 1.0 / half_period_s[i]
        travel = 2.0 * amplitude[i] * direction
        q[i] = -amplitude[i] * direction + travel * x * x * x * (10.0 + x * (-15.0 + 6.0 * x))
        dq[i] = travel * rate * x * x * (30.0 + x * (-60.0 + 30.0 * x))
        ddq[i] = travel * rate * rate * x * (60.0 + x * (-180.0 + 120.0 * x))


def to_rest(q: Vector, dq: Vector, ddq: Vector, q_end: Vector, duration_s: float) -> Vector:
    """Return the coefficients (6, 2) that lead from (q, dq, ddq) to rest at `q_end` in `duration_s`."""
    T = duration_s
    travel = q_end - q
    return np.vstack(
        [
            q,
            dq,
            ddq / 2.0,
            (20.0 * travel - 12.0 * dq * T - 3.0 * ddq * T**2) / (2.0 * T**3),
            (-30.0 * travel + 16.0 * dq * T + 3.0 * ddq * T**2) / (2.0 * T**4),
            (12.0 * travel - 6.0 * dq * T - ddq * T**2) / (2.0 * T**5),
        ]
    )


@compiled
def evaluate(coefficients: Vector, elapsed_s: float, q: Vector, dq: Vector, ddq: Vector) -> None:
    """Fill the motion of a quintic at `elapsed_s`."""
    t = elapsed_s
    for i in range(JOINTS):
        c0, c1, c2 = coefficients[0, i], coefficients[1, i], coefficients[2, i]
        c3, c4, c5 = coefficients[3, i], coefficients[4, i], coefficients[5, i]
        q[i] = c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * c5))))
        dq[i] = c1 + t * (2.0 * c2 + t * (3.0 * c3 + t * (4.0 * c4 + t * 5.0 * c5)))
        ddq[i] = 2.0 * c2 + t * (6.0 * c3 + t * (12.0 * c4 + t * 20.0 * c5))


class Excitation:
    """The motion by which the certified scheme learns the arm: a short Fourier series per joint.

    It begins and ends at rest in the trajectory's start corner and moves both joints at once and both ways, so that no
    combination of parameters stays hidden (`analysis.excitation` finds the coefficients).
    """

    def __init__(self, settings: Settings) -> None:
        amplitude = np.radians(settings.trajectory.amplitude_deg)[:, np.newaxis]
        self._corner = -amplitude[:, 0]
        self._cosine = amplitude * np.array(settings.excitation.cosine)
        self._sine = amplitude * np.array(settings.excitation.sine)
        period_s = settings.excitation.period_s
        self._rad_s = np.arange(1, self._sine.shape[1] + 1) * (2.0 * np.pi / period_s if period_s else 0.0)
        self._acceleration = self._rad_s**2
        self.is_on = bool(period_s and self._rad_s.size)

    def evaluate(self, elapsed_s: float, q_d: Vector, dq_d: Vector, ddq_d: Vector) -> None:
        """Fill the desired motion (2,) at this time since its start; it goes on and on."""
        cosine, sine = np.cos(self._rad_s * elapsed_s), np.sin(self._rad_s * elapsed_s)
        q_d[:] = self._corner + self._cosine @ (cosine - 1.0) + self._sine @ sine
        dq_d[:] = self._sine @ (self._rad_s * cosine) - self._cosine @ (self._rad_s * sine)
        ddq_d[:] = -(self._cosine @ (self._acceleration * cosine)) - self._sine @ (self._acceleration * sine)


class Admittance:
    """A desired motion that is that of a virtual mass with a damper under the external torque, joint by joint.

        mass ddq_d = tau_ext_hat (beyond its dead band) - drag dq_d

    It begins with the motion of that moment, which the damper brakes. Acceleration, speed and position have bounds;
    speed toward a position limit is no larger than what can be braked before it. `step` carries the motion on in place.
    """

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
