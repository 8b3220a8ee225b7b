"""The bank of filters against scipy and against one filter alone."""

import numpy as np
import pytest
import scipy.signal
from excited_arm import NAMES, SETTINGS, kernel_of

from adacd_hil.scheme.model import filter_bank

T = 1e-3
CUTOFF = np.array(SETTINGS.certified.cutoffs_rad_s)
COLUMNS = len(NAMES)


class Bank:
    """The kernel's filters, at rest."""

    def __init__(self):
        self.k, self.m = kernel_of()
        filter_bank.choose_rates(self.k, self.m, T)
        self.tau_f, self.W_f = self.m.filters.tau_f, self.m.filters.W_f

    def take(self, Y_p, Y_h, tau_J, is_seen):
        self.m.regressor.Y_p, self.m.regressor.Y_h = Y_p, Y_h
        filter_bank.take_sample(self.k, self.m, tau_J, is_seen)

    def run(self, Y_p, Y_h, tau_J):
        """Go over samples (n, ...), the first of them after a gap; return tau_f (n, C, 2) and W_f (n, C, 2, p)."""
        history = []
        for k in range(len(tau_J)):
            self.take(Y_p[k], Y_h[k], tau_J[k], is_seen=k > 0)
            history.append((self.tau_f.copy(), self.W_f.copy()))
        return tuple(np.array(values) for values in zip(*history, strict=True))


def signals(count=200, seed=1):
    random = np.random.default_rng(seed)
    return [np.cumsum(random.standard_normal((count, *shape)), 0) for shape in ((2, COLUMNS), (2, COLUMNS), (2,))]


def held_by_scipy(cutoff, samples):
    """Filter straight lines between samples (n, ...) by cutoff / (s + cutoff), from zero."""
    numerator, denominator, _ = scipy.signal.cont2discrete(([cutoff], [1.0, cutoff]), T, method="foh")
    # From zero: not even the first sample's own weight.
    start = -numerator.ravel()[0] * samples[:1]
    return scipy.signal.lfilter(numerator.ravel(), denominator, samples, axis=0, zi=start)[0]


@pytest.mark.parametrize("c", range(3))
def test_each_filter_is_the_one_that_scipy_has_and_differentiates_the_momentum(c):
    """W_f = F (s Y_p + Y_h): a derivative of straight lines is constant in between."""
    Y_p, Y_h, tau_J = signals()
    tau_f, W_f = Bank().run(Y_p, Y_h, tau_J)
    np.testing.assert_allclose(tau_f[:, c], held_by_scipy(CUTOFF[c], tau_J), rtol=1e-9, atol=1e-10)
    decay = np.exp(-CUTOFF[c] * T)
    rate = np.concatenate([np.zeros((1, 2, COLUMNS)), np.diff(Y_p, axis=0) / T])
    derivative = scipy.signal.lfilter([1.0 - decay], [1.0, -decay], rate, axis=0)
    np.testing.assert_allclose(W_f[:, c], derivative + held_by_scipy(CUTOFF[c], Y_h), rtol=1e-8, atol=1e-8)


def test_the_lag_column_is_the_filtered_derivative_of_its_joint_s_torque():
    _, _, tau_J = signals()
    tau_J -= tau_J[0]
    filtered, got = Bank(), []
    none = np.zeros((2, COLUMNS))
    for k, torque in enumerate(tau_J):
        filtered.take(none, none, torque, is_seen=k > 0)
        W_f = np.zeros((3, 2, COLUMNS))
        filter_bank.fill_lag(CUTOFF, torque, filtered.tau_f, 3, W_f)
        got.append(W_f)
    rate = np.concatenate([np.zeros((1, 2)), np.diff(tau_J, axis=0) / T])
    for c, a in enumerate(CUTOFF):
        decay = np.exp(-a * T)
        expected = scipy.signal.lfilter([1.0 - decay], [1.0, -decay], rate, axis=0)
        columns = np.array(got)[:, c]
        for joint in range(2):
            np.testing.assert_allclose(columns[:, joint, 3 + joint], expected[:, joint], rtol=1e-9, atol=1e-9)
            assert np.count_nonzero(np.delete(columns[:, joint], 3 + joint, axis=1)) == 0


def test_the_cross_talk_column_is_the_other_joint_s_filtered_torque():
    tau_f, W_f = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]), np.zeros((3, 2, COLUMNS))
    filter_bank.fill_cross_talk(tau_f, 1, W_f)
    np.testing.assert_array_equal(W_f[:, 0, 1], tau_f[:, 1])
    np.testing.assert_array_equal(W_f[:, 1, 2], tau_f[:, 0])
    assert np.count_nonzero(W_f) == 6


def test_smoothed_channels_come_first_and_all_but_the_slowest_are_there_bare_too():
    r = np.random.default_rng(3).standard_normal((100, 3, 2))
    y, got, smoothing = np.zeros((5, 2)), [], np.exp(-0.2)
    for row in r:
        filter_bank.smooth(smoothing, row, y)
        got.append(y.copy())
    smoothed = scipy.signal.lfilter([1.0 - smoothing], [1.0, -smoothing], r, axis=0)
    np.testing.assert_allclose(np.array(got)[:, :3], smoothed, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(np.array(got)[:, 3:], r[:, 1:])


def test_a_gap_leaves_every_residual_where_it_was_whatever_the_parameters():
    Y_p, Y_h, tau_J = signals()
    filtered = Bank()
    filtered.run(Y_p, Y_h, tau_J)
    before = filtered.tau_f.copy(), filtered.W_f.copy()
    filtered.take(Y_p[0] + 7.0, Y_h[0] - 5.0, tau_J[0] + 3.0, is_seen=False)
    np.testing.assert_array_equal(filtered.tau_f, before[0])
    np.testing.assert_array_equal(filtered.W_f, before[1])
