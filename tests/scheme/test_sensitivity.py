"""The thresholds against their formula, computed by other means, and against noise that is filtered here."""

import numpy as np
import pytest
from excited_arm import NAMES, SETTINGS, kernel_of

from adacd_hil.scheme.detect import sensitivity

CERTIFIED = SETTINGS.certified
T = SETTINGS.bus.period_s
CUTOFFS = np.array(CERTIFIED.cutoffs_rad_s)
CHANNELS = [(a, True) for a in CUTOFFS] + [(a, False) for a in CUTOFFS[1:]]
COULOMB = NAMES.index("F_c1")
STRIBECK = NAMES.index("stribeck1")
K, _ = kernel_of()


def known_arm(seed=1):
    """Return the memory of an arm of which something is known, in some motion."""
    random = np.random.default_rng(seed)
    _, m = kernel_of()
    m.models.theta[:] = random.uniform(0.05, 0.5, len(NAMES))
    root = 0.02 * random.standard_normal((len(NAMES), len(NAMES)))
    m.models.P[:] = root @ root.T
    m.filters.W_f[:] = random.standard_normal(m.filters.W_f.shape)
    m.regressor.M[:] = [[0.4, 0.1], [0.1, 0.05]]
    m.sensitivity.roughness[:] = 1.0, 2.5
    m.sensitivity.velocity_roughness[:] = 1.5, 3.0
    m.sensitivity.unit[:] = 0.5, 2.0
    m.sensitivity.strain[:] = 1.0, 2.0
    return m


def thresholds_of(m):
    sensitivity.follow_friction(K, m, np.zeros(2))
    sensitivity.fill_thresholds(K, m)
    return m.sensitivity.h.copy()


def noise_of(m):
    """Return what white torque noise and the velocity's quantisation leave in each channel (5, 2), Nm², by formula."""
    nu = CERTIFIED.velocity_noise_rad_s
    momentum = np.diag(m.regressor.M @ np.diag(m.sensitivity.velocity_roughness) @ m.regressor.M.T)
    variance = []
    for a, is_smooth in CHANNELS:
        s = CERTIFIED.smoothing_rad_s
        width = a * s / (a + s) if is_smooth else a
        share = 0.335 * s / 200.0 / (1.0 + a / 600.0) if is_smooth else sensitivity.BARE
        torque = (CERTIFIED.noise_sigmas * CERTIFIED.torque_noise_Nm) ** 2 * width * T / 2.0 * m.sensitivity.roughness
        variance.append(torque + (share * nu * a) ** 2 * momentum)
    return np.array(variance)


def doubt_of(m):
    """Return k_m g of each filter and joint (3, 2), Nm."""
    D = np.diag((np.array(K.model_error) * m.models.theta) ** 2)
    believed, unexplained = (np.einsum("cij,jk,cik->ci", m.filters.W_f, P, m.filters.W_f) for P in (m.models.P, D))
    return CERTIFIED.model_sigmas * np.sqrt(m.sensitivity.unit * believed + unexplained)


@pytest.mark.parametrize("is_steady", [True, False])
def test_a_moving_arm_s_thresholds_are_noise_and_doubt_in_quadrature(is_steady):
    """The doubt of a smoothed channel follows the motion as slowly as its residual."""
    m = known_arm()
    m.sensitivity.doubt[:] = before = doubt_of(m) if is_steady else 0.0
    share = 1.0 - np.exp(-CERTIFIED.smoothing_rad_s * T)
    followed = np.concatenate([before + share * (doubt_of(m) - before), doubt_of(m)[1:]])
    np.testing.assert_allclose(thresholds_of(m), m.sensitivity.strain * np.sqrt(noise_of(m) + followed**2), rtol=1e-10)


def test_a_joint_at_rest_may_hold_what_static_friction_is_believed_to_hold():
    """Coulomb and Stribeck friction, and a standard deviation of each, in the share of the filter that is of rest.

    The deviation of the latter is no more than STATIC_SHARE of the former.
    """
    m = known_arm()
    m.filters.W_f[:] = 0.0
    moving = thresholds_of(m)
    m.sensitivity.still[:] = 0.5
    m.sensitivity.still_smooth[:] = 0.25
    places = np.array([[COULOMB, STRIBECK], [COULOMB + 1, STRIBECK + 1]])
    held = m.models.theta[places].sum(1) + np.sqrt(np.diag(m.models.P)[places]).sum(1)
    share = np.array([0.25, 0.25, 0.25, 0.5, 0.5])[:, None]
    np.testing.assert_allclose(thresholds_of(m) - moving, CERTIFIED.standstill_share * share * held, rtol=1e-10)


def test_friction_that_was_learnt_negative_holds_nothing():
    m = known_arm()
    m.sensitivity.still[:] = m.sensitivity.still_smooth[:] = 1.0
    m.models.P[:] = 0.0
    m.filters.W_f[:] = 0.0
    m.models.theta[[COULOMB, COULOMB + 1, STRIBECK, STRIBECK + 1]] = -0.2
    np.testing.assert_allclose(thresholds_of(m), m.sensitivity.strain * np.sqrt(noise_of(m)), rtol=1e-10)


def stood(dq, before, count=1):
    """Return the memory after samples of a joint's velocity (2,), the first after one of `before`."""
    _, m = kernel_of()
    m.sensitivity.dq_old[:] = before
    for _ in range(count):
        sensitivity.follow_standstill(K, m, np.array(dq))
    return m


def test_standstill_fills_a_filter_in_its_own_time():
    dq = [0.0, -0.9 * CERTIFIED.still_rad_s]
    m = stood(dq, dq, 100)
    own = m.sensitivity
    np.testing.assert_allclose(own.still, np.tile(1.0 - np.exp(-CUTOFFS * 0.1)[:, None], (1, 2)), rtol=1e-12)
    assert np.all(own.still_smooth < own.still)
    np.testing.assert_allclose(own.still_smooth[1], 0.991, atol=0.002)  # 1 - (200 e^-5 - 50 e^-20) / 150
    before, dq = own.still.copy(), np.array([1.1, -1.1]) * CERTIFIED.still_rad_s
    own.dq_old[:] = dq
    sensitivity.follow_standstill(K, m, dq)
    np.testing.assert_allclose(own.still, before * np.exp(-CUTOFFS * T)[:, None], rtol=1e-12)


def test_a_joint_that_turns_round_between_two_samples_has_stood_still():
    expected = np.column_stack([1.0 - np.exp(-CUTOFFS * T), np.zeros(3)])
    np.testing.assert_allclose(stood([0.3, 0.3], [-0.3, 0.1]).sensitivity.still, expected, rtol=1e-12)


def test_the_undone_filter_s_deviation_is_that_of_a_mean_of_five_samples():
    m = known_arm()
    m.sensitivity.doubt[:] = 0.3
    m.sensitivity.h[:] = [[0.5, 0.6], [0.3, 0.7], [0.4, 0.2], [0.9, 0.9], [0.8, 0.8]]
    sensitivity.fill_wide(K, m)
    torque = CERTIFIED.torque_noise_Nm**2 * m.sensitivity.roughness / 5.0
    velocity = (
        2.0
        * (0.12 * CERTIFIED.velocity_noise_rad_s / (5.0 * T)) ** 2
        * m.regressor.M**2
        @ m.sensitivity.velocity_roughness
    )
    model = (0.3 / CERTIFIED.model_sigmas) ** 2
    np.testing.assert_allclose(m.sensitivity.wide_sigma, np.sqrt(torque + velocity + model), rtol=1e-10)
    np.testing.assert_array_equal(m.sensitivity.wide_threshold, [0.3, 0.2])


FLOOR_RAD_S = sensitivity.SECOND_DIFFERENCE * CERTIFIED.velocity_noise_rad_s


def after_a_swing(noise, count=2000):
    """Return the memory after a fast swing, 4 rad/s and 28 rad/s² at most, seen with white noise (n, 2) of dq."""
    _, m = kernel_of()
    swing = 4.0 * np.sin(7.0 * T * np.arange(count))
    for dq in swing[:, None] + noise:
        sensitivity.follow_velocity_noise(K, m, dq, True)
    return m


def test_velocity_noise_is_seen_in_the_second_difference_and_motion_is_not():
    assert np.all(after_a_swing(np.zeros((2000, 2))).sensitivity.velocity_roughness == 1.0)
    noise = np.random.default_rng(3).standard_normal((2000, 2)) * FLOOR_RAD_S * [0.2, 8.0]
    roughness = after_a_swing(noise).sensitivity.velocity_roughness
    assert 1.0 <= roughness[0] < 1.2
    assert roughness[1] == pytest.approx(6.0 * 8.0**2, rel=0.3)  # a second difference has 1 + 4 + 1 times the variance


def test_what_an_encoder_has_shown_in_motion_is_kept_at_rest_and_goes_back_in_motion_that_shows_less():
    noise = np.random.default_rng(3).standard_normal((2000, 2)) * FLOOR_RAD_S
    m = after_a_swing(noise)
    for _ in range(2):
        sensitivity.follow_velocity_noise(K, m, np.zeros(2), True)  # from the motion to rest: two jumps
    seen = m.sensitivity.roughness_now.copy()
    assert np.all(seen > 3.0)
    sensitivity.keep_velocity_noise(K, m)
    for _ in range(3000):  # at rest
        sensitivity.follow_velocity_noise(K, m, np.zeros(2), True)
        sensitivity.keep_velocity_noise(K, m)
    assert np.all(m.sensitivity.roughness_now == 1.0)
    np.testing.assert_array_equal(m.sensitivity.velocity_roughness, seen)
    moves_s = 10.0
    for _ in range(round(moves_s / T)):
        m.sensitivity.dq_old[0] = 0.5  # and neither noise nor a jump
        sensitivity.keep_velocity_noise(K, m)
    sensitivity.follow_velocity_noise(K, m, m.sensitivity.dq_old.copy(), True)
    left = 1.0 + (seen - 1.0) * np.exp([-moves_s / sensitivity.ROUGHNESS_LOST_S, 0.0])
    np.testing.assert_allclose(m.sensitivity.velocity_roughness, left, rtol=1e-2)


def test_a_jump_of_the_velocity_counts_as_five_deviations_at_most():
    """Its second difference is a rise and a fall."""
    _, m = kernel_of()
    for dq in (0.0, 0.0, 3.0, 3.0, 3.0):
        sensitivity.follow_velocity_noise(K, m, np.array([dq, 0.0]), True)
    share = T / sensitivity.ROUGHNESS_S
    most = (1.0 + share * (sensitivity.JUMP**2 - 1.0)) ** 2
    np.testing.assert_allclose(m.sensitivity.velocity_roughness, [most * (1.0 - share), 1.0], rtol=1e-10)


def test_a_contact_doubles_the_strain_of_the_joints_that_are_over_up_to_the_largest():
    _, m = kernel_of()
    m.sensitivity.h[:] = 1.0
    m.filters.y[3, 1] = -1.1
    strains = []
    for largest in (8.0, 8.0, 8.0, 8.0, 4.0):
        sensitivity.raise_strain(m, largest)
        strains.append(m.sensitivity.strain.tolist())
    assert strains == [[1.0, 2.0], [1.0, 4.0], [1.0, 8.0], [1.0, 8.0], [1.0, 8.0]]


def stepped(step_Nm, std_Nm=0.02):
    """Return the memory after a second of a sensor with this step, and how far its mean is off at the worst place."""
    _, m = kernel_of()
    noise = std_Nm * np.random.default_rng(3).standard_normal(200_000)
    for tau in np.round((noise[:10_000] + 0.5 * step_Nm) / step_Nm) * step_Nm:
        sensitivity.follow_torque_step(K, m, np.array([tau, 0.0]))
        m.gaps.last[2] = tau, 0.0
    places = np.linspace(0.0, step_Nm, 21)
    return m, max(abs(np.mean(np.round((noise + at) / step_Nm) * step_Nm) - at) for at in places)


@pytest.mark.parametrize("step_Nm", [0.0015, 0.04, 0.1, 0.2])
def test_a_sensor_s_step_is_found_and_its_pull_is_what_rounding_does_to_a_mean(step_Nm):
    m, off_Nm = stepped(step_Nm)
    np.testing.assert_allclose(m.sensitivity.torque_step_Nm, [step_Nm, 0.0], rtol=1e-9)
    assert m.sensitivity.torque_pull_Nm[0] == pytest.approx(sensitivity.PULL * off_Nm, rel=0.1, abs=2e-4)
    assert m.sensitivity.torque_pull_Nm[1] == 0.0


def test_what_changes_first_or_by_much_is_no_step():
    """A push that ends a long rest is one; so is a sensor that has more noise than steps."""
    _, m = kernel_of()
    changes = int(sensitivity.CHANGES)
    for k in range(changes + 10):
        assert (m.sensitivity.torque_step_Nm[0] > 0.0) == (k > changes)  # the first sample is no change
        sensitivity.follow_torque_step(K, m, np.array([5.0 * (k % 2 == 0), 0.0]))
        m.gaps.last[2] = 5.0 * (k % 2 == 0), 0.0
    assert m.sensitivity.torque_step_Nm[0] == sensitivity.LARGEST_STEP_NM


def test_a_sensor_s_step_raises_the_thresholds_by_its_noise_and_its_pull():
    m, _ = stepped(0.1)
    _, fine = kernel_of()
    for memory in (m, fine):
        memory.models.P[:] = 0.0
        memory.models.theta[:] = 0.0
        sensitivity.fill_thresholds(K, memory)
    h, h_fine = m.sensitivity.h, fine.sensitivity.h
    noise = K.noise.torque_gain * 0.1**2 / 12.0
    np.testing.assert_allclose(h[:, 0], np.sqrt(h_fine[:, 0] ** 2 + noise) + m.sensitivity.torque_pull_Nm[0], rtol=1e-9)
    np.testing.assert_array_equal(h[:, 1], h_fine[:, 1])


def relaxed(share, count, strain=8.0):
    """Return the memory after samples that show this share of the threshold."""
    _, m = kernel_of()
    m.sensitivity.strain[:] = strain
    m.sensitivity.h[:] = 0.5
    m.filters.y[2] = 0.5 * share
    for _ in range(count):
        sensitivity.decay_strain(K, m)
    return m


def test_strain_goes_back_over_ten_seconds_where_the_residual_leaves_room_and_never_below_one():
    left = 8.0 * (1.0 - T / sensitivity.STRAIN_S) ** 1000
    np.testing.assert_allclose(relaxed(np.array([0.59, -0.61]), 1000).sensitivity.strain, [left, 8.0], rtol=1e-10)
    assert relaxed(np.zeros(2), 1000, 1.05).sensitivity.strain.tolist() == [1.0, 1.0]


def test_a_peak_of_the_residual_holds_the_strain_for_a_while():
    m = relaxed(np.array([0.9, -0.9]), 1)
    m.filters.y[:] = 0.0
    count = round(np.log(0.9 / sensitivity.RELAXED) * sensitivity.STRAIN_S / T)
    for _ in range(count - 2):
        sensitivity.decay_strain(K, m)
    assert m.sensitivity.strain.tolist() == [8.0, 8.0]
    for _ in range(4):
        sensitivity.decay_strain(K, m)
    assert np.all(m.sensitivity.strain < 8.0)


def units_after(share, count, unit=1.0, is_monitored=False, sign=lambda _: 1.0):
    """Return the unit after samples whose squared residual is this share (2,) of what is believed."""
    m = known_arm()
    m.sensitivity.unit[:] = m.sensitivity.unit_by_sign[:] = unit
    m.sensitivity.held[:] = [[0.0, 0.3], [0.1, 0.2], [0.4, 0.0]]
    believed = CERTIFIED.residual_Nm**2 + m.sensitivity.held[0] ** 2
    believed += np.einsum("ij,jk,ik->i", m.filters.W_f[0], m.models.P, m.filters.W_f[0])
    for sample in range(count):
        m.filters.r[0] = sign(sample) * np.sqrt(share * believed)
        sensitivity.follow_unit(K, m, is_monitored)
    return m.sensitivity.unit.copy()


@pytest.mark.parametrize(
    ("is_monitored", "memory_s", "rtol"),
    [(False, sensitivity.UNIT_TEST_S, 1e-10), (True, sensitivity.UNIT_S, 1e-3)],
)
def test_the_unit_follows_an_error_of_both_signs_in_its_own_time(is_monitored, memory_s, rtol):
    left = (1.0 - T / memory_s) ** 1000
    share = np.array([0.1, 1.0])
    target = sensitivity.UNIT_PEAK * share
    swings = units_after(share, 1000, is_monitored=is_monitored, sign=lambda sample: (-1.0) ** sample)
    np.testing.assert_allclose(swings, target + left * (1.0 - target), rtol=rtol)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_while_the_arm_is_monitored_a_push_of_one_sign_raises_no_unit(sign):
    assert np.all(units_after(np.full(2, 9.0), 1000, is_monitored=True, sign=lambda _: sign) < 1.0)


def test_the_unit_keeps_to_its_bounds():
    assert units_after(np.zeros(2), 200, 1.005 * sensitivity.SMALLEST_UNIT).tolist() == [sensitivity.SMALLEST_UNIT] * 2
    assert units_after(np.full(2, 1e9), 1).tolist() == [sensitivity.LARGEST_UNIT] * 2


@pytest.mark.parametrize(
    ("place", "value", "h", "joints"),
    [
        ((0, 0), 1.01, 1.0, 0b01),
        ((1, 0), -1.01, 1.0, 0b01),
        ((2, 1), 1.01, 1.0, 0b10),
        ((3, 1), np.nan, 1.0, 0b10),
        ((1, 0), 1.0, 1.0, 0b00),
        ((1, 0), -1.0, 1.0, 0b00),
        ((0, slice(None)), (2.0, -2.0), 1.0, 0b11),
        ((0, 0), 0.0, np.nan, 0b11),
    ],
)
def test_a_joint_is_over_in_any_channel_and_what_is_no_number_is_over(place, value, h, joints):
    y, h = np.zeros((5, 2)), np.full((5, 2), h)
    y[place] = value
    assert sensitivity.joints_over(y, h) == joints


@pytest.mark.parametrize(("smoothed", "joints"), [(0.0, 0b00), (0.39, 0b00), (-0.41, 0b01)])
def test_a_bare_channel_alone_finds_no_push(smoothed, joints):
    y, h = np.zeros((5, 2)), np.ones((5, 2))
    y[4, 0], y[2, 0] = -1.5, smoothed
    assert sensitivity.joints_over(y, h) == joints
