"""The tables of a campaign: each figure with what is wanted of it, what each scheme reaches, and what noise allows."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from campaign_bound import Bound
from campaign_trials import STEPS_NM, Row

from adacd_hil.cli.output import format_table
from adacd_hil.scheme.detect.sight import WITHIN_S

Rows = dict[str, list[Row]]
Bounds = dict[tuple[str, bool], Bound]
KNOWN_S = 0.5
"""A touch that begins earlier in an adaptation meets a model that nothing is known of yet."""
NAN = float("nan")


@dataclass(frozen=True)
class Figure:
    """One line. wanted: largest value, or with `is_floor` the smallest; value: of a scheme's rows; noise: the bound."""

    name: str
    wanted: float
    value: Callable[[Rows], float]
    noise: float = NAN
    form: str = "{:.3g}"
    is_floor: bool = False

    def is_good(self, value: float) -> bool:
        """Return whether a value is as wanted; one that was not measured is."""
        if np.isnan(value):
            return True
        return value >= self.wanted if self.is_floor else value <= self.wanted


@dataclass(frozen=True)
class FigureTable:
    """The table as text, and its lines as plain values."""

    text: str
    lines: list[dict[str, Any]]


def figure_table(rows: Rows, schemes: Sequence[str], bounds: Bounds) -> FigureTable:
    """Make the table of the campaign; the last scheme has to reach what is wanted."""
    lines, cells = [], []
    for figure in figures_of(bounds):
        values = {scheme: figure.value(_of(rows, scheme)) for scheme in schemes}
        lines.append({"name": figure.name, "wanted": figure.wanted, "noise": figure.noise, **values})
        ahead = values[schemes[-1]]
        verdict = (
            "" if np.isnan(ahead) or not np.isfinite(figure.wanted) else "ok" if figure.is_good(ahead) else "MISSED"
        )
        times = ahead / figure.noise if figure.noise > 0.0 else NAN
        wanted = f"{'≥' if figure.is_floor else '≤'} {figure.form.format(figure.wanted)}"
        cells.append((
            figure.name, wanted if np.isfinite(figure.wanted) else "",
            *(_text(figure, value) for value in values.values()),
            _text(figure, figure.noise), "–" if np.isnan(times) else f"{times:.1f} ×", verdict,
        ))  # fmt: skip
    head = ("figure", "at least", *schemes, "noise bound", "times it", "")
    right = tuple(range(1, len(head) - 1))
    return FigureTable(format_table(head, cells, right=right), lines)


def is_all_good(table: FigureTable) -> bool:
    """Return whether no figure is missed."""
    return "MISSED" not in table.text


def figures_of(bounds: Bounds) -> list[Figure]:
    """List the figures."""
    figures = [
        Figure("armed from zero, median, s", 2.5, lambda rows: _median(_took(rows, 0))),
        Figure("armed from zero, worst, s", 2.5, lambda rows: _worst(_took(rows, 0))),
        Figure("armed after 1 kg, median, s", 1.0, lambda rows: _median(_took(rows, 1))),
        Figure("armed after 1 kg, worst, s", 1.0, lambda rows: _worst(_took(rows, 1))),
        Figure("arms never armed", 0.0, lambda rows: _sum(not r["is_armed"] for r in _watched(rows))),
        Figure("false alarms in 60 s, random arms", 0.0, lambda rows: _alarms(rows["arms"])),
        Figure("false alarms in 60 s, friction variants", 0.0, lambda rows: _alarms(rows["variants"])),
        Figure("false alarms, the day", 0.0, lambda rows: _alarms(rows["day"])),
        Figure("hours of it", 24.0, lambda rows: _sum(r.get("watched_s", 0.0) for r in rows["day"]) / 3600.0,
               is_floor=True),
        Figure("frozen residual on unseen motion, S and M, worst, Nm", 0.04, _residual),
        Figure("the same, 99 % of runs below, Nm", 0.04, lambda rows: _residual(rows, 99.0)),
    ]  # fmt: skip
    for is_loaded, limits in ((False, {0.3: 10.0, 1.0: 4.0}), (True, {0.3: 15.0, 1.0: 6.0})):
        load = "1 kg" if is_loaded else "no payload"
        for joint in range(2):
            for step_Nm in (0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0):
                noise_ms = max(1e3 * bounds[key].delay_s(joint, step_Nm) for key in bounds if key[1] == is_loaded)
                figures.append(
                    Figure(
                        f"step of {step_Nm:g} Nm, joint {joint + 1}, {load}, median, ms",
                        limits.get(step_Nm, np.inf),
                        lambda rows, s=step_Nm, j=joint, load=is_loaded: 1e3 * _step_delay(rows, load, j, s),  # type: ignore[misc]
                        noise_ms,
                        "{:.1f}",
                    )
                )
            noise_Nm = max(bounds[key].smallest_Nm(joint, WITHIN_S) for key in bounds if key[1] == is_loaded)
            figures.append(
                Figure(
                    f"smallest step within {1e3 * WITHIN_S:g} ms, joint {joint + 1}, {load}, Nm",
                    0.08 if is_loaded else 0.05,
                    lambda rows, j=joint, load=is_loaded: _smallest(rows, load, j),  # type: ignore[misc]
                    noise_Nm,
                )
            )
    return figures + touch_figures()


def touch_figures() -> list[Figure]:
    """List the figures of contacts on links and of touches while adapting."""

    def lever(percent: float, key: str, neutral: float) -> Callable[[Rows], float]:
        def value(rows: Rows) -> float:
            some = [abs(r[key] - neutral) for r in _found(rows) if key in r and r["force_N"] >= 10.0]
            return float(np.percentile(some, percent)) if some else NAN

        return value

    def contact_median(key: str) -> Callable[[Rows], float]:
        return lambda rows: _median([r[key] for r in _found(rows)])

    def touched(judge: Callable[[list[float]], float], key: str) -> Callable[[Rows], float]:
        return lambda rows: judge([r[key] for r in _touches(rows)])

    two = "{:.2f}"
    return [
        Figure("contacts found, %", 99.9, lambda rows: _share(_contacts(rows), _is_found), NAN, two, True),
        Figure("link right 10 ms after the alarm, %", 99.0, _link_right, NAN, two, True),
        Figure("direction right, %", 100.0, lambda rows: _share(_found(rows), _is_direction_right), NAN, two, True),
        Figure("peak off by, median, %", 5.0, lambda rows: 100.0 * _median(_peak_errors(rows))),
        Figure("peak over true peak, median", np.inf, contact_median("peak_ratio")),
        Figure("contact found after, median, s", np.inf, contact_median("delay_s")),
        Figure("noise bound of that, s", np.inf, lambda rows: _median([r["noise_delay_s"] for r in _contacts(rows)])),
        Figure("lever arm off by, from 10 N, median, m", 0.03, lever(50.0, "lever_error_m", 0.0)),
        Figure("lever arm off by, from 10 N, 95 %, m", 0.03, lever(95.0, "lever_error_m", 0.0)),
        Figure("force off by, from 10 N, median, share", 0.1, lever(50.0, "force_ratio", 1.0)),
        Figure("force off by, from 10 N, 95 %, share", 0.1, lever(95.0, "force_ratio", 1.0)),
        Figure("touch while adapting flagged within 50 ms, %", 99.0, _flagged_in_time, NAN, two, True),
        Figure(f"the same, begun after {KNOWN_S:g} s, %", 99.0, _known_flagged_in_time, NAN, two, True),
        Figure("touch flagged after, median, s", 0.05, touched(_median, "flagged_s")),
        Figure("what it changes of the torque, median, Nm", 0.02, touched(_median, "changed_Nm")),
        Figure("what it changes of the torque, worst, Nm", 0.02, touched(_worst, "changed_Nm")),
    ]


def variant_table(rows: Rows, schemes: Sequence[str]) -> str:
    """Make the table of profiles, friction variants and payloads."""
    head = ("scheme", "profile", "friction", "payload", "armed s", "worst", "after 1 kg s", "worst", "never",
            "alarms", "residual Nm")  # fmt: skip
    cells = []
    keys = dict.fromkeys((r["profile"], r["friction"], r["loaded"]) for r in rows["variants"])
    for key in keys:
        for scheme in schemes:
            some = [r for r in rows["variants"]
                    if (r["profile"], r["friction"], r["loaded"]) == key and r["scheme"] == scheme]  # fmt: skip
            first, second = ([r["took_s"][i] for r in some if len(r["took_s"]) > i] for i in range(2))
            residual = max((max(r["residual_Nm"]) for r in some if r["is_armed"]), default=NAN)
            cells.append((
                scheme, key[0], key[1], "1 kg" if key[2] else "–",
                *(f"{f(values):.2f}" if values else "–" for values in (first, second) for f in (_median, _worst)),
                str(sum(not r["is_armed"] for r in some)), str(int(_alarms(some))) if some else "–", f"{residual:.3f}",
            ))  # fmt: skip
    return format_table(head, cells, right=tuple(range(4, len(head))))


def _text(figure: Figure, value: float) -> str:
    return "–" if np.isnan(value) else figure.form.format(value)


def _of(rows: Rows, scheme: str) -> Rows:
    return {part: [row for row in some if row["scheme"] == scheme] for part, some in rows.items()}


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if len(values) else NAN


def _worst(values: Sequence[float]) -> float:
    return float(np.max(np.where(np.isnan(values), np.inf, values))) if len(values) else NAN


def _sum(values: Any) -> float:
    values = list(values)
    return float(sum(values)) if values else NAN


def _share(rows: Sequence[Row], is_so: Callable[[Row], bool]) -> float:
    return 100.0 * float(np.mean([is_so(row) for row in rows])) if rows else NAN


def _watched(rows: Rows) -> list[Row]:
    return rows["arms"] + rows["variants"] + rows["day"]


def _took(rows: Rows, adaptation: int) -> list[float]:
    return [row["took_s"][adaptation] for row in _watched(rows) if len(row["took_s"]) > adaptation]


def _alarms(rows: Sequence[Row]) -> float:
    return _sum(row["alarms"] for row in rows if row["is_armed"])


def _residual(rows: Rows, percent: float = 100.0) -> float:
    values = [max(r["residual_Nm"]) for r in rows["day"] + rows["variants"]
              if r["is_armed"] and r["profile"] in "SM" and r["friction"] == "plain"]  # fmt: skip
    return float(np.percentile(values, percent)) if values else NAN


def _step_delay(rows: Rows, is_loaded: bool, joint: int, step_Nm: float) -> float:
    """Return the median delay of a step on the profile where it is largest, s."""
    medians = []
    wanted = (is_loaded, joint, step_Nm, True)
    some = [row for row in rows["steps"] if (row["loaded"], row["joint"], row["step_Nm"], row["is_moving"]) == wanted]
    for profile in dict.fromkeys(row["profile"] for row in some):
        delays = [row["delay_s"] for row in some if row["profile"] == profile]
        medians.append(float(np.median(delays)))
    return max(medians, default=NAN)


def _smallest(rows: Rows, is_loaded: bool, joint: int) -> float:
    """Return the smallest step from which on all are found in time in the median; inf for none."""
    smallest = float("inf") if rows["steps"] else NAN
    for step_Nm in reversed(STEPS_NM):
        if not _step_delay(rows, is_loaded, joint, step_Nm) <= WITHIN_S:
            break
        smallest = step_Nm
    return smallest


def _contacts(rows: Rows) -> list[Row]:
    return [row for row in rows["contacts"] if not row["was_over"]]


def _is_found(row: Row) -> bool:
    return bool(np.isfinite(row["delay_s"]))


def _found(rows: Rows) -> list[Row]:
    return [row for row in _contacts(rows) if _is_found(row)]


def _is_direction_right(row: Row) -> bool:
    return bool(row["is_direction_right"])


def _peak_errors(rows: Rows) -> list[float]:
    return [abs(row["peak_ratio"] - 1.0) for row in _found(rows)]


def _flagged_in_time(rows: Rows) -> float:
    return _share(_touches(rows), lambda row: row["flagged_s"] <= 0.05)


def _known_flagged_in_time(rows: Rows) -> float:
    return _share([row for row in _touches(rows) if row["at_s"] >= KNOWN_S], lambda row: row["flagged_s"] <= 0.05)


def _link_right(rows: Rows) -> float:
    return _share([r for r in _found(rows) if not r["is_hidden"]], lambda r: r["found_link"] == r["link"])


def _touches(rows: Rows) -> list[Row]:
    return [row for row in rows["touches"] if "changed_Nm" in row and not row["was_over"]]
