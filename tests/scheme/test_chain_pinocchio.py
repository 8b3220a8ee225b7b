"""The dynamics of serial arms and their URDF against Pinocchio, whose mechanics and reader are not ours."""

import numpy as np
import pytest
from serial_arms import (
    GRAVITY,
    SEVEN_JOINT_URDF,
    mass_matrix,
    planar_chain,
    random_chain,
    random_state,
    seven_joint_arm,
)

from adacd_hil.lab.serial_arm import chain

pinocchio = pytest.importorskip("pinocchio")

SEEDS = range(12)


def pinocchio_model(arm, theta_full):
    """Build the arm in Pinocchio from the same arrays."""
    model = pinocchio.Model()
    parent = 0
    for i, parameters in enumerate(theta_full.reshape(-1, 10)):
        kind = pinocchio.JointModelPrismaticUnaligned if arm.is_prismatic[i] else pinocchio.JointModelRevoluteUnaligned
        placement = pinocchio.SE3(arm.rotation[i], arm.translation[i])
        parent = model.addJoint(parent, kind(arm.axis[i]), placement, f"joint{i + 1}")
        inertia = pinocchio.Inertia.FromDynamicParameters(parameters)
        model.appendBodyToJoint(parent, inertia, pinocchio.SE3.Identity())
    model.gravity.linear = arm.gravity_m_s2
    return model


def arms(seed):
    """Return chain, parameters and Pinocchio's model: the planar arm, the one of seven joints, then random ones."""
    if seed == 0:
        arm, theta_full = planar_chain((0.0, -9.81, 0.0)), random_chain(0, 2)[1]
    elif seed <= 4:
        seven = seven_joint_arm()
        model = pinocchio.buildModelFromXML(SEVEN_JOINT_URDF)
        model.gravity.linear = np.array(GRAVITY)
        return seven.chain, seven.theta_full, model
    else:
        arm, theta_full = random_chain(seed, seed - 3)
    return arm, theta_full, pinocchio_model(arm, theta_full)


def assert_close(ours, theirs):
    """Agree to 1e-9 of the largest entry."""
    assert np.max(np.abs(theirs)) > 0.0
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9 * np.max(np.abs(theirs)))


@pytest.mark.parametrize("seed", SEEDS)
def test_pinocchio_agrees_on_the_regressor(seed):
    arm, _, model = arms(seed)
    q, dq, ddq = random_state(seed, model.nv)
    theirs = pinocchio.computeJointTorqueRegressor(model, model.createData(), q, dq, ddq)
    assert_close(chain.regressor(arm, q, dq, ddq), theirs)


@pytest.mark.parametrize("seed", SEEDS)
def test_pinocchio_agrees_on_momentum_and_remainder(seed):
    """M dq and -C' dq + g, with Pinocchio's own M, C and g."""
    arm, theta_full, model = arms(seed)
    data, (q, dq, _) = model.createData(), random_state(seed, model.nv)
    upper = np.triu(pinocchio.crba(model, data, q))
    M = upper + np.triu(upper, 1).T
    C = pinocchio.computeCoriolisMatrix(model, data, q, dq)
    g = pinocchio.computeGeneralizedGravity(model, data, q)
    Y_p, Y_h = chain.split_regressor(arm, q, dq)
    assert_close(mass_matrix(arm, q, theta_full), M)
    assert_close(Y_p @ theta_full, M @ dq)
    assert_close(Y_h @ theta_full, -C.T @ dq + g)


def test_pinocchio_reads_the_same_parameters_and_frames_from_the_urdf():
    arm = seven_joint_arm()
    model = pinocchio.buildModelFromXML(SEVEN_JOINT_URDF)
    theirs = np.concatenate([inertia.toDynamicParameters() for inertia in list(model.inertias)[1:]])
    np.testing.assert_allclose(arm.theta_full, theirs, rtol=1e-12, atol=1e-14)
    frame = model.frames[model.getFrameId("tool")]
    index, pose = arm.places["tool"]
    assert (index + 1, arm.joint_names) == (frame.parentJoint, tuple(model.names)[1:])
    np.testing.assert_allclose(pose.rotation, frame.placement.rotation, atol=1e-15)
    np.testing.assert_allclose(pose.translation, frame.placement.translation, atol=1e-15)
    np.testing.assert_array_equal(arm.position_low, model.lowerPositionLimit)
    np.testing.assert_array_equal(arm.position_high, model.upperPositionLimit)
    np.testing.assert_array_equal(arm.velocity_limit, model.velocityLimit)
    np.testing.assert_array_equal(arm.torque_limit, model.effortLimit)
