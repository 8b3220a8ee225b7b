"""The plan of a sweep: which logs or scenarios, with which settings and seeds; its rows, and the tasks they go out in.

Every row has a key made of all that its result depends on. A sweep that is begun again computes the keys that its
folder lacks. A log that has changed, other settings, and another version of the package or of the code make other keys.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

from adacd_hil.log.log_files import LogError
from adacd_hil.settings.schema import ConfigError
from adacd_hil.wire.codec import CodecError

Changes = tuple[tuple[str, str], ...]
"""Settings that differ, as `key`, TOML value."""


class Subject(NamedTuple):
    """The subject of one task: a log, or a scenario with a seed. `stamp`: the state of a log when the plan was made."""

    log: str = ""
    stamp: str = ""
    scenario: str = ""
    seed: int = 0


class SweepRow(NamedTuple):
    """One run or replay of the sweep."""

    key: str
    changes: Changes


@dataclass(frozen=True)
class Task:
    """Rows about one subject: a worker opens it once for all of them."""

    subject: Subject
    config: str  # name or file; empty: the log's own
    profile: str
    rows: tuple[SweepRow, ...]


@dataclass(frozen=True)
class Plan:
    """A whole sweep. `version`: of the code, a part of every key."""

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
        """Keys of the settings that are varied."""
        return tuple(dict.fromkeys(key for changes in self.variants for key, _ in changes))

    def tasks(self, done: frozenset[str], rows_per_task: int) -> Iterator[Task]:
        """Give the tasks whose rows are not done, lazily, subject by subject."""
        for subject in self.subjects:
            rows = [SweepRow(self._key(subject, changes), changes) for changes in self.variants]
            rows = [row for row in rows if row.key not in done]
            for start in range(0, len(rows), rows_per_task):
                yield Task(subject, self.config, self.profile, tuple(rows[start : start + rows_per_task]))

    def row_keys(self) -> Iterator[str]:
        """Give the keys of all rows."""
        return (self._key(subject, changes) for subject in self.subjects for changes in self.variants)

    def _key(self, subject: Subject, changes: Changes) -> str:
        text = json.dumps([subject, sorted(changes), self.config, self.profile, self.version])
        return hashlib.sha256(text.encode()).hexdigest()[:24]


def plan_logs(
    logs: Sequence[Path], variants: Sequence[Mapping[str, str]], config: str, profile: str, version: str
) -> Plan:
    """Plan replays of logs. Raises OSError when one can't be looked at."""
    subjects = []
    for path in logs:
        status = path.stat()
        subjects.append(Subject(log=str(path.resolve()), stamp=f"{status.st_size}/{status.st_mtime_ns}"))
    return Plan(tuple(dict.fromkeys(subjects)), _tuples(variants), config, profile, version)


def plan_scenarios(
    scenarios: Sequence[str],
    seeds: Sequence[int],
    variants: Sequence[Mapping[str, str]],
    config: str,
    profile: str,
    version: str,
) -> Plan:
    """Plan runs of the emulated arm."""
    subjects = (Subject(scenario=scenario, seed=seed) for scenario in scenarios for seed in seeds)
    return Plan(tuple(dict.fromkeys(subjects)), _tuples(variants), config, profile, version)


def _tuples(variants: Sequence[Mapping[str, str]]) -> tuple[Changes, ...]:
    return tuple(dict.fromkeys(tuple(changes.items()) for changes in variants)) or ((),)


SET: Final = "set."
"""Prefix of the columns of varied settings."""
REFUSALS: Final = (ConfigError, CodecError, LogError)
"""What makes a row of its own that says why, however often it is tried."""

Value = str | int | float | bool | None
Values = dict[str, Value]


def row_labels(subject: Subject, row: SweepRow) -> Values:
    """Name a row: its key, its subject, and the settings that are varied."""
    changes: Mapping[str, str] = dict(row.changes)
    return {
        "key": row.key,
        "log": subject.log or None,
        "scenario": subject.scenario or None,
        "seed": subject.seed if subject.scenario else None,
        **{SET + key: value for key, value in changes.items()},
    }


def failed(subject: Subject, row: SweepRow, error: str) -> Values:
    """Make a row that says why there is no result."""
    return row_labels(subject, row) | {"status": "failed", "error": " ".join(error.split())}
