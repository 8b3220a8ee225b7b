"""Limits of a URDF that no arm can have, as exporters write them, are no limits of the arm."""

import math

import pytest
from called import called

from adacd_hil.control.configuration_check import examine_configuration
from adacd_hil.lab.commission.arm_draft import planar_from_urdf

INERTIA = '<inertia ixx="0.03" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.03"/>'
BODY = f'<inertial><origin xyz="0.2 0 0"/><mass value="2"/>{INERTIA}</inertial>'


def urdf(limits='lower="-1" upper="1.5" effort="20" velocity="3"'):
    joints = "".join(
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{x} 0 0"/><axis xyz="0 0 1"/><limit {limits}/></joint>'
        for name, parent, child, x in (("shoulder", "base", "upper", 0), ("elbow", "upper", "fore", 0.3))
    )
    tip = '<joint name="flange" type="fixed"><parent link="fore"/><child link="tip"/><origin xyz="0.25 0 0"/></joint>'
    links = f'<link name="base"/><link name="upper">{BODY}</link><link name="fore">{BODY}</link><link name="tip"/>'
    return f'<robot name="x">{links}{joints}{tip}</robot>'


def test_limits_are_taken():
    arm = planar_from_urdf(urdf().encode())
    assert arm.position_limit_deg == pytest.approx((57.3, 57.3), abs=0.01)
    assert arm.velocity_limit_deg_s == pytest.approx((math.degrees(3.0),) * 2, abs=0.01)
    assert arm.effort_Nm == (20.0, 20.0)


LIMITS = {
    "zero": 'lower="0" upper="0" effort="0" velocity="0"',
    "no effort": 'lower="-1" upper="1" effort="0" velocity="3"',
    "huge": 'lower="-1000" upper="1000" effort="1000000" velocity="10000"',
    "tiny": 'lower="-0.001" upper="0.001" effort="0.0001" velocity="0.0001"',
}


@pytest.mark.parametrize("limits", LIMITS.values(), ids=LIMITS)
def test_an_arm_with_limits_that_say_nothing_is_drafted_with_guesses(limits, tmp_path):
    path, out = tmp_path / "arm.urdf", tmp_path / "arm.toml"
    path.write_text(urdf(limits))
    done = called("init", out, "--no-bus", "--yes", "--urdf", path)
    assert done.exit_code == 0, done.output
    found = examine_configuration(str(out))
    assert found.errors == []
    assert found.settings is not None
    assert "arm.torque_limit_Nm" in found.settings.assumed


def test_a_limit_that_is_not_taken_is_named_with_its_bound():
    (doubt,) = planar_from_urdf(urdf(LIMITS["no effort"].replace("3", "10000")).encode()).doubts
    assert "arm.velocity_limit_deg_s[0]` = 572957.8 deg/s is above 3600 deg/s" in doubt


def test_an_arm_without_torque_is_one_line(tmp_path):
    path, out = tmp_path / "arm.urdf", tmp_path / "arm.toml"
    path.write_text(urdf())
    done = called("init", out, "--no-bus", "--yes", "--urdf", path, "--torque-limit-nm", "4", "0")
    assert (done.exit_code, out.exists()) == (2, False)
    assert "`arm.torque_limit_Nm[1]` = 0 Nm: joint 2 can't move" in done.output
