"""The report's figures: the paper's figures 5 to 7, and the contacts close up.

Colours mean one thing throughout: blue the identified model, orange the CAD model (told apart by every kind of colour
vision), green joint 1 and purple joint 2 where the two share an axis, red what was detected.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from adacd_hil.lab.drawing import (
    COLOURS,
    PANEL_BINS,
    PAPER,
    Drawing,
    label_below,
    label_decades,
    legend_above,
    mark_lane,
    note,
    plot,
    style,
)
from adacd_hil.lab.report.page import ADAPTATIONS, SECTION_TITLES, has_paper, shown_beside
from adacd_hil.log.logged_run import Run, Section
from adacd_hil.records import JOINTS, PARAMETER_UNITS, SchemeState, Vector
from adacd_hil.scheme.model.filter_bank import channels_of
from adacd_hil.score.judge import filtered, row_at
from adacd_hil.score.metrics import Metrics, ReportedContact
from adacd_hil.score.wording import why_not_found

CLOSE_UPS: Final = 24
"""Contacts shown close up; six rows of four are a page."""
_SHADED: Final = 120
"""Sections that have room beside each other, with their letters."""
_NUMBERED: Final = 60
"""Contacts that have room beside each other, with their numbers."""
_LANE: Final = 0.915
"""Height of the lane with the marks of contacts."""
_BEFORE_S: Final = 0.012
_AFTER_S: Final = 0.06
"""From the onset, and at least: a typical detection, and the isolation window after it."""


def draw(run: Run, metrics: Metrics) -> list[Drawing]:
    """Draw every figure that the run has something for."""
    if run.cycle.size == 0:
        return []
    with style():
        drawings = [residuals(run, metrics)]
        adaptations = [section for section in metrics.sections if section.kind == "adaptation"]
        for number, section in enumerate(adaptations[:ADAPTATIONS]):
            drawings.append(adaptation(run, metrics, section, number))
        if metrics.contacts:
            drawings.append(close_ups(run, metrics))
    return drawings


def residuals(run: Run, metrics: Metrics) -> Drawing:
    """Draw figure 5: the residuals over the whole run, each joint once in full and once, by model, near zero."""
    has_beside = run.beside is not None
    lanes: tuple[tuple[str, Vector | None, Vector | None], ...] = (
        (("certified", run.tau_ext_hat, run.threshold),) if run.certified is not None else (("near zero", None, None),)
    )
    if run.beside is not None:
        lanes += (("paper's", run.beside.tau_ext_hat, run.beside.threshold),)
    figure = Figure(figsize=(10.0, 8.1 if has_beside else 6.6))
    time_s = run.time_s()
    shown = time_s >= min(0.0, time_s[-1])
    end_s = float(time_s[-1])
    full, near = _panels(figure, len(lanes))
    for joint in range(JOINTS):
        h = run.settings.detector.threshold_Nm[joint]
        _curves(full[joint], run, metrics, joint, shown)
        _pad(full[joint], run.tau_ext_hat[shown, joint], run.tau_ext_hat_cad[shown, joint], h)
        full[joint].set_title(f"({'ab'[joint]})  Joint {joint + 1}", pad=17 if joint == 0 else 5)
        full[joint].set_ylabel("Nm")
        _mark(full[joint], metrics)
        for axes, (label, residual, threshold) in zip(near[joint], lanes, strict=True):
            if residual is None or threshold is None:
                _curves(axes, run, metrics, joint, shown)
            else:
                _shade(axes, metrics.sections)
                colour = COLOURS["beside" if label == "paper's" else "identified"]
                plot(axes, time_s[shown], residual[shown, joint], color=colour, linewidth=0.8)
                finite = np.where(np.isfinite(threshold[shown, joint]), threshold[shown, joint], np.nan)
                for sign in (-1.0, 1.0):
                    plot(axes, time_s[shown], sign * finite, color=COLOURS["ink"], linewidth=0.7)
            axes.set_ylim(-1.8 * h, 1.8 * h)
            axes.set_yticks([-h, 0.0, h], [f"−{h:g}", "0", f"{h:g}"])
            axes.set_ylabel(label)
        for axes in (full[joint], *near[joint]):
            axes.set_xlim(0.0, max(end_s, 1e-3))
            axes.yaxis.set_label_coords(-0.052, 0.5)
            axes.tick_params(labelbottom=axes is near[-1][-1])
    _label(full[0], metrics.sections, end_s)
    near[1][-1].set_xlabel("time since motion start, s")
    lines = {str(line.get_label()): line for line in reversed(full[0].lines)}
    labels = [label for label in lines if not label.startswith("_")]
    handles = [lines[label] for label in labels]
    figure.legend(
        handles, labels, loc="upper right", bbox_to_anchor=(0.985, 0.99), ncols=len(labels), columnspacing=1.6
    )
    if run.certified is None:
        caption = (
            "Estimated external torque with the identified parameters and with the CAD model; below each, the range "
            "around the threshold, where the model's own error shows. Numbers mark contacts"
        )
    else:
        beside = ", and of the paper's scheme on the same stream" if run.beside is not None else ""
        caption = (
            f"Measured minus predicted torque: of the certified scheme, slowest filter, with the CAD model{beside}; "
            "below each, near zero and with the thresholds in force. Numbers mark contacts"
        )
    if len(metrics.contacts) > _NUMBERED:
        caption = caption.replace("Numbers", "Strokes")
    has_missed = any(contact.is_armed and contact.detected_s is None for contact in metrics.contacts)
    caption += ", a hollow mark one that was not detected" if has_missed else ""
    caption += f"; of {len(metrics.sections)} sections the wide ones are lettered" if _is_narrow(metrics) else ""
    caption += ", a cross a false alarm." if metrics.false_alarms else "."
    figure_5 = "Figure 5 — error" if has_paper(metrics) else "Torque that the model does not explain,"
    return Drawing("fig5", f"{figure_5} in (a) joint 1 and (b) joint 2", caption, figure)


def _panels(figure: Figure, lanes: int) -> tuple[list[Axes], list[list[Axes]]]:
    """Make, for each joint, a panel in full and one per lane near zero below it."""
    if lanes == 1:
        full = _stack(figure, (0.915, 0.475), 0.235)
        return full, [[axes] for axes in _stack(figure, (0.655, 0.215), 0.135)]
    full = _stack(figure, (0.927, 0.468), 0.187)
    return full, [_stack(figure, (top, top - 0.117), 0.0985) for top in (0.725, 0.266)]


def _curves(axes: Axes, run: Run, metrics: Metrics, joint: int, shown: NDArray[np.bool_]) -> None:
    """Draw a joint's residual of every model, against the paper's threshold where it decides or is compared."""
    time_s = run.time_s()[shown]
    _shade(axes, metrics.sections)
    h = run.settings.detector.threshold_Nm[joint]
    label = "threshold" if run.certified is None else "the paper's threshold"
    for level in (-h, h) if run.certified is None or has_paper(metrics) else ():
        axes.axhline(level, color=COLOURS["ink"], linewidth=0.8, dashes=(4, 2.5), label=label)
    if run.has_cad:
        cad = run.tau_ext_hat_cad[shown, joint]
        plot(axes, time_s, cad, color=COLOURS["cad"], linewidth=0.7, label="with the CAD model")
    if run.beside is not None:
        beside = run.beside.tau_ext_hat[shown, joint]
        plot(axes, time_s, beside, color=COLOURS["beside"], linewidth=0.7, label="the paper's scheme")
    label = "with the identified parameters" if run.certified is None else "certified"
    plot(axes, time_s, run.tau_ext_hat[shown, joint], color=COLOURS["identified"], linewidth=0.8, label=label)


def _stack(figure: Figure, tops: Sequence[float], height: float) -> list[Axes]:
    return [figure.add_axes((0.066, top - height, 0.919, height)) for top in tops]


def _shade(axes: Axes, sections: Sequence[Section]) -> None:
    for section in _wide(sections):
        if section.kind != "detection":
            axes.axvspan(section.start_s, section.end_s, color=COLOURS[section.kind], linewidth=0.0, zorder=0)
        axes.axvline(section.start_s, color=COLOURS["rule"], linewidth=0.7, zorder=1)


def _is_narrow(metrics: Metrics) -> bool:
    return len(metrics.sections) > _SHADED


def _wide(sections: Sequence[Section]) -> list[Section]:
    """Choose the sections that can be told apart: of many, those as wide as their letters."""
    if len(sections) <= _SHADED:
        return list(sections)
    least_s = (sections[-1].end_s - sections[0].start_s) / _SHADED
    return [section for section in sections if section.duration_s >= least_s]


def _label(axes: Axes, sections: Sequence[Section], end_s: float) -> None:
    """Write letter and kind of each section above the axes, the kind only where it has room."""
    for section in _wide(sections):
        room = 165.0 * section.duration_s / max(end_s, 1e-9)  # characters
        kind = SECTION_TITLES[section.kind]
        text = f"{section.label}  {kind}" if len(kind) + 3 < room else section.label
        axes.annotate(
            text,
            (0.5 * (section.start_s + section.end_s), 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, 4),
            textcoords="offset points",
            ha="center",
            va="bottom",
            fontsize=8.0,
            color=COLOURS["muted"],
        )


def _pad(axes: Axes, identified: Vector, cad: Vector, h: float) -> None:
    """Fit the ordinate to the data and leave a lane on top for the contact marks."""
    low, high = _range((identified, cad), h)
    span = high - low
    axes.set_ylim(low - 0.06 * span, high + 0.24 * span)
    axes.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))


def _mark(axes: Axes, metrics: Metrics) -> None:
    """Mark contacts and false alarms on the lane on top."""
    alarm = COLOURS["alarm"]
    is_crowded = len(metrics.contacts) > _NUMBERED
    for is_seen in (True, False) if is_crowded else ():
        times_s = [contact.at_s for contact in metrics.contacts if (contact.detected_s is not None) == is_seen]
        marker, size, edge = ("|", 7, 0.6) if is_seen else ("o", 5, 0.9)
        look = {"marker": marker, "markersize": size, "markeredgewidth": edge, "markerfacecolor": "none"}
        mark_lane(axes, times_s, _LANE, color=alarm, **look)
    for contact in () if is_crowded else metrics.contacts:
        is_seen = contact.detected_s is not None
        look = {"markerfacecolor": alarm if is_seen else PAPER, "markeredgecolor": alarm, "markeredgewidth": 0.9}
        mark_lane(axes, [contact.at_s], _LANE, color=alarm, marker="o", markersize=10.5, **look)
        axes.annotate(
            str(contact.number),
            (contact.at_s, _LANE),
            xycoords=("data", "axes fraction"),
            ha="center",
            va="center_baseline",
            fontsize=7.0,
            fontweight="bold",
            color=PAPER if is_seen else alarm,
        )
    if metrics.false_alarms_s:
        mark_lane(axes, metrics.false_alarms_s, _LANE, marker="x", markersize=8, color=alarm, markeredgewidth=1.8)


def parameter_label(name: str) -> str:
    """Write a parameter's name as mathematics: F_v1 as F with the index v1."""
    stem, index = (name[0], name[1:]) if "_" not in name else name.split("_", 1)
    letters = index.rstrip("0123456789")
    digits = index[len(letters) :]
    inner = rf"\mathrm{{{letters}}}{digits}" if letters else digits
    return rf"${stem}_{{{inner}}}$"


def adaptation(run: Run, metrics: Metrics, section: Section, number: int) -> Drawing:
    """Draw figure 6 or 7: each parameter over one adaptation, and the residual that ends it."""
    names = run.parameter_names
    columns = 4
    lines = -(-(len(names) + 1) // columns)
    figure = Figure(figsize=(10.0, 0.35 + 2.05 * lines))
    grid = figure.subplots(lines, columns, squeeze=False)
    height = figure.get_figheight()
    figure.subplots_adjust(
        left=0.05, right=0.985, bottom=0.5 / height, top=1.0 - 0.33 / height, wspace=0.32, hspace=0.45
    )
    panels = list(grid.flat)
    time_s = run.time_s() - section.start_s
    after_s = 0.08 * section.duration_s
    rows = (time_s >= 0.0) & (time_s <= section.duration_s + after_s)
    if not rows.any():
        rows[-1] = True
    identified = metrics.parameters[section.label]
    for column, name in enumerate(names):
        axes = panels[column]
        true, final = identified[name]
        if true is not None:
            axes.axhline(true, color=COLOURS["ink"], linewidth=0.9, dashes=(4, 2.5))
        if run.certified is not None:
            std = run.certified.theta_std[rows, column]
            for sign in (-1.0, 1.0):
                level = run.theta_hat[rows, column] + sign * std
                plot(axes, time_s[rows], level, PANEL_BINS, color=COLOURS["identified"], linewidth=0.6, dashes=(1, 1.6))
        plot(axes, time_s[rows], run.theta_hat[rows, column], PANEL_BINS, color=COLOURS["identified"], linewidth=1.3)
        _head(axes, name, true, final)
        _fit(axes, run.theta_hat[rows, column], true)
    _ending(panels[len(names)], run, rows, time_s)
    for axes in panels[len(names) + 1 :]:
        axes.set_axis_off()
    for axes in panels[: len(names) + 1]:
        axes.set_xlim(0.0, max(section.duration_s + after_s, 1e-3))
        axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        if section.is_complete:
            axes.axvspan(0.0, section.duration_s, color=COLOURS["adaptation"], linewidth=0.0, zorder=0, alpha=0.55)
            axes.axvline(section.duration_s, color=COLOURS["muted"], linewidth=0.8, zorder=1)
    label_below(figure, "time since the adaptation began, s")
    ordinal = ("first", "second", "third", "fourth", "fifth")[number] if number < 5 else f"{number + 1}th"
    payload_kg = metrics.payload_kg[section.label]
    payload = "" if payload_kg is None else f", {payload_kg:g} kg payload" if payload_kg else ", no payload"
    title = f"Figure {6 + number} — model identification" if has_paper(metrics) else "Model identification"
    truth = "dashed the true values; " if identified and next(iter(identified.values()))[0] is not None else ""
    end = _end_text(section, metrics)
    band = "dotted one standard deviation of each; " if run.certified is not None else ""
    return Drawing(
        f"fig{6 + number}",
        f"{title}, {ordinal} adaptation (section {section.label}{payload})",
        f"Identified parameters over time, {truth}{band}{end}.",
        figure,
    )


def _end_text(section: Section, metrics: Metrics) -> str:
    """Say how an adaptation ended."""
    if not section.is_complete:
        return "it did not end"
    test_s = None if metrics.evidence is None else metrics.evidence.test_s[section.label]
    if test_s is None:
        return f"it ended after {section.duration_s:.2f} s, when the residual had stayed within β for T"
    return (
        f"frozen after {section.duration_s - test_s:.2f} s, and certified after {test_s:.2f} s more of motion that it "
        "was not fitted to"
    )


def _head(axes: Axes, name: str, true: float | None, final: float) -> None:
    axes.set_title(f"{parameter_label(name)}", fontsize=10.5)
    text = f"{final:.4f}"
    if true:
        text += f"  ({100.0 * (final - true) / true:+.1f} %)".replace("-", "−")
    note(axes, f"{text}  {PARAMETER_UNITS[name]}")


def _fit(axes: Axes, values: Vector, true: float | None) -> None:
    """Fit the ordinate, zero and the true value inside, so that a small error looks small."""
    levels = np.append(values[np.isfinite(values)], [0.0, true or 0.0])
    low, high = float(levels.min()), float(levels.max())
    span = max(high - low, 1e-6)
    axes.set_ylim(low - 0.08 * span, high + 0.1 * span)
    axes.yaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))


def _ending(axes: Axes, run: Run, rows: NDArray[np.bool_], time_s: Vector) -> None:
    """Draw the larger residual of both joints against β, on a logarithmic ordinate."""
    largest = np.abs(run.tau_ext_hat[rows]).max(axis=1)
    is_certified = run.certified is not None
    beta_Nm = run.settings.certified.beta_Nm if is_certified else run.settings.termination.beta_Nm
    axes.set_yscale("log")
    plot(axes, time_s[rows], np.maximum(largest, 1e-4), PANEL_BINS, color=COLOURS["muted"], linewidth=0.8)
    axes.axhline(beta_Nm, color=COLOURS["alarm"], linewidth=0.9, dashes=(4, 2.5))
    high = float(np.nanmax(largest, initial=beta_Nm))
    axes.set_ylim(1e-3, max(3.0 * high, 5.0 * beta_Nm))
    axes.minorticks_off()
    label_decades(axes.yaxis)
    testing = np.flatnonzero(rows & (run.state == SchemeState.CERTIFY))
    if testing.size:
        axes.axvline(time_s[testing[0]], color=COLOURS["muted"], linewidth=0.8)
    axes.set_title("test" if is_certified else "eq. (15)")
    note(axes, f"residual, β = {beta_Nm:g} Nm")


def close_ups(run: Run, metrics: Metrics) -> Drawing:
    """Draw each contact's residuals around its onset, with threshold, onset and detection."""
    contacts = metrics.contacts[:CLOSE_UPS]
    columns = 4
    lines = -(-len(contacts) // columns)
    figure = Figure(figsize=(10.0, 0.75 + 1.85 * lines))
    grid = figure.subplots(lines, columns, squeeze=False)
    height = figure.get_figheight()
    figure.subplots_adjust(
        left=0.05, right=0.985, bottom=0.45 / height, top=1.0 - 0.62 / height, wspace=0.22, hspace=0.42
    )
    time_s = run.time_s()
    view = _view(run)
    beside = shown_beside(metrics)
    theirs = {} if beside is None else {contact.number: contact.detected_s for contact in beside.contacts}
    for contact, axes in zip(contacts, grid.flat, strict=False):
        _close_up(axes, run, contact, time_s, view, theirs.get(contact.number))
    for axes in list(grid.flat)[len(contacts) :]:
        axes.set_axis_off()
    label_below(figure, "time since onset, ms" if run.truth else "time since detection, ms")
    handles, labels = grid.flat[0].get_legend_handles_labels()
    legend_above(figure, handles, labels, height)
    more = f" The first {CLOSE_UPS} of {len(metrics.contacts)}." if len(metrics.contacts) > CLOSE_UPS else ""
    ideal = "; dotted, the true torque through the same filter" if run.truth is not None else ""
    if run.certified is not None:
        ideal = f", filter of {view.a_rad_s:g} rad/s{ideal}; dashed, where the paper's scheme detects"
    caption = f"Estimated external torque of both joints, Nm, around each contact{ideal}.{more}"
    return Drawing("contacts", "Contacts close up", caption, figure)


class _CloseUp(NamedTuple):
    """The residual that close-ups show (n, 2), with its threshold (n, 2) and its filter's cut-off."""

    tau_ext_hat: Vector
    threshold: Vector
    a_rad_s: float


def _view(run: Run) -> _CloseUp:
    """Choose the fastest bare channel of the bank, or the paper's one."""
    if run.certified is None:
        fixed = np.broadcast_to(np.array(run.settings.detector.threshold_Nm), run.tau_ext_hat.shape)
        return _CloseUp(run.tau_ext_hat, fixed, run.a_rad_s)
    cutoff, _ = channels_of(run.settings)[-1]
    return _CloseUp(run.certified.tau_ext[:, -1], run.certified.threshold[:, -1], cutoff)


def _close_up(
    axes: Axes, run: Run, contact: ReportedContact, time_s: Vector, view: _CloseUp, paper_detected_s: float | None
) -> None:
    at_s = contact.at_s
    delay_s = (contact.delay_ms or 0.0) * 1e-3
    after_s = max(_AFTER_S, 2.0 * delay_s)
    if contact.detected_s is None and contact.end_s is not None and contact.onset_s is not None:
        after_s = max(after_s, min(1.0, 1.5 * (contact.end_s - contact.onset_s)))
    rows = (time_s >= at_s - _BEFORE_S) & (time_s <= at_s + after_s)
    ms = (time_s[rows] - at_s) * 1e3
    onset = view.threshold[row_at(run, at_s)]
    h = float(np.min(onset[np.isfinite(onset)], initial=max(run.settings.detector.threshold_Nm)))
    axes.axhspan(-h, h, color=COLOURS["grid"], linewidth=0.0, zorder=0.5, label="within the threshold")
    levels = [view.tau_ext_hat[rows]]
    if run.truth is not None:
        ideal_ms, ideal = _ideal(run, at_s, after_s, view.a_rad_s)
        levels.append(ideal)
    for joint in range(JOINTS):
        colour = COLOURS[f"joint{joint + 1}"]
        axes.plot(ms, view.tau_ext_hat[rows, joint], color=colour, linewidth=1.3, label=f"joint {joint + 1}")
        if run.truth is not None:
            axes.plot(ideal_ms, ideal[:, joint], color=colour, linewidth=0.9, linestyle=(0, (1, 1.6)))
    if contact.onset_s is not None:
        axes.axvline(0.0, color=COLOURS["ink"], linewidth=0.9, label="onset")
    seen_ms = (contact.detected_s - at_s) * 1e3 if contact.detected_s is not None else float("nan")
    if seen_ms > 0.0:
        axes.axvspan(0.0, seen_ms, color=COLOURS["fault"], linewidth=0.0, zorder=0)
    axes.axvline(seen_ms, color=COLOURS["alarm"], linewidth=1.2, label="detection")
    if paper_detected_s is not None:
        theirs_ms = (paper_detected_s - at_s) * 1e3
        axes.axvline(theirs_ms, color=COLOURS["beside"], linewidth=1.0, dashes=(4, 2.5), label="the paper's")
    low, high = _range(levels, h)
    margin = 0.08 * (high - low)
    axes.set_ylim(low - margin, high + margin)
    axes.set_xlim(-1e3 * _BEFORE_S, 1e3 * after_s)
    axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    axes.yaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
    _describe(axes, contact)


def _range(levels: Sequence[Vector], h: float) -> tuple[float, float]:
    """Give the smallest and the largest value, twice the threshold h at least."""
    values = np.concatenate([level.ravel() for level in levels])
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
    return min(low, -2.0 * h), max(high, 2.0 * h)


def _ideal(run: Run, onset_s: float, after_s: float, a_rad_s: float) -> tuple[Vector, Vector]:
    """Give time in ms and the true torque through the filter, Nm, around an onset."""
    truth = run.truth
    assert truth is not None
    time_s = run.truth_time_s()
    rows = np.flatnonzero((time_s >= onset_s - _BEFORE_S) & (time_s <= onset_s + after_s))
    ideal = filtered(truth.tau_ext[rows], truth.cycle[rows], run.settings.bus.period_s, a_rad_s)
    return (time_s[rows] - onset_s) * 1e3, ideal


def _describe(axes: Axes, contact: ReportedContact) -> None:
    number = f"{contact.number}"
    if contact.link is not None:
        number += f"  link {contact.link}"
    elif contact.link_detected is not None:
        number += f"  link {contact.link_detected}"
    axes.set_title(number)
    if contact.delay_ms is not None:
        text, colour = f"detected after {contact.delay_ms:.0f} ms", COLOURS["muted"]
    elif contact.detected_s is not None:
        text, colour = f"detected at {contact.detected_s:.2f} s", COLOURS["muted"]
    else:
        text, colour = why_not_found(contact.is_armed), COLOURS["alarm"]
    note(axes, text, colour)
