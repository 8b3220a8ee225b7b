"""The outline of a run: where its parts begin and end, from one reading of its log front to back, in bounded memory.

Of its cycles an outline has the first and the last of every piece, those in which the state changes with their
neighbours, those in which the paper's scheme is armed or disarmed, and those in which a true contact begins. These
cycles suffice for sections, detections and contacts, and for the points where a run can be cut: not within a contact, a
reaction or an adaptation. A stretch has each of these whole or not at all.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from adacd_hil.log.logged_run import (
    AttemptBegins,
    CertifiedStream,
    CheckCounts,
    Cycles,
    MeasuredMotion,
    PaperStream,
    Run,
    host_cycles,
)
from adacd_hil.log.reader import LoggedEvent, LogStream, Piece, Series, contacts_of
from adacd_hil.records import JOINTS, ContactReport, Request, SchemeState
from adacd_hil.score.emulator_truth import TruthTable, host_truth
from adacd_hil.score.judge import true_contacts
from adacd_hil.score.margins import SETTLING_TIME_CONSTANTS
from adacd_hil.settings.configuration import Settings

BUSY: Final = (SchemeState.ADAPT, SchemeState.CERTIFY, SchemeState.REACT, SchemeState.STOPPED)
"""States that a stretch does not cut."""


class Facts:
    """The facts that a reading finds in a run besides its rows."""

    def __init__(self) -> None:
        self.cycles = 0
        self.reports: list[ContactReport] = []
        self.events: list[LoggedEvent] = []
        self.finish_cycle: int | None = None
        """Cycle of the first request to finish."""
        self.motion_start_ns: int | None = None
        """The first cycle in ADAPT."""
        self.first_ns: int | None = None
        self._checks: list[CheckCounts] = []
        self._attempts = AttemptBegins()

    @property
    def begins(self) -> Cycles:
        """First cycle of each attempt so far; of one that began before the log, 0."""
        return self._attempts.begins

    @property
    def zero_ns(self) -> int:
        """Motion start, else the first cycle."""
        return next((t_ns for t_ns in (self.motion_start_ns, self.first_ns) if t_ns is not None), 0)

    def add(self, stream: LogStream, piece: Piece) -> None:
        """Add the facts of the next piece."""
        self.reports += [entry.report for entry in contacts_of(piece.series["/contact"])]
        self.events += stream.events(piece)
        self._checks += _checks_of(piece.series["/frame_checks"])
        scheme = piece.series["/scheme"]
        if not len(scheme):
            return
        records = scheme.records
        self._attempts.add(records["cycle"], records["state"])
        if self.first_ns is None:
            self.first_ns = int(scheme.t_ns[0])
        adapting = np.flatnonzero(records["state"] == SchemeState.ADAPT)
        if self.motion_start_ns is None and adapting.size:
            self.motion_start_ns = int(scheme.t_ns[adapting[0]])
        asked = np.flatnonzero(records["request"] == Request.FINISH)
        if self.finish_cycle is None and asked.size:
            self.finish_cycle = int(records["cycle"][asked[0]])
        self.cycles += len(scheme)

    def apply(self, run: Run) -> Run:
        """Return a run with these facts, else as `run`."""
        return dataclasses.replace(
            run,
            reports=tuple(self.reports),
            events=tuple(self.events),
            finish_cycle=self.finish_cycle,
            checks=_joined(self._checks),
            motion_start_ns=run.motion_start_ns if run.motion_start_ns is not None else self.zero_ns,
        )


_CHECKS: Final = "_checks"
"""How the field of a device's counts in /frame_checks ends."""


def _checks_of(series: Series) -> list[CheckCounts]:
    """Take the counts out of a piece of /frame_checks, if it has any."""
    devices = tuple(name.removesuffix(_CHECKS) for name in series.fields if name.endswith(_CHECKS))
    if not len(series) or not devices:
        return []
    counts = np.stack([series[device + _CHECKS].astype(np.int64) for device in devices], axis=1)
    return [CheckCounts(devices, series["cycle"].astype(np.int64), counts)]


def _joined(parts: list[CheckCounts]) -> CheckCounts | None:
    if not parts:
        return None
    cycle = np.concatenate([part.cycle for part in parts])
    return CheckCounts(parts[0].devices, cycle, np.concatenate([part.counts for part in parts]))


class TruthClock:
    """Finds the host's time of each row of the truth, as the log is read: between the cycles that it lies between."""

    def __init__(self, truth: TruthTable) -> None:
        self.t_ns = np.zeros(len(truth.cycle), np.int64)
        self._truth = truth
        self._pending = np.arange(len(truth.cycle))
        self._before: tuple[int, int] | None = None  # cycle and time of the last row before the piece

    def add(self, scheme: Series, begins: Cycles) -> tuple[Cycles, Cycles]:
        """Place the rows of the truth that fall into a piece of the log; return these rows and their cycles.

        begins: first cycle of each attempt so far.
        """
        cycle, t_ns = scheme.records["cycle"].astype(np.int64), scheme.t_ns
        pending = self._pending
        known = host_cycles(self._truth.cycle[pending], self._truth.attempt[pending], begins)
        is_told = (self._truth.attempt[pending] < len(begins)) & (known <= cycle[-1])
        rows, cycles = pending[is_told], known[is_told]
        self.t_ns[rows] = self._times_ns(cycles, cycle, t_ns)
        self._pending = pending[~is_told]
        self._before = int(cycle[-1]), int(t_ns[-1])
        return rows, cycles

    def _times_ns(self, wanted: Cycles, cycle: Cycles, t_ns: Cycles) -> Cycles:
        if self._before is not None:
            cycle, t_ns = np.append(self._before[0], cycle), np.append(self._before[1], t_ns)
        since_ns = np.interp(wanted, cycle, (t_ns - t_ns[0]).astype(np.float64))
        return np.asarray(t_ns[0] + np.rint(since_ns).astype(np.int64))

    @property
    def last_cycle(self) -> int:
        """The last cycle that was read, -1 before the first."""
        return -1 if self._before is None else self._before[0]

    def end(self) -> None:
        """Give rows after the last cycle the time of that cycle."""
        if self._before is not None:
            self.t_ns[self._pending] = self._before[1]
        self._pending = self._pending[:0]


class Outline:
    """One reading of a log, piece by piece."""

    def __init__(self, shell: Run, empty: Series, truth: TruthTable | None) -> None:
        """`shell`: a run with empty arrays: settings, metadata, and a truth on the host's cycles if there is one.

        empty: a piece of /scheme without records; truth: rows whose cycle of the host is still to be found.
        """
        self.facts = Facts()
        self.indexes: list[NDArray[np.int64]] = []
        """Index of each row's cycle among the cycles that were read, from 0."""
        self._shell = shell
        self._rows = SchemeRows(empty)
        self._truth = truth
        self._clock = None if truth is None else TruthClock(truth)
        index = next((known.contact_index for known in (truth, shell.truth) if known is not None), np.empty(0))
        self._is_onset = (index >= 0.0) & (np.concatenate(([-1.0], index))[:-1] != index)
        self._last: tuple[int, bool] | None = None  # state of the row before, and whether the paper's scheme was armed
        self._busy_ns = 0  # time of the last cycle in a state of `BUSY`, or of a later row of the truth

    def add(self, stream: LogStream, piece: Piece) -> None:
        """Add the next piece: its facts, and the rows of the outline."""
        before = self.facts.cycles
        self.facts.add(stream, piece)
        scheme = piece.series["/scheme"]
        if not len(scheme):
            return
        rows = np.unique(np.concatenate((self._edges(scheme), self._onset_rows(scheme))))
        rows = rows[(rows >= 0) & (rows < len(scheme))]
        self._rows.add(scheme, rows)
        self.indexes.append(before + rows)
        busy = np.flatnonzero(np.isin(scheme.records["state"], BUSY))
        if busy.size:
            self._busy_ns = max(self._busy_ns, int(scheme.t_ns[busy[-1]]))

    def is_idle_since(self, t_ns: int) -> bool:
        """Tell whether the last cycle in a state of `BUSY` and the last row of the truth so far are before a time."""
        return self._busy_ns < t_ns

    def _edges(self, scheme: Series) -> NDArray[np.int64]:
        """List the first and last row and the rows beside changes of the state or of arming of the paper's scheme."""
        state = scheme.records["state"].astype(np.int64)
        is_armed = np.zeros(len(state), np.bool_)
        if "paper_is_armed" in scheme.fields:
            is_armed = scheme.records["paper_is_armed"] > 0.5
        last_state, was_armed = self._last or (int(state[0]), bool(is_armed[0]))
        self._last = int(state[-1]), bool(is_armed[-1])
        changes = np.flatnonzero(np.diff(state, prepend=last_state))
        switches = np.flatnonzero(np.diff(is_armed.astype(np.int8), prepend=np.int8(was_armed)))
        ends = np.array([0, len(state) - 1])
        return np.concatenate((ends, changes - 1, changes, changes + 1, switches - 1, switches))

    def _onset_rows(self, scheme: Series) -> NDArray[np.int64]:
        """List the rows in which true contacts begin, and the ones before them."""
        cycle = scheme.records["cycle"].astype(np.int64)
        if self._clock is not None:
            rows, cycles = self._clock.add(scheme, self.facts.begins)
            onsets = cycles[self._is_onset[rows]]
            if rows.size:
                self._busy_ns = max(self._busy_ns, int(self._clock.t_ns[rows].max()))
        elif self._shell.truth is not None:
            onsets = self._shell.truth.cycle[self._is_onset]
            onsets = onsets[(onsets >= cycle[0]) & (onsets <= cycle[-1])]
        else:
            return np.empty(0, np.int64)
        found = np.searchsorted(cycle, onsets)
        return np.concatenate((found - 1, found))

    def done(self) -> Run:
        """Give the outline of the run."""
        run = self.facts.apply(self._rows.fill(self._shell))
        if self._truth is None or self._clock is None:
            return run
        self._clock.end()
        time_s = np.asarray((self._clock.t_ns - run.zero_ns) * 1e-9, np.float64)
        last = self._clock.last_cycle
        return dataclasses.replace(run, truth=host_truth(self._truth, self.facts.begins, last, time_s))


Rows = NDArray[np.int64]

_TIME: Final = "t_ns"
_PLAIN: Final = ("state", "fault", "contact_joints", "tau_ext_hat", "tau_ext_hat_cad", "theta_hat", "threshold")
_MOTION: Final = ("q", "dq", "tau_J")
_CERTIFIED: Final = ("tau_ext_bank", "threshold_bank", "theta_further", "theta_std", "promotions")
_PAPER: Final = ("paper_is_armed", "paper_tau_ext_hat", "paper_threshold")


class SchemeRows:
    """Rows of /scheme, gathered piece by piece: only the fields that a report reads.

    One block of memory holds them. It is allocated at once and used as far as it is filled: columns that are gathered
    apart and joined at the end need the memory twice, and fragment it.
    """

    def __init__(self, first: Series, room: int = 1 << 16) -> None:
        """Take all records of `first`, a piece of /scheme with or without records. room: rows to allocate at first."""
        self.count = 0
        self._room = room
        self._begin(first)
        self.add(first)

    def _begin(self, scheme: Series) -> None:
        """Make room for rows of such fields."""
        names = [name for name in ("cycle", *_PLAIN, *_MOTION, *_CERTIFIED, *_PAPER) if name in scheme.fields]
        fields = [(_TIME, np.dtype(np.int64)), *((name, scheme.records.dtype[name]) for name in names)]
        self._rows = np.empty(max(self._room, len(scheme)), np.dtype(fields, align=True))

    def add(self, scheme: Series, rows: Rows | slice = slice(None)) -> None:
        """Take some rows of a piece."""
        if not len(scheme):
            return
        if self.count == 0:
            self._begin(scheme)  # only a record shows the fields of a log
        t_ns = scheme.t_ns[rows]
        end = self.count + len(t_ns)
        if end > len(self._rows):
            more = np.empty(max(end, 2 * len(self._rows)), self._rows.dtype)
            more[: self.count] = self._rows[: self.count]
            self._rows = more
        here = self._rows[self.count : end]
        here[_TIME] = t_ns
        for name in (self._rows.dtype.names or ())[1:]:
            here[name] = scheme.records[name][rows]
        self.count = end

    def fill(self, shell: Run) -> Run:
        """Give a run with these rows, else as `shell`."""
        rows = self._rows[: self.count]
        columns = {name: rows[name] for name in rows.dtype.names or ()}
        return dataclasses.replace(shell, **_arrays(columns, shell.settings))


def run_of_piece(scheme: Series, shell: Run) -> Run:
    """Give a run with the rows of one piece, else as `shell`."""
    return SchemeRows(scheme).fill(shell)


def _arrays(columns: dict[str, NDArray[Any]], settings: Settings) -> dict[str, Any]:
    """Give the fields of a run."""
    arrays: dict[str, Any] = {name: columns[name] for name in _PLAIN}
    arrays |= {"cycle": columns["cycle"].astype(np.int64), _TIME: columns[_TIME]}
    arrays["motion"] = MeasuredMotion(*(columns[name] for name in _MOTION))
    if "tau_ext_bank" in columns:
        shape = (-1, settings.channel_count, JOINTS)
        arrays["certified"] = CertifiedStream(
            tau_ext=columns["tau_ext_bank"].reshape(shape),
            threshold=columns["threshold_bank"].reshape(shape),
            theta_further=columns["theta_further"],
            theta_std=columns["theta_std"],
            promotions=columns["promotions"],
        )
    if "paper_is_armed" in columns:
        arrays["beside"] = PaperStream(
            is_armed=columns["paper_is_armed"] > 0.5,
            tau_ext_hat=columns["paper_tau_ext_hat"],
            threshold=columns["paper_threshold"],
        )
    return arrays


MARGIN_S: Final = 0.2
"""Margin before a contact or a reaction."""


def settling_s(run: Run) -> float:
    """Return the time after which a contact or a reaction has left the filters, s."""
    return SETTLING_TIME_CONSTANTS / run.a_rad_s


def widen(run: Run, start_s: float, end_s: float) -> tuple[float, float]:
    """Extend a stretch of a run, s since motion start, as little as needed to cut no contact and no adaptation.

    run: has the cycles in which contacts and adaptations begin or end.
    """
    if run.cycle.size == 0:
        return start_s, end_s
    busy = sorted(_busy(run))
    for first_s, last_s in reversed(busy):
        if first_s < start_s < last_s:
            start_s = first_s
    for first_s, last_s in busy:
        if first_s < end_s < last_s:
            end_s = last_s
    return start_s, end_s


def _busy(run: Run) -> Iterator[tuple[float, float]]:
    """Yield start and end of each true contact and each stretch in a state of `BUSY`, margins included, s."""
    time_s, later_s = run.time_s(), settling_s(run)
    is_busy = np.concatenate(([False], np.isin(run.state, BUSY), [False]))
    edges = np.flatnonzero(is_busy[1:] != is_busy[:-1])
    for first, end in edges.reshape(-1, 2).tolist():
        yield float(time_s[first]) - MARGIN_S, float(time_s[min(end, len(time_s) - 1)]) + later_s
    for touch in true_contacts(run):
        yield touch.onset_s - MARGIN_S, touch.end_s + later_s
