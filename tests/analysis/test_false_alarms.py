"""Thresholds for a wanted rate of false alarms, against distributions whose tail is known."""

import math

import numpy as np
import pytest
import scipy.signal
import scipy.stats

from adacd_hil.lab.signal_noise import low_pass, resolution, white_noise
from adacd_hil.lab.thresholds.false_alarms import (
    BLOCK_S,
    Sensing,
    Tail,
    TooLittleMotionError,
    calibrate,
    calibrate_detector,
    clusters,
    counted_hours,
    find_limits,
    fit_tail,
    gains,
    largest_ratio,
    peak_factor,
)
from adacd_hil.scheme.detect.margin_watch import MarginWatch

T = 1e-3


def test_what_is_near_is_one_alarm():
    peaks = np.zeros(40)
    peaks[[3, 4, 8, 20, 30, 36]] = [1.0, 3.0, 2.0, 5.0, 4.0, 6.0]
    peaks[10:12] = np.nan
    np.testing.assert_array_equal(clusters(peaks, 0.5), [3.0, 5.0, 4.0, 6.0])
    assert clusters(peaks, 6.0).size == 0


@pytest.mark.parametrize("shape", [-0.3, 0.0, 0.2])
def test_a_tail_is_a_generalised_pareto_distribution(shape):
    tail = Tail(level=2.0, scale=0.5, shape=shape, rate_per_h=40.0, hours=1.0, count=40)
    thresholds = np.linspace(2.0, 3.4, 6)
    survival = scipy.stats.genpareto.sf(thresholds - 2.0, shape, scale=0.5)
    np.testing.assert_allclose([tail.rate_at(h) for h in thresholds], 40.0 * survival, rtol=1e-9)
    np.testing.assert_allclose(tail.rate_at(tail.threshold_at(3.0)), 3.0, rtol=1e-9)


def noise_peaks(seed, hours, count=1):
    """Block maxima of |Gaussian noise| through 10 rad/s, sampled every 10 ms, as sigmas (B, count)."""
    decay = math.exp(-0.1)
    white = np.random.default_rng(seed).standard_normal((round(hours * 360_000), count))
    x = np.abs(scipy.signal.lfilter([math.sqrt(1.0 - decay**2)], [1.0, -decay], white, axis=0))
    return x.reshape(-1, 10, count).max(axis=1)


def test_the_predicted_rate_is_that_of_other_motion():
    peaks, held_out = noise_peaks(1, 2.0)[:, 0], noise_peaks(2, 4.0)[:, 0]
    for rate_per_h in (5.0, 20.0, 100.0):
        alarms = clusters(held_out, calibrate(peaks, rate_per_h).threshold)
        assert 0.5 < alarms.size / counted_hours(held_out) / rate_per_h < 2.0


@pytest.mark.slow
def test_a_rate_that_was_never_seen_is_extrapolated_within_its_bound():
    found = calibrate(noise_peaks(3, 1.0)[:, 0], 0.05)
    truth = calibrate(noise_peaks(4, 15.0)[:, 0], 0.5)
    assert found.extrapolation > 1.0 > truth.extrapolation
    assert truth.threshold < found.bound
    assert found.threshold < found.bound < 1.4 * truth.threshold
    assert found.rate_bound_per_h > found.rate_per_h


def test_a_detector_of_channels_that_see_different_noise_alarms_as_often_as_wanted():
    peaks = noise_peaks(6, 2.0, 4).reshape(-1, 2, 2)
    thresholds, _ = calibrate_detector(peaks, 40.0)
    assert 34.0 < clusters(largest_ratio(peaks, thresholds), 1.0).size / 2.0 < 46.0


@pytest.mark.parametrize(("rate_per_h", "low", "high"), [(300.0, 1.2, 1.3), (6000.0, 1.05, 1.15)])
def test_alarms_that_merge_at_a_low_level_are_not_few(rate_per_h, low, high):
    peaks = np.abs(np.random.default_rng(1).normal(1.0, 0.1, (3000, 1, 2)))
    peaks[::600, 0, 0] = 1e-4
    threshold = calibrate(peaks[:, 0, 0], rate_per_h).threshold
    assert low < threshold < high
    assert clusters(peaks[:, 0, 0], threshold).size <= rate_per_h * counted_hours(peaks[:, 0, 0])
    thresholds, _ = calibrate_detector(peaks, 2.0 * rate_per_h)
    assert low - 0.1 < thresholds.min() < thresholds.max() < high + 0.1


@pytest.mark.parametrize("peaks", [np.random.default_rng(0).random(300), np.zeros(40_000)])
def test_too_little_motion_is_said(peaks):
    with pytest.raises(TooLittleMotionError, match=r"contact-free motion|stand apart"):
        calibrate(peaks, 1.0)


def test_the_gains_are_those_of_the_filtered_stream():
    white = 0.02 * np.random.default_rng(6).standard_normal(200_000)
    mean, slope = 0.5 * (white[1:] + white[:-1]), np.diff(white) / T
    torque, momentum = gains((50.0, 200.0), T, 1.5e-3)
    np.testing.assert_allclose(low_pass(mean - 1.5e-3 * slope, (50.0, 200.0), T).std(), 0.02 * torque, rtol=0.02)
    np.testing.assert_allclose(low_pass(slope, (50.0, 200.0), T).std(), 0.02 * momentum, rtol=0.02)


def test_the_peak_of_noise_is_that_of_rices_formula():
    # a second-order spectrum, for which the formula holds: mean frequency sqrt(w1 w2)
    white = np.random.default_rng(7).standard_normal(720_000)
    x = low_pass(white, (20.0, 20.0), T)
    level = peak_factor(3600.0, 20.0) * x.std()
    ups = np.count_nonzero((np.abs(x[1:]) > level) & (np.abs(x[:-1]) <= level))
    assert 0.7 < ups / 720.0 < 1.3


def test_resolution_and_noise_of_a_measurement_are_found():
    generator = np.random.default_rng(8)
    smooth = np.sin(np.arange(20_000) * 1e-3)
    assert resolution(np.round(smooth / 5e-4) * 5e-4) == pytest.approx(5e-4, rel=1e-6)
    assert resolution(np.array([2e-3, 0.0, 5e-4, 5e-4])) == 5e-4
    assert resolution(np.ones(5)) == 0.0
    assert white_noise(smooth + 0.02 * generator.standard_normal(20_000)) == pytest.approx(0.02, rel=0.05)


@pytest.mark.parametrize(
    ("change", "limit"),
    [
        ({}, "torque noise"),
        ({"torque_LSB_Nm": 0.2, "torque_noise_Nm": 0.0}, "torque LSB"),
        ({"velocity_LSB_rad_s": 0.02}, "velocity LSB"),
        ({"lag_error_s": 2e-3}, "lag"),
        ({"friction_error_Nm": 0.1}, "friction"),
    ],
)
def test_what_limits_a_threshold_is_named(change, limit):
    t_s = np.arange(20_000) * T
    values = {
        "torque_noise_Nm": 0.02, "torque_LSB_Nm": 1.5e-3, "velocity_LSB_rad_s": 5e-4, "mass_row_kg_m2": 0.4,
        "momentum_noise_Nms": 0.0, "lag_error_s": 0.0, "friction_error_Nm": 0.0,
    }  # fmt: skip
    sensing = Sensing(**(values | change))
    z = 0.02 * np.random.default_rng(9).standard_normal(20_000)
    tau_J = 5.0 * np.sin(6.0 * t_s)
    causes, achievable_Nm = find_limits(z, tau_J, np.zeros(20_000), sensing, (50.0, 200.0), T, 1.2e-3, 0.01)
    assert max(causes, key=causes.get) == limit
    assert achievable_Nm > 0.0


def test_fast_noise_is_the_velocitys_and_what_lasts_is_the_models():
    noise_Nms = 4e-4 * np.random.default_rng(9).standard_normal(20_001)
    z = np.diff(noise_Nms) / T
    sensing = Sensing(0.0, 0.0, 0.0, 0.4, 4e-4, 0.0, 0.0)

    def limits(stream):
        return find_limits(stream, np.zeros(20_000), np.zeros(20_000), sensing, (50.0,), T, 1.2e-3, 0.01)

    (fast, fast_Nm), (slow, slow_Nm) = limits(z), limits(z + 0.1)
    assert [max(causes, key=causes.get) for causes in (fast, slow)] == ["velocity noise", "model"]
    expected = peak_factor(0.01, 50.0) * low_pass(z, (50.0,), T).std()
    np.testing.assert_allclose([fast_Nm, slow_Nm], expected, rtol=0.05)
    np.testing.assert_allclose(slow["model"], peak_factor(0.01, 50.0) * 0.1, rtol=0.02)


def test_the_largest_ratio_of_an_hour_is_what_the_margin_says():
    generator = np.random.default_rng(11)
    watch = MarginWatch()
    blocks = generator.gumbel(0.2, 0.02, (3600 * 20, 2))
    for block in blocks[:3000]:
        watch.add_block(block)
    hourly = np.median(blocks.reshape(20, 3600, 2).max(axis=1), axis=0)
    np.testing.assert_allclose(1.0 / watch.margin, hourly, rtol=0.1)


@pytest.mark.parametrize("burst_s", [3.0, 6.0, 12.0])
def test_motion_in_bursts_has_the_tail_of_its_largest_values(burst_s):
    """Low levels merge a burst into one cluster, so there are few of them, too."""
    burst = np.arange(18_000) // round(burst_s / BLOCK_S) % 2 == 0
    peaks = np.abs(np.random.default_rng(3).normal(1.0, 0.1, burst.size)) * np.where(burst, 1.0, 0.05)
    assert np.mean(peaks > fit_tail(peaks).level) < 0.02
