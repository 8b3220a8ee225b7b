"""The withdrawal: away from the collision, along +tau_ext_hat, as fast as the limits allow, to a stop.

Each joint follows the time-optimal profile of a double integrator from its present desired position and velocity to
rest at its target: to the cruise speed, cruise, brake, each part with the acceleration limit or none. The profile is
known in closed form and sampled, so that it ends exactly on the target with zero velocity and never chatters.

The target lies along the external torque: the joint with the largest part of it moves its `distance_deg`, the others in
proportion. It is cut off at the position limits less a margin, but never put against the external torque: a joint
that is already beyond, or too fast to stop before, stops as soon as it can.

Units: rad, rad/s, rad/s², s. Joint vectors (2,).
"""

import math
from typing import NamedTuple

import numpy as np

from adacd_hil.records import JOINTS, Vector
from adacd_hil.settings.configuration import Settings


class JointWay(NamedTuple):
    """One joint's motion from `position` and `velocity`: parts of constant acceleration, then rest at the target."""

    position: float
    velocity: float
    parts: tuple[tuple[float, float], ...]  # acceleration, duration_s
    target: float

    def at(self, elapsed_s: float) -> tuple[float, float, float]:
        """Return position, velocity and acceleration this long after the start.

        Before the start they are those of the start; after the last part the target, 0 and 0.
        """
        position, velocity = self.position, self.velocity
        remaining_s = max(elapsed_s, 0.0)
        for acceleration, duration_s in self.parts:
            if remaining_s < duration_s:
                return (
                    position + remaining_s * (velocity + 0.5 * acceleration * remaining_s),
                    velocity + acceleration * remaining_s,
                    acceleration,
                )
            position += duration_s * (velocity + 0.5 * acceleration * duration_s)
            velocity += acceleration * duration_s
            remaining_s -= duration_s
        return self.target, 0.0, 0.0

    @property
    def duration_s(self) -> float:
        """Time from the start until rest."""
        return sum(duration_s for _, duration_s in self.parts)


def time_optimal(
    position: float, velocity: float, target: float, velocity_limit: float, acceleration_limit: float
) -> JointWay:
    """Return a joint's fastest motion to rest at `target` within the limits.

    A velocity over its limit is braked first. A joint too fast to stop at the target goes past it and comes back.
    """
    stop = position + velocity * abs(velocity) / (2.0 * acceleration_limit)
    sign = math.copysign(1.0, target - stop)
    distance = sign * (target - position)
    forward = sign * velocity
    peak = min(velocity_limit, math.sqrt(max(acceleration_limit * distance + 0.5 * forward**2, 0.0)))
    to_peak_s = abs(peak - forward) / acceleration_limit
    to_rest_s = peak / acceleration_limit
    ground = 0.5 * (forward + peak) * to_peak_s + 0.5 * peak * to_rest_s
    cruise_s = max(distance - ground, 0.0) / peak if peak > 0.0 else 0.0
    to_peak = sign * math.copysign(acceleration_limit, peak - forward)
    parts = ((to_peak, to_peak_s), (0.0, cruise_s), (-sign * acceleration_limit, to_rest_s))
    return JointWay(position, velocity, parts, target)


class Withdrawal:
    """The motion of all joints away from one collision, to rest: planned when made, then sampled by `evaluate`."""

    def __init__(
        self, settings: Settings, q_d: Vector, dq_d: Vector, tau_ext_hat: Vector, start: Vector | None = None
    ) -> None:
        """Plan from the present desired motion; without an external torque plan a stop.

        Each joint moves along its torque, by its `distance_deg` times its share of the largest torque; a position limit
        shortens that. start: joint positions at which the withdrawal began, if it is planned anew on the way; the
        distance moved since then shortens it.
        """
        distance = np.radians(settings.reaction.distance_deg)
        velocity_limit = np.minimum(
            np.radians(settings.reaction.velocity_limit_deg_s), settings.arm.velocity_limit_rad_s
        )
        acceleration_limit = np.radians(settings.reaction.acceleration_limit_deg_s2)
        position_limit = settings.arm.position_limit_rad - np.radians(settings.reaction.position_margin_deg)
        self._settings = settings
        largest = float(np.max(np.abs(tau_ext_hat)))
        share = tau_ext_hat / largest if largest > 0.0 else np.zeros(JOINTS)
        way = share * distance
        if start is not None:
            way = np.copysign(np.maximum(np.abs(way) - np.sign(way) * (q_d - start), 0.0), way)
        limits = position_limit, velocity_limit, acceleration_limit
        by_joint = zip(*(values.tolist() for values in (q_d, dq_d, way, *limits)), strict=True)
        self._profiles = tuple(_withdraw(*values) for values in by_joint)

    @property
    def duration_s(self) -> float:
        """Time from the plan's start until all joints are at rest."""
        return max(profile.duration_s for profile in self._profiles)

    def evaluate(self, elapsed_s: float, q_d: Vector, dq_d: Vector, ddq_d: Vector) -> None:
        """Fill q_d, dq_d, ddq_d (2,) in place with the desired motion this long after the plan's start."""
        for i, profile in enumerate(self._profiles):
            q_d[i], dq_d[i], ddq_d[i] = profile.at(elapsed_s)

    @property
    def beyond_limits(self) -> list[int]:
        """Indices, from 0, of the joints that can't stop within their position limit: [] if all can.

        They brake at the acceleration limit from their position and velocity at the plan's start.
        """
        limit = self._settings.arm.position_limit_rad
        return [i for i in range(JOINTS) if abs(self._soonest_stop(i)) > limit[i]]

    def _soonest_stop(self, joint: int) -> float:
        """Return the position, rad, where a joint stops if it brakes at its limit from the plan's start."""
        profile = self._profiles[joint]
        limit = math.radians(self._settings.reaction.acceleration_limit_deg_s2[joint])
        return profile.position + profile.velocity * abs(profile.velocity) / (2.0 * limit)

    def describe_beyond(self, joint: int) -> str:
        """Return a message for a joint of `beyond_limits`: speed, position, position limit, and where it stops."""
        arm, wish = self._settings.arm, self._settings.reaction
        profile = self._profiles[joint]
        return (
            f"joint {joint + 1} moves at {math.degrees(profile.velocity):.0f} deg/s at "
            f"{math.degrees(profile.position):.1f} deg and can't stop within `arm.position_limit_deg[{joint}]` = "
            f"{arm.position_limit_deg[joint]:g} deg: it brakes with {wish.acceleration_limit_deg_s2[joint]:g} deg/s² "
            f"and stops at {math.degrees(self._soonest_stop(joint)):.1f} deg"
        )


def _withdraw(
    position: float,
    velocity: float,
    displacement: float,
    position_limit: float,
    velocity_limit: float,
    acceleration_limit: float,
) -> JointWay:
    """Return one joint's motion over `displacement`, cut off at the position limit, but never against its direction.

    A joint too fast to stop there brakes at once, and so does one without displacement.
    """
    sign = math.copysign(1.0, displacement or velocity)  # a joint that is not pushed just stops
    room = position_limit - sign * position
    forward = sign * velocity
    stop = forward * abs(forward) / (2.0 * acceleration_limit)
    target = position + sign * max(min(abs(displacement), room), stop)
    return time_optimal(position, velocity, target, velocity_limit, acceleration_limit)
