"""Samples that are lost: put on a line, they widen the thresholds; many are said."""

import numpy as np
import pytest
from excited_arm import PERIOD_S, Kernel, kernel_of, record
from planar_arm import THETA

from adacd_hil.scheme.detect import lost_samples
from adacd_hil.scheme.kernel import certified_kernel
from adacd_hil.scheme.supervisor import findings

K, _ = kernel_of()
MODE = certified_kernel.WATCH | certified_kernel.REFINE


def followed(steps, dq=(0.3, 0.3), is_seen=True, lost_Nm2=0.0):
    """Return G (3, 2) after a sample that came so many periods after the last, which had 0.3 rad/s."""
    _, m = kernel_of()
    m.gaps.last[1] = 0.3
    m.sensitivity.hold[:] = 0.1
    m.regressor.M[:] = np.eye(2)
    m.lost.lost_Nm2[:] = lost_Nm2
    lost_samples.follow_lost(K, m, np.array(dq), steps, steps * PERIOD_S, is_seen)
    return m.lost.lost_Nm2.copy()


def test_a_sample_after_a_sample_leaves_nothing_open_and_what_was_open_is_forgotten():
    assert not followed(1).any()
    expected = np.exp(-2.0 * K.cutoff * PERIOD_S)[:, None] * np.ones(2)
    np.testing.assert_allclose(followed(1, lost_Nm2=1.0), expected, rtol=1e-12)


@pytest.mark.parametrize("steps", [2, 5, 9])
def test_a_line_leaves_open_the_noise_of_its_ends_the_torque_s_bend_and_friction_where_the_joint_turned(steps):
    turn = K.cutoff * steps * PERIOD_S
    noise = (K.noise_sigmas * K.torque_noise_Nm * turn) ** 2 * 0.5 * (1.0 - 1.0 / steps)
    bend = lost_samples.CURVATURE_NM_S2 * (steps * PERIOD_S) ** 2 / 12.0
    expected = np.array([noise + (turn * bend) ** 2, noise + (turn * (bend + 0.1)) ** 2]).T
    np.testing.assert_allclose(followed(steps, dq=(0.3, -0.3)), expected, rtol=1e-12)


def test_a_gap_that_is_cut_out_leaves_the_velocity_s_noise():
    expected = (2.0 * K.cutoff * K.noise.velocity_noise_rad_s) ** 2
    np.testing.assert_allclose(followed(20, is_seen=False), np.tile(expected[:, None], (1, 2)), rtol=1e-12)


class LossyArm(Kernel):
    """The arm as certified, on the excitation, of whose samples some are lost."""

    def __init__(self, lost, seconds=6.0):
        super().__init__()
        self.found, self.h, self.dq, self.still, self.roughness = [], [], [], [], []
        since, mode = 1, certified_kernel.WATCH | certified_kernel.LEARN
        for k, sample in enumerate(zip(*record(THETA["P"], seconds, seed=5), strict=True)):
            is_lost = lost(k) and mode == MODE
            found = self.step(*sample, mode, 0 if is_lost else 1, since, since * PERIOD_S)
            since = since + 1 if is_lost else 1
            if found & findings.FITTED:
                certified_kernel.begin_test(self.constants, self.memory)
                mode = certified_kernel.WATCH | certified_kernel.TEST
            elif found & findings.CERTIFIED:
                certified_kernel.begin_refinement(self.constants, self.memory)
                mode = MODE
            elif mode == MODE:
                self.found.append(found)
                self.h.append(self.m.sensitivity.h.copy())
                self.dq.append(sample[1])
                self.still.append(self.m.sensitivity.still.copy())
                self.roughness.append(self.m.sensitivity.velocity_roughness.copy())


@pytest.mark.parametrize("burst", [1, 4, 8])
def test_bursts_that_are_put_on_a_line_raise_no_alarm(burst):
    whole, lossy = LossyArm(lambda _k: False), LossyArm(lambda k: k % 40 < burst)
    assert not np.bitwise_or.reduce(lossy.found) & findings.CONTACT
    assert len(lossy.found) == len(whole.found)
    assert np.max(np.array(lossy.h) / np.array(whole.h)) > 1.0
    assert np.sum([found & findings.UNSEEN != 0 for found in lossy.found]) == pytest.approx(
        burst / 40 * len(lossy.found), rel=0.05
    )


def test_an_arm_whose_every_second_sample_is_lost_is_not_taken_for_one_that_stands_still():
    """No sample follows on the one before it then; each is compared with the last there was all the same."""
    whole, lossy = LossyArm(lambda _k: False), LossyArm(lambda k: k % 2 == 1)
    assert not np.bitwise_or.reduce(lossy.found) & findings.CONTACT
    np.testing.assert_allclose(np.array(lossy.still)[:, :2], np.array(whole.still)[:, :2], atol=0.25)
    moving = np.abs(np.array(whole.dq)) > 0.3
    assert moving.any(axis=0).all()
    assert np.array(lossy.still)[:, 2][moving].max() < 0.05
    assert np.median(np.array(lossy.h)[:, 0] / np.array(whole.h)[:, 0]) < 1.5
    assert np.max(lossy.roughness) < 4.0
