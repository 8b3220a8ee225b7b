"""A candidate beside the model in use: when it takes over."""

import numpy as np
import pytest
from excited_arm import NAMES, kernel_of

from adacd_hil.scheme.detect import sensitivity
from adacd_hil.scheme.identify import anchor, refinement

K, _ = kernel_of()
COUNT = len(NAMES)
TRUE = np.concatenate([[0.4, 0.07, 0.04, 0.1, 0.05, 0.1, 0.08, 0.02, -0.01, 0.001, 0.001], np.zeros(COUNT - 11)])
CYCLES = 20


class Refined:
    """A memory in which a test of `candidate` ends after CYCLES samples of the true arm, while `frozen` is in use."""

    def __init__(self, candidate, frozen):
        _, self.m = kernel_of()
        self.m.models.theta[:] = frozen
        self.m.models.belief[:] = candidate
        self.m.models.P_belief[:] = 0.25 * np.eye(COUNT)
        self.m.sensitivity.h[:] = 0.5
        refinement.begin(self.m)
        self.m.candidate.cycles = K.refine_cycles - CYCLES
        self.random = np.random.default_rng(1)

    def sample(self, tau_ext=0.0):
        m = self.m
        m.filters.W_f[:] = 0.3 * self.random.standard_normal(m.filters.W_f.shape)
        m.filters.tau_f[:] = m.filters.W_f @ TRUE - tau_ext
        m.filters.r[:] = m.filters.W_f @ m.models.theta - m.filters.tau_f
        return refinement.test(K, m)

    def run(self):
        """Return whether it is against an anchor, by sample."""
        return [self.sample() for _ in range(CYCLES)]

    @property
    def has_taken_over(self):
        return self.m.models.promotions == 1.0


def off_by(share):
    return TRUE * (1.0 + share)


def test_a_candidate_that_explains_the_motion_better_takes_over_at_the_end_of_its_test():
    refined = Refined(off_by(0.05), off_by(0.2))
    for _ in range(CYCLES - 1):
        refined.sample()
    assert not refined.has_taken_over
    assert not refined.sample()
    for theta, P in (("theta", "P"), ("certified", "P_certified")):  # the latter a payload will be put on
        np.testing.assert_array_equal(refined.m.models[theta], off_by(0.05))
        np.testing.assert_array_equal(refined.m.models[P], 0.25 * np.eye(COUNT))
    assert refined.m.models.promotions == 1.0


@pytest.mark.parametrize("anchor_std", [np.inf, 0.001], ids=["no anchor", "an anchor that excludes it"])
def test_a_worse_candidate_leaves_the_model_as_it_is_and_is_not_said(anchor_std):
    refined = Refined(off_by(0.2), off_by(0.05))
    refined.m.anchor.anchor_Nm[anchor.TARE], refined.m.anchor.anchor_std[anchor.TARE] = 5.0, anchor_std
    assert not any(refined.run())
    np.testing.assert_array_equal(refined.m.models.theta, off_by(0.05))
    assert refined.m.models.promotions == 0.0


def test_a_candidate_that_no_arm_can_have_does_not_take_over():
    """Better in the residual, but its mass matrix is not positive definite."""
    impossible = TRUE.copy()
    impossible[2] = -1e-3
    refined = Refined(impossible, off_by(0.9))
    refined.m.sensitivity.h[:] = 100.0
    assert not any(refined.run())
    np.testing.assert_array_equal(refined.m.models.theta, off_by(0.9))


@pytest.mark.parametrize("channel", range(5))
def test_a_candidate_that_would_have_raised_an_alarm_does_not_take_over(channel):
    """By the bare filters' thresholds, and the slowest one's; the smoothed channels of fast filters have no say."""
    refined = Refined(off_by(0.05), off_by(0.2))
    refined.m.sensitivity.h[channel] = 1e-4
    assert not any(refined.run())
    assert refined.has_taken_over == (channel in (1, 2))


def test_a_joint_that_rests_has_no_say_in_which_model_is_better():
    """At rest friction may hold any torque: here the model in use happens to fit joint 1, and it does not count."""
    refined = Refined(off_by(0.05), off_by(0.2))
    refined.m.sensitivity.still[0, 0] = 1.1 * sensitivity.MOVING
    refined.sample()
    m = refined.m
    squares = [(m.filters.W_f[0, 1] @ (theta - TRUE)) ** 2 for theta in (off_by(0.05), off_by(0.2))]
    np.testing.assert_allclose([m.candidate.square, m.candidate.frozen_square], squares, rtol=1e-10)
    m.sensitivity.still[:] = 1.0
    refined.sample()
    np.testing.assert_allclose([m.candidate.square, m.candidate.frozen_square], squares, rtol=1e-10)


@pytest.mark.parametrize(("off_Nm", "is_excluded"), [(0.0, False), (0.1, True)])
def test_a_better_candidate_that_an_anchor_excludes_is_said_once_and_does_not_take_over(off_Nm, is_excluded):
    refined = Refined(off_by(0.05), off_by(0.2))
    refined.m.models.P_belief[:] = 1e-6 * np.eye(COUNT)
    refinement.begin(refined.m)
    refined.m.candidate.cycles = K.refine_cycles - CYCLES
    refined.m.anchor.anchor_Nm[anchor.TARE] = TRUE[[7, 8]] + [off_Nm, 0.0]
    refined.m.anchor.anchor_std[anchor.TARE] = 0.001
    assert refined.run() == [False] * (CYCLES - 1) + [is_excluded]
    assert refined.has_taken_over is not is_excluded
    assert not refined.sample()  # the next test has begun


def test_after_a_test_the_next_begins_with_the_belief_as_it_is_then():
    refined = Refined(off_by(0.2), off_by(0.05))
    refined.sample()
    refined.m.models.belief[:] = off_by(0.01)
    [refined.sample() for _ in range(CYCLES - 1)]
    np.testing.assert_array_equal(refined.m.candidate.theta, off_by(0.01))
    sums = ("cycles", "square", "frozen_square", "worst")
    assert [float(refined.m.candidate[name]) for name in sums] == [0.0] * 4
