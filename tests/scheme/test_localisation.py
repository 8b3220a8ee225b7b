"""Force and lever arm of a contact, against the statics of the arm written out by hand."""

import math

import numpy as np
import pytest

from adacd_hil.records import Location
from adacd_hil.scheme.contact.localisation import blind_angle, blind_angle_of_link1, on_link1, on_link2

L1, L2 = 0.35, 0.30
LENGTHS = (L1, L2)
SIGMA = np.array([0.03, 0.015])


def torques(force_N, lever_m, q2, angle=0.5 * math.pi):
    """Return tau (2,) of a force on link 2, at an angle from its axis, in world coordinates."""
    at = np.array([L1 + lever_m * math.cos(q2), lever_m * math.sin(q2)])
    force = force_N * np.array([math.cos(q2 + angle), math.sin(q2 + angle)])
    moment = [at[0] * force[1] - at[1] * force[0]]
    moment.append((at[0] - L1) * force[1] - at[1] * force[0])
    return np.array(moment)


def blow(force_N, lever_m, q2, sigma=(0.0, 0.0), seed=0, samples=60):
    """Return a half-sine's torques (n, 2) with noise, and q2 (n,)."""
    shape = np.sin(np.pi * np.arange(samples) / samples)
    noise = np.random.default_rng(seed).normal(size=(samples, 2)) * sigma
    return shape[:, None] * torques(force_N, lever_m, q2) + noise, np.full(samples, q2)


@pytest.mark.parametrize("q2", [0.0, -0.7, 1.2, 2.6])
@pytest.mark.parametrize(("force_N", "lever_m"), [(12.0, 0.05), (-30.0, 0.29), (8.0, 0.15)])
def test_force_and_lever_arm_of_one_contact_are_found(force_N, lever_m, q2):
    place = on_link2(*blow(force_N, lever_m, q2), 1e-6 * SIGMA, LENGTHS)
    assert place.location is Location.KNOWN
    assert 0.98 * abs(force_N) < abs(place.force_N) < abs(force_N)  # a median over the top of a half-sine
    assert place.force_N * force_N > 0.0
    assert place.lever_m == pytest.approx(lever_m, rel=1e-6)


def test_noise_shifts_the_lever_arm_as_its_standard_deviation_says():
    places = [on_link2(*blow(10.0, 0.2, 0.6, SIGMA, seed), SIGMA, LENGTHS) for seed in range(300)]
    lever = np.array([place.lever_m for place in places])
    assert np.mean(lever) == pytest.approx(0.2, abs=2e-3)
    assert np.std(lever) < np.mean([place.lever_sigma for place in places])
    noise = math.hypot(*SIGMA) / (L1 * math.cos(0.6))
    assert np.std([place.force_N for place in places]) < 0.5 * noise
    assert places[0].force_sigma > noise


@pytest.mark.parametrize("samples", [40, 100, 400])
@pytest.mark.parametrize("where", [0.05, 0.5, 0.8])
def test_a_jump_of_the_drives_torque_does_not_make_the_force_larger(samples, where):
    tau = np.tile(torques(10.0, 0.2, 0.6), (samples, 1))
    jump = int(where * samples)
    tau[jump : jump + max(samples // 10, 4)] *= (1.5, 1.1)
    place = on_link2(tau, np.full(samples, 0.6), SIGMA, LENGTHS)
    assert place.force_N == pytest.approx(10.0, rel=1e-6)


def test_of_a_force_that_grows_the_strongest_part_counts():
    tau = np.linspace(0.0, 1.0, 90)[:, None] * torques(12.0, 0.2, 0.6)
    assert on_link2(tau, np.full(90, 0.6), SIGMA, LENGTHS).force_N == pytest.approx(11.0, rel=0.02)


def test_one_sample_is_enough():
    place = on_link2(torques(-12.0, 0.2, 0.6)[None], np.full(1, 0.6), SIGMA, LENGTHS)
    assert place.force_N == pytest.approx(-12.0)


@pytest.mark.parametrize("q2", [math.radians(89.0), math.radians(-95.0)])
def test_at_a_square_elbow_nothing_is_claimed(q2):
    place = on_link2(*blow(20.0, 0.2, q2), SIGMA, LENGTHS)
    assert place.location is Location.SINGULAR
    assert math.isinf(place.force_sigma)
    assert math.isinf(place.lever_sigma)


def test_a_weak_touch_is_uncertain():
    assert on_link2(*blow(1.0, 0.2, 0.6), SIGMA, LENGTHS).location is Location.UNCERTAIN


@pytest.mark.parametrize(
    ("lever_m", "location"),
    [(0.31, Location.KNOWN), (0.42, Location.BEYOND_TIP), (-0.15, Location.INCONSISTENT), (0.9, Location.INCONSISTENT)],
)
def test_a_lever_arm_off_the_link_is_said(lever_m, location):
    assert on_link2(*blow(20.0, lever_m, 0.3), SIGMA, LENGTHS).location is location


def test_on_link1_the_smallest_force_with_the_moment_is_given():
    place = on_link1(-3.5, 0.07, L1)
    assert (place.location, place.force_N, place.force_sigma) == (Location.LINK_1, -10.0, pytest.approx(0.2))
    assert math.isinf(place.lever_sigma)


@pytest.mark.parametrize("angle", [0.02, -0.03, 0.2])
def test_a_force_within_the_blind_cone_stays_below_joint_2s_threshold(angle):
    threshold = 0.08
    tau = torques(15.0, L2, 0.9, angle)
    seen = blind_angle_of_link1(tau[0], 0.9, LENGTHS, threshold)
    assert (abs(tau[1]) < threshold) == (abs(angle) < blind_angle(15.0, L2, threshold))
    assert seen == pytest.approx(blind_angle(15.0, L2, threshold), rel=0.3)


def test_a_force_too_weak_for_joint_2_is_blind_in_every_direction():
    assert blind_angle(0.1, 0.3, 0.08) == 0.5 * math.pi
