"""`adacd-hil tune`: thresholds, filter and gain found from logs, as a configuration with its provenance."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from adacd_hil.cli.options import FiniteRange, json_option, logs_argument, stretch_options, typed_again
from adacd_hil.cli.output import (
    ExitCode,
    explain_statuses,
    explained,
    extendable,
    format_table,
    print_and_write,
    quoted,
    suggest,
    writable_folder,
)
from adacd_hil.given_path import WRITTEN_FILE, WRITTEN_FOLDER
from adacd_hil.lab.cli.given_logs import different_logs
from adacd_hil.lab.stated_bounds import LEAST_RATE_PER_H, MOST_RATE_PER_H
from adacd_hil.plain_values import json_text
from adacd_hil.printable import in_line
from adacd_hil.progress_lines import Progress

if TYPE_CHECKING:
    from adacd_hil.lab.tune.tune_roc import Candidate, Found, Tuning
    from adacd_hil.log.time_window import TimeWindow


rate_option = click.option(
    "--rate-per-h",
    type=FiniteRange(LEAST_RATE_PER_H, MOST_RATE_PER_H),
    default=0.01,
    show_default=True,
    help="Wanted false alarms per hour of a detector.",
)
"""The option of `tune` and `thresholds`."""


@click.command(
    epilog=explain_statuses(
        OK="found, and the half to check on shows the wanted rate",
        PARTIAL="it can't show it, or no candidate is fit",
        FAILURE="a log can't be read, or has no motion that counts",
        USAGE="wrong usage or configuration",
        INTERRUPTED="interrupted",
    )
)
@logs_argument
@rate_option
@click.option("--config", metavar="NAME|FILE", help="Settings to start from and to extend; default: the logs' own.")
@click.option("--out", type=WRITTEN_FILE, help="Write the suggested configuration here.")
@click.option("--report", type=WRITTEN_FOLDER, help="Folder for tune.json and the figures.")
@json_option
@explained
@stretch_options
def tune(
    logs: tuple[Path, ...],
    rate_per_h: float,
    config: str | None,
    out: Path | None,
    report: Path | None,
    as_json: bool,
    stretch: "TimeWindow",
) -> ExitCode:
    """Find thresholds, filter and gain from LOGS; a folder stands for the run log in it.

    Thresholds are chosen on half of the logs, or of one log's time, and checked on the rest. With the truth.mcap beside
    the logs: contacts found, delays, and a small grid of filters and gains, replayed. Without: thresholds only.

    With --from and --until, motion and contacts of that stretch of each log count. The replays begin with the log.
    """
    from adacd_hil.lab.tune.tune import base_of, suggested_toml
    from adacd_hil.lab.tune.tune import tune as find
    from adacd_hil.lab.tune.tune_roc import tuning_by_key
    from adacd_hil.replay.log_source import LogSource

    paths = different_logs(logs)
    with writable_folder(out, config):
        base = base_of(LogSource(paths[0]).settings, config) if out is not None else None
        with Progress() as progress:
            found = find(paths, rate_per_h, config, progress, stretch)
        text = json_text(tuning_by_key(found)) if as_json else _as_text(found)
        content = ""
        if base is not None and found.best is not None:
            content = suggested_toml(found, found.best, extendable(base[0]), base[1])
        written = out if content else None
        print_and_write(text, written, content, as_json)
        if not as_json:
            suggest(*_next(paths[0], found, written))
    if report is not None:
        from adacd_hil.lab.tune.tune import write_tuning

        write_tuning(found, report)
    return ExitCode.OK if found.is_shown else ExitCode.PARTIAL


def _next(log_path: Path, found: "Tuning", out: Path | None) -> tuple[str, ...]:
    """Return the command to suggest: to write the configuration, or to try the written one `out` on the first log.

    () if nothing is suggested.
    """
    if found.best is None:
        return ()
    if out is None:
        return (f"{typed_again('--out', 'tuned.toml')}   # writes the suggestion as a configuration",)
    return (f"adacd-hil replay {quoted(log_path)} --config {quoted(out)}   # with these settings",)


def _as_text(found: "Tuning") -> str:
    from adacd_hil.lab.score.rates import CONFIDENCE_TEXT
    from adacd_hil.lab.score.report_wording import DELAY_FIGURES
    from adacd_hil.lab.tune.tune import in_words
    from adacd_hil.lab.tune.tune_roc import LIMITS, free_hours

    hours = sum(map(free_hours, found.logs))
    lines = [f"{found.rate_per_h:g} false alarms per hour wanted; {hours:.4f} h of contact-free motion", ""]
    if found.detectors:
        rate = f"{CONFIDENCE_TEXT} bound, 1/h"
        head = (
            "detector",
            "found",
            CONFIDENCE_TEXT,
            *(f"{name} ms" for name in DELAY_FIGURES),
            "alarms",
            rate,
            "thresholds",
        )
        rows = [
            (choice.name, *_cells(choice.checked), "largest seen" if choice.calibration is None else choice.method)
            for choice in found.detectors
        ]
        lines += ["Detectors, in the half that their thresholds were not chosen on:", format_table(head, rows), ""]
    columns = ("filter and gain", "thresholds", "adapts, s", "missed", "false", "median ms", "bound, 1/h", "fit")
    lines += [
        "The logs' scheme, replayed with the thresholds chosen:",
        format_table(columns, [_row(candidate) for candidate in found.candidates]),
        "",
        *(in_line(f"Note: {note}") for note in found.notes),
    ]
    if found.best is None:
        lines.append("No candidate is fit; nothing is suggested.")
    else:
        lines.append(f"Suggested: {', '.join(f'{key} = {value}' for key, value in found.best.changes.items())}")
        lines.append(f"  chosen on:  {in_words(found.best.choice.chosen)}")
        lines.append(f"  checked on: {in_words(found.best.choice.checked)}")
        if not found.is_shown:
            lines.append(
                f"  {found.rate_per_h:g} per hour is not shown by counting, which needs {3.0 / found.rate_per_h:.4g} h "
                f"without an alarm to check on; the thresholds are from the {found.best.choice.method}."
            )
    return "\n".join([*lines, "", LIMITS])


def _cells(checked: "Found") -> tuple[str, ...]:
    """Return the cells of a detector's row, a dash for a value that is unknown.

    Contacts found, bounds of their share in %, at `CONFIDENCE`, median, 90 % and largest delay in ms, alarms, bound of
    the alarm rate per hour.
    """
    from adacd_hil.lab.score.report_wording import delay_figures

    low, high = checked.share_bounds
    return (
        "–" if checked.contacts is None else f"{len(checked.delays_ms)} of {checked.contacts}",
        "–" if checked.contacts is None else f"{100 * low:.0f}–{100 * high:.0f} %",
        *("–" if each is None else f"{each:.1f}" for each in delay_figures(checked.delays_ms).values()),
        str(checked.alarms),
        f"{checked.rate_bound_per_h:.3g}",
    )


def _row(candidate: "Candidate") -> tuple[str, ...]:
    from adacd_hil.lab.score.report_wording import delay_figures
    from adacd_hil.lab.tune.tune import slowest_adaptation

    outcome = candidate.outcome
    median_ms = delay_figures(outcome.delays_ms)["median"]
    return (
        candidate.name,
        ", ".join(f"{each:.3g}" for each in candidate.choice.thresholds.reshape(-1)),
        slowest_adaptation(outcome),
        "–" if outcome.missed is None else str(outcome.missed),
        "–" if outcome.false_alarms is None else str(outcome.false_alarms),
        "–" if median_ms is None else f"{median_ms:.1f}",
        f"{candidate.choice.checked.rate_bound_per_h:.3g}",
        "; ".join(candidate.problems) or "yes",
    )
