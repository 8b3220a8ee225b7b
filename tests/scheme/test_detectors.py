"""Detectors on one stream, against scipy's filters and closed forms."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.signal
from planar_arm import THETA as ARMS
from smooth_motion import smooth_motion, torque_of

from adacd_hil.lab.detectors.detector_registry import OWN_CHANNELS, detectors, register
from adacd_hil.lab.detectors.detectors import (
    FLOOR_NM,
    VELOCITY_LAG_S,
    autocovariance,
    constants_of,
    likelihood_weights,
    likelihood_windows,
    make_stream,
    new_memory,
    record,
)

T = 1e-3
THETA = ARMS["M"]
WEIGHTS = np.random.default_rng(4).standard_normal((2, 6, 24))


def statistics(z, held=None, block=1):
    constants = constants_of(WEIGHTS, T)
    peaks = np.full((-(-len(z) // block), len(OWN_CHANNELS), 2), np.inf)
    record(constants, new_memory(constants), z, np.zeros(z.shape) if held is None else held, block, peaks)
    return {name: peaks[:, row] for row, name in enumerate(OWN_CHANNELS)}


def low_pass(z, a):
    decay = math.exp(-a * T)
    return scipy.signal.lfilter([1.0 - decay], [1.0, -decay], z, axis=0)


def trapezoid(z, gain):
    # the stream is already the mean over the interval, so of the bilinear numerator only the sum is left
    b, a = scipy.signal.bilinear([gain], [1.0, gain], 1.0 / T)
    return scipy.signal.lfilter([b.sum()], a, z, axis=0)


NOISE = np.random.default_rng(3).standard_normal((400, 2))


@pytest.mark.parametrize(
    ("channel", "expected"),
    [
        ("first-order 10", low_pass(NOISE, 10.0)),
        ("first-order 200", low_pass(NOISE, 200.0)),
        ("smoothed 50", low_pass(low_pass(NOISE, 50.0), 200.0)),
        ("band-pass", low_pass(NOISE, 100.0) - low_pass(NOISE, 10.0)),
        ("observer 25", trapezoid(NOISE, 25.0)),
        ("observer 100", trapezoid(NOISE, 100.0)),
        (
            "likelihood 16",
            np.stack([scipy.signal.lfilter(WEIGHTS[i, 2], [1.0], NOISE[:, i]) for i in range(2)], axis=1),
        ),
    ],
)
def test_a_channel_is_its_linear_filter(channel, expected):
    np.testing.assert_allclose(statistics(NOISE)[channel], np.abs(expected), rtol=1e-10, atol=1e-12)


def test_a_block_keeps_its_largest_statistic():
    every = statistics(NOISE)["observer 25"]
    np.testing.assert_array_equal(
        statistics(NOISE, block=150)["observer 25"], [every[:150].max(0), every[150:300].max(0), every[300:].max(0)]
    )


def test_cusum_adds_up_what_is_above_the_drift_and_forgets_it_at_zero():
    push = np.zeros((3000, 2))
    push[:1000] = (0.5, -0.3)
    summed = statistics(push)["cusum"]
    # each of the two poles delays by 1 / 200 s
    np.testing.assert_allclose(summed[999], [0.48 - 0.5 * 0.01, 0.28 - 0.3 * 0.01], rtol=3e-3)
    assert np.all(np.diff(summed[1100:], axis=0) < 0.0)
    np.testing.assert_allclose(summed[2000] - summed[2999], 0.02 * 0.999, rtol=1e-6)


def test_friction_that_holds_a_joint_still_is_no_torque():
    held = np.zeros((600, 2))
    held[100:400, 0] = 0.2
    friction = 0.2 * np.sign(np.sin(np.arange(600) / 20.0))
    z = np.zeros((600, 2))
    z[100:400, 0] = friction[100:400]
    found = statistics(z, held)
    for name in OWN_CHANNELS:
        assert found[name].max() <= 1e-12, name
    assert statistics(z)["first-order 50"].max() > 0.1


def test_white_noise_makes_the_average_the_best_window_and_a_sigma_of_one():
    sigma_Nm = 1e6 * FLOOR_NM  # beside which the floor is nothing
    (weights,) = likelihood_windows(np.r_[sigma_Nm**2, np.zeros(31)], (8,), 0.0, T)
    average = 1.0 / (sigma_Nm * math.sqrt(8.0))
    np.testing.assert_allclose(weights, average * np.r_[np.ones(8), np.zeros(24)], rtol=1e-9, atol=1e-9 * average)


def test_a_whitened_window_has_a_sigma_of_one_on_coloured_noise():
    white = np.random.default_rng(5).standard_normal((200_000, 2))
    coloured = scipy.signal.lfilter([0.02, -0.015], [1.0, -0.5], white, axis=0)
    weights = likelihood_weights(coloured, 1.5e-3, T)[:, :-1]  # the longest one trusts no average that far
    for window in weights.reshape(-1, weights.shape[-1]):
        through = scipy.signal.lfilter(window, [1.0], coloured[:, 0])
        assert 0.88 < through.std() <= 1.02


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: autocovariance(np.zeros(90), 10), "90 samples"),
        (lambda: likelihood_windows(np.zeros(8), (4,), 0.0, T), "variance"),
        (lambda: likelihood_windows(np.ones(8), (9,), 0.0, T), "8 samples"),
    ],
)
def test_what_cannot_be_designed_is_refused(call, words):
    with pytest.raises(ValueError, match=words):
        call()


def moving_arm(lag_s=0.0):
    """A free motion with its exact torque, the velocity `lag_s` old."""
    t_s = np.arange(3000) * T
    motion = smooth_motion(t_s)
    return motion[0], smooth_motion(t_s - lag_s)[1], torque_of(*motion, THETA)


def test_the_stream_of_a_free_arm_is_zero_but_for_the_reversals():
    q, dq, tau = moving_arm()
    z, held = make_stream(q, dq, tau, THETA, np.full(len(q), T), lag_s=0.0)
    is_far = (np.minimum(np.abs(dq[1:]), np.abs(dq[:-1])) > 0.01).all(axis=1)
    assert np.abs(z[1:][is_far]).max() < 2e-5
    assert held.max() == 0.15
    assert np.all((held > 0.0) == (np.abs(dq) < 2e-3))


def test_nothing_is_predicted_of_the_friction_of_a_joint_that_stands_still():
    dq = np.tile([1e-3, -1e-3], (50, 1))
    z, held = make_stream(np.zeros((50, 2)), dq, np.zeros((50, 2)), THETA, np.full(50, T), VELOCITY_LAG_S)
    np.testing.assert_allclose(z[1:], np.tile([0.12e-3, -0.06e-3], (49, 1)), atol=1e-9)
    np.testing.assert_array_equal(held, np.tile([0.15, 0.08], (50, 1)))


def test_an_external_torque_comes_out_positive_when_it_pushes_toward_plus_q():
    q, dq, tau = moving_arm()
    z, _ = make_stream(q, dq, tau - np.array([0.4, -0.2]), THETA, np.full(len(q), T), lag_s=0.0)
    np.testing.assert_allclose(np.median(z, axis=0), [0.4, -0.2], atol=1e-4)


def test_a_lag_that_is_known_is_taken_out():
    q, dq, tau = moving_arm(lag_s=1.5e-3)
    left = [np.abs(make_stream(q, dq, tau, THETA, np.full(len(q), T), lag_s=lag)[0]) for lag in (0.0, 1.5e-3)]
    assert np.quantile(left[1], 0.9) < 0.15 * np.quantile(left[0], 0.9)


def test_a_gap_and_a_change_of_theta_are_no_torque():
    q, dq, tau = moving_arm()
    keep = np.r_[0:1200, 1500:3000]
    interval_s = np.full(len(keep), T)
    interval_s[1200] = 0.0
    unchanged, _ = make_stream(q[keep], dq[keep], tau[keep], THETA, interval_s, lag_s=0.0)
    theta = np.tile(THETA, (len(keep), 1))
    theta[600:, 0] *= 1.01
    z, _ = make_stream(q[keep], dq[keep], tau[keep], theta, interval_s, lag_s=0.0)
    assert np.all(z[1200] == 0.0)
    a1_Nm = 0.01 * THETA[0] * np.diff(dq[:, 0])[600:1199] / T
    np.testing.assert_allclose(z[601:1200, 0] - unchanged[601:1200, 0], a1_Nm, atol=1e-9)
    np.testing.assert_allclose(
        z[600, 0] - unchanged[600, 0], 0.01 * THETA[0] * (dq[600, 0] - dq[599, 0]) / T, atol=1e-9
    )


@pytest.mark.parametrize(
    ("name", "take", "words"),
    [
        ("paper", lambda x: x, "there is a detector or channel paper already"),
        ("observer 25", lambda x: x, "there is a detector or channel observer 25 already"),
        ("plain", lambda x: x[:, 0], r"detector plain gives statistics \(400,\) for samples \(400, 2\)"),
        (
            "plain",
            lambda x: np.where(np.arange(len(x))[:, None] == 7, np.nan, x),
            "detector plain gives nan for sample 7 of joint 1",
        ),
        ("plain", lambda x: x / x.max(), "gives sample 1 another statistic where the stream is cut at 136 and 137"),
    ],
)
def test_a_detector_that_breaks_the_contract_is_refused_and_named(name, take, words):
    before = detectors()
    with pytest.raises(ValueError, match=words):
        register(name, lambda period_s: SimpleNamespace(take=lambda z, held_Nm: take(np.abs(z))))
    assert detectors() == before
