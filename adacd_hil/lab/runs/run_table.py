"""Lists of runs that pass a filter, as rows for a terminal, a page, JSON, CSV and Parquet.

CSV and Parquet have the same columns, a value per joint in columns of its own (`threshold_1_Nm`); unknown values are
empty. Parquet's columns have fixed types, so that tables of several folders can be read as one.
"""

import csv
import errno
import fnmatch
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from adacd_hil.file_replacement import has_other_head, replace_files, replacing
from adacd_hil.lab.logs.signal_tables import import_pyarrow
from adacd_hil.lab.runs.run_summary import CERTIFIED, GOOD, NO_CERTIFICATE, NOT_JUDGED, RUNNING, RunSummary
from adacd_hil.lab.score.report_wording import number_text, pair_text
from adacd_hil.log.log_files import failing_as
from adacd_hil.printable import number_of
from adacd_hil.score.wording import NONE, found_text

_PAIR: Final = ("float64", "float64")
COLUMNS: Final[Mapping[str, str | tuple[str, str]]] = {
    **dict.fromkeys(("run", "log", "status", "verdict", "started", "started_by", "arm"), "string"),
    **dict.fromkeys(("config", "profile", "scenario", "interface", "version"), "string"),
    "duration_s": "float64",
    "certificate": "string",
    "certified_s": "float64",
    "certificates": "int64",
    "threshold_Nm": _PAIR,
    "margin": "float64",
    **dict.fromkeys(("found", "expected", "false_alarms"), "int64"),
    **dict.fromkeys(("friction_Nm", "friction_std_Nm", "offset_Nm", "offset_std_Nm"), _PAIR),
}
"""The table's columns, each with its type in Parquet, or those of a value per joint."""


def values_of(run: RunSummary) -> dict[str, Any]:
    """Return a run's values by column of COLUMNS; None: not known. A value per joint is a pair."""
    state, at_s, given = run.certificate or (None, None, None)
    own = {
        "run": run.name,
        "log": str(run.log),
        "started": None if run.started is None else run.started.isoformat(timespec="seconds"),
        "certificate": state,
        "certified_s": at_s,
        "certificates": given,
    }
    values = {name: own[name] if name in own else getattr(run, name) for name in COLUMNS}
    return {name: None if value == "" else value for name, value in values.items()}


HEAD: Final = (
    "run", "started", "verdict", "certificate", "thresholds Nm", "margin", "contacts", "lasts s", "arm", "scenario",
)  # fmt: skip
NUMBERS: Final = (5, 6, 7)
"""Columns of HEAD that are aligned right."""


@dataclass(frozen=True)
class RunFilter:
    """The conditions that a run of the list meets; None or empty: no condition.

    arms: names as in the list, configurations, or patterns of them. since, until: bounds of the run's beginning, both
    included; a run without a date is outside any bounds.
    """

    arms: tuple[str, ...] = ()
    statuses: tuple[str, ...] = ()
    scenarios: tuple[str, ...] = ()
    since: datetime | None = None
    until: datetime | None = None

    def takes(self, run: RunSummary) -> bool:
        """Return whether a run meets all conditions: on its arm, status, scenario and beginning.

        Of the names of one condition, one must fit. An empty condition is met, but a run without a date is outside any
        bounds.
        """
        if self.arms and not any(is_arm(run, arm) for arm in self.arms):
            return False
        if self.statuses and run.status not in self.statuses:
            return False
        if self.scenarios and run.scenario not in self.scenarios:
            return False
        if self.since is None and self.until is None:
            return True
        if run.started is None:
            return False
        is_late_enough = self.since is None or run.started >= self.since
        return is_late_enough and (self.until is None or run.started <= self.until)


def is_arm(run: RunSummary, arm: str) -> bool:
    """Return whether a run's arm or configuration has the name `arm`, which may be a pattern such as `lab-*`."""
    return any(name and fnmatch.fnmatchcase(name, arm) for name in (run.arm, run.config))


def in_order(runs: Iterable[RunSummary]) -> list[RunSummary]:
    """Return runs sorted by their beginnings, the oldest first; those without a date come before all."""
    return sorted(runs, key=lambda run: (run.started is not None, run.started and run.started.timestamp(), run.name))


def count_text(runs: Sequence[RunSummary]) -> str:
    """Return a phrase such as "5 runs, 2 not good, 1 running"; "5 runs, all good"; "no run" without one.

    Broken runs count as not good. Counts of 0 are left out.
    """
    text = number_of(len(runs), "run")
    bad = sum(run.status not in (GOOD, NOT_JUDGED, RUNNING) for run in runs)
    parts = [f"{bad} not good"] if bad else []
    for status in (NOT_JUDGED, RUNNING):
        if count := sum(run.status == status for run in runs):
            parts.append(f"{count} {status}")
    return f"{text}, {', '.join(parts) or 'all good'}" if runs else "no run"


def row_texts(run: RunSummary) -> tuple[str, ...]:
    """Return the texts of a run's row in the table of runs, in the order of HEAD; NONE for unknown values."""
    return (
        run.name,
        NONE if run.started is None else f"{run.started:%Y-%m-%d %H:%M}",
        run.status,
        certificate_text(run),
        pair_text(run.threshold_Nm, 3),
        number_text(run.margin, 2),
        NONE if run.found is None else str(run.found) if run.expected is None else found_text(run.found, run.expected),
        number_text(run.duration_s, 1),
        run.arm or NONE,
        run.scenario or NONE,
    )


def certificate_text(run: RunSummary) -> str:
    """Return the state of a run's last certificate, and when that came, s since motion start; NONE if unknown.

    "none" for a run without a certificate. The time is left out if unknown. A certified run with several certificates
    has their number, too.
    """
    if run.certificate is None:
        return NONE
    state, at_s, given = run.certificate
    if state == NO_CERTIFICATE:
        return "none"
    when = "" if at_s is None else f" at {at_s:.1f} s"
    return f"{state}{when}" + (f", {given} in all" if given > 1 and state == CERTIFIED else "")


def _flat(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row by the columns of CSV and Parquet: a value per joint becomes two, `threshold_1_Nm`.

    row: by COLUMNS.
    """
    flat: dict[str, Any] = {}
    for name, value in row.items():
        if isinstance(COLUMNS[name], str):
            flat[name] = value
            continue
        stem, unit = name.rsplit("_", 1)
        flat |= {f"{stem}_{joint}_{unit}": value and value[joint - 1] for joint in (1, 2)}
    return flat


def as_csv(runs: Sequence[RunSummary]) -> str:
    """Return the table of runs as CSV, with a head and a line per run; unknown values are empty.

    A value per joint takes two columns, see `_flat`.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(_flat(COLUMNS))
    writer.writerows(_flat(values_of(run)).values() for run in runs)
    return out.getvalue()


def write_parquet(runs: Sequence[RunSummary], path: Path) -> None:
    """Write the table of runs as Parquet, and make its folder; an earlier file is replaced once the new one is whole.

    Raises LogError without pyarrow, or if the file can't be written, as over a log, a folder or no Parquet.
    """
    arrow, parquet = import_pyarrow()
    rows = [_flat(values_of(run)) for run in runs]
    columns = {
        name: arrow.array([row[name] for row in rows], type=getattr(arrow, kind)())
        for name, kind in _flat(COLUMNS).items()
    }
    with failing_as(f"{path} can't be written"):
        _check_head(path, b"PAR1")
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as beside:
            parquet.write_table(arrow.table(columns), beside, compression="zstd")


def write_result(content: bytes | str, path: Path) -> None:
    """Write a file, and make its folder; an earlier file is replaced once the new one is whole.

    Raises LogError if it can't be written, as over a log, a folder or a file that begins otherwise.
    """
    with failing_as(f"{path} can't be written"):
        _check_head(path, (content.encode() if isinstance(content, str) else content)[:_HEAD_BYTES])
        replace_files(path.parent, {path.name: content})


_HEAD_BYTES = 12
"""Of a table or page: those of two versions of it are alike this far."""


def _check_head(path: Path, head: bytes) -> None:
    if has_other_head(path, head):
        raise FileExistsError(errno.EEXIST, "what is there is no result of this command; give another name", str(path))
