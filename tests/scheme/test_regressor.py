"""The regressor against mechanics that were derived elsewhere."""

import numpy as np
import pytest
from planar_arm import PAYLOAD_1KG, THETA, acceleration

from adacd_hil.scheme.model.regressor import (
    fill_momentum,
    fill_remainder,
    inverse_dynamics,
    is_positive_definite,
    mass_matrix,
    regressor,
)

SEEDS = range(20)


def random_state(seed):
    random = np.random.default_rng(seed)
    return random.uniform(-3.0, 3.0, 2), random.uniform(-2.0, 2.0, 2), random.uniform(-5.0, 5.0, 2)


def test_the_golden_vector_is_met():
    tau = inverse_dynamics(np.array([0.3, -0.7]), np.array([1.1, -0.6]), np.array([2.0, -3.0]), THETA["M"], 0.0)
    np.testing.assert_allclose(tau, [0.9391413364143529, -0.10515014859197394], rtol=1e-14)


def test_the_golden_vector_with_payload_is_met():
    theta = THETA["M"] + PAYLOAD_1KG
    tau = inverse_dynamics(np.array([0.3, -0.7]), np.array([1.1, -0.6]), np.array([2.0, -3.0]), theta, 0.0)
    np.testing.assert_allclose(tau, [1.109512623205665, -0.11638114642578004], rtol=1e-14)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_model_torque_accelerates_a_lagrangian_arm_as_wanted(seed):
    q, dq, ddq = random_state(seed)
    tau = inverse_dynamics(q, dq, ddq, THETA["M"], 0.0)
    np.testing.assert_allclose(acceleration(q, dq, tau, THETA["M"]), ddq, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("parameter_count", [7, 9])
@pytest.mark.parametrize("seed", SEEDS)
def test_momentum_and_remainder_make_up_the_torque(seed, parameter_count):
    """W = d/dt Y_p + Y_h, the derivative by a central difference."""
    q, dq, ddq = random_state(seed)
    h = 1e-5
    Y_p = np.zeros((2, 2, parameter_count))
    for side, sign in enumerate((-1.0, 1.0)):
        fill_momentum(q + sign * h * dq + 0.5 * h * h * ddq, dq + sign * h * ddq, Y_p[side])
    Y_h = np.zeros((2, parameter_count))
    fill_remainder(q, dq, 0.0, Y_h)
    W = (Y_p[1] - Y_p[0]) / (2.0 * h) + Y_h
    np.testing.assert_allclose(W, regressor(q, dq, ddq, parameter_count, 0.0), atol=1e-7)


@pytest.mark.parametrize("seed", SEEDS)
def test_momentum_is_mass_times_velocity(seed):
    q, dq, _ = random_state(seed)
    Y_p = np.zeros((2, 7))
    fill_momentum(q, dq, Y_p)
    np.testing.assert_allclose(Y_p @ THETA["M"], mass_matrix(q, THETA["M"]) @ dq, rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("seed", SEEDS)
def test_coriolis_torque_does_no_work_on_the_changing_mass(seed):
    """dq' (Mdot - 2 C) dq = 0, with C dq from the regressor and Mdot from a central difference."""
    q, dq, _ = random_state(seed)
    theta = THETA["S"].copy()
    theta[3:] = 0.0
    h = 1e-5
    Mdot = (mass_matrix(q + h * dq, theta) - mass_matrix(q - h * dq, theta)) / (2.0 * h)
    coriolis = inverse_dynamics(q, dq, np.zeros(2), theta, 0.0)
    assert abs(dq @ Mdot @ dq - 2.0 * dq @ coriolis) < 1e-9


def coriolis_matrix(q, dq, a2):
    """C of the paper's eq. (17)."""
    s2 = np.sin(q[1])
    return np.array([[-a2 * s2 * dq[1], -a2 * s2 * (dq[0] + dq[1])], [a2 * s2 * dq[0], 0.0]])


@pytest.mark.parametrize("seed", SEEDS)
def test_mass_rate_minus_twice_coriolis_is_skew_symmetric(seed):
    q, dq, x = random_state(seed)
    a2 = THETA["S"][1]
    Mdot = -a2 * np.sin(q[1]) * dq[1] * np.array([[2.0, 1.0], [1.0, 0.0]])
    assert abs(x @ (Mdot - 2.0 * coriolis_matrix(q, dq, a2)) @ x) < 1e-12


@pytest.mark.parametrize("seed", SEEDS)
def test_the_paper_coriolis_matrix_is_in_the_regressor(seed):
    q, dq, _ = random_state(seed)
    theta = np.array([0.0, 1.3, 0.0, 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(
        inverse_dynamics(q, dq, np.zeros(2), theta, 0.0), coriolis_matrix(q, dq, 1.3) @ dq, rtol=1e-12, atol=1e-14
    )


@pytest.mark.parametrize("profile", ["P", "S", "M"])
def test_an_arm_that_exists_is_positive_definite(profile):
    assert is_positive_definite(THETA[profile])


@pytest.mark.parametrize(
    "inertia",
    [
        (0.0, 0.0, 0.0),
        (0.2, 0.03, 0.0),
        (0.2, 0.03, -0.02),
        (0.02, 0.0, 0.03),
        (-0.3, 0.0, -0.1),
        (0.2, 0.0602, 0.02),  # a3 (a1 - a3) = 0.0036 = 0.06²
        (0.2, np.nan, 0.02),
        (np.nan, 0.03, 0.02),
        (0.2, 0.03, np.nan),
    ],
)
def test_an_arm_that_cannot_exist_has_no_positive_definite_mass(inertia):
    assert not is_positive_definite(np.array([*inertia, 0.0, 0.0, 0.0, 0.0]))


@pytest.mark.parametrize("seed", SEEDS)
def test_the_mass_test_agrees_with_eigenvalues_over_all_angles(seed):
    theta = np.random.default_rng(seed).uniform(-0.02, 0.2, 7)
    angles = np.linspace(-np.pi, np.pi, 721)
    smallest = min(np.linalg.eigvalsh(mass_matrix(np.array([0.0, angle]), theta))[0] for angle in angles)
    assert is_positive_definite(theta) == (smallest > 0.0)
