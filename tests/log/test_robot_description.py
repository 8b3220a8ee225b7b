"""The URDF for viewers, read by the reader of the scheme, and the layout that shows it."""

import base64
import json
import math
from dataclasses import replace

import numpy as np
import pytest

from adacd_hil.config import load_settings
from adacd_hil.log.layout import viewer_layout
from adacd_hil.log.live.robot_description import robot_description
from adacd_hil.log.live.scene import Shape, transforms_of
from adacd_hil.scheme.urdf import read_urdf

LENGTHS_M = (0.42, 0.27)


def settings_of(is_upright):
    settings = load_settings("paper")
    arm = replace(
        settings.arm,
        link_length_m=LENGTHS_M,
        position_limit_deg=(75.0, 120.0),
        velocity_limit_deg_s=(250.0, 300.0),
        torque_limit_Nm=(12.0, 6.0),
        cad_theta=(),
    )
    P0 = settings.estimator.P0 + ((0.5, 0.5) if is_upright else ())
    estimator = replace(settings.estimator, gravity=is_upright, P0=P0)
    return replace(settings, arm=arm, estimator=estimator)


def turn(quaternion):
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def tip_by_urdf(arm, q):
    rotation, place = np.eye(3), np.zeros(3)
    for index, angle in enumerate(q):
        place = place + rotation @ arm.chain.translation[index]
        c, s = math.cos(angle), math.sin(angle)
        rotation = rotation @ arm.chain.rotation[index] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return place + rotation @ arm.places["tip"][1].translation


def tip_by_transforms(transforms):
    rotation, place = np.eye(3), np.zeros(3)
    for transform in transforms:
        place = place + rotation @ np.array(transform.translation)
        rotation = rotation @ turn(transform.rotation)
    return place


@pytest.mark.parametrize("is_upright", [False, True])
def test_the_urdf_places_the_tip_as_the_arm_does_and_as_the_transforms_do(is_upright):
    arm = read_urdf(robot_description(settings_of(is_upright)))
    assert arm.chain.axis.tolist() == [[0.0, 0.0, 1.0]] * 2
    shape = Shape(LENGTHS_M, is_upright)
    for q in np.random.default_rng(3).uniform(-2.0, 2.0, (20, 2)):
        along = LENGTHS_M[0] * math.cos(q[0]) + LENGTHS_M[1] * math.cos(q.sum())
        across = LENGTHS_M[0] * math.sin(q[0]) + LENGTHS_M[1] * math.sin(q.sum())
        expected = [along, 0.0, across] if is_upright else [along, across, 0.0]
        assert tip_by_urdf(arm, q) == pytest.approx(expected, abs=1e-12)
        assert tip_by_transforms(transforms_of(shape, q)) == pytest.approx(expected, abs=1e-12)


def test_the_urdf_has_the_limits_of_the_settings_and_the_names_of_the_log():
    arm = read_urdf(robot_description(settings_of(False)))
    assert arm.joint_names == ("joint1", "joint2")
    assert arm.link_names == ("link1", "link2")
    assert np.degrees(arm.position_high) == pytest.approx([75.0, 120.0])
    assert (arm.position_low == -arm.position_high).all()
    assert np.degrees(arm.velocity_limit) == pytest.approx([250.0, 300.0])
    assert arm.torque_limit.tolist() == [12.0, 6.0]


def test_the_layout_holds_the_urdf_and_shows_every_panel_once():
    urdf = robot_description(settings_of(False)).encode()
    layout = json.loads(viewer_layout(urdf))
    arm = layout["configById"]["3D!arm"]["layers"]["arm"]
    assert base64.b64decode(arm["url"].removeprefix("data:text/xml;base64,")) == urdf
    assert sorted(shown(layout["layout"])) == sorted(layout["configById"])


def test_a_layout_without_an_arm_has_no_3d_panel():
    layout = json.loads(viewer_layout())
    assert sorted(shown(layout["layout"])) == sorted(layout["configById"])
    assert "3D!arm" not in layout["configById"]


def shown(place):
    return [place] if isinstance(place, str) else shown(place["first"]) + shown(place["second"])
