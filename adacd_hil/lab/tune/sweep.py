"""A sweep: sends tasks to workers and stores the rows that they return.

A few tasks per worker are in flight, and rows are written every few seconds, so that memory doesn't grow with the plan.
A task that raises is tried again. When a worker dies, the tasks in flight are tried again one by one, so that only the
task at fault is lost. A task that fails every time leaves rows with the reason. Workers need the package and, for
replays, the logs at the same paths.

Results are parts as they come, one Parquet table in the end. The sweep writes a part beside and renames it, so that a
sweep that is killed leaves whole parts only. Columns are those of all rows; a row that lacks one has null there.
Readers: `duckdb`, `pandas.read_parquet`, `pyarrow.parquet`.

The plan has the logs or scenarios, settings and seeds; its rows, and the tasks that compute them. Every row
has a key made of all that its result depends on. A sweep that is begun again computes the keys that its folder lacks. A
log that has changed, other settings, and another version of the package or of the code make other keys.
"""

import hashlib
import json
import os
import statistics
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

from adacd_hil.clock import MonotonicClock
from adacd_hil.extras import install_command
from adacd_hil.file_replacement import replace_file, replacing
from adacd_hil.lab.tune.workers import Workers
from adacd_hil.log.log_files import LogError
from adacd_hil.log.logged_run import Progress
from adacd_hil.records import SchemeState
from adacd_hil.replay.log_source import LogSource
from adacd_hil.replay.replay import replay_many
from adacd_hil.replay.replayed_outcome import Replay
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.setting_keys import apply_settings, keep_log_settings
from adacd_hil.wire.codec import CodecError

Changes = tuple[tuple[str, str], ...]
"""Settings that differ, as `key`, TOML value."""


class Subject(NamedTuple):
    """The subject of one task: a log, or a scenario with a seed; the others are "" and 0.

    `stamp`: size and date of a log when the plan was made.
    """

    log: str = ""
    stamp: str = ""
    scenario: str = ""
    seed: int = 0


class SweepRow(NamedTuple):
    """One row of the sweep: a run or replay of the subject with changed settings.

    key: digest of all that the result depends on.
    """

    key: str
    changes: Changes


@dataclass(frozen=True)
class Task:
    """Rows about one subject, which one worker computes together. profile: of an emulated arm, "" for the default."""

    subject: Subject
    config: str  # name or file; empty: the log's own
    profile: str
    rows: tuple[SweepRow, ...]


@dataclass(frozen=True)
class Plan:
    """A whole sweep: each subject with each variant of the settings. `config`, `profile`: as of `Task`.

    `version`: of the package and its code, a part of every key.
    """

    subjects: tuple[Subject, ...]
    variants: tuple[Changes, ...]
    config: str
    profile: str
    version: str

    @property
    def size(self) -> int:
        """Number of rows."""
        return len(self.subjects) * len(self.variants)

    @property
    def varied(self) -> tuple[str, ...]:
        """Keys of the settings that some variant changes, each once."""
        return tuple(dict.fromkeys(key for changes in self.variants for key, _ in changes))

    def tasks(self, done: frozenset[str], rows_per_task: int) -> Iterator[Task]:
        """Yield tasks, subject by subject, for the rows whose keys are not in `done`, at most `rows_per_task` each."""
        for subject in self.subjects:
            rows = [SweepRow(self._key(subject, changes), changes) for changes in self.variants]
            rows = [row for row in rows if row.key not in done]
            for start in range(0, len(rows), rows_per_task):
                yield Task(subject, self.config, self.profile, tuple(rows[start : start + rows_per_task]))

    def row_keys(self) -> Iterator[str]:
        """Yield the keys of all rows, done or not, in the order of the table."""
        return (self._key(subject, changes) for subject in self.subjects for changes in self.variants)

    def _key(self, subject: Subject, changes: Changes) -> str:
        text = json.dumps([subject, sorted(changes), self.config, self.profile, self.version])
        return hashlib.sha256(text.encode()).hexdigest()[:24]


def log_subjects(logs: Iterable[Path]) -> Iterator[Subject]:
    """Yield the subject of each log. Raises OSError if a log's size and date can't be read."""
    for path in logs:
        status = path.stat()
        yield Subject(log=str(path.resolve()), stamp=f"{status.st_size}/{status.st_mtime_ns}")


def plan_of(
    subjects: Iterable[Subject], variants: Iterable[Mapping[str, str]], config: str, profile: str, version: str
) -> Plan:
    """Return the plan of a sweep that replays or runs each subject, each once, with each variant of the settings.

    variants: values as TOML, by key; none: the settings as they are. config: name or file, "" for the log's own, or
    that of emulated runs. profile: of an emulated arm, "" for the default. version: of the code.
    """
    changes = dict.fromkeys(tuple(variant.items()) for variant in variants)
    return Plan(tuple(dict.fromkeys(subjects)), tuple(changes) or ((),), config, profile, version)


SET: Final = "set."
"""Prefix of the columns of varied settings."""
REFUSALS: Final = (ConfigError, CodecError, LogError)
"""Errors that repeat at every attempt: they make a row with the reason."""

Value = str | int | float | bool | None
Values = dict[str, Value]


def row_labels(subject: Subject, row: SweepRow) -> Values:
    """Return the columns that identify a row: its key, its subject, and its varied settings as "set.KEY".

    log, or scenario and seed, are None if they don't apply.
    """
    changes: Mapping[str, str] = dict(row.changes)
    return {
        "key": row.key,
        "log": subject.log or None,
        "scenario": subject.scenario or None,
        "seed": subject.seed if subject.scenario else None,
        **{SET + key: value for key, value in changes.items()},
    }


def failed(subject: Subject, row: SweepRow, error: str) -> Values:
    """Return the row of a task that failed: its labels, status "failed", and the error in one line."""
    return row_labels(subject, row) | {"status": "failed", "error": " ".join(error.split())}


def replay_task(task: Task) -> list[Values]:
    """Replay a task's log with the settings of each row; return a row of results or an error for each, in their order.

    ConfigError, CodecError and LogError become rows; other errors are raised.
    """
    subject = task.subject
    path = Path(subject.log)
    try:
        base = LogSource(path).settings
        if task.config:
            base = keep_log_settings(base, load_settings(task.config, task.profile or base.arm.profile))
    except REFUSALS as refusal:
        return [failed(subject, row, str(refusal)) for row in task.rows]
    variants: dict[SweepRow, Settings] = {}
    results: dict[SweepRow, Replay | str] = {}
    for row in task.rows:
        try:
            variants[row] = apply_settings(base, dict(row.changes))
        except ConfigError as refusal:
            results[row] = str(refusal)
    results |= zip(variants, _replay_all(path, list(variants.values())), strict=True)
    return [
        failed(subject, row, result) if isinstance(result := results[row], str) else finished(subject, row, result)
        for row in task.rows
    ]


def _replay_all(path: Path, variants: list[Settings]) -> list[Replay | str]:
    """Return the replay of a log with each of the settings; for one that is refused, the error's text.

    If one of several is refused, each is replayed alone. Errors other than `REFUSALS` are raised.
    """
    try:
        return list(replay_many(path, variants))
    except REFUSALS as refusal:
        if len(variants) == 1:
            return [str(refusal)]
    return [result for settings in variants for result in _replay_all(path, [settings])]


def finished(subject: Subject, row: SweepRow, found: Replay) -> Values:
    """Return the row of results of a replay, status "ok"; None for values that it lacks, as without the truth."""
    score = found.score
    delays_ms = () if score is None else score.delays_ms
    took_s = found.adaptation_s
    last = found.states[-1] if found.states else None
    return row_labels(subject, row) | {
        "status": "ok",
        "error": None,
        "notes": "; ".join(found.notes) or None,
        "cycles": found.cycles,
        "attempts": found.attempts,
        "identical": found.is_identical if found.compared else None,
        "ends_in": last.state.name if last else SchemeState.INIT.name,
        "fault": last.fault.name if last else "NONE",
        "adaptations": sum(each is not None for each in took_s),
        "adaptation_first_s": took_s[0] if took_s else None,
        "adaptation_last_s": took_s[-1] if took_s else None,
        "monitored_s": found.monitored_s,
        "detections": len(found.detections_ns),
        "touches_armed": None if score is None else score.armed,
        "touches_found": None if score is None else len(delays_ms),
        "missed": None if score is None else score.missed,
        "false_alarms": None if score is None else len(score.false_alarms),
        "delay_median_ms": statistics.median(delays_ms) if delays_ms else None,
        "delay_max_ms": max(delays_ms, default=None),
        **{f"theta_hat.{name}": value for name, value in found.parameters.items()},
    }


TABLE_NAME = "sweep.parquet"
PLAN_NAME = "plan.json"
_PARTS = "parts"


class SweepStore:
    """The folder of a sweep: parts, with rows as they come, and the table that joins them."""

    def __init__(self, folder: Path) -> None:
        """Open the folder, or create it; parts that are there stay.

        Raises LogError if pyarrow is missing, OSError if the folder can't be made.
        """
        self.folder = folder
        self._parts = folder / _PARTS
        self._parquet = _parquet()
        self._parts.mkdir(parents=True, exist_ok=True)
        self._next = 1 + max((int(path.stem) for path in self._paths()), default=-1)

    def done(self) -> frozenset[str]:
        """Return the keys of all rows in the parts with status "ok". Raises LogError if a part can't be read."""
        rows = (row for path in self._paths() for row in self._read(path, ["key", "status"]).to_pylist())
        return frozenset(row["key"] for row in rows if row["status"] == "ok")

    def write_part(self, rows: Iterable[Values]) -> None:
        """Write rows as the next part of the folder, whole or not at all. Raises LogError if it can't be written."""
        path = self._parts / f"{self._next:06d}.parquet"
        self._next += 1
        _write(self._parquet, path, _table(list(rows)))

    def join(self, keys: Iterable[str], about: Mapping[str, str]) -> Path:
        """Write the table of the rows with these keys, in this order, and plan.json with `about`; return its path.

        The path is that of the table. Of several results of a row, the last with status "ok" counts, else the last.
        Keys without one are left out. The table has `about` as metadata, too. Replaces an earlier table; the parts
        stay. Raises LogError if a part can't be read, or the table not be written; OSError if plan.json can't be
        written.
        """
        rows: dict[str, Values] = {}
        for path in self._paths():
            for row in self._read(path).to_pylist():
                if row["status"] == "ok" or rows.get(row["key"], row)["status"] != "ok":
                    rows[row["key"]] = row
        table = _table([rows[key] for key in keys if key in rows])
        metadata = {f"adacd_hil.{name}": text for name, text in about.items()}
        path = self.folder / TABLE_NAME
        _write(self._parquet, path, table.replace_schema_metadata(metadata))
        replace_file(self.folder / PLAN_NAME, json.dumps(about, indent=2))
        return path

    def notes(self, table: Path) -> list[str]:
        """Return a line "SUBJECT: NOTES" for each row of a joined table whose replay has notes, each text once.

        Raises LogError if the table can't be read.
        """
        rows = self._read(table).to_pylist()
        noted = (f"{row['log'] or row['scenario']}: {row['notes']}" for row in rows if row.get("notes"))
        return list(dict.fromkeys(noted))

    def _paths(self) -> list[Path]:
        return sorted(path for path in self._parts.glob("*.parquet") if path.stem.isdecimal())

    def _read(self, path: Path, columns: list[str] | None = None) -> Any:
        try:
            return self._parquet.read_table(path, columns=columns)
        except (OSError, ValueError) as error:  # of pyarrow, too
            raise LogError(f"sweep {path}: {str(error).splitlines()[0]}; remove it to compute its rows again") from None


def _parquet() -> Any:
    try:
        from pyarrow import parquet
    except ImportError:
        raise LogError(f"sweep needs pyarrow: {install_command('tables')}") from None
    return parquet


def _table(rows: list[Values]) -> Any:
    import pyarrow as pa

    names = dict.fromkeys(name for row in rows for name in row)
    return pa.table({name: pa.array([row.get(name) for row in rows], from_pandas=False) for name in names})


def _write(parquet: Any, path: Path, table: Any) -> None:
    """Write a table to `path`, whole or not at all. Raises LogError if it can't be written."""
    try:
        with replacing(path) as beside:
            parquet.write_table(table, beside, compression="zstd")
    except OSError as error:  # pyarrow's names no file
        reason = os.strerror(error.errno) if error.errno else str(error)
        raise LogError(f"{path} can't be written: {reason}; the same command continues") from error


ROWS_PER_TASK = 20
"""So many replays share the decoding of a log; more would make a lost worker cost more."""
RETRIES = 2
_WRITE_NS = 5_000_000_000

Work = Callable[[Task], list[Values]]


class SweepOutcome(NamedTuple):
    """The outcome of a sweep. Numbers of rows: computed now, found done before, and, of the computed ones, failed."""

    computed: int
    found: int
    failed: int
    elapsed_s: float


def run_sweep(
    plan: Plan,
    work: Work,
    store: SweepStore,
    workers: Workers,
    progress: Progress,
    rows_per_task: int = ROWS_PER_TASK,
) -> SweepOutcome:
    """Compute the rows of a plan that the store lacks or that failed, and write them to it every few seconds.

    work: called by the workers with each task, of at most `rows_per_task` rows. If an error or Ctrl-C ends it, rows
    computed so far are written. Raises LogError if the cluster is lost, or a part can't be read or written.
    """
    clock = MonotonicClock()
    begin_ns = written_ns = clock.now_ns()
    done = store.done()
    wanted = sum(key not in done for key in plan.row_keys())
    flights = _Flights(plan.tasks(done, rows_per_task), work, workers, progress)
    rows: list[Values] = []
    computed = failures = 0
    try:
        for found in flights:
            rows += found
            computed += len(found)
            failures += sum(row["status"] != "ok" for row in found)
            now_ns = clock.now_ns()
            if now_ns - written_ns >= _WRITE_NS:
                store.write_part(rows)
                rows, written_ns = [], now_ns
                progress(_describe(computed, wanted, failures, (now_ns - begin_ns) * 1e-9))
    finally:
        if rows:
            store.write_part(rows)
    elapsed_s = (clock.now_ns() - begin_ns) * 1e-9
    progress(_describe(computed, wanted, failures, elapsed_s))
    return SweepOutcome(computed, plan.size - wanted, failures, elapsed_s)


class _Flights:
    """Tasks on their way through the workers.

    Iterate once for the rows of each, in the order in which they come back.
    """

    def __init__(self, tasks: Iterator[Task], work: Work, workers: Workers, progress: Progress) -> None:
        self._tasks = tasks
        self._work = work
        self._workers = workers
        self._progress = progress
        self._flying: dict[Future[list[Values]], Task] = {}
        self._again: deque[Task] = deque()
        self._suspects: deque[Task] = deque()
        """In flight as a worker died: each flies alone, so that one that kills its worker shows."""
        self._is_alone = False
        self._failures: Counter[Task] = Counter()

    def __iter__(self) -> Iterator[list[Values]]:
        while self._launch():
            finished, _ = wait(self._flying, return_when=FIRST_COMPLETED)
            for future in finished:
                if future not in self._flying:
                    continue  # lost with the worker of another
                if future.cancelled():
                    raise LogError("sweep: the scheduler is gone; begin again to go on with what is missing")
                error = future.exception()
                if isinstance(error, BrokenExecutor):
                    yield from self._land_broken()
                    continue
                task = self._flying.pop(future)
                if error is None:
                    yield future.result()
                else:
                    yield from self._fail(task, f"{type(error).__name__}: {error}", self._again)

    def _launch(self) -> bool:
        """Submit tasks until the workers have as many as they have room for; return whether any is in flight.

        If tasks were in flight as a worker died, submit these first, one at a time.
        """
        if not self._flying:
            self._is_alone = bool(self._suspects)
        room = 1 if self._is_alone or self._suspects else self._workers.room
        while len(self._flying) < room and (task := self._next()) is not None:
            try:
                future = self._workers.submit(self._work, task)
            except BrokenExecutor:  # a worker died before it had work
                self._workers.replace_dead()
                future = self._workers.submit(self._work, task)
            self._flying[future] = task
        return bool(self._flying)

    def _next(self) -> Task | None:
        """Return the next task: one that was in flight as a worker died, else one that failed, else a new one.

        None if none is left.
        """
        for waiting in (self._suspects, self._again):
            if waiting:
                return waiting.popleft()
        return next(self._tasks, None)

    def _land_broken(self) -> Iterator[list[Values]]:
        """Replace dead workers, and queue the tasks that ended with them to be tried again, each alone.

        If a single task ended with them, it counts as failed once more; yield its rows if it has failed too often.
        """
        self._progress("a worker process has died: killed, or out of memory")
        self._workers.replace_dead()
        wait(self._flying)
        lost = [future for future in self._flying if isinstance(future.exception(), BrokenExecutor)]
        tasks = [self._flying.pop(future) for future in lost]
        if len(tasks) > 1:
            self._suspects.extend(tasks)
        else:
            yield from self._fail(tasks[0], "the worker process died each time", self._suspects)

    def _fail(self, task: Task, error: str, again: deque[Task]) -> Iterator[list[Values]]:
        """Count a failure of a task, and queue it in `again`; after RETRIES, yield its rows with the error instead."""
        self._failures[task] += 1
        if self._failures[task] <= RETRIES:
            again.append(task)
        else:
            yield [failed(task.subject, row, error) for row in task.rows]


def _describe(computed: int, wanted: int, failures: int, elapsed_s: float) -> str:
    rate = computed / max(elapsed_s, 1e-9)
    left_s = (wanted - computed) / rate if computed else 0.0
    text = f"{computed} of {wanted} rows, {rate:.1f} rows/s, {left_s:.0f} s left"
    return text + (f", {failures} failed" if failures else "")
