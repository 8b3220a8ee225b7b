"""The truth of a run from the emulator's log: the cycles of its contacts, the model of the arm, its true contacts.

Of a contact the first cycles and the last second are kept as they are. In between, of every `_BUCKET` cycles those
with the smallest and largest torque of each joint and the largest force; that many contacts of many seconds fit in
memory, and the peaks and the filtered torque at their end stay exact.

The reader refuses a log of another run, as far as both logs name their scenario.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.log.log_files import CONFIG_DIGEST_KEY, TRUTH_NAME
from adacd_hil.log.log_info import attachment, run_metadata
from adacd_hil.log.logged_run import (
    Cycles,
    EmulatorSpan,
    Progress,
    Truth,
    host_cycles,
    host_span,
    is_interrupted,
    whole_rounds,
)
from adacd_hil.log.reader import LogStream, Series
from adacd_hil.records import PARAMETER_NAMES, SchemeState, Vector
from adacd_hil.score.judge import TouchWindow, contact_bounds, forgotten_after_s
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.toml_files import parse_toml

Rows = NDArray[np.int64]


def extreme_rows(series: Iterable[Vector], starts: Rows) -> Rows:
    """Choose of every bucket the rows in which a series (n,) is smallest and largest, the first of equal ones.

    starts: where the buckets begin, from 0, ascending. Rows ascend. NaN is chosen nowhere.
    """
    chosen: list[Rows] = [np.empty(0, np.int64)]
    for values in series:
        bucket = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(values)))
        for extreme in (np.fmin, np.fmax):
            hits = np.flatnonzero(values == extreme.reduceat(values, starts)[bucket])
            chosen.append(hits[np.diff(bucket[hits], prepend=-1) != 0])
    return np.unique(np.concatenate(chosen))


_BEGINNING: Final = (10_000, 1_000)
"""Cycles kept as they are: of a contact at first, and of one once `_PLENTY` rows are kept."""
_PLENTY: Final = 1_000_000
_ENDING: Final = 1_000
_BUCKET: Final = 100
_HELD: Final = 30_000
"""Rows of one contact that are held before some of them are chosen."""


class TruthTable(NamedTuple):
    """Kept rows of the truth (m,), on the emulator's own cycles; attempt (m,): of the run, from 0.

    model_attempt, model_cycle (k,): from when on payload and parameters are as they are. metadata: of the log; problem:
    missing parts; is_complete: it is whole and no record was dropped on the way to it.
    """

    attempt: Cycles
    cycle: Cycles
    tau_ext: Vector
    contact_link: Vector
    contact_index: Vector
    force_N: Vector | None
    model_attempt: Cycles
    model_cycle: Cycles
    payload_kg: Vector
    theta: Vector
    metadata: Mapping[str, str]
    problem: str
    is_complete: bool
    span: EmulatorSpan | None = None


_ROW: Final = np.dtype(
    [
        ("attempt", "<i8"), ("cycle", "<i8"), ("tau_ext", "<f8", (2,)), ("contact_link", "<f8"),
        ("contact_index", "<f8"), ("contact_force", "<f8"),
    ]
)  # fmt: skip
_MODEL: Final = ("payload", "theta")


def read_truth(path: Path) -> TruthTable:
    """Read the contacts from the emulator's log, with the cycle after each. Raises LogError."""
    stream = LogStream(path, ("/truth",))
    rows = _Gathering()
    for piece in stream:
        rows.add(piece.series["/truth"])
    return rows.done(stream)


class _Gathering:
    """Takes in the records of /truth, piece by piece."""

    def __init__(self) -> None:
        self._has_force = True
        self._kept: list[NDArray[Any]] = []
        self._kept_rows = 0
        self._contact = _OneContact(_BEGINNING[0])
        self._first: NDArray[Any] | None = None
        self._last: NDArray[Any] | None = None  # the row before
        self._models: list[tuple[NDArray[Any], ...]] = []  # attempt, cycle, payload, theta
        self._model: tuple[NDArray[Any], ...] | None = None

    def add(self, truth: Series) -> None:
        """Take in a piece."""
        if not len(truth):
            return
        rows = self._rows(truth)
        self._first = rows[:1] if self._first is None else self._first
        self._add_models(truth, rows)
        self._add_contacts(rows)
        self._last = rows[-1:]

    def _rows(self, truth: Series) -> NDArray[Any]:
        records, rows = truth.records, np.zeros(len(truth), _ROW)
        for name in _ROW.names or ():
            if name in truth.fields:
                rows[name] = records[name].reshape(rows[name].shape)
        self._has_force = self._has_force and "contact_force" in truth.fields
        before = rows[:1] if self._last is None else self._last
        is_anew = np.diff(rows["cycle"], prepend=before["cycle"]) < 0
        rows["attempt"] = before["attempt"] + np.cumsum(is_anew)
        return rows

    def _add_models(self, truth: Series, rows: NDArray[Any]) -> None:
        """Keep the rows from which on payload or parameters are others, and the first of each attempt."""
        columns = (rows["attempt"], *(truth.records[name].reshape(len(rows), -1) for name in _MODEL))
        changes = np.zeros(len(rows), np.bool_)
        for place, column in enumerate(columns):
            before = column[:1] if self._model is None else self._model[place]
            differs = np.concatenate((before, column[:-1])) != column
            changes |= differs if differs.ndim == 1 else differs.any(axis=1)
        changes[0] |= self._model is None
        attempt, payload, theta = columns
        self._models.append((attempt[changes], rows["cycle"][changes], payload[changes], theta[changes]))
        self._model = tuple(column[-1:].copy() for column in columns)

    def _add_contacts(self, rows: NDArray[Any]) -> None:
        """Keep the rows of contacts, and the row after each contact."""
        key = np.stack((rows["attempt"].astype(np.float64), rows["contact_index"]), axis=1)
        edges = np.flatnonzero((key[1:] != key[:-1]).any(axis=1)) + 1
        bounds = [0, *edges.tolist(), len(rows)]
        for start, end in pairwise(bounds):
            spell = rows[start:end]
            if self._contact.is_another(spell[0]):
                self._close(spell[:1])
            if spell["contact_index"][0] >= 0.0:
                self._contact.add(spell)

    def _close(self, after: NDArray[Any]) -> None:
        """End the contact in progress with the row after it, unless that is the next contact's own."""
        done = self._contact.rows()
        if after["contact_index"][0] < 0.0:
            done = np.concatenate((done, after))
        self._kept.append(done)
        self._kept_rows += len(done)
        self._contact = _OneContact(_BEGINNING[self._kept_rows > _PLENTY])

    def done(self, stream: LogStream) -> TruthTable:
        """Return the kept rows."""
        rows = np.concatenate([np.zeros(0, _ROW), *self._kept, self._contact.rows()])
        nothing = np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 1)), np.zeros((0, len(PARAMETER_NAMES)))
        models = zip(nothing, *self._models, strict=True)
        attempt, cycle, payload, theta = (np.concatenate(column) for column in models)
        return TruthTable(
            attempt=rows["attempt"].copy(),
            cycle=rows["cycle"].copy(),
            tau_ext=rows["tau_ext"].copy(),
            contact_link=rows["contact_link"].copy(),
            contact_index=rows["contact_index"].copy(),
            force_N=rows["contact_force"].copy() if self._has_force else None,
            model_attempt=attempt,
            model_cycle=cycle,
            payload_kg=payload[:, 0],
            theta=theta,
            metadata=stream.metadata,
            problem=stream.problem,
            is_complete=stream.is_complete,
            span=None if self._first is None or self._last is None else (_place(self._first), _place(self._last)),
        )


def _place(row: NDArray[Any]) -> tuple[int, int]:
    return int(row["attempt"][0]), int(row["cycle"][0])


class _OneContact:
    """The rows of the contact in progress, in bounded memory."""

    def __init__(self, beginning: int) -> None:
        self._beginning = beginning  # rows that are kept as they are
        self._key: tuple[int, float] | None = None
        self._chosen: list[NDArray[Any]] = []
        self._count = 0
        self._waiting = np.zeros(0, _ROW)

    def is_another(self, row: NDArray[Any]) -> bool:
        """Whether there is a contact in progress that a row is not of."""
        return self._key is not None and self._key != (int(row["attempt"]), float(row["contact_index"]))

    def add(self, rows: NDArray[Any]) -> None:
        """Take in rows of it."""
        self._key = (int(rows["attempt"][0]), float(rows["contact_index"][0]))
        room = max(self._beginning - self._count, 0)
        self._chosen.append(rows[:room])
        self._count += len(rows)
        self._waiting = np.concatenate((self._waiting, rows[room:]))
        if len(self._waiting) > _HELD:
            self._choose()

    def _choose(self) -> None:
        """Choose among the waiting rows but the last ones."""
        middle, self._waiting = self._waiting[:-_ENDING], self._waiting[-_ENDING:].copy()
        if len(middle):
            series = (middle["tau_ext"][:, 0], middle["tau_ext"][:, 1], middle["contact_force"])
            self._chosen.append(middle[extreme_rows(series, np.arange(0, len(middle), _BUCKET))])

    def rows(self) -> NDArray[Any]:
        """Return the rows that are kept."""
        self._choose()
        return np.concatenate([*self._chosen, self._waiting])


def host_truth(rows: TruthTable, begins: Cycles, last: int, time_s: Vector) -> Truth | None:
    """Return the truth on the host's cycles; None where the emulator never cycled.

    begins: first cycle of each attempt of the run; last: of the run; time_s: of the rows (m,).

    The arm goes on when the host has died; cycles after the host's last one are left out.
    """
    if not rows.model_cycle.size:
        return None
    cycle = host_cycles(rows.cycle, rows.attempt, begins)
    of_host = cycle <= last
    return Truth(
        cycle=cycle[of_host],
        tau_ext=rows.tau_ext[of_host],
        contact_link=rows.contact_link[of_host],
        contact_index=rows.contact_index[of_host],
        payload_kg=rows.payload_kg,
        theta=rows.theta,
        force_N=None if rows.force_N is None else rows.force_N[of_host],
        attempt=rows.attempt[of_host],
        time_s=time_s[of_host],
        model_cycle=host_cycles(rows.model_cycle, rows.model_attempt, begins),
        span=None if rows.span is None else host_span(rows.span, begins),
    )


_PLAYED = ("scenario", "seed")


def foreign_truth(log: Path, truth: Path) -> str:
    """Return in one line why a truth is of another run than a log; "" if no field contradicts the log.

    Both name scenario and seed if one process played host and arm, and the truth has a digest of the host's
    configuration: in lockstep, the same three make the same run. On a bus the host doesn't know the scenario.
    """
    ours, theirs = run_metadata(log), _played(truth)
    for key in _PLAYED:
        if key in ours and key in theirs and ours[key] != theirs[key]:
            return f"{truth} is of another run: its {key} is {theirs[key]}, the log's {ours[key]}"
    config = attachment(log, "config.toml")
    if CONFIG_DIGEST_KEY in theirs and config is not None and theirs[CONFIG_DIGEST_KEY] != _digest(config):
        return f"{truth} is of another run: its host had another configuration"
    return ""


def config_digest(config: str) -> str:
    """Return the digest by which a truth names its host's configuration. Raises ConfigError.

    The digest leaves out `realtime`, which a session sets to the host's abilities, and `safety.enable_timeout_s`, which
    it sets by the devices' profiles.
    """
    table = {key: value for key, value in parse_toml(config).items() if key != "realtime"}
    if isinstance(safety := table.get("safety"), dict):
        table["safety"] = {key: value for key, value in safety.items() if key != "enable_timeout_s"}
    return hashlib.sha256(json.dumps(table, sort_keys=True, default=str).encode()).hexdigest()


def _digest(config: bytes) -> str | None:
    try:
        return config_digest(config.decode("utf-8", "replace"))
    except ConfigError:
        return None  # the reader of the log reports it


def _played(truth: Path) -> dict[str, str]:
    """Return scenario and seed of a truth; old ones have them in an attachment alone."""
    said = run_metadata(truth)
    try:
        table = parse_toml(attachment(truth, "scenario.toml") or b"")
    except ConfigError:
        return said
    attached = {"scenario": table.get("name"), "seed": table.get("seed")}
    return {key: str(value) for key, value in attached.items() if value is not None} | said


@dataclass(frozen=True)
class TrueContact:
    """A true contact. onset, end: its first cycle and the first one without it. tau_ext (k, 2), cycle (k,): of both.

    number: of the truth, from 1. Cycles are the emulator's, in the `attempt` of the run, from 0; `counted_from` makes
    them the host's.
    """

    number: int
    attempt: int
    link: int
    onset: int
    end: int
    tau_ext: Vector
    cycle: Cycles

    def counted_from(self, first_cycle: int) -> "TrueContact":
        """Return it with the cycles of the host, for which the attempt begins with the given one."""
        shift = int(whole_rounds(np.array(first_cycle)))
        return replace(self, onset=self.onset + shift, end=self.end + shift, cycle=self.cycle + shift)


class TrueContacts(NamedTuple):
    """The true contacts of a run, in order, and of which cycles they are known."""

    contacts: tuple[TrueContact, ...]
    span: EmulatorSpan


class HostCycles(NamedTuple):
    """Cycles of the host (k,): number, time, state of the cycle before, and threshold (k, 2)."""

    cycle: Cycles
    t_ns: Cycles
    before: NDArray[np.uint8]
    threshold: Vector


def windows_of(contacts: Sequence[TrueContact], host: HostCycles, settings: Settings) -> list[TouchWindow]:
    """Return those contacts, on the host's cycles, that begin before these end, as they are judged.

    host: has the cycles that each onset and each end lies between.
    """
    contacts = [contact for contact in contacts if len(host.cycle) and contact.onset <= host.cycle[-1]]
    if not contacts:
        return []
    is_certified = settings.scheme == "certified"
    a_rad_s = settings.certified.cutoffs_rad_s[0] if is_certified else settings.filter.a_rad_s
    instants = [(contact.onset, contact.end) for contact in contacts]
    since_ns = np.rint(np.interp(instants, host.cycle, host.t_ns - host.t_ns[0])).astype(np.int64)
    rows = np.searchsorted(host.cycle, [contact.onset for contact in contacts]).tolist()
    windows = []
    for contact, row, (onset_ns, end_ns) in zip(contacts, rows, (since_ns + host.t_ns[0]).tolist(), strict=True):
        threshold = np.where(np.isfinite(host.threshold[row]), host.threshold[row], settings.detector.threshold_Nm)
        after_s = forgotten_after_s(contact.tau_ext, contact.cycle, settings.bus.period_s, a_rad_s, threshold)
        before = host.before[row]
        windows.append(
            TouchWindow(
                number=contact.number,
                link=contact.link,
                onset_ns=onset_ns,
                forgotten_ns=end_ns + round(after_s * 1e9),
                is_armed=bool(before == SchemeState.MONITOR),
                is_reacting=bool(is_interrupted(before)),
            )
        )
    return windows


def contacts_beside(path: Path, progress: Progress = lambda _: None) -> TrueContacts | None:
    """Read the true contacts from the emulator's log in the same folder; None where there is none. Raises LogError.

    The truth of another run is left out, and `progress` gets a line with the reason.
    """
    truth = path.with_name(TRUTH_NAME)
    if not truth.exists():
        return None
    if problem := foreign_truth(path, truth):
        progress(f"{problem}; it is left out")
        return None
    rows = read_truth(truth)
    return None if rows.span is None else TrueContacts(_contacts(rows), rows.span)


def _contacts(rows: TruthTable) -> tuple[TrueContact, ...]:
    found = []
    for number, (start, end) in enumerate(contact_bounds(rows.contact_index, rows.attempt), start=1):
        stop = end + int(end < len(rows.cycle) and rows.attempt[end] == rows.attempt[start])  # the row after it
        cycle = rows.cycle[start:stop]
        link, tau_ext = int(rows.contact_link[start]), rows.tau_ext[start:stop]
        found.append(TrueContact(number, int(rows.attempt[start]), link, int(cycle[0]), int(cycle[-1]), tau_ext, cycle))
    return tuple(found)
