"""A run as plain arrays: the host's records, the emulator's truth, the streams of the certified scheme.

Torques in Nm, joint arrays (2,), histories time-first (n, 2). Times in s count from *motion start*: the first cycle in
ADAPT.

**Sections** are lettered. *adaptation* lasts from ADAPT until MONITOR, the test of the frozen model (CERTIFY) included;
*detection* from there to the announcement of a payload change; *payload* is PAYLOAD, *fault* is FAULT. REACT and
STOPPED belong to the section that they interrupt. The paper's experiment gives A to E.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.clock import REALTIME
from adacd_hil.log.log_files import LogError
from adacd_hil.log.logged_run import (
    Cycles,
    Mask,
    Truth,
    host_cycles,
    host_span,
    sections_in,
)
from adacd_hil.log.reader import LoggedEvent, Series
from adacd_hil.log.time_window import TimeWindow
from adacd_hil.log.types.topics import CYCLE, SCHEME
from adacd_hil.records import BEGINNING, ContactReport, CycleRecord, SchemeState, Vector
from adacd_hil.score.emulator_truth import TruthTable
from adacd_hil.settings.configuration import Settings


class Quantity(NamedTuple):
    """A time of a cycle.

    column: its name in /cycle, where it is in ns. `is_reserve`: it should be large, not small.
    """

    name: str
    column: str
    title: str
    is_reserve: bool = False

    @property
    def meaning(self) -> str:
        """From when to when, as /cycle says."""
        return next(member.meaning for member in CYCLE.head if member.name == self.column)


LATENESS: Final = Quantity("lateness", "lateness_ns", "Lateness")
COMPUTE: Final = Quantity("compute", "compute_ns", "Compute")
SYNC_TO_COMMAND: Final = Quantity("sync_to_command", "command_ns", "SYNC → command")
SLACK: Final = Quantity("slack", "slack_ns", "Slack", is_reserve=True)
QUANTITIES: Final = (
    LATENESS,
    Quantity("sync_to_feedback", "feedback_ns", "SYNC → feedback"),
    COMPUTE,
    SYNC_TO_COMMAND,
    SLACK,
)


@dataclass(frozen=True)
class CycleColumns:
    """The columns of /cycle over n cycles, int64 (n,), by the names of `CycleRecord`."""

    t_ns: Cycles
    columns: Mapping[str, Cycles]

    def __len__(self) -> int:
        return self.t_ns.size

    def __getitem__(self, name: str) -> Cycles:
        return self.columns[name]

    def rows(self, rows: Cycles) -> "CycleColumns":
        """Return the columns of some of the cycles; rows: their indices."""
        return CycleColumns(self.t_ns[rows], {name: column[rows] for name, column in self.columns.items()})

    def times_us(self, quantity: Quantity) -> Vector:
        """Return a time of the cycles that have it, µs (k,).

        Cycles with missing frames have no time from SYNC to feedback.
        """
        values_ns = self[quantity.column]
        if quantity.column == "feedback_ns":
            values_ns = values_ns[self["frames_missing"] == 0]  # else it is when the host gave up
        return np.asarray(values_ns / 1000.0, dtype=np.float64)

    def steps(self, name: str, before: int = 0) -> Cycles:
        """Return by how much a running count goes up in each cycle (n,); where it went down, it began anew from 0.

        before: the count in the cycle before the first.
        """
        count = self[name]
        added = np.diff(count, prepend=before)
        return np.where(added < 0, count, added)


def columns_of_series(series: Series) -> CycleColumns:
    """Return the columns of a log's /cycle. Raises LogError if its records lack one."""
    lacking = [name for name in CycleRecord._fields if name not in series.fields]
    if lacking:
        raise LogError(f"{CYCLE.name} has no {', '.join(lacking)}")
    return CycleColumns(series.t_ns, {name: series[name].astype(np.int64) for name in CycleRecord._fields})


def columns_of_records(t_ns: Sequence[int], records: Sequence[CycleRecord]) -> CycleColumns:
    """Return the columns of records, one per cycle, at the times t_ns."""
    table = np.array(records, dtype=np.int64).reshape(len(records), len(CycleRecord._fields))
    columns = {name: table[:, place].copy() for place, name in enumerate(CycleRecord._fields)}
    return CycleColumns(np.array(t_ns, dtype=np.int64), columns)


EMULATOR: Final = "emulator_"
"""Prefix of metadata that only the truth has."""


class AttemptBegins:
    """Finds the cycles in which attempts begin: in INIT or COMMISSION, after a cycle in neither of them.

    Cycles come piece by piece.
    """

    def __init__(self) -> None:
        self._begins: list[int] = []
        self._was_beginning: bool | None = None  # None before the first cycle

    def add_cycles(self, cycle: NDArray[Any], state: NDArray[np.uint8]) -> None:
        """Look for beginnings of attempts in the next cycles (k,), k > 0, and add their cycles to `begins`."""
        is_beginning = np.isin(state, BEGINNING)
        if self._was_beginning is None and not is_beginning[0]:
            self._begins.append(0)
        before = np.concatenate(([bool(self._was_beginning)], is_beginning[:-1]))
        self._begins += cycle[is_beginning & ~before].astype(np.int64).tolist()
        self._was_beginning = bool(is_beginning[-1])

    @property
    def begins(self) -> Cycles:
        """First cycle of each attempt so far; 0 for one that began before the log, or if none is known."""
        return np.array(self._begins or [0], np.int64)


@dataclass(frozen=True)
class CertifiedStream:
    """The certified scheme's values beyond the paper's, over n cycles.

    tau_ext, threshold: of the bank, Nm (n, channels, 2): each filter smoothed, then all but the slowest bare.
    theta_further (n, k): offsets, lags and friction terms; theta_std (n, p + k): of all parameters; promotions (n,):
    running count of refined models that took over.
    """

    tau_ext: Vector
    threshold: Vector
    theta_further: Vector
    theta_std: Vector
    promotions: Vector


@dataclass(frozen=True)
class PaperStream:
    """The paper's scheme that ran beside, over n cycles: is_armed (n,), its residual and threshold, Nm (n, 2)."""

    is_armed: Mask
    tau_ext_hat: Vector
    threshold: Vector


@dataclass(frozen=True)
class MeasuredMotion:
    """Measured values over n cycles: q rad, dq rad/s, tau_J Nm, each (n, 2)."""

    q: Vector
    dq: Vector
    tau_J: Vector


@dataclass(frozen=True)
class CheckCounts:
    """Running counts of the end-to-end checks of cyclic frames, as logged k times: counts (k, devices, statuses).

    cycle (k,): of each logging.
    """

    devices: tuple[str, ...]
    cycle: Cycles
    counts: Cycles


class StretchOfRun(NamedTuple):
    """A stretch of a log that was read: as asked, and as found, widened so that it cuts nothing.

    contacts_before: number of contacts before it. motion_start_s: s since the beginning of the log.
    """

    asked: TimeWindow
    found: TimeWindow
    contacts_before: int
    motion_start_s: float


@dataclass(frozen=True)
class Run:
    """A run as plain arrays over n of its cycles: over all, or of a long one over those that the report keeps.

    Joint arrays are (n, 2), theta_hat (n, p). `truth` is None on a real arm. frames, dropped: counts of the log's
    summary, None if it lacks them. zero_ns: motion start, the first cycle in ADAPT, else the first cycle; 0 without
    cycles.
    """

    cycle: Cycles
    t_ns: Cycles
    state: NDArray[np.uint8]
    fault: NDArray[np.uint8]
    tau_ext_hat: Vector
    tau_ext_hat_cad: Vector
    theta_hat: Vector
    threshold: Vector
    reports: tuple[ContactReport, ...]
    timing: CycleColumns
    truth: Truth | None
    settings: Settings
    metadata: Mapping[str, str]
    frames: int | None
    dropped: int | None
    contact_joints: NDArray[np.uint8]  # bit i: joint i is over its threshold
    motion: MeasuredMotion
    zero_ns: int = 0
    finish_cycle: int | None = None  # cycle of the request to finish; None: never
    certified: CertifiedStream | None = None  # None of the paper's scheme
    beside: PaperStream | None = None
    events: tuple[LoggedEvent, ...] = ()
    all_cycles: int | None = None  # of a long run: how many there are, of which the n are kept
    bucket: int = 1  # of a long run: of so many cycles those with extremes are kept
    log_start_ns: int | None = None  # the beginning of its log
    stretch: StretchOfRun | None = None  # None: the whole log
    checks: CheckCounts | None = None  # None: not in the log
    broken_off: str = ""  # the reason for an unintended end of the log
    is_cut: bool = False  # the log was cut from the run's

    @property
    def is_part(self) -> bool:
        """Whether the run began before these cycles, or may have gone on after them, as was asked for."""
        return self.is_cut or self.stretch is not None

    @property
    def first_contact(self) -> int:
        """Number that the first contact in this stretch has among all contacts of the log, from 1."""
        return 1 if self.stretch is None else 1 + self.stretch.contacts_before

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the columns of `theta_hat`."""
        return self.settings.estimator.parameter_names

    @property
    def has_cad(self) -> bool:
        """Whether the configuration has a CAD model, `arm.cad_theta`."""
        return len(self.settings.arm.cad_theta) > 0

    def time_s(self) -> Vector:
        """Return the time of each cycle since motion start, s (n,)."""
        # Subtracted as integers: float64 resolves only 256 ns of an absolute time.
        return np.asarray((self.t_ns - self.zero_ns) * 1e-9, dtype=np.float64)


@dataclass(frozen=True)
class Section:
    """A section of a run, times in s since motion start. `is_complete`: False if the run ended, or failed, in it."""

    label: str
    kind: str  # "adaptation", "detection", "payload", "fault"
    start_s: float
    end_s: float
    is_complete: bool

    @property
    def duration_s(self) -> float:
        """Length in s."""
        return self.end_s - self.start_s


def section_label(index: int) -> str:
    """Return the label of the section with number `index`, from 0: A to Z, then AA, AB and so on."""
    letter = chr(ord("A") + index % 26)
    return letter if index < 26 else section_label(index // 26 - 1) + letter


class Stay(NamedTuple):
    """A span of time in one state, s since motion start. row: of its first cycle, in the arrays of the run."""

    state: SchemeState
    start_s: float
    end_s: float
    row: int


def stays_of(run: Run) -> list[Stay]:
    """Return the spans of a run in one state each, in order of time; [] for a run without cycles.

    A span ends at the first cycle of the next one, the last span at the last cycle.
    """
    if run.state.size == 0:
        return []
    edges = np.flatnonzero(run.state[1:] != run.state[:-1]) + 1
    time_s = run.time_s()
    ends_s = [*time_s[edges].tolist(), float(time_s[-1])]
    return [
        Stay(SchemeState(int(run.state[row])), float(time_s[row]), end_s, row)
        for row, end_s in zip([0, *edges.tolist()], ends_s, strict=True)
    ]


def split_sections(run: Run) -> tuple[Section, ...]:
    """Return the lettered sections of a run, in the order of time; () for a run without cycles."""
    time_s = run.time_s()
    return tuple(
        Section(section_label(number), rows.kind, float(time_s[rows.first]), float(time_s[rows.end]), rows.is_complete)
        for number, rows in enumerate(sections_in(run.state))
    )


def section_at(sections: Iterable[Section], time_s: float) -> str | None:
    """Return the label of the first section that contains a time, s since motion start, its ends included.

    None if none does.
    """
    return next((section.label for section in sections if section.start_s <= time_s <= section.end_s), None)


def rows_of(time_s: Vector, section: Section, end_s: float) -> slice:
    """Return the rows of a section among cycles at the ascending times `time_s` (n,).

    end_s: when the run ends. The cycle between two sections belongs to the later one, the run's last cycle to the last
    section.
    """
    is_last = bool(section.end_s >= end_s)
    first = int(np.searchsorted(time_s, section.start_s))
    return slice(first, int(np.searchsorted(time_s, section.end_s, side="right" if is_last else "left")))


def is_realtime(run: Run) -> bool:
    """Return whether the run went by the host's clock, not in lockstep."""
    return run.metadata.get("clock") == REALTIME


def host_truth(table: TruthTable, begins: Cycles, last: int, time_s: Vector) -> Truth | None:
    """Return the truth on the host's cycles; None if the emulator logged no cycle.

    begins: first cycle of each attempt of the run so far; last: the host's last cycle; time_s: of the rows (m,). Rows
    of later attempts, and those after the host's last cycle, are left out: the arm goes on when the host has died.
    Payloads and parameters after that cycle stay, those of later attempts don't.
    """
    rows = table.rows
    if table.span is None:
        return None
    cycle = host_cycles(rows.cycle, rows.attempt, begins)
    of_host = (cycle <= last) & (rows.attempt < len(begins))
    return replace(
        truth_rows(replace(rows.with_host_models(begins), cycle=cycle, time_s=time_s), of_host),
        span=host_span(table.span, begins),
    )


def truth_rows(truth: Truth, rows: NDArray[np.bool_]) -> Truth:
    """Return a truth with the chosen ones of its rows, and with all of its payloads and parameters.

    rows (m,): a mask.
    """
    names = ("cycle", "tau_ext", "contact_link", "contact_index", "force_N", "time_s", "attempt")
    return replace(truth, **{name: getattr(truth, name)[rows] for name in names})


def last_cycle(path: Path, scheme: Series, before: tuple[int, int] = (-1, -1)) -> tuple[int, int]:
    """Return number and time, ns, of the last cycle of a piece of /scheme; before: those of the one before the piece.

    Raises LogError, which names the log's `path`, for a cycle that is not after the one before, as of two joined logs.
    """
    cycle = scheme.records["cycle"].astype(np.int64)
    for column, last in zip((cycle, scheme.t_ns), before, strict=True):
        for number in cycle[np.diff(column, prepend=last) <= 0][:1].tolist():
            raise LogError(f"log {path}, {SCHEME.name}: cycle {number} is not after the one before, by number or time")
    return (int(cycle[-1]), int(scheme.t_ns[-1])) if len(scheme) else before
