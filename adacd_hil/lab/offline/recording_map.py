"""The map of a recording: meaning and unit of each column, and the arm that was recorded.

One TOML file. Scales turn the recorded values, after their unit, into rad, rad/s and Nm, positive along the URDF's
joint axes: -1.0 turns a sign, a drive's gain in Nm/A makes torques of currents.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from adacd_hil.file_access import read_input
from adacd_hil.lab.serial_arm.offline import OfflineSettings
from adacd_hil.lab.serial_arm.urdf import STANDARD_GRAVITY_M_S2, SerialArm, UrdfError, read_urdf
from adacd_hil.records import Vector
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.schema import ConfigError, setting
from adacd_hil.settings.toml_files import read_toml

ISO = "iso"
TIME_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, ISO: 1.0}
ANGLE_RAD = {"rad": 1.0, "deg": math.pi / 180.0, "rev": 2.0 * math.pi}
_SPEED = {"rad/s": 1.0, "deg/s": math.pi / 180.0, "rpm": math.pi / 30.0}
_TORQUE = {"Nm": 1.0, "mNm": 1e-3, "A": 1.0, "mA": 1e-3}
_UNITS = {"q": ANGLE_RAD, "dq": _SPEED, "tau_J": _TORQUE}
_USUAL_PERIOD_S = (2e-4, 0.1)
_SPELLINGS = {
    **{unit.casefold(): unit for units in (TIME_S, ANGLE_RAD, _SPEED, _TORQUE) for unit in units},
    **{"sec": "s", "seconds": "s", "msec": "ms", "\N{MICRO SIGN}s": "us", "\N{GREEK SMALL LETTER MU}s": "us"},
    **{"°": "deg", "degree": "deg", "degrees": "deg", "°/s": "deg/s", "degs": "deg/s", "rads": "rad/s", "amp": "A"},
    **{f"{milli}n{times}m": f"{milli}Nm" for milli in ("", "m") for times in ("*", "·", " ", ".", "-")},
}


def unit_of(text: str) -> str:
    """Return the unit that a text names, such as "[degrees]" or "msec", as the map spells it; "" for any other text.

    Upper and lower case don't matter.
    """
    return _SPELLINGS.get(text.strip(" []()").casefold(), "")


def time_unit_of(step: float) -> str:
    """Return the first of s, ms, us, ns in which a step between rows is within `_USUAL_PERIOD_S`; "" without one."""
    low_s, high_s = _USUAL_PERIOD_S
    return next((unit for unit in ("s", "ms", "us", "ns") if low_s <= step * TIME_S[unit] <= high_s), "")


@dataclass(frozen=True)
class ArmSection:
    """The arm that was recorded."""

    urdf: str = setting(meaning="file, relative to the map")
    gravity_m_s2: tuple[float, float, float] = setting(
        STANDARD_GRAVITY_M_S2, unit="m/s²", low=-1e3, high=1e3, meaning="in the root's axes"
    )
    locked: tuple[str, ...] = setting((), meaning="joints that do not move")
    has_rotors: bool = setting(False, meaning="torques are those of geared motors, which turn their rotors too")


@dataclass(frozen=True)
class ColumnsSection:
    """Heads or numbers of the columns, or a bag's names of the joints; in the order of the joints from the base."""

    time: str = setting("", meaning="of the sample; none: a row every sampling.period_s")
    q: tuple[str, ...] = setting((), meaning="joint positions; of a bag names of its joints, else those of the URDF")
    tau_J: tuple[str, ...] = setting((), meaning="joint torques, or currents; none of a bag, which has efforts")
    dq: tuple[str, ...] = setting((), meaning="joint velocities; none: derived from the positions")
    contact: str = setting("", meaning="not 0 while somebody touches the arm; none: not known")


@dataclass(frozen=True)
class UnitsSection:
    """Units of the columns."""

    time: str = setting(
        "s", choices=tuple(TIME_S), meaning="of the time; iso: a date and time such as 2024-05-01T10:00:00.005"
    )
    q: str = setting("rad", choices=tuple(ANGLE_RAD), meaning="of positions")
    dq: str = setting("rad/s", choices=tuple(_SPEED), meaning="of velocities")
    tau_J: str = setting("Nm", choices=tuple(_TORQUE), meaning="of torques; of currents, scale.tau_J has the gains")


@dataclass(frozen=True)
class ScaleSection:
    """A factor per joint, after the unit; 1 if it is empty."""

    q: tuple[float, ...] = setting((), low=-1e9, high=1e9, meaning="of positions and velocities")
    tau_J: tuple[float, ...] = setting((), low=-1e9, high=1e9, meaning="of torques; Nm/A of currents")


@dataclass(frozen=True)
class CsvSection:
    """The form of the file."""

    delimiter: str = setting(",", choices=(",", ";", "\t", " "), meaning="between two columns")
    decimal: str = setting(".", choices=(".", ","), meaning="sign before the decimals")
    has_header: bool = setting(True, meaning="whether the first row names the columns")
    skip_rows: int = setting(0, low=0, high=10_000, meaning="lines before that")


@dataclass(frozen=True)
class BagSection:
    """Topic and stamp of the joints' states in an MCAP file or a rosbag."""

    topic: str = setting("", meaning="of sensor_msgs/JointState; none: the only one, or /joint_states")
    time: str = setting(
        "header", choices=("header", "received"), meaning="stamp of the message, or when it was recorded"
    )


@dataclass(frozen=True)
class SamplingSection:
    """Period and longest gap of the samples, and window of derived velocities."""

    period_s: float = setting(
        0.0,
        unit="s",
        low=0.0,
        high=0.05,
        meaning="of the samples, and of the rows without a time; 0: the recording's median",
    )
    longest_gap_s: float = setting(0.05, unit="s", low=1e-3, high=10.0, meaning="a longer one parts the recording")
    smoothing_s: float = setting(
        0.03, unit="s", low=1e-3, high=1.0, meaning="window of the derivative where velocities are derived"
    )


def units_by_slope(units: UnitsSection, factor: float) -> list[tuple[str, str]]:
    """Return the single changes of the map's units that bring velocities within 10 % of the positions' slope.

    Each is (key, unit), those of dq before those of q; empty if none does. factor: velocities over slope with the
    present units.
    """
    found = [("dq", unit) for unit, value in _SPEED.items() if _is_near_one(factor * value / _SPEED[units.dq])]
    found += [("q", unit) for unit, value in ANGLE_RAD.items() if _is_near_one(factor * ANGLE_RAD[units.q] / value)]
    return [(key, unit) for key, unit in found if getattr(units, key) != unit]


def _is_near_one(value: float) -> bool:
    return abs(value - 1.0) < 0.1


@dataclass(frozen=True)
class RecordingMap:
    """A map, and the arm that it names.

    n, the number of moving joints, is the length of each list of columns or scales that isn't empty. scheme: keys of
    `OfflineSettings` with the map's values.
    """

    urdf: SerialArm
    arm: ArmSection
    columns: ColumnsSection
    scheme: dict[str, Any]  # keys of OfflineSettings, which override its defaults and the recording's estimates
    units: UnitsSection = UnitsSection()
    scale: ScaleSection = ScaleSection()
    csv: CsvSection = CsvSection()
    bag: BagSection = BagSection()
    sampling: SamplingSection = SamplingSection()

    @property
    def joints(self) -> int:
        """Number of joints, n."""
        return len(self.urdf.joint_names)

    @property
    def time_s(self) -> float:
        """One unit of the recorded times in s; 1 for dates."""
        return TIME_S[self.units.time]

    def factors(self, key: str) -> tuple[float, ...]:
        """Factor from each recorded value to rad, rad/s or Nm: unit times scale (n,). key: "q", "dq" or "tau_J".

        Velocities have the scale of the positions. The unit's factor of A is 1, of mA 0.001.
        """
        unit = _UNITS[key][getattr(self.units, key)]
        return tuple(unit * factor for factor in self._scale("tau_J" if key == "tau_J" else "q"))

    def _scale(self, key: str) -> tuple[float, ...]:
        given: tuple[float, ...] = getattr(self.scale, key)
        return given or (1.0,) * self.joints

    def scaled(self, key: str, factors: Vector) -> str:
        """Return the map's line `scale.KEY` with its present values times factors (n,), as text.

        key: "q" or "tau_J".
        """
        values = np.array(self._scale(key)) * factors
        return f"`scale.{key}` = [{', '.join(f'{value:g}' for value in values)}]"

    def settings(self, noise_Nm: tuple[float, ...], period_s: float, velocity_noise_rad_s: float) -> OfflineSettings:
        """Return the scheme's settings: those of the map, else the given estimates, else the defaults.

        Raises ConfigError for a key or a value that `OfflineSettings` doesn't allow.
        """
        shown = {"noise_Nm": list(noise_Nm), "period_s": period_s, "velocity_noise_rad_s": velocity_noise_rad_s}
        return parse(OfflineSettings, shown | self.scheme, "scheme.")


_SECTIONS = {
    "arm": ArmSection,
    "columns": ColumnsSection,
    "units": UnitsSection,
    "scale": ScaleSection,
    "csv": CsvSection,
    "bag": BagSection,
    "sampling": SamplingSection,
}


def read_map(path: Path) -> RecordingMap:
    """Read a map and the URDF that it names. Raises ConfigError if it can't be read, or as `parse_map`."""
    return parse_map(read_toml(path, "map"), path)


def parse_map(table: dict[str, Any], path: Path) -> RecordingMap:
    """Return a map by its TOML table, and read the URDF that it names. path: of the map; it need not exist.

    Raises ConfigError if the URDF can't be read, a section, key or value is wrong, or as `_check_lengths`.
    """
    unknown = [key for key in table if key not in (*_SECTIONS, "scheme")]
    if unknown:
        raise ConfigError(f"{path}: unknown section `{unknown[0]}`; known: {', '.join((*_SECTIONS, 'scheme'))}")
    try:
        sections: dict[str, Any] = {
            name: parse(section, table.get(name, {}), f"{name}.") for name, section in _SECTIONS.items()
        }
        scheme = checked_scheme(dict(table.get("scheme", {})), "scheme.")
        urdf = _read_arm(path.parent, sections["arm"])
        found = RecordingMap(**sections, scheme=scheme, urdf=urdf)
        _check_lengths(found)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    return found


def checked_scheme(scheme: dict[str, Any], prefix: str) -> dict[str, Any]:
    """Return settings of the scheme, as given. prefix: of their keys in errors.

    Raises ConfigError for a key or value that `OfflineSettings` doesn't allow, and for `period_s`, which the recording
    gives.
    """
    if "period_s" in scheme:
        raise ConfigError(f"`{prefix}period_s` is no setting: the recording's own period is taken")
    parse(OfflineSettings, {"noise_Nm": [1.0]} | scheme, prefix)
    return scheme


def _read_arm(folder: Path, arm: ArmSection) -> SerialArm:
    file = folder / arm.urdf
    try:
        return read_urdf(read_input(file), arm.gravity_m_s2, arm.locked)
    except OSError as error:
        raise ConfigError(f"`arm.urdf`: {file}: {error.strerror}") from None
    except UrdfError as error:
        raise ConfigError(f"`arm.urdf`: {file}: {error}") from None


def _check_lengths(found: RecordingMap) -> None:
    """Raise ConfigError for a list of `columns`, `scale` or `scheme.noise_Nm` without a value per moving joint.

    An empty list passes. A joint that is locked doesn't count as moving.
    """
    lists: dict[str, tuple[Any, ...]] = {
        "columns.q": found.columns.q,
        "columns.tau_J": found.columns.tau_J,
        "columns.dq": found.columns.dq,
        "scale.q": found.scale.q,
        "scale.tau_J": found.scale.tau_J,
        "scheme.noise_Nm": tuple(found.scheme.get("noise_Nm", ())),
    }
    for key, values in lists.items():
        if values and len(values) != found.joints:
            raise ConfigError(f"`{key}` has {len(values)} values; the arm has {found.joints} moving joints")
