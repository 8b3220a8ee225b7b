"""What the devices measure: lag, quantisation, noise, saturation."""

import itertools
import math

import numpy as np
import pytest
from scipy import signal

from firmware_sim.arm.sensing import (
    POSITION_LSB_RAD,
    TORQUE_LSB_NM,
    TRACKING_RAD_S,
    TorqueNoise,
    to_counts,
    torque_counts,
    track,
)
from firmware_sim.arm.touch_settings import TICK_S


def tracked(positions_rad: np.ndarray) -> np.ndarray:
    """Give the velocity after each tick (n - 1,) of a tracking loop that starts on the first position, at rest."""
    estimate_rad, velocity_rad_s = positions_rad[0], 0.0
    velocities = []
    for before_rad, now_rad in itertools.pairwise(positions_rad):
        estimate_rad, velocity_rad_s = track(before_rad, now_rad, estimate_rad, velocity_rad_s, TICK_S)
        velocities.append(velocity_rad_s)
    return np.array(velocities)


def test_the_velocity_lags_a_steady_acceleration_by_1_59_ms():
    times_s = np.arange(2_000) * TICK_S
    velocity = tracked(0.5 * 8.0 * times_s**2)
    lag_s = times_s[-1] - velocity[-1] / 8.0
    assert lag_s == pytest.approx(2.0 / TRACKING_RAD_S, rel=1e-6)
    assert lag_s == pytest.approx(1.59e-3, abs=5e-6)


def test_a_steady_velocity_is_measured_without_error():
    assert tracked(1.7 * np.arange(2_000) * TICK_S)[-1] == pytest.approx(1.7, rel=1e-12)


def test_the_tracking_loop_is_the_critically_damped_200_hz_one():
    """Against scipy's solution of v̂/q = ω² s / (s + ω)² for the same straight lines between encoder values."""
    positions = np.random.default_rng(2).normal(0.0, 0.01, 300)
    positions[0] = 0.0
    times_s = np.arange(300) * TICK_S
    omega = 2.0 * math.pi * 200.0
    system = signal.lti([omega**2, 0.0], [1.0, 2.0 * omega, omega**2])
    _, expected, _ = signal.lsim(system, positions, times_s, interp=True)
    assert np.allclose(tracked(positions), expected[1:], rtol=1e-9, atol=1e-9)


def test_the_encoder_is_never_off_by_more_than_half_a_count():
    for angle_rad in np.random.default_rng(4).uniform(-7, 7, 500):
        error_rad = to_counts(angle_rad, POSITION_LSB_RAD) * POSITION_LSB_RAD - angle_rad
        assert abs(error_rad) <= 0.5 * POSITION_LSB_RAD * (1 + 1e-9)
    assert to_counts(2.0 * math.pi, POSITION_LSB_RAD) == 1 << 20
    assert to_counts(-math.pi, POSITION_LSB_RAD) == -(1 << 19)


def test_a_resting_encoder_gives_no_velocity():
    assert not tracked(np.full(100, 1234 * POSITION_LSB_RAD)).any()


@pytest.mark.parametrize(
    ("torque_Nm", "counts"),
    [
        (0.0, 0),
        (0.0007, 0),
        (0.0008, 1),
        (-0.0008, -1),
        (1.0, 655),
        (-12.0, -7864),
        (49.9984, 32767),
        (50.0, 32767),
        (75.0, 32767),
        (-50.0, -32768),
        (-75.0, -32768),
        (1e6, 32767),
    ],
)
def test_the_torque_converter_counts_and_saturates(torque_Nm, counts):
    assert torque_counts(torque_Nm) == counts


def test_the_torque_lsb_is_16_bits_over_50_nm_both_ways():
    assert pytest.approx(1.5259e-3, rel=1e-4) == TORQUE_LSB_NM


def test_torque_noise_has_its_rms_on_both_joints_independently():
    noise = TorqueNoise(seed=8, rms_Nm=0.02)
    samples = np.array([noise.draw().copy() for _ in range(20_000)])
    assert samples.std(axis=0) == pytest.approx([0.02, 0.02], rel=0.02)
    assert np.abs(samples.mean(axis=0)).max() < 5e-4
    assert abs(np.corrcoef(samples.T)[0, 1]) < 0.03
    assert abs(np.corrcoef(samples[1:, 0], samples[:-1, 0])[0, 1]) < 0.03


def test_torque_noise_repeats_with_its_seed_and_not_with_another():
    first, again, other = (TorqueNoise(seed=seed, rms_Nm=0.02) for seed in (8, 8, 9))
    for _ in range(600):
        value = first.draw().copy()
        assert value.tobytes() == again.draw().tobytes()
        assert value.tobytes() != other.draw().tobytes()


def test_noise_that_is_off_is_zero():
    noise = TorqueNoise(seed=8, rms_Nm=0.0)
    assert not any(noise.draw().any() for _ in range(600))
