"""The dynamics of a serial arm: against the planar closed form, against itself, and its base parameters."""

import math

import numpy as np
import pytest
from serial_arms import PLANAR_LENGTH_M, mass_matrix, planar_chain, random_chain, random_state, seven_joint_arm

from adacd_hil.lab.serial_arm import chain
from adacd_hil.records import GRAVITY_PARAMETER_NAMES, PARAMETER_NAMES
from adacd_hil.scheme.model import regressor

SEEDS = range(20)
G_M_S2 = 9.81
FULL_NAMES = [f"{name}_{link}" for link in (1, 2) for name in chain.LINK_PARAMETERS]
CLOSED_NAMES = PARAMETER_NAMES + GRAVITY_PARAMETER_NAMES


def closed_parts(q, dq, count, level_rad):
    Y_p, Y_h = np.zeros((2, count)), np.zeros((2, count))
    regressor.fill_momentum(q, dq, Y_p)
    regressor.fill_remainder(q, dq, level_rad, Y_h)
    return Y_p, Y_h


def unit(**values):
    """Return theta_full (20,) of the planar arm with some parameters set."""
    theta_full = np.zeros(20)
    for name, value in values.items():
        theta_full[FULL_NAMES.index(name)] = value
    return theta_full


# What each inertial parameter of the closed form is on the chain: its own change of theta_full.
INERTIA = {
    "a1": unit(Izz_1=1.0),
    "a2": unit(mx_2=1.0 / PLANAR_LENGTH_M),
    "a3": unit(Izz_2=1.0, Izz_1=-1.0),
}
GRAVITY = {"a4": unit(mx_1=1.0 / G_M_S2), "a5": unit(mx_2=1.0 / G_M_S2)}


@pytest.mark.parametrize("level_rad", [0.0, 1.3, -2.5])
@pytest.mark.parametrize("seed", SEEDS)
def test_the_planar_closed_form_is_a_chain_of_two_however_it_is_mounted(seed, level_rad):
    """Y_p and Y_h column by column, friction included; a4 and a5 by what gravity alone adds; and its mass matrix."""
    q, dq, _ = random_state(seed, 2)
    Y_p, Y_h = (np.zeros((2, 9)) for _ in range(2))
    pull = np.array([math.sin(level_rad), -math.cos(level_rad), 0.0])
    level, mounted = planar_chain((0.0, 0.0, 0.0)), planar_chain(G_M_S2 * pull)
    theta = np.array([0.4, 0.07, 0.04])
    body = theta @ np.array(list(INERTIA.values()))
    np.testing.assert_allclose(regressor.mass_matrix(q, theta), mass_matrix(level, q, body), rtol=1e-12)
    level, upright = chain.split_regressor(level, q, dq), chain.split_regressor(mounted, q, dq)
    for name, change in INERTIA.items():
        Y_p[:, CLOSED_NAMES.index(name)] = level[0] @ change
        Y_h[:, CLOSED_NAMES.index(name)] = level[1] @ change
    for name, change in GRAVITY.items():
        Y_h[:, CLOSED_NAMES.index(name)] = (upright[1] - level[1]) @ change
    chain.fill_friction(dq, CLOSED_NAMES.index("F_v1"), Y_h)
    expected = closed_parts(q, dq, 9, level_rad)
    np.testing.assert_allclose(Y_p, expected[0], rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(Y_h, expected[1], rtol=1e-10, atol=1e-13)


@pytest.mark.parametrize("seed", range(4))
def test_base_parameters_tell_the_whole_torque_with_the_fewest_columns(seed):
    arm = random_chain(seed, 4)[0] if seed else seven_joint_arm().chain
    n = arm.axis.shape[0]
    base = chain.find_base(arm)
    states = [random_state(100 + index, n) for index in range(60)]
    W = np.concatenate([chain.regressor(arm, *state) for state in states])
    np.testing.assert_allclose(W[:, base.columns] @ base.map, W, atol=1e-10)
    assert np.linalg.matrix_rank(W, tol=1e-7) == base.columns.size == len(base.names)


def test_the_seven_joint_arm_has_43_base_parameters():
    """The number known of arms of this build: Gaz et al., Dynamic identification of the Franka Emika Panda, 2019."""
    assert chain.find_base(seven_joint_arm().chain).columns.size == 43


def test_friction_columns_are_velocity_and_its_sign():
    Y_h = np.zeros((3, 8))
    chain.fill_friction(np.array([0.5, -2.0, 0.0]), 1, Y_h)
    expected = [[0, 0.5, 0, 0, 1, 0, 0, 0], [0, 0, -2.0, 0, 0, -1, 0, 0], [0.0] * 8]
    np.testing.assert_array_equal(Y_h, expected)


def test_a_point_mass_has_the_kinetic_energy_of_its_speed():
    """u' I u = m |v + omega x r|²."""
    row = np.zeros(10)
    omega, v, r = np.array([0.5, -1.0, 2.0]), np.array([3.0, 0.1, -0.2]), np.array([0.3, -0.4, 0.7])
    u = np.concatenate([omega, v])
    chain.add_form(u, u, 1.0, row)
    assert row @ chain.point_mass(2.0, r) == pytest.approx(2.0 * np.sum((v + np.cross(omega, r)) ** 2))
