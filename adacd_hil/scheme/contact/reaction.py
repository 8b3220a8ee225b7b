"""What the arm does about a contact: the choice of a reaction, the withdrawal, and the course from detection to end.

**Choice.** The choice of a reaction: by level and link, and what changes it while the arm reacts.

A contact that grows into a collision, or whose link turns out to be another, has its reaction chosen anew. A withdrawal
is given up for the `two_sided` reaction when something pushes from the other side: the external torque along the way of
the withdrawal has turned against it by more than the upper thresholds, as in a clamp or with a wall behind.

Shapes: tau_ext_hat (2,), Nm.

**Withdrawal.** The withdrawal: away from the collision, along +tau_ext_hat, as fast as the limits allow, to a stop.

Each joint follows the time-optimal profile of a double integrator from its present desired position and velocity to
rest at its target: to the cruise speed, cruise, brake, each part with the acceleration limit or none. The profile is
known in closed form and sampled, so that it ends exactly on the target with zero velocity and never chatters.

The target lies along the external torque: the joint with the largest part of it moves its `distance_deg`, the others in
proportion. It is cut off at the position limits less a margin, but never put against the external torque: a joint
that is already beyond, or too fast to stop before, stops as soon as it can.

**Course.** A contact from detection to its end: its reports and the reaction to it, of either scheme. Per cycle, after
the kernel and the supervisor: `step`. It looks at the state reached, so it must see every cycle.

Units: rad, rad/s, rad/s², s. Joint vectors (2,).
"""

import math
from typing import NamedTuple

import numpy as np

from adacd_hil.records import JOINTS, ContactLevel, ContactReport, Reaction, SchemeState, Vector
from adacd_hil.scheme.contact.contact_report import ContactEvidence, ContactReporter
from adacd_hil.scheme.supervisor.supervisor import REACTING, Supervisor
from adacd_hil.scheme.supervisor.transitions import (
    COLLISION,
    CONTACT_SHIFT,
    Calm,
)
from adacd_hil.settings.configuration import Settings


class JointWay(NamedTuple):
    """One joint's way: three parts of constant acceleration, each with its length in s, then rest at the target."""

    position: float
    velocity: float
    parts: tuple[tuple[float, float], ...]  # acceleration, duration_s
    target: float

    def at(self, elapsed_s: float) -> tuple[float, float, float]:
        """Return position, velocity and acceleration at this time; before the start, those of the start."""
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
        """Time until rest."""
        return sum(duration_s for _, duration_s in self.parts)


def time_optimal(
    position: float, velocity: float, target: float, velocity_limit: float, acceleration_limit: float
) -> JointWay:
    """Plan the fastest way to rest at `target` within the limits; a velocity over its limit is braked first."""
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
    """The way of all joints from one collision to rest. Made when REACT is entered, then sampled per period."""

    def __init__(
        self, settings: Settings, q_d: Vector, dq_d: Vector, tau_ext_hat: Vector, start: Vector | None = None
    ) -> None:
        """Plan from the present motion. Without an external torque the arm just stops.

        start: where the way began, if not here; what has been covered since is not covered again.
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
        self._profiles = tuple(
            _withdraw(
                float(q_d[i]),
                float(dq_d[i]),
                float(way[i]),
                float(position_limit[i]),
                float(velocity_limit[i]),
                float(acceleration_limit[i]),
            )
            for i in range(JOINTS)
        )

    @property
    def duration_s(self) -> float:
        """Time until all joints are at rest."""
        return max(profile.duration_s for profile in self._profiles)

    def evaluate(self, elapsed_s: float, q_d: Vector, dq_d: Vector, ddq_d: Vector) -> None:
        """Fill the desired motion (2,) at this time since the plan was made."""
        for i, profile in enumerate(self._profiles):
            q_d[i], dq_d[i], ddq_d[i] = profile.at(elapsed_s)

    @property
    def beyond(self) -> list[int]:
        """Joints that the acceleration limit lets stop only beyond their position limit, from 0."""
        limit = self._settings.arm.position_limit_rad
        return [i for i in range(JOINTS) if abs(self._soonest_stop(i)) > limit[i]]

    def _soonest_stop(self, joint: int) -> float:
        """Return where a joint stops that brakes with its acceleration limit at once, rad."""
        profile = self._profiles[joint]
        limit = math.radians(self._settings.reaction.acceleration_limit_deg_s2[joint])
        return profile.position + profile.velocity * abs(profile.velocity) / (2.0 * limit)

    def describe_beyond(self, joint: int) -> str:
        """Say where such a joint stops."""
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
    """Plan one joint's way over `displacement`, cut off at the position limit, never back against it."""
    sign = math.copysign(1.0, displacement or velocity)  # a joint that is not pushed just stops
    room = position_limit - sign * position
    forward = sign * velocity
    stop = forward * abs(forward) / (2.0 * acceleration_limit)
    target = position + sign * max(min(abs(displacement), room), stop)
    return time_optimal(position, velocity, target, velocity_limit, acceleration_limit)


TURNED_CYCLES = 5
"""How many samples in a row the torque must be turned: what a blow leaves in the estimate is shorter."""
BLIND_S = 0.02
"""After a withdrawal has begun it is not judged yet: the estimate still rings from the blow."""

_ROUNDING_NM = 1e-9
"""More than two ways of adding up a torque along a way may differ by."""


class ReactionChoice:
    """What is done about the contact of REACT and STOPPED."""

    def __init__(self, settings: Settings) -> None:
        wish = settings.reaction
        self._table = {
            ContactLevel.CONTACT: tuple(Reaction[name.upper()] for name in wish.contact),
            ContactLevel.COLLISION: tuple(Reaction[name.upper()] for name in wish.collision),
        }
        self._two_sided = Reaction[wish.two_sided.upper()]
        self._collision_Nm = np.array(settings.detector.collision_Nm)
        self._blind_cycles = round(BLIND_S / settings.bus.period_s)
        self.reaction = Reaction.NONE
        """What is to be done now; NONE also while nothing touches."""
        self._cause = (ContactLevel.CONTACT, 0)
        self.is_two_sided = False
        """Whether something has pushed from the other side too."""
        self._is_given_up = False
        self._way = np.zeros(0)
        self._cycles = 0
        self._turned_cycles = 0

    @property
    def level(self) -> ContactLevel:
        """The highest level of this contact so far."""
        return self._cause[0]

    @property
    def goes_on(self) -> bool:
        """Whether the arm moves on along its path."""
        return self.reaction in (Reaction.NONE, Reaction.SLOW_DOWN)

    def hold(self) -> None:
        """Begin to stop without a contact, as for a host that is late."""
        self._begin(Reaction.STOP, np.zeros(0))
        self._cause = (ContactLevel.COLLISION, 0)

    def end(self) -> None:
        """Forget the contact: the arm goes on."""
        self._begin(Reaction.NONE, np.zeros(0))
        self._cause = (ContactLevel.CONTACT, 0)

    def begin(self, level: ContactLevel, link: int, tau_ext_hat: Vector, is_model_valid: bool) -> None:
        """Choose for a contact that begins. Without a valid model there is nothing to float with: the arm stops."""
        self.is_two_sided = self._is_given_up = False
        self._cause = (level, link)
        self._choose(tau_ext_hat, is_model_valid)

    def step(
        self,
        level: ContactLevel,
        link: int,
        is_latched: bool,
        tau_ext_hat: Vector,
        is_model_valid: bool,
    ) -> None:
        """Take in one cycle of a contact and change the reaction if something calls for it."""
        cause = (max(level, self._cause[0]), link)
        if cause != self._cause and self._cause[1] and not self._is_given_up:
            self._cause = cause
            self._choose(tau_ext_hat, is_model_valid)
        if is_latched and self.goes_on and self.level is ContactLevel.CONTACT:
            self._begin(Reaction.STOP, tau_ext_hat)
        if self._is_judging:
            self._judge(tau_ext_hat, is_model_valid)

    def calm(self, calm: Calm, link: int) -> Calm:
        """Narrow the bounds to those within which nothing calls for another reaction, but what `judged` says."""
        if self._is_given_up:
            return calm
        if link != self._cause[1]:
            return calm._replace(cycles=0)
        is_contact = self.level is ContactLevel.CONTACT
        return calm._replace(watched=calm.watched | COLLISION) if is_contact else calm

    @property
    def judged(self) -> tuple[tuple[float, float], float]:
        """A way, and the external torque along it, Nm, from which on a withdrawal certainly goes on; -inf: any."""
        if not self._is_judging:
            return (0.0, 0.0), -np.inf
        return (float(self._way[0]), float(self._way[1])), _ROUNDING_NM - self._bound_Nm

    def pass_by(self, cycles: int) -> None:
        """Count calm cycles."""
        if self._is_judging:
            self._cycles += cycles
            self._turned_cycles = 0

    @property
    def _is_judging(self) -> bool:
        return self.reaction is Reaction.WITHDRAW and self._way.size > 0

    @property
    def _bound_Nm(self) -> float:
        """How far the torque along the way may turn against it."""
        return float(np.abs(self._way) @ self._collision_Nm)

    def _choose(self, tau_ext_hat: Vector, is_model_valid: bool) -> None:
        level, link = self._cause
        reaction = self._table[level][link - 1]
        if reaction is not self.reaction:
            self._begin(self._possible(reaction, is_model_valid), tau_ext_hat)

    @staticmethod
    def _possible(reaction: Reaction, is_model_valid: bool) -> Reaction:
        return Reaction.STOP if reaction is Reaction.FLOAT and not is_model_valid else reaction

    def _begin(self, reaction: Reaction, tau_ext_hat: Vector) -> None:
        self.reaction = reaction
        size = float(np.linalg.norm(tau_ext_hat)) if tau_ext_hat.size else 0.0
        self._way = tau_ext_hat / size if size > 0.0 else np.zeros(0)
        self._cycles = self._turned_cycles = 0

    def _judge(self, tau_ext_hat: Vector, is_model_valid: bool) -> None:
        """Give a withdrawal up if it pushes something on the other side."""
        self._cycles += 1
        if self._cycles <= self._blind_cycles:
            return
        along = float(tau_ext_hat @ self._way)
        self._turned_cycles = self._turned_cycles + 1 if along < -self._bound_Nm else 0
        self.is_two_sided = self.is_two_sided or self._turned_cycles >= TURNED_CYCLES
        if self.is_two_sided:
            self._is_given_up = True
            self._begin(self._possible(self._two_sided, is_model_valid), tau_ext_hat)


class PaperReaction(ReactionChoice):
    """The paper's: the arm withdraws from every contact, stops without one, and goes on as the supervisor says."""

    def begin(self, level: ContactLevel, link: int, tau_ext_hat: Vector, is_model_valid: bool) -> None:  # noqa: ARG002
        """Withdraw; nothing changes that any more."""
        self._begin(Reaction.WITHDRAW, np.zeros(0))
        self._cause = (ContactLevel.COLLISION, link)

    def step(self, level: ContactLevel, link: int, is_latched: bool, tau_ext_hat: Vector, is_model_valid: bool) -> None:
        """Change nothing."""

    def calm(self, calm: Calm, link: int) -> Calm:  # noqa: ARG002
        """Return the bounds as they are."""
        return calm

    def end(self) -> None:
        """Leave the reaction as it is, which nobody asks for until the next contact."""


class ContactCourse:
    """The contact that the arm is about, if there is one. tau_ext_hat (2,): filtered, for the reaction; a view."""

    def __init__(self, evidence: ContactEvidence, choice: ReactionChoice, tau_ext_hat: Vector) -> None:
        self.evidence = evidence
        self._reporter = ContactReporter(evidence)
        self._choice = choice
        self._tau_ext_hat = tau_ext_hat
        self._is_reacting = False
        self._link = 0

    def compile(self) -> None:
        """Run every compiled function once."""
        self._reporter.evidence.compile()

    @property
    def is_reporting(self) -> bool:
        """Whether a report is out that is not final yet."""
        return self._reporter.is_open

    @property
    def reaction(self) -> Reaction:
        """What control is to do about it."""
        return self._choice.reaction

    @property
    def goes_on(self) -> bool:
        """Whether the arm moves on along its path."""
        return self._choice.goes_on

    @property
    def judged(self) -> tuple[tuple[float, float], float]:
        """A way, and the external torque along it, Nm, from which on a withdrawal certainly goes on."""
        return self._choice.judged

    def calm(self, calm: Calm, cycle: int) -> Calm:
        """Narrow the bounds to those within which, from this cycle on, only `pass_by` is to be called."""
        if self._is_reacting and self._link:
            calm = self._choice.calm(calm, self._link)
        return self._reporter.calm(calm, cycle)

    def pass_by(self, cycles: int) -> None:
        """Count calm cycles, which the evidence has taken in."""
        self._reporter.evidence.pass_by(cycles)
        if self._is_reacting and self._link:
            self._choice.pass_by(cycles)

    def step(self, cycle: int, supervisor: Supervisor, observation: int, is_model_valid: bool) -> ContactReport | None:
        """Take in one cycle and return the report that is due in it, if one is.

        supervisor: after its step. observation: the kernel's.
        """
        self._reporter.evidence.observe()
        state, joints = supervisor.state, observation >> CONTACT_SHIFT
        level = ContactLevel.COLLISION if observation & COLLISION else ContactLevel.CONTACT
        if state not in REACTING:
            self._leave(state)
            return None
        choice, tau_ext_hat = self._choice, self._tau_ext_hat
        if not self._is_reacting:
            self._is_reacting = True
            if not joints:
                choice.hold()
                return None
            self._reporter.begin(cycle)
            self._link = 2 if joints & 2 else 1
            choice.begin(level, self._link, tau_ext_hat, is_model_valid)
        elif self._link:
            choice.step(level, self._link, supervisor.is_latched, tau_ext_hat, is_model_valid)
        report = self._reporter.report(cycle, joints) if self._reporter.is_open else None
        if report is None:
            return None
        self._link = report.link
        return report._replace(level=choice.level, reaction=choice.reaction, is_two_sided=choice.is_two_sided)

    def _leave(self, state: SchemeState) -> None:
        """Forget the contact that is over."""
        if self._is_reacting:
            self._is_reacting, self._link = False, 0
            self._choice.end()
        if state is SchemeState.FAULT:
            self._reporter.cancel()
