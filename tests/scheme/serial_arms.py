"""Serial arms for the tests of the chain: random ones, the planar one, and one of seven joints."""

from pathlib import Path

import numpy as np

from adacd_hil.lab.serial_arm import chain
from adacd_hil.lab.serial_arm.chain import Chain, point_mass
from adacd_hil.lab.serial_arm.urdf import SerialArm, read_urdf

SEVEN_JOINT_URDF = (Path(__file__).parent / "seven_joint_arm.urdf").read_text()
GRAVITY = (0.0, 0.0, -9.81)
PLANAR_LENGTH_M = 0.35


def seven_joint_arm() -> SerialArm:
    return read_urdf(SEVEN_JOINT_URDF, GRAVITY)


def random_rotation(random):
    rotation = np.linalg.qr(random.normal(size=(3, 3)))[0]
    return rotation * np.sign(np.linalg.det(rotation))


def random_chain(seed, n):
    """Return a chain with random axes, about a third of them prismatic, and the parameters (10 n,) of real bodies."""
    random = np.random.default_rng(seed)
    axis = random.normal(size=(n, 3))
    arm = Chain(
        np.array([random_rotation(random) for _ in range(n)]),
        random.uniform(-0.4, 0.4, (n, 3)),
        axis / np.linalg.norm(axis, axis=1)[:, None],
        (random.random(n) < 0.3).astype(float),
        random.uniform(-6.0, 6.0, 3),
    )
    bodies = [point_mass(random.uniform(0.2, 2.0), at) for at in random.uniform(-0.2, 0.2, (6 * n, 3))]
    return arm, np.sum(np.reshape(bodies, (n, 6, 10)), axis=1).ravel()


def planar_chain(gravity_m_s2):
    """Return the 2R arm in the x-y plane."""
    translation = np.array([[0.0, 0.0, 0.0], [PLANAR_LENGTH_M, 0.0, 0.0]])
    axis = np.array([[0.0, 0.0, 1.0]] * 2)
    return Chain(np.array([np.eye(3)] * 2), translation, axis, np.zeros(2), np.array(gravity_m_s2))


def random_state(seed, n):
    return np.random.default_rng(seed).uniform(-3.0, 3.0, (3, n))


def mass_matrix(arm, q, theta_full):
    """Return M(q) (n, n), kg m²: column j is the momentum at dq_j = 1."""
    return np.column_stack([chain.split_regressor(arm, q, unit)[0] @ theta_full for unit in np.eye(q.size)])
