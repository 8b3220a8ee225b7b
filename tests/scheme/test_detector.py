"""When a collision is detected: the delay law, the smallest impulse, the sign."""

import numpy as np
import pytest
from smooth_motion import PLACES, PaperKernel, run_kernel, settings_with

from adacd_hil.scheme.detect.external_torque import follow_standstill, joints_over
from adacd_hil.scheme.kernel import paper_kernel

T = 1e-3
BEGIN = 100


def alarms(tau_ext):
    """Let the arm stand still under tau_ext (n, 2); return the joints that are over per sample as (n, 2)."""
    still = np.zeros_like(tau_ext)
    blocks = run_kernel(settings_with(), still, still, -tau_ext, np.zeros(7), paper_kernel.ARMED)
    return np.abs(blocks[:, PLACES["tau_ext_hat"]]) > blocks[:, PLACES["threshold"]]


def step_at(joint, size, samples=3000):
    tau_ext = np.zeros((samples, 2))
    tau_ext[BEGIN:, joint] = size
    return tau_ext


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("size_Nm", "delay_ms"),
    [(0.2, 138.6), (0.3, 69.3), (0.5, 35.7), (1.0, 16.3), (2.0, 7.8), (5.0, 3.0)],
)
def test_a_torque_step_is_detected_by_the_delay_law(size_Nm, delay_ms, sign, joint):
    over = alarms(step_at(joint, sign * size_Nm))
    assert abs(np.argmax(over[:, joint]) - BEGIN - delay_ms) <= 1.0
    assert not np.any(over[:, 1 - joint])


@pytest.mark.parametrize(
    ("tau_ext_hat", "threshold", "joints"),
    [
        ((0.0, 0.0), (0.15, 0.15), 0b00),
        ((0.2, 0.0), (0.15, 0.15), 0b01),
        ((0.0, -0.2), (0.15, 0.15), 0b10),
        ((-0.2, 0.2), (0.15, 0.15), 0b11),
        ((0.15, -0.15), (0.15, 0.15), 0b00),
        ((np.nextafter(0.15, 1.0), 0.0), (0.15, 0.15), 0b01),
        ((np.nan, 0.0), (0.15, 0.15), 0b01),
        ((0.0, np.nan), (0.15, 0.15), 0b10),
        ((np.inf, -np.inf), (0.15, 0.15), 0b11),
        ((0.3, 0.3), (0.4, 0.1), 0b10),
        ((0.3, 0.3), (0.1, 0.4), 0b01),
    ],
)
def test_the_joints_over_their_threshold_are_named(tau_ext_hat, threshold, joints):
    assert joints_over(np.array(tau_ext_hat), np.array(threshold)) == joints


def test_thresholds_go_out_of_force_when_the_scheme_disarms():
    kernel = PaperKernel(settings_with())
    kernel.step(paper_kernel.ARMED)
    assert kernel.out.threshold.tolist() == [0.15, 0.15]
    kernel.step(0)
    assert np.all(np.isposinf(kernel.out.threshold))


def thresholds(dq, F_c, samples=1000):
    """Return the thresholds in force (n, 2) at constant velocity, with a model of this Coulomb friction."""
    dq = np.tile(np.asarray(dq, float), (samples, 1))
    theta = np.zeros(7)
    theta[5:] = F_c
    blocks = run_kernel(settings_with(), np.zeros_like(dq), dq, np.zeros_like(dq), theta, paper_kernel.ARMED)
    return blocks[:, PLACES["threshold"]]


def test_a_joint_that_stands_still_may_hold_its_coulomb_friction():
    np.testing.assert_allclose(thresholds([0.0, 0.0], [0.15, 0.08])[-1], [0.30, 0.23], rtol=1e-4)


def test_a_joint_that_moves_has_the_threshold_of_the_settings():
    np.testing.assert_array_equal(thresholds([0.02, -0.02], [0.15, 0.08]), 0.15)


def test_the_standstill_is_forgotten_as_the_filter_forgets():
    standstill = np.ones(2)
    follow_standstill(np.array([1.0, 0.0]), 0.01, np.exp(-10.0 * T), standstill)
    np.testing.assert_allclose(standstill, [np.exp(-10.0 * T), 1.0], rtol=1e-12)


def test_a_model_with_negative_friction_lowers_no_threshold():
    np.testing.assert_array_equal(thresholds([0.0, 0.0], [-0.1, -0.1]), 0.15)
