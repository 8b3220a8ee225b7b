"""The tare file, as TOML, and the checks before its use.

It has the offsets of the torque sensors with their provenance, in joint direction: `arm.torque_offset_Nm` subtracts
them after the sign. It belongs to the sensors that were tared, by their serial numbers of 0x1018:4.
"""

import dataclasses
import math
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from adacd_hil.control.device_record import DeviceRecord, read_record
from adacd_hil.dates import MOST_AHEAD_H, NS_PER_H, date_ns
from adacd_hil.device.canopen_bus import DeviceError
from adacd_hil.device.network import Identity
from adacd_hil.file_replacement import replacing
from adacd_hil.log.log_files import TARE_NAME
from adacd_hil.records import JOINTS, Event
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.run_settings import TareSettings
from adacd_hil.settings.schema import ConfigError, setting
from adacd_hil.settings.toml_text import to_toml

TARE_FORMAT = 1
SMALLEST_STD_NM = 0.001
"""Smallest standard deviation of a sensor's zero that is used, however long it was measured."""
TARED = ("arm.torque_offset_Nm", "arm.torque_offset_std_Nm")
"""Settings that a tare overrides."""


@dataclass(frozen=True)
class SensorRecord(DeviceRecord):
    """The sensor of one joint, and its temperature where it has object 0x2111."""

    temperature_C: float | None = setting(None, unit="°C", low=-273.15, high=1000.0, meaning="when it was tared")


@dataclass(frozen=True)
class PoseRecord:
    """One measured pose; pairs are (joint 1, joint 2)."""

    q_rad: tuple[float, float] = setting(unit="rad", meaning="joint position")
    mean_Nm: tuple[float, float] = setting(unit="Nm", meaning="mean torque, joint direction, nothing subtracted")
    std_Nm: tuple[float, float] = setting(unit="Nm", low=0.0, meaning="standard deviation of the samples")
    peak_to_peak_Nm: tuple[float, float] = setting(unit="Nm", low=0.0, meaning="highest less lowest sample")
    drift_Nm: tuple[float, float] = setting(unit="Nm", meaning="mean of the second half less that of the first")
    residual_Nm: tuple[float, float] = setting(unit="Nm", meaning="mean less gravity model and offset")
    samples: int = setting(low=1, meaning="complete cycles")


@dataclass(frozen=True, kw_only=True)
class Tare:
    """Offsets of both joint torque sensors, and how they were measured."""

    format: int = setting(low=TARE_FORMAT, high=TARE_FORMAT, meaning="version of this file's layout")
    offset_Nm: tuple[float, float] = setting(unit="Nm", low=-50.0, high=50.0, meaning="subtracted after the sign")
    standard_error_Nm: tuple[float, float] = setting(unit="Nm", low=0.0, meaning="of the offset")
    spread_Nm: tuple[float, float] = setting(unit="Nm", low=0.0, meaning="highest less lowest residual of the poses")
    old_offset_Nm: tuple[float, float] = setting(unit="Nm", meaning="offset that this one replaces")
    sign: tuple[int, int] = setting(low=-1, high=1, meaning="arm.sign that it was measured with")
    mounting_deg: tuple[float, float] | None = setting(
        None, unit="deg", meaning="tilt and q1 of hanging that gravity was subtracted with"
    )
    zero_deg: tuple[float, float] | None = setting(
        None, unit="deg", meaning="arm.zero_deg that gravity was subtracted with"
    )
    is_auto_zeroed: bool = setting(meaning="the sensors had just set their own zero, 0x6125")
    gravity_model: str = setting(choices=("none", "estimated", "cad"), meaning="where a4 and a5 come from")
    gravity_Nm: tuple[float, float] = setting(unit="Nm", meaning="a4 and a5, zeros with vertical joint axes")
    condition: float = setting(low=1.0, meaning="condition number of the poses' equations")
    samples: int = setting(low=1, meaning="of all poses together")
    duration_s: float = setting(unit="s", low=0.0, meaning="of all samples together")
    date_utc: str = setting(meaning="when it was measured, ISO 8601, UTC")
    user: str = setting(meaning="who measured")
    host: str = setting(meaning="on which machine")
    interface: str = setting(meaning="python-can interface")
    channel: str = setting(meaning="its channel")
    config: str = setting(meaning="name of the configuration")
    profile: str = setting(meaning="arm profile of the configuration")
    wire_version: int = setting(low=0, meaning="of the DBC")
    layout_digest: str = setting(meaning="of the DBC")
    version: str = setting(meaning="of adacd-hil")
    git: str = setting(meaning="commit of adacd-hil, empty when installed without one")
    sensor1: SensorRecord = setting(meaning="sensor of joint 1")
    sensor2: SensorRecord = setting(meaning="sensor of joint 2")
    poses: tuple[PoseRecord, ...] = setting(meaning="measured poses")

    def __post_init__(self) -> None:
        if not self.poses:
            raise ValueError("a tare without poses")
        try:
            self.measured_ns()
        except ValueError:
            raise ValueError(f"date_utc = {self.date_utc!r} is not like 2026-01-31T12:00:00Z") from None

    @property
    def sensors(self) -> tuple[SensorRecord, SensorRecord]:
        """Return the sensors in joint order."""
        return self.sensor1, self.sensor2

    def measured_ns(self) -> int:
        """Return the time of the measurement, ns since 1970."""
        return date_ns(self.date_utc)


def read_tare(path: Path) -> Tare:
    """Return the tare of a file. Raises ConfigError as `read_record`."""
    return _read(path)[1]


def _read(path: Path) -> tuple[bytes, Tare]:
    return read_record(path, Tare, "tare", "tare")


def write_tare(tare: Tare, path: Path) -> Path | None:
    """Write a tare file in one step; copy an old one to its name with `.1` and return the copy's path, else None.

    At each moment the path holds a whole file. Raises OSError if a file can't be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    backup = path.with_name(f"{path.name}.1") if path.exists() else None
    with replacing(path, is_durable=True) as new:
        new.write_text(to_toml(tare), encoding="utf-8")
        if backup is not None:
            with replacing(backup) as copy:
                shutil.copy2(path, copy)
    return backup


def sensor_identities(identities: Sequence[Identity]) -> tuple[Identity, ...]:
    """Return the torque sensors among the devices found at boot, in joint order. Raises KeyError if one is missing."""
    found = {identity.name: identity for identity in identities}
    return tuple(found[f"Sensor{joint}"] for joint in range(1, JOINTS + 1))


@dataclass(frozen=True)
class UsedTare:
    """A tare file that a run uses. `text`: its contents. `age_s`: of the tare. `warnings`: remarks, as on its age."""

    path: Path
    text: bytes
    tare: Tare
    age_s: float
    warnings: tuple[str, ...]

    def apply(self, settings: Settings) -> Settings:
        """Return the settings with the tare's torque offsets and their standard deviations in section `arm`."""
        arm = dataclasses.replace(
            settings.arm, torque_offset_Nm=self.tare.offset_Nm, torque_offset_std_Nm=self.offset_std_Nm(settings.tare)
        )
        return dataclasses.replace(settings, arm=arm)

    def offset_std_Nm(self, drift: TareSettings) -> tuple[float, float]:
        """Return the standard deviation of each offset now, Nm, at least SMALLEST_STD_NM.

        Its square is the sum of the squares of the tare's standard error, of half the poses' spread, and of the drift
        since.
        """
        drifted = drift.drift_variance(self.age_s)
        first, second = (
            math.sqrt(error**2 + (spread / 2.0) ** 2 + drifted)
            for error, spread in zip(self.tare.standard_error_Nm, self.tare.spread_Nm, strict=True)
        )
        return max(first, SMALLEST_STD_NM), max(second, SMALLEST_STD_NM)

    def check_devices(self, identities: Sequence[Identity]) -> list[Event]:
        """Compare the sensors found with the tare's; return summary and warnings as events.

        Raises DeviceError if a sensor is another one.
        """
        for sensor, identity in zip(self.tare.sensors, sensor_identities(identities), strict=True):
            if difference := sensor.difference(identity):
                raise DeviceError(f"{difference} of tare {self.path}; tare again")
        events = [Event("info", "tare", f"{self.path} of {self.tare.date_utc}: {self.describe_offset()} Nm subtracted")]
        return events + [Event("warning", "tare", line) for line in self.warnings]

    def attachments(self) -> dict[str, bytes]:
        """Return the file's text, by its name in the log."""
        return {TARE_NAME: self.text}

    def metadata(self) -> dict[str, str]:
        """Return file, date, offsets and sensors of the tare for the log's metadata, by keys like `tare_date_utc`."""
        return {
            "tare": str(self.path),
            "tare_date_utc": self.tare.date_utc,
            "tare_offset_Nm": self.describe_offset(),
            "tare_sensor_serials": ", ".join(str(sensor.serial) for sensor in self.tare.sensors),
        }

    def describe_offset(self) -> str:
        """Return the offsets of both joints, Nm, as text."""
        return ", ".join(repr(offset) for offset in self.tare.offset_Nm)


def use_tare(path: Path, settings: Settings, now_ns: int) -> UsedTare:
    """Read a tare for a run with these settings.

    Its warnings are on its age, a date in the future, and a zero that the sensors have set themselves. now_ns: wall
    clock. Raises ConfigError if the tare is missing, invalid, or older than `tare.max_age_h`, 0 for no limit. Also if
    it was measured with another sign, without gravity where the configuration has it or the other way round, or in
    gravity with another mounting or zero.
    """
    text, tare = _read(path)
    if tare.sign != settings.arm.sign:
        raise ConfigError(
            f"tare {path} was measured with arm.sign = {list(tare.sign)}, but the configuration has "
            f"{list(settings.arm.sign)}; tare again"
        )
    if (tare.gravity_model != "none") != settings.estimator.gravity:
        raise ConfigError(
            f"tare {path} was measured with gravity_model = {tare.gravity_model!r}, but the configuration has "
            f"estimator.gravity = {str(settings.estimator.gravity).lower()}, which makes another offset; tare again"
        )
    for name, tared, present in (
        ("mounting_deg", tare.mounting_deg, settings.mounting_deg),
        ("zero_deg", tare.zero_deg, settings.arm.zero_deg),
    ):
        if settings.estimator.gravity and tared is not None and tared != present:
            raise ConfigError(
                f"tare {path} was measured with arm.{name} = {list(tared)}, but the configuration has "
                f"{list(present)}, which makes another gravity; tare again"
            )
    bounds = settings.tare
    age_h = (now_ns - tare.measured_ns()) / NS_PER_H
    if 0.0 < bounds.max_age_h < age_h:
        raise ConfigError(
            f"tare {path} is {age_h:.1f} h old, more than tare.max_age_h = {bounds.max_age_h:g} h; tare again"
        )
    warnings = []
    if age_h > bounds.warn_age_h:
        warnings.append(f"{path} is {age_h:.1f} h old, more than tare.warn_age_h = {bounds.warn_age_h:g} h")
    if age_h < -MOST_AHEAD_H:
        warnings.append(f"{path} is dated {-age_h:.1f} h in the future: a clock is wrong")
    if tare.is_auto_zeroed:
        warnings.append(f"{path} counts on the zero that the sensors set themselves; a sensor that was reset forgot it")
    return UsedTare(path, text, tare, max(age_h, 0.0) * 3600.0, tuple(warnings))
