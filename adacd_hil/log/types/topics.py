"""The topics of a log, each declared once: its number, name, fields, and how a message of it is packed.

A topic is added here, by an `OwnTopic` in RUN_TOPICS, and where its messages are made. Schema, channel, reader, check,
export and live view follow from the declaration. A field of /scheme is added to `records.scheme_layout`, or to the head
of SCHEME and to `records.SchemeOutput`.

The control side packs *bodies*: a message without its stamp. The writer puts encapsulation and stamp in front, the same
for all messages of a cycle: stamp = t_ns + epoch_ns. A block is logged as its bytes.

| topic | type | when |
|---|---|---|
| /to_can_bus, /from_can_bus | can_msgs/msg/Frame | every frame of up to 8 bytes, error frames too |
| /to_can_bus_fd, /from_can_bus_fd | ros2_socketcan_msgs/msg/FdFrame | every longer frame |
| /decoded/<DBC message> | adacd_hil_msgs/msg/<DBC message> | every frame that the DBC knows |
| /joint_states | sensor_msgs/msg/JointState | every cycle; measured q, dq, tau_J |
| /scheme | adacd_hil_msgs/msg/Scheme | every cycle; records.scheme_layout or certified_layout |
| /arm | adacd_hil_msgs/msg/ArmState | every cycle; records.ArmState but for q, dq, tau_J, which /scheme has |
| /contact | adacd_hil_msgs/msg/Contact | each report of a contact, from its detection until one is final |
| /control | adacd_hil_msgs/msg/Control | every cycle; records.CONTROL_LAYOUT |
| /cycle | adacd_hil_msgs/msg/Cycle | every cycle; records.CycleRecord |
| /frame_checks | adacd_hil_msgs/msg/FrameChecks | once a second: counts of the checks of each device's cyclic frames |
| /events | foxglove_msgs/msg/Log | when something happens |
| /truth | adacd_hil_msgs/msg/Truth | every cycle, in the emulator's own log; truth_topic.TRUTH_LAYOUT |
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Any

from adacd_hil.log.log_files import LogError
from adacd_hil.log.types.message_types import (
    CAN_FRAME,
    FD_FRAME,
    JOINT_STATE,
    LOG,
    Member,
    MessageType,
    body_struct,
    number_type,
    ros_message_name,
)
from adacd_hil.records import (
    CONTROL_LAYOUT,
    ArmState,
    ContactKind,
    ContactLevel,
    ContactReport,
    FaultReason,
    FrameChecks,
    Layout,
    Location,
    Reaction,
    Request,
    SchemeOutput,
    SchemeState,
    Vector,
    certified_layout,
    scheme_layout,
)
from adacd_hil.wire.e2e import E2eStatus
from adacd_hil.wire.message_table import MessageTable

PACKAGE = "adacd_hil_msgs/msg"
DECODED = "/decoded/"


class ChannelId(IntEnum):
    """Numbers of the topics between control process and writer; in the file they may differ."""

    TO_CAN_BUS = 1
    FROM_CAN_BUS = 2
    JOINT_STATES = 3
    SCHEME = 4
    CONTACT = 5
    CONTROL = 6
    CYCLE = 7
    EVENTS = 8
    TRUTH = 9
    TO_CAN_BUS_FD = 10
    FROM_CAN_BUS_FD = 11
    FRAME_CHECKS = 12
    ARM = 13
    DECODED_FIRST = 16  # and up: the messages of the DBC, in its order


@dataclass(frozen=True)
class LogChannel:
    """One topic of a file. id: our number of it, `ChannelId`; the file's may differ."""

    id: int
    topic: str
    type: MessageType


@dataclass(frozen=True)
class OwnTopic:
    """A topic of ours.

    type: of its messages; a name makes it a type of our own. head: the fields that a message of that type begins with.
    block: lays out the float64 values that follow, by the counts that `channel` gets. rate_Hz: of the live view; 0:
    every message is shown.
    """

    id: int
    name: str
    type: MessageType | str
    head: tuple[Member, ...] = ()
    block: Callable[[int, int, int], Layout] | None = None
    rate_Hz: int = 0

    def channel(self, parameter_count: int = 0, further_count: int = 0, channel_count: int = 0) -> LogChannel:
        """Return the topic as a channel of a file, with its message type.

        The counts size the block of /scheme, see `records.certified_layout`; a topic without such a block needs none.
        Raises LogError if two fields have one name in ROS.
        """
        if isinstance(self.type, MessageType):
            return LogChannel(self.id, self.name, self.type)
        fields = self.block(parameter_count, further_count, channel_count).fields if self.block is not None else ()
        members = (Member(field.name, "float64", field.size, field.unit, field.meaning) for field in fields)
        return LogChannel(self.id, self.name, number_type(f"{PACKAGE}/{self.type}", (*self.head, *members)))

    @cached_property
    def body(self) -> struct.Struct:
        """The struct that packs a message's head behind the stamp, with padding up to a block if one follows."""
        return body_struct(self.head, has_block=self.block is not None)

    @cached_property
    def _has_arrays(self) -> bool:
        return any(member.size > 1 for member in self.head)

    def pack(self, *values: Any, block: Vector | None = None) -> bytes:
        """Return a message as bytes, without the stamp that the writer adds.

        values: fields of the head, in its order. block: the float64 values that follow it. Raises struct.error for a
        wrong number or type of values; in a topic with array fields ValueError for a wrong number.
        """
        if self._has_arrays:
            pairs = zip(self.head, values, strict=True)
            values = tuple(number for member, value in pairs for number in (value if member.size > 1 else (value,)))
        packed = self.body.pack(*values)
        return packed if block is None else packed + block.tobytes()


CYCLE_NUMBER = Member("cycle", "uint64", meaning="number of the cycle")
_FRAME_RATE_HZ = 10


def _choice(name: str, values: type[IntEnum]) -> Member:
    return Member(name, "uint8", meaning=values.__name__, values=values)


TO_CAN_BUS = OwnTopic(ChannelId.TO_CAN_BUS, "/to_can_bus", CAN_FRAME, rate_Hz=_FRAME_RATE_HZ)
FROM_CAN_BUS = OwnTopic(ChannelId.FROM_CAN_BUS, "/from_can_bus", CAN_FRAME, rate_Hz=_FRAME_RATE_HZ)
TO_CAN_BUS_FD = OwnTopic(ChannelId.TO_CAN_BUS_FD, "/to_can_bus_fd", FD_FRAME, rate_Hz=_FRAME_RATE_HZ)
FROM_CAN_BUS_FD = OwnTopic(ChannelId.FROM_CAN_BUS_FD, "/from_can_bus_fd", FD_FRAME, rate_Hz=_FRAME_RATE_HZ)
JOINT_STATES = OwnTopic(ChannelId.JOINT_STATES, "/joint_states", JOINT_STATE, rate_Hz=50)
"""The writer makes it of /scheme."""
SCHEME = OwnTopic(
    ChannelId.SCHEME,
    "/scheme",
    "Scheme",
    head=(
        CYCLE_NUMBER,
        _choice("state", SchemeState),
        Member("previous_state", "uint8", meaning="SchemeState of the cycle before"),
        _choice("fault", FaultReason),
        _choice("request", Request),
        Member("contact_joints", "uint8", meaning="bit i: joint i + 1 over the threshold"),
        Member("is_model_valid", "bool", meaning="theta_hat may be fed forward"),
    ),
    block=lambda *counts: certified_layout(*counts) if counts[-1] else scheme_layout(counts[0]),
    rate_Hz=50,
)
ARM = OwnTopic(
    ChannelId.ARM,
    "/arm",
    "ArmState",
    head=(
        CYCLE_NUMBER,
        Member("first_cycle", "uint64", meaning="number of the cycle with which this attempt began"),
        Member("periods", "int64", meaning="since the cycle before, 1 unless some were skipped"),
        Member("steps", "int64", meaning="periods from the last complete sample to this one; 0: it is not complete"),
        Member("sample_age_ns", "int64", unit="ns", meaning="from the SYNC of the sample to this cycle's"),
        Member("age_q", "int64", 2, meaning="cycles since the position was sampled"),
        Member("age_tau_J", "int64", 2, meaning="cycles since the torque was sampled"),
        Member("is_enabled", "bool", meaning="both drives produce the commanded torque"),
        Member("is_complete", "bool", meaning="q, dq and tau_J are a new sample of one SYNC"),
        Member("fault", "uint8", meaning="FaultReason of the arm, before the scheme", values=FaultReason),
        Member("is_late", "bool", meaning="the host has skipped so many periods that the arm is to be held"),
    ),
    rate_Hz=20,
)
"""With q, dq and tau_J of /scheme all that the scheme is given in a cycle, but for the request."""
CONTACT = OwnTopic(
    ChannelId.CONTACT,
    "/contact",
    "Contact",
    head=(
        CYCLE_NUMBER,
        Member("link", "uint8", meaning="link that was touched"),
        Member("direction", "int8", 2, meaning="sign of the external torque, 0 below the threshold"),
        Member("is_final", "bool", meaning="last report of the contact"),
        Member("tau_ext_peak", "float64", 2, "Nm", "largest external torque, filter undone"),
        Member("impulse", "float64", 2, "Nm s", "integral of the external torque"),
        _choice("level", ContactLevel),
        _choice("kind", ContactKind),
        _choice("reaction", Reaction),
        _choice("location", Location),
        Member("is_two_sided", "bool", meaning="something has pushed from the other side too"),
        Member("tau_ext_peak_sigma", "float64", 2, "Nm", "standard deviation, inf: not known"),
        Member("impulse_sigma", "float64", 2, "Nm s", "standard deviation, inf: not known"),
        Member("force_N", "float64", unit="N", meaning="at right angles to the link"),
        Member("force_sigma", "float64", unit="N", meaning="standard deviation, inf: not known"),
        Member("lever_m", "float64", unit="m", meaning="from joint 2"),
        Member("lever_sigma", "float64", unit="m", meaning="standard deviation, inf: not known"),
        Member("blind_rad", "float64", unit="rad", meaning="nearer to link 2's axis a force reads as one on link 1"),
    ),
)
CONTROL = OwnTopic(
    ChannelId.CONTROL,
    "/control",
    "Control",
    head=(
        CYCLE_NUMBER,
        Member("gate_flags", "uint8", meaning="limits that acted, one bit each"),
        Member("enable", "bool", meaning="drives are asked to be enabled"),
        Member("quick_stop", "bool", meaning="drives are asked for a quick stop"),
    ),
    block=lambda *_: CONTROL_LAYOUT,
    rate_Hz=50,
)
CYCLE = OwnTopic(
    ChannelId.CYCLE,
    "/cycle",
    "Cycle",
    head=(
        CYCLE_NUMBER,
        Member("lateness_ns", "int64", unit="ns", meaning="wake-up after the grid point"),
        Member("feedback_ns", "int64", unit="ns", meaning="SYNC sent to last frame decoded"),
        Member("command_ns", "int64", unit="ns", meaning="SYNC sent to last command handed to the bus"),
        Member(
            "compute_ns", "int64", unit="ns", meaning="last cyclic frame received to last command handed to the bus"
        ),
        Member("slack_ns", "int64", unit="ns", meaning="last command to the next grid point; negative: overrun"),
        Member("data_age", "uint64", meaning="age of the oldest value that was used, cycles"),
        Member("overruns", "uint64", meaning="periods skipped since the run began"),
        Member("frames_missing", "uint64", meaning="cyclic frames that did not arrive or failed their checks"),
        Member(
            "commands_late", "uint64", meaning="commands of the cycle before that missed this SYNC and act at the next"
        ),
        Member("frames_lost", "uint64", meaning="received frames that the kernel dropped since the run began"),
        Member("receive_queue_bytes", "uint64", meaning="waits to be received, bytes of the kernel's memory"),
        Member("transmit_queue_bytes", "uint64", meaning="waits to be sent, bytes of the kernel's memory"),
        Member("log_queue_bytes", "uint64", meaning="waits for the log's writer, bytes"),
    ),
    rate_Hz=20,
)
_DEVICES = ("drive1", "drive2", "sensor1", "sensor2")
FRAME_CHECKS = OwnTopic(
    ChannelId.FRAME_CHECKS,
    "/frame_checks",
    "FrameChecks",
    head=(
        CYCLE_NUMBER,
        *(
            Member(f"{device}_checks", "uint64", len(E2eStatus), "", "frames so far, by E2eStatus", values, "E2E")
            for device, values in zip(_DEVICES, (E2eStatus, None, None, None), strict=True)
        ),
        Member("implausible", "uint64", len(_DEVICES), meaning="frames so far that failed their plausibility check"),
    ),
)
EVENTS = OwnTopic(ChannelId.EVENTS, "/events", LOG)
CERTIFIED_MODEL = "certified model"
"""Name of the events at the end of an attempt with a certificate each, as JSON."""
RUN_TOPICS = (
    TO_CAN_BUS,
    FROM_CAN_BUS,
    TO_CAN_BUS_FD,
    FROM_CAN_BUS_FD,
    JOINT_STATES,
    SCHEME,
    ARM,
    CONTACT,
    CONTROL,
    CYCLE,
    FRAME_CHECKS,
    EVENTS,
)
"""The topics of a run, in the order of the file; those of the DBC's messages follow."""


def run_channels(
    parameter_count: int, messages: tuple[MessageTable, ...] = (), further_count: int = 0, channel_count: int = 0
) -> tuple[LogChannel, ...]:
    """Return the topics of a run as channels of a file, for `parameter_count` parameters and the DBC's messages.

    further_count, channel_count: of the certified scheme, see `records.certified_layout`; 0 for the paper's. Raises
    LogError if two types share a name, or two fields of one.
    """
    own = tuple(topic.channel(parameter_count, further_count, channel_count) for topic in RUN_TOPICS)
    decoded = tuple(
        _decoded_channel(ChannelId.DECODED_FIRST + index, message) for index, message in enumerate(messages)
    )
    _check_names((*own, *decoded))
    return (*own, *decoded)


def _decoded_channel(channel_id: int, message: MessageTable) -> LogChannel:
    members = (Member(signal.name, "float64", unit=signal.unit) for signal in message.signals)
    message_type = number_type(f"{PACKAGE}/{ros_message_name(message.name)}", members)
    return LogChannel(channel_id, DECODED + message.name, message_type)


def _check_names(channels: tuple[LogChannel, ...]) -> None:
    """Raise LogError when two different types carry one name: a viewer would take one for the other."""
    texts: dict[str, str] = {}
    for channel in channels:
        if texts.setdefault(channel.type.name, channel.type.text) != channel.type.text:
            raise LogError(f"{channel.topic}: the type name {channel.type.name} is taken")


def pack_scheme(output: SchemeOutput, request: Request) -> bytes:
    """Return a /scheme message as bytes, without the stamp that the writer adds."""
    o = output
    head = (o.cycle, o.state, o.previous_state, o.fault, request, o.contact_joints, o.is_model_valid)
    return SCHEME.pack(*head, block=o.block)


def pack_arm(arm: ArmState, first_cycle: int) -> bytes:
    """Return an /arm message as bytes, without the stamp; first_cycle: number of the attempt's first cycle.

    It lacks q, dq and tau_J, which /scheme has.
    """
    cycle, t_ns, periods, _, _, _, age_q, age_tau_J, is_enabled, is_complete, fault, is_late, steps, sampled_ns = arm
    age_ns = 0 if sampled_ns is None else t_ns - sampled_ns
    ages = (*age_q, *age_tau_J)
    return ARM.body.pack(cycle, first_cycle, periods, steps, age_ns, *ages, is_enabled, is_complete, fault, is_late)


def pack_contact(report: ContactReport) -> bytes:
    """Return a /contact message as bytes, without the stamp."""
    return CONTACT.pack(*(getattr(report, member.name) for member in CONTACT.head))


def pack_frame_checks(checks: FrameChecks) -> bytes:
    """Return a /frame_checks message as bytes, without the stamp."""
    return FRAME_CHECKS.pack(checks.cycle, *checks.counts, checks.implausible)
