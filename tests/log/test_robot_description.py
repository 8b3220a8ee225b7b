"""The URDF for viewers, read by the reader of the scheme, and the layout that shows it."""

import base64
import json
import math
from dataclasses import replace

import mujoco
import numpy as np
import pinocchio
import pytest

from adacd_hil.lab.live.scene import Shape, transforms_of
from adacd_hil.lab.serial_arm.urdf import read_urdf
from adacd_hil.log.robot_description import robot_description
from adacd_hil.log.viewer_layout import viewer_layout
from adacd_hil.records import GRAVITY_M_S2
from adacd_hil.scheme.model.regressor import inverse_dynamics
from adacd_hil.settings.configuration_files import load_settings

LENGTHS_M = (0.42, 0.27)


FLAT = None
MOUNTINGS_DEG = [FLAT, (90.0, -90.0), (90.0, 0.0), (90.0, 180.0), (90.0, 90.0), (10.0, 35.0), (60.0, -140.0)]


def settings_of(mounting_deg, cad_theta=()):
    settings = load_settings("paper")
    arm = replace(
        settings.arm,
        link_length_m=LENGTHS_M,
        position_limit_deg=(75.0, 120.0),
        velocity_limit_deg_s=(250.0, 300.0),
        torque_limit_Nm=(12.0, 6.0),
        cad_theta=cad_theta,
        mounting_deg=mounting_deg,
    )
    P0 = settings.estimator.P0 + ((0.5, 0.5) if mounting_deg else ())
    estimator = replace(settings.estimator, gravity=mounting_deg is not FLAT, P0=P0)
    return replace(settings, arm=arm, estimator=estimator)


def tip_by_urdf(text, q):
    """Where an engine that is not ours puts the tip."""
    model = pinocchio.buildModelFromXML(text)
    data = model.createData()
    pinocchio.framesForwardKinematics(model, data, q)
    return data.oMf[model.getFrameId("tip")].translation


def tip_by_transforms(transforms):
    place = pinocchio.SE3.Identity()
    for _, _, translation, rotation in transforms:
        turn = pinocchio.Quaternion(np.array(rotation))
        place = place * pinocchio.SE3(turn, np.array(translation))
    return place.translation


@pytest.mark.parametrize("mounting_deg", MOUNTINGS_DEG)
def test_the_urdf_places_the_tip_as_the_arm_does_and_as_the_transforms_do(mounting_deg):
    text = robot_description(settings_of(mounting_deg))
    assert read_urdf(text).chain.axis.tolist() == [[0.0, 0.0, 1.0]] * 2
    tilt_rad, uphill_rad = (0.0, 0.0) if mounting_deg is FLAT else np.radians(np.add(mounting_deg, (0.0, 90.0)))
    shape = Shape(LENGTHS_M, tilt_rad, uphill_rad)
    for q in np.random.default_rng(3).uniform(-2.0, 2.0, (20, 2)):
        first, both = q[0] - uphill_rad, q.sum() - uphill_rad
        along = LENGTHS_M[0] * math.cos(first) + LENGTHS_M[1] * math.cos(both)
        across = LENGTHS_M[0] * math.sin(first) + LENGTHS_M[1] * math.sin(both)
        expected = [along, across * math.cos(tilt_rad), across * math.sin(tilt_rad)]
        assert tip_by_urdf(text, q) == pytest.approx(expected, abs=1e-12)
        assert tip_by_transforms(transforms_of(shape, q)) == pytest.approx(expected, abs=1e-12)


def test_the_urdf_has_the_limits_of_the_settings_and_the_names_of_the_log():
    arm = read_urdf(robot_description(settings_of(FLAT)))
    assert arm.joint_names == ("joint1", "joint2")
    assert arm.link_names == ("link1", "link2")
    assert np.degrees(arm.position_high) == pytest.approx([75.0, 120.0])
    assert (arm.position_low == -arm.position_high).all()
    assert np.degrees(arm.velocity_limit) == pytest.approx([250.0, 300.0])
    assert arm.torque_limit.tolist() == [12.0, 6.0]


def random_theta(generator, mounting_deg):
    """Draw the parameters of two links of any masses; link 1 may carry a counterweight."""
    m, inertia = generator.uniform(0.2, 5.0, 2), generator.uniform(0.001, 0.1, 2)
    c1, c2 = generator.uniform(0.0, 0.4), generator.uniform(0.0, 0.3)
    l1 = LENGTHS_M[0]
    alpha, beta, gamma = inertia[0] + m[0] * c1**2 + m[1] * l1**2, l1 * m[1] * c2, inertia[1] + m[1] * c2**2
    share = 0.0 if mounting_deg is FLAT else GRAVITY_M_S2 * math.sin(math.radians(mounting_deg[0]))
    gravity = (share * (m[0] * generator.uniform(-0.9, 1.0) * c1 + m[1] * l1), share * m[1] * c2)
    friction = generator.uniform(0.0, 0.2, 4)
    return tuple(map(float, (alpha + gamma, beta, gamma, *friction, *(gravity if mounting_deg else ()))))


def mujoco_torque(model, q, dq, ddq):
    """Give the torque that MuJoCo needs for a motion, friction included."""
    data = mujoco.MjData(model)
    data.qpos, data.qvel, data.qacc = q, dq, ddq
    mujoco.mj_inverse(model, data)
    return data.qfrc_inverse + model.dof_frictionloss * np.sign(dq)


@pytest.mark.parametrize("mounting_deg", MOUNTINGS_DEG)
@pytest.mark.parametrize("seed", range(2))
def test_the_urdf_moves_in_mujoco_as_the_cad_model_says(seed, mounting_deg):
    generator = np.random.default_rng(seed)
    theta, settings = random_theta(generator, mounting_deg), settings_of(mounting_deg)
    settings = replace(settings, arm=replace(settings.arm, cad_theta=theta))
    model = mujoco.MjModel.from_xml_string(robot_description(settings))
    model.opt.gravity[:] = (0.0, 0.0, -GRAVITY_M_S2)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT  # friction as a constraint, joint limits
    assert (model.nq, model.body_mass[1:].min() > 0.0) == (2, True)
    for _ in range(5):
        q, dq, ddq = generator.uniform(-1.0, 1.0, (3, 2)) * [[1.2], [3.0], [30.0]]
        expected = inverse_dynamics(q, dq, ddq, np.array(theta), settings.level_rad)
        assert mujoco_torque(model, q, dq, ddq) == pytest.approx(expected, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("profile", ["P", "S", "M"])
def test_the_built_in_arms_load_in_mujoco(profile):
    settings = load_settings("certified", profile)
    model = mujoco.MjModel.from_xml_string(robot_description(settings))
    assert model.nq == 2
    weighed_kg = {"P": 2.25, "S": 4.5, "M": 4.5}[profile]  # of the emulated arm
    assert model.body_mass.sum() == pytest.approx(weighed_kg, rel=0.1)


@pytest.mark.parametrize(
    ("theta", "said"),
    [
        ((), "arm.cad_theta is not given"),
        ((0.1, 0.2, 0.01, 0.0, 0.0, 0.0, 0.0), "belong to no rigid links"),
        ((0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), "belong to no rigid links"),
    ],
)
def test_what_the_cad_model_does_not_tell_is_not_made_up(theta, said):
    text = robot_description(settings_of(FLAT, theta))
    assert f"no inertia: {'' if not theta else 'arm.cad_theta: '}" in text
    assert said in text
    assert "<inertial>" not in text
    with pytest.raises(ValueError, match="mass and inertia"):
        mujoco.MjModel.from_xml_string(text)
    assert read_urdf(text).joint_names == ("joint1", "joint2")


def test_gravity_that_does_not_fit_the_inertia_is_said():
    theta = list(random_theta(np.random.default_rng(0), (90.0, -90.0)))
    theta[8] *= 1.05
    assert "but a2 = " in robot_description(settings_of((90.0, -90.0), tuple(theta)))


def test_a_link_whose_centre_is_on_its_joint_has_a_body_too():
    model = mujoco.MjModel.from_xml_string(robot_description(settings_of(FLAT, (0.2, 0.0, 0.02, 0.0, 0.0, 0.0, 0.0))))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    assert mujoco_torque(model, [0.3, 0.7], [0.0, 0.0], [1.0, 0.0]) == pytest.approx([0.2, 0.02])


VIEWERS_KEYS = {
    "Plot": "paths showXAxisLabels showYAxisLabels showLegend legendDisplay showPlotValuesInLegend sidebarDimension "
    "isSynced xAxisVal",
    "StateTransitions": "paths isSynced",
    "RawMessages": "topicPath diffEnabled",
    "RosOut": "searchTerms minLogLevel topicToRender",
    "3D": "cameraState followTf layers topics",
}
"""What each panel's configuration must have, after the types of Lichtblick's panels (August 2026)."""


def test_every_panel_is_shown_once_with_a_title_and_the_keys_that_its_viewer_reads():
    urdf = robot_description(settings_of(FLAT)).encode()
    layout = json.loads(viewer_layout(urdf))
    arm = layout["configById"]["3D!arm"]["layers"]["arm"]
    assert base64.b64decode(arm["url"].removeprefix("data:text/xml;base64,")) == urdf
    for shown_layout in (layout, json.loads(viewer_layout())):
        assert sorted(shown(shown_layout["layout"])) == sorted(shown_layout["configById"])
    assert "3D!arm" not in shown_layout["configById"]
    for name, panel in layout["configById"].items():
        titles = {panel.pop("lichtblickPanelTitle"), panel.pop("foxglovePanelTitle")}
        assert len(titles) == 1
        assert titles != {""}
        assert set(panel) == set(VIEWERS_KEYS[name.split("!")[0]].split()), name
        for path in panel.get("paths", ()):
            assert path["timestampMethod"] in ("receiveTime", "headerStamp")
            assert path["enabled"] is True


def shown(place):
    return [place] if isinstance(place, str) else shown(place["first"]) + shown(place["second"])
