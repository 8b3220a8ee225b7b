"""The tables of a report as CSV: contacts, parameters, states. Times in s since motion start, units in the names."""

import csv
import dataclasses
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from adacd_hil.analysis.logged_run import Run
from adacd_hil.analysis.metrics import Metrics
from adacd_hil.analysis.report.timeline import stays_of
from adacd_hil.analysis.score.contacts import Contact
from adacd_hil.analysis.sections import section_at
from adacd_hil.records import PARAMETER_UNITS

_PARAMETERS: Final = ("section", "parameter", "unit", "true", "identified", "std", "cad")
_STATES: Final = ("state", "section", "start_s", "end_s", "duration_s")
_DIGITS: Final = 9


def report_tables(run: Run, metrics: Metrics) -> dict[str, str]:
    """Write each table, by its file's name."""
    names = [field.name for field in dataclasses.fields(Contact)]
    pairs = [name for name in names if any(isinstance(getattr(c, name), tuple) for c in metrics.contacts)]
    head = [column for name in names for column in ((f"{name}_1", f"{name}_2") if name in pairs else (name,))]
    contacts = ([cell for name in names for cell in _cells(getattr(c, name), name in pairs)] for c in metrics.contacts)
    return {
        "contacts.csv": _table(head, contacts),
        "parameters.csv": _table(_PARAMETERS, _parameters(run, metrics)),
        "states.csv": _table(_STATES, _states(run, metrics)),
    }


def _cells(value: Any, is_pair: bool) -> Sequence[Any]:
    """Give a value, or that of each joint."""
    if not is_pair:
        return (value,)
    return (None, None) if value is None else tuple(value)


def _parameters(run: Run, metrics: Metrics) -> Iterable[Sequence[Any]]:
    cad: Mapping[str, float] = (
        dict(zip(run.parameter_names, run.settings.arm.cad_theta, strict=True)) if run.has_cad else {}
    )
    for label, found in metrics.parameters.items():
        estimates = {} if metrics.evidence is None else metrics.evidence.estimates.get(label, {})
        for name, (true, identified) in found.items():
            std = estimates[name].std if name in estimates else None
            yield label, name, PARAMETER_UNITS[name], true, identified, std, cad.get(name)
        for name in (name for name in estimates if name not in found):
            yield label, name, PARAMETER_UNITS.get(name, "Nm"), None, estimates[name].value, estimates[name].std, None


def _states(run: Run, metrics: Metrics) -> Iterable[Sequence[Any]]:
    for stay in stays_of(run):
        label = section_at(metrics.sections, 0.5 * (stay.start_s + stay.end_s))
        yield stay.state.name, label, stay.start_s, stay.end_s, stay.end_s - stay.start_s


def _table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(head)
    writer.writerows([f"{cell:.{_DIGITS}g}" if isinstance(cell, float) else cell for cell in row] for row in rows)
    return out.getvalue()
