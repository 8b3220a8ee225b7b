"""The withdrawal: away, within the limits, to an exact stop."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from smooth_motion import settings_with

from adacd_hil.scheme.contact.reaction import Withdrawal, time_optimal

T = 1e-3
SETTINGS = settings_with()
VELOCITY_LIMIT = np.radians(SETTINGS.reaction.velocity_limit_deg_s)
ACCELERATION_LIMIT = np.radians(SETTINGS.reaction.acceleration_limit_deg_s2)
POSITION_LIMIT = SETTINGS.arm.position_limit_rad - np.radians(SETTINGS.reaction.position_margin_deg)
DISTANCE = np.radians(SETTINGS.reaction.distance_deg)


def pair(low, high):
    return st.tuples(st.floats(low, high), st.floats(low, high)).map(np.array)


POSITIONS = pair(-2.2, 2.2)  # some beyond the limits
VELOCITIES = pair(-1.7, 1.7)
TORQUES = pair(-5.0, 5.0)


def sampled(q_d, dq_d, tau_ext_hat, settings=SETTINGS):
    """Return q_d, dq_d, ddq_d (n, 2) per period, to rest and ten periods longer."""
    withdrawal = Withdrawal(settings, np.array(q_d), np.array(dq_d), np.array(tau_ext_hat))
    count = int(withdrawal.duration_s / T) + 11
    motion = np.zeros((3, count, 2))
    for k in range(count):
        withdrawal.evaluate(k * T, *motion[:, k])
    return tuple(motion)


@given(POSITIONS, VELOCITIES, TORQUES)
def test_a_withdrawal_leads_from_the_present_motion_to_rest_within_the_limits_and_never_back(q_d, dq_d, tau_ext_hat):
    position, velocity, acceleration = sampled(q_d, dq_d, tau_ext_hat)
    np.testing.assert_array_equal(position[0], q_d)
    np.testing.assert_allclose(velocity[0], dq_d, atol=1e-12)
    np.testing.assert_array_equal(position[-9:], np.tile(position[-1], (9, 1)))
    assert not velocity[-9:].any()
    assert not acceleration[-9:].any()
    assert np.all(np.abs(np.diff(velocity, axis=0)) <= ACCELERATION_LIMIT * T * (1.0 + 1e-9))
    assert np.all(np.abs(velocity) <= VELOCITY_LIMIT * (1.0 + 1e-12))
    trapezoid = 0.5 * T * (velocity[1:] + velocity[:-1])
    np.testing.assert_allclose(np.diff(position, axis=0), trapezoid, atol=0.25 * np.max(ACCELERATION_LIMIT) * T**2)
    # a joint speeds up along the external torque only; against it, it only brakes
    against = -velocity * np.where(tau_ext_hat < 0.0, -1.0, 1.0)
    assert np.all(np.diff(np.maximum(against, 0.0), axis=0) <= 1e-9)
    # clear of the position limits, but for a joint that can't stop before
    stop = q_d + dq_d * np.abs(dq_d) / (2.0 * ACCELERATION_LIMIT)
    reachable = np.maximum(POSITION_LIMIT, np.maximum(np.abs(q_d), np.abs(stop)))
    assert np.all(np.abs(position[-1]) <= reachable + 1e-12)


def test_an_arm_at_rest_withdraws_the_full_distance_on_the_joint_pushed_most():
    position, _, _ = sampled((0.1, 0.2), (0.0, 0.0), (1.0, -0.5))
    np.testing.assert_allclose(position[-1], [0.1 + DISTANCE[0], 0.2 - 0.5 * DISTANCE[1]], rtol=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("beyond_rad", "dq_d", "target_rad"),
    [(-0.02, 0.0, 0.0), (0.01, 0.0, 0.01), (0.2, -0.5, 0.2 - 0.5**2 / (2.0 * ACCELERATION_LIMIT[0]))],
    ids=["as far as the margin", "holds its place beyond", "comes back and stops where it can"],
)
def test_a_joint_near_its_limit_withdraws_only_as_far_as_the_margin(sign, beyond_rad, dq_d, target_rad):
    q_d = sign * (POSITION_LIMIT[0] + beyond_rad)
    position, _, _ = sampled((q_d, 0.0), (sign * dq_d, 0.0), (sign * 1.0, 0.0))
    np.testing.assert_allclose(position[-1], [sign * (POSITION_LIMIT[0] + target_rad), 0.0], rtol=1e-12)


def test_without_an_external_torque_the_arm_just_stops():
    position, _, _ = sampled((0.0, 0.0), (1.0, -0.5), (0.0, 0.0))
    stop = np.array([1.0, -0.5]) * np.array([1.0, 0.5]) / (2.0 * ACCELERATION_LIMIT)
    np.testing.assert_allclose(position[-1], stop, rtol=1e-12)


@pytest.mark.parametrize(
    ("velocity", "target", "limits", "duration_s"),
    [
        (0.0, 0.1, (100.0, 12.0), 2.0 * np.sqrt(0.1 / 12.0)),  # half of the way to speed up, half to brake
        (0.0, -2.0, (0.5, 10.0), 2.0 / 0.5 + 0.5 / 10.0),  # cruised at the limit
        (-1.0, 0.1, (100.0, 10.0), 0.1 + 2.0 * np.sqrt((0.1 + 0.05) / 10.0)),  # brakes first, v² / 2A the wrong way
    ],
)
def test_a_way_takes_the_least_time(velocity, target, limits, duration_s):
    assert time_optimal(0.0, velocity, target, *limits).duration_s == pytest.approx(duration_s, rel=1e-12)


def test_a_velocity_over_the_limit_is_braked_to_it_first():
    profile = time_optimal(0.0, 2.0, 3.0, 1.0, 10.0)
    assert profile.at(0.05)[2] == -10.0
    np.testing.assert_allclose(profile.at(0.15)[1], 1.0, rtol=1e-12)


def test_before_its_start_a_profile_stands_at_its_start():
    assert time_optimal(0.3, 0.5, 1.0, 1.0, 10.0).at(-1.0)[:2] == (0.3, 0.5)
