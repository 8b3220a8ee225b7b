"""The arm of a configuration, composed for the emulator to play: mechanics, sensors, and a scenario to its size.

The configuration is the one that the host reads. A missing value is assumed and reported in a line; a truth
outweighs both. Inertia, in the words of `firmware_sim.arm.arms`, is that of masses in the truth, else of `arm.mass_kg`
with its neighbours, which the host doesn't read, else of `arm.cad_theta`, else, if no lengths are given either, of the
profile, else of uniform rods as heavy as the drives' rated torque suggests:

    γ = m₂ l₂² / 3 = τ₂ γ_P / τ_P2        α + γ = τ₁ (α + γ)_P / τ_P1, with m₁ ≥ m₂ / 2        index P: profile P

From cad_theta = (a₁, a₂, a₃, …): α = a₁ − a₃, β = a₂, γ = a₃. With c₂ in the middle of link 2, or as near to it as
β l₁ / α ≤ c₂ ≤ γ l₁ / β allows, m₂ = a₂ / (l₁ c₂), and link 1 is a rod with the rest of α.

A scenario that comes with the package was made for profile P: places grow with the links, forces and payloads so that
their torques grow with the rated torques or the inertia, whichever grows less: drives must be able to hold them, and a
light arm must not be thrown beyond its limits before a host can react.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from adacd_hil.settings.arm_settings import ArmSettings
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import ConfigurationLayer, resolved_table
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.toml_files import builtin_names
from firmware_sim.arm.arms import ARMS
from firmware_sim.arm.hardware_settings import STANDARD_GRAVITY_M_S2
from firmware_sim.arm.plant import CURRENT_LOOP_HZ
from firmware_sim.arm.sensing import TORQUE_NOISE_NM, TORQUE_RANGE_NM, VELOCITY_LOOP_HZ
from firmware_sim.scenario.scenario import ArmTruth, TruthArmSettings

Pair = tuple[float, float]
_MODEL: Final = ARMS["P"]
_COULOMB_SHARE, _VISCOUS_SHARE_S = 0.003, 0.0025
"""Friction of profile P over its rated torque, about, at 1 rad/s."""
_BRAKING_S: Final = 0.015
"""How long quick stop takes the unloaded arm to a third of its speed, as profile P's."""
_STOP_MARGIN_DEG: Final = 20.0
_NOISE_SHARE: Final = TORQUE_NOISE_NM / TORQUE_RANGE_NM
_RANGE_PER_RATED: Final = 4.0
_LEAST_RANGE_SHARE: Final = 0.1
"""Part of the rated torque that the frames of a sensor must be able to carry to be played."""
_HOLDING_SHARE: Final = 1.5
_CAD_SPARE: Final = 0.02
"""Share by which links keep clear of an inertia that vanishes in some motion."""
_HEAVIEST: Final = 10.0
"""Most that payloads are multiplied by: they go up to 1 kg, and a scenario takes 20 kg."""


_GEOMETRY: Final = frozenset({"arm.link_length_m", "arm.cad_theta", "arm.mass_kg"})
_OF_THE_ARM: Final = _GEOMETRY | {
    "arm.rated_torque_Nm",
    "arm.sign",
    "devices.drive",
    "devices.sensor",
    "devices.drive_node",
    "devices.sensor_node",
}


class DeviceCounts(NamedTuple):
    """Counts of the emulated devices by their profiles; pairs are by joint, as the configuration places the devices.

    increments_per_joint_rev: of position. torque_range_Nm: the largest torque that the sensors' signals, or the
    profile, allow. rated_count_Nm: one count of 0x6076 behind the gear. rated_torque_Nm: 0x6076 of the EDS, behind the
    gear; 0: the EDS lacks it.
    """

    increments_per_joint_rev: Pair
    torque_range_Nm: Pair
    rated_count_Nm: Pair
    rated_torque_Nm: Pair


@dataclass(frozen=True)
class _Links:
    """Both links: length, m, mass, kg, centre of mass from the link's joint, m, and inertia about that centre."""

    length_m: Pair
    mass_kg: Pair
    center_m: Pair
    inertia_kg_m2: Pair


class ToldArm(NamedTuple):
    """A host's configuration, and its keys ("section.key") that the user has set.

    own_keys: neither built in nor of an emulated profile.
    """

    settings: Settings
    own_keys: frozenset[str]

    @property
    def is_own(self) -> bool:
        """Whether the user has set a key that describes an arm or its devices, so that it is not the profile's."""
        return bool(self.own_keys & _OF_THE_ARM)

    @property
    def has_geometry(self) -> bool:
        """Whether the user has set lengths, masses or CAD parameters of the links; otherwise they are the profile's."""
        return bool(self.own_keys & _GEOMETRY)


def told_arm(settings: Settings, layers: Sequence[ConfigurationLayer]) -> ToldArm:
    """Return all settings, and the names of the keys that the user has set: neither built in nor an emulated profile's.

    `layers`: those that gave the settings.
    """
    own = [layer for layer in layers if layer.origin not in builtin_names() and "[profiles." not in layer.origin]
    table = resolved_table(own)
    keys = {f"{name}.{key}" for name, section in table.items() if isinstance(section, dict) for key in section}
    return ToldArm(settings, frozenset(keys))


def compose_scenario(
    told: ToldArm, truth: ArmTruth, counts: DeviceCounts, table: dict[str, Any], is_builtin: bool
) -> tuple[dict[str, Any], list[str]]:
    """Return a scenario's table with the arm of a configuration and a truth put in, and the assumptions, a line each.

    `table` stays as it is. `is_builtin`: the scenario comes with the package, so it is fitted to the size of the arm.
    Raises ConfigError if the configuration's inertia or torque counts can't be played.
    """
    settings, arm = told.settings, told.settings.arm
    assumed: list[str] = []
    links = _place_links(told, truth, assumed)
    factor = truth.factor
    first, second = (by_eds or own for by_eds, own in zip(counts.rated_torque_Nm, arm.rated_torque_Nm, strict=True))
    rated = truth.arm.rated_torque_Nm or _times((first, second), factor.rated_torque)
    strength = _times(rated, factor.gear)  # sensors, friction and touches follow the configured gear
    viscous, coulomb = _friction(told, truth, rated, assumed)
    inertia = _joint_inertia(links)
    braking = truth.arm.brake_damping_Nm_s or _times(inertia, (1.0 / _BRAKING_S, 1.0 / _BRAKING_S))
    if truth.arm.brake_damping_Nm_s is None:
        assumed.append(
            f"quick stop and fault brake with {braking[0]:.3g} and {braking[1]:.3g} Nm s/rad, since no file says: to a "
            f"third of the unloaded arm's speed in {1000 * _BRAKING_S:g} ms"
        )
    stops = truth.arm.stop_deg
    if stops is None and not told.has_geometry:
        stops = ARMS[arm.profile].stop_deg
    if stops is None:
        first, second = (min(limit + _STOP_MARGIN_DEG, 720.0) for limit in arm.position_limit_deg)
        stops = first, second
        assumed.append(
            f"joint stops at ±{first:g} and ±{second:g} deg, since the file has none: {_STOP_MARGIN_DEG:g} deg beyond "
            "arm.position_limit_deg"
        )
    gear = _by_place(truth, "drives", factor.gear)
    increments = _times(gear, _by_place(truth, "drives", counts.increments_per_joint_rev))
    own: dict[str, Any] = {
        "name": settings.name or "own",
        "link_length_m": links.length_m,
        "mass_kg": links.mass_kg,
        "center_m": links.center_m,
        "inertia_kg_m2": links.inertia_kg_m2,
        "viscous_Nm_s": viscous,
        "coulomb_Nm": coulomb,
        "rated_torque_Nm": strength,
        "brake_damping_Nm_s": braking,
        "stop_deg": stops,
        **_wire(arm.sign, truth),
        "zero_deg": _by_place(truth, "drives", arm.zero_deg),
        "increments_per_joint_rev": _times(increments, _by_place(truth, "drives", factor.position_counts)),
        "velocity_factor": _times(gear, _by_place(truth, "drives", factor.velocity_counts)),
        "rated_count_Nm": _times(gear, _by_place(truth, "drives", counts.rated_count_Nm)),
        "torque_factor": _by_place(truth, "sensors", factor.torque_counts),
    }
    own = {key: list(value) if isinstance(value, tuple) else value for key, value in own.items()}
    composed = dict(table)
    if is_builtin:
        _fit(composed, settings, links, rated, assumed)
    composed["own_arm"] = own
    if truth.arm.torque_offset_Nm is not None:
        composed["torque_offset_Nm"] = list(truth.arm.torque_offset_Nm)
    composed["sensors"] = _sensors(rated, counts, composed.get("sensors", {}), assumed)
    composed["mechanics"] = _mechanics(told, links, composed.get("mechanics", {}), assumed)
    if not composed.get("drives"):
        assumed.append(
            f"drives with a torque loop of {CURRENT_LOOP_HZ:g} Hz and a velocity filter of {VELOCITY_LOOP_HZ:g} Hz "
            "that give their rated torque for ever; no file says"
        )
    return composed, [f"assumed: {line}" for line in assumed]


def _times(values: Pair, factors: Pair) -> Pair:
    return values[0] * factors[0], values[1] * factors[1]


def _by_place(truth: ArmTruth, what: str, by_joint: Pair) -> Pair:
    """Return values by joint in the order of the devices: exchanged if the truth exchanges `what`, or the joints.

    what: "drives" or "sensors".
    """
    return (by_joint[1], by_joint[0]) if truth.wiring.swapped in (what, "joints") else by_joint


def _place_links(told: ToldArm, truth: ArmTruth, assumed: list[str]) -> _Links:
    """Return the links of truth, configuration or profile, else rods, times the truth's factors.

    Append a line to `assumed` for each assumption. Raises ConfigError if no links can have the inertia of
    `arm.cad_theta`.
    """
    arm = told.settings.arm
    told_m = truth.arm.link_length_m or arm.link_length_m
    if not told.has_geometry and truth.arm.link_length_m is None and truth.arm.mass_kg is None:
        model = ARMS[arm.profile]
        assumed.append(
            f"links, friction and stops of profile {arm.profile}, since the file has neither arm.link_length_m nor "
            "arm.cad_theta"
        )
        links = _Links(model.link_length_m, model.mass_kg, model.center_m, model.inertia_kg_m2)
        return _multiply(links, truth)
    if truth.arm.link_length_m is None and "arm.link_length_m" not in told.own_keys:
        assumed.append(f"links of {told_m[0]:g} and {told_m[1]:g} m, since the file has no arm.link_length_m")
    if truth.arm.mass_kg is not None:
        links = _weighed(told_m, truth.arm, "truth", assumed)
    elif arm.mass_kg is not None:
        links = _weighed(told_m, arm, "file", assumed)
    elif "arm.cad_theta" in told.own_keys and arm.cad_theta:
        links = _from_cad(told_m, arm.cad_theta)
        assumed.append(
            f"links of {links.mass_kg[0]:.3g} and {links.mass_kg[1]:.3g} kg whose inertia is arm.cad_theta's within "
            f"{100.0 * _CAD_SPARE:g} %; --truth with arm.mass_kg plays another"
        )
    else:
        links = _rods(told_m, _heavy_enough(told_m, arm.rated_torque_Nm))
        for number, mass_kg in enumerate(links.mass_kg, start=1):
            assumed.append(
                f"link {number} mass {mass_kg:.3g} kg, a uniform rod, since the file has no arm.cad_theta; its rated "
                "torque moves it as profile P's"
            )
    return _multiply(links, truth)


def _multiply(links: _Links, truth: ArmTruth) -> _Links:
    """Return the links with lengths and masses multiplied by the truth's factors; centres and inertia follow."""
    (f1, f2), (m1, m2) = truth.factor.link_length, truth.factor.mass
    return _Links(
        _times(links.length_m, (f1, f2)),
        _times(links.mass_kg, (m1, m2)),
        _times(links.center_m, (f1, f2)),
        _times(links.inertia_kg_m2, (m1 * f1 * f1, m2 * f2 * f2)),
    )


def _weighed(length_m: Pair, body: TruthArmSettings | ArmSettings, source: str, assumed: list[str]) -> _Links:
    """Return links with the masses of `body`. A missing centre or inertia is a uniform rod's, with a line in `assumed`.

    source: "truth" or "file", for that line.
    """
    assert body.mass_kg is not None
    rods = _rods(length_m, body.mass_kg)
    for key, meaning in (
        ("center_m", "the centre of mass in the middle of each link"),
        ("inertia_kg_m2", "a rod's inertia"),
    ):
        if getattr(body, key) is None:
            assumed.append(f"{meaning}, since the {source} has no arm.{key}")
    return _Links(length_m, rods.mass_kg, body.center_m or rods.center_m, body.inertia_kg_m2 or rods.inertia_kg_m2)


def _rods(length_m: Pair, mass_kg: Pair) -> _Links:
    (l1, l2), (m1, m2) = length_m, mass_kg
    return _Links(length_m, mass_kg, (l1 / 2.0, l2 / 2.0), (m1 * l1 * l1 / 12.0, m2 * l2 * l2 / 12.0))


def _heavy_enough(length_m: Pair, rated_Nm: Pair) -> Pair:
    """Return the masses of uniform rods, kg, that their rated torque accelerates about as it does profile P's.

    Link 1 has at least half the mass of link 2.
    """
    (l1, l2), (r1, r2) = length_m, rated_Nm
    alpha, _, gamma = _MODEL.inertia()
    m2 = 3.0 * gamma * r2 / _MODEL.rated_torque_Nm[1] / l2**2
    whole = (alpha + gamma) * r1 / _MODEL.rated_torque_Nm[0]
    m1 = 3.0 * (whole - m2 * (l1**2 + l2**2 / 3.0)) / l1**2
    return max(m1, m2 / 2.0), m2


def _from_cad(length_m: Pair, theta: Sequence[float]) -> _Links:
    """Return two links with the inertia of `theta`, which is `arm.cad_theta`.

    With a2² near (a1 - a3) a3, a1 is larger by up to _CAD_SPARE, so that the outstretched arm keeps an inertia against
    each motion. Raises ConfigError if no links can have it.
    """
    a1, a2, a3 = theta[:3]
    l1, l2 = length_m
    alpha, beta, gamma = a1 - a3, a2, a3
    if not (alpha > 0.0 and gamma > 0.0 and beta * beta <= alpha * gamma):
        raise ConfigError(
            f"`arm.cad_theta` = [{a1:g}, {a2:g}, {a3:g}, ...] is no arm's: a3 and a1 - a3 must be above 0 kg m², and "
            f"a2² at most (a1 - a3) a3 = {alpha * gamma:.4g}"
        )
    if beta == 0.0:  # link 2 is balanced about its joint
        m2 = alpha / l1**2 / 2.0
        c2 = 0.0
    else:
        c2 = min(max(l2 / 2.0, (1.0 + _CAD_SPARE) * beta * l1 / alpha), (1.0 - _CAD_SPARE) * gamma * l1 / beta)
        m2 = beta / (l1 * c2)
    left = max(alpha - m2 * l1**2, 0.0)
    m1 = max(3.0 * left / l1**2, 1e-4)
    return _Links(length_m, (m1, m2), (l1 / 2.0, c2), (max(left - m1 * l1**2 / 4.0, 0.0), max(gamma - m2 * c2**2, 0.0)))


def _joint_inertia(links: _Links) -> Pair:
    """Return the inertia about each joint, kg m²: α + γ, as with the elbow at 90 degrees, and γ."""
    (l1, _), (m1, m2), (c1, c2), (i1, i2) = links.length_m, links.mass_kg, links.center_m, links.inertia_kg_m2
    gamma = i2 + m2 * c2**2
    return i1 + m1 * c1**2 + m2 * l1**2 + gamma, gamma


def _friction(told: ToldArm, truth: ArmTruth, rated: Pair, assumed: list[str]) -> tuple[Pair, Pair]:
    """Return viscous, Nm s/rad, and Coulomb friction, Nm, by joint.

    Each is that of the truth, else of the configuration, else of the user's `arm.cad_theta` if that has any, else of
    the profile if the user has set no geometry. Otherwise it is a share of the rated torque, with a line in `assumed`.
    """
    theta = told.settings.arm.cad_theta if "arm.cad_theta" in told.own_keys else ()
    known = theta[3:7] if any(theta[3:7]) else ()
    found: list[Pair] = []
    arm = told.settings.arm
    model = ARMS[arm.profile]
    for key, given, places, typical, share, unit in (
        (
            "viscous", truth.arm.viscous_Nm_s or arm.viscous_Nm_s, slice(0, 2), model.viscous_Nm_s,
            _VISCOUS_SHARE_S, "Nm s/rad",
        ),
        ("Coulomb", truth.arm.coulomb_Nm or arm.coulomb_Nm, slice(2, 4), model.coulomb_Nm, _COULOMB_SHARE, "Nm"),
    ):  # fmt: skip
        if given is not None:
            first, second = given
        elif known:
            first, second = known[places]
        elif not told.has_geometry:
            first, second = typical
        else:
            first, second = _times(rated, (share, share))
            assumed.append(
                f"{key} friction {first:.3g} and {second:.3g} {unit}, since the file has none: {100 * share:g} % of "
                "rated torque"
            )
        found.append((first, second))
    viscous, coulomb = found
    return viscous, coulomb


def _wire(sign: tuple[int, int], truth: ArmTruth) -> dict[str, Any]:
    """Return the keys of `own_arm` on joints and signs of the devices: the configuration's, changed by the truth."""
    wiring = truth.wiring
    drive_joint, sensor_joint = (
        (2, 1) if wiring.swapped in (what, "joints") else (1, 2) for what in ("drives", "sensors")
    )
    turned, driven, sensed = (
        [-1 if is_reversed else 1 for is_reversed in joints]
        for joints in (wiring.reversed_joint, wiring.reversed_motor, wiring.reversed_sensor)
    )
    return {
        "drive_joint": list(drive_joint),
        "sensor_joint": list(sensor_joint),
        "drive_sign": [sign[place] * turned[joint - 1] for place, joint in enumerate(drive_joint)],
        "motor_sign": [driven[joint - 1] for joint in drive_joint],
        "sensor_sign": [sign[place] * turned[j - 1] * sensed[j - 1] for place, j in enumerate(sensor_joint)],
    }


def _sensors(rated: Pair, counts: DeviceCounts, said: dict[str, Any], assumed: list[str]) -> dict[str, Any]:
    """Return the scenario's sensor settings, `said`, completed by range, noise and encoder bits.

    Appends a line to `assumed` for each addition. Raises ConfigError if the frames carry less than
    `_LEAST_RANGE_SHARE` of rated torque.
    """
    sensors = dict(said)
    for joint, (rated_Nm, most_Nm) in enumerate(zip(rated, counts.torque_range_Nm, strict=True)):
        if most_Nm < _LEAST_RANGE_SHARE * rated_Nm:
            raise ConfigError(
                f"the frames of torque sensor {joint + 1} carry ±{most_Nm:.3g} Nm, rated torque is {rated_Nm:g} Nm: "
                "`torque_Nm` of the sensor's profile, the worth of a count, is wrong"
            )
    if "torque_range_Nm" not in sensors:
        ranges = [
            min(max(_RANGE_PER_RATED * rated_Nm, TORQUE_RANGE_NM * min(rated_Nm / model_Nm, 1.0)), most)
            for rated_Nm, model_Nm, most in zip(rated, _MODEL.rated_torque_Nm, counts.torque_range_Nm, strict=True)
        ]
        sensors["torque_range_Nm"] = ranges
        assumed.append(f"torque sensors of ±{ranges[0]:.4g} and ±{ranges[1]:.4g} Nm in 16 bits; no file says")
    if "torque_noise_Nm" not in sensors:
        noise = [_NOISE_SHARE * range_Nm for range_Nm in sensors["torque_range_Nm"]]
        sensors["torque_noise_Nm"] = noise
        assumed.append(
            f"their noise {1000 * noise[0]:.3g} and {1000 * noise[1]:.3g} mNm rms, {100 * _NOISE_SHARE:g} % of range"
        )
    if "encoder_bits" not in sensors and any(counts.increments_per_joint_rev):
        bits = [
            min(max(math.ceil(math.log2(increments)), 8), 20) if increments else 20
            for increments in counts.increments_per_joint_rev
        ]
        sensors["encoder_bits"] = bits
        assumed.append(f"encoders of {bits[0]} and {bits[1]} bits, as finely as the profiles count positions")
    return sensors


def _mechanics(told: ToldArm, links: _Links, said: dict[str, Any], assumed: list[str]) -> dict[str, Any]:
    """Return the scenario's mechanics, `said`, completed by the configuration's mounting and by holding brakes.

    Appends a line to `assumed` for each assumption.
    """
    mechanics, settings = dict(said), told.settings
    holding = settings.arm.holding_torque_Nm
    if settings.mounting_deg[0] > 0.0 and "tilt_deg" not in mechanics:
        mechanics["tilt_deg"], mechanics["tilt_direction_deg"] = settings.mounting_deg
        if settings.arm.mounting_deg is None:
            assumed.append("the arm moves upright, q1 = 0 level, since arm.mounting_deg is unset")
    tilt_rad = math.radians(mechanics.get("tilt_deg", 0.0))
    if tilt_rad > 0.0 and holding is None and "holding_brake_Nm" not in mechanics:
        (l1, _), (m1, m2), (c1, c2) = links.length_m, links.mass_kg, links.center_m
        heavy = _HOLDING_SHARE * STANDARD_GRAVITY_M_S2 * math.sin(tilt_rad)
        pair = heavy * (m1 * abs(c1) + m2 * (l1 + abs(c2))), heavy * m2 * abs(c2)
        mechanics["holding_brake_Nm"] = list(pair)
        assumed.append(
            f"brakes that hold {pair[0]:.3g} and {pair[1]:.3g} Nm without power, since arm.holding_torque_Nm is "
            f"unset: {_HOLDING_SHARE:g} times gravity's"
        )
    if holding is not None and any(holding) and "holding_brake_Nm" not in mechanics:
        mechanics["holding_brake_Nm"] = list(holding)
    if "stiffness_Nm_rad" not in mechanics and "rotor_inertia_kg_m2" not in mechanics:
        assumed.append("stiff joints without rotors, whose torque sensors see all that the motors give; no file says")
    return mechanics


_PLACES: Final = ("x_m", "y_m", "radius_m", "move_to_m")
"""Keys of touches in metres of the world: they grow with the arm's reach."""


def _fit(table: dict[str, Any], settings: Settings, links: _Links, rated: Pair, assumed: list[str]) -> None:
    """Fit a scenario's table, made for profile P, to the arm, in place: scale places, forces and payloads.

    A start pose is replaced by the corner where the trajectory begins. Keys that the table lacks stay absent. Appends a
    line to `assumed` if a factor of places or torques isn't 1.
    """
    length_m = links.length_m
    longer = length_m[0] / _MODEL.link_length_m[0], length_m[1] / _MODEL.link_length_m[1]
    alpha, _, gamma = _MODEL.inertia()
    inertia, model = _joint_inertia(links), (alpha + gamma, gamma)
    first, second = (min(rated[i] / _MODEL.rated_torque_Nm[i], inertia[i] / model[i]) for i in range(2))
    stronger = first, second
    reach = sum(length_m) / sum(_MODEL.link_length_m)
    first, second = settings.trajectory.amplitude_deg
    if "start_deg" in table:
        table["start_deg"] = [-first, -second]
    # Joint 1 swings a payload about joint 2 by m l1 l2, the more the longer link 1 is.
    heavier = min(stronger[1] / (longer[1] * max(longer)), _HEAVIEST)
    if "payload_kg" in table:
        table["payload_kg"] *= heavier
    if "payloads" in table:
        table["payloads"] = [_heavier(row, heavier, longer[1]) for row in table["payloads"]]
    for key in ("contacts", "hands", "bodies", "walls"):
        if key in table:
            table[key] = [_sized(row, reach, longer, stronger) for row in table[key]]
    if (longer, stronger) != ((1.0, 1.0), (1.0, 1.0)):
        assumed.append(
            f"places of touches times {longer[0]:.3g} and {longer[1]:.3g}, as the links over profile P's, torques "
            f"times {stronger[0]:.3g} and {stronger[1]:.3g}, payloads times {heavier:.3g}"
        )


def _heavier(row: dict[str, Any], heavier: float, longer: float) -> dict[str, Any]:
    fitted = {**row, "mass_kg": row["mass_kg"] * heavier}
    if "center_m" in row:
        fitted["center_m"] = [value * longer for value in row["center_m"]]
    if "inertia_kg_m2" in row:
        fitted["inertia_kg_m2"] = row["inertia_kg_m2"] * heavier * longer**2
    return fitted


def _sized(row: dict[str, Any], reach: float, longer: Pair, stronger: Pair) -> dict[str, Any]:
    link = row.get("link", 1) - 1
    force = stronger[link] / longer[link]
    factors = {**dict.fromkeys(_PLACES, reach), "point_m": longer[link], "force_N": force, "force_limit_N": force}
    return {key: _grown(value, factors[key]) if key in factors else value for key, value in row.items()}


def _grown(value: Any, factor: float) -> Any:
    return [_grown(one, factor) for one in value] if isinstance(value, list) else value * factor
