"""The torque filter against its closed forms."""

import numpy as np
import pytest
import scipy.signal

from adacd_hil.scheme.model.filter_bank import advance_regressor, advance_torque, first_order_hold, resume

T = 1e-3


def filter_torque(hold, samples):
    tau_old, tau_f = samples[0].copy(), np.zeros(2)
    filtered = [tau_f.copy()]
    for sample in samples[1:]:
        advance_torque(hold, tau_old, sample.copy(), tau_f)
        filtered.append(tau_f.copy())
    return np.array(filtered)


@pytest.mark.parametrize(("a", "b"), [(10.0, 10.0), (100.0, 100.0), (10.0, 1.0), (1000.0, 1000.0)])
def test_a_torque_that_rises_linearly_is_filtered_exactly(a, b):
    t_s = np.arange(500) * T
    slope, start = np.array([3.0, -7.0]), np.array([0.4, 0.2])
    samples = start + np.outer(t_s, slope)
    decay = np.exp(-a * t_s)[:, None]
    exact = b / a * (start * (1.0 - decay) + slope * (t_s[:, None] - (1.0 - decay) / a))
    np.testing.assert_allclose(filter_torque(first_order_hold(a, b, T), samples), exact, rtol=1e-11, atol=1e-13)


def test_a_constant_torque_comes_out_with_the_dc_gain():
    filtered = filter_torque(first_order_hold(10.0, 4.0, T), np.full((5000, 2), 2.0))
    np.testing.assert_allclose(filtered[-1], 0.8, rtol=1e-12)


def test_a_random_torque_agrees_with_scipy():
    samples = np.random.default_rng(1).standard_normal((300, 2))
    _, expected, _ = scipy.signal.lsim(([10.0], [1.0, 10.0]), samples[:, 0], np.arange(300) * T)
    np.testing.assert_allclose(
        filter_torque(first_order_hold(10.0, 10.0, T), samples)[:, 0], expected, rtol=1e-9, atol=1e-12
    )


class RegressorFilter:
    """One W_f with a single column that matters: momentum y_p(t), remainder y_h(t)."""

    def __init__(self, a, b):
        self.a, self.b = a, b
        self.hold = first_order_hold(a, b, T)
        self.input_old, self.S, self.W_f, self.tau_old = np.zeros((2, 1)), np.zeros((2, 1)), np.zeros((2, 1)), None

    def resume(self, y_p, y_h):
        self.tau_old = np.zeros(2)
        resume(
            self.a,
            self.b,
            np.full((2, 1), y_p),
            np.full((2, 1), y_h),
            np.zeros(2),
            self.input_old,
            self.tau_old,
            self.S,
            self.W_f,
        )

    def advance(self, y_p, y_h):
        advance_regressor(
            self.hold,
            self.a,
            self.b,
            np.full((2, 1), y_p),
            np.full((2, 1), y_h),
            self.input_old,
            self.S,
            self.W_f,
        )
        return self.W_f[0, 0]


def test_a_momentum_that_rises_linearly_gives_the_filtered_constant_torque():
    """Y_p = 5 + 3 t has the torque 3 behind it; the start at full momentum leaves no trace."""
    column = RegressorFilter(10.0, 10.0)
    column.resume(5.0, 0.0)
    t_s = np.arange(1, 400) * T
    filtered = [column.advance(5.0 + 3.0 * t, 0.0) for t in t_s]
    np.testing.assert_allclose(filtered, 3.0 * (1.0 - np.exp(-10.0 * t_s)), rtol=1e-9, atol=1e-12)


def test_momentum_and_remainder_add_up():
    column = RegressorFilter(10.0, 20.0)
    column.resume(5.0, 0.7)
    t_s = np.arange(1, 400) * T
    filtered = [column.advance(5.0 + 3.0 * t, 0.7) for t in t_s]
    np.testing.assert_allclose(filtered, 2.0 * 3.7 * (1.0 - np.exp(-10.0 * t_s)), rtol=1e-9, atol=1e-12)


def test_a_gap_does_not_move_the_filtered_regressor():
    column = RegressorFilter(10.0, 10.0)
    column.resume(0.0, 0.0)
    before = [column.advance(3.0 * k * T, 0.0) for k in range(1, 100)][-1]
    column.resume(8.0, 2.0)
    assert column.W_f[0, 0] == before


def test_a_gap_is_cut_out_of_time():
    """After it, the filtered torque goes on as if no time had passed, whatever the momentum did meanwhile."""
    with_gap, without_gap = RegressorFilter(10.0, 10.0), RegressorFilter(10.0, 10.0)
    with_gap.resume(0.0, 0.0)
    without_gap.resume(0.0, 0.0)
    for k in range(1, 100):
        with_gap.advance(3.0 * k * T, 0.0)
        without_gap.advance(3.0 * k * T, 0.0)
    with_gap.resume(80.0, 0.0)
    after = [with_gap.advance(80.0 + 3.0 * k * T, 0.0) for k in range(1, 200)]
    expected = [without_gap.advance(3.0 * (99 + k) * T, 0.0) for k in range(1, 200)]
    np.testing.assert_allclose(after, expected, rtol=1e-10)
