"""Frozen settings with unit and bounds, read from TOML; an unknown key is an error that names the nearest known one.

A section is a frozen dataclass whose fields are made by `setting`. Field names carry their unit. Angles in degrees
exist only here, in fields labelled `_deg`; the properties beside them give radians.
"""

import dataclasses
import math
import re
import tomllib
import types
import typing
from collections.abc import Iterable
from dataclasses import dataclass
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from adacd_hil.input_files import exists, read_input
from adacd_hil.nearest_name import nearest_name
from adacd_hil.records import GRAVITY_PARAMETER_NAMES, JOINTS, PARAMETER_NAMES, POSITION_TERMS, Reaction, Vector
from adacd_hil.scheduling import ANY_CPU, ISOLATED_CPU, RealtimeRequest
from adacd_hil.terminal import one_line


class ConfigError(ValueError):
    """A setting that can't be used; the message is one line: key, value, bound, unit."""


SUCCESSORS = {
    "certified.collision_Nm": "`detector.collision_Nm`",
    "certified.deviations": "`certified.noise_sigmas` and `certified.model_sigmas`",
    "certified.sigmas": "`certified.noise_sigmas` and `certified.model_sigmas`",
}
"""Keys that are gone, and by what they are replaced, as an error says it."""


def setting(
    default: Any = dataclasses.MISSING,
    *,
    unit: str = "",
    low: float = -math.inf,
    high: float = math.inf,
    choices: tuple[str, ...] = (),
    meaning: str,
) -> Any:
    """Declare one setting. Bounds are inclusive and hold for each element of a tuple; no default means required."""
    metadata = {"unit": unit, "low": low, "high": high, "choices": choices, "meaning": meaning}
    if isinstance(default, type):
        return dataclasses.field(default_factory=default, metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


Section = TypeVar("Section")


def parse(section: type[Section], table: dict[str, Any], where: str = "") -> Section:
    """Make a `section` from a TOML table.

    Raises ConfigError for an unknown key, a missing key, a wrong type or a value outside its bounds.
    """
    fields = {field.name: field for field in dataclasses.fields(typing.cast(Any, section))}
    hints = typing.get_type_hints(section)
    for key in table:
        if key not in fields:
            raise ConfigError(_unknown(key, fields, where))
    values = {}
    for name, field in fields.items():
        if name in table:
            values[name] = _parse_value(hints[name], table[name], f"{where}{name}", field.metadata)
        elif _is_required(field):
            raise ConfigError(f"missing key `{where}{name}`")
    place = where.rstrip(".")
    try:
        return section(**values)
    except ConfigError as error:
        if place in str(error):
            raise
        raise ConfigError(f"`{place}`: {error}") from error
    except ValueError as error:
        raise ConfigError(f"{place}: {error}" if place else str(error)) from error


def find_problems(section: type[Any], table: dict[str, Any], where: str = "") -> list[str]:
    """List everything for which `parse` would refuse a table, a line each.

    What concerns several keys of a section is looked at only where each of them is right, and then the first of it.
    """
    fields = {field.name: field for field in dataclasses.fields(section)}
    hints = typing.get_type_hints(section)
    problems = [_unknown(key, fields, where) for key in table if key not in fields]
    for name, field in fields.items():
        if name in table:
            problems += _value_problems(hints[name], table[name], f"{where}{name}", field.metadata)
        elif _is_required(field):
            problems.append(f"missing key `{where}{name}`")
    if not problems:
        try:
            parse(section, table, where)
        except ConfigError as error:
            problems.append(str(error))
    return problems


def _value_problems(hint: Any, value: Any, key: str, metadata: Any) -> list[str]:
    options = [option for option in typing.get_args(hint) if option is not type(None)]
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return _value_problems(options[0], value, key, metadata)
    if dataclasses.is_dataclass(hint) and isinstance(value, dict):
        return find_problems(typing.cast(type[Any], hint), value, f"{key}.")
    if typing.get_origin(hint) is tuple and dataclasses.is_dataclass(options[0]) and isinstance(value, list):
        rows = enumerate(value)
        return [text for index, row in rows for text in _value_problems(options[0], row, f"{key}[{index}]", metadata)]
    try:
        _parse_value(hint, value, key, metadata)
    except ConfigError as error:
        return [str(error)]
    return []


def _unknown(key: str, known: Iterable[str], where: str) -> str:
    known = list(known)
    if successor := SUCCESSORS.get(f"{where}{key}"):
        return f"unknown key `{where}{key}`; its successor is {successor}"
    nearest = nearest_name(key, known)
    hint = f"; did you mean `{where}{nearest}`?" if nearest else f"; known: {', '.join(known)}"
    return f"unknown key `{where}{key}`{hint}"


def _is_required(field: "dataclasses.Field[Any]") -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def _parse_value(hint: Any, value: Any, key: str, metadata: Any) -> Any:
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, dict):
            raise ConfigError(f"`{key}` = {value!r} must be a table")
        return parse(typing.cast(type[Any], hint), value, f"{key}.")
    if typing.get_origin(hint) is tuple:
        return _parse_tuple(hint, value, key, metadata)
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        hint = next(option for option in typing.get_args(hint) if option is not type(None))
        return _parse_value(hint, value, key, metadata)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if not isinstance(value, hint) or (hint is int and isinstance(value, bool)):
        raise ConfigError(f"`{key}` = {value!r} must be of type {hint.__name__}")
    if isinstance(value, int | float) and not isinstance(value, bool):
        _check_bounds(value, key, metadata)
    if metadata["choices"] and value not in metadata["choices"]:
        nearest = nearest_name(str(value), metadata["choices"])
        hint_text = f"; did you mean {nearest!r}?" if nearest else ""
        raise ConfigError(f"`{key}` = {value!r} must be one of {', '.join(metadata['choices'])}{hint_text}")
    return value


def _parse_tuple(hint: Any, value: Any, key: str, metadata: Any) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        raise ConfigError(f"`{key}` = {value!r} must be a list")
    arguments = typing.get_args(hint)
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        element_hints: tuple[Any, ...] = (arguments[0],) * len(value)
    else:
        element_hints = arguments
    if len(value) != len(element_hints):
        raise ConfigError(f"`{key}` has {len(value)} values, {len(element_hints)} expected")
    return tuple(
        _parse_value(element, item, f"{key}[{index}]", metadata)
        for index, (element, item) in enumerate(zip(element_hints, value, strict=True))
    )


def _check_bounds(value: float, key: str, metadata: Any) -> None:
    unit = f" {metadata['unit']}" if metadata["unit"] else ""
    if not math.isfinite(value):
        raise ConfigError(f"`{key}` = {value} is not finite")
    if value < metadata["low"]:
        raise ConfigError(f"`{key}` = {value}{unit} is below {metadata['low']:g}{unit}")
    if value > metadata["high"]:
        raise ConfigError(f"`{key}` = {value}{unit} is above {metadata['high']:g}{unit}")


def _radians(degrees: tuple[float, float]) -> Vector:
    return np.radians(np.array(degrees, dtype=np.float64))


@dataclass(frozen=True)
class ArmSettings:
    """The arm: what the host may know of it."""

    profile: str = setting("P", choices=("P", "S", "M"), meaning="which of the emulated arms this is meant for")
    link_length_m: tuple[float, float] = setting((0.35, 0.30), unit="m", low=0.01, high=5.0, meaning="joint to joint")
    rated_torque_Nm: tuple[float, float] = setting(
        (12.0, 6.0), unit="Nm", low=0.1, high=1000.0, meaning="0x6076; 1000 per mille of target torque"
    )
    sign: tuple[int, int] = setting((1, 1), low=-1, high=1, meaning="+1 or -1: device direction to joint direction")
    torque_offset_Nm: tuple[float, float] = setting(
        (0.0, 0.0), unit="Nm", low=-50.0, high=50.0, meaning="sensor zero, subtracted after the sign"
    )
    torque_offset_std_Nm: tuple[float, float] | None = setting(
        None, unit="Nm", low=1e-6, high=100.0, meaning="how well that zero is known, a deviation; `--tare` says it"
    )
    holding_torque_Nm: tuple[float, float] | None = setting(
        None,
        unit="Nm",
        low=0.0,
        high=1000.0,
        meaning="most that brake, friction and cogging of a motor without power hold; 0: free; absent: not known",
    )
    position_torque_Nm: float = setting(
        0.0,
        unit="Nm",
        low=0.0,
        high=10.0,
        meaning="`certified`: most that depends on where the arm is, of a cable or a tilted base; 0: none",
    )
    torque_limit_Nm: tuple[float, float] = setting(
        (12.0, 6.0), unit="Nm", low=0.0, high=1000.0, meaning="largest commanded torque"
    )
    torque_error_share: float = setting(
        0.3, low=0.01, high=10.0, meaning="largest difference of commanded and actual torque, part of rated torque"
    )
    torque_rate_limit_Nm_s: tuple[float, float] = setting(
        (2000.0, 1000.0), unit="Nm/s", low=1.0, high=1e6, meaning="largest change of commanded torque"
    )
    position_limit_deg: tuple[float, float] = setting(
        (75.0, 120.0), unit="deg", low=1.0, high=720.0, meaning="largest |q|; beyond it the run faults"
    )
    velocity_limit_deg_s: tuple[float, float] = setting(
        (250.0, 300.0), unit="deg/s", low=1.0, high=3600.0, meaning="largest |dq|; beyond it the run faults"
    )
    cad_theta: tuple[float, ...] = setting((), low=0.0, meaning="the CAD model, in the order of the parameters")

    def __post_init__(self) -> None:
        if any(sign == 0 for sign in self.sign):
            raise ValueError(f"sign = {self.sign} must be +1 or -1 for each joint")

    @property
    def position_limit_rad(self) -> Vector:
        """Largest |q|, rad (2,)."""
        return _radians(self.position_limit_deg)

    @property
    def velocity_limit_rad_s(self) -> Vector:
        """Largest |dq|, rad/s (2,)."""
        return _radians(self.velocity_limit_deg_s)


@dataclass(frozen=True)
class BusSettings:
    """Timing on the bus, and who else is on it."""

    period_us: int = setting(1000, unit="µs", low=500, high=10_000, meaning="SYNC period, 0x1006")
    heartbeat_ms: int = setting(100, unit="ms", low=10, high=10_000, meaning="heartbeat period, 0x1017")
    command_patience_cycles: int = setting(
        10, low=1, high=255, meaning="SYNCs without a new command until a drive faults by itself, 0x2200"
    )
    sync_patience_periods: float = setting(
        1.5, low=1.1, high=25.5, meaning="periods without SYNC until a drive faults by itself, 0x2201 in tenths"
    )
    max_age_cycles: int = setting(3, low=1, high=100, meaning="oldest usable value; older faults the run")
    feedback_timeout_ms: int = setting(
        1000, unit="ms", low=1, high=60_000, meaning="lockstep: longest wait for one cycle's feedback"
    )
    arms: int = setting(
        1, low=1, high=7, meaning="arms of this contract on the bus, each with a host; from 2 on it is shared"
    )
    host_node: int = setting(127, low=1, high=127, meaning="node id of this host; each host on the bus has its own")
    sync: str = setting(
        "produce", choices=("produce", "follow"), meaning="send SYNC, or begin each cycle with that of another host"
    )
    schedule: str = setting(
        "same_cycle",
        choices=("same_cycle", "pipelined"),
        meaning="commands leave when they are ready, to act at the next SYNC; or behind that one, to act one later",
    )
    sync_timeout_ms: int = setting(
        100, unit="ms", low=1, high=60_000, meaning="follow: longest wait for SYNC; the drives have stopped before"
    )

    def __post_init__(self) -> None:
        if self.follows and not self.is_shared:
            raise ConfigError("`bus.sync` = 'follow' needs another arm's host on the bus, but `bus.arms` = 1")

    @property
    def is_shared(self) -> bool:
        """Whether other hosts and their arms are on the bus."""
        return self.arms > 1

    @property
    def follows(self) -> bool:
        """Whether another host sends SYNC."""
        return self.sync == "follow"

    @property
    def is_pipelined(self) -> bool:
        """Whether the commands of a cycle leave behind the SYNC of the next."""
        return self.schedule == "pipelined"

    @property
    def period_s(self) -> float:
        """SYNC period in s."""
        return self.period_us * 1e-6

    @property
    def period_ns(self) -> int:
        """SYNC period in ns."""
        return self.period_us * 1000


@dataclass(frozen=True)
class DataSettings:
    """How much of the cyclic data may be missing. Shares are of the cycles of any second with enabled drives."""

    blind_cycles: int = setting(
        5,
        low=2,
        high=1000,
        meaning="cycles in a row without a fresh sample for the model that fault the run; bus.max_age_cycles if more",
    )
    incomplete_share: float = setting(
        0.1, low=0.0, high=1.0, meaning="cycles in which some frame is missing or late; more is said and judged"
    )
    no_new_data_share: float = setting(
        0.05, low=0.0, high=1.0, meaning="cycles without a new frame of one device; more is said and judged"
    )
    repeated_share: float = setting(
        0.01, low=0.0, high=1.0, meaning="cycles with a repeated frame of one device; more is said and judged"
    )


@dataclass(frozen=True)
class DevicesSettings:
    """Which devices are on the bus, by joint, and the contract that describes their frames."""

    drive: tuple[str, str] = setting(
        ("adacd-drive", "adacd-drive"), meaning="device profile: a built-in name or a file"
    )
    sensor: tuple[str, str] = setting(
        ("adacd-sensor", "adacd-sensor"), meaning="device profile: a built-in name or a file"
    )
    drive_node: tuple[int, int] = setting((1, 2), low=1, high=126, meaning="CANopen node ids")
    sensor_node: tuple[int, int] = setting((3, 4), low=1, high=126, meaning="CANopen node ids")
    contract: str = setting("arm", meaning="a DBC in dbc/ by name, or a file; empty: composed from the profiles")
    boot_timeout_s: float = setting(
        2.0, unit="s", low=0.1, high=60.0, meaning="longest wait for the nodes to boot after a reset of communication"
    )
    start: str = setting("sensors_first", choices=("sensors_first", "all"), meaning="order of the NMT start commands")
    reread_ms: int = setting(
        100, unit="ms", low=0, high=60_000, meaning="how often one object of the set-up is read again; 0: never"
    )
    quick_stop_option: int | None = setting(None, low=0, high=8, meaning="0x605A of the drives; unset: the profile's")
    fault_reaction_option: int | None = setting(
        None, low=0, high=4, meaning="0x605E of the drives; unset: the profile's"
    )
    bitrate: int = setting(1_000_000, unit="bit/s", low=10_000, high=1_000_000, meaning="of a composed contract")
    data_bitrate: int = setting(
        5_000_000, unit="bit/s", low=0, high=8_000_000, meaning="CAN FD data phase of a composed contract; 0: classic"
    )

    def __post_init__(self) -> None:
        nodes = (*self.drive_node, *self.sensor_node)
        if len(set(nodes)) != len(nodes):
            raise ValueError(f"node ids {', '.join(map(str, nodes))} of drives and sensors must differ")


@dataclass(frozen=True)
class FilterSettings:
    """Eq. (16): F(s) = b / (s + a)."""

    a_rad_s: float = setting(10.0, unit="rad/s", low=0.1, high=1000.0, meaning="cut-off; 10 rad/s is 1.59 Hz")
    b_rad_s: float = setting(
        10.0, unit="rad/s", low=0.1, high=1000.0, meaning="gain; DC gain b/a scales every threshold"
    )


_GRAVITY_P0 = (50.0, 50.0)
"""Gravity's torques are some ten times those of Coulomb friction, whose gain is 0.5; a gain goes by their square."""


@dataclass(frozen=True)
class EstimatorSettings:
    """Eq. (10)."""

    law: str = setting(
        "least_squares", choices=("least_squares", "gradient"), meaning="P from P(0) by least squares, or constant"
    )
    P0: tuple[float, ...] = setting(
        (8.0, 4.0, 4.0, 0.5, 0.5, 0.5, 0.5),
        low=0.0,
        high=1e6,
        meaning="diagonal of P(0), continuous-time gain, 1/s; with gravity those of a4 and a5 may be left out: 50",
    )
    gravity: bool = setting(False, meaning="add a4 and a5: joint axes that are not vertical")

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the estimated parameters, in order."""
        return PARAMETER_NAMES + (GRAVITY_PARAMETER_NAMES if self.gravity else ())

    def __post_init__(self) -> None:
        if self.gravity and len(self.P0) == len(PARAMETER_NAMES):
            object.__setattr__(self, "P0", self.P0 + _GRAVITY_P0)
        if len(self.P0) != len(self.parameter_names):
            names = ", ".join(self.parameter_names)
            raise ConfigError(
                f"`estimator.P0` has {len(self.P0)} values, {len(self.parameter_names)} expected: {names}"
            )


@dataclass(frozen=True)
class TerminationSettings:
    """Eq. (15) and the evidence it needs."""

    beta_Nm: float = setting(0.1, unit="Nm", low=0.001, high=100.0, meaning="bound on |tau_ext_hat| of each joint")
    hold_s: float = setting(5.0, unit="s", low=0.1, high=600.0, meaning="T: how long the bound must hold")
    timeout_s: float = setting(60.0, unit="s", low=1.0, high=3600.0, meaning="longest adaptation; then FAULT")
    travel_deg: float = setting(20.0, unit="deg", low=0.0, high=360.0, meaning="travel of each joint to count as moved")
    velocity_deg_s: float = setting(
        10.0, unit="deg/s", low=0.0, high=360.0, meaning="speed that each joint must reach both ways"
    )
    excitation_Nm2s: float = setting(
        2e-4, unit="Nm² s", low=0.0, high=1e6, meaning="smallest eigenvalue of the scaled information matrix"
    )
    excitation_scale: tuple[float, float, float, float] = setting(
        (0.1, 0.05, 0.05, 1.0),
        low=1e-6,
        high=1e6,
        meaning="error that must not stay hidden: inertia kg m², viscous Nm s/rad, Coulomb Nm, gravity Nm",
    )


@dataclass(frozen=True)
class DetectorSettings:
    """Eq. (14)."""

    threshold_Nm: tuple[float, float] = setting((0.15, 0.15), unit="Nm", low=0.001, high=100.0, meaning="per joint")
    standstill_rad_s: float = setting(
        0.01, unit="rad/s", low=0.0, high=1.0, meaning="|dq| below which friction may hold any torque up to F_c; 0: off"
    )
    isolation_window_s: float = setting(
        0.05, unit="s", low=0.0, high=1.0, meaning="after detection, until the link is final"
    )
    collision_Nm: tuple[float, float] = setting(
        (2.0, 1.0), unit="Nm", low=0.01, high=1000.0, meaning="upper threshold; `paper`: any contact is a collision"
    )


REACTIONS = tuple(reaction.name.lower() for reaction in Reaction)
"""What can be done about a contact, as a configuration says it."""


FRICTION_TERMS = ("stribeck", "load", "asymmetric", "width", "dahl_short", "dahl_long")
"""Optional friction terms of the certified scheme, one parameter per joint each; see `scheme.friction`."""
CROSS_TALK = "cross_talk"
"""What each torque sensor shows of the other joint's torque, Nm/Nm."""

_KINDS = "inertia kg m², viscous Nm s/rad, Coulomb Nm, gravity Nm, torque offset Nm, lag s, further friction Nm"


@dataclass(frozen=True)
class CertifiedSettings:
    """The scheme that goes beyond the paper: what is believed, when it is enough, and what stands out from it.

    Seven numbers are by kind of parameter: inertia, viscous friction, Coulomb friction, gravity, torque offset, lag,
    further friction.
    """

    cutoffs_rad_s: tuple[float, ...] = setting(
        (10.0, 50.0, 200.0), unit="rad/s", low=1.0, high=1000.0, meaning="filters of the bank, from slow to fast"
    )
    smoothing_rad_s: float = setting(
        200.0, unit="rad/s", low=10.0, high=3000.0, meaning="second low-pass behind each filter, against velocity noise"
    )
    noise_sigmas: float = setting(6.5, low=1.0, high=50.0, meaning="threshold in deviations of the torque's noise")
    model_sigmas: float = setting(5.0, low=1.0, high=50.0, meaning="threshold in deviations of the model")
    friction_terms: tuple[str, ...] = setting(
        ("stribeck", "load", "dahl_short", "dahl_long"),
        choices=FRICTION_TERMS,
        meaning="friction beyond viscous and Coulomb",
    )
    dahl_rad: tuple[float, float] = setting(
        (0.001, 0.004), unit="rad", low=1e-6, high=1.0, meaning="bristle lengths of dahl_short and dahl_long"
    )
    cross_talk_std: float = setting(
        0.01,
        low=0.0,
        high=0.5,
        meaning="part of the other joint's torque that a torque sensor shows, a deviation; 0: not identified",
    )
    still_rad_s: float = setting(
        0.002,
        unit="rad/s",
        low=0.0,
        high=1.0,
        meaning="|dq| below which a joint may stand still; above the noise of dq",
    )
    coulomb_width_rad_s: float = setting(
        0.0, unit="rad/s", low=0.0, high=1.0, meaning="Coulomb friction is F_c tanh(dq / width); 0: F_c sgn(dq)"
    )
    stribeck_rad_s: float = setting(
        0.05, unit="rad/s", low=1e-3, high=10.0, meaning="speed over which static friction falls off"
    )
    prior_std: tuple[float, ...] = setting(
        (1.0, 0.5, 0.5, 10.0, 0.3, 0.001, 0.2), low=0.0, high=1e6, meaning=f"what an arm may be: {_KINDS}"
    )
    enough_std: tuple[float, ...] = setting(
        (0.02, 0.04, 0.04, 0.2, 0.04, 0.004, 0.2), low=0.0, high=1e6, meaning=f"how well it must be known: {_KINDS}"
    )
    drift_std: tuple[float, ...] = setting(
        (0.0, 0.0015, 0.0015, 0.0, 0.0005, 0.0, 0.0015),
        low=0.0,
        high=1e3,
        meaning=f"how far it may wander in a second of monitoring: {_KINDS}",
    )
    model_error: tuple[float, ...] = setting(
        (0.003, 0.01, 0.01, 0.01, 0.0, 0.1, 0.1), low=0.0, high=1.0, meaning=f"part that no model explains: {_KINDS}"
    )
    payload_std_kg: float = setting(3.0, unit="kg", low=0.0, high=1000.0, meaning="what a payload at the tip may weigh")
    payload_inertia_std: float = setting(
        0.02, unit="kg m²", low=0.0, high=100.0, meaning="what it may add to each inertia beside a point mass"
    )
    residual_Nm: float = setting(0.02, unit="Nm", low=1e-4, high=10.0, meaning="residual of one filtered sample")
    learn_every: int = setting(4, low=1, high=100, meaning="samples between two that are learnt")
    hold_back_s: float = setting(
        0.06, unit="s", low=0.0, high=1.0, meaning="how long a sample waits until it is learnt; a contact discards it"
    )
    recover_s: float = setting(0.5, unit="s", low=0.0, high=60.0, meaning="after a contact, nothing is learnt so long")
    fit_s: tuple[float, float] = setting(
        (1.4, 0.45), unit="s", low=0.05, high=600.0, meaning="shortest fit: of the arm, of a payload"
    )
    test_s: tuple[float, float] = setting(
        (0.6, 0.35), unit="s", low=0.05, high=600.0, meaning="test of the frozen model: of the arm, with a payload"
    )
    beta_Nm: float = setting(
        0.1, unit="Nm", low=1e-3, high=100.0, meaning="test: largest |tau_ext_hat| of the slowest filter"
    )
    excitation_Nm2s: float = setting(
        5e-5, unit="Nm² s", low=0.0, high=1e6, meaning="smallest eigenvalue of the scaled information matrix"
    )
    condition: float = setting(1e5, low=1.0, high=1e12, meaning="largest condition number of the same matrix")
    refine_s: float = setting(4.0, unit="s", low=0.1, high=3600.0, meaning="test of a refined model before it is used")
    torque_noise_Nm: float = setting(0.02, unit="Nm", low=0.0, high=10.0, meaning="torque sensor, rms of one sample")
    velocity_noise_rad_s: float = setting(
        3.3e-3, unit="rad/s", low=0.0, high=1.0, meaning="velocity, largest error of one sample"
    )
    lag_s: float = setting(
        0.00125, unit="s", low=0.0, high=0.1, meaning="expected age of the velocity when the torque is new; identified"
    )
    standstill_share: float = setting(1.0, low=0.0, high=10.0, meaning="part of F_c that is uncertain at rest")

    def __post_init__(self) -> None:
        if len(self.cutoffs_rad_s) < 2:
            raise ConfigError(f"`certified.cutoffs_rad_s` has {len(self.cutoffs_rad_s)} values, at least 2 expected")
        if list(self.cutoffs_rad_s) != sorted(self.cutoffs_rad_s):
            raise ConfigError(f"`certified.cutoffs_rad_s` = {self.cutoffs_rad_s} must go from slow to fast")
        for name in ("prior_std", "enough_std", "drift_std", "model_error"):
            count = len(getattr(self, name))
            if count != 7:
                raise ConfigError(f"`certified.{name}` has {count} values, 7 expected: {_KINDS}")


@dataclass(frozen=True)
class ReactionSettings:
    """What is done about a contact, by its level and link. Link 1's joint is joint 1; pairs of numbers are joints."""

    distance_deg: tuple[float, float] = setting((8.0, 8.0), unit="deg", low=0.0, high=90.0, meaning="how far back")
    velocity_limit_deg_s: tuple[float, float] = setting(
        (100.0, 120.0), unit="deg/s", low=1.0, high=720.0, meaning="largest desired speed while withdrawing"
    )
    acceleration_limit_deg_s2: tuple[float, float] = setting(
        (700.0, 900.0), unit="deg/s²", low=10.0, high=20_000.0, meaning="largest desired acceleration"
    )
    position_margin_deg: float = setting(
        3.0, unit="deg", low=0.0, high=90.0, meaning="how far the withdrawal stays from the position limits"
    )
    clear_s: float = setting(
        0.5, unit="s", low=0.0, high=60.0, meaning="how long nothing pushes until the arm goes on after a contact"
    )
    patience_s: float = setting(
        10.0, unit="s", low=0.1, high=3600.0, meaning="a contact that lasts longer waits to be acknowledged"
    )
    contact: tuple[str, str] = setting(
        ("stop", "stop"), choices=REACTIONS, meaning="to a contact of link 1, of link 2; `paper` knows collisions only"
    )
    collision: tuple[str, str] = setting(
        ("withdraw", "withdraw"), choices=REACTIONS, meaning="to a collision of link 1, of link 2; `paper` withdraws"
    )
    start: str = setting(
        "desired",
        choices=("desired", "measured"),
        meaning="stop, withdraw: from where the arm was to be, or also from where a blow has thrown it",
    )
    rebound_s: float = setting(
        0.0, unit="s", low=0.0, high=1.0, meaning="how long a blow may throw the arm faster than its velocity limit"
    )
    two_sided: str = setting(
        "float", choices=("stop", "float"), meaning="to a push from the other side while withdrawing, as in a clamp"
    )
    damping_Nm_s: tuple[float, float] = setting(
        (1.0, 0.4), unit="Nm s/rad", low=0.0, high=100.0, meaning="float: what brakes a push that has ended"
    )
    friction_share: float = setting(
        0.7, low=0.0, high=1.0, meaning="float: part of the identified friction that is compensated"
    )
    mass_kg_m2: tuple[float, float] = setting(
        (0.15, 0.06), unit="kg m²", low=1e-3, high=100.0, meaning="admittance: virtual inertia of each joint"
    )
    drag_Nm_s: tuple[float, float] = setting(
        (3.0, 1.2), unit="Nm s/rad", low=1e-3, high=1000.0, meaning="admittance: virtual damping of each joint"
    )
    deadband_Nm: tuple[float, float] = setting(
        (0.2, 0.1), unit="Nm", low=0.0, high=100.0, meaning="admittance: external torque that moves nothing"
    )
    yield_limit_deg_s: tuple[float, float] = setting(
        (60.0, 90.0), unit="deg/s", low=1.0, high=360.0, meaning="float, admittance: speed that a push may give a joint"
    )
    slow_share: float = setting(0.2, low=0.0, high=1.0, meaning="slow_down: part of the speed that is left")


@dataclass(frozen=True)
class TrajectorySettings:
    """Quintic motion between two corners."""

    amplitude_deg: tuple[float, float] = setting((30.0, 60.0), unit="deg", low=0.0, high=180.0, meaning="± per joint")
    half_period_s: tuple[float, float] = setting(
        (1.125, 4.5), unit="s", low=0.1, high=60.0, meaning="as printed (1.125, 4.5); synchronous (2.25, 2.25)"
    )
    approach_deg_s: float = setting(90.0, unit="deg/s", low=1.0, high=360.0, meaning="peak speed to the start corner")


@dataclass(frozen=True)
class ExcitationSettings:
    """The motion of the certified scheme's adaptation: periodic, from the trajectory's start corner at rest.

    In amplitudes of the trajectory, q_d = -1 + sum_n cosine_n (cos(n w t) - 1) + sine_n sin(n w t), w = 2 pi / period.
    """

    period_s: float = setting(0.0, unit="s", low=0.0, high=600.0, meaning="of the motion; 0: adapt on the trajectory")
    cosine: tuple[tuple[float, ...], tuple[float, ...]] = setting(
        ((), ()), low=-2.0, high=2.0, meaning="per joint and harmonic"
    )
    sine: tuple[tuple[float, ...], tuple[float, ...]] = setting(
        ((), ()), low=-2.0, high=2.0, meaning="per joint and harmonic"
    )

    def __post_init__(self) -> None:
        for joint in range(JOINTS):
            cosine, sine = self.cosine[joint], self.sine[joint]
            if len(cosine) != len(sine):
                raise ConfigError(
                    f"joint {joint + 1} has {len(cosine)} values in `excitation.cosine`, "
                    f"{len(sine)} in `excitation.sine`"
                )
            velocity = sum((n + 1) * value for n, value in enumerate(sine))
            acceleration = sum((n + 1) ** 2 * value for n, value in enumerate(cosine))
            if abs(velocity) > 1e-3 or abs(acceleration) > 1e-3:
                raise ConfigError(
                    f"excitation of joint {joint + 1} does not begin at rest: the sum of n sine_n = {velocity:.3g}, "
                    f"of n² cosine_n = {acceleration:.3g}, each within 0.001"
                )


@dataclass(frozen=True)
class ControllerSettings:
    """Joint PD plus identified feedforward."""

    Kp: tuple[float, float] = setting((250.0, 20.0), unit="Nm/rad", low=0.0, high=1e5, meaning="position gain")
    Kd: tuple[float, float] = setting((12.5, 0.75), unit="Nm s/rad", low=0.0, high=1e4, meaning="velocity gain")
    following_window_deg: tuple[float, float] = setting(
        (20.0, 30.0), unit="deg", low=0.1, high=360.0, meaning="largest |q - q_d| of an arm that nobody touches"
    )
    following_timeout_s: float = setting(
        0.1, unit="s", low=0.001, high=60.0, meaning="how long it may be larger until the run faults"
    )
    feedforward: bool = setting(True, meaning="feed the identified model forward once it is valid")


@dataclass(frozen=True)
class RequestSettings:
    """One entry of the operator's script."""

    at_s: float = setting(unit="s", low=0.0, high=1e6, meaning="since the drives were enabled")
    request: str = setting(choices=("payload", "payload_changed", "finish"), meaning="what the user asks")


@dataclass(frozen=True)
class OperatorSettings:
    """The user, where a script plays the user."""

    script: tuple[RequestSettings, ...] = setting((), meaning="requests by time")
    acknowledge_after_s: float = setting(
        0.0, unit="s", low=0.0, high=3600.0, meaning="acknowledge a stop by itself after this time; 0: never"
    )
    acknowledge_faults: int = setting(0, low=0, high=1000, meaning="how many faults are acknowledged by themselves")
    acknowledge_fault_after_s: float = setting(
        1.0, unit="s", low=0.0, high=3600.0, meaning="how long after a fault it is acknowledged by itself"
    )
    acknowledge_on_hardware: bool = setting(
        False, meaning="let stops and faults be acknowledged by themselves where a real arm may be on the bus, too"
    )

    @property
    def acknowledges(self) -> bool:
        """Whether stops or faults are acknowledged by themselves."""
        return self.acknowledge_after_s > 0.0 or self.acknowledge_faults > 0


@dataclass(frozen=True)
class LockstepSettings:
    """What stands for the time that passes by itself on an arm; lockstep only."""

    latency: str = setting(
        "constant",
        choices=("constant", "uniform", "lognormal"),
        meaning="distribution of the host's time between the last feedback and its commands",
    )
    latency_us: float = setting(
        60.0, unit="us", low=0.0, high=1e6, meaning="constant: it; uniform: the lowest; lognormal: the median"
    )
    latency_high_us: float = setting(
        200.0, unit="us", low=0.0, high=1e6, meaning="uniform: the highest; lognormal: exceeded by 1 in 1000"
    )
    stall_us: float = setting(0.0, unit="us", low=0.0, high=1e7, meaning="how much longer a stalled cycle takes")
    stall_every_s: float = setting(0.0, unit="s", low=0.0, high=1e6, meaning="mean time between stalls; 0: none")
    seed: int = setting(1, low=0, high=2**63 - 1, meaning="of the latency")
    stuffing: str = setting(
        "exact", choices=("exact", "worst"), meaning="length of frames: by their bits, or the longest that can be"
    )
    queue: str = setting(
        "identifier", choices=("identifier", "fifo"), meaning="which of the host's waiting frames is sent first"
    )

    def __post_init__(self) -> None:
        if self.latency != "constant" and self.latency_high_us < self.latency_us:
            raise ConfigError(
                f"`lockstep.latency_high_us` = {self.latency_high_us:g} us is below `lockstep.latency_us` = "
                f"{self.latency_us:g} us"
            )
        if self.latency == "lognormal" and self.latency_us <= 0.0:
            raise ConfigError(
                "`lockstep.latency_us` = 0 us can't be the median of a lognormal distribution; above 0 us"
            )


@dataclass(frozen=True)
class RealtimeSettings:
    """How the process that runs the cycle gets on time, and what is done when it doesn't."""

    scheduler: str = setting(
        "fifo", choices=("fifo", "deadline", "other"), meaning="SCHED_FIFO, SCHED_DEADLINE, or none of real time"
    )
    priority: int = setting(80, low=1, high=98, meaning="of SCHED_FIFO; threaded interrupts have 50, the kernel 99")
    cpu: str = setting(
        ANY_CPU, meaning="processor to stay on: its number, 'isolated' for the first isolated one, or 'any'"
    )
    lock_memory: bool = setting(True, meaning="keep all memory in place, with a reserve")
    spin_us: float = setting(
        -1.0,
        unit="µs",
        low=-1.0,
        high=1000.0,
        meaning="how long to read the clock before SYNC is due; -1: by measurement",
    )
    sample_period: str = setting(
        "measured",
        choices=("measured", "nominal"),
        meaning="interval that the scheme integrates over: between SYNCs, or `bus.period_us` as for a simulated arm "
        "that moves by whole periods; lockstep is nominal",
    )
    misses: int = setting(10, low=1, high=1_000_000, meaning="skipped periods in the window that are too many")
    misses_window_s: float = setting(1.0, unit="s", low=0.01, high=60.0, meaning="in which they are counted")
    on_misses: str = setting(
        "stop", choices=("stop", "hold"), meaning="FAULT; or, while detection is on, brake and hold until acknowledged"
    )

    def __post_init__(self) -> None:
        if self.cpu not in (ANY_CPU, ISOLATED_CPU) and not self.cpu.isdecimal():
            raise ConfigError(f"`realtime.cpu` = {self.cpu!r} must be a processor's number, 'isolated' or 'any'")
        if self.scheduler == "deadline" and self.cpu != ANY_CPU:
            raise ConfigError(
                f"`realtime.cpu` = {self.cpu!r} can't be had with `realtime.scheduler` = 'deadline', which the kernel "
                "refuses to a process that is pinned; start it in an exclusive cpuset instead"
            )


@dataclass(frozen=True)
class LogSettings:
    """The log: what may wait for its writer, and when a part of it ends and the next one begins."""

    buffer_MiB: int = setting(
        4, unit="MiB", low=1, high=256, meaning="memory between control process and writer; 6 s of cycles at 1 kHz"
    )
    part_MiB: int = setting(
        512, unit="MiB", low=0, high=1_000_000, meaning="largest part, before compression; 0: parts of any size"
    )
    part_min: float = setting(30.0, unit="min", low=0.0, high=1e6, meaning="longest part; 0: parts of any length")


@dataclass(frozen=True)
class SafetySettings:
    """Checks before torque."""

    commission_s: float = setting(
        0.2, unit="s", low=0.01, high=100.0, meaning="how long the arm rests, with complete data, before enabling"
    )
    rest_velocity_rad_s: float = setting(0.05, unit="rad/s", low=1e-4, high=1.0, meaning="|dq| that counts as at rest")
    rest_torque_Nm: float = setting(1.0, unit="Nm", low=0.01, high=100.0, meaning="largest |tau_J| before enabling")
    phase_timeout_s: float = setting(5.0, unit="s", low=0.1, high=600.0, meaning="longest COMMISSION and ENABLE")
    tolerated_emergencies: tuple[int, ...] = setting(
        (0x8200, 0x8210, 0x8240),
        low=0x0100,
        high=0xFFFF,
        meaning="EMCY error codes that don't stop the arm; any other does at once; default: one odd SYNC, a PDO "
        "or a SYNC of the wrong length",
    )


@dataclass(frozen=True)
class TareSettings:
    """Tare of the joint torque sensors: how long, how still, how far apart, and how old.

    The bounds on spread and drift are a small part of the detection threshold (0.15 Nm); an offset that is off by the
    threshold is a contact that nobody made.
    """

    poses: int = setting(1, low=1, high=50, meaning="poses to measure in")
    window_s: float = setting(2.0, unit="s", low=0.1, high=600.0, meaning="measured time in each pose")
    settle_s: float = setting(0.5, unit="s", low=0.0, high=60.0, meaning="rest before the measurement of a pose")
    move_deg: float = setting(
        10.0, unit="deg", low=1.0, high=360.0, meaning="a new pose: some joint is further than this from the last one"
    )
    move_timeout_s: float = setting(
        120.0, unit="s", low=1.0, high=3600.0, meaning="longest wait for the user to move the arm to a new pose"
    )
    creep_limit_deg: float = setting(0.1, unit="deg", low=1e-4, high=10.0, meaning="largest travel while measuring")
    std_limit_Nm: float = setting(
        0.06, unit="Nm", low=1e-6, high=100.0, meaning="largest standard deviation; sensors have about 0.02"
    )
    peak_to_peak_limit_Nm: float = setting(
        0.5, unit="Nm", low=1e-6, high=100.0, meaning="largest distance of two samples; catches a short knock"
    )
    drift_limit_Nm: float = setting(
        0.02, unit="Nm", low=1e-6, high=100.0, meaning="largest difference of the means of the window's halves"
    )
    offset_limit_Nm: tuple[float, float] = setting(
        (2.0, 2.0), unit="Nm", low=1e-3, high=50.0, meaning="largest plausible offset; beyond it something pushes"
    )
    pose_limit_Nm: float = setting(
        0.1, unit="Nm", low=1e-6, high=100.0, meaning="vertical axes: largest spread of poses; else largest residual"
    )
    missing_limit: float = setting(0.01, low=0.0, high=0.5, meaning="largest share of cycles without complete data")
    gravity_model: str = setting(
        "estimated", choices=("estimated", "cad"), meaning="with estimator.gravity: a4, a5 from the poses, or the CAD's"
    )
    condition_limit: float = setting(
        30.0, low=1.0, high=1e6, meaning="largest condition number of the poses' equations for a4, a5 and offsets"
    )
    auto_zero_limit_Nm: float = setting(
        0.02, unit="Nm", low=1e-6, high=10.0, meaning="largest torque left after the sensor's own zero, 0x6125"
    )
    warn_age_h: float = setting(24.0, unit="h", low=0.0, high=1e5, meaning="a run warns of a tare older than this")
    max_age_h: float = setting(0.0, unit="h", low=0.0, high=1e5, meaning="a run refuses one older than this; 0: never")
    drift_Nm_sqrt_s: float = setting(
        2e-5, unit="Nm/√s", low=0.0, high=1.0, meaning="random walk of a sensor's zero; take the data sheet's"
    )
    drift_Nm_K: float = setting(
        1e-3, unit="Nm/K", low=0.0, high=10.0, meaning="drift of a sensor's zero with temperature; likewise"
    )
    temperature_K: float = setting(
        5.0, unit="K", low=0.0, high=200.0, meaning="how far the temperature may be from that of the tare"
    )

    def drift_variance(self, age_s: float) -> float:
        """Return by how much a sensor's zero may have moved in so long, as a variance in Nm²."""
        return (self.drift_Nm_K * self.temperature_K) ** 2 + self.drift_Nm_sqrt_s**2 * age_s


@dataclass(frozen=True)
class HistorySettings:
    """What the arm's last certificate, of another run, says of it; `run --history` fills it in from the arm's file."""

    date_utc: str = setting("", meaning="when it was certified, ISO 8601, UTC; empty: no last certificate")
    friction_Nm: tuple[float, ...] = setting(
        (), unit="Nm", low=-1000.0, high=1000.0, meaning="of joint 1 at 0.2, 0.6, 1.2 rad/s, then of joint 2"
    )
    friction_std_Nm: tuple[float, ...] = setting((), unit="Nm", low=0.0, high=1000.0, meaning="their deviations")
    inertia_kgm2: tuple[float, ...] = setting((), unit="kg m²", low=-1000.0, high=1000.0, meaning="a1, a2, a3")
    inertia_std_kgm2: tuple[float, ...] = setting((), unit="kg m²", low=0.0, high=1000.0, meaning="their deviations")
    offset_Nm: tuple[float, ...] = setting(
        (), unit="Nm", low=-1000.0, high=1000.0, meaning="zero of each torque sensor, arm.torque_offset_Nm included"
    )
    offset_std_Nm: tuple[float, ...] = setting(
        (), unit="Nm", low=0.0, high=1000.0, meaning="their deviations, drift since the certificate included"
    )
    friction_share: float = setting(
        0.2, low=0.0, high=10.0, meaning="how far friction differs from run to run, a deviation, share of it"
    )
    inertia_share: float = setting(0.02, low=0.0, high=10.0, meaning="likewise of an inertia")

    def __post_init__(self) -> None:
        for name, values, count in (
            ("friction_Nm", self.friction_Nm, 3 * JOINTS),
            ("friction_std_Nm", self.friction_std_Nm, 3 * JOINTS),
            ("inertia_kgm2", self.inertia_kgm2, 3),
            ("inertia_std_kgm2", self.inertia_std_kgm2, 3),
            ("offset_Nm", self.offset_Nm, JOINTS),
            ("offset_std_Nm", self.offset_std_Nm, JOINTS),
        ):
            wanted = count if self.is_known else 0
            if len(values) != wanted:
                raise ValueError(
                    f"{name} has {len(values)} values, {wanted} expected with date_utc = {self.date_utc!r}"
                )

    @property
    def is_known(self) -> bool:
        """Whether there is a last certificate."""
        return bool(self.date_utc)


@dataclass(frozen=True)
class Settings:
    """Everything a run depends on, resolved. Attached to every log."""

    name: str = setting("", meaning="name of the configuration")
    scheme: str = setting("paper", choices=("paper", "certified"), meaning="the paper's scheme, or the one beyond it")
    arm: ArmSettings = setting(ArmSettings, meaning="the arm")
    bus: BusSettings = setting(BusSettings, meaning="timing on the bus")
    data: DataSettings = setting(DataSettings, meaning="how much of the cyclic data may be missing")
    devices: DevicesSettings = setting(DevicesSettings, meaning="drives and sensors")
    filter: FilterSettings = setting(FilterSettings, meaning="torque filter")
    estimator: EstimatorSettings = setting(EstimatorSettings, meaning="adaptation law")
    termination: TerminationSettings = setting(TerminationSettings, meaning="end of adaptation")
    detector: DetectorSettings = setting(DetectorSettings, meaning="collision detection")
    certified: CertifiedSettings = setting(CertifiedSettings, meaning="the scheme beyond the paper")
    reaction: ReactionSettings = setting(ReactionSettings, meaning="what is done about a contact")
    trajectory: TrajectorySettings = setting(TrajectorySettings, meaning="the motion")
    excitation: ExcitationSettings = setting(ExcitationSettings, meaning="the motion of the certified adaptation")
    controller: ControllerSettings = setting(ControllerSettings, meaning="joint controller")
    operator: OperatorSettings = setting(OperatorSettings, meaning="scripted user")
    lockstep: LockstepSettings = setting(LockstepSettings, meaning="modelled time of the host")
    realtime: RealtimeSettings = setting(RealtimeSettings, meaning="being on time")
    safety: SafetySettings = setting(SafetySettings, meaning="checks before torque")
    tare: TareSettings = setting(TareSettings, meaning="tare of the torque sensors")
    history: HistorySettings = setting(HistorySettings, meaning="the arm's last certificate")
    log: LogSettings = setting(LogSettings, meaning="the log")

    @property
    def blind_cycles(self) -> int:
        """Cycles in a row without a fresh sample that fault the run: not fewer than a value may be old."""
        return max(self.data.blind_cycles, self.bus.max_age_cycles)

    @property
    def commission_cycles(self) -> int:
        """Good cycles in a row before the drives are enabled: those of `safety.commission_s`, at least one."""
        return max(1, round(self.safety.commission_s / self.bus.period_s))

    @property
    def further_names(self) -> tuple[str, ...]:
        """Names of what the certified scheme estimates beside the dynamic parameters, in order; none of the paper's."""
        if self.scheme == "paper":
            return ()
        by_place = POSITION_TERMS if self.arm.position_torque_Nm > 0.0 else ()
        between = (CROSS_TALK,) if self.certified.cross_talk_std > 0.0 else ()
        kinds = ("offset", "lag", *self.certified.friction_terms, *between, *by_place)
        return tuple(f"{kind}{joint + 1}" for kind in kinds for joint in range(JOINTS))

    @property
    def further_count(self) -> int:
        """Number of `further_names`."""
        return len(self.further_names)

    @property
    def filter_count(self) -> int:
        """Filters in the certified scheme's bank; 0 of the paper's."""
        return len(self.certified.cutoffs_rad_s) if self.scheme == "certified" else 0

    @property
    def channel_count(self) -> int:
        """Residuals per joint that have a threshold: each filter's smoothed, and all but the slowest one's bare."""
        return max(2 * self.filter_count - 1, 0)

    @property
    def cad_theta(self) -> Vector:
        """The CAD model's parameters (p,)."""
        return np.array(self.arm.cad_theta, dtype=np.float64)

    @property
    def realtime_request(self) -> RealtimeRequest:
        """What the control process asks of the operating system."""
        wish = self.realtime
        return RealtimeRequest(wish.scheduler, wish.priority, wish.cpu, wish.lock_memory, self.bus.period_ns)

    def __post_init__(self) -> None:
        names = self.estimator.parameter_names
        if len(self.arm.cad_theta) not in (0, len(names)):
            gravity = " (`estimator.gravity` adds a4 and a5, Nm)" if self.estimator.gravity else ""
            raise ConfigError(
                f"`arm.cad_theta` has {len(self.arm.cad_theta)} values, {len(names)} expected: "
                f"{', '.join(names)}{gravity}; [] without CAD model"
            )
        if self.bus.host_node in (*self.devices.drive_node, *self.devices.sensor_node):
            raise ConfigError(f"`bus.host_node` = {self.bus.host_node} is the node id of a device")


def renewed(table: dict[str, Any]) -> dict[str, Any]:
    """Return the configuration of a log with today's keys in place of those that older versions had.

    A log has every key that there was when it was written, so one that is missing was not in the model.
    """
    certified = table.get("certified")
    if isinstance(certified, dict) and "cross_talk_std" not in certified:
        table = table | {"certified": certified | {"cross_talk_std": 0.0}}
    safety = table.get("safety")
    if not isinstance(safety, dict) or "commission_cycles" not in safety:
        return table
    bus = table.get("bus")
    period_us = bus.get("period_us", 1000) if isinstance(bus, dict) else 1000
    cycles = safety["commission_cycles"]
    if not (isinstance(cycles, int) and isinstance(period_us, int)):
        return table
    kept = {key: value for key, value in safety.items() if key != "commission_cycles"}
    return table | {"safety": kept | {"commission_s": cycles * period_us * 1e-6}}


def merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """Lay one TOML table over another, section by section."""
    merged = dict(base)
    for key, value in over.items():
        if isinstance(value, dict) and isinstance(merged.get(key), dict):
            merged[key] = merge(merged[key], value)
        else:
            merged[key] = value
    return merged


def read_toml(path: Path, kind: str = "configuration") -> dict[str, Any]:
    """Read one TOML file; `kind` says what it is in errors.

    Raises ConfigError when it is missing, no regular file, too large or not TOML.
    """
    try:
        return parse_toml(read_input(path, _MOST_TOML_BYTES))
    except FileNotFoundError:
        raise ConfigError(f"{kind} {path} does not exist") from None
    except (OSError, ConfigError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ConfigError(f"{kind} {path}: {reason}") from None


def parse_toml(text: bytes | str) -> dict[str, Any]:
    """Read TOML, tables at most 16 deep and integers of 64 bits. Raises ConfigError with what is wrong.

    A byte order mark at the beginning, which editors on Windows write, is left out.
    """
    try:
        text = (text if isinstance(text, str) else text.decode("utf-8")).removeprefix("\ufeff")
        if _TOO_DEEP.search(text):  # such a key takes its reader a time that goes by the square
            raise RecursionError
        table = tomllib.loads(text)
    except RecursionError:
        raise ConfigError(f"more than {_DEEPEST} tables or lists within each other") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"byte {error.start} is not UTF-8") from None
    except ValueError as error:  # of TOML, and of integers that are too long to be read
        raise ConfigError(one_line(error)) from None
    _check_extent(table)
    return table


def _check_extent(table: dict[str, Any]) -> None:
    """Refuse what would not end well further on: very deep tables, integers that no float can hold."""
    waiting: list[tuple[str, Any, int]] = [("", table, 0)]
    while waiting:
        key, value, depth = waiting.pop()
        if depth > _DEEPEST:
            raise ConfigError(f"`{key}`: more than {_DEEPEST} tables or lists within each other")
        if isinstance(value, dict):
            waiting += [(f"{key}.{name}".lstrip(".")[:_LONGEST_KEY], item, depth + 1) for name, item in value.items()]
        elif isinstance(value, list):
            waiting += [(key, item, depth + 1) for item in value]
        elif isinstance(value, int) and not -(2**63) <= value < 2**63:
            raise ConfigError(f"`{key}` is an integer of more than 64 bits")


_MOST_TOML_BYTES = 1 << 20
_DEEPEST = 16
_LONGEST_KEY = 80
_TOO_DEEP = re.compile(r"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*"|'[^'\n]*')[ \t]*\.[ \t]*){64}""")
_LONGEST_CHAIN = 8
"""Configurations that extend each other."""
_MOST_NAMES = 12
"""More built-in names than this make no line that anybody reads."""


def toml_names(folder: Traversable) -> list[str]:
    """Name the TOML files of a package's folder, without their ending."""
    return sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml"))


def find_toml(kind: str, name_or_file: str, folder: Traversable) -> Path:
    """Find the file that a built-in name or a path stands for. Raises ConfigError with the nearest built-in name."""
    names = toml_names(folder)
    if name_or_file in names:
        return Path(str(folder / f"{name_or_file}.toml"))
    path = Path(name_or_file)
    if not name_or_file or (not path.suffix and not exists(path)):
        nearest = nearest_name(name_or_file, names)
        some = ", ".join(names) if len(names) <= _MOST_NAMES else f"{len(names)}, such as {', '.join(names[:3])}"
        hint = f"; did you mean {nearest!r}?" if nearest else f"; built in: {some}"
        raise ConfigError(f"{kind} {name_or_file!r} is neither built in nor a file{hint}")
    return path


def _builtin_folder() -> Traversable:
    return resources.files("adacd_hil") / "configs"


def builtin_names() -> list[str]:
    """Name the configurations that come with the package."""
    return toml_names(_builtin_folder())


def load_settings(name_or_file: str = "paper", profile: str | None = None) -> Settings:
    """Resolve a configuration: a built-in name, or a TOML file laid over the one it `extends` (default `paper`).

    `profile` picks the `[profiles.X]` table that is laid over the rest. Raises ConfigError.
    """
    table = _load_table(name_or_file)
    profiles = _table_in(table, "profiles", "`profiles`")
    table.pop("profiles", None)
    chosen = profile or _table_in(table, "arm", "`arm`").get("profile", "P")
    if not isinstance(chosen, str) or chosen not in profiles:
        raise ConfigError(f"profile {chosen!r} is not in configuration {name_or_file}; known: {', '.join(profiles)}")
    _table_in(profiles, chosen, f"`profiles.{chosen}`")
    # What the file says of the arm outweighs the profile's own values, not the other way round.
    return parse(Settings, merge(merge(profiles[chosen], table), {"arm": {"profile": chosen}}))


def _table_in(table: dict[str, Any], key: str, name: str) -> dict[str, Any]:
    """Return a table within a table, empty where it isn't there. Raises ConfigError when it is no table."""
    value = table.get(key, {})
    if not isinstance(value, dict):
        raise ConfigError(f"{name} = {value!r} must be a table")
    return value


def _load_table(name_or_file: str, seen: tuple[str, ...] = ()) -> dict[str, Any]:
    """Read a configuration and all that it extends; a relative path is taken from the file that names it."""
    if name_or_file in seen:
        raise ConfigError(f"configuration {name_or_file} extends itself")
    if len(seen) > _LONGEST_CHAIN:
        raise ConfigError(f"configuration {seen[0]} extends more than {_LONGEST_CHAIN} others, one by one")
    path = find_toml("configuration", name_or_file, _builtin_folder())
    table = read_toml(path)
    table.setdefault("name", path.stem)
    if "extends" not in table and name_or_file in builtin_names():
        return table
    extended = table.pop("extends", "paper")
    if not isinstance(extended, str):
        raise ConfigError(f"`extends` = {extended!r} must be the name of a configuration or a file")
    if extended not in builtin_names() and Path(extended).suffix:
        extended = str(path.parent / extended)
    return merge(_load_table(extended, (*seen, name_or_file)), table)


def to_toml(settings: Any) -> str:
    """Write settings as TOML that `parse` reads back to the same value."""
    lines: list[str] = []
    _write_section(settings, "", lines)
    return "\n".join(lines).strip() + "\n"


def to_short_toml(settings: Any) -> str:
    """Write what differs from the defaults, a row per line, as TOML that `parse` reads back to the same value."""
    lines: list[str] = []
    _write_section(settings, "", lines, is_short=True)
    return "\n".join(lines).strip() + "\n"


def is_default(field: "dataclasses.Field[Any]", value: Any) -> bool:
    """Tell whether a setting has the value that it has when it is absent."""
    if field.default_factory is not dataclasses.MISSING:
        return bool(value == field.default_factory())
    return field.default is not dataclasses.MISSING and bool(value == field.default)


def _write_section(section: Any, prefix: str, lines: list[str], is_short: bool = False) -> None:
    nested = []
    for field in dataclasses.fields(section):
        value = getattr(section, field.name)
        if is_short and is_default(field, value):
            continue
        if dataclasses.is_dataclass(value):
            nested.append((field.name, value))
        elif isinstance(value, tuple) and value and dataclasses.is_dataclass(value[0]):
            rows = ["{" + _inline(item, is_short) + "}" for item in value]
            if is_short:
                lines.extend((f"{field.name} = [", *(f"    {row}," for row in rows), "]"))
            else:
                lines.append(f"{field.name} = [{', '.join(rows)}]")
        elif value is not None:
            lines.append(f"{field.name} = {_toml_value(value)}")
    for name, value in nested:
        lines.extend(("", f"[{prefix}{name}]"))
        _write_section(value, f"{prefix}{name}.", lines, is_short)


def _inline(section: Any, is_short: bool) -> str:
    values = [
        (field.name, value)
        for field in dataclasses.fields(section)
        if (value := getattr(section, field.name)) is not None and not (is_short and is_default(field, value))
    ]
    return ", ".join(f"{name} = {_toml_value(value)}" for name, value in values)


_TOML_ESCAPES = {code: f"\\u{code:04X}" for code in (*range(0x20), 0x7F)} | {
    ord('"'): '\\"',
    ord("\\"): "\\\\",
}


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return '"' + value.translate(_TOML_ESCAPES) + '"'
    if isinstance(value, tuple):
        return "[" + ", ".join(_toml_value(item) for item in value) + "]"
    return repr(value)
