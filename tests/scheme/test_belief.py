"""The belief against the closed form of Bayesian linear regression, and what it does not learn."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize
from excited_arm import NAMES, SETTINGS, kernel_of
from planar_arm import PAYLOAD_1KG

from adacd_hil.scheme.identify import belief
from adacd_hil.scheme.kernel import certified_memory
from adacd_hil.scheme.model import filter_bank, regressor

K, _ = kernel_of()
COUNT = len(NAMES)
EVERY = SETTINGS.certified.learn_every
WAITING = round(SETTINGS.certified.hold_back_s / (EVERY * SETTINGS.bus.period_s))


def prior():
    return kernel_of()[1]


def samples(count=400, seed=1):
    random = np.random.default_rng(seed)
    W_f = random.standard_normal((count, 2, COUNT))
    return W_f, W_f @ random.standard_normal(COUNT) + 0.1 * random.standard_normal((count, 2))


def learn(m, W_f, tau_f, held=0.0):
    """Learn a sample in which friction may hold a torque, Nm."""
    m.filters.W_learnt, m.filters.tau_learnt = W_f, tau_f
    m.sensitivity.hold, m.sensitivity.still_smooth[filter_bank.LEARNT] = 10.0 * np.asarray(held), 0.1
    return belief.learn(K, m)


def teach(m, W_f, tau_f, held=0.0):
    held = np.broadcast_to(held, tau_f.shape)
    return [learn(m, *sample) for sample in zip(W_f, tau_f, held, strict=True)]


def test_nothing_is_expected_of_an_arm_but_the_velocity_s_usual_lag():
    expected = np.zeros(COUNT)
    expected[[NAMES.index("lag1"), NAMES.index("lag2")]] = SETTINGS.certified.lag_s
    np.testing.assert_array_equal(prior().models.belief, expected)


def test_of_further_friction_load_may_be_a_quarter_and_bristles_half():
    further = SETTINGS.certified.prior_std[-1]
    std = dict(zip(NAMES, np.sqrt(np.diag(prior().models.P_belief)), strict=True))
    shares = {"stribeck1": 1.0, "load2": 0.25, "dahl_short1": 0.5, "dahl_long2": 0.5}
    assert {name: std[name] / further for name in shares} == pytest.approx(shares)


def test_what_is_learnt_is_the_closed_form_of_every_fourth_sample_that_has_waited():
    """P = (P0^-1 + sum W' W / R)^-1, theta = P (P0^-1 theta0 + sum W' tau / R).

    R of each joint's sample is that of a good model's residual and of what friction may have held then.
    """
    W_f, tau_f = samples()
    held = np.random.default_rng(2).uniform(0.0, 0.1, tau_f.shape)
    m = prior()
    theta0, P0 = m.models.belief.copy(), m.models.P_belief.copy()
    teach(m, W_f, tau_f, held)
    learnt = slice(EVERY - 1, len(W_f) - WAITING * EVERY, EVERY)
    a, learn_s = SETTINGS.certified.cutoffs_rad_s[1], EVERY * 1e-3  # noise through a filter is correlated over 2 / a
    R = (SETTINGS.certified.residual_Nm**2 + held[learnt] ** 2) * 2.0 / (a * learn_s)
    information = np.linalg.inv(P0) + np.einsum("nij,ni,nik->jk", W_f[learnt], 1.0 / R, W_f[learnt])
    correlation = np.linalg.solve(P0, theta0) + np.einsum("nij,ni->j", W_f[learnt], tau_f[learnt] / R)
    np.testing.assert_allclose(m.models.P_belief, np.linalg.inv(information), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(m.models.belief, np.linalg.solve(information, correlation), rtol=1e-7)


def test_samples_closer_than_their_noise_changes_count_for_less_but_never_for_more_than_one():
    a = SETTINGS.certified.cutoffs_rad_s[1]
    for every, correlated in ((EVERY, 2.0 / (a * EVERY * 1e-3)), (20, 2.0), (60, 1.0)):
        settings = replace(SETTINGS, certified=replace(SETTINGS.certified, learn_every=every))
        assert float(certified_memory.constants_of(settings)[0].correlated) == pytest.approx(correlated)


def test_the_belief_tells_when_it_has_changed():
    W_f, tau_f = samples()
    changed = np.flatnonzero(teach(prior(), W_f, tau_f))
    np.testing.assert_array_equal(changed, np.arange((WAITING + 1) * EVERY - 1, len(W_f), EVERY))


def test_samples_that_wait_are_thrown_away_when_they_turn_out_to_be_a_touch():
    W_f, tau_f = samples()
    begin, flagged, end = 200, 200 + WAITING * EVERY, len(W_f)
    beliefs = []
    for torque in (0.0, 5.0):
        m = prior()
        touched = tau_f.copy()
        touched[begin:flagged] += torque
        teach(m, W_f[:flagged], touched[:flagged])
        belief.discard(m)
        teach(m, W_f[flagged:end], touched[flagged:end])
        beliefs.append(m.models.belief.copy())
    np.testing.assert_array_equal(beliefs[0], beliefs[1])
    assert np.max(np.abs(beliefs[0])) > 0.1


def test_after_a_touch_the_ring_holds_what_was_seen_since():
    """Its first places: a contact that follows soon is weighed by these alone."""
    W_f, tau_f = samples()
    m = prior()
    teach(m, W_f[: 7 * EVERY], tau_f[: 7 * EVERY])
    belief.discard(m)
    teach(m, W_f[100 : 100 + 3 * EVERY], tau_f[100 : 100 + 3 * EVERY])
    assert m.ring.used == 3.0
    np.testing.assert_array_equal(m.ring.tau[:3], tau_f[100 + EVERY - 1 : 100 + 3 * EVERY : EVERY])


def test_a_payload_widens_the_belief_along_one_direction_and_each_parameter_by_its_own_rest():
    P, direction = np.eye(COUNT), regressor.payload_direction((0.35, 0.30), COUNT, 0.0)
    rest_std = np.where(np.arange(COUNT) < 3, 0.02, 0.0)
    belief.add_payload(direction, 3.0, rest_std, P)
    np.testing.assert_allclose(direction[:7], PAYLOAD_1KG)
    np.testing.assert_allclose(P, np.eye(COUNT) + 9.0 * np.outer(direction, direction) + np.diag(rest_std**2))


def test_a_payload_pulls_where_gravity_acts():
    direction = regressor.payload_direction((0.35, 0.30), 9, 9.80665)
    np.testing.assert_allclose(direction[:3], [0.35**2 + 0.30**2, 0.35 * 0.30, 0.30**2])
    np.testing.assert_allclose(direction[3:], [0.0, 0.0, 0.0, 0.0, 9.80665 * 0.35, 9.80665 * 0.30])


def test_a_wandering_parameter_becomes_less_certain_with_time():
    P = np.diag([1.0, 2.0]) + 0.5
    belief.wander(np.array([0.1, 0.0]), np.array([[1.0, 1.0]]), 4.0, P)
    np.testing.assert_allclose(P, [[1.54, 0.5], [0.5, 2.5]])


@pytest.mark.parametrize(("shown", "share"), [(0.0, 0.0), (0.3, 0.09), (1.0, 1.0), (5.0, 1.0)])
def test_it_wanders_as_far_as_the_motion_shows_it_in_some_joint(shown, share):
    P = np.zeros((1, 1))
    belief.wander(np.array([0.1]), np.array([[0.1 * shown], [-shown]]), 4.0, P)
    assert P[0, 0] == pytest.approx(0.04 * share)


LAGS = [NAMES.index("lag1"), NAMES.index("lag2")]
OTHERS = [j for j in range(COUNT) if j not in LAGS]


def test_a_lag_that_is_held_moves_no_more_and_the_others_are_learnt_as_if_it_were_known():
    W_f, tau_f = samples(1200)
    m = prior()
    teach(m, W_f[:400], tau_f[:400])
    belief.hold_lags(K, m)
    belief.discard(m)
    held, variance = m.models.belief[LAGS].copy(), np.diag(m.models.P_belief)[LAGS].copy()
    theta0, P0 = m.models.belief[OTHERS].copy(), m.models.P_belief[np.ix_(OTHERS, OTHERS)].copy()
    teach(m, W_f[400:], tau_f[400:])
    np.testing.assert_array_equal(m.models.belief[LAGS], held)
    np.testing.assert_array_equal(np.diag(m.models.P_belief)[LAGS], variance)
    learnt = slice(400 + EVERY - 1, len(W_f) - WAITING * EVERY, EVERY)
    W, tau = W_f[learnt][..., OTHERS], tau_f[learnt] - W_f[learnt][..., LAGS] @ held
    R = SETTINGS.certified.residual_Nm**2 * K.correlated
    information = np.linalg.inv(P0) + np.einsum("nij,nik->jk", W, W) / R
    theta = np.linalg.solve(information, np.linalg.solve(P0, theta0) + np.einsum("nij,ni->j", W, tau) / R)
    np.testing.assert_allclose(m.models.belief[OTHERS], theta, rtol=1e-6)


@pytest.mark.parametrize("negative", range(5))
def test_physically_possible_friction_is_the_nearest_to_what_was_learnt(negative):
    """In the metric of P, against a solver that we did not write."""
    random = np.random.default_rng(negative)
    for _ in range(5):
        root = random.standard_normal((5, 5))
        P, theta = root @ root.T + np.eye(5), np.abs(random.standard_normal(5))
        theta[1 : 1 + negative] *= -1.0
        root = np.linalg.cholesky(np.linalg.inv(P)).T
        bounds = np.full(5, -np.inf), np.full(5, np.inf)
        bounds[0][1:] = 0.0
        expected = scipy.optimize.lsq_linear(root, root @ theta, bounds, method="bvls").x
        belief.keep_non_negative(1, 5, theta, P)
        np.testing.assert_allclose(theta, expected, atol=1e-6)


def test_friction_that_is_known_for_certain_to_be_negative_goes_to_zero_alone():
    theta, P = np.array([0.4, -0.2]), np.diag([1.0, 0.0])
    belief.keep_non_negative(1, 2, theta, P)
    assert theta.tolist() == [0.4, 0.0]
