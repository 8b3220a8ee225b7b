"""The regressor against mechanics that were derived elsewhere."""

import numpy as np
import pytest
from planar_arm import THETA
from serial_arms import random_state

from adacd_hil.scheme.model.regressor import (
    fill_momentum,
    fill_remainder,
    inverse_dynamics,
    is_positive_definite,
    mass_matrix,
    regressor,
)

SEEDS = range(20)


def test_the_golden_vector_is_met():
    tau = inverse_dynamics(np.array([0.3, -0.7]), np.array([1.1, -0.6]), np.array([2.0, -3.0]), THETA["M"], 0.0)
    np.testing.assert_allclose(tau, [0.9391413364143529, -0.10515014859197394], rtol=1e-14)


@pytest.mark.parametrize("parameter_count", [7, 9])
@pytest.mark.parametrize("seed", SEEDS)
def test_momentum_and_remainder_make_up_the_torque(seed, parameter_count):
    """W = d/dt Y_p + Y_h, the derivative by a central difference."""
    q, dq, ddq = random_state(seed, 2)
    h = 1e-5
    Y_p = np.zeros((2, 2, parameter_count))
    for side, sign in enumerate((-1.0, 1.0)):
        fill_momentum(q + sign * h * dq + 0.5 * h * h * ddq, dq + sign * h * ddq, Y_p[side])
    Y_h = np.zeros((2, parameter_count))
    fill_remainder(q, dq, 0.0, Y_h)
    W = (Y_p[1] - Y_p[0]) / (2.0 * h) + Y_h
    np.testing.assert_allclose(W, regressor(q, dq, ddq, parameter_count, 0.0), atol=1e-7)


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
