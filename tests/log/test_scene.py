"""What the live view draws, decoded by code that isn't ours."""

import math

import numpy as np
import pytest
from live_rig import PUSH
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

from adacd_hil.lab.live.scene import (
    ARROW_LIFETIME_NS,
    GREEN,
    GREY,
    LARGEST_SPHERE_M,
    RED,
    SCENE,
    SMALLEST_SPHERE_M,
    YELLOW,
    MessageType,
    Shape,
    draw_contact,
    draw_joints,
    pack_scene,
    threshold_shares,
)
from adacd_hil.records import ContactLevel, Location, SchemeState

SHAPE = Shape((0.35, 0.30))
TIME_NS = 1_700_000_000_123_456_789


def decode(kind: MessageType, payload: bytes):
    schema = Schema(id=1, name=kind.name, encoding="ros2msg", data=kind.text.encode())
    return DecoderFactory().decoder_for("cdr", schema)(payload)


def drawn(*entities):
    return decode(SCENE, pack_scene(TIME_NS, entities)).entities


def rgba(primitive):
    return (primitive.color.r, primitive.color.g, primitive.color.b, primitive.color.a)


def test_each_joint_shows_how_near_its_residual_is():
    residuals, shares = np.array([0.03, -0.15]), np.array([0.3, 1.5])
    joint1, joint2, state = drawn(*draw_joints(SchemeState.MONITOR, residuals, shares))
    assert [(e.id, e.frame_id, e.frame_locked) for e in (joint1, joint2, state)] == [
        ("joint1", "link1", True),
        ("joint2", "link2", True),
        ("state", "base", True),
    ]
    assert (rgba(joint1.spheres[0]), rgba(joint2.spheres[0])) == (GREEN, RED)
    assert joint1.spheres[0].size.x == pytest.approx(SMALLEST_SPHERE_M + 0.3 * (LARGEST_SPHERE_M - SMALLEST_SPHERE_M))
    assert joint2.spheres[0].size.z == LARGEST_SPHERE_M  # and no larger
    assert [entity.texts[0].text for entity in (joint1, joint2, state)] == [
        "+0.030 Nm, 30 %",
        "-0.150 Nm, 150 %",
        "MONITOR",
    ]
    assert joint1.texts[0].billboard
    assert (joint1.timestamp.sec, joint1.timestamp.nanosec) == divmod(TIME_NS, 1_000_000_000)
    assert (joint1.lifetime.sec, joint1.lifetime.nanosec) == (0, 0)


def test_a_joint_is_yellow_from_half_of_the_threshold_and_grey_while_detection_is_off():
    residuals = np.array([0.05, 0.2])
    near, off, _ = drawn(*draw_joints(SchemeState.ADAPT, residuals, np.array([0.5, math.nan])))
    assert rgba(near.spheres[0]) == YELLOW
    assert (rgba(off.spheres[0]), off.spheres[0].size.y) == (GREY, SMALLEST_SPHERE_M)
    assert off.texts[0].text == "+0.200 Nm"


def scheme_record(**fields):
    values = {name: np.array(value, np.float64) for name, value in fields.items()}
    record = np.zeros((), [(name, np.float64, value.shape) for name, value in values.items()])
    for name, value in values.items():
        record[name] = value
    return record


@pytest.mark.parametrize("threshold", [math.inf, math.nan, 0.0])
def test_without_a_threshold_there_is_no_share(threshold):
    record = scheme_record(tau_ext_hat=[0.1, -0.1], threshold=[threshold, 0.2])
    np.testing.assert_array_equal(threshold_shares(record), [math.nan, 0.5])


def test_of_several_channels_the_nearest_to_its_threshold_counts():
    bank = scheme_record(
        tau_ext_hat=[0.1, 0.1],
        threshold=[1.0, 1.0],
        tau_ext_bank=[[0.1, 0.1], [-0.9, 0.2]],
        threshold_bank=[[1.0, math.inf], [1.0, math.inf]],
    )
    np.testing.assert_array_equal(threshold_shares(bank), [0.9, math.nan])


OTHER = {"force_N": -18.5, "level": ContactLevel.CONTACT}
ARROWS = [
    ({}, "link2", 0.2, -0.185, RED, "COLLISION link 2: 18.5 N at 0.20 m"),
    (OTHER, "link2", 0.2, 0.185, YELLOW, "CONTACT link 2: 18.5 N at 0.20 m"),
    ({"link": 1, "location": Location.LINK_1, "force_N": 4.0}, "link1", 0.35, -0.05, RED, "COLLISION link 1: ≥ 4.0 N"),
    # the paper's scheme seeks no place: the torque gives the force
    ({"location": Location.NOT_SOUGHT, "force_N": 0.0}, "link2", 0.3, 0.05, RED, "COLLISION link 2: ≥ 5.0 N"),
    # arrows stay in sight, and on the link
    ({"force_N": 0.0}, "link2", 0.2, 0.05, RED, "COLLISION link 2: 0.0 N at 0.20 m"),
    ({"force_N": 1000.0}, "link2", 0.2, -0.6, RED, "COLLISION link 2: 1000.0 N at 0.20 m"),
    ({"lever_m": -0.05}, "link2", 0.0, -0.185, RED, "COLLISION link 2: 18.5 N at -0.05 m"),
    ({"lever_m": 0.5}, "link2", 0.3, -0.185, RED, "COLLISION link 2: 18.5 N at 0.50 m"),
]


@pytest.mark.parametrize(("changes", "frame_id", "x_m", "tail_m", "color", "text"), ARROWS)
def test_a_force_is_an_arrow_that_ends_on_its_link(changes, frame_id, x_m, tail_m, color, text):
    (contact,) = drawn(draw_contact(SHAPE, PUSH._replace(**changes)))
    (arrow,) = contact.arrows
    assert (contact.id, contact.frame_id, contact.texts[0].text) == ("contact", frame_id, text)
    assert contact.lifetime.sec * 1_000_000_000 + contact.lifetime.nanosec == ARROW_LIFETIME_NS
    assert (arrow.pose.position.x, arrow.pose.position.y) == pytest.approx((x_m, tail_m))
    assert arrow.shaft_length + arrow.head_length == pytest.approx(abs(tail_m))
    assert arrow.shaft_length >= 0.6 * abs(tail_m) - 1e-12
    turned = -math.copysign(math.sqrt(0.5), tail_m)
    assert (arrow.pose.orientation.z, arrow.pose.orientation.w) == pytest.approx((turned, math.sqrt(0.5)))
    assert rgba(arrow) == color
