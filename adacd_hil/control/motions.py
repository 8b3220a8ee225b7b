"""Laws of motion: quintics, the excitation's Fourier series, the pace along a path, the admittance.

Shapes: positions, velocities, accelerations (2,). Units: rad, s, Nm.
"""

import math

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, QUINTIC_PEAK_ACCELERATION, QUINTIC_PEAK_SPEED, Vector
from adacd_hil.settings.configuration import Settings


@compiled
def corner_to_corner(
    elapsed_s: float, amplitude: Vector, half_period_s: Vector, q: Vector, dq: Vector, ddq: Vector
) -> None:
    """Fill q, dq, ddq (2,) of the endless motion between -amplitude and +amplitude, by quintics from rest to rest.

    It begins at -amplitude. half_period_s (2,): of one way, by joint. amplitude (2,): rad.
    """
    for i in range(JOINTS):
        index = np.floor(elapsed_s / half_period_s[i])
        direction = 1.0 if index % 2.0 == 0.0 else -1.0
        x = elapsed_s / half_period_s[i] - index
        rate = 1.0 / half_period_s[i]
        travel = 2.0 * amplitude[i] * direction
        q[i] = -amplitude[i] * direction + travel * x * x * x * (10.0 + x * (-15.0 + 6.0 * x))
        dq[i] = travel * rate * x * x * (30.0 + x * (-60.0 + 30.0 * x))
        ddq[i] = travel * rate * rate * x * (60.0 + x * (-180.0 + 120.0 * x))


class QuinticMove:
    """A straight move in joint space from rest to rest, all joints together; the slowest joint sets the duration.

    Speed and acceleration stay within their limits, and each position stays between start and end.
    """

    def __init__(
        self, start: Vector, end: Vector, speed_rad_s: Vector, acceleration_rad_s2: Vector, shortest_s: float
    ) -> None:
        """Plan the move; `duration_s` is the least that keeps all limits, and at least shortest_s.

        start, end (2,): positions. speed, acceleration (2,): limits.
        """
        self._start, self._end, self._travel = start.copy(), end.copy(), end - start
        distance = np.abs(self._travel)
        by_speed_s = QUINTIC_PEAK_SPEED * distance / speed_rad_s
        by_acceleration_s = np.sqrt(QUINTIC_PEAK_ACCELERATION * distance / acceleration_rad_s2)
        self.duration_s = max(shortest_s, float(by_speed_s.max()), float(by_acceleration_s.max()))

    def evaluate(self, elapsed_s: float, q: Vector, dq: Vector, ddq: Vector) -> None:
        """Fill q, dq, ddq (2,) this long after the start; after `duration_s`, the end position at rest."""
        if elapsed_s >= self.duration_s:
            q[:], dq[:], ddq[:] = self._end, 0.0, 0.0
            return
        x, rate = elapsed_s / self.duration_s, 1.0 / self.duration_s
        q[:] = self._start + self._travel * (x * x * x * (10.0 + x * (-15.0 + 6.0 * x)))
        dq[:] = self._travel * (rate * x * x * (30.0 + x * (-60.0 + 30.0 * x)))
        ddq[:] = self._travel * (rate * rate * x * (60.0 + x * (-180.0 + 120.0 * x)))


CHANGE_S = 0.15
"""Shortest change of pace. From 100 °/s to rest it takes 0.2 s, since 700 °/s² allow no faster one."""


class Pace:
    """Speed along a path, as a share of the planned speed.

    A change of the share takes CHANGE_S, and longer where the path leaves less acceleration for it. Of each joint,

        |share² ddq + dshare/dt dq| <= acceleration limit

    So an arm that stops on its path stays on the path, within the path's speed, and within the acceleration limit.
    """

    def __init__(self, settings: Settings) -> None:
        self._period_s = settings.bus.period_s
        self._limit = np.radians(settings.reaction.acceleration_limit_deg_s2)
        self.begin_path()

    def begin_path(self) -> None:
        """Set the share of the planned speed to 1, its change and the lag to 0, for a new path."""
        self.share, self.change = 1.0, 0.0
        """Present share, and its rate of change, 1/s."""
        self.lag_s = 0.0
        """Delay of the arm behind the plan, s."""
        self._from = self._to = self._phase = 1.0

    @property
    def is_planned(self) -> bool:
        """Whether the arm moves along the path at the planned speed; `lag_s` may still be above 0."""
        return self.share == 1.0 and self.change == 0.0

    def step(self, wanted: float, dq: Vector, ddq: Vector) -> None:
        """Move `share` one period closer to the wanted share, and update `change` and `lag_s`.

        wanted: 0 for rest, 1 for the planned speed. dq, ddq (2,): planned velocity and acceleration at the present
        place of the path.
        """
        if wanted != self._to:
            self._from, self._to, self._phase = self.share, wanted, 0.0
        before = self.share
        if self._phase < 1.0:
            self._phase = min(self._phase + self._phase_step(dq, ddq), 1.0)
            x = self._phase
            self.share = self._from + (self._to - self._from) * (x * x * (3.0 - 2.0 * x))
        self.change = (self.share - before) / self._period_s
        self.lag_s += (1.0 - self.share) * self._period_s

    def _phase_step(self, dq: Vector, ddq: Vector) -> float:
        """Return the part, 0 to 1, of the present change of pace to make in this period.

        The whole change takes CHANGE_S, and longer where the acceleration limits allow less. dq, ddq (2,): planned
        velocity and acceleration.
        """
        step, x = self._period_s / CHANGE_S, self._phase
        steepest = min(max(x, 0.5), x + step)  # where d(share)/dx is largest in this period
        slope = abs(self._to - self._from) * 6.0 * steepest * (1.0 - steepest)
        largest = max(self.share, self._to) ** 2
        for i in range(JOINTS):
            room = max(float(self._limit[i]) - largest * abs(float(ddq[i])), 0.0)
            needed = slope * abs(float(dq[i])) / CHANGE_S
            if needed > room:
                step = min(step, room / needed * self._period_s / CHANGE_S)
        return step


class Excitation:
    """The motion by which the certified scheme identifies the arm: a short Fourier series per joint.

    It begins and ends at rest in the trajectory's start corner and moves both joints at once and both ways, so that
    every combination of parameters shows in the torques (`lab.tune.excitation_search` finds the coefficients).
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

    def peaks_deg(self) -> tuple[Vector, Vector, Vector]:
        """Return the largest |q|, |dq| and |ddq|, (2,) each, of 1000 points of a period, in deg, deg/s and deg/s².

        Call it only if `is_on`.
        """
        motion = np.zeros((1000, 3, JOINTS))
        for row, elapsed_s in zip(motion, np.linspace(0.0, 2.0 * np.pi / self._rad_s[0], len(motion)), strict=True):
            self.evaluate(float(elapsed_s), *row)
        q, dq, ddq = np.degrees(np.max(np.abs(motion), axis=0))
        return q, dq, ddq

    def evaluate(self, elapsed_s: float, q_d: Vector, dq_d: Vector, ddq_d: Vector) -> None:
        """Fill q_d, dq_d, ddq_d (2,) of the periodic motion this long after its start."""
        cosine, sine = np.cos(self._rad_s * elapsed_s), np.sin(self._rad_s * elapsed_s)
        q_d[:] = self._corner + self._cosine @ (cosine - 1.0) + self._sine @ sine
        dq_d[:] = self._sine @ (self._rad_s * cosine) - self._cosine @ (self._rad_s * sine)
        ddq_d[:] = -(self._cosine @ (self._acceleration * cosine)) - self._sine @ (self._acceleration * sine)


class Admittance:
    """Desired motion of a virtual mass with a damper under the external torque, joint by joint.

        mass ddq_d = tau_ext_hat (beyond its dead band) - drag dq_d

    It begins with the present motion, which the damper brakes. Acceleration, speed and position are limited; the speed
    toward a position limit is such that the joint can brake before it. `step` advances the motion in place.
    """

    def __init__(self, settings: Settings) -> None:
        wish = settings.reaction
        self._period_s = settings.bus.period_s
        self._mass, self._drag, self._deadband = wish.mass_kg_m2, wish.drag_Nm_s, wish.deadband_Nm
        speed = np.minimum(np.radians(wish.yield_limit_deg_s), settings.arm.velocity_limit_rad_s)
        self._speed_limit = speed.tolist()
        self._acceleration_limit = np.radians(wish.acceleration_limit_deg_s2).tolist()
        self._bound = (settings.arm.position_limit_rad - np.radians(wish.position_margin_deg)).tolist()

    def step(self, tau_ext_hat: Vector, q_d: Vector, dq_d: Vector, ddq_d: Vector) -> None:
        """Advance q_d, dq_d, ddq_d (2,) in place by one period under the external torque (2,), Nm.

        Torque within the dead band counts as 0. The limits of the settings hold for each joint; one that begins too
        fast for the limit of speed or position exceeds it, and brakes at the limit of acceleration.
        """
        for i in range(JOINTS):
            speed, tau = float(dq_d[i]), float(tau_ext_hat[i])
            push = math.copysign(max(abs(tau) - self._deadband[i], 0.0), tau)
            step = self._acceleration_limit[i] * self._period_s
            wanted = speed + self._period_s * (push - self._drag[i] * speed) / self._mass[i]
            limit = self._speed_limit[i]
            room = self._bound[i] - math.copysign(float(q_d[i]), wanted * float(q_d[i]))
            room -= (abs(speed) + step) * self._period_s  # the most that this period may use of it
            limit = min(limit, math.sqrt(2.0 * self._acceleration_limit[i] * max(room, 0.0)))
            new = min(max(min(max(wanted, -limit), limit), speed - step), speed + step)
            q_d[i] += 0.5 * (speed + new) * self._period_s
            dq_d[i] = new
            ddq_d[i] = (new - speed) / self._period_s


TOLERANCE = 1e-3
"""Relative excess over a limit that an excitation may have: the search for it ends a little outside."""


def motion_problems(settings: Settings) -> list[str]:
    """Return a line for each limit that trajectory or excitation exceeds by a share of over `TOLERANCE`; empty if none.

    Limits: the arm's positions and velocities, and the reaction's accelerations.
    """
    arm, trajectory = settings.arm, settings.trajectory
    travel = 2.0 * np.array(trajectory.amplitude_deg)
    half_period_s = np.array(trajectory.half_period_s)
    needed = {
        "`trajectory`": (
            0.5 * travel,
            QUINTIC_PEAK_SPEED * travel / half_period_s,
            QUINTIC_PEAK_ACCELERATION * travel / half_period_s**2,
        )
    }
    excitation = Excitation(settings)
    if excitation.is_on:
        needed["`excitation`"] = excitation.peaks_deg()
    limits = (
        ("arm.position_limit_deg", arm.position_limit_deg, "deg"),
        ("arm.velocity_limit_deg_s", arm.velocity_limit_deg_s, "deg/s"),
        ("reaction.acceleration_limit_deg_s2", settings.reaction.acceleration_limit_deg_s2, "deg/s²"),
    )
    return [
        f"{name} takes joint {i + 1} to {peak[i]:.4g} {unit}, `{key}[{i}]` = {limit[i]:g} {unit}"
        for name, peaks in needed.items()
        for peak, (key, limit, unit) in zip(peaks, limits, strict=True)
        for i in range(JOINTS)
        if peak[i] > (1.0 + TOLERANCE) * limit[i]
    ]
