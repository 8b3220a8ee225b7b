"""The regressor against Pinocchio, whose mechanics are not ours."""

import math

import numpy as np
import pytest

from adacd_hil.scheme.model.regressor import inverse_dynamics, mass_matrix

pinocchio = pytest.importorskip("pinocchio")

SEEDS = range(20)


def random_state(seed):
    random = np.random.default_rng(seed)
    return random.uniform(-3.0, 3.0, 2), random.uniform(-2.0, 2.0, 2), random.uniform(-5.0, 5.0, 2)


PHYSICAL = {"m": (3.0, 1.5), "l": (0.35, 0.30), "lc": (0.20, 0.13), "I": (0.040, 0.015)}


def pinocchio_arm(gravity):
    """Build the 2R arm of PHYSICAL in the x-y plane with gravity (3,) in m/s²."""
    model = pinocchio.Model()
    parent = 0
    for i in range(2):
        offset = np.array([0.0 if i == 0 else PHYSICAL["l"][0], 0.0, 0.0])
        parent = model.addJoint(parent, pinocchio.JointModelRZ(), pinocchio.SE3(np.eye(3), offset), f"joint{i + 1}")
        inertia = pinocchio.Inertia(
            PHYSICAL["m"][i], np.array([PHYSICAL["lc"][i], 0.0, 0.0]), np.diag([1e-3, 1e-3, PHYSICAL["I"][i]])
        )
        model.appendBodyToJoint(parent, inertia, pinocchio.SE3.Identity())
    model.gravity.linear = np.array(gravity)
    return model


def theta_of_physical(g=9.81):
    """Eq. (18), without friction, gravity appended."""
    (m1, m2), (l1, _), (lc1, lc2), (I1, I2) = (PHYSICAL[key] for key in ("m", "l", "lc", "I"))
    inertia = [I1 + m1 * lc1**2 + I2 + m2 * (l1**2 + lc2**2), m2 * l1 * lc2, I2 + m2 * lc2**2]
    return np.array([*inertia, 0.0, 0.0, 0.0, 0.0, (m1 * lc1 + m2 * l1) * g, m2 * lc2 * g])


@pytest.mark.parametrize("seed", SEEDS)
def test_pinocchio_agrees_on_the_horizontal_arm(seed):
    q, dq, ddq = random_state(seed)
    model = pinocchio_arm((0.0, 0.0, 0.0))
    expected = pinocchio.rnea(model, model.createData(), q, dq, ddq)
    np.testing.assert_allclose(
        inverse_dynamics(q, dq, ddq, theta_of_physical()[:7], 0.0), expected, rtol=1e-12, atol=1e-12
    )


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("hangs_rad", [0.0, 1.3, -2.5, math.pi])
def test_pinocchio_agrees_on_an_arm_however_it_is_mounted(seed, hangs_rad):
    q, dq, ddq = random_state(seed)
    model = pinocchio_arm((9.81 * math.cos(hangs_rad), 9.81 * math.sin(hangs_rad), 0.0))
    expected = pinocchio.rnea(model, model.createData(), q, dq, ddq)
    found = inverse_dynamics(q, dq, ddq, theta_of_physical(), hangs_rad + math.pi / 2.0)
    np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("seed", SEEDS)
def test_pinocchio_agrees_on_the_mass_matrix(seed):
    q, _, _ = random_state(seed)
    model = pinocchio_arm((0.0, 0.0, 0.0))
    data = model.createData()
    upper = np.triu(pinocchio.crba(model, data, q))
    expected = upper + np.triu(upper, 1).T
    np.testing.assert_allclose(mass_matrix(q, theta_of_physical()), expected, rtol=1e-12)
