"""The history file of an arm: the certificates of all its runs, as TOML, and the checks before its use.

It belongs to the devices of one arm, by their serial numbers of 0x1018:4. The first certificate carries a digest of the
devices and of itself, each further one a digest of its predecessor's and of itself, so that a damaged or edited file is
refused. Missing newest certificates are not noticed. The digest is no signature: anybody who can write the file can
compute it.
"""

import dataclasses
import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from adacd_hil.control.device_record import DeviceRecord, read_record
from adacd_hil.dates import MOST_AHEAD_H, NS_PER_H, date_ns
from adacd_hil.device.canopen_bus import DeviceError
from adacd_hil.device.network import Identity
from adacd_hil.file_replacement import dangling_link, replacing
from adacd_hil.log.log_files import HISTORY_NAME
from adacd_hil.printable import number_of
from adacd_hil.records import Event
from adacd_hil.scheme.identify.certificate import Certificate
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.run_settings import HISTORY_LARGEST, HistorySettings
from adacd_hil.settings.schema import ConfigError, setting
from adacd_hil.settings.toml_text import to_toml

HISTORY_FORMAT = 1


@dataclass(frozen=True)
class CertificateRecord:
    """One certificate of a run, see `Certificate`."""

    date_utc: str = setting(meaning="when the run ended, ISO 8601, UTC")
    log: str = setting(meaning="the run's log")
    profile: str = setting(meaning="arm profile of the configuration")
    version: str = setting(meaning="of adacd-hil")
    parameters: tuple[float, ...] = setting(meaning="a1 … F_c2, and those of gravity")
    friction_Nm: tuple[float, ...] = setting(
        unit="Nm",
        low=-HISTORY_LARGEST,
        high=HISTORY_LARGEST,
        meaning="of joint 1 at each speed, then of joint 2",
    )
    friction_std_Nm: tuple[float, ...] = setting(unit="Nm", low=0.0, high=HISTORY_LARGEST, meaning="their deviations")
    inertia_kgm2: tuple[float, ...] = setting(
        unit="kg m²", low=-HISTORY_LARGEST, high=HISTORY_LARGEST, meaning="a1, a2, a3"
    )
    inertia_std_kgm2: tuple[float, ...] = setting(
        unit="kg m²", low=0.0, high=HISTORY_LARGEST, meaning="their deviations"
    )
    offset_Nm: tuple[float, ...] = setting(
        unit="Nm",
        low=-HISTORY_LARGEST,
        high=HISTORY_LARGEST,
        meaning="of the torque sensors, the configuration's included",
    )
    offset_std_Nm: tuple[float, ...] = setting(unit="Nm", low=0.0, high=HISTORY_LARGEST, meaning="their deviations")
    is_payload: bool = setting(meaning="with a payload that was announced in the run")
    text: str = setting(meaning="the anchor of its offsets, and the sources of friction and inertia")
    digest: str = setting("", meaning="SHA-256 of the digest before (of the devices at first) and of all above")

    def __post_init__(self) -> None:
        self.known(HistorySettings())

    def known(self, settings: HistorySettings) -> HistorySettings:
        """Return section `history` of the settings with this record's values. Raises ValueError if some are missing."""
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
        """Return the SHA-256, in hexadecimal, of `before` and this record without its digest, in one text.

        before: the predecessor's digest, or `devices_digest` for the first.
        """
        return _digest(before + to_toml(dataclasses.replace(self, digest="")))


@dataclass(frozen=True)
class History:
    """The certificates of one arm, the oldest first.

    Raises ValueError when made without certificates, or with a wrong date or digest.
    """

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
        """Return the newest certificate."""
        return self.certificates[-1]


def devices_digest(devices: Sequence[DeviceRecord]) -> str:
    """Return the SHA-256, in hexadecimal, of the devices: it stands in for the digest before the first certificate."""
    return _digest("\n".join(map(to_toml, devices)))


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _difference(devices: Sequence[DeviceRecord], identities: Sequence[Identity], path: Path) -> str:
    """Return the first found device that a history doesn't have, or has as another one, as text; "" if none.

    devices: of the history in `path`. identities: of the devices found.
    """
    known = {record.name: record for record in devices}
    for identity in identities:
        record = known.get(identity.name)
        if record is None:
            return f"{identity.name} (node {identity.node_id}) is no device of history {path}"
        if difference := record.difference(identity):
            return f"{difference} of history {path}: it is another arm's"
    return ""


def read_history(path: Path) -> History:
    """Return the history of a file. Raises ConfigError if it is missing, can't be read, is invalid or was changed."""
    return _read(path)[1]


def _read(path: Path) -> tuple[bytes, History]:
    return read_record(path, History, "history", "run --history")


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
        """Return whether there is no history file yet, so no certificate of the arm."""
        return self.history is None

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return remarks for the log: that it is the arm's first run, or none."""
        return (f"{self.path}: the arm's first run, its friction is unknown",) if self.is_first_run else ()

    def apply(self, settings: Settings) -> Settings:
        """Return the settings with the last certificate in section `history`; unchanged in a first run.

        Widen the deviations of its torque offsets by the sensors' drift since.
        """
        if self.history is None:
            return settings
        known = self.history.last.known(settings.history)
        drifted = settings.tare.drift_variance(self.age_s)
        std_Nm = tuple(math.sqrt(std**2 + drifted) for std in known.offset_std_Nm)
        return dataclasses.replace(settings, history=dataclasses.replace(known, offset_std_Nm=std_Nm))

    def check_devices(self, identities: Sequence[Identity]) -> list[Event]:
        """Compare the devices with the history's; return [event] with a summary, a warning in a first run.

        Raises DeviceError if they differ.
        """
        if self.history is None:
            return [Event("warning", "history", self.warnings[0])]
        if difference := _difference(self.history.devices, identities, self.path):
            raise DeviceError(difference)
        return [Event("info", "history", f"{self.path}: {self._count()}, the last of {self.history.last.date_utc}")]

    def _count(self) -> str:
        """Return the number of certificates that were read, as text."""
        return number_of(0 if self.history is None else len(self.history.certificates), "certificate")

    def attachments(self) -> dict[str, bytes]:
        """Return the file's text, by its name in the log; none in a first run."""
        return {} if self.is_first_run else {HISTORY_NAME: self.text}

    def metadata(self) -> dict[str, str]:
        """Return file and number of certificates for the log's metadata, as `history` and `history_certificates`."""
        return {"history": str(self.path), "history_certificates": self._count()}

    def add_certificates(
        self, certificates: Sequence[Certificate], identities: Sequence[Identity], origin: "Origin"
    ) -> str:
        """Append certificates of a run to the history file, in one step; return a summary.

        Read the file again first, so that certificates of another run are kept; make one if there is none. identities:
        of the devices found. Raises ConfigError as `read_history`, and for a file of another arm; OSError if it can't
        be written.
        """
        devices, records = tuple(DeviceRecord(*identity) for identity in identities), []
        if self.path.exists():
            now = _read(self.path)[1]
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
    """Origin of certificates: end of the run, log, arm profile, version of adacd-hil; see `CertificateRecord`."""

    date_utc: str
    log: str
    profile: str
    version: str


def use_history(path: Path, now_ns: int) -> UsedHistory:
    """Read the arm's history for a run; a missing file is a first run. now_ns: wall clock.

    Raises ConfigError as `read_history` for a file that is there, for a link to a missing one, and for a certificate
    over `MOST_AHEAD_H` in the future.
    """
    if (link := dangling_link(path)) is not None:  # the history was moved: the arm is known, not on its first run
        raise ConfigError(f"history {path}: link {link} leads to {link.readlink()}, which is not there")
    if not path.exists():
        return UsedHistory(path, b"", None)
    text, history = _read(path)
    ahead_ns = date_ns(history.last.date_utc) - now_ns
    if ahead_ns > MOST_AHEAD_H * NS_PER_H:
        raise ConfigError(f"history {path}: its last certificate is {ahead_ns / NS_PER_H:.1f} h ahead of this clock")
    return UsedHistory(path, text, history, max(-ahead_ns, 0) * 1e-9)
