"""What the devices measure: the lag of a drive's velocity, and the noise of the torque sensors."""

import itertools
import math

import numpy as np
import pytest
from scipy import signal

from firmware_sim.arm.sensing import TorqueNoise, track
from firmware_sim.arm.touch_settings import TICK_S


def tracked(positions_rad: np.ndarray) -> np.ndarray:
    """Give the velocity after each tick (n - 1,) of a tracking loop that starts on the first position, at rest."""
    estimate_rad, velocity_rad_s = positions_rad[0], 0.0
    velocities = []
    for before_rad, now_rad in itertools.pairwise(positions_rad):
        estimate_rad, velocity_rad_s = track(before_rad, now_rad, estimate_rad, velocity_rad_s, TICK_S)
        velocities.append(velocity_rad_s)
    return np.array(velocities)


def test_the_tracking_loop_is_the_critically_damped_200_hz_one():
    """Against scipy's solution of v̂/q = ω² s / (s + ω)² for the same straight lines between encoder values."""
    positions = np.random.default_rng(2).normal(0.0, 0.01, 300)
    positions[0] = 0.0
    times_s = np.arange(300) * TICK_S
    omega = 2.0 * math.pi * 200.0
    system = signal.lti([omega**2, 0.0], [1.0, 2.0 * omega, omega**2])
    _, expected, _ = signal.lsim(system, positions, times_s, interp=True)
    assert np.allclose(tracked(positions), expected[1:], rtol=1e-9, atol=1e-9)


def test_torque_noise_has_its_rms_on_both_joints_independently():
    noise = TorqueNoise(seed=8, rms_Nm=0.02)
    samples = np.array([noise.draw().copy() for _ in range(20_000)])
    assert samples.std(axis=0) == pytest.approx([0.02, 0.02], rel=0.02)
    assert np.abs(samples.mean(axis=0)).max() < 5e-4
    assert abs(np.corrcoef(samples.T)[0, 1]) < 0.03
    assert abs(np.corrcoef(samples[1:, 0], samples[:-1, 0])[0, 1]) < 0.03
