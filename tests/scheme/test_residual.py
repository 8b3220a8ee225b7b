"""The residual of the compiled step: what it is when the model is right, across gaps, and against another observer."""

import numpy as np
import pytest
from planar_arm import THETA
from smooth_motion import PLACES, run_kernel, settings_with, smooth_motion, torque_of

from adacd_hil.scheme.kernel import paper_kernel
from adacd_hil.scheme.model.torque_filter import first_order_hold

T = 1e-3
LEFT_NM = 1e-5
"""What straight lines between samples leave: (T²/12) (|tau''| + a |p''|) = 1e-6 s²/12 (29 Nm/s² + 10/s · 9 Nm/s)."""
SMOOTH = THETA["M"] * [1, 1, 1, 1, 1, 0, 0]  # Coulomb friction jumps between two samples; see its own test


def tau_ext_hat_of(blocks):
    return blocks[:, PLACES["tau_ext_hat"]]


def filtered(samples, a=10.0):
    """Filter samples (n, 2) with the DC gain 1, from 0, straight lines between samples."""
    decay, weight_old, weight_new = first_order_hold(a, a, T)
    out = np.zeros_like(samples)
    for k in range(1, len(samples)):
        out[k] = decay * out[k - 1] + weight_old * samples[k - 1] + weight_new * samples[k]
    return out


@pytest.fixture(scope="module")
def motion():
    t_s = np.arange(6000) * T
    return (t_s, *smooth_motion(t_s))


@pytest.mark.parametrize("b_rad_s", [10.0, 1.0])
def test_with_the_true_model_the_external_torque_is_left_whatever_the_filters_gain(motion, b_rad_s):
    t_s, q, dq, ddq = motion
    tau_ext = np.column_stack((0.5 * np.sin(20.0 * t_s), np.where(t_s % 1.0 < 0.1, 2.0, 0.0)))
    settings = settings_with(filter={"a_rad_s": 10.0, "b_rad_s": b_rad_s})
    blocks = run_kernel(settings, q, dq, torque_of(q, dq, ddq, SMOOTH, tau_ext), SMOOTH, 0)
    np.testing.assert_allclose(tau_ext_hat_of(blocks), filtered(tau_ext), atol=LEFT_NM)


def test_the_residual_of_the_cad_model_shows_what_it_lacks(motion):
    _, q, dq, ddq = motion
    settings = settings_with()
    tau_J = torque_of(q, dq, ddq, SMOOTH)
    blocks = run_kernel(settings, q, dq, tau_J, SMOOTH, 0)
    lacking = torque_of(q, dq, ddq, settings.cad_theta) - tau_J
    np.testing.assert_allclose(blocks[:, PLACES["tau_ext_hat_cad"]], filtered(lacking), atol=LEFT_NM)


@pytest.mark.parametrize("gap", ["overrun", "lost frames"])
def test_across_gaps_the_true_model_still_leaves_nothing(motion, gap):
    """A stall of 5 ms every half second."""
    t_s, q, dq, ddq = motion
    tau_J = torque_of(q, dq, ddq, SMOOTH)
    is_lost = (np.arange(t_s.size) % 500 >= 495) & (t_s > 0.1)
    if gap == "overrun":
        kept = np.flatnonzero(~is_lost)
        periods = np.diff(kept, prepend=-1)
        blocks = run_kernel(settings_with(), q[kept], dq[kept], tau_J[kept], SMOOTH, 0, periods=periods)
    else:
        fresh = np.flatnonzero(~is_lost)
        periods = np.zeros(t_s.size, dtype=np.int64)
        periods[fresh] = np.diff(fresh, prepend=-1)
        is_complete = (~is_lost).astype(np.int64)
        blocks = run_kernel(settings_with(), q, dq, tau_J, SMOOTH, 0, is_complete=is_complete, periods=periods)
    assert np.max(np.abs(tau_ext_hat_of(blocks))) < LEFT_NM


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("signal", [0, 1, 2])
def test_one_bad_number_does_not_stay_in_the_filters(motion, signal, value):
    _, q, dq, ddq = motion
    record = [q[:2000].copy(), dq[:2000].copy(), torque_of(q, dq, ddq, SMOOTH)[:2000].copy()]
    record[signal][700, 1] = value
    blocks = run_kernel(settings_with(), *record, SMOOTH, paper_kernel.LEARN)
    assert np.max(np.abs(tau_ext_hat_of(blocks))) < LEFT_NM


@pytest.mark.parametrize("interval_s", [0.499e-3, 1.501e-3, -1e-3, np.nan])
def test_an_interval_far_from_the_nominal_one_is_a_gap(motion, interval_s):
    _, q, dq, ddq = motion
    tau_J = torque_of(q, dq, ddq, SMOOTH)
    period_s, periods = np.full(len(q), T), np.ones(len(q), dtype=np.int64)
    period_s[1000], periods[1000] = interval_s, 6
    odd = run_kernel(settings_with(), q, dq, tau_J, SMOOTH, paper_kernel.LEARN, period_s=period_s)
    gap = run_kernel(settings_with(), q, dq, tau_J, SMOOTH, paper_kernel.LEARN, periods=periods)
    assert tau_ext_hat_of(odd).tobytes() == tau_ext_hat_of(gap).tobytes()
    assert odd[:, PLACES["theta_hat"]].tobytes() == gap[:, PLACES["theta_hat"]].tobytes()


@pytest.mark.parametrize("interval_s", [0.501e-3, 1.499e-3])
def test_an_interval_near_the_nominal_one_is_integrated_over(interval_s):
    t_s = np.concatenate((np.arange(50) * T, 49 * T + interval_s + np.arange(500) * T))
    q, dq, ddq = smooth_motion(t_s)
    tau_ext = np.tile([1.0, 0.5], (len(t_s), 1))
    tau_J = torque_of(q, dq, ddq, SMOOTH, tau_ext)
    period_s = np.diff(t_s, prepend=-T)
    blocks = run_kernel(settings_with(), q, dq, tau_J, SMOOTH, 0, period_s=period_s)
    expected = -np.expm1(-10.0 * t_s)[:, None] * tau_ext
    np.testing.assert_allclose(tau_ext_hat_of(blocks), expected, atol=2.0 * LEFT_NM)


def test_another_interval_throughout_is_the_same_as_another_period():
    t_s = np.arange(3000) * 1.3e-3
    q, dq, ddq = smooth_motion(t_s)
    tau_J = torque_of(q, dq, ddq, SMOOTH)
    measured = run_kernel(
        settings_with(), q, dq, tau_J, np.zeros(7), paper_kernel.LEARN, period_s=np.full(3000, 1.3e-3)
    )
    slower = run_kernel(settings_with(bus={"period_us": 1300}), q, dq, tau_J, np.zeros(7), paper_kernel.LEARN)
    for name in ("tau_f", "tau_f_hat", "tau_ext_hat", "theta_hat", "excitation"):
        np.testing.assert_allclose(measured[:, PLACES[name]], slower[:, PLACES[name]], rtol=1e-12, atol=1e-15)
    assert slower[-1, PLACES["excitation"]] > 0.0
