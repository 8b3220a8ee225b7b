"""The table of topics: types that others can parse, and bodies that are laid out as their types say."""

import struct

import numpy as np
import pytest
from mcap_ros2._dynamic import generate_dynamic
from recorded_run import CODEC

from adacd_hil.log.log_files import LogError
from adacd_hil.log.types.message_types import (
    ENCAPSULATION,
    Member,
    number_type,
    payload_dtype,
    ros_field_name,
    ros_message_name,
)
from adacd_hil.log.types.topics import (
    ChannelId,
    pack_arm,
    run_channels,
)
from adacd_hil.log.types.truth_topic import truth_channels
from adacd_hil.records import (
    ArmState,
    FaultReason,
    SchemeState,
)

CHANNELS = (*run_channels(9, tuple(CODEC.messages.values())), *truth_channels())
STAMP = struct.pack("<II", 12, 34)


def decode(channel_id, body):
    channel = next(channel for channel in CHANNELS if channel.id == channel_id)
    return generate_dynamic(channel.type.name, channel.type.text)[channel.type.name](ENCAPSULATION + STAMP + body)


def test_fields_and_messages_are_spelled_as_ros_demands():
    fields = {"tau_J": "tau_j", "F_v1": "f_v1", "q": "q", "TorqueNm": "torque_nm", "_a__b_": "a_b", "2nd": "n2nd"}
    assert {name: ros_field_name(name) for name in fields} == fields
    messages = {"Drive1Feedback": "Drive1Feedback", "DRIVE1_feedback": "DRIVE1Feedback", "sync": "Sync"}
    assert {name: ros_message_name(name) for name in messages} == messages


def test_two_fields_with_one_ros_name_are_refused():
    with pytest.raises(LogError, match="two fields are named p in ROS"):
        number_type("a/msg/B", (Member("P", "float64"), Member("p", "float64")))


def test_the_layout_of_a_type_is_aligned_as_cdr_demands():
    text = number_type(
        "a/msg/B", (Member("u", "uint8"), Member("f", "float64", 2), Member("s", "int16"), Member("i", "int32"))
    ).text
    layout = payload_dtype(text)
    offsets = {name: layout.fields[name][1] for name in layout.names}
    assert offsets == {"sec": 4, "nanosec": 8, "u": 12, "f": 20, "s": 36, "i": 40}
    assert layout.itemsize == 44


@pytest.mark.parametrize(
    ("sampled_ns", "age_ns"),
    [(6_500_000, 2_500_000), (9_000_001, -1), (None, 0)],
    ids=["own", "clock set back", "none"],
)
def test_arm_is_laid_out_as_its_type_says_with_the_age_of_its_sample(sampled_ns, age_ns):
    joints = np.array([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]])
    ages = (4, 5), (6, 2**33)
    arm = ArmState(2**40, 9_000_000, 3, *joints, *ages, True, False, FaultReason.DATA_AGE, True, 7, sampled_ns)
    message = decode(ChannelId.ARM, pack_arm(arm, 17))
    assert (message.cycle, message.first_cycle, message.periods, message.steps) == (2**40, 17, 3, 7)
    assert (message.age_q, message.age_tau_j, message.sample_age_ns) == ([4, 5], [6, 2**33], age_ns)
    assert (message.is_enabled, message.is_complete, message.fault, message.is_late) == (True, False, 1, True)


def test_states_are_named_before_the_field_that_holds_them():
    text = next(channel.type.text for channel in CHANNELS if channel.id == ChannelId.SCHEME)
    lines = text.splitlines()
    state = next(index for index, line in enumerate(lines) if line.startswith("uint8 state "))
    assert lines[state - len(SchemeState) : state] == [f"uint8 STATE_{s.name}={s.value}" for s in SchemeState]
