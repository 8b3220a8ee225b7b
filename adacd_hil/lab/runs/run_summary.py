"""The figures of a run in one line, without reading its log where a report has them.

A run's figures are those of the judge (`adacd_hil.lab.score`), as report.json beside the log has them. A report of
a stretch, of another log or of another version of the file's layout is ignored. Without a report, the figures come
from the log's index and its events; `judged` reads the whole log.

Friction and torque offsets are those of the first certificate that no payload was announced for, thresholds those of
the watching after the first adaptation. Friction is at `records.FRICTION_AT_RAD_S`; offsets have the configuration's
included.

Torques in Nm, a value per joint.
"""

import dataclasses
import json
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Final, NamedTuple

from adacd_hil.file_access import InUseError, check_unused, read_input
from adacd_hil.lab.logs.log_info import LogInfo, read_info
from adacd_hil.lab.report.report_json import JSON_NAME, SCHEMA
from adacd_hil.lab.stated_bounds import STATUSES
from adacd_hil.log.log_files import CONFIG_NAME, EPOCH_KEY, LOG_NAME, SUFFIX, TRUTH_NAME, LogError, find_parts
from adacd_hil.log.log_parts import PLANNED_ENDINGS
from adacd_hil.log.log_walk import attachment
from adacd_hil.log.logged_run import settings_of
from adacd_hil.log.reader import LogStream
from adacd_hil.log.types.topics import CYCLE, EVENTS
from adacd_hil.printable import one_line
from adacd_hil.records import FRICTION_AT, FRICTION_AT_RAD_S
from adacd_hil.settings.configuration import Settings

DEEPEST: Final = 4
"""Levels below a folder in which its runs are looked for."""
GOOD, NOT_GOOD, NOT_JUDGED, BROKEN, RUNNING = STATUSES
CERTIFIED, IDENTIFIED, TAKEN_BACK, NO_CERTIFICATE = "certified", "identified", "taken back", "none"
"""States of a certificate. `identified`: by the paper's scheme, which issues no certificates."""
_MOST_REPORT_BYTES: Final = 64 << 20
_DATED: Final = re.compile(r"(\d{4}-\d\d-\d\d)[T_ ](\d\d)[-:]?(\d\d)[-:]?(\d\d)")
_IDENTITY: Final = re.compile(r"node \d+: (vendor \S+, product \S+), revision \S+, serial (\d{1,18})")
"""The event of a device that was identified."""
_MOTION_START: Final = "-> ADAPT"
_TO_MONITOR: Final = ("ADAPT -> MONITOR", "CERTIFY -> MONITOR")
_DAMAGES: Final = (LookupError, TypeError, ValueError, AttributeError, RecursionError)
"""Errors that a damaged report raises."""

Pair = tuple[float, float]


class CertificateState(NamedTuple):
    """The last certificate of a run: its state, such as CERTIFIED, and when it got it, s since motion start.

    given: number of certificates of the run.
    """

    state: str
    at_s: float | None
    given: int = 0


@dataclass(frozen=True)
class RunSummary:
    """One run. None: not known, or not there.

    name: of its folder, from the folder that was looked through. started: local time, by `started_by`: "log" where the
    log has the date, "folder" where its name has, else "file", the last change of the log. status: of STATUSES;
    verdict: the reason in a sentence. expected: contacts that there were while detection was armed, None on a real arm;
    found: the detected ones of those, or all detections if the run isn't judged. margin: smallest threshold over
    residual. duration_s: from the log's first message to its last. friction_Nm (at FRICTION_AT_RAD_S), offset_Nm: of
    the first certificate without payload; the paper's scheme gives friction alone, of its first complete adaptation.
    devices: maker with product, and serial number, of each that has one; none before `with_devices`.
    """

    name: str
    log: Path
    status: str
    verdict: str
    started: datetime | None = None
    started_by: str = ""
    arm: str = ""
    config: str = ""
    profile: str = ""
    scenario: str = ""
    interface: str = ""
    version: str = ""
    certificate: CertificateState | None = None
    threshold_Nm: Pair | None = None
    margin: float | None = None
    found: int | None = None
    expected: int | None = None
    false_alarms: int | None = None
    friction_Nm: Pair | None = None
    friction_std_Nm: Pair | None = None
    offset_Nm: Pair | None = None
    offset_std_Nm: Pair | None = None
    duration_s: float | None = None
    settings: Settings | None = None
    devices: frozenset[tuple[str, int]] = frozenset()

    @property
    def is_clean(self) -> bool:
        """Whether the status is GOOD: the run was judged good and its log is whole.

        False also while it is not judged.
        """
        return self.status == GOOD

    @property
    def is_judged(self) -> bool:
        """Whether the status is GOOD or NOT_GOOD: the figures are those of a report."""
        return self.status in (GOOD, NOT_GOOD)


def find_runs(folder: Path) -> Iterator[Path]:
    """Yield the folders of runs in a folder and up to DEEPEST levels below, by name; only the folder if it is a run.

    Links to folders below it are not followed. A folder whose log lacks its first part is also a run. A missing folder,
    or one below that can't be read, is yielded at the end, so that the list names it. Raises OSError if the given
    folder can't be listed.
    """
    if _has_run(folder, [entry.name for entry in folder.iterdir()] if folder.is_dir() else []):
        yield folder
        return
    unreadable: list[Path] = []
    for place, names, files in os.walk(folder, onerror=lambda error: unreadable.append(Path(str(error.filename)))):
        here = Path(place)
        if _has_run(here, files):
            yield here
        if len(here.relative_to(folder).parts) >= DEEPEST:
            names.clear()
        names.sort()
    yield from unreadable


def _has_run(folder: Path, names: Sequence[str]) -> bool:
    """Return whether a folder has the log of a run, or later parts of one. names: those of its files."""
    return LOG_NAME in names or (any(name.endswith(SUFFIX) for name in names) and bool(find_parts(folder / LOG_NAME)))


def summarise(folder: Path, name: str = "") -> RunSummary:
    """Return the summary of the run in a folder, by its report if there is one that fits, else by its log's events.

    name: of the run in the list; "": the folder's. Does not raise: a log that is damaged or can't be read gives the
    status BROKEN, one that is being written RUNNING, one without a fitting report NOT_JUDGED.
    """
    log = folder / LOG_NAME
    started, started_by = _started(log)
    broken = RunSummary(folder.resolve().name if name in ("", ".") else name, log, BROKEN, "", started, started_by)
    try:
        if not log.exists():
            folder.stat()
            next(folder.iterdir(), None)
        check_unused(log)
        info = read_info(log, is_brief=True)
    except InUseError as error:
        return dataclasses.replace(broken, status=RUNNING, verdict=one_line(error))
    except LogError as error:
        return dataclasses.replace(broken, verdict=one_line(error))
    except OSError as error:
        return dataclasses.replace(broken, verdict=one_line(f"{folder} can't be read: {error.strerror}"))
    headed = _headed(broken, info, _settings(log))
    if info.problems:
        return dataclasses.replace(headed, verdict=one_line("; ".join(info.problems)), duration_s=None)
    return _figured(headed, info)


def _figured(headed: RunSummary, info: LogInfo) -> RunSummary:
    """Return the summary with the figures of the run's report; if none can be used, with those of the log's events."""
    try:
        table = _report_of(headed.log.parent, info)
        return _unjudged(headed, "") if table is None else _with_report(headed, table)
    except LogError as error:
        return _unjudged(headed, str(error))
    except _DAMAGES as error:
        return _unjudged(headed, f"{JSON_NAME} is damaged: {type(error).__name__} {error}")


def judged(summary: RunSummary) -> RunSummary:
    """Return the summary with figures evaluated now: reads the whole log, and the truth beside it, if there is one.

    Summaries of another status than NOT_JUDGED are returned unchanged; a log that can't be judged gets BROKEN.
    """
    from adacd_hil.lab.report.report_json import report_json
    from adacd_hil.lab.report.run_reading import read_run  # it compiles
    from adacd_hil.lab.score.evaluation import evaluate

    if summary.status != NOT_JUDGED:
        return summary
    truth = summary.log.parent / TRUTH_NAME
    try:
        run, gathered, source = read_run(summary.log, truth if truth.exists() else None)
        return _with_report(summary, report_json(evaluate(run, gathered), run.metadata, source))
    except (LogError, ValueError) as error:
        return dataclasses.replace(summary, status=BROKEN, verdict=one_line(error))


def with_devices(summary: RunSummary) -> RunSummary:
    """Return the summary with the devices that the beginning of its log names with a serial number.

    The set is empty if it names none; a summary whose log can't be read is returned unchanged.
    """
    try:
        stream = LogStream(summary.log, (EVENTS.name, CYCLE.name), cycles_per_piece=1, is_ahead=False)
        piece = next(iter(stream), None)
        events = [] if piece is None else stream.events(piece)
    except LogError:
        return summary
    told = [match for logged in events if (match := _IDENTITY.fullmatch(logged.event.message))]
    return dataclasses.replace(summary, devices=frozenset((each[1], int(each[2])) for each in told if int(each[2])))


def reported(folder: Path, name: str, table: Mapping[str, Any]) -> RunSummary:
    """Return the summary of the run in `folder` with the figures of a report, even one of a stretch.

    BROKEN if the log can't be read. table: as in report.json; a damaged one raises one of _DAMAGES. name: of the run in
    the list.
    """
    log = folder / LOG_NAME
    empty = RunSummary(name, log, BROKEN, "")
    try:
        return _with_report(_headed(empty, read_info(log, is_brief=True), _settings(log)), table)
    except LogError as error:
        return dataclasses.replace(empty, verdict=one_line(error))


def _settings(log: Path) -> Settings | None:
    """Return the settings in a log; None if it has none, or they can't be read, such as those of another version."""
    text = attachment(log, CONFIG_NAME)
    try:
        return None if text is None else settings_of(log, {CONFIG_NAME: text})
    except LogError:  # of a version that has other settings
        return None


def _headed(summary: RunSummary, info: LogInfo, settings: Settings | None) -> RunSummary:
    """Return the summary with the data of a log's metadata and settings, such as date, arm and duration."""
    said = info.metadata
    config, profile = said.get("config", ""), said.get("profile", "")
    started, started_by = _started(summary.log, info.start_ns if info.metadata.get(EPOCH_KEY, "0") != "0" else 0)
    return dataclasses.replace(
        summary,
        started=started,
        started_by=started_by,
        arm=said.get("arm") or "/".join(filter(None, (config, profile))),
        config=config,
        profile=profile,
        scenario=said.get("scenario", ""),
        interface=said.get("interface", ""),
        version=said.get("version", ""),
        duration_s=info.duration_s,
        settings=settings,
    )


def _started(log: Path, start_ns: int = 0) -> tuple[datetime | None, str]:
    """Return when a run began, local time, and the source: "log", "folder" (its name) or "file"; (None, "") if unknown.

    "file" is the time of the last change of the log's first part. start_ns: the log's first time, since 1970; 0 if it
    has no date, as in lockstep.
    """
    try:
        if start_ns:
            return datetime.fromtimestamp(start_ns // 1_000_000_000).astimezone(), "log"
        if match := _DATED.search(log.parent.resolve().name):
            return datetime.fromisoformat(f"{match[1]}T{match[2]}:{match[3]}:{match[4]}").astimezone(), "folder"
    except (ValueError, OverflowError, OSError):  # no date of this calendar
        pass
    try:
        return datetime.fromtimestamp(int(log.stat().st_mtime)).astimezone(), "file"
    except (OSError, ValueError, OverflowError):
        return None, ""


def _report_of(folder: Path, info: LogInfo) -> dict[str, Any] | None:
    """Return report.json of a run; None without one.

    Raises LogError if it can't be read, or is of a stretch, another log or another layout, one of _DAMAGES if it is
    damaged.
    """
    path = folder / JSON_NAME
    if not path.exists():
        return None
    try:
        table: dict[str, Any] = json.loads(read_input(path, _MOST_REPORT_BYTES))
        said, layout, stretch = table["run"], table["schema"], table["stretch"]
        counts = (table["cycle"]["count"], table["log"]["frames"])
        is_own = counts == (info.cycles, info.frames) and info.metadata.items() <= said.items()
    except OSError as error:
        raise LogError(f"{JSON_NAME} can't be read: {error.strerror}") from None
    if layout != SCHEMA:
        raise LogError(f"{JSON_NAME} has layout {layout}, {SCHEMA} is read")
    if stretch is not None:
        raise LogError(f"{JSON_NAME} is of a stretch of the log")
    if not is_own:
        raise LogError(f"{JSON_NAME} is of another log")
    return table


def _unjudged(summary: RunSummary, problem: str) -> RunSummary:
    """Return the summary as NOT_JUDGED, with contacts and certificate by the log's events; BROKEN for a damaged log.

    summary: BROKEN so far. problem: why the report is not used, "" without a report; it begins the verdict of
    NOT_JUDGED. The first error, a lack of cycles, and an ending that was not planned follow.
    """
    try:
        info = read_info(summary.log)
    except LogError as error:
        return dataclasses.replace(summary, verdict=one_line(error))
    if info.problems:
        return dataclasses.replace(summary, verdict=one_line("; ".join(info.problems)))
    said = [problem] if problem else []
    said += [f"error {info.faults[0]}"] if info.faults else []
    said += [] if info.cycles else ["no cycle was run"]
    said += [f"ended: {info.ending}"] if info.ending not in PLANNED_ENDINGS else []
    return dataclasses.replace(
        summary,
        status=NOT_JUDGED,
        verdict=one_line("; ".join(said)),
        certificate=_told_certificate(info),
        found=info.contacts,
    )


def _told_certificate(info: LogInfo) -> CertificateState:
    """Return state and time of the last certificate by the log's events, and the number of all; else NO_CERTIFICATE.

    IDENTIFIED if MONITOR was entered from ADAPT, as by the paper's scheme. TAKEN_BACK has the time at which it was.
    Times are in s since motion start, None without a motion start.
    """
    found = CertificateState(NO_CERTIFICATE, None)
    start_ns: int | None = None
    for t_ns, event in info.milestones:
        if event.name == "supervisor" and event.message.endswith(_MOTION_START) and start_ns is None:
            start_ns = t_ns
        at_s = None if start_ns is None else round((t_ns - start_ns) * 1e-9, 6)
        if event.name == "supervisor" and event.message in _TO_MONITOR:
            state = CERTIFIED if event.message.startswith("CERTIFY") else IDENTIFIED
            found = CertificateState(state, at_s, found.given + 1)
        elif event.name == "revoked":
            found = CertificateState(TAKEN_BACK, at_s, found.given)
    return found


def _with_report(summary: RunSummary, table: Mapping[str, Any]) -> RunSummary:
    """Return the summary as GOOD or NOT_GOOD with the figures of a report; a log that isn't whole is NOT_GOOD.

    Raises one of _DAMAGES if the report is damaged, LogError if the log is needed and can't be read.
    """
    log, certified = table["log"], table["certified"]
    is_good = _flag(table["is_clean"]) and _flag(log["is_complete"])
    armed = [contact for contact in table["contacts"] if _flag(contact["is_armed"])]
    false_alarms = table["false_alarms"]
    has_truth = false_alarms is not None
    settings = summary.settings
    configured_Nm = settings.detector.threshold_Nm if settings is not None and settings.scheme == "paper" else None
    return dataclasses.replace(
        summary,
        status=GOOD if is_good else NOT_GOOD,
        verdict=one_line(table["verdict"] + " " + log["problem"]),
        certificate=_reported_certificate(summary, table),
        threshold_Nm=configured_Nm if certified is None else _threshold(table),
        margin=None if certified is None else _number(certified["smallest_margin"]),
        found=sum(contact["detected_s"] is not None for contact in armed),
        expected=len(armed) if has_truth else None,
        false_alarms=int(false_alarms) if has_truth else None,
        **_first_model(table),
    )


def _reported_certificate(summary: RunSummary, table: Mapping[str, Any]) -> CertificateState:
    """Return the last certificate of a run, by its report: state, when that came, s since motion start, their number.

    It came with the last complete adaptation; NO_CERTIFICATE without one. If a certificate was taken back, return it by
    the log's events; raises LogError if they can't be read.
    """
    certified = table["certified"]
    if certified is not None and certified["revoked"]:
        return _told_certificate(read_info(summary.log))
    ends = [_number(section["end_s"]) for section in _sections(table, "adaptation") if _flag(section["is_complete"])]
    if not ends:
        return CertificateState(NO_CERTIFICATE, None)
    return CertificateState(IDENTIFIED if certified is None else CERTIFIED, ends[-1], len(ends))


def _sections(table: Mapping[str, Any], kind: str) -> list[Mapping[str, Any]]:
    return [section for section in table["sections"].values() if section["kind"] == kind]


def _first_adaptation(table: Mapping[str, Any]) -> str | None:
    """Return the label of the first complete adaptation in a report; None without one."""
    return next((each["label"] for each in _sections(table, "adaptation") if _flag(each["is_complete"])), None)


def _threshold(table: Mapping[str, Any]) -> Pair | None:
    """Return by joint the smallest of the channels' median thresholds in the first detection section with margins, Nm.

    None if no detection section has margins. table: of a run of the certified scheme.
    """
    margins = table["certified"]["margins"]
    for section in _sections(table, "detection"):
        if channels := margins.get(section["label"]):
            rows = [_pair(channel["threshold_Nm"]) for channel in channels]
            return min(row[0] for row in rows), min(row[1] for row in rows)
    return None


def _first_model(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return friction and offsets with deviations, by field of RunSummary, of the first certificate without a payload.

    A run of the paper's scheme has the friction of its first complete adaptation only, None if unknown. {} for a
    certified run without such a certificate.
    """
    certified, section = table["certified"], _first_adaptation(table)
    if certified is None:
        return {"friction_Nm": _identified_friction(table["parameters"], section)}
    own = [each for each in certified["certificates"] if not _flag(each["is_payload"])]
    names = ("friction_Nm", "friction_std_Nm", "offset_Nm", "offset_std_Nm") if own else ()
    return {name: _pair(own[0][name][FRICTION_AT if name.startswith("friction") else slice(None)]) for name in names}


def _identified_friction(parameters: Mapping[str, Any], section: str | None) -> Pair | None:
    """Return the friction at FRICTION_AT_RAD_S that the paper's scheme identified in a section, Nm; None if unknown.

    section: None: no adaptation was complete.
    """
    if section is None or section not in parameters:
        return None
    values = {name: _number(pair[1]) for name, pair in parameters[section].items()}
    coulomb, viscous = ([values[f"{name}{joint}"] for joint in (1, 2)] for name in ("F_c", "F_v"))
    if None in coulomb or None in viscous:
        return None
    (c1, c2), (v1, v2) = _pair(coulomb), _pair(viscous)
    return c1 + FRICTION_AT_RAD_S * v1, c2 + FRICTION_AT_RAD_S * v2


def _number(value: Any) -> float | None:
    """Return a value of a report as float; None if it is null or not finite. Raises TypeError if it is no number."""
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{value!r} is no number")
    return float(value) if math.isfinite(value) else None


def _pair(values: Any) -> Pair:
    first, second = (_number(value) for value in values)
    if first is None or second is None:
        raise ValueError("a value per joint is missing")
    return first, second


def _flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise TypeError(f"{value!r} is neither true nor false")
    return value
