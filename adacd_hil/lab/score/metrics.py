"""The results of a run in numbers: adaptation times, residuals, contacts, false alarms, margins, times of the cycle.

`evaluation` makes these results of a run's arrays. Times in s count from *motion start*: the first cycle in ADAPT.
Torques in Nm, joint arrays (2,), histories time-first (n, 2); `tau_ext_hat` has the filter's DC gain taken out, so
that a torque step tau crosses the threshold h after t = -ln(1 - h / |tau|) / a.

**Sections** are lettered A, B, C, … in order, see `adacd_hil.lab.score.run_arrays`. An adaptation's time is that of its
section: up to MONITOR, the test of the frozen model and contacts on the way included.

**Frozen residual**: largest |tau_ext_hat| of each joint free of contact. A cycle counts unless it lies in
[onset, end + 10/a] of a true contact, or less than 10/a after a cycle in REACT: 10 time constants leave 0.2 mNm of
5 Nm. In a detection section only armed cycles (MONITOR) count; in an adaptation section all do, and only the CAD
model's residual is given, because theta_hat still moves. Without the truth, [detection - 10/a, detection + 10/a]
stands for the contact; with it, cycles that it does not cover don't count. After the request to finish the arm parks
and stands, where friction may hold any torque up to F_c: those cycles don't count.

**A detection** is an alarm of `adacd_hil.score.judge`. That module decides which contacts were found or missed, and
which detections are false alarms; detection is armed in MONITOR.

**Certified scheme.** The residual is that of its slowest filter, `a` that filter's cut-off; `law_ms` and `ideal_ms` are
those of the fastest channel of its bank. Its margins, and the paper's scheme that ran beside it on the same stream:
`adacd_hil.lab.score.margins`.
"""

import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from adacd_hil.lab.score.rates import rate_bound_per_h
from adacd_hil.lab.score.run_arrays import Section
from adacd_hil.log.types.topics import CERTIFIED_MODEL
from adacd_hil.score.smallest_push import SmallestPush

if TYPE_CHECKING:
    from adacd_hil.scheme.identify.certificate import Certificate  # it compiles


class Count(NamedTuple):
    """How often a thing happened, in all and per 100 000 cycles; the latter is None without a cycle."""

    total: int
    per_100000: float | None


@dataclass(frozen=True)
class TimingEvidence:
    """The times of a run, summed up; None: without a meaning in lockstep.

    is_modelled: lockstep, the times are those of the model of bus and host, not of this machine. times: percentiles by
    name, µs, of each time; histograms: of those that aren't None. reaction: percentiles of the latency from the
    decision to the first command that reacts, µs, and the `count` of reactions; None without states. data_age: number
    of cycles by the age, in cycles, of the oldest value used; the last entry is for OLDEST_CYCLES and more.
    queues_bytes, counts: by name.
    """

    period_us: float
    is_modelled: bool
    cycles: int
    times: Mapping[str, Mapping[str, float] | None]
    histograms: Mapping[str, Mapping[str, Any]]
    reaction: Mapping[str, float] | None
    data_age: tuple[int, ...]
    queues_bytes: Mapping[str, Mapping[str, float] | None]
    counts: Mapping[str, Count]

    def by_key(self) -> dict[str, Any]:
        """Return the evidence by the keys of report.json, such as "times_us"; a missing histogram is None."""
        return {
            "is_modelled": self.is_modelled,
            "period_us": self.period_us,
            "cycles": self.cycles,
            "times_us": self.times,
            "reaction_us": self.reaction,
            "data_age_cycles": self.data_age,
            "queues_bytes": self.queues_bytes,
            "counts": self.counts,
            "histograms_us": {name: self.histograms.get(name) for name in self.times},
        }


class Finding(NamedTuple):
    """A clause about the run; is_bad: the run is not good because of it."""

    text: str
    is_bad: bool = False


class Fault(NamedTuple):
    """A stay in FAULT, from `at_s` s after motion start.

    reason: name of a FaultReason. cause: the log's words for it, "" without any; is_last: the run ended in it.
    """

    reason: str
    at_s: float
    cause: str
    is_last: bool


@dataclass(frozen=True)
class DeviceShares:
    """Shares of a device's cycles, 0…1: without a new frame, with a repeated one, and the worst second of each.

    cycles: number of those that are judged.
    """

    cycles: int
    no_new_data: float
    repeated: float
    worst_no_new_data: float
    worst_repeated: float


@dataclass(frozen=True)
class CyclicData:
    """Shares of `cycles` cycles with powered drives, 0…1, in which data was incomplete or older than the cycle.

    incomplete, worst_incomplete (of a second), aged: None where the log lacks it. devices: empty where it does.
    excesses: a line for each share over its limit in some second.
    """

    cycles: int
    incomplete: float | None
    worst_incomplete: float | None
    aged: float | None
    devices: dict[str, DeviceShares]
    excesses: tuple[str, ...]


class BesideDetection(NamedTuple):
    """The detection of a true contact by the paper's scheme beside; number: as in the list of contacts.

    detected_s: s since motion start; it and the delay are None if no crossing found the contact.
    """

    number: int
    is_armed: bool
    detected_s: float | None
    delay_ms: float | None


@dataclass(frozen=True)
class Beside:
    """The results of the paper's scheme that ran beside, by the definitions of the module's first lines.

    Without the truth there are no contacts, and false alarms and misses are None. adaptation_s: None where it did not
    end.
    """

    adaptation_s: dict[str, float | None]
    frozen_residual_max_Nm: dict[str, tuple[float, float] | None]
    contacts: tuple[BesideDetection, ...]
    false_alarms: int | None
    false_alarms_s: tuple[float, ...] | None
    missed: int | None


@dataclass(frozen=True)
class ParameterEstimate:
    """A parameter at the end of an adaptation, and the scheme's own standard deviation of it, both in its unit."""

    value: float
    std: float


@dataclass(frozen=True)
class ChannelMargin:
    """A channel of the bank over a section, in cycles free of contact; lists are by joint.

    cutoff_rad_s, smoothing_rad_s: of its one or two filters, None: one. residual_max_Nm: largest |residual|.
    threshold_Nm: median of the threshold. margin: smallest threshold / |residual| of a cycle; inf if the residual was 0
    throughout.
    """

    cutoff_rad_s: float
    smoothing_rad_s: float | None
    residual_max_Nm: list[float]
    threshold_Nm: list[float]
    margin: list[float]


@dataclass(frozen=True)
class CertifiedEvidence:
    """Evidence of the certified scheme.

    By label of each adaptation: number of tests of the frozen model, length of the last test, s (None without one), and
    the parameters.

    margins: by section. promotions: refined models that took over in the run. is_anchored: whether every certificate in
    the log names the anchors of all its offsets; True without a certificate. revoked: why certificates were withdrawn,
    the earliest first. smallest_push: None without a cycle in MONITOR free of contact. certificates: those that were
    not withdrawn, as the log has them at its end; () for a log without its end, or of an earlier version.
    """

    tests: dict[str, int]
    test_s: dict[str, float | None]
    estimates: dict[str, dict[str, ParameterEstimate]]
    margins: dict[str, tuple[ChannelMargin, ...]]
    promotions: int
    paper_beside: Beside | None
    is_anchored: bool
    revoked: tuple[str, ...]
    smallest_push: SmallestPush | None
    certificates: "tuple[Certificate, ...]" = ()

    @property
    def smallest_margin(self) -> float | None:
        """The smallest margin of any channel, joint and section; None without margins."""
        values = [min(row.margin) for rows in self.margins.values() for row in rows]
        return min(values, default=None)


def certificates_in(told: Iterable[tuple[str, str]]) -> "Iterator[Certificate]":
    """Yield the certificates in events of the name CERTIFIED_MODEL.

    Unreadable ones, such as those of another version, are left out.

    told: (name, message) of each event.
    """
    from adacd_hil.scheme.identify.certificate import Certificate  # it compiles

    for name, message in told:
        if name == CERTIFIED_MODEL:
            with suppress(ValueError, TypeError, RecursionError, AttributeError):  # of another version
                values: dict[str, Any] = {
                    key: tuple(value) if isinstance(value, list) else value
                    for key, value in json.loads(message).items()
                }
                yield Certificate(**values)


@dataclass(frozen=True)
class Residual:
    """Largest |tau_ext_hat| of a section, Nm per joint, over `cycles` cycles free of contact.

    identified: of the frozen model, cad: of the CAD model. None without such a cycle; identified also in an adaptation
    section, cad without a CAD model.
    """

    identified: tuple[float, float] | None
    cad: tuple[float, float] | None
    cycles: int


class PaperRow(NamedTuple):
    """One row of the table that compares the run with the paper, as texts.

    paper: the paper's value, None if the run is not of the paper's experiment; beside: that of the paper's scheme on
    the same stream, NONE of `wording` if it didn't run, None if the paper's scheme is the run's own.
    """

    quantity: str
    paper: str | None
    beside: str | None
    measured: str


class ReportSource(NamedTuple):
    """The log that a run was read from.

    is_complete: log and truth are whole, no packet was dropped on the way to them, and all alarms could be judged.
    log_problem: the parts that the log lacks, one line. truth_problem: why the truth could not judge some or all of the
    run. config, scenario, truth: names or files that the run was started with; "" if unknown.
    """

    log_name: str
    log_problem: str = ""
    is_complete: bool = True
    truth_problem: str = ""
    config: str = ""
    scenario: str = ""
    truth: str = ""

    @property
    def notice(self) -> str:
        """One line for a reader on the problems of log and truth; "" without any."""
        log = f"The log is not whole: {self.log_problem}" if self.log_problem else ""
        truth = f"Not all could be judged: {self.truth_problem}" if self.truth_problem else ""
        return "; ".join(filter(None, (log, truth)))


@dataclass(frozen=True, kw_only=True)
class ReportedContact:
    """A true contact and its detection, or on a real arm a detection alone. None: unknown, or there is none.

    Times in s since motion start. state: of the scheme at the onset, on a real arm at the detection. law_ms:
    closed-form delay of a step of the largest torque up to the detection, the faster joint; None if never. ideal_ms:
    delay that the filter alone gives to the true torque as it was; None if never. link_at_alarm, link_detected:
    isolated at detection and at the end of the isolation window. link_ok: somebody touched that link at some time until
    then. torque_error_ratio: peak with the filter undone over the true peak, at the joint with the larger true torque.
    true_force_N: size of the true force, at whatever angle. level to blind_deg: of the last report, in the names of
    `records`; None where it has no value. A sigma is a standard deviation.
    """

    number: int
    section: str | None = None
    state: str
    link: int | None = None
    onset_s: float | None = None
    end_s: float | None = None
    is_armed: bool
    detected_s: float | None = None
    delay_ms: float | None = None
    law_ms: float | None = None
    ideal_ms: float | None = None
    link_at_alarm: int | None = None
    link_detected: int | None = None
    link_ok: bool | None = None
    direction: tuple[int, int] | None = None
    direction_ok: bool | None = None
    tau_ext_Nm: tuple[float, float] | None = None
    tau_ext_peak_hat_Nm: tuple[float, float] | None = None
    torque_error_ratio: float | None = None
    true_force_N: float | None = None
    level: str | None = None
    kind: str | None = None
    reaction: str | None = None
    location: str | None = None
    is_two_sided: bool | None = None
    tau_ext_peak_sigma_Nm: tuple[float | None, float | None] | None = None
    impulse_Nm_s: tuple[float, float] | None = None
    impulse_sigma_Nm_s: tuple[float | None, float | None] | None = None
    force_N: float | None = None
    force_sigma_N: float | None = None
    lever_m: float | None = None
    lever_sigma_m: float | None = None
    blind_deg: float | None = None

    @property
    def at_s(self) -> float:
        """Onset of the contact, or its detection if the onset is unknown, s since motion start."""
        at_s = self.onset_s if self.onset_s is not None else self.detected_s
        assert at_s is not None
        return at_s


@dataclass(frozen=True)
class Metrics:
    """The content of the report, see the module's first lines for the definitions.

    fault, fault_s: the first one of the run, None without one. cycle: number, duration, clock and scheduler of all
    cycles. missed and false_alarms_s: None without the truth. evidence: None for the paper's scheme.
    findings: a clause each, the gravest first.
    """

    sections: tuple[Section, ...]
    adaptation_s: dict[str, float | None]
    frozen_residual_max_Nm: dict[str, Residual]
    contacts: tuple[ReportedContact, ...]
    false_alarms_s: tuple[float, ...] | None
    missed: int | None
    parameters: dict[str, dict[str, tuple[float | None, float]]]
    payload_kg: dict[str, float | None]
    fault: str | None
    fault_s: float | None
    cycle: dict[str, Any]
    timing: TimingEvidence
    data: CyclicData
    frames: int | None
    dropped: int | None
    evidence: CertifiedEvidence | None
    armed_false_alarms: int | None  # of them those in MONITOR
    paper: tuple[PaperRow, ...] = ()
    findings: tuple[Finding, ...] = ()

    @property
    def false_alarms(self) -> int | None:
        """Number of false alarms; None without the truth."""
        return None if self.false_alarms_s is None else len(self.false_alarms_s)

    @property
    def verdict(self) -> str:
        """All findings in one sentence, with a capital and a full stop."""
        text = "; ".join(finding.text for finding in self.findings)
        return f"{text[:1].upper()}{text[1:]}."

    @property
    def is_clean(self) -> bool:
        """Whether no finding is bad. The log may be damaged all the same."""
        return not any(finding.is_bad for finding in self.findings)

    @property
    def false_alarm_bound_per_h(self) -> float | None:
        """Upper bound, one-sided, of the certified scheme's rate of false alarms in MONITOR, 1/h, by their number.

        None without the truth, for the paper's scheme, or without a cycle in MONITOR free of contact.
        """
        push = None if self.evidence is None else self.evidence.smallest_push
        if push is None or self.armed_false_alarms is None:
            return None
        return rate_bound_per_h(self.armed_false_alarms, push.hours)
