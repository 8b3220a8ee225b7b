"""The table of topics: what a log holds, under which type, how often, and how each message is packed.

The control side packs *bodies*: what follows the stamp. The writer puts encapsulation and stamp in front, the same
for all messages of a cycle: stamp = t_ns + epoch_ns. A block is logged as its bytes.

| topic | type | when |
|---|---|---|
| /to_can_bus, /from_can_bus | can_msgs/msg/Frame | every frame of up to 8 bytes, error frames too |
| /to_can_bus_fd, /from_can_bus_fd | ros2_socketcan_msgs/msg/FdFrame | every longer frame |
| /decoded/<DBC message> | adacd_hil_msgs/msg/<DBC message> | every frame that the DBC knows |
| /joint_states | sensor_msgs/msg/JointState | every cycle; measured q, dq, tau_J |
| /scheme | adacd_hil_msgs/msg/Scheme | every cycle; records.scheme_layout or certified_layout |
| /contact | adacd_hil_msgs/msg/Contact | when a report begins and when it is final |
| /control | adacd_hil_msgs/msg/Control | every cycle; records.CONTROL_LAYOUT |
| /cycle | adacd_hil_msgs/msg/Cycle | every cycle; records.CycleRecord |
| /frame_checks | adacd_hil_msgs/msg/FrameChecks | once a second: what the checks said of each device's cyclic frames |
| /events | foxglove_msgs/msg/Log | when something happens |
| /truth | adacd_hil_msgs/msg/Truth | every cycle, in the emulator's own log; records.TRUTH_LAYOUT |
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
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
    TRUTH_LAYOUT,
    ContactKind,
    ContactLevel,
    ContactReport,
    CycleRecord,
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
from adacd_hil.wire.codec_columns import MessageTable
from adacd_hil.wire.e2e import E2eStatus

PACKAGE = "adacd_hil_msgs/msg"
DECODED = "/decoded/"
EVENTS_TOPIC = "/events"


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
    DECODED_FIRST = 16  # and up: the messages of the DBC, in its order


@dataclass(frozen=True)
class LogChannel:
    """One topic."""

    id: int
    topic: str
    type: MessageType


def _constants(prefix: str, values: type[IntEnum]) -> tuple[tuple[str, int], ...]:
    return tuple((f"{prefix}_{value.name}", int(value)) for value in values)


def _members(layout: Layout) -> tuple[Member, ...]:
    """Describe the fields of a float64 block."""
    return tuple(Member(field.name, "float64", field.size, field.unit, field.meaning) for field in layout.fields)


_CYCLE_NUMBER = Member("cycle", "uint64", meaning="number of the cycle")
_SCHEME = (
    _CYCLE_NUMBER,
    Member("state", "uint8", meaning="SchemeState", constants=_constants("STATE", SchemeState)),
    Member("previous_state", "uint8", meaning="SchemeState of the cycle before"),
    Member("fault", "uint8", meaning="FaultReason", constants=_constants("FAULT", FaultReason)),
    Member("request", "uint8", meaning="Request", constants=_constants("REQUEST", Request)),
    Member("contact_joints", "uint8", meaning="bit i: joint i over the threshold"),
    Member("is_model_valid", "bool", meaning="theta_hat may be fed forward"),
)
_CONTACT = (
    _CYCLE_NUMBER,
    Member("link", "uint8", meaning="link that was touched"),
    Member("direction", "int8", 2, meaning="sign of the external torque, 0 below the threshold"),
    Member("is_final", "bool", meaning="the isolation window has ended"),
    Member("tau_ext_peak", "float64", 2, "Nm", "largest external torque, filter undone"),
    Member("impulse", "float64", 2, "Nm s", "integral of the external torque"),
    Member("level", "uint8", meaning="ContactLevel", constants=_constants("LEVEL", ContactLevel)),
    Member("kind", "uint8", meaning="ContactKind", constants=_constants("KIND", ContactKind)),
    Member("reaction", "uint8", meaning="Reaction", constants=_constants("REACTION", Reaction)),
    Member("location", "uint8", meaning="Location", constants=_constants("LOCATION", Location)),
    Member("is_two_sided", "bool", meaning="something has pushed from the other side too"),
    Member("tau_ext_peak_sigma", "float64", 2, "Nm", "standard deviation, inf: not known"),
    Member("impulse_sigma", "float64", 2, "Nm s", "standard deviation, inf: not known"),
    Member("force_N", "float64", unit="N", meaning="at right angles to the link"),
    Member("force_sigma", "float64", unit="N", meaning="standard deviation, inf: not known"),
    Member("lever_m", "float64", unit="m", meaning="from joint 2"),
    Member("lever_sigma", "float64", unit="m", meaning="standard deviation, inf: not known"),
    Member("blind_rad", "float64", unit="rad", meaning="nearer to link 2's axis a force reads as one on link 1"),
)
_CONTACT_KINDS: dict[str, Callable[[int], IntEnum]] = {
    "level": ContactLevel,
    "kind": ContactKind,
    "reaction": Reaction,
    "location": Location,
}
_CONTROL = (
    _CYCLE_NUMBER,
    Member("gate_flags", "uint8", meaning="limits that acted, one bit each"),
    Member("enable", "bool", meaning="drives are asked to be enabled"),
    Member("quick_stop", "bool", meaning="drives are asked for a quick stop"),
)
_CYCLE = (
    _CYCLE_NUMBER,
    Member("lateness_ns", "int64", unit="ns", meaning="wake-up after the grid point"),
    Member("feedback_ns", "int64", unit="ns", meaning="SYNC sent to last frame decoded"),
    Member("command_ns", "int64", unit="ns", meaning="SYNC sent to last command handed to the bus"),
    Member("compute_ns", "int64", unit="ns", meaning="last cyclic frame received to last command handed to the bus"),
    Member("slack_ns", "int64", unit="ns", meaning="last command to the next grid point; negative: overrun"),
    Member("data_age", "uint64", meaning="age of the oldest value that was used, cycles"),
    Member("overruns", "uint64", meaning="periods skipped since the run began"),
    Member("frames_missing", "uint64", meaning="cyclic frames that did not arrive or failed their checks"),
    Member("commands_late", "uint64", meaning="commands of the cycle before that missed this SYNC and act at the next"),
    Member("frames_lost", "uint64", meaning="received frames that the kernel dropped since the run began"),
    Member("receive_queue_bytes", "uint64", meaning="waits to be received, bytes of the kernel's memory"),
    Member("transmit_queue_bytes", "uint64", meaning="waits to be sent, bytes of the kernel's memory"),
    Member("log_queue_bytes", "uint64", meaning="waits for the log's writer, bytes"),
)
_DEVICES = ("drive1", "drive2", "sensor1", "sensor2")
_FRAME_CHECKS = (
    _CYCLE_NUMBER,
    *(
        Member(f"{device}_checks", "uint64", len(E2eStatus), meaning="frames so far, by E2eStatus", constants=constants)
        for device, constants in zip(_DEVICES, (_constants("E2E", E2eStatus), (), (), ()), strict=True)
    ),
    Member("implausible", "uint64", len(_DEVICES), meaning="frames so far that failed their plausibility check"),
)
_TRUTH = (_CYCLE_NUMBER,)

_SCHEME_HEAD = body_struct(_SCHEME, has_block=True)
_CONTACT_BODY = body_struct(_CONTACT)
_CONTROL_HEAD = body_struct(_CONTROL, has_block=True)
_CYCLE_BODY = body_struct(_CYCLE)
_FRAME_CHECKS_BODY = body_struct(_FRAME_CHECKS)
_TRUTH_HEAD = body_struct(_TRUTH, has_block=True)
SCHEME_BLOCK = _SCHEME_HEAD.size
"""Where the block begins in the body of /scheme, bytes."""


def run_channels(
    parameter_count: int, messages: tuple[MessageTable, ...] = (), further_count: int = 0, channel_count: int = 0
) -> tuple[LogChannel, ...]:
    """List the topics of a run for `parameter_count` dynamic parameters and the DBC's messages.

    further_count, channel_count: of the certified scheme, see `records.certified_layout`; 0 for the paper's.
    """
    layout = certified_layout(parameter_count, further_count, channel_count)
    scheme = (*_SCHEME, *_members(layout if channel_count else scheme_layout(parameter_count)))
    control = (*_CONTROL, *_members(CONTROL_LAYOUT))
    own = (
        LogChannel(ChannelId.TO_CAN_BUS, "/to_can_bus", CAN_FRAME),
        LogChannel(ChannelId.FROM_CAN_BUS, "/from_can_bus", CAN_FRAME),
        LogChannel(ChannelId.TO_CAN_BUS_FD, "/to_can_bus_fd", FD_FRAME),
        LogChannel(ChannelId.FROM_CAN_BUS_FD, "/from_can_bus_fd", FD_FRAME),
        LogChannel(ChannelId.JOINT_STATES, "/joint_states", JOINT_STATE),
        LogChannel(ChannelId.SCHEME, "/scheme", number_type(f"{PACKAGE}/Scheme", scheme)),
        LogChannel(ChannelId.CONTACT, "/contact", number_type(f"{PACKAGE}/Contact", _CONTACT)),
        LogChannel(ChannelId.CONTROL, "/control", number_type(f"{PACKAGE}/Control", control)),
        LogChannel(ChannelId.CYCLE, "/cycle", number_type(f"{PACKAGE}/Cycle", _CYCLE)),
        LogChannel(ChannelId.FRAME_CHECKS, "/frame_checks", number_type(f"{PACKAGE}/FrameChecks", _FRAME_CHECKS)),
        LogChannel(ChannelId.EVENTS, "/events", LOG),
    )
    decoded = tuple(
        _decoded_channel(ChannelId.DECODED_FIRST + index, message) for index, message in enumerate(messages)
    )
    _check_names((*own, *decoded))
    return (*own, *decoded)


def truth_channels() -> tuple[LogChannel, ...]:
    """List the topics of the emulator's own log."""
    truth = number_type(f"{PACKAGE}/Truth", (*_TRUTH, *_members(TRUTH_LAYOUT)))
    return (LogChannel(ChannelId.TRUTH, "/truth", truth), LogChannel(ChannelId.EVENTS, "/events", LOG))


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
    """Pack the body of /scheme."""
    return (
        _SCHEME_HEAD.pack(
            output.cycle,
            output.state,
            output.previous_state,
            output.fault,
            request,
            output.contact_joints,
            output.is_model_valid,
        )
        + output.block.tobytes()
    )


def pack_contact(report: ContactReport) -> bytes:
    """Pack the body of /contact."""
    values = (value if isinstance(value, tuple) else (value,) for value in report)
    by_name = dict(zip(report._fields, values, strict=True))
    return _CONTACT_BODY.pack(*(value for member in _CONTACT for value in by_name[member.name]))


def unpack_contact(body: bytes) -> ContactReport:
    """Unpack the body of /contact. Raises struct.error when it is cut, ValueError for a value that has no name."""
    values = iter(_CONTACT_BODY.unpack_from(body))
    fields: dict[str, Any] = {}
    for member in _CONTACT:
        if member.size > 1:
            fields[member.name] = tuple(itertools.islice(values, member.size))
        else:
            kind = _CONTACT_KINDS.get(member.name)
            fields[member.name] = next(values) if kind is None else kind(next(values))
    return ContactReport(**fields)


def pack_control(cycle: int, block: Vector, gate_flags: int, enable: bool, quick_stop: bool) -> bytes:
    """Pack the body of /control; `block` is laid out by CONTROL_LAYOUT."""
    return _CONTROL_HEAD.pack(cycle, gate_flags, enable, quick_stop) + block.tobytes()


def pack_cycle(record: CycleRecord) -> bytes:
    """Pack the body of /cycle."""
    return _CYCLE_BODY.pack(*record)


def pack_frame_checks(checks: FrameChecks) -> bytes:
    """Pack the body of /frame_checks."""
    counts = [count for device in checks.counts for count in device]
    return _FRAME_CHECKS_BODY.pack(checks.cycle, *counts, *checks.implausible)


def pack_truth(cycle: int, block: Vector) -> bytes:
    """Pack the body of /truth; `block` is laid out by TRUTH_LAYOUT."""
    return _TRUTH_HEAD.pack(cycle) + block.tobytes()
