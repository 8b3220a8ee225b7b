"""`adacd-hil compare`: two logs beside each other."""

from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING

import click

from adacd_hil.cli.options import json_option, stretch_options
from adacd_hil.cli.output import ExitCode, answer, complain_of, explain_statuses, explained, format_table, one_by_one
from adacd_hil.given_path import GivenPath
from adacd_hil.log.log_parts import log_in
from adacd_hil.printable import in_line
from adacd_hil.progress_lines import Progress

if TYPE_CHECKING:
    from adacd_hil.lab.runs.log_comparison import Contact, LogComparison
    from adacd_hil.log.time_window import TimeWindow

_EPILOG = explain_statuses(
    OK="all decided the same in every cycle",
    FAILURE="they differ, or a log can't be read",
    USAGE="wrong usage",
    PARTIAL="the same as far as the logs are whole",
)


@click.command(epilog=_EPILOG)
@click.argument("first", type=GivenPath())
@click.argument("others", type=GivenPath(), nargs=-1, required=True)
@json_option
@explained
@stretch_options
def compare(first: Path, others: tuple[Path, ...], as_json: bool, stretch: "TimeWindow") -> ExitCode:
    """Compare the first run with each other: settings, fields of /scheme, states, contacts, parameters, timing.

    Times count from motion start, the first cycle in ADAPT. A folder stands for the run log in it.

    --from and --until choose a stretch of the first log; of the second the cycles that lie equally long after motion
    start are compared with it.
    """
    from adacd_hil.lab.runs.log_comparison import compare_logs

    with Progress() as progress:
        found, refused = one_by_one(others, lambda other: compare_logs(log_in(first), log_in(other), progress, stretch))
    if found:
        tables = [each.by_key() for each in found]
        answer(as_json, tables[0] if len(others) == 1 else tables, "\n\n".join(map(_as_text, found)))
    if code := complain_of(refused):
        return code
    if not all(each.is_same_where_whole for each in found):
        return ExitCode.FAILURE
    return ExitCode.OK if all(each.is_same and not each.notes for each in found) else ExitCode.PARTIAL


def _as_text(found: "LogComparison") -> str:
    names = [str(found.first.path), str(found.second.path)]
    lines = [in_line(line) for line in (f"1: {names[0]}", f"2: {names[1]}", "", *found.notes)]
    if not found.stretch.is_whole:
        lines.append(f"of 1 {found.stretch.text}; of 2 as long after motion start")
    if found.is_same:
        lines.append(f"the same in all {found.cycles} cycles")
    else:
        same = ", all the same" if found.is_same_where_whole else ""
        lines.append(f"{found.cycles} cycles compared{same}, {found.only[0]} and {found.only[1]} only in one")
    fields = [
        (
            each.field,
            f"{each.first_s:.3f} s",
            str(each.first_cycle),
            str(each.cycles),
            f"{each.largest:.3g}" if each.largest else "–",
        )
        for each in found.fields
    ]
    contacts = [(contact_in_words(first), contact_in_words(second)) for first, second in found.contacts]
    for head, rows in (
        (("setting", "1", "2"), [(key, *pair) for key, pair in found.settings.items()]),
        (("metadata", "1", "2"), [(key, *pair) for key, pair in found.metadata.items()]),
        (("field", "differs from", "cycle", "cycles", "by at most"), fields),
        (("contact in 1", "in 2"), contacts),
    ):
        if rows:
            lines += ["", format_table(head, rows, (1, 2, 3, 4) if rows is fields else ())]
    lines += ["", format_table(("state", "1", "2"), _states(found))]
    lines += ["", format_table(("parameter", "1", "2"), _parameters(found))]
    lines += ["", format_table(("timing, µs", "1", "2"), _timing(found))]
    return "\n".join(lines)


def contact_in_words(contact: "Contact | None") -> str:
    """Return a contact as the text of a table's cell: time, link and, if it or a bound is known, force; "–" for None.

    The force of a location that this version doesn't have is written as if known.
    """
    if contact is None:
        return "–"
    from adacd_hil.records import Location

    time_s, report = contact
    is_known = report.location in Location.__members__.values()  # a later version may have others
    force = Location(report.location).force_text(report.force_N) if is_known else f"{report.force_N:.1f}"
    return f"{time_s:.3f} s, link {report.link}" + ("" if force == "–" else f", {force} N")


def _states(found: "LogComparison") -> list[tuple[str, str, str]]:
    rows = []
    for a, b in zip_longest(found.first.states, found.second.states):
        name = a[1] if a and b and a[1] == b[1] else f"{a[1] if a else '–'} / {b[1] if b else '–'}"
        rows.append((name, f"{a[0]:.3f} s" if a else "–", f"{b[0]:.3f} s" if b else "–"))
    return rows


def _parameters(found: "LogComparison") -> list[tuple[str, str, str]]:
    first, second = found.first.parameters, found.second.parameters
    names = [*first, *(name for name in second if name not in first)]
    return [(name, _numbers(first.get(name, [])), _numbers(second.get(name, []))) for name in names]


def _numbers(values: list[float]) -> str:
    return ", ".join(f"{value:.6g}" for value in values) or "–"


def _timing(found: "LogComparison") -> list[tuple[str, str, str]]:
    rows = []
    for name, values in found.first.timing_us.items():
        cells = [
            " / ".join(f"{value:.0f}" for value in side.timing_us.get(name, {}).values()) or "–"
            for side in (found.first, found.second)
        ]
        rows.append((f"{name} {'/'.join(values)}", cells[0], cells[1]))
    return rows
