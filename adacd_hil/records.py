"""Values that cross a layer: measurements, decisions, commands, and how each cycle went.

Wide per-cycle values live in float64 *blocks*: one contiguous array whose fields a `Layout` names. The compiled
step fills a block, the log stores its bytes as they are, replay compares them bit for bit.

Symbols: q, dq rad and rad/s; tau_J measured joint torque, positive drives +q, Nm; tau_ext_hat estimated external
torque, positive when the environment pushes toward +q, Nm; theta_hat dynamic parameters in the order of
`PARAMETER_NAMES`. All joint vectors are float64 (2,).
"""

import math
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Annotated, Final, NamedTuple, Self, get_type_hints

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

JOINTS = 2
JOINT_NAMES = ("joint1", "joint2")
GRAVITY_M_S2 = 9.80665
"""Standard acceleration of gravity. Source: 3rd CGPM, 1901."""
QUINTIC_PEAK_SPEED, QUINTIC_PEAK_ACCELERATION = 1.875, 10.0 / math.sqrt(3.0)
"""Of a rest-to-rest quintic: peak speed over travel / duration, peak acceleration over travel / duration²."""

PARAMETER_NAMES = ("a1", "a2", "a3", "F_v1", "F_v2", "F_c1", "F_c2")
"""Eq. (19): inertia kg m², viscous friction Nm s/rad, Coulomb friction Nm."""
GRAVITY_PARAMETER_NAMES = ("a4", "a5")
"""Appended where the joint axes are not vertical; Nm."""
POSITION_TERMS = ("sin_q", "cos_q", "sin_2q", "cos_2q", "sin_sum", "cos_sum")
"""Torque that depends on the joint position, one parameter per joint each, of `arm.position_torque_Nm`."""
FRICTION_SPEEDS_RAD_S = (0.2, 0.6, 1.2)
"""Speeds at which friction is compared: in the sum, errors of viscous and Coulomb friction can't hide each other."""
FRICTION_AT_RAD_S = FRICTION_SPEEDS_RAD_S[1]
"""The one of these speeds for which people are shown friction."""
FRICTION_AT = slice(FRICTION_SPEEDS_RAD_S.index(FRICTION_AT_RAD_S), None, len(FRICTION_SPEEDS_RAD_S))
"""Its places in friction at these speeds, joint by joint."""
_JOINT_UNITS = {
    "F_v": "Nm s/rad",
    "F_c": "Nm",
    "offset": "Nm",
    "lag": "s",
    "stribeck": "Nm",
    "load": "Nm/Nm",
    "asymmetric": "Nm",
    "width": "Nm",
    "dahl_short": "Nm",
    "dahl_long": "Nm",
    "cross_talk": "Nm/Nm",
    **dict.fromkeys(POSITION_TERMS, "Nm"),
}
PARAMETER_UNITS = {
    **dict.fromkeys(("a1", "a2", "a3"), "kg m²"),
    **dict.fromkeys(GRAVITY_PARAMETER_NAMES, "Nm"),
    **{f"{name}{joint + 1}": unit for name, unit in _JOINT_UNITS.items() for joint in range(JOINTS)},
}


class Field(NamedTuple):
    """One field of a block: name, number of values, unit, meaning."""

    name: str
    size: int
    unit: str
    meaning: str


@dataclass(frozen=True)
class Layout:
    """Names the fields of a float64 block, in order, without gaps."""

    fields: tuple[Field, ...]

    @cached_property
    def slices(self) -> dict[str, slice]:
        """The slice of each field's values in the block, by the field's name, in the block's order."""
        places: dict[str, slice] = {}
        start = 0
        for field in self.fields:
            places[field.name] = slice(start, start + field.size)
            start += field.size
        return places

    @cached_property
    def size(self) -> int:
        """Number of float64 values in a block."""
        return sum(field.size for field in self.fields)


class SchemeBlock:
    """The block of a cycle, one field a line: sizes, unit, meaning.

    Sizes: n joints, p dynamic parameters (7, or 9 with gravity).
    """

    q: Annotated[Vector, "n", "rad", "measured joint position"]
    dq: Annotated[Vector, "n", "rad/s", "measured joint velocity"]
    tau_J: Annotated[Vector, "n", "Nm", "measured joint torque"]
    tau_f: Annotated[Vector, "n", "Nm", "filtered measured torque, eq. (3)"]
    tau_f_hat: Annotated[Vector, "n", "Nm", "its prediction by theta_hat, eq. (7)"]
    tau_f_cad: Annotated[Vector, "n", "Nm", "its prediction by the CAD model"]
    tau_ext_hat: Annotated[Vector, "n", "Nm", "estimated external torque, filtered, eq. (13) with our sign"]
    tau_ext_hat_cad: Annotated[Vector, "n", "Nm", "the same with the CAD model"]
    tau_ext_wide_hat: Annotated[Vector, "n", "Nm", "estimated external torque with the filter undone"]
    theta_hat: Annotated[Vector, "p", "see PARAMETER_UNITS", "estimated parameters"]
    threshold: Annotated[Vector, "n", "Nm", "detection threshold in force, inf while detection is off"]
    quiet_s: Annotated[float, "", "s", "how long eq. (15) has held"]
    excitation: Annotated[float, "", "Nm² s", "smallest eigenvalue of the scaled information matrix of this adaptation"]
    period_s: Annotated[float, "", "s", "measured time since the sample before"]


class CertifiedBlock(SchemeBlock):
    """The block of the certified scheme: the fields of `SchemeBlock`, then its own.

    Sizes: further parameters (offsets, lags, friction terms, cross-talk, torques by place), all parameters, bank:
    joints times channels of the detector bank. tau_f, tau_ext_hat and threshold are those of the slowest filter. The
    bank holds first the smoothed channel of each filter, then the unsmoothed channels of all filters but the slowest.
    """

    tau_ext_bank: Annotated[Vector, "bank", "Nm", "estimated external torque of each channel"]
    threshold_bank: Annotated[Vector, "bank", "Nm", "its threshold in force, inf while detection is off"]
    theta_further: Annotated[Vector, "further", "see PARAMETER_UNITS", "estimated offsets, lags and friction terms"]
    theta_std: Annotated[Vector, "all", "see PARAMETER_UNITS", "how well theta is known"]
    condition: Annotated[float, "", "", "condition number of the scaled information matrix of this adaptation"]
    promotions: Annotated[float, "", "", "refined models that have taken over since the certificate"]
    paper_is_armed: Annotated[float, "", "", "whether the paper's scheme, run beside, has ended its adaptation"]
    paper_tau_ext_hat: Annotated[Vector, "n", "Nm", "its estimated external torque"]
    paper_threshold: Annotated[Vector, "n", "Nm", "its threshold in force, inf while it adapts"]
    paper_theta_hat: Annotated[Vector, "p", "see PARAMETER_UNITS", "its estimated parameters"]


def block_sizes(parameter_count: int, further_count: int = 0, channel_count: int = 0) -> dict[str, int]:
    """Return the number of values of each kind of field by the size's name in the annotations of the blocks' classes.

    A field of one number has the size "", which has no entry. further_count: parameters after the `parameter_count`
    dynamic ones. channel_count: of the detector bank, per joint.
    """
    return {
        "n": JOINTS,
        "p": parameter_count,
        "further": further_count,
        "all": parameter_count + further_count,
        "bank": JOINTS * channel_count,
    }


def _layout(block: type, sizes: dict[str, int]) -> Layout:
    """Return the layout of a class of block, from its annotations: size, unit, meaning. sizes: of `block_sizes`."""
    hints = get_type_hints(block, include_extras=True)
    return Layout(
        tuple(
            Field(name, sizes[size] if size else 1, unit, meaning)
            for name, (size, unit, meaning) in ((name, hint.__metadata__) for name, hint in hints.items())
        )
    )


def scheme_layout(parameter_count: int) -> Layout:
    """Return the layout of `SchemeBlock` for `parameter_count` dynamic parameters (7, or 9 with gravity)."""
    return _layout(SchemeBlock, block_sizes(parameter_count))


def certified_layout(parameter_count: int, further_count: int, channel_count: int) -> Layout:
    """Return the layout of `CertifiedBlock` for so many dynamic parameters, and further ones (offsets, lags, ...).

    channel_count: channels of the detector bank, per joint.
    """
    return _layout(CertifiedBlock, block_sizes(parameter_count, further_count, channel_count))


CONTROL_LAYOUT = Layout(
    (
        Field("q_d", JOINTS, "rad", "desired joint position"),
        Field("dq_d", JOINTS, "rad/s", "desired joint velocity"),
        Field("ddq_d", JOINTS, "rad/s²", "desired joint acceleration"),
        Field("tau_d", JOINTS, "Nm", "desired torque, before the limits"),
        Field("tau_c", JOINTS, "Nm", "commanded torque, after the limits"),
    )
)


class SchemeState(IntEnum):
    """States of the scheme. The comment beside each value says how to leave it; a fault leads from each to FAULT."""

    INIT = 0  # the first complete cycle; or FAULT when it doesn't come
    COMMISSION = 1  # enough complete cycles at rest; or FAULT when they don't come
    ENABLE = 2  # both drives report Operation enabled; a motion, back to COMMISSION; a contact; or FAULT on timeout
    ADAPT = 3  # eq. (15) with excitation proven, or all that a test of the fit needs; a contact; or FAULT on timeout
    MONITOR = 4  # a contact; a late host; evidence against the certificate; the announcement of a payload change
    REACT = 5  # after a collision: at rest; after a contact: it has cleared
    STOPPED = 6  # the user acknowledges, takes the certificate back, or announces or reports a payload change
    PAYLOAD = 7  # the user announces that the payload has been changed; a contact
    FAULT = 8  # latched; the user acknowledges, then INIT
    CERTIFY = 9  # theta frozen, tested on motion not used for the fit; out: certified; refuted; a contact


class Request(IntEnum):
    """A request to a running arm, by the user or by the host's own checks."""

    NONE = 0
    ACKNOWLEDGE = 1  # the collision has been seen to; go on
    PAYLOAD = 2  # park the arm, the payload is about to change
    PAYLOAD_CHANGED = 3  # the payload has changed; adapt again
    FINISH = 4  # end the run: come to rest, then disable the drives
    # Requests of the host's own checks: enter FAULT with the reason of the same name.
    FAULT_TORQUE = 5
    FAULT_FOLLOWING = 6
    FAULT_TAMPERED = 7
    ACCEPT = 8  # the user confirms that the arm is free: adopt the refused sensor zero or the added friction
    RELEARN = 9  # the user confirms that the stopped arm is free, and its model wrong: identify it again
    FAULT_MISCONFIGURED = 10  # of the host's own checks, as the FAULTs above


class Reaction(IntEnum):
    """Reaction of the arm to a contact."""

    NONE = 0  # continues without any change
    STOP = 1  # brakes to rest and holds its place
    WITHDRAW = 2  # moves away along the external torque, then rests
    FLOAT = 3  # gives way: zero torque, friction and gravity compensated, damped
    ADMITTANCE = 4  # moves as a virtual mass with a damper would under the external torque
    SLOW_DOWN = 5  # continues on its path at a fraction of the speed


MOTION_START = SchemeState.ADAPT
"""The times of a run count from its first cycle in this state."""
BEGINNING = SchemeState.INIT, SchemeState.COMMISSION
LEARNING = SchemeState.ADAPT, SchemeState.CERTIFY
REACTING = SchemeState.REACT, SchemeState.STOPPED


class FaultReason(IntEnum):
    """Reason of a FAULT."""

    NONE = 0
    DATA_AGE = 1  # a signal older than its budget
    DRIVE = 2  # a drive left Operation enabled by itself, or reported an error by EMCY
    SENSOR = 3  # a torque sensor reports an error, by its status or by EMCY
    LIMIT = 4  # position or velocity outside the arm's limits
    NOT_A_NUMBER = 5  # a value that is not finite
    COMMISSION_TIMEOUT = 6
    ENABLE_TIMEOUT = 7
    ADAPT_TIMEOUT = 8
    HEARTBEAT = 9  # a device has fallen silent or left Operational
    DEADLINE = 10  # the host has skipped too many periods
    BLIND = 11  # the model has had no fresh sample for too long
    FOREIGN_FRAMES = 12  # another node sends frames that only this host, or only one device of the arm, sends
    TORQUE = 13  # a drive's torque is not the one that was commanded
    FOLLOWING = 14  # the arm doesn't follow the desired motion
    TAMPERED = 15  # a parameter of a device differs from the value that the host wrote
    DETECTOR = 16  # in older logs only: a user's detector in the loop had failed
    MISCONFIGURED = 17  # the first motion contradicts an order, a sign or a scale of the configuration


class ArmState(NamedTuple):
    """Measurements of one cycle, in joint coordinates.

    Ages count cycles since the value was sampled: 0 is this cycle's SYNC. `periods` is the number of periods since the
    previous ArmState, 1 unless the cycle overran. `is_complete`: q, dq and tau_J were sampled on one SYNC, and no
    ArmState before had that sample; where devices answer late it is not this cycle's SYNC. `is_late`: the host has
    skipped so many periods that the arm must stop. `steps`: periods between this sample and the last complete one, 0 if
    it isn't complete. `sampled_ns`: t_ns of the SYNC of the sample; None: of this cycle's SYNC.
    """

    cycle: int
    t_ns: int
    periods: int
    q: Vector
    dq: Vector
    tau_J: Vector
    age_q: tuple[int, ...]
    age_tau_J: tuple[int, ...]
    is_enabled: bool
    is_complete: bool
    fault: FaultReason
    is_late: bool = False
    steps: int = 1
    sampled_ns: int | None = None


class ArmBatch(NamedTuple):
    """ArmStates of n consecutive cycles, as columns.

    cycle, t_ns, periods (n,) int64; q, dq, tau_J (n, 2); age_q, age_tau_J (n, 2) int64; is_enabled, is_complete,
    is_late (n,) bool; fault (n,) uint8 of FaultReason; steps, sampled_ns (n,) int64.
    """

    cycle: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    periods: NDArray[np.int64]
    q: Vector
    dq: Vector
    tau_J: Vector
    age_q: NDArray[np.int64]
    age_tau_J: NDArray[np.int64]
    is_enabled: NDArray[np.bool_]
    is_complete: NDArray[np.bool_]
    fault: NDArray[np.uint8]
    is_late: NDArray[np.bool_]
    steps: NDArray[np.int64]
    sampled_ns: NDArray[np.int64]


class ArmCommand(NamedTuple):
    """Command of one cycle: torque (2,) Nm, Enable operation, Quick stop."""

    tau_c: Vector
    enable: bool
    quick_stop: bool


class ContactLevel(IntEnum):
    """Severity of a contact."""

    CONTACT = 1  # over the lower threshold: clears itself
    COLLISION = 2  # over the upper threshold, or lasting: latched until acknowledged


class ContactKind(IntEnum):
    """Time course of a contact."""

    UNKNOWN = 0  # not classified, or not yet
    PUSH = 1  # slow and lasting, such as a guiding hand or a person who leans on the arm
    HIT = 2  # an impact: rises and falls fast


class Location(IntEnum):
    """Whether contact force and lever arm are known, or the reason why not."""

    NOT_SOUGHT = 0
    KNOWN = 1  # one contact without friction on link 2
    LINK_1 = 2  # only the moment about joint 1 is known; force_N is the smallest force with that moment
    SINGULAR = 3  # in this elbow position both joint torques carry the same information
    UNCERTAIN = 4  # the force is too small against the noise
    BEYOND_TIP = 5  # the lever arm ends past the tip: the payload is touched, or the force is not normal to the link
    INCONSISTENT = 6  # no single normal force on link 2 fits: several contacts, as in a clamp, or friction

    def force_text(self, force_N: float) -> str:
        """Return the text of a force in N, with one decimal: of LINK_1 "≥" and its size; "–" where it is unknown.

        It is known for KNOWN and UNCERTAIN.
        """
        if self in (Location.KNOWN, Location.UNCERTAIN):
            return f"{force_N:.1f}"
        return f"≥ {abs(force_N):.1f}" if self is Location.LINK_1 else "–"


class ContactReport(NamedTuple):
    """A contact, as first detected and then refined until its report is final.

    link: 1 or 2. direction: sign of the external torque per joint, 0 where below the threshold. tau_ext_peak: largest
    external torque with the filter undone, Nm. impulse: integral of the external torque so far, Nm s. Each `_sigma` is
    one standard deviation of the value before it, inf where that is not known. force_N: normal to the link, positive on
    the side of +q; lever_m: its distance from joint 2. blind_rad: a force on link 2 whose angle to the link's axis is
    smaller than this looks like a force on link 1; pi / 2: any force does. Fields from `level` on keep their defaults
    where force and kind are not computed.
    """

    cycle: int
    link: int
    direction: tuple[int, int]
    tau_ext_peak: tuple[float, float]
    impulse: tuple[float, float]
    is_final: bool
    level: ContactLevel = ContactLevel.COLLISION
    kind: ContactKind = ContactKind.UNKNOWN
    reaction: Reaction = Reaction.WITHDRAW
    location: Location = Location.NOT_SOUGHT
    is_two_sided: bool = False  # something pushes from the other side too, as in a clamp
    tau_ext_peak_sigma: tuple[float, float] = (math.inf, math.inf)
    impulse_sigma: tuple[float, float] = (math.inf, math.inf)
    force_N: float = 0.0
    force_sigma: float = math.inf
    lever_m: float = 0.0
    lever_sigma: float = math.inf
    blind_rad: float = 0.5 * math.pi


class SchemeOutput(NamedTuple):
    """Decision of the scheme in one cycle. `block` is laid out by `scheme_layout` or `certified_layout`."""

    cycle: int
    state: SchemeState
    previous_state: SchemeState
    fault: FaultReason
    contact_joints: int  # bit i: joint i, counted from 0, over the threshold
    is_model_valid: bool  # theta_ff may be fed forward
    theta_ff: Vector  # parameters of the last finished adaptation, zeros before; for the feedforward
    tau_ext_hat: Vector
    contact: ContactReport | None  # set in each cycle in which a report is due, the final one last
    block: Vector
    reaction: Reaction = Reaction.NONE  # to the contact of REACT and STOPPED


class CycleRecord(NamedTuple):
    """How one cycle went; times in ns. Not part of the decisions. The queues are 0 in lockstep."""

    cycle: int
    lateness_ns: int  # wake-up after the grid point
    feedback_ns: int  # SYNC sent to last frame decoded
    command_ns: int  # SYNC sent to last command handed to the bus
    compute_ns: int  # last cyclic frame received to last command handed to the bus
    slack_ns: int  # last command handed to the bus to the next grid point; negative: overrun
    data_age: int  # cycles, of the oldest value that was used
    overruns: int  # periods skipped since the run began
    frames_missing: int  # cyclic frames of this cycle that did not arrive or failed their checks
    commands_late: int  # commands of the previous cycle that missed this SYNC: they act at the next
    frames_lost: int  # received frames that the kernel dropped since the run began
    receive_queue_bytes: int  # kernel memory of frames not yet received, when last read
    transmit_queue_bytes: int  # kernel memory of frames not yet sent, when last read
    log_queue_bytes: int  # bytes in the ring that the log's writer has not taken


class FrameChecks(NamedTuple):
    """Results of the checks on the cyclic frames of drive 1, drive 2, sensor 1, sensor 2, since the attempt began.

    counts: per device, number of frames by E2eStatus. implausible: per device, frames with values out of bounds.
    """

    cycle: int
    counts: tuple[tuple[int, ...], ...]
    implausible: tuple[int, ...]


class Event(NamedTuple):
    """An event in the log: level, name, message."""

    level: str  # "info", "warning", "error"
    name: str
    message: str

    @property
    def operator_text(self) -> str:
        """Text shown to the operator: the message."""
        return self.message


class BriefedEvent(Event):
    """An event with a shorter text for the operator. Equal to the event of the same message."""

    brief: str

    @classmethod
    def of(cls, event: Event, brief: str) -> Self:
        """Return a copy of the event that keeps its text for the log and shows the operator `brief` instead."""
        briefed = cls(*event)
        briefed.brief = brief
        return briefed

    @property
    def operator_text(self) -> str:
        """Text shown to the operator: the shorter one, `brief`."""
        return self.brief


CERTIFICATE_EVENTS: Final = frozenset(("anchor", "touch", "position", "certificate", "revoked", "sight"))
"""Names of the events about certificates: shown to the operator at once; a replay must repeat them."""
BEGINS_ANEW: Final = "no certificate, learning begins anew"
"""The clause of those events that withhold a certificate, behind the cause."""
