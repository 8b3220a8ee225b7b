"""The compiled step of the certified scheme, on motions in closed form and on an arm that follows the excitation."""

from dataclasses import replace

import numpy as np
import pytest
from excited_arm import NAMES, OFFSETS, PERIOD_S, SETTINGS, Kernel, play, record
from planar_arm import THETA
from smooth_motion import smooth_motion, torque_of

from adacd_hil.scheme.detect import lost_samples
from adacd_hil.scheme.kernel import certified_kernel, certified_memory
from adacd_hil.scheme.supervisor import findings

COUNT = len(NAMES)
LAGS = [NAMES.index("lag1"), NAMES.index("lag2")]
SMOOTH = THETA["M"] * [1, 1, 1, 1, 1, 0, 0]  # Coulomb friction of a reversal is no straight line between samples
RECOVER = round(SETTINGS.certified.recover_s / PERIOD_S)
TESTED = round(SETTINGS.certified.test_s[0] / PERIOD_S)


@pytest.fixture(scope="module")
def smooth():
    """A motion in closed form without noise, and its torque."""
    q, dq, ddq = smooth_motion(np.arange(600) * PERIOD_S)
    return q, dq, torque_of(q, dq, ddq, SMOOTH)


def test_a_push_toward_positive_q_is_seen_in_each_filter_as_large_as_it_is(smooth):
    """An arm that moves like this while 0.5 Nm push needs 0.5 Nm less of its joint."""
    q, dq, tau_J = smooth
    tau_ext = np.array([0.5, -0.3])
    _, residual = Kernel(theta=SMOOTH).run(q, dq, tau_J - tau_ext)
    cutoffs = np.array(SETTINGS.certified.cutoffs_rad_s)
    shown = 1.0 - np.exp(-cutoffs * (len(q) - 1) * PERIOD_S)
    np.testing.assert_allclose(residual[-1], np.outer(shown, tau_ext), atol=2e-3)


@pytest.mark.parametrize("lag_s", [0.0, 0.002])
def test_the_weight_of_a_payload_at_rest_is_no_contact_as_the_arm_begins_to_learn_it(lag_s):
    arm = replace(SETTINGS.arm, cad_theta=(), mounting_deg=(90.0, -90.0))
    settings = replace(SETTINGS, arm=arm, estimator=replace(SETTINGS.estimator, gravity=True, P0=(1.0,) * 9))
    kernel = Kernel(settings)
    m, names = kernel.m, certified_memory.parameter_names(settings)
    m.models.certified[:9] = *THETA["P"], 8.0, 1.5
    m.models.certified[[names.index("lag1"), names.index("lag2")]] = lag_s
    m.models.P_certified[:] = np.diag(kernel.constants[0].enough_std ** 2) * 0.01
    m.models.theta[:], m.models.P[:] = m.models.certified, m.models.P_certified
    l1, l2 = arm.link_length_m
    weight = 9.80665 * np.array([l1 + l2, l2])
    rest = np.zeros(2), np.zeros(2), np.array([9.5, 1.5]) + weight
    for _ in range(600):
        seen = kernel.step(*rest, mode=certified_kernel.WATCH)
    assert seen & findings.CONTACT
    certified_kernel.begin_adaptation(kernel.constants, kernel.memory, True, True)
    learning = certified_kernel.WATCH | certified_kernel.LEARN
    assert not any(kernel.step(*rest, mode=learning) & findings.CONTACT for _ in range(300))


def test_a_gap_is_cut_out_of_time_and_so_are_samples_that_were_lost(smooth):
    q, dq, tau_J = smooth
    kernel = Kernel(theta=SMOOTH)
    _, residual = kernel.run(q[:300], dq[:300], tau_J[:300])
    before = residual[-1]
    kernel.step(q[299] + 9.0, dq[299], tau_J[299] + 9.0, is_complete=0)
    np.testing.assert_array_equal(kernel.m.filters.r, before)
    kernel.step(q[309], dq[309], tau_J[309], periods=lost_samples.MOST_FILLED + 2)
    np.testing.assert_allclose(kernel.m.filters.r, before, atol=1e-12)
    kernel.step(q[450], dq[450], tau_J[450], periods=150)
    np.testing.assert_allclose(kernel.m.filters.r, before, atol=1e-12)
    _, after = kernel.run(q[451:], dq[451:], tau_J[451:])
    assert np.max(np.abs(after)) < 2e-4


@pytest.mark.parametrize("lost", [1, 2, 3])
def test_a_few_lost_samples_lie_between_their_neighbours(smooth, lost):
    """A push that begins in them is felt with the first sample after them."""
    q, dq, tau_J = smooth
    pushed, whole = Kernel(theta=SMOOTH), Kernel(theta=SMOOTH)
    for kernel in (pushed, whole):
        kernel.run(q[:300], dq[:300], tau_J[:300])
    assert pushed.step(q[300], dq[300], tau_J[300], is_complete=0) & findings.UNSEEN
    after = slice(300, 301 + lost)
    expected = whole.run(q[after], dq[after], tau_J[after] - 1.0)[1][-1]
    seen = pushed.step(q[300 + lost], dq[300 + lost], tau_J[300 + lost] - 1.0, periods=lost + 1)
    assert not seen & findings.UNSEEN
    assert np.all(np.abs(pushed.m.filters.r) > 0.4 * np.abs(expected))
    unpushed = Kernel(theta=SMOOTH)
    unpushed.run(q[:300], dq[:300], tau_J[:300])
    unpushed.step(q[300 + lost], dq[300 + lost], tau_J[300 + lost], periods=lost + 1)
    assert np.max(np.abs(unpushed.m.filters.r)) < 1e-3


def test_an_incomplete_cycle_and_the_sample_after_a_gap_are_said_to_be_unseen(smooth):
    q, dq, tau_J = smooth
    kernel = Kernel(theta=SMOOTH)
    found = [kernel.step(q[k], dq[k], tau_J[k]) & findings.UNSEEN for k in range(3)]
    found.append(kernel.step(q[3], dq[3], tau_J[3], is_complete=0) & findings.UNSEEN)
    found.append(kernel.step(q[12], dq[12], tau_J[12], periods=10) & findings.UNSEEN)
    found.append(kernel.step(q[13], dq[13], tau_J[13]) & findings.UNSEEN)
    assert [bool(bits) for bits in found] == [True, False, False, True, True, False]


def test_a_sample_that_is_no_number_is_told_and_filtered_by_nobody(smooth):
    q, dq, tau_J = smooth
    kernel = Kernel(theta=SMOOTH)
    kernel.run(q[:50], dq[:50], tau_J[:50])
    before = kernel.m.filters.r.copy()
    for place in range(3):
        values = [q[50].copy(), dq[50].copy(), tau_J[50].copy()]
        values[place][1] = np.nan
        assert kernel.step(*values) & findings.NOT_A_NUMBER
        np.testing.assert_array_equal(kernel.m.filters.r, before)


def test_the_measured_period_counts():
    """SYNCs up to 0.3 ms late: with the nominal period in place of theirs the residual is ten times as large."""
    late_s = np.random.default_rng(5).uniform(0.0, 3e-4, 600)
    t_s = np.arange(600) * PERIOD_S + late_s
    q, dq, ddq = smooth_motion(t_s)
    tau_J = torque_of(q, dq, ddq, SMOOTH)
    largest = []
    for period_s in (np.diff(t_s, prepend=t_s[0] - PERIOD_S), None):
        _, residual = Kernel(theta=SMOOTH).run(q, dq, tau_J, period_s=period_s)
        largest.append(np.max(np.abs(residual[:, 1])))
    assert largest[0] < 5e-4
    assert largest[1] > 10.0 * largest[0]


LEARNT_S = 3.0


def learnt(delay_s=0.0, offset=(0.0, 0.0)):
    """Return theta after LEARN on a smooth motion whose q and dq are older than tau_J."""
    t_s = np.arange(round(LEARNT_S / PERIOD_S)) * PERIOD_S
    tau_J = torque_of(*smooth_motion(t_s, 2.0), SMOOTH) + np.array(offset)
    q, dq, _ = smooth_motion(t_s - delay_s, 2.0)
    open_minded = replace(SETTINGS.certified, prior_std=(1.0, 0.5, 0.5, 10.0, 0.3, 0.01, 0.2))
    kernel = Kernel(replace(SETTINGS, certified=open_minded))
    kernel.run(q, dq, tau_J, certified_kernel.LEARN)
    return kernel.m.models.theta.copy()


def test_the_lag_of_the_velocity_and_the_offsets_of_the_torque_sensors_are_identified():
    theta = learnt(delay_s=3e-3, offset=(0.15, -0.1))
    np.testing.assert_allclose(theta[LAGS], 3e-3, atol=2e-4)
    np.testing.assert_allclose(theta[OFFSETS], [0.15, -0.1], atol=0.005)
    np.testing.assert_allclose(theta[:3], SMOOTH[:3], rtol=0.01)


def test_a_velocity_that_is_noisy_takes_no_inertia_away():
    """Noise of 5 mrad/s, as of a coarse encoder: least squares on the unsmoothed filter find 2 to 3 % less."""
    measured = record(THETA["P"], 20.0)
    noise = 0.005 * np.random.default_rng(5).standard_normal(measured.dq.shape)
    found = play(measured._replace(dq=measured.dq + noise)).numbers.memory[0].models.belief
    np.testing.assert_allclose(found[:3], THETA["P"][:3], rtol=0.005)


def certain(tau_J, mode=certified_kernel.WATCH, count=60):
    """Return the observations of an arm at rest whose model is certain, and its kernel."""
    kernel = Kernel(theta=SMOOTH, P=np.zeros((COUNT, COUNT)))
    rest = np.zeros((count, 2))
    found, _ = kernel.run(rest, rest, np.tile(tau_J, (count, 1)), mode)
    return found, kernel


def test_contact_and_collision_are_two_levels():
    for torque_Nm, is_collision in ((-0.5, False), (-4.0, True)):
        found, _ = certain([torque_Nm, 0.0])
        assert found[-1] & findings.CONTACT
        assert bool(found[-1] & findings.COLLISION) is is_collision
    assert not certain([-0.01, 0.0])[0][-1] & findings.CONTACT


def test_a_lost_sample_keeps_the_contact_that_was_there():
    _, kernel = certain([-1.0, 0.0])
    found = kernel.step([0.0, 0.0], [0.0, 0.0], [0.0, 0.0], certified_kernel.WATCH, is_complete=0)
    assert found & findings.CONTACT


def test_a_frozen_model_that_fails_its_test_is_refuted():
    kernel = Kernel(theta=SMOOTH)
    certified_kernel.begin_test(kernel.constants, kernel.memory)
    rest = np.zeros((400, 2))
    beta = SETTINGS.certified.beta_Nm
    found, residual = kernel.run(rest, rest, np.tile([0.0, -2.0 * beta], (400, 1)), certified_kernel.TEST)
    refuted = (found & findings.REFUTED) != 0
    np.testing.assert_array_equal(refuted, np.abs(residual[:, 0, 1]) > beta)
    assert refuted.any()
    assert not np.any(found[refuted] & findings.CERTIFIED)


def test_a_contact_pauses_the_test_of_a_candidate_until_the_arm_has_recovered():
    kernel = Kernel(theta=SMOOTH, P=np.zeros((COUNT, COUNT)))
    certified_kernel.begin_refinement(kernel.constants, kernel.memory)
    rest, mode = np.zeros(2), certified_kernel.WATCH | certified_kernel.REFINE
    for _ in range(100):
        kernel.step(rest, rest, rest, mode)
    before = 100.0
    while not kernel.step(rest, rest, [-2.0, 0.0], mode) & findings.CONTACT:
        before += 1.0
    sums = ("cycles", "square", "frozen_square", "worst")
    paused = [float(kernel.m.candidate[name]) for name in sums]
    assert paused[0] == before
    assert kernel.m.ring.used == 0.0
    assert kernel.m.models.recovering_cycles == RECOVER
    while kernel.step(rest, rest, rest, mode) & findings.CONTACT:
        pass
    for _ in range(RECOVER - 2):
        kernel.step(rest, rest, rest, mode)
    assert [float(kernel.m.candidate[name]) for name in sums] == paused
    kernel.step(rest, rest, rest, mode)
    assert kernel.m.candidate.cycles == before + 1.0


@pytest.mark.parametrize(("mode", "strain"), [("LEARN", 4.0), ("TEST", 4.0), ("REFINE", 1.0)])
def test_each_contact_before_the_certificate_strains_the_thresholds_once(mode, strain):
    """Twice over the threshold, with a recovery between."""
    kernel = Kernel(P=np.zeros((COUNT, COUNT)))
    kernel.m.models.P_belief[:] = 0.0
    rest, mode = np.zeros(2), certified_kernel.WATCH | getattr(certified_kernel, mode)
    for _ in range(2):
        for torque_Nm, count in ((-5.0, 30), (0.0, 600 + RECOVER)):
            found = [kernel.step(rest, rest, [torque_Nm, 0.0], mode) for _ in range(count)]
            assert bool(found[-1] & findings.CONTACT) is (torque_Nm != 0.0)
    assert kernel.m.sensitivity.strain.tolist() == [strain, 1.0]


@pytest.mark.parametrize("speeds", [(0.0, 0.0), (0.5, 0.0), (0.0, -0.5)])
def test_a_test_in_which_a_joint_rests_proves_nothing(speeds):
    """A model of nothing, of an arm of nothing: no residual, so only the motion is missing."""
    kernel = Kernel(theta=np.zeros(COUNT))
    certified_kernel.begin_test(kernel.constants, kernel.memory)
    kernel.m.models.theta[:] = 0.0
    found = [kernel.step([0.0, 0.0], speeds, [0.0, 0.0], certified_kernel.TEST) for _ in range(2 * TESTED)]
    assert not np.any(np.array(found) & (findings.CERTIFIED | findings.REFUTED))
    assert kernel.step([0.0, 0.0], [0.5, -0.5], [0.0, 0.0], certified_kernel.TEST) & findings.CERTIFIED


def test_an_arm_that_rests_teaches_no_offset_where_friction_holds():
    """A certified arm for 2 s with 0.1 Nm that its friction may hold; of one that creeps it were an offset."""
    learnt = []
    for speed, still in ((0.0, 1.0), (0.01, 0.0)):
        kernel = Kernel(theta=np.zeros(COUNT))
        m = kernel.m
        std = np.where(np.char.startswith(NAMES, "offset"), 0.0115, 1e-4)
        m.models.belief[:] = 0.0
        m.models.P_belief[:] = m.models.P[:] = np.diag(std**2)
        certified_kernel.begin_refinement(kernel.constants, kernel.memory)
        m.sensitivity.still[:] = m.sensitivity.still_smooth[:] = still
        m.sensitivity.h[:] = 1.0
        for _ in range(2000):
            kernel.step([0.0, 0.0], [speed, speed], [0.1, -0.1], certified_kernel.REFINE)
        learnt.append(m.models.belief[OFFSETS].copy())
    np.testing.assert_array_equal(learnt[0], [0.0, 0.0])
    np.testing.assert_allclose(learnt[1], [0.1, -0.1], atol=0.035)
