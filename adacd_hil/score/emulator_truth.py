"""The truth of a run from the emulator's log: the cycles of its contacts, the model of the arm, its true contacts.

Of a contact the first cycles and the last `_ENDING` are kept as they are. In between, of every `_BUCKET` cycles those
with the smallest and largest torque of each joint, and force; that many contacts of many seconds fit in memory, and the
largest torques and the filtered torque at their end stay exact.

The reader refuses a log of another run, as far as both logs name their scenario.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.log.log_files import CONFIG_DIGEST_KEY, CONFIG_NAME, SCENARIO_NAME, TRUTH_NAME, LogError
from adacd_hil.log.log_walk import attachment, run_metadata
from adacd_hil.log.logged_run import Cycles, EmulatorSpan, Progress, Truth, is_armed_in, is_interrupted
from adacd_hil.log.reader import LogStream, Series
from adacd_hil.log.types.truth_topic import TRUTH
from adacd_hil.records import PARAMETER_NAMES, SchemeState, Vector
from adacd_hil.score.judge import TrueContact, forgotten_after_s, true_contacts
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.toml_files import parse_toml

Rows = NDArray[np.int64]


def extreme_rows(series: Iterable[Vector], starts: Rows) -> Rows:
    """Return the rows in which a series is smallest or largest in its bucket, the first of equal ones, ascending.

    series: arrays (n,), each judged by itself. starts: where the buckets begin, from 0, ascending. NaN is chosen
    nowhere.
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
    """The truth in an emulator's log: kept rows on the emulator's own cycles, and its metadata.

    problem: missing parts and records that were dropped on the way to it, or "". span: attempt and cycle of the first
    and of the last record; None if the emulator never cycled.
    """

    rows: Truth
    metadata: Mapping[str, str]
    problem: str
    span: EmulatorSpan | None = None


_ROW: Final = np.dtype(
    [
        ("attempt", "<i8"), ("cycle", "<i8"), ("tau_ext", "<f8", (2,)), ("contact_link", "<f8"),
        ("contact_index", "<f8"), ("contact_force", "<f8"),
    ]
)  # fmt: skip
_MODEL: Final = ("payload", "theta")


def read_truth(path: Path) -> TruthTable:
    """Return the truth in the emulator's log: the cycles of contacts and the one after each, payload and parameters.

    Of a long contact some cycles are left out, see the module. Raises LogError for a file that is no log.
    """
    stream = LogStream(path, (TRUTH.name,))
    rows = _TruthRows()
    for piece in stream:
        rows.add_records(piece.series[TRUTH.name])
    return rows.table(stream)


class _TruthRows:
    """Keeps rows of /truth, piece by piece: of one contact in progress in bounded memory."""

    def __init__(self) -> None:
        self._kept: list[NDArray[Any]] = []
        self._kept_rows = 0
        self._first: NDArray[Any] | None = None
        self._last: NDArray[Any] | None = None  # the row before
        self._models: list[tuple[NDArray[Any], ...]] = []  # attempt, cycle, payload, theta
        self._model: tuple[NDArray[Any], ...] | None = None
        self._begin()

    def _begin(self) -> None:
        """Begin the next contact: no row waits. Its first cycles are all kept; fewer of them after `_PLENTY` rows."""
        self._key: tuple[int, float] | None = None  # attempt and index of the contact in progress
        self._whole = _BEGINNING[self._kept_rows > _PLENTY]  # rows of it that are kept as they are
        self._waiting = np.zeros(0, _ROW)

    def add_records(self, truth: Series) -> None:
        """Keep, of the next cycles of the truth, those of contacts and those in which payload or parameters change.

        Also the first cycle after a contact. Of a long contact some are left out, see the module.
        """
        if not len(truth):
            return
        rows = self._rows(truth)
        self._first = rows[:1] if self._first is None else self._first
        self._add_models(truth, rows)
        key = np.stack((rows["attempt"].astype(np.float64), rows["contact_index"]), axis=1)
        edges = np.flatnonzero((key[1:] != key[:-1]).any(axis=1)) + 1
        for start, end in pairwise([0, *edges.tolist(), len(rows)]):
            self._add_spell(rows[start:end])
        self._last = rows[-1:]

    def _rows(self, truth: Series) -> NDArray[Any]:
        """Return the records as rows of type _ROW; a cycle number that falls begins the next attempt.

        Fields that the log lacks are 0.
        """
        records, rows = truth.records, np.zeros(len(truth), _ROW)
        for name in _ROW.names or ():
            if name in truth.fields:
                rows[name] = records[name].reshape(rows[name].shape)
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

    def _add_spell(self, rows: NDArray[Any]) -> None:
        """Add the next rows of one contact: keep its beginning and end whole, and the extreme rows between them.

        Of rows without a contact, keep the first one after a contact.
        """
        key = int(rows["attempt"][0]), float(rows["contact_index"][0])
        if self._key not in (None, key):
            self._thin()
            self._keep(self._waiting)
            self._keep(rows[: int(key[1] < 0.0)])
            self._begin()
        if key[1] < 0.0:
            return
        self._key = key
        self._keep(rows[: self._whole])
        rest = rows[self._whole :]
        self._whole -= len(rows) - len(rest)
        self._waiting = np.concatenate((self._waiting, rest))
        if len(self._waiting) > _HELD:
            self._thin()

    def _keep(self, rows: NDArray[Any]) -> None:
        self._kept.append(rows)
        self._kept_rows += len(rows)

    def _thin(self) -> None:
        """From a contact's rows that are still undecided keep those with extreme torque or force, and drop the rest.

        The last _ENDING of them stay undecided, since they may be the contact's end.
        """
        middle, self._waiting = self._waiting[:-_ENDING], self._waiting[-_ENDING:].copy()
        if len(middle):
            series = (middle["tau_ext"][:, 0], middle["tau_ext"][:, 1], middle["contact_force"])
            self._keep(middle[extreme_rows(series, np.arange(0, len(middle), _BUCKET))])

    def table(self, stream: LogStream) -> TruthTable:
        """Return the kept rows as a truth, with metadata and problem of `stream`; call it once, at the log's end."""
        self._thin()
        rows = np.concatenate([np.zeros(0, _ROW), *self._kept, self._waiting])
        nothing = np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 1)), np.zeros((0, len(PARAMETER_NAMES)))
        models = zip(nothing, *self._models, strict=True)
        attempt, cycle, payload, theta = (np.concatenate(column) for column in models)
        truth = Truth(
            cycle=rows["cycle"].copy(),
            tau_ext=rows["tau_ext"].copy(),
            contact_link=rows["contact_link"].copy(),
            contact_index=rows["contact_index"].copy(),
            payload_kg=payload[:, 0],
            theta=theta,
            force_N=rows["contact_force"].copy(),
            time_s=np.zeros(len(rows)),
            attempt=rows["attempt"].copy(),
            model_cycle=cycle,
            model_attempt=attempt,
        )
        span = None if self._first is None or self._last is None else (_place(self._first), _place(self._last))
        return TruthTable(truth, stream.metadata, stream.problem, span)


def _place(row: NDArray[Any]) -> tuple[int, int]:
    """Return attempt and cycle of a row (1,)."""
    return int(row["attempt"][0]), int(row["cycle"][0])


_PLAYED = ("scenario", "seed", "truth")


def foreign_truth(log: Path, truth: Path) -> str:
    """Return in one line why a truth can't be read or is of another run than a log; "" if no field contradicts the log.

    Both name scenario and seed if one process played host and arm, and the truth has a digest of the host's
    configuration: in lockstep, the same three make the same run. On a bus the host doesn't know the scenario.
    """
    try:
        LogStream(truth, ())
    except LogError as error:
        return str(error)
    ours, theirs = run_metadata(log), _played(truth)
    for key in _PLAYED:
        if key in ours and key in theirs and ours[key] != theirs[key]:
            return f"{truth} is of another run: its {key} is {theirs[key]}, the log's {ours[key]}"
    config = attachment(log, CONFIG_NAME)
    if CONFIG_DIGEST_KEY in theirs and config is not None and theirs[CONFIG_DIGEST_KEY] != _digest(config):
        return f"{truth} is of another run: its host had another configuration"
    return ""


def config_digest(config: str) -> str:
    """Return the digest by which a truth names its host's configuration. Raises ConfigError for a text that is no TOML.

    The digest leaves out `realtime`, which a session sets to the host's abilities, and `safety.enable_timeout_s`, which
    it sets by the devices' profiles.
    """
    table = {key: value for key, value in parse_toml(config).items() if key != "realtime"}
    if isinstance(safety := table.get("safety"), dict):
        table["safety"] = {key: value for key, value in safety.items() if key != "enable_timeout_s"}
    return hashlib.sha256(json.dumps(table, sort_keys=True, default=str).encode()).hexdigest()


def _digest(config: bytes) -> str | None:
    """Return the digest of an attached configuration; None for one that is no TOML."""
    try:
        return config_digest(config.decode("utf-8", "replace"))
    except ConfigError:
        return None  # the reader of the log reports it


def _played(truth: Path) -> dict[str, str]:
    """Return the metadata of a truth; of an old one, scenario and seed from its attached scenario, if it has that."""
    said = run_metadata(truth)
    try:
        table = parse_toml(attachment(truth, SCENARIO_NAME) or b"")
    except ConfigError:
        return said
    attached = {"scenario": table.get("name"), "seed": table.get("seed")}
    return {key: str(value) for key, value in attached.items() if value is not None} | said


class HostCycles(NamedTuple):
    """Cycles of the host (k,): number, time, state of the cycle before, and threshold (k, 2)."""

    cycle: Cycles
    t_ns: Cycles
    before: NDArray[np.uint8]
    threshold: Vector


def placed_contacts(contacts: Sequence[TrueContact], host: HostCycles, settings: Settings) -> list[TrueContact]:
    """Return the contacts that begin up to the last of the host's cycles, with their times on the host's clock.

    An onset or end outside these cycles gets the time of the nearest one. A contact from the first cycle or before it
    is not armed. contacts: their cycles are counted by the host. host: its cycles before and after each onset and end,
    others may be left out.
    """
    contacts = [contact for contact in contacts if len(host.cycle) and contact.onset <= host.cycle[-1]]
    if not contacts:
        return []
    instants = [(contact.onset, contact.end) for contact in contacts]
    since_ns = np.rint(np.interp(instants, host.cycle, host.t_ns - host.t_ns[0])).astype(np.int64)
    rows = np.searchsorted(host.cycle, [contact.onset for contact in contacts]).tolist()
    times_ns = (since_ns + host.t_ns[0]).tolist()
    host = host._replace(before=np.concatenate(([SchemeState.INIT], host.before[1:])))
    return [
        placed_contact(contact, (onset_ns, end_ns), host, row, settings, settings.cutoff_rad_s)
        for contact, row, (onset_ns, end_ns) in zip(contacts, rows, times_ns, strict=True)
    ]


def placed_contact(
    contact: TrueContact, times_ns: tuple[int, int], host: HostCycles, row: int, settings: Settings, a_rad_s: float
) -> TrueContact:
    """Return a contact on the clock of a run, with the times in which it explains alarms.

    times_ns: of onset and end. row: index of the first of the host's cycles at the onset or after it. a_rad_s: cut-off
    of the scheme's slowest filter.
    """
    threshold = threshold_in_force(host.threshold[row], settings)
    after_s = forgotten_after_s(contact.tau_ext, contact.cycle, settings.bus.period_s, a_rad_s, threshold)
    return replace(
        contact,
        onset_ns=times_ns[0],
        forgotten_ns=times_ns[1] + round(after_s * 1e9),
        is_armed=bool(is_armed_in(host.before[row])),
        is_reacting=bool(is_interrupted(host.before[row])),
    )


def threshold_in_force(threshold: Vector, settings: Settings) -> Vector:
    """Return a cycle's threshold of `tau_ext_hat`, Nm (2,); at a joint without detection, that of the settings."""
    return np.where(np.isfinite(threshold), threshold, settings.detector.threshold_Nm)


class KnownTruth(NamedTuple):
    """The true contacts of a run, in order, of which cycles they are known, and the rows of the truth."""

    contacts: tuple[TrueContact, ...]
    span: EmulatorSpan
    rows: Truth


def contacts_beside(path: Path, progress: Progress = lambda _: None) -> KnownTruth | None:
    """Return what truth.mcap beside a log knows of the true contacts of its run.

    None without that file, if the emulator never cycled, and for a truth of another run or one whose heads can't be
    read, of which `progress` gets a line. Raises LogError for a truth with invalid metadata.
    """
    truth = path.with_name(TRUTH_NAME)
    if not truth.exists():
        return None
    if problem := foreign_truth(path, truth):
        progress(f"{problem}; it is left out")
        return None
    table = read_truth(truth)
    return None if table.span is None else KnownTruth(true_contacts(table.rows), table.span, table.rows)
