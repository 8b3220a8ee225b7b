"""The estimator against the closed form of least squares."""

import numpy as np
import pytest

from adacd_hil.scheme.identify.estimator import update

R = 1000.0
P0 = np.array([8.0, 4.0, 4.0, 0.5, 0.5, 0.5, 0.5])
THETA_TRUE = np.array([0.38, 0.07, 0.04, 0.12, 0.06, 0.15, 0.08])


def run(columns, torque, P0=P0, R=R, is_least_squares=True):
    """Learn from W_f (n, 2, p) and tau_f (n, 2); return theta_hat and P."""
    count = P0.shape[0]
    theta_hat, P, v, K = np.zeros(count), np.diag(P0), np.zeros(count), np.zeros(count)
    for W_f, tau_f in zip(columns, torque, strict=True):
        update(W_f, tau_f, R, is_least_squares, theta_hat, P, v, K)
    return theta_hat, P


def random_motion(samples=3000):
    columns = np.random.default_rng(2).standard_normal((samples, 2, 7))
    return columns, columns @ THETA_TRUE


@pytest.mark.parametrize("samples", [1, 10, 3000])
def test_estimate_and_gain_are_those_of_regularised_least_squares(samples):
    columns, torque = random_motion(samples)
    torque = torque + 0.1 * np.random.default_rng(3).standard_normal(torque.shape)
    information = np.diag(1.0 / P0) + np.einsum("nij,nik->jk", columns, columns) / R
    correlation = np.einsum("nij,ni->j", columns, torque) / R
    theta_hat, P = run(columns, torque)
    np.testing.assert_allclose(theta_hat, np.linalg.solve(information, correlation), rtol=1e-9)
    np.testing.assert_allclose(P, np.linalg.inv(information), rtol=1e-9, atol=1e-13)


def test_the_gain_stays_symmetric_and_positive_at_a_million_times_the_paper():
    columns, torque = random_motion()
    _, P = run(columns, torque, P0=P0 * 1e6)
    assert np.array_equal(P, P.T)
    assert np.linalg.eigvalsh(P)[0] > 0.0


def test_the_gradient_law_keeps_its_gain():
    columns, torque = random_motion(100)
    _, P = run(columns, torque, is_least_squares=False)
    np.testing.assert_array_equal(P, np.diag(P0))


def test_the_gradient_law_follows_its_differential_equation():
    """theta_hat' = P W_f' epsilon; for a small gain the step is its explicit Euler step."""
    columns, torque = random_motion(1)
    theta_hat, _ = run(columns, torque, P0=P0 * 1e-6, is_least_squares=False)
    np.testing.assert_allclose(theta_hat, P0 * 1e-6 * (columns[0].T @ torque[0]) / R, rtol=1e-6)


def test_the_gradient_law_is_stable_at_a_million_times_the_paper():
    columns, torque = random_motion(20_000)
    theta_hat, _ = run(columns, torque, P0=P0 * 1e6, is_least_squares=False)
    np.testing.assert_allclose(theta_hat, THETA_TRUE, rtol=1e-6)
