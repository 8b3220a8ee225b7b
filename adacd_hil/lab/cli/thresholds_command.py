"""Thresholds from recorded motion, for the command `thresholds`."""

from pathlib import Path

from adacd_hil.cli.output import format_table
from adacd_hil.lab.cli.given_logs import different_logs
from adacd_hil.lab.score.rates import CONFIDENCE_TEXT
from adacd_hil.lab.thresholds.detector_comparison import Comparison, compare_detectors
from adacd_hil.lab.thresholds.recorded_thresholds import Thresholds, thresholds_of_logs
from adacd_hil.log.time_window import TimeWindow
from adacd_hil.plain_values import json_text
from adacd_hil.printable import in_line
from adacd_hil.progress_lines import Progress


def find(
    logs: tuple[Path, ...], rate_per_h: float, is_compared: bool, stretch: TimeWindow
) -> tuple[Thresholds, Comparison | None]:
    """Return the thresholds of all detectors for a rate of false alarms, from contact-free motion in logs.

    rate_per_h: false alarms of a detector per hour. stretch: part of each log to use. Return a comparison of the
    detectors, too, if is_compared, else None. Raises LogError if logs can't be used or have too little motion,
    CommandError if one is given twice.
    """
    paths = different_logs(logs)
    with Progress() as progress:
        thresholds, statistics = thresholds_of_logs(paths, rate_per_h, stretch, progress)
    return thresholds, compare_detectors(statistics, rate_per_h) if is_compared else None


def as_json(thresholds: Thresholds, comparison: Comparison | None) -> str:
    """Return thresholds and, unless None, comparison as the text of a JSON object."""
    content = vars(thresholds)
    return json_text(content if comparison is None else content | {"comparison": comparison.by_key()})


def as_text(thresholds: Thresholds, comparison: Comparison | None) -> str:
    """Return thresholds as tables for people, and the comparison's table unless it is None."""
    lines = [
        f"{thresholds.rate_per_h:g} false alarms per hour, from {thresholds.hours:.2f} h of contact-free motion"
        + (", extrapolated" if thresholds.is_extrapolated else "")
        + f"; the velocity lags by {1e3 * thresholds.lag_s:.2f} ms",
        "",
    ]
    rows = []
    for row in thresholds.channels:
        for i, threshold in enumerate(row.threshold):
            unit = {"likelihood": "sigmas", "cusum": "Nm s"}.get(row.channel.split(" ", maxsplit=1)[0], "Nm")
            rows.append(
                (
                    row.detector,
                    row.channel,
                    str(i + 1),
                    f"{threshold:.4g} {unit}",
                    f"{row.achievable_Nm[i]:.4f} Nm" if row.achievable_Nm else "",
                    row.limit[i] if row.limit else "",
                )
            )
    lines += [
        format_table(
            ("detector", "channel", "joint", "threshold", "achievable", "limited by"), rows, (2, 3, 4), names=3
        )
    ]
    checks = [
        (
            row.name,
            f"{row.rate_bound_per_h:.2g}",
            f"x {row.bound_ratio:.2f}",
            "too short" if row.predicted_per_h is None else f"{row.predicted_per_h:.3g}",
            "" if row.measured_per_h is None else f"{row.measured_per_h:.3g}",
        )
        for row in thresholds.detectors
    ]
    head = ("detector", f"{CONFIDENCE_TEXT} bound, 1/h", "to be sure", "held out: predicted, 1/h", "measured, 1/h")
    lines += ["", format_table(head, checks, (1, 2, 3, 4))]
    if thresholds.missing:
        lines += ["", f"Too little motion for: {', '.join(thresholds.missing)}"]
    lines += ["", *(in_line(f"Note: {note}") for note in thresholds.notes)]
    if comparison is not None:
        lines += ["", "Median delay of a step, ms, best detector first:", format_table(*comparison.table())]
    return "\n".join(lines)
