"""Draft of an arm's configuration: known values, derived values and guesses, each with a comment.

Known are two rigid links from a description: a URDF of two joints, or lengths and masses. Gains, motion and prior
follow from the inertia in proportion to the emulated arm P, on which they were measured. If the masses aren't known,
the inertia is taken in proportion to the rated torque.

The parameters are those of the host's model, in the order of `records.PARAMETER_NAMES`: with link i of mass m_i, its
centre of mass c_i from joint i on the line of the link and the inertia I_i about it,

    a1 = I₁ + m₁ c₁² + m₂ l₁² + a3    a2 = m₂ l₁ c₂    a3 = I₂ + m₂ c₂²        kg m²
    a4 = g' (m₁ c₁ + m₂ l₁)           a5 = g' m₂ c₂                            Nm, if the axes are not vertical

g' = g sin(tilt) acts in the plane of motion; `arm.mounting_deg` has the tilt and the q1 at which link 1 hangs down.

Friction is not known from a description; it is 0.
"""

import math
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from adacd_hil.lab.serial_arm.chain import PER_LINK, Chain
from adacd_hil.lab.serial_arm.urdf import BASE, SerialArm, UrdfError, read_urdf, symmetric
from adacd_hil.printable import one_line
from adacd_hil.records import GRAVITY_M_S2, JOINTS, Vector
from adacd_hil.settings.arm_settings import SLIGHT_TILT_DEG, ArmSettings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.parsing import bounds_of, parse
from adacd_hil.settings.run_settings import SafetySettings, TrajectorySettings
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.setting_keys import known_keys
from adacd_hil.settings.toml_text import toml_value

Pair = tuple[float, float]
_PARALLEL = math.cos(math.radians(2.0))
"""Least |cosine| of the angle between parallel axes, and of that between a vertical axis and the vertical."""
_BENT_DEG = 5.0
"""Angle from which the zero of joint 2 is not that of a stretched arm."""
_LEAST_MOMENT_KG_M = 1e-6
"""Least mass moment of link 2 about its joint; the direction of a smaller one is undefined."""
_IMPOSSIBLE = 5.0
"""Lengths of a link from its joint to its centre of mass that no arm has; so for the radius of gyration."""
LEVEL_DEG: Pair = (0.0, 0.0)
"""Mounting of an arm with vertical axes, without gravity."""


class PlanarArm(NamedTuple):
    """Description of an arm with two parallel axes.

    cad_theta: parameters, () if the masses are not known. mounting_deg: as `arm.mounting_deg`. sign, zero_deg: settings
    of drives that count as the description. effort_Nm: torque limits. mass_kg, center_m, inertia_kg_m2: of each link,
    the inertia about its centre of mass; the last two are None for rods. is_tip_known: the length of link 2 is not
    derived from its centre of mass. Other fields are None if the description lacks them. doubts: properties of the
    description that the model can't represent, a line each.
    """

    link_length_m: Pair
    cad_theta: tuple[float, ...]
    mounting_deg: Pair = LEVEL_DEG
    position_limit_deg: Pair | None = None
    velocity_limit_deg_s: Pair | None = None
    effort_Nm: Pair | None = None
    doubts: tuple[str, ...] = ()
    is_tip_known: bool = True
    mass_kg: Pair | None = None
    center_m: Pair | None = None
    inertia_kg_m2: Pair | None = None
    viscous_Nm_s: Pair | None = None
    coulomb_Nm: Pair | None = None
    sign: tuple[int, int] = (1, 1)
    zero_deg: Pair = (0.0, 0.0)

    @property
    def has_gravity(self) -> bool:
        """Whether gravity acts on the joints: the plane of motion is tilted by more than `SLIGHT_TILT_DEG`."""
        return self.mounting_deg[0] > SLIGHT_TILT_DEG


def uniform_rods(link_length_m: Pair, mass_kg: Pair, mounting_deg: Pair) -> PlanarArm:
    """Return the description of two uniform rods: centre of mass in the middle, inertia m l² / 12 about it.

    mounting_deg: as `arm.mounting_deg`.
    """
    (l1, l2), (m1, m2) = link_length_m, mass_kg
    theta = _theta((m1 * l1**2 / 3.0, m2 * l2**2 / 3.0), (m1 * l1 / 2.0, m2 * l2 / 2.0), m2, l1, mounting_deg)
    return PlanarArm(link_length_m, theta, mounting_deg, mass_kg=mass_kg)


def _theta(inertia: Pair, moment_kg_m: Pair, outer_kg: float, l1: float, mounting_deg: Pair) -> tuple[float, ...]:
    """Return a1, a2, a3, four times 0 for friction and, unless the axes are vertical, a4 and a5 of two links.

    a4 is at least 0. inertia: of each about its joint, kg m². moment_kg_m: mass times centre of mass, along the line of
    the link. outer_kg: mass of link 2. l1: length of link 1, m. mounting_deg: as `arm.mounting_deg`.
    """
    first, second = inertia
    theta = [first + outer_kg * l1**2 + second, l1 * moment_kg_m[1], second, 0.0, 0.0, 0.0, 0.0]
    if mounting_deg[0] > SLIGHT_TILT_DEG:
        share = GRAVITY_M_S2 * math.sin(math.radians(mounting_deg[0]))
        theta += [share * max(moment_kg_m[0] + outer_kg * l1, 0.0), share * moment_kg_m[1]]
    return tuple(map(_short, theta))


def planar_from_urdf(text: bytes, locked: Collection[str] = (), pitch_deg: float = 0.0) -> PlanarArm:
    """Read an arm of two revolute joints with parallel axes.

    locked: names of joints that count as fixed at 0. pitch_deg: rotation of the URDF's root about its y axis; 0: its z
    axis points up, 90: its x axis down. Raises UrdfError if the URDF can't be read, is of another arm, or has an
    impossible inertia, or limits without 0.
    """
    pitch_rad = math.radians(pitch_deg)
    gravity = GRAVITY_M_S2 * math.sin(pitch_rad), 0.0, -GRAVITY_M_S2 * math.cos(pitch_rad)
    arm = read_urdf(text, gravity, locked)
    count = len(arm.joint_names)
    if count != JOINTS:
        names = ", ".join(arm.joint_names)
        remedy = "; name those that stay where they are with --lock" if count > JOINTS else ""
        raise UrdfError(f"{count} joints move ({names}), an arm has {JOINTS} here{remedy}")
    chain = arm.chain
    if np.any(chain.is_prismatic):
        raise UrdfError("a joint slides; both must turn")
    turned = chain.rotation[1] @ chain.axis[1]  # in link 1's frame
    cosine = float(chain.axis[0] @ turned)
    if abs(cosine) < _PARALLEL:
        raise UrdfError(
            f"the axes are {math.degrees(math.acos(min(abs(cosine), 1.0))):.0f} deg apart, not parallel: "
            "the model is of two parallel axes; compare <axis> and <origin rpy> with the arm"
        )
    doubts = _mass_doubts(arm)
    sign = (1, -1) if cosine < 0.0 else (1, 1)
    offset = chain.translation[1]
    across = offset - (offset @ chain.axis[0]) * chain.axis[0]
    l1 = float(np.linalg.norm(across))
    if l1 < 1e-3:
        raise UrdfError("the two axes are the same line")
    first, second = arm.theta_full.reshape(JOINTS, PER_LINK)
    moment = second[1:4] - (second[1:4] @ chain.axis[1]) * chain.axis[1]  # kg m, in link 2's frame
    l2 = _reach(arm)
    is_tip_known = l2 > 1e-3
    if not is_tip_known:
        l2 = 2.0 * float(np.linalg.norm(moment)) / second[0] if second[0] > 0.0 and np.any(moment) else l1
    along = across / l1
    mounting_deg = _mounting(chain, along)
    bent_deg = 0.0
    theta: tuple[float, ...] = ()
    body: dict[str, Pair] = {}
    if first[0] > 0.0 and second[0] > 0.0:
        inertia = _about(first, chain.axis[0]), _about(second, chain.axis[1])
        if np.linalg.norm(moment) > _LEAST_MOMENT_KG_M:
            bent_deg = _angle_deg(along, chain.rotation[1] @ moment, chain.axis[0])
        moments = float(first[1:4] @ along), float(np.linalg.norm(moment))
        theta = _theta(inertia, moments, second[0], l1, mounting_deg)
        if mounting_deg[0] > SLIGHT_TILT_DEG:
            doubts += _gravity_doubts(first[1:4], along, chain.axis[0], moments[0] + second[0] * l1)
        body = _body(arm, (first[0], second[0]), moments, inertia)
        doubts += _size_doubts(arm.link_names, body, (l1, l2))
    zero_deg, limits = _straightened(arm, sign[1], bent_deg, doubts)
    return PlanarArm(
        (_short(l1), _short(l2)),
        theta,
        mounting_deg,
        _plausible("position_limit_deg", limits, doubts),
        _plausible("velocity_limit_deg_s", np.degrees(arm.velocity_limit).round(2), doubts),
        _plausible("rated_torque_Nm", arm.torque_limit, doubts),
        tuple(doubts),
        is_tip_known,
        sign=sign,
        zero_deg=zero_deg,
        **body,
    )


def _angle_deg(start: Vector, end: Vector, axis: Vector) -> float:
    """Return the angle about the unit vector `axis` from `start`, which is across it, to `end`, deg in [-180, 180]."""
    return math.degrees(math.atan2(float(np.cross(start, end) @ axis), float(start @ end)))


def _mounting(chain: Chain, along: Vector) -> Pair:
    """Return the tilt of the plane of motion, and the q1 in (-180, 180] at which link 1 hangs down; deg.

    along (3,): direction of link 1 at q1 = 0, in joint 1's frame. `LEVEL_DEG` for a slight tilt.
    """
    axis, gravity = chain.axis[0], chain.rotation[0].T @ chain.gravity_m_s2
    downhill = gravity - (gravity @ axis) * axis
    tilt_deg = math.degrees(math.asin(min(float(np.linalg.norm(downhill)) / GRAVITY_M_S2, 1.0)))
    if tilt_deg <= SLIGHT_TILT_DEG:
        return LEVEL_DEG
    hangs_deg = round(_angle_deg(along, downhill, axis), 2)
    return round(tilt_deg, 2), hangs_deg if hangs_deg > -180.0 else 180.0


def _gravity_doubts(moment: Vector, along: Vector, axis: Vector, lever_kg_m: float) -> Iterator[str]:
    """Yield a line if the model can't represent link 1's gravity: a counterweight, or a centre of mass off its line.

    moment (3,): of link 1, kg m; along, axis (3,): its direction and joint 1's; lever_kg_m: moment of the whole arm
    along link 1.
    """
    aside = abs(float(np.cross(axis, along) @ moment))
    if lever_kg_m <= 0.0:
        yield "link 1 has a counterweight heavier than link 2: the model has no gravity of that direction"
    elif aside > math.sin(math.radians(_BENT_DEG)) * lever_kg_m:
        yield "the centre of mass of link 1 is off the line to joint 2: gravity acts in another direction than modelled"


def _straightened(arm: SerialArm, sign: int, bent_deg: float, doubts: list[str]) -> tuple[Pair, Vector]:
    """Return the drives' positions at q = 0, deg, and the largest |q| (2,), deg, of an arm that is stretched at q2 = 0.

    sign: 1, or -1 if joint 2 of the URDF turns against joint 1. bent_deg: the model's q2 at the URDF's zero; up to
    `_BENT_DEG` counts as 0. Adds a line to `doubts` if the limits of joint 2 exclude the stretched arm. Raises
    UrdfError for limits without 0.
    """
    limits = _position_limits(arm)
    if abs(bent_deg) > _BENT_DEG:
        ends = (math.degrees(sign * float(end[1])) + bent_deg for end in (arm.position_low, arm.position_high))
        low, high = sorted(ends)
        straight = round(min(-low, high), 2)
        if straight > 0.0:
            return (0.0, round(-bent_deg, 2)), np.array((limits[0], straight))
        doubts.append(
            f"at the URDF's q2 = 0 the centre of mass of link 2 is {abs(bent_deg):.0f} deg off the line of link 1, and "
            "the stretched arm, the model's q2 = 0, is not within the limits of joint 2"
        )
    return (0.0, 0.0), limits


def _mass_doubts(arm: SerialArm) -> list[str]:
    """Return a line on each link without an inertial.

    Raises UrdfError for an inertia without a mass, or a mass without inertia about its joint.
    """
    doubts = []
    links = arm.theta_full.reshape(JOINTS, PER_LINK)
    for name, link, axis in zip(arm.link_names, links, arm.chain.axis, strict=True):
        if link[0] <= 0.0 and np.any(link):
            raise UrdfError(f'link "{name}": an inertia without a mass; <mass value="..."> must be above 0 kg')
        if link[0] > 0.0 and _about(link, axis) <= 0.0:
            raise UrdfError(
                f'link "{name}": mass {link[0]:g} kg without inertia about its joint; give <inertia>, or an '
                "<origin> off the axis"
            )
        if not np.any(link):
            doubts.append(
                f'link "{name}" has no <inertial>: no CAD model is written, and the masses of the emulated arm are a '
                "guess; add <inertial>, or give --length-m and --mass-kg in place of --urdf"
            )
    return doubts


def _body(arm: SerialArm, mass_kg: Pair, moment_kg_m: Pair, inertia: Pair) -> dict[str, Pair]:
    """Return masses, centres of mass and inertias about them of both links, by `PlanarArm`'s fields.

    Friction is added if the URDF has any. moment_kg_m: along each link. inertia: of each link about its joint.
    """
    center = [moment / mass for moment, mass in zip(moment_kg_m, mass_kg, strict=True)]
    own = [max(whole - mass * c * c, 0.0) for whole, mass, c in zip(inertia, mass_kg, center, strict=True)]
    named: dict[str, Sequence[float] | Vector] = {"mass_kg": mass_kg, "center_m": center, "inertia_kg_m2": own}
    if np.any(arm.damping) or np.any(arm.friction):
        named |= {"viscous_Nm_s": arm.damping, "coulomb_Nm": arm.friction}
    return {name: (_short(float(pair[0])), _short(float(pair[1]))) for name, pair in named.items()}


def _size_doubts(names: Sequence[str], body: dict[str, Pair], length_m: Pair) -> Iterator[str]:
    """Yield a line for each link whose centre of mass, or radius of gyration about it, is beyond the link's length.

    names: of the links. body: of `_body`. length_m: of each link. Raises UrdfError beyond `_IMPOSSIBLE` lengths.
    """
    for name, mass, center, inertia, length in zip(
        names, body["mass_kg"], body["center_m"], body["inertia_kg_m2"], length_m, strict=True
    ):
        for what, size_m in (
            (f"the centre of its mass is {center:g} m from its joint", abs(center)),
            (f"an inertia of {inertia:g} kg m² with {mass:g} kg", math.sqrt(inertia / mass)),
        ):
            line = f'link "{name}", {length:g} m: {what}; are m, kg and kg m² the units of the URDF?'
            if size_m > _IMPOSSIBLE * length:
                raise UrdfError(line)
            if size_m > length:
                yield line


def _reach(arm: SerialArm) -> float:
    """Return the distance, m, from joint 2's axis to the farthest frame on link 2, such as a tip; 0 without one."""
    axis = arm.chain.axis[1]
    far = [0.0]
    for carrier, pose in arm.places.values():
        if carrier == JOINTS - 1 and carrier != BASE:
            far.append(float(np.linalg.norm(pose.translation - (pose.translation @ axis) * axis)))
    return max(far)


def _about(link: Vector, axis: Vector) -> float:
    """Return the inertia of a link about its joint's axis, kg m².

    link: its parameters (10,), axis (3,): unit vector.
    """
    return float(axis @ symmetric(link[4:]) @ axis)


def _position_limits(arm: SerialArm) -> Vector:
    """Return each joint's largest |q| (2,) that its limits allow in both directions, deg; inf without limits.

    Raises UrdfError if 0 is not within the limits.
    """
    largest = np.minimum(-arm.position_low, arm.position_high)
    if np.any(largest <= 0.0):
        joint = int(np.argmax(largest <= 0.0))
        raise UrdfError(f'joint "{arm.joint_names[joint]}": 0 is not within its limits; set the zero between them')
    return np.asarray(np.degrees(largest).round(2))


def _plausible(key: str, values: Vector, doubts: list[str]) -> Pair | None:
    """Return the values (2,) as a pair of limits; None if one is infinite or `arm.KEY` doesn't accept them.

    In the second case, add a line to `doubts`.
    """
    if not np.all(np.isfinite(values)):
        return None
    pair = float(values[0]), float(values[1])
    try:
        parse(ArmSettings, {key: list(pair)}, "arm.")
    except ConfigError as error:
        doubts.append(f"a limit of the URDF is not taken: {error}")
        return None
    return pair


def _short(value: float) -> float:
    return float(f"{value:.6g}")


_MODEL = load_settings("certified", "P")
_MODEL_INERTIA = np.array(_MODEL.arm.cad_theta)[[0, 2]]
"""a1 and a3 of P's CAD model, kg m², for which its gains were measured."""
_MOST_DAMPING_RAD_S = 300.0
"""Kd over that inertia. P's: 142 and 113. An arm with 340 lost its certificate, one with 1180 vibrated to a FAULT."""
_MODEL_TORQUE_NM = np.array(_MODEL.arm.rated_torque_Nm)
_RATE_PER_NM = _MODEL.arm.torque_rate_limit_Nm_s[1] / _MODEL_TORQUE_NM[1]
"""Torque rate limit per rated torque, 1/s."""
_AMPLITUDE_DEG, _HALF_PERIOD_S = np.array((_MODEL.trajectory.amplitude_deg, _MODEL.trajectory.half_period_s))
_MOST_HALF_PERIOD_S = bounds_of(TrajectorySettings, "half_period_s")[1]
_MOST_SLOWER = _MOST_HALF_PERIOD_S / max(_HALF_PERIOD_S)
"""Largest slowdown of the motion; beyond it the amplitude shrinks, by steps of this factor."""
_SHORTER = 0.95
_UPRIGHT_DEG, _LEAST_UPRIGHT_DEG = (60.0, 60.0), 45.0
"""For an arm that is level at q1 = 0: amplitude, and joint 1's amplitude below which gravity looks like an offset."""
_LEVEL = math.sin(math.radians(45.0))
"""|sin| of the q1 at which link 1 hangs, from which gravity hardly changes about q1 = 0, as an offset does not."""
_PEAK_DEG_S = _MODEL.reaction.velocity_limit_deg_s
"""Peak speed of the certified scheme's excitation at those amplitudes and that period, and of a withdrawal."""
_FULL_ACCELERATION = 1.02
"""Factor on its peak acceleration for a withdrawal's limit; two percent allow for rounding."""
_TRAVEL_SHARE, _SPEED_SHARE = 0.8, 0.8
"""Share of the position and of the velocity limit that the motion uses."""
_HEAVY = 2.0
"""Inertia per torque, against P, up to which the motion needs no slowdown: that of arm S, which runs it."""
_ALIKE = 2.0
"""Factor of torques and inertia against P within which P's numbers of the scheme are used."""
_HEAVY_INERTIA = 20.0
"""Inertia, against P, up to which a fit is as well conditioned; measured on 8 kg links."""
_OFFSET, _LAG = 4, 5
"""Index of torque offsets, and of lags (not torques), among the kinds of parameters."""
_MOST_REST_NM = bounds_of(SafetySettings, "rest_torque_Nm")[1]
_LEAST_TORQUE_SHARE = 0.3
"""Share of the torque that gravity must leave."""


class Fact(NamedTuple):
    """A value, mostly of both joints, and its source as text; "" for a guess."""

    value: Any
    source: str = ""


class ArmFacts(NamedTuple):
    """Known or guessed facts of an arm, from which the rest of its configuration follows.

    Each source is the origin of values as text, "" for a guess. drive, sensor: names of both profiles. drive_node,
    sensor_node: both node ids. data_bitrate, bitrate: None: not written.
    """

    geometry: PlanarArm
    length_source: str
    mass_source: str
    gravity_source: str
    rated_torque_Nm: Fact
    torque_limit_Nm: Fact
    position_limit_deg: Fact
    velocity_limit_deg_s: Fact
    drive: Fact
    sensor: Fact
    drive_node: Fact
    sensor_node: Fact
    period_us: int = 1000
    data_bitrate: int | None = None
    bitrate: int | None = None


class Entry(NamedTuple):
    """One line of the configuration. value: None if unknown; the key is then written as a comment.

    key: such as "arm.sign". comment: written above the line. is_assumed: the value is a guess.
    """

    key: str
    value: Any
    comment: str
    is_assumed: bool = False


def draft_arm(facts: ArmFacts) -> tuple[list[Entry], list[str]]:
    """Draft an arm's configuration from its facts; return its lines, and warnings.

    Warnings: doubts of the description, and abilities that the arm may lack, a line each. Raises ConfigError for a
    joint without torque.
    """
    warnings = list(facts.geometry.doubts)
    return [*_arm(facts), *_devices(facts), *_motion(facts, warnings)], warnings


def assumed_keys(entries: Iterable[Entry]) -> list[str]:
    """Return the keys, such as "arm.sign", whose values are guesses, in the order of the entries."""
    return [entry.key for entry in entries if entry.is_assumed]


def _arm(facts: ArmFacts) -> Iterator[Entry]:
    geometry, rated = facts.geometry, facts.rated_torque_Nm
    yield _stated("arm.link_length_m", Fact(geometry.link_length_m, facts.length_source), "axis to axis, axis to tip")
    yield _stated("arm.rated_torque_Nm", rated, "of each drive, 0x6076, at the joint")
    yield _stated("arm.torque_limit_Nm", facts.torque_limit_Nm, "the most that is ever commanded")
    rate = _RATE_PER_NM * np.array(rated.value)
    yield Entry("arm.torque_rate_limit_Nm_s", _rounded(rate), "in proportion to the rated torque")
    for key in ("arm.position_limit_deg", "arm.velocity_limit_deg_s"):
        yield _stated(key, getattr(facts, key.removeprefix("arm.")), known_keys()[key].meaning)
    comment = "+1 where the device counts as the joint"
    if geometry.sign != (1, 1):
        comment = "joint 2 of the URDF turns against joint 1, and the drives as the URDF"
    yield Entry("arm.sign", geometry.sign, f"a guess: {comment}; `doctor --move` checks it", True)
    if any(geometry.zero_deg):
        comment = "a guess: drives that read the URDF's positions; at q2 = 0 the arm is stretched"
        yield Entry("arm.zero_deg", geometry.zero_deg, comment, True)
    yield Entry(
        "arm.holding_torque_Nm",
        None,
        "not known: largest torque of brakes, friction and cogging without power; 0: free",
        True,
    )
    theta = geometry.cad_theta
    if theta:
        names = "a1, a2, a3 in kg m², friction unknown" + (", a4, a5 in Nm" if geometry.has_gravity else "")
        yield _stated("arm.cad_theta", Fact(theta, facts.mass_source), names)
    else:
        yield Entry("arm.cad_theta", (), "not known: the masses; the scheme identifies the arm without them")
    for key in ("mass_kg", "center_m", "inertia_kg_m2", "viscous_Nm_s", "coulomb_Nm"):
        if (pair := getattr(geometry, key)) is not None:
            yield Entry(f"arm.{key}", pair, f"for the emulator; the host doesn't read it: {facts.mass_source}")
    axes = "not vertical: gravity acts on them" if geometry.has_gravity else "vertical: gravity doesn't act on them"
    yield _stated("estimator.gravity", Fact(geometry.has_gravity, facts.gravity_source), f"joint axes {axes}")
    if geometry.has_gravity:
        comment = f"tilt of the plane of motion, and the q1 at which link 1 hangs; {draw_arm(geometry.mounting_deg)}"
        yield _stated("arm.mounting_deg", Fact(geometry.mounting_deg, facts.gravity_source), comment)


def _devices(facts: ArmFacts) -> Iterator[Entry]:
    for kind in ("drive", "sensor"):
        yield _stated(f"devices.{kind}", getattr(facts, kind), "profiles of joint 1 and 2")
        yield _stated(f"devices.{kind}_node", getattr(facts, f"{kind}_node"), "node ids of joint 1 and 2")
    yield Entry("devices.contract", "", "composed from the profiles")
    if facts.bitrate is not None:
        yield Entry("devices.bitrate", facts.bitrate, "of the bus")
    if facts.data_bitrate is not None:
        yield Entry("devices.data_bitrate", facts.data_bitrate, "of CAN FD's data phase")
    if facts.period_us != _MODEL.bus.period_us:
        yield Entry("bus.period_us", facts.period_us, "in which the frames fit; `adacd-hil budget` shows how")


def _motion(facts: ArmFacts, warnings: list[str]) -> Iterator[Entry]:
    """Draft trajectory, excitation, reaction, gains, rest torque and the scheme's numbers; add lines to `warnings`.

    Raises ConfigError for a joint without torque.
    """
    hangs_rad = math.radians(facts.geometry.mounting_deg[1])
    is_level = facts.geometry.has_gravity and abs(math.sin(hangs_rad)) > _LEVEL
    wanted, comment = _AMPLITUDE_DEG, f"±, within {_TRAVEL_SHARE:.0%} of the position limit"
    if is_level:
        wanted, comment = _UPRIGHT_DEG, f"{comment}; wide, to tell gravity from the sensors' offsets"
    amplitude = _rounded(np.minimum(wanted, _TRAVEL_SHARE * np.array(facts.position_limit_deg.value)))
    if is_level and amplitude[0] < _LEAST_UPRIGHT_DEG:
        warnings.append(
            f"joint 1 may swing by ±{amplitude[0]:g} deg only, {_LEAST_UPRIGHT_DEG:g} deg tell gravity from the offset "
            "of its torque sensor: without a tare the arm may not be certified"
        )
    slower = _slowdown(facts, amplitude, warnings)
    if slower > _MOST_SLOWER:
        whole = amplitude
        while slower > _MOST_SLOWER:
            amplitude = _rounded(_SHORTER * np.array(amplitude))
            slower = _slowdown(facts, amplitude, [])
        comment += f"; {amplitude[0] / whole[0]:.2g} of it, for a half period of {_MOST_HALF_PERIOD_S:g} s at most"
        warnings.append(
            f"by its limits of speed and torque the arm moves by ±{amplitude[0]:g} and ±{amplitude[1]:g} deg only, in "
            f"{slower * max(_HALF_PERIOD_S):.3g} s: learning it takes minutes; are the limits and the gears right?"
        )
    yield Entry("trajectory.amplitude_deg", amplitude, comment)
    reason = "as of the emulated arm" if slower == 1.0 else f"{slower:.2f} times slower than the emulated arm"
    yield Entry("trajectory.half_period_s", _rounded(slower * _HALF_PERIOD_S), reason)
    yield Entry("excitation.period_s", _round(slower * _MODEL.excitation.period_s), reason)
    speed = _SPEED_SHARE * np.array(facts.velocity_limit_deg_s.value)
    withdrawal = _rounded(np.minimum(_PEAK_DEG_S, np.maximum(speed, 1.0)))
    if withdrawal != _PEAK_DEG_S:
        yield Entry("reaction.velocity_limit_deg_s", withdrawal, f"{_SPEED_SHARE:.0%} of the velocity limit")
    has_masses = bool(facts.geometry.cad_theta)
    for name in ("Kp", "Kd"):
        gain = _rounded(np.array(getattr(_MODEL.controller, name)) * _inertia(facts) / _MODEL_INERTIA)
        basis = "the inertia" if has_masses else "the rated torque, as the masses are not known"
        yield Entry(f"controller.{name}", gain, f"the emulated arm's, in proportion to {basis}", not has_masses)
        if name == "Kd" and has_masses:
            warnings += _fast_damping(np.array(gain), facts.geometry.cad_theta)
    if facts.geometry.has_gravity:
        yield _rest_torque(facts)
    yield from _certified(facts)


def _fast_damping(Kd: Vector, cad_theta: Sequence[float]) -> Iterator[str]:
    """Yield a warning for each joint whose Kd over its inertia exceeds `_MOST_DAMPING_RAD_S`, so that it may vibrate.

    Kd in Nm s/rad; cad_theta: a1, a2, a3 first. The inertia is that at q2 = 0 while the other joint turns freely, less
    than the element of M.
    """
    a1, a2, a3 = cad_theta[:3]
    diagonal = np.array((a1 + 2.0 * a2, a3))
    free = np.maximum(diagonal - (a3 + a2) ** 2 / diagonal[::-1], 1e-9)
    for i in np.flatnonzero(Kd > _MOST_DAMPING_RAD_S * free):
        yield (
            f"`controller.Kd[{i}]` = {Kd[i]:.3g} Nm s/rad on {free[i]:.2g} kg m², joint {i + 1}'s inertia while the "
            f"other is free: {Kd[i] / free[i]:.3g} rad/s, {_MOST_DAMPING_RAD_S:g} at most; the arm may vibrate, "
            "rehearse it"
        )


def _rest_torque(facts: ArmFacts) -> Entry:
    """Return `safety.rest_torque_Nm` for an arm with gravity, whose load may rest on the sensors.

    It is the default plus 1.2 times gravity's largest torque on joint 1. If the masses are not known, it is the default
    plus the larger torque limit, as a guess. Either sum is at most `_MOST_REST_NM`.
    """
    free = load_settings("certified").safety.rest_torque_Nm
    gravity = _gravity(facts, facts.position_limit_deg.value)[0]
    load, comment = 1.2 * gravity, f"gravity's {gravity:.3g} Nm on joint 1 and a fifth, which the arm's brakes hold"
    if not gravity:
        load = max(facts.torque_limit_Nm.value)
        comment = "a guess: as much as the drives may give, for gravity loads the sensors and the masses are not known"
    return Entry("safety.rest_torque_Nm", _round(min(free + load, _MOST_REST_NM)), comment, not gravity)


def _certified(facts: ArmFacts) -> Iterator[Entry]:
    """Yield the keys of `certified`, and `detector.collision_Nm`, that differ from the defaults for this arm.

    They are the defaults, scaled by the arm's rated torque and inertia. `prior_std` is at least twice the description's
    inertia and gravity. With gravity, and unscaled torques, the offsets' `enough_std` is doubled. `collision_Nm` is
    only lowered.
    """
    base = load_settings("certified")
    found, inertia = base.certified, _inertia(facts)
    scale = _torque_scale(facts)
    wanted = (2.0 * inertia[0], 0.0, 0.0, 2.0 * sum(facts.geometry.cad_theta[7:]), 0.0, 0.0, 0.0)
    prior = [max(values) for values in zip(found.prior_std, _scaled(found.prior_std, scale), wanted, strict=True)]
    entries: list[tuple[str, Any, Any, str]] = []
    if facts.geometry.has_gravity and scale == 1.0:
        enough = [2.0 * value if kind == _OFFSET else value for kind, value in enumerate(found.enough_std)]
        reason = "offsets half as well as without gravity, which hides them; a tare shows them"
        entries.append(("certified.enough_std", enough, found.enough_std, reason))
    if scale != 1.0:
        reason = f"torques are {scale:.2g} times those of the emulated arm"
        enough = _scaled(found.enough_std, scale)
        prior[-1] = enough[-1]  # further friction need not show itself: it is never known less well than it may be
        entries += [
            ("certified.residual_Nm", scale * found.residual_Nm, found.residual_Nm, reason),
            ("certified.beta_Nm", scale * found.beta_Nm, found.beta_Nm, reason),
            ("certified.enough_std", enough, found.enough_std, f"{reason}; lags stay"),
            ("certified.drift_std", _scaled(found.drift_std, scale), found.drift_std, f"{reason}; lags stay"),
        ]
    reason = "prior; inertia and gravity: at least twice the description's"
    entries.append(("certified.prior_std", prior, found.prior_std, reason))
    ratios = inertia / _MODEL_INERTIA
    light, heavy = min(1.0, _ALIKE * min(ratios)), max(1.0, max(ratios) / _HEAVY_INERTIA)
    reason = "evidence of a lag grows with the inertia"
    entries += [
        ("certified.excitation_Nm2s", light**2 * found.excitation_Nm2s, found.excitation_Nm2s, reason),
        ("certified.condition", (heavy / light) ** 2 * found.condition, found.condition, reason),
    ]
    upper = base.detector.collision_Nm
    lower = np.minimum(1.0, np.array(facts.rated_torque_Nm.value) / _MODEL_TORQUE_NM) * upper
    entries.append(("detector.collision_Nm", lower, upper, "in proportion to the rated torque where that is smaller"))
    for key, value, default, comment in entries:
        rounded = _rounded(value) if isinstance(default, tuple) else _round(value)
        if rounded != default:
            yield Entry(key, rounded, comment)


def _torque_scale(facts: ArmFacts) -> float:
    """Return the rated torque over that of the emulated arm P, for the joint where this is closer to 1.

    1 unless both joints' ratios are above `_ALIKE`, or both below 1 / `_ALIKE`.
    """
    ratios = np.array(facts.rated_torque_Nm.value) / _MODEL_TORQUE_NM
    if min(ratios) > _ALIKE:
        return float(min(ratios))
    return float(max(ratios)) if max(ratios) < 1.0 / _ALIKE else 1.0


def _scaled(by_kind: Sequence[float], scale: float) -> list[float]:
    """Return `by_kind`, a number per kind of parameter, times `scale`; that of lags, no torques, as it is."""
    return [value if kind == _LAG else scale * value for kind, value in enumerate(by_kind)]


def _slowdown(facts: ArmFacts, amplitude: Sequence[float], warnings: list[str]) -> float:
    """Return the factor, at least 1, by which the motion must be slower than that of the emulated arm P.

    Then it fits the limits of speed, acceleration and torque. amplitude: of both joints, deg. Adds a line to `warnings`
    for each joint to which gravity leaves too little torque. Raises ConfigError for a joint without torque.
    """
    limit_Nm, speed = np.array((facts.torque_limit_Nm.value, facts.velocity_limit_deg_s.value))
    for i in np.flatnonzero(limit_Nm <= 0.0):
        raise ConfigError(f"`arm.torque_limit_Nm[{i}]` = 0 Nm: joint {i + 1} can't move without torque")
    gravity, share = _gravity(facts, amplitude), amplitude / _AMPLITUDE_DEG
    least_Nm, left_Nm = _LEAST_TORQUE_SHARE * limit_Nm, limit_Nm - gravity
    for i in np.flatnonzero(left_Nm < least_Nm):
        warnings.append(
            f"gravity takes {gravity[i]:.1f} Nm of joint {i + 1}'s {limit_Nm[i]:g} Nm: too little is left to move"
        )
    heavy = _inertia(facts) / _MODEL_INERTIA * _MODEL_TORQUE_NM / np.maximum(left_Nm, least_Nm) * share
    slower = max(
        *share * _PEAK_DEG_S / (_SPEED_SHARE * speed),
        *np.sqrt(_FULL_ACCELERATION * share[share > 1.0]),
        *np.sqrt(heavy / _HEAVY),
    )
    return float(slower) if slower > 1.01 else 1.0


def _inertia(facts: ArmFacts) -> Vector:
    """Return a1 and a3, kg m², by the masses; if these are unknown, in proportion to the rated torque."""
    if theta := facts.geometry.cad_theta:
        return np.array(theta)[[0, 2]]
    return np.asarray(_MODEL_INERTIA * facts.rated_torque_Nm.value / _MODEL_TORQUE_NM)


def _gravity(facts: ArmFacts, within_deg: Sequence[float]) -> Vector:
    """Return gravity's largest torque on each joint while |q| is within these bounds, Nm.

    0 without gravity, and if the masses are unknown.
    """
    geometry = facts.geometry
    if not (geometry.has_gravity and geometry.cad_theta):
        return np.zeros(JOINTS)
    a4, a5 = geometry.cad_theta[7:]
    swing_1, swing_2 = (np.radians(np.linspace(-bound, bound, 73)) for bound in within_deg)
    uphill = swing_1[:, np.newaxis] - math.radians(geometry.mounting_deg[1] + 90.0)
    second = a5 * np.cos(uphill + swing_2)
    return np.array((np.max(np.abs(a4 * np.cos(uphill) + second)), np.max(np.abs(second))))


_ARROWS = "→↗↑↖←↙↓↘"
"""Directions in steps of 45 deg, counter-clockwise."""
_POSES = {
    0: "the arm points down",
    180: "the arm points up",
    -90: "the arm is level and +q1 lifts it",
    90: "the arm is level and +q1 lowers it",
}
"""Pose or direction of an arm at q = 0, by the q1 at which link 1 hangs down, deg."""


def draw_arm(mounting_deg: Pair) -> str:
    """Return a line of text that draws an arm at q = 0, joint 1 on the left, with an arrow along gravity.

    For a slight tilt the line says that gravity does not act on the joints. mounting_deg: as `arm.mounting_deg`.
    """
    tilt_deg, hangs_deg = mounting_deg
    arm = "at q = 0: [1]====[2]===>, +q counter-clockwise"
    if tilt_deg <= SLIGHT_TILT_DEG:
        return f"{arm}, seen from above; gravity does not act on the joints"
    pose = _POSES.get(round(hangs_deg), f"link 1 hangs at q1 = {hangs_deg:g} deg")
    tilt = "" if tilt_deg > 89.9 else f" (plane tilted by {tilt_deg:g} deg)"
    return f"{arm}, gravity {_ARROWS[round(hangs_deg / 45.0) % 8]}{tilt}: {pose}"


def _stated(key: str, fact: Fact, what: str) -> Entry:
    """Return the entry of a fact with the comment "WHAT: SOURCE"; a fact without a source becomes a guess."""
    return Entry(key, fact.value, f"{what}: {fact.source or 'a guess'}", not fact.source)


def _round(value: float) -> float:
    return float(f"{value:.4g}")


def _rounded(values: Iterable[float]) -> tuple[float, ...]:
    return tuple(map(_round, values))


_HEAD = """# {title}
# `adacd-hil config check {name}` checks this file, `adacd-hil config docs KEY` explains a key; other keys
# are as in `{base}`. `adacd-hil run` needs offsets of the torque sensors: `adacd-hil tare`.

extends = "{base}"
"""


def draft_as_toml(entries: Sequence[Entry], title: str, name: str, base: str = "certified") -> str:
    """Return a draft as the text of a commented TOML file; guesses are listed in `assumed`.

    title: its first comment. name: of the file, quoted for a shell. base: configuration that it extends.
    """
    lines = [_HEAD.format(title=one_line(title), name=one_line(name), base=base).rstrip()]
    if assumed := assumed_keys(entries):
        lines += [
            "",
            "# Guesses. `adacd-hil doctor` asks for each: measure it or look it up, write it, take the key off here.",
            "assumed = [",
            *(f'    "{key}",' for key in assumed),
            "]",
        ]
    order = ["", *(known.partition(".")[0] for known in known_keys())]
    for section in sorted({entry.key.rpartition(".")[0] for entry in entries}, key=order.index):
        lines += ["", f"[{section}]"] if section else []
        lines += [line for entry in entries if entry.key.rpartition(".")[0] == section for line in _lines_of(entry)]
    return "\n".join(lines) + "\n"


def _lines_of(entry: Entry) -> list[str]:
    name = entry.key.rpartition(".")[2]
    line = f"# {name} = [0.0, 0.0]" if entry.value is None else f"{name} = {toml_value(entry.value)}"
    return [*([f"# {one_line(entry.comment)}"] if entry.comment else []), line]
