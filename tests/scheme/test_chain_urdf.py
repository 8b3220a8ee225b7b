"""What is read from a URDF, and what is said of one that can't be used."""

import numpy as np
import pytest
from serial_arms import SEVEN_JOINT_URDF

from adacd_hil.lab.serial_arm.urdf import UrdfError, read_urdf

INERTIA = '<inertia ixx="3" ixy="0" ixz="0" iyy="3" iyz="0" izz="1"/>'
BODY = f'<inertial><origin xyz="0 0 0.5"/><mass value="2"/>{INERTIA}</inertial>'


def joint(name, kind, parent, child, inside=""):
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{inside}</joint>'


def robot(inside):
    return f'<robot name="r">{inside}</robot>'


LINKS = '<link name="a"/><link name="b"/><link name="c"/>'
TURN = joint("turn", "revolute", "a", "b", '<axis xyz="0 0 2"/><limit lower="-1" upper="2" velocity="3" effort="4"/>')


def test_a_fixed_body_becomes_part_of_the_link_that_carries_it():
    """A body of 2 kg whose mass centre ends up at (1, 0, 0.5)."""
    links = f'<link name="a"/><link name="b"/><link name="c">{BODY}</link>'
    arm = read_urdf(robot(links + TURN + joint("glue", "fixed", "b", "c", '<origin xyz="1 0 0"/>')))
    expected = [2.0, 2.0, 0.0, 1.0, 3.5, 0.0, 5.5, -1.0, 0.0, 3.0]  # order: m, m c, then Ixx Ixy Iyy Ixz Iyz Izz
    np.testing.assert_allclose(arm.theta_full, expected, atol=1e-15)
    assert arm.joint_names == ("turn",)
    assert arm.link_names == ("b",)
    assert {name: place[0] for name, place in arm.places.items()} == {"a": -1, "b": 0, "c": 0}


def test_an_axis_is_made_a_unit_vector_and_limits_are_kept():
    arm = read_urdf(robot(LINKS + TURN + joint("slide", "prismatic", "b", "c")))
    np.testing.assert_array_equal(arm.chain.axis, [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    np.testing.assert_array_equal(arm.chain.is_prismatic, [0.0, 1.0])
    assert (arm.position_low[0], arm.position_high[0]) == (-1.0, 2.0)
    assert (arm.velocity_limit[0], arm.torque_limit[0]) == (3.0, 4.0)
    assert (arm.position_low[1], arm.position_high[1]) == (-np.inf, np.inf)


def test_a_continuous_joint_has_no_position_limits():
    spin = joint("spin", "continuous", "b", "c", '<limit lower="-1" upper="1" velocity="3" effort="4"/>')
    arm = read_urdf(robot(LINKS + TURN + spin))
    assert (arm.position_low[1], arm.position_high[1], arm.velocity_limit[1]) == (-np.inf, np.inf, 3.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot", "not XML: unclosed token: line 1, column 0"),
        ("", "not XML: no element found: line 1, column 0"),
        ("<sdf/>", "the outermost element is <sdf>, not <robot>"),
        (robot(""), "no <link>"),
        (robot(f'{LINKS}{TURN}<x:hand xmlns:x="http://www.ros.org/wiki/xacro"/>'), "<xacro:hand> is in it"),
        (robot("<link/>"), "a <link> has no name"),
        (robot('<link name="a"/><link name="a"/>'), 'link "a" is there twice'),
        (robot(LINKS + TURN + joint("x", "fixed", "d", "c")), 'link "d", the parent of joint "x", does not exist'),
        (robot(LINKS.replace('"c"/>', f'"c">{BODY}</link>') + TURN), 'more than one root link: "a", "c"'),
        (robot('<link name="a"/>'), "no joint moves"),
        (robot(LINKS + TURN + joint("x", "ball", "b", "c")), 'joint "x": type "ball" is not one of '),
        (robot(LINKS + TURN + joint("x", "fixed", "b", "d")), 'joint "x": child link "d" does not exist'),
        (robot(LINKS + TURN + '<joint name="x" type="fixed"/>'), 'joint "x": no <parent link="...">'),
        (robot(LINKS + TURN + joint("x", "fixed", "c", "b")), 'link "b" is the child of more than one joint'),
        (robot('<link name="a"/><link name="b"/>' + TURN + joint("x", "fixed", "b", "a")), "no root"),
        (
            robot(LINKS + '<link name="d"/>' + TURN + joint("x", "fixed", "c", "d") + joint("y", "fixed", "d", "c")),
            'link "c" hangs on a loop, not on the root',
        ),
        (robot(LINKS + TURN + joint("x", "revolute", "a", "c")), 'the arm branches: joints "turn", "x" move'),
        (robot(LINKS + TURN + joint("x", "revolute", "b", "c", '<axis xyz="0 0 0"/>')), 'joint "x": the axis is zero'),
        (robot(LINKS + TURN + joint("x", "revolute", "b", "c", '<axis xyz="0 1"/>')), "has 2 numbers, not 3"),
        (
            robot(LINKS + TURN + joint("x", "revolute", "b", "c", '<mimic joint="turn"/>')),
            "<mimic> is not supported; lock",
        ),
        (
            robot(LINKS + TURN + joint("x", "revolute", "b", "c", '<origin rpy="0 nan 0"/>')),
            'joint "x": <origin rpy="0 nan 0">: nan is not finite',
        ),
        (
            robot(LINKS + TURN + joint("x", "revolute", "b", "c", '<origin xyz="0 O 0"/>')),
            'joint "x": <origin xyz="0 O 0">: "O" is not a number',
        ),
        (
            robot(LINKS + TURN + joint("x", "revolute", "b", "c", '<limit lower="2" upper="1"/>')),
            'joint "x": lower limit 2 is above the upper 1',
        ),
        (SEVEN_JOINT_URDF.replace('value="3.6"', 'value="-3.6"'), 'link "link1": mass -3.6 kg is negative'),
        (SEVEN_JOINT_URDF.replace('izz="0.0142"', ""), 'link "link4": <inertia> has no attribute "izz"'),
        (SEVEN_JOINT_URDF.replace('izz="0.0142"', 'izz="-1"'), 'link "link4": the inertia is not positive'),
        (SEVEN_JOINT_URDF.replace('<mass value="0.9"/>', ""), 'link "tool": <inertial> needs <mass> and <inertia>'),
    ],
)
def test_a_urdf_that_cannot_be_used_is_refused_in_one_line(text, message):
    with pytest.raises(UrdfError) as refused:
        _ = read_urdf(text).theta_full
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_locked_joint_that_is_not_there_is_named():
    with pytest.raises(UrdfError, match='no joint "thumb" to be locked'):
        read_urdf(robot(LINKS + TURN), locked=("thumb",))


ODD = f'<inertial><mass value="-1"/>{INERTIA.replace("3", "-3", 1)}</inertial>'
ELSEWHERE = {
    "an odd inertia of the base": (LINKS.replace('"a"/>', f'"a">{ODD}</link>') + TURN, ()),
    "a mimic that is locked": (LINKS + TURN + joint("x", "prismatic", "b", "c", '<mimic joint="turn"/>'), ("x",)),
    "a mimic of a locked joint, not locked itself": (
        LINKS
        + '<link name="d"/>'
        + TURN
        + joint("y", "prismatic", "b", "d", '<mimic joint="x"/>')
        + joint("x", "prismatic", "b", "c"),
        ("x",),
    ),
    "a locked joint of a kind of its own": (LINKS + TURN + joint("x", "floating", "b", "c"), ("x",)),
    "a locked joint without sense": (LINKS + TURN + joint("x", "revolute", "b", "c", '<axis xyz="0 0 0"/>'), ("x",)),
    "limits of a fixed joint": (LINKS + TURN + joint("x", "fixed", "b", "c", '<limit lower="2" upper="1"/>'), ()),
    "a world without a link": (LINKS + TURN + joint("x", "fixed", "world", "a") + joint("y", "fixed", "b", "c"), ()),
    "a world without a joint": (LINKS + '<link name="world"/>' + TURN + joint("y", "fixed", "b", "c"), ()),
}


@pytest.mark.parametrize(("inside", "locked"), ELSEWHERE.values(), ids=ELSEWHERE)
def test_what_the_arm_does_not_need_is_not_judged(inside, locked):
    arm = read_urdf(robot(inside), locked=locked)
    assert arm.joint_names == ("turn",)
    assert not arm.theta_full.any()


def test_limits_that_are_all_zero_say_nothing():
    zero = '<axis xyz="0 0 1"/><limit lower="0" upper="0" velocity="0" effort="0"/>'
    arm = read_urdf(robot(LINKS + TURN + joint("x", "revolute", "b", "c", zero)))
    assert (arm.position_low[1], arm.position_high[1]) == (-np.inf, np.inf)
    assert (arm.velocity_limit[1], arm.torque_limit[1]) == (np.inf, np.inf)
    one_side = read_urdf(robot(LINKS + TURN + joint("x", "revolute", "b", "c", zero.replace('upper="0"', 'upper="1"'))))
    assert (one_side.position_low[1], one_side.position_high[1]) == (0.0, 1.0)
