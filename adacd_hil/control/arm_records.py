"""Tare and history of an arm: the files that outlive a run, as TOML, and the checks before their use.

Both belong to devices, by the serial numbers of 0x1018:4: a tare to the sensors that were tared, a history to all
devices of one arm.

**A tare** has offsets with their provenance, in joint direction: `arm.torque_offset_Nm` subtracts them after the sign.

**A history** lists the certificates of all runs. The first certificate carries a digest of the devices and of itself,
each further one a digest of its predecessor's and of itself, so that a damaged or edited file is refused. Missing
newest certificates are not noticed. The digest is no signature: anybody who can write the file can compute it.
"""

import dataclasses
import hashlib
import math
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from adacd_hil.clock import date_ns
from adacd_hil.device.canopen_bus import DeviceError
from adacd_hil.device.network import Identity
from adacd_hil.file_access import dangling_link, read_input, replacing
from adacd_hil.records import JOINTS, Event
from adacd_hil.scheme.identify.certificate import Certificate
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.run_settings import HistorySettings, TareSettings
from adacd_hil.settings.schema import ConfigError, parse, setting
from adacd_hil.settings.toml_files import parse_toml, read_toml, to_toml

TARE_NAME = "tare.toml"
TARE_FORMAT = 1
SMALLEST_STD_NM = 0.001
"""Smallest standard deviation of a sensor's zero that is used, however long it was measured."""
_NS_PER_H = 3_600_000_000_000
TARED = ("arm.torque_offset_Nm", "arm.torque_offset_std_Nm")
"""Settings that a tare overrides."""
_CLOCK_TOLERANCE_H = 0.1


@dataclass(frozen=True)
class DeviceRecord:
    """A device of the arm in a tare or history: name, node id and object 0x1018."""

    name: str = setting(meaning="name in the DBC")
    node_id: int = setting(low=1, high=127, meaning="CANopen node id")
    vendor: int = setting(low=0, high=0xFFFF_FFFF, meaning="0x1018:1")
    product: int = setting(low=0, high=0xFFFF_FFFF, meaning="0x1018:2")
    revision: int = setting(low=0, high=0xFFFF_FFFF, meaning="0x1018:3")
    serial: int = setting(low=0, high=0xFFFF_FFFF, meaning="0x1018:4")

    def difference(self, found: Identity) -> str:
        """Return the first difference to the device found, "" if it is the same. The revision may differ (firmware)."""
        for what, known, present in (
            ("vendor", self.vendor, found.vendor),
            ("product code", self.product, found.product),
            ("serial number", self.serial, found.serial),
        ):
            if known != present:
                return f"{found.name} (node {found.node_id}): {what} {present} is not the {known}"
        return ""


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
        """The sensors in joint order."""
        return self.sensor1, self.sensor2

    def measured_ns(self) -> int:
        """Return the time of the measurement, ns since 1970."""
        return date_ns(self.date_utc)


def read_tare(path: Path) -> Tare:
    """Read a tare file. Raises ConfigError."""
    if not path.exists():
        raise ConfigError(f"tare {path} does not exist; `adacd-hil tare` makes one")
    table = read_toml(path, "tare")
    try:
        return parse(Tare, table)
    except ConfigError as error:
        raise ConfigError(f"tare {path}: {error}") from None


def write_tare(tare: Tare, path: Path) -> Path | None:
    """Write a tare file in one step; keep the old one as `.1` and return its path, None without one. Raises OSError.

    At each moment the path holds a whole file.
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
    """Return the torque sensors among the devices found at boot, in joint order."""
    found = {identity.name: identity for identity in identities}
    return tuple(found[f"Sensor{joint}"] for joint in range(1, JOINTS + 1))


@dataclass(frozen=True)
class UsedTare:
    """A tare file that a run uses. `text`: its contents. `warnings`: remarks for the log, such as its age."""

    path: Path
    text: bytes
    tare: Tare
    age_s: float
    warnings: tuple[str, ...]

    def apply(self, settings: Settings) -> Settings:
        """Return the settings with the tare's `arm.torque_offset_Nm` and its standard deviation."""
        arm = dataclasses.replace(
            settings.arm, torque_offset_Nm=self.tare.offset_Nm, torque_offset_std_Nm=self.offset_std_Nm(settings.tare)
        )
        return dataclasses.replace(settings, arm=arm)

    def offset_std_Nm(self, drift: TareSettings) -> tuple[float, float]:
        """Return the standard deviation of the offsets now, Nm: measured, plus drift since the tare."""
        drifted = drift.drift_variance(self.age_s)
        first, second = (
            math.sqrt(error**2 + (spread / 2.0) ** 2 + drifted)
            for error, spread in zip(self.tare.standard_error_Nm, self.tare.spread_Nm, strict=True)
        )
        return max(first, SMALLEST_STD_NM), max(second, SMALLEST_STD_NM)

    def check_sensors(self, identities: Sequence[Identity]) -> list[Event]:
        """Return events for the log. Raises DeviceError unless the sensors are those of the tare."""
        for sensor, identity in zip(self.tare.sensors, sensor_identities(identities), strict=True):
            if difference := sensor.difference(identity):
                raise DeviceError(f"{difference} of tare {self.path}; tare again")
        events = [Event("info", "tare", f"{self.path} of {self.tare.date_utc}: {self.describe_offset()} Nm subtracted")]
        return events + [Event("warning", "tare", line) for line in self.warnings]

    def metadata(self) -> dict[str, str]:
        """Return file, date, offsets and sensors of the tare for the log's metadata."""
        return {
            "tare": str(self.path),
            "tare_date_utc": self.tare.date_utc,
            "tare_offset_Nm": self.describe_offset(),
            "tare_sensor_serials": ", ".join(str(sensor.serial) for sensor in self.tare.sensors),
        }

    def describe_offset(self) -> str:
        """Format the offsets of both joints, Nm."""
        return ", ".join(repr(offset) for offset in self.tare.offset_Nm)


def use_tare(path: Path, settings: Settings, now_ns: int) -> UsedTare:
    """Read a tare for a run with these settings. now_ns: wall clock. Raises ConfigError if it can't be used."""
    tare = read_tare(path)
    if tare.sign != settings.arm.sign:
        raise ConfigError(
            f"tare {path} was measured with arm.sign = {list(tare.sign)}, but the configuration has "
            f"{list(settings.arm.sign)}; tare again"
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
    age_h = (now_ns - tare.measured_ns()) / _NS_PER_H
    if 0.0 < bounds.max_age_h < age_h:
        raise ConfigError(
            f"tare {path} is {age_h:.1f} h old, more than tare.max_age_h = {bounds.max_age_h:g} h; tare again"
        )
    warnings = []
    if age_h > bounds.warn_age_h:
        warnings.append(f"{path} is {age_h:.1f} h old, more than tare.warn_age_h = {bounds.warn_age_h:g} h")
    if age_h < -_CLOCK_TOLERANCE_H:
        warnings.append(f"{path} is dated {-age_h:.1f} h in the future: a clock is wrong")
    if tare.is_auto_zeroed:
        warnings.append(f"{path} counts on the zero that the sensors set themselves; a sensor that was reset forgot it")
    return UsedTare(path, read_input(path), tare, max(age_h, 0.0) * 3600.0, tuple(warnings))


HISTORY_NAME = "history.toml"
HISTORY_FORMAT = 1
_LARGEST = 1000.0
_FUTURE_NS = 360_000_000_000
"""Most by which a certificate's date may be ahead of this machine's clock."""


@dataclass(frozen=True)
class CertificateRecord:
    """One certificate of a run, see `Certificate`."""

    date_utc: str = setting(meaning="when the run ended, ISO 8601, UTC")
    log: str = setting(meaning="the run's log")
    profile: str = setting(meaning="arm profile of the configuration")
    version: str = setting(meaning="of adacd-hil")
    parameters: tuple[float, ...] = setting(meaning="a1 … F_c2, and those of gravity")
    friction_Nm: tuple[float, ...] = setting(
        unit="Nm", low=-_LARGEST, high=_LARGEST, meaning="of joint 1 at 0.2, 0.6, 1.2 rad/s, then of joint 2"
    )
    friction_std_Nm: tuple[float, ...] = setting(unit="Nm", low=0.0, high=_LARGEST, meaning="their deviations")
    inertia_kgm2: tuple[float, ...] = setting(unit="kg m²", low=-_LARGEST, high=_LARGEST, meaning="a1, a2, a3")
    inertia_std_kgm2: tuple[float, ...] = setting(unit="kg m²", low=0.0, high=_LARGEST, meaning="their deviations")
    offset_Nm: tuple[float, ...] = setting(
        unit="Nm", low=-_LARGEST, high=_LARGEST, meaning="of the torque sensors, the configuration's included"
    )
    offset_std_Nm: tuple[float, ...] = setting(unit="Nm", low=0.0, high=_LARGEST, meaning="their deviations")
    is_payload: bool = setting(meaning="with a payload that was announced in the run")
    text: str = setting(meaning="the anchor of its offsets, and the sources of friction and inertia")
    digest: str = setting("", meaning="SHA-256 of the digest before (of the devices at first) and of all above")

    def __post_init__(self) -> None:
        self.known(HistorySettings())

    def known(self, settings: HistorySettings) -> HistorySettings:
        """Return settings with this as the last certificate. Raises ValueError if values are missing."""
        return dataclasses.replace(
            settings,
            date_utc=self.date_utc,
            friction_Nm=self.friction_Nm,
            friction_std_Nm=self.friction_std_Nm,
            inertia_kgm2=self.inertia_kgm2,
            inertia_std_kgm2=self.inertia_std_kgm2,
            offset_Nm=self.offset_Nm,
            offset_std_Nm=self.offset_std_Nm,
        )

    def digest_after(self, before: str) -> str:
        """Return this record's digest after a predecessor's."""
        return _digest(before + to_toml(dataclasses.replace(self, digest="")))


@dataclass(frozen=True)
class History:
    """The certificates of one arm, the oldest first."""

    format: int = setting(low=HISTORY_FORMAT, high=HISTORY_FORMAT, meaning="version of this file's layout")
    devices: tuple[DeviceRecord, ...] = setting(meaning="drives and sensors of the arm")
    certificates: tuple[CertificateRecord, ...] = setting(meaning="certificates of all runs")

    def __post_init__(self) -> None:
        if not self.certificates:
            raise ValueError("a history without certificates")
        before = devices_digest(self.devices)
        for number, certificate in enumerate(self.certificates, start=1):
            try:
                date_ns(certificate.date_utc)
            except ValueError:
                raise ValueError(f"certificate {number}: date_utc is not like 2026-01-31T12:00:00Z") from None
            if certificate.digest != certificate.digest_after(before):
                raise ValueError(f"certificate {number} was changed or damaged: its digest differs")
            before = certificate.digest

    @property
    def last(self) -> CertificateRecord:
        """The newest certificate."""
        return self.certificates[-1]


def devices_digest(devices: Sequence[DeviceRecord]) -> str:
    """Return the digest of the devices, the predecessor of the first certificate's."""
    return _digest("\n".join(map(to_toml, devices)))


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _difference(devices: Sequence[DeviceRecord], identities: Sequence[Identity], path: Path) -> str:
    """Return the first difference between devices and a history's, "" if they are the same."""
    known = {record.name: record for record in devices}
    for identity in identities:
        record = known.get(identity.name)
        if record is None:
            return f"{identity.name} (node {identity.node_id}) is no device of history {path}"
        if difference := record.difference(identity):
            return f"{difference} of history {path}: it is another arm's"
    return ""


def read_history(path: Path) -> History:
    """Read an arm's history. Raises ConfigError."""
    if not path.exists():
        raise ConfigError(f"history {path} does not exist; `adacd-hil run --history` makes one")
    return _parse(path, read_input(path))


def _parse(path: Path, text: bytes) -> History:
    try:
        return parse(History, parse_toml(text))
    except ConfigError as error:
        raise ConfigError(f"history {path}: {error}") from None


@dataclass(frozen=True)
class UsedHistory:
    """The history that a run reads and extends.

    `text`: the file's contents; `history` None: the file doesn't exist yet. `age_s`: age of its last certificate.
    """

    path: Path
    text: bytes
    history: History | None
    age_s: float = 0.0

    @property
    def is_first_run(self) -> bool:
        """Whether the arm has no certificate yet."""
        return self.history is None

    @property
    def warnings(self) -> tuple[str, ...]:
        """Remarks for the log."""
        return (f"{self.path}: the arm's first run, its friction is unknown",) if self.is_first_run else ()

    def apply(self, settings: Settings) -> Settings:
        """Return the settings with the last certificate in section `history`, its age as drift of the sensors."""
        if self.history is None:
            return settings
        known = self.history.last.known(settings.history)
        drifted = settings.tare.drift_variance(self.age_s)
        std_Nm = tuple(math.sqrt(std**2 + drifted) for std in known.offset_std_Nm)
        return dataclasses.replace(settings, history=dataclasses.replace(known, offset_std_Nm=std_Nm))

    def check_devices(self, identities: Sequence[Identity]) -> Event:
        """Return an event for the log. Raises DeviceError unless the devices are those of the history."""
        if self.history is None:
            return Event("warning", "history", self.warnings[0])
        if difference := _difference(self.history.devices, identities, self.path):
            raise DeviceError(difference)
        return Event("info", "history", f"{self.path}: {self._count()}, the last of {self.history.last.date_utc}")

    def _count(self) -> str:
        count = 0 if self.history is None else len(self.history.certificates)
        return f"{count} certificate{'' if count == 1 else 's'}"

    def metadata(self) -> dict[str, str]:
        """Describe the history for the log's metadata."""
        return {"history": str(self.path), "history_certificates": self._count()}

    def add_certificates(
        self, certificates: Sequence[Certificate], identities: Sequence[Identity], origin: "Origin"
    ) -> str:
        """Append certificates and write the history in one step; return a summary. Raises OSError, ConfigError.

        Certificates that another run has appended meanwhile are kept.
        """
        devices, records = tuple(DeviceRecord(*identity) for identity in identities), []
        if self.path.exists():
            now = _parse(self.path, read_input(self.path))
            if difference := _difference(now.devices, identities, self.path):
                raise ConfigError(difference)
            devices, records = now.devices, list(now.certificates)
        before = records[-1].digest if records else devices_digest(devices)
        for certificate in certificates:
            record = CertificateRecord(**origin._asdict(), **certificate._asdict())
            before = record.digest_after(before)
            records.append(dataclasses.replace(record, digest=before))
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(self.path, is_durable=True) as new:
            new.write_text(to_toml(History(HISTORY_FORMAT, devices, tuple(records))), encoding="utf-8")
        return f"{self.path}: {len(certificates)} more, {len(records)} in all"


class Origin(NamedTuple):
    """Origin of certificates: run, log, profile, version; see `CertificateRecord`."""

    date_utc: str
    log: str
    profile: str
    version: str


def use_history(path: Path, now_ns: int) -> UsedHistory:
    """Read the arm's history for a run; a missing file is a first run. Raises ConfigError if it can't be used."""
    if (link := dangling_link(path)) is not None:  # the history was moved: the arm is known, not on its first run
        raise ConfigError(f"history {path}: link {link} leads to {link.readlink()}, which is not there")
    if not path.exists():
        return UsedHistory(path, b"", None)
    text = read_input(path)
    history = _parse(path, text)
    ahead_ns = date_ns(history.last.date_utc) - now_ns
    if ahead_ns > _FUTURE_NS:
        raise ConfigError(f"history {path}: its last certificate is {ahead_ns / 3.6e12:.1f} h ahead of this clock")
    return UsedHistory(path, text, history, max(-ahead_ns, 0) * 1e-9)
