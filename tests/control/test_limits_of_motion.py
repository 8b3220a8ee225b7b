"""Every desired motion stays within the arm's limits, from whatever it begins with."""

import dataclasses

import numpy as np
import pytest
from desired_motion import Desired
from long_cases import long_but

from adacd_hil.control.reference import LOST_CYCLES
from adacd_hil.records import JOINTS, Event, Reaction, SchemeState, Vector
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings

SCHEMES = ("paper", "certified")
PERIOD_US = 10_000
"""Long, so that many starts are played in little time; the limits hold at each sample all the same."""
LEARNING_OR_ARMED = (SchemeState.ADAPT, SchemeState.CERTIFY, SchemeState.MONITOR)
REACTIONS = (Reaction.STOP, Reaction.WITHDRAW, Reaction.ADMITTANCE, Reaction.SLOW_DOWN, Reaction.FLOAT)
STARTS_AT_ONCE = 50
"""Starts of one arm, one after the other."""


def settings_of(scheme: str, random: np.random.Generator) -> Settings:
    """Return a configuration whose limits are drawn around what trajectory and excitation need."""
    found = load_settings(scheme, "P")
    wider = random.uniform(1.0, 1.5, 2)
    arm = dataclasses.replace(
        found.arm,
        position_limit_deg=tuple(wider * found.trajectory.amplitude_deg),
        velocity_limit_deg_s=tuple(random.uniform(1.0, 2.0, 2) * (101.0, 121.0)),
    )
    reaction = dataclasses.replace(
        found.reaction,
        acceleration_limit_deg_s2=tuple(random.uniform(1.0, 2.0, 2) * (700.0, 900.0)),
        position_margin_deg=float(random.uniform(0.0, 3.0)),
        start="measured",
    )
    bus = dataclasses.replace(found.bus, period_us=PERIOD_US)
    trajectory = dataclasses.replace(found.trajectory, approach_deg_s=float(random.uniform(20.0, 200.0)))
    return dataclasses.replace(found, arm=arm, reaction=reaction, bus=bus, trajectory=trajectory)


class Course:
    """One arm whose states, reactions and losses are drawn."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)
        self.settings = settings_of(SCHEMES[seed % 2], self.random)
        self.desired = Desired(self.settings)
        self.limits = np.array(
            [
                self.settings.arm.position_limit_rad,
                self.settings.arm.velocity_limit_rad_s,
                np.radians(self.settings.reaction.acceleration_limit_deg_s2),
            ]
        )
        self.motion: list[Vector] = []
        self.said: list[Event] = []

    def play(self, starts: int) -> None:
        """Begin so many motions, each wherever the one before has come to."""
        self.step(SchemeState.ADAPT, 60)
        for _ in range(starts):
            self.step(LEARNING_OR_ARMED[self.random.integers(3)], int(self.random.integers(1, 200)))
            (self.pause, self.react, self.lose)[self.random.integers(3)]()
        self.desired.reference.park()
        self.step(SchemeState.MONITOR, 3000)
        assert self.desired.reference.is_parked(self.desired.cycle)

    def pause(self) -> None:
        """Let the user change the payload, perhaps before the arm has come to its corner."""
        self.step(SchemeState.PAYLOAD, int(self.random.integers(1, 200)))

    def react(self) -> None:
        """Push the arm, perhaps twice, and perhaps throw it."""
        self.desired.follows = self.random.random() < 0.7
        if not self.desired.follows:
            self.throw()
        for _ in range(self.random.integers(1, 3)):
            tau = tuple(self.random.normal(scale=3.0, size=2))
            self.step(SchemeState.REACT, int(self.random.integers(1, 40)), REACTIONS[self.random.integers(5)], tau)
        if self.random.random() < 0.5:
            self.step(SchemeState.STOPPED, int(self.random.integers(1, 40)), self.desired.reaction)
        self.desired.follows = True

    def lose(self) -> None:
        """Lose the arm's feedback, and find it elsewhere."""
        self.desired.ages = (3, 3)
        self.step(SchemeState.MONITOR, LOST_CYCLES + 1)
        self.desired.ages = (0, 0)
        if self.random.random() < 0.5:
            self.desired.follows = False
            self.throw()
            self.step(SchemeState.MONITOR, 1)
            self.desired.follows = True

    def throw(self) -> None:
        """Put the arm anywhere within its limits of position and velocity."""
        self.desired.q = self.random.uniform(-1.0, 1.0, 2) * self.limits[0]
        self.desired.dq = self.random.uniform(-1.0, 1.0, 2) * self.limits[1]

    def step(
        self,
        state: SchemeState,
        cycles: int,
        reaction: Reaction = Reaction.NONE,
        tau: tuple[float, ...] = (0.0, 0.0),
    ) -> None:
        self.motion.append(self.desired.step(state, reaction, tau, cycles))
        self.said += self.desired.reference.take_events()

    def beyond(self) -> set[int]:
        """Return the joints, from 1, whose desired position leaves its limit somewhere."""
        position = np.abs(np.concatenate(self.motion)[:, 0])
        return {i + 1 for i in range(JOINTS) if np.any(position[:, i] > self.limits[0, i] + 1e-12)}

    def largest_shares(self) -> Vector:
        """Return how much of the limits of speed and acceleration is used at most (2, n)."""
        motion = np.concatenate(self.motion)
        return np.max(np.abs(motion[:, 1:]), axis=0) / self.limits[1:]


def check(seed: int) -> set[int]:
    """Play one arm, and compare with its limits; return the joints that couldn't stop within their position limit."""
    course = Course(seed)
    course.play(STARTS_AT_ONCE)
    assert np.max(course.largest_shares()) <= 1.0 + 1e-3, f"seed {seed}"
    said = {int(event.message.split()[1]) for event in course.said if event.name == "motion"}
    assert course.beyond() <= said, f"seed {seed}"
    return said


@pytest.mark.slow
@pytest.mark.parametrize("seeds", long_but(1, [range(40), range(1000, 3000)]))
def test_every_motion_stays_within_position_speed_and_acceleration_limits(seeds: range) -> None:
    """Also from a hundred thousand starts."""
    too_fast = [check(seed) for seed in seeds]
    assert any(too_fast)  # some are thrown too near to a limit


def planned(settings: Settings) -> list[Vector]:
    """Return the whole of each motion from park to park: of an arm that is asked to end at 8 times in a period."""
    courses = []
    for at_s in np.linspace(0.05, 2.4, 8):
        desired = Desired(settings)
        desired.step(SchemeState.ADAPT, cycles=round(at_s / settings.bus.period_s))
        desired.reference.park()
        courses.append(desired.step(SchemeState.ADAPT, cycles=3000))
        assert desired.reference.is_parked(desired.cycle)
    return courses


@pytest.mark.parametrize("scheme", SCHEMES)
def test_an_arm_that_ends_goes_smoothly_and_stays_between_where_it_has_been_and_its_corner(scheme: str) -> None:
    settings = load_settings(scheme, "P")
    for course in planned(settings):
        assert np.all(np.abs(course[:, 0]) <= np.radians(settings.trajectory.amplitude_deg) * (1.0 + 1e-3))
        # A tenth of the acceleration limit; a brake begins with all of it.
        assert np.max(np.abs(np.diff(course[:, 2], axis=0))) < np.radians(70.0)
        np.testing.assert_allclose(np.diff(course[:, 0], axis=0), 1e-3 * course[1:, 1], atol=1e-5)


def test_a_joint_that_cannot_stop_before_its_limit_brakes_and_says_so() -> None:
    settings = load_settings("paper", "P")
    desired = Desired(settings)
    desired.step(SchemeState.MONITOR, cycles=300)
    desired.follows, desired.q, desired.dq = False, np.radians([72.0, 0.0]), np.radians([90.0, 10.0])
    desired.ages = (3, 3)
    desired.step(SchemeState.MONITOR, cycles=LOST_CYCLES + 1)
    desired.ages = (0, 0)
    course = desired.step(SchemeState.MONITOR, cycles=400)
    (event,) = desired.reference.take_events()
    assert (event.level, event.name) == ("warning", "motion")
    assert "joint 1" in event.message
    stop_deg = 72.0 + 90.0**2 / 1400.0
    assert f"{stop_deg:.1f} deg" in event.message
    assert np.degrees(course[:, 0, 0].max()) == pytest.approx(stop_deg, abs=0.1)
