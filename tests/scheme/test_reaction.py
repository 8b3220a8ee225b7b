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
def test_the_withdrawal_begins_where_the_motion_is(q_d, dq_d, tau_ext_hat):
    position, velocity, _ = sampled(q_d, dq_d, tau_ext_hat)
    np.testing.assert_array_equal(position[0], q_d)
    np.testing.assert_allclose(velocity[0], dq_d, atol=1e-12)


@given(POSITIONS, VELOCITIES, TORQUES)
def test_the_withdrawal_ends_at_rest_and_stays(q_d, dq_d, tau_ext_hat):
    position, velocity, acceleration = sampled(q_d, dq_d, tau_ext_hat)
    np.testing.assert_array_equal(position[-9:], np.tile(position[-1], (9, 1)))
    np.testing.assert_array_equal(velocity[-9:], 0.0)
    np.testing.assert_array_equal(acceleration[-9:], 0.0)


@given(POSITIONS, VELOCITIES, TORQUES)
def test_the_withdrawal_respects_the_acceleration_limits(q_d, dq_d, tau_ext_hat):
    _, velocity, _ = sampled(q_d, dq_d, tau_ext_hat)
    assert np.all(np.abs(np.diff(velocity, axis=0)) <= ACCELERATION_LIMIT * T * (1.0 + 1e-9))


@given(POSITIONS, VELOCITIES, TORQUES)
def test_the_withdrawal_respects_the_velocity_limits(q_d, dq_d, tau_ext_hat):
    _, velocity, _ = sampled(q_d, dq_d, tau_ext_hat)
    assert np.all(np.abs(velocity) <= VELOCITY_LIMIT * (1.0 + 1e-12))


@given(POSITIONS, VELOCITIES, TORQUES)
def test_position_is_the_integral_of_velocity(q_d, dq_d, tau_ext_hat):
    position, velocity, _ = sampled(q_d, dq_d, tau_ext_hat)
    trapezoid = 0.5 * T * (velocity[1:] + velocity[:-1])
    np.testing.assert_allclose(np.diff(position, axis=0), trapezoid, atol=0.25 * np.max(ACCELERATION_LIMIT) * T**2)


@given(POSITIONS, VELOCITIES, TORQUES)
def test_the_arm_never_moves_back_toward_the_person(q_d, dq_d, tau_ext_hat):
    """A joint speeds up along the external torque only; against it, it only brakes."""
    _, velocity, _ = sampled(q_d, dq_d, tau_ext_hat)
    against = -velocity * np.where(tau_ext_hat < 0.0, -1.0, 1.0)
    assert np.all(np.diff(np.maximum(against, 0.0), axis=0) <= 1e-9)


@given(POSITIONS, VELOCITIES, TORQUES)
def test_the_target_stays_clear_of_the_position_limits(q_d, dq_d, tau_ext_hat):
    """But for a joint that can't stop before."""
    position, _, _ = sampled(q_d, dq_d, tau_ext_hat)
    stop = q_d + dq_d * np.abs(dq_d) / (2.0 * ACCELERATION_LIMIT)
    reachable = np.maximum(POSITION_LIMIT, np.maximum(np.abs(q_d), np.abs(stop)))
    assert np.all(np.abs(position[-1]) <= reachable + 1e-12)


def test_an_arm_at_rest_withdraws_the_full_distance_on_the_joint_pushed_most():
    position, _, _ = sampled((0.1, 0.2), (0.0, 0.0), (1.0, -0.5))
    np.testing.assert_allclose(position[-1], [0.1 + DISTANCE[0], 0.2 - 0.5 * DISTANCE[1]], rtol=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_joint_near_its_limit_withdraws_only_as_far_as_the_margin(sign):
    position, _, _ = sampled((sign * (POSITION_LIMIT[0] - 0.02), 0.0), (0.0, 0.0), (sign * 1.0, 0.0))
    np.testing.assert_allclose(position[-1], [sign * POSITION_LIMIT[0], 0.0], rtol=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_joint_beyond_its_margin_holds_its_place(sign):
    q_d = (sign * (POSITION_LIMIT[0] + 0.01), 0.0)
    position, _, _ = sampled(q_d, (0.0, 0.0), (sign * 1.0, 0.0))
    np.testing.assert_allclose(position[-1], q_d, rtol=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_joint_that_comes_back_from_beyond_its_margin_stops_where_it_can(sign):
    q_d, dq_d = sign * (POSITION_LIMIT[0] + 0.2), sign * -0.5
    position, _, _ = sampled((q_d, 0.0), (dq_d, 0.0), (sign * 1.0, 0.0))
    np.testing.assert_allclose(position[-1, 0], q_d - sign * 0.5**2 / (2.0 * ACCELERATION_LIMIT[0]), rtol=1e-12)


def test_without_an_external_torque_the_arm_just_stops():
    position, _, _ = sampled((0.0, 0.0), (1.0, -0.5), (0.0, 0.0))
    stop = np.array([1.0, -0.5]) * np.array([1.0, 0.5]) / (2.0 * ACCELERATION_LIMIT)
    np.testing.assert_allclose(position[-1], stop, rtol=1e-12)


def test_the_way_from_rest_to_rest_takes_the_least_time():
    """Speed up over half of the distance, brake over the other: 2 sqrt(d / A)."""
    profile = time_optimal(0.0, 0.0, 0.1, 100.0, 12.0)
    np.testing.assert_allclose(profile.duration_s, 2.0 * np.sqrt(0.1 / 12.0), rtol=1e-12)


def test_a_long_way_is_cruised_at_the_velocity_limit():
    """d / V + V / A."""
    profile = time_optimal(0.0, 0.0, -2.0, 0.5, 10.0)
    np.testing.assert_allclose(profile.duration_s, 2.0 / 0.5 + 0.5 / 10.0, rtol=1e-12)


def test_moving_the_wrong_way_costs_the_time_to_turn_round():
    """Brake for v / A, having gone v² / 2A the wrong way, then from rest to rest."""
    profile = time_optimal(0.0, -1.0, 0.1, 100.0, 10.0)
    np.testing.assert_allclose(profile.duration_s, 0.1 + 2.0 * np.sqrt((0.1 + 0.05) / 10.0), rtol=1e-12)


def test_a_velocity_over_the_limit_is_braked_to_it_first():
    profile = time_optimal(0.0, 2.0, 3.0, 1.0, 10.0)
    assert profile.at(0.05)[2] == -10.0
    np.testing.assert_allclose(profile.at(0.15)[1], 1.0, rtol=1e-12)


def test_before_its_start_a_profile_stands_at_its_start():
    assert time_optimal(0.3, 0.5, 1.0, 1.0, 10.0).at(-1.0)[:2] == (0.3, 0.5)
