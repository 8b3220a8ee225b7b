"""Thresholds, filter and gain found from logs: candidates, how each is judged, which one is suggested, as TOML.

One half of the logs gives each candidate its thresholds for the wanted rate of false alarms: those at which the tail's
upper bound is that rate. Then the logs are replayed with the candidate and its thresholds. A candidate is fit if
it adapts as often as the logs' own settings do, misses no contact for which those were armed, and has no more false
alarms than the wanted rate allows. The suggestion is the fit candidate with the smallest median delay.
If a wanted rate is extrapolated too far, the bounds of the tails differ more by chance than by candidate: then filter
and gain stay as they are. They also stay without the truth, because delays are unknown: only thresholds are found.

The suggestion names the configuration that it extends and the keys that change, with their origin as comments. Figures
show the share of contacts found against false alarms, and the delays.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from adacd_hil import __version__
from adacd_hil.clock import wall_ns
from adacd_hil.lab.drawing import COLOURS, Drawing, note, style, write_figures
from adacd_hil.lab.score.rates import CONFIDENCE_TEXT, least_rate_per_h
from adacd_hil.lab.score.report_wording import delay_figures, delays_phrase
from adacd_hil.lab.thresholds.false_alarms import TooLittleMotionError
from adacd_hil.lab.tune.tune_candidates import (
    candidates,
    name_of,
    observe_candidates,
    observe_detectors,
    thresholds_as_changes,
)
from adacd_hil.lab.tune.tune_roc import (
    Candidate,
    Changes,
    Choice,
    Found,
    TunedLog,
    Tuning,
    TuningOutcome,
    choose,
    free_hours,
    read_logs,
    tuning_by_key,
)
from adacd_hil.log.logged_run import Progress
from adacd_hil.log.time_window import TimeWindow
from adacd_hil.printable import number_of
from adacd_hil.replay.replay import replay_many
from adacd_hil.replay.replayed_outcome import Replay
from adacd_hil.score.wording import found_text
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.setting_keys import apply_settings, changed_keys, keep_log_settings
from adacd_hil.settings.toml_files import builtin_names
from adacd_hil.settings.toml_text import toml_value

FARTHEST: Final = 100.0
"""Extrapolation beyond which filters and gains are not ranked: thresholds of equal ones differ by a factor of 4."""


def tune(
    paths: Sequence[Path],
    rate_per_h: float,
    config: str | None,
    progress: Progress,
    stretch: TimeWindow,
) -> Tuning:
    """Find thresholds, filter and gain for a rate of false alarms from logs; write no file.

    If no log records the true contacts, or the rate is extrapolated more than FARTHEST-fold, filter and gain stay as
    they are. config: name or file of the settings to start from; None: the logs' own. stretch: of each log; the replays
    begin with the log, and only their results in the stretch count. Raises TooLittleMotionError if the half to choose
    on has no free motion with the settings to start from; LogError, ConfigError or CodecError if a log, its settings or
    its contract can't be used; DetectorError if a registered detector can't be used.
    """
    progress(f"reading {number_of(len(paths), 'log')}")
    logs = read_logs(paths, config, stretch, progress)
    unknown = [str(log.path) for log in logs if log.windows is None]
    has_truth = len(unknown) < len(logs)
    notes = [f"the true contacts of {', '.join(unknown)} are not known: an alarm of such a run counts as a contact, "
             "and none as missed or false"] * bool(unknown)  # fmt: skip
    detectors: list[Choice] = []
    try:
        detectors = [choose(observed, rate_per_h) for observed in observe_detectors(logs, progress)]
    except TooLittleMotionError as error:
        notes.append(f"the detectors can't be compared: {error}")
    tried = candidates(logs[0].settings) if has_truth else [{}]
    settings = logs[0].settings
    chosen = _choices(logs, tried, rate_per_h, progress, notes)
    changes = [
        filter_and_gain | thresholds_as_changes(apply_settings(settings, filter_and_gain), choice.thresholds)
        for filter_and_gain, choice in chosen
    ]
    own, *outcomes = replay_all(logs, [{}, *changes], progress)
    notes += own.notes
    judged = [
        Candidate(name_of(filter_and_gain), change, choice, outcome, problems_of(choice, outcome, own, rate_per_h))
        for (filter_and_gain, choice), change, outcome in zip(chosen, changes, outcomes, strict=True)
    ]
    if len(judged) > 1 and judged[0].choice.extrapolation > FARTHEST:
        notes.append(f"a rate of {rate_per_h:g} per hour is too far from this motion to choose filter and gain by it")
    return Tuning(rate_per_h, tuple(logs), own, tuple(judged), best_of(judged), tuple(detectors), tuple(notes))


def _choices(
    logs: Sequence[TunedLog],
    tried: Sequence[Changes],
    rate_per_h: float,
    progress: Progress,
    notes: list[str],
) -> list[tuple[Changes, Choice]]:
    """Return the filters and gains of `tried` that show free motion, each with its choice of thresholds.

    Those without are dropped, with a line in `notes`. Raises TooLittleMotionError if the unchanged settings, {}, have
    none.
    """
    chosen = []
    for changes, observed in zip(tried, observe_candidates(logs, tried, progress), strict=True):
        try:
            chosen.append((changes, choose(observed, rate_per_h)))
        except TooLittleMotionError as error:
            if not changes:
                raise TooLittleMotionError(f"{error}, with the settings to start from") from None
            notes.append(f"{name_of(changes)}: {error}")
    return chosen


def replay_all(logs: Sequence[TunedLog], variants: Sequence[Changes], progress: Progress) -> list[TuningOutcome]:
    """Replay all logs with each variant of the settings; return the outcome of each, in their order.

    variants: changed settings, {} for the logs' own. Raises LogError, ConfigError or CodecError if a log, a variant or
    a contract can't be used.
    """
    by_log = []
    for log in logs:
        progress(f"replaying {log.path} with the thresholds found")
        settings = [apply_settings(log.settings, changes) for changes in variants]
        by_log.append(replay_many(log.path, settings, progress, stretch=log.stretch))
    return [_outcome(logs, replays) for replays in zip(*by_log, strict=True)]


def _outcome(logs: Sequence[TunedLog], replays: Sequence[Replay]) -> TuningOutcome:
    """Return one outcome of all logs' replays with one variant; contacts count where the logged scheme was armed."""
    took_s = [each for found in replays for each in found.adaptation_s]
    judged = [(found, found.score) for found in replays if found.score is not None]
    armed = {(log.path, window.number) for log in logs for window in log.windows or () if window.is_armed}
    contacts = [
        contact
        for log, found in zip(logs, replays, strict=True)
        if found.score is not None
        for contact in found.score.contacts
        if (log.path, contact.number) in armed
    ]
    delays = [contact.delay_ms for contact in contacts if contact.delay_ms is not None]
    return TuningOutcome(
        adaptation_s=tuple(each for each in took_s if each is not None),
        unfinished=sum(each is None for each in took_s),
        missed=len(armed) - len(delays) if judged else None,
        false_alarms=sum(len(score.false_alarms) for _, score in judged) if judged else None,
        hours=sum(found.monitored_s for found, _ in judged) / 3600.0,
        delays_ms=tuple(delays),
        armed_false_alarms=sum(score.armed_false_alarms for _, score in judged),
        notes=tuple(f"{log.path}: {note}" for log, found in zip(logs, replays, strict=True) for note in found.notes),
    )


def problems_of(choice: Choice, outcome: TuningOutcome, own: TuningOutcome, rate_per_h: float) -> tuple[str, ...]:
    """Return the reasons why a candidate is not fit, a few words each; () if it is.

    It is fit with a tail, as many finished adaptations as `own`, and no missed contact. The lower bound of its false
    alarms' rate must not exceed `rate_per_h`, neither in the half to check on nor in the replay. own: outcome of the
    unchanged settings.
    """
    problems = []
    if choice.calibration is None:
        problems.append("too little motion for a tail")
    if len(outcome.adaptation_s) < len(own.adaptation_s):
        problems.append(f"{len(own.adaptation_s) - len(outcome.adaptation_s)} adaptations don't finish")
    if outcome.missed:
        problems.append(f"{outcome.missed} missed")
    if least_rate_per_h(choice.checked.alarms, choice.checked.hours) > rate_per_h:
        problems.append(f"{choice.checked.alarms} false alarms in the half to check on")
    elif least_rate_per_h(outcome.armed_false_alarms, outcome.hours) > rate_per_h:
        problems.append(f"{outcome.armed_false_alarms} false alarms")
    return tuple(problems)


def best_of(judged: Sequence[Candidate]) -> Candidate | None:
    """Return the candidate with the smallest median delay in the half to choose on, without problems; None without one.

    judged: at least one, that of the logs' filter and gain first. If the rate is extrapolated more than FARTHEST-fold,
    only this one is considered.
    """
    looked_at = judged[:1] if judged[0].choice.extrapolation > FARTHEST else judged
    fit = [candidate for candidate in looked_at if not candidate.problems]
    return min(fit, key=_delays, default=None)


def _delays(candidate: Candidate) -> tuple[float, ...]:
    """Return the sort key of a candidate: median, 90th percentile and largest delay, ms, in the half to choose on.

    inf if no contact was found.
    """
    figures = delay_figures(candidate.choice.chosen.delays_ms)
    return tuple(math.inf if each is None else each for each in figures.values())


def base_of(settings: Settings, config: str | None) -> tuple[str, Settings]:
    """Return name and settings of the configuration that a suggestion extends.

    settings: of the log. config: as the user named it; None: the one that `settings` name. In both cases it gets the
    arm profile of `settings`. Raises ConfigError if `config` is None and the one that `settings` name isn't built in,
    or if the configuration can't be read.
    """
    name = settings.name if config is None else config
    if config is None and name not in builtin_names():
        raise ConfigError(f"the logs' configuration {name!r} isn't built in: name its file with --config")
    return name, load_settings(name, settings.arm.profile)


def suggested_toml(tuning: Tuning, best: Candidate, base_name: str, base: Settings) -> str:
    """Return a suggestion as TOML that `load_settings` reads: the changed keys, with their origin in comments.

    The arm profile of the logs is added if that configuration has another. base_name, base: of the configuration that
    it extends, as from `base_of`. Raises ConfigError if it can't be read.
    """
    own = tuning.logs[0].settings
    differing = [key for key in changed_keys(keep_log_settings(own, base), own) if key != "name"]
    lines = [*_provenance(tuning, best)]
    if differing:
        lines.append(f"the logs' settings differ from {_plain(base_name)} in {', '.join(differing)}")
    text = [*(f"# {line}" for line in lines), "", f"extends = {toml_value(base_name)}"]
    sections: dict[str, list[str]] = {}
    if own.arm.profile != load_settings(base_name).arm.profile:
        sections["arm"] = [f"profile = {toml_value(own.arm.profile)}"]
    for key, (_, value) in changed_keys(base, apply_settings(base, best.changes)).items():
        section, _, last = key.rpartition(".")
        sections.setdefault(section, []).append(f"{last} = {value}")
    for section, entries in sections.items():
        text += ["", f"[{section}]", *entries]
    return "\n".join(text) + "\n"


def _provenance(tuning: Tuning, best: Candidate) -> list[str]:
    """Return lines on the origin of a suggestion: date, logs, method, its effect on both halves, and in a replay."""
    date = datetime.fromtimestamp(wall_ns() // 1_000_000_000, tz=UTC).strftime("%Y-%m-%d %H:%M UTC")
    choice, tail = best.choice, best.choice.calibration
    lines = [
        f"Suggested by adacd-hil tune, version {__version__}, {date}.",
        f"From {len(tuning.logs)} logs, {sum(map(free_hours, tuning.logs)):.4f} h of motion that nobody touched:",
        *(f"  {_plain(str(log.path))}, SHA-256 {log.digest}, {free_hours(log):.4f} h" for log in tuning.logs),
        f"Wanted: {tuning.rate_per_h:g} false alarms per hour. Thresholds: {choice.method}, whose upper "
        f"{CONFIDENCE_TEXT} bound is the wanted rate.",
    ]
    if tail is not None:
        lines.append(f"  The tail is fitted to {tail.tail.count} peaks of {tail.tail.hours:.4f} h.")
    lines += [
        f"Chosen on:  {in_words(choice.chosen)}",
        f"Checked on: {in_words(choice.checked)}",
        "Counted alone, the wanted rate is "
        + ("shown." if tuning.is_shown else "not shown: that needs 3 / rate hours without an alarm."),
        f"Replayed with these settings: {outcome_in_words(best)}",
    ]
    return lines


def _plain(name: str) -> str:
    """Return a text with "?" in place of letters that aren't printable, which might end a comment."""
    return "".join(letter if letter.isprintable() else "?" for letter in name)


def in_words(found: Found) -> str:
    """Return the effect of thresholds as a phrase: false alarms, hours, upper bound of the rate.

    If the contacts are known, also those found, the bounds of their share, and the delays.
    """
    bound = f"{CONFIDENCE_TEXT} bound {found.rate_bound_per_h:.3g} per hour"
    text = f"{found.alarms} false alarms in {found.hours:.4f} h, {bound}"
    if found.contacts is None:
        return text
    low, high = found.share_bounds
    share = f"{found_text(len(found.delays_ms), found.contacts)} contacts found ({100 * low:.0f} to {100 * high:.0f} %)"
    return f"{text}; {share}{delays_phrase(found.delays_ms)}"


def slowest_adaptation(outcome: TuningOutcome) -> str:
    """Return the longest adaptation, s, as text such as "12.34".

    Without any: "not finished" if the replayed motion has one that did not end, else "not looked at".
    """
    if outcome.adaptation_s:
        return f"{max(outcome.adaptation_s):.2f}"
    return "not finished" if outcome.unfinished else "not looked at"


def outcome_in_words(candidate: Candidate) -> str:
    """Return a phrase on the replay of all logs with a candidate: adaptations, misses, false alarms, delays.

    Without the truth it names the adaptations alone.
    """
    outcome = candidate.outcome
    slowest = slowest_adaptation(outcome)
    text = f"adaptation {slowest}"
    if outcome.adaptation_s:
        text = f"{len(outcome.adaptation_s)} adaptations of {min(outcome.adaptation_s):.2f} to {slowest} s"
    if outcome.missed is None:
        return text
    return text + f", {outcome.missed} missed, {outcome.false_alarms} false alarms{delays_phrase(outcome.delays_ms)}"


_LOOKS: Final = tuple(
    itertools.product(("-", "--", "-."), ("identified", "cad", "joint1", "joint2", "bar", "beside", "ink", "muted"))
)
"""Lines and colours of the detectors; the suggestion has its own colour."""

_LEAST_RATE: Final = 1e-6
"""Per hour; predictions of the model below this are not drawn, because they can't be checked."""


@contextmanager
def _axes(title: str) -> Iterator[tuple[Figure, Axes]]:
    """Yield a figure and its axes with a title; at the block's end, add a legend at the right."""
    with style():
        figure = Figure(figsize=(10.0, 4.6))
        axes = figure.subplots()
        figure.subplots_adjust(left=0.065, right=0.72, bottom=0.12, top=0.9)
        axes.set_title(title)
        yield figure, axes
        axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0))


def _curves(tuning: Tuning) -> Iterator[tuple[Choice, dict[str, Any]]]:
    """Yield each choice and its line's style and label: the suggestion first, then the detectors.

    Without a suggestion, the logs' own filter comes first. Looks repeat if there are more detectors than `_LOOKS`.
    """
    scheme = tuning.best or tuning.candidates[0]
    yield scheme.choice, {"color": COLOURS["alarm"], "linewidth": 2.0, "label": f"scheme: {scheme.name}"}
    for choice, (line, colour) in zip(tuning.detectors, itertools.cycle(_LOOKS), strict=False):
        yield choice, {"color": COLOURS[colour], "linestyle": line, "linewidth": 1.1, "label": choice.name}


def draw_roc(tuning: Tuning) -> Drawing:
    """Draw the share of contacts found against the bound of the false-alarm rate that was counted.

    Add the tail's predictions as dotted lines, and the interval of the first curve's share as a band. Without the
    truth, draw only that bound against the factor on the thresholds.
    """
    title = "False alarms and contacts found"
    with _axes(title) as (figure, axes):
        for place, (choice, look) in enumerate(_curves(tuning)):
            found = [each for _, each, _ in choice.roc]
            bounds = np.array([each.rate_bound_per_h for each in found])
            if found[0].contacts is None:
                axes.plot([factor for factor, _, _ in choice.roc], bounds, **look)
                continue
            shares = np.array([len(each.delays_ms) / max(each.contacts or 0, 1) for each in found])
            axes.plot(bounds, 100.0 * shares, marker="o", markersize=3.0, **look)
            predicted = [np.nan if rate is None or rate < _LEAST_RATE else rate for _, _, rate in choice.roc]
            axes.plot(predicted, 100.0 * shares, **(look | {"linestyle": ":", "label": None}))
            if place == 0:
                low, high = np.array([each.share_bounds for each in found]).T
                axes.fill_between(bounds, 100.0 * low, 100.0 * high, color=look["color"], alpha=0.12, linewidth=0.0)
        has_truth = tuning.candidates[0].choice.chosen.contacts is not None
        bound_label = f"false alarms per hour, upper {CONFIDENCE_TEXT} bound of what was counted"
        if has_truth:
            axes.set(xscale="log", ylim=(-3.0, 103.0), xlabel=bound_label, ylabel="contacts found, %")
        else:
            axes.set(xscale="log", yscale="log", xlabel="factor on the thresholds", ylabel=bound_label)
        note(axes, "counted where nothing was chosen; dotted: the tail model's prediction")
    hours = tuning.candidates[0].choice.checked.hours
    caption = (
        f"All thresholds of a detector times one factor. {hours:.3f} h without an alarm leave a bound of "
        f"{3.0 / hours:.3g} per hour, further left nothing can be counted."
        if hours > 0.0
        else "All thresholds of a detector times one factor."
    )
    return Drawing("roc", title, caption, figure)


def draw_delays(tuning: Tuning) -> Drawing:
    """Draw the share of contacts found against the time since onset, at the chosen thresholds. Needs the truth."""
    title = "Delay at the chosen thresholds"
    with _axes(title) as (figure, axes):
        for choice, look in _curves(tuning):
            delays = sorted((*choice.chosen.delays_ms, *choice.checked.delays_ms))
            contacts = (choice.chosen.contacts or 0) + (choice.checked.contacts or 0)
            shares = 100.0 * np.arange(len(delays) + 1) / max(contacts, 1)
            axes.step([0.0, *delays], shares, where="post", **look)
        axes.set(ylim=(-3.0, 103.0), xlabel="time since the onset, ms", ylabel="contacts found, %")
        note(axes, f"for {tuning.rate_per_h:g} false alarms per hour")
    caption = "Contacts of all logs; what a curve lacks to 100 % is never found."
    return Drawing("delays", title, caption, figure)


def write_tuning(tuning: Tuning, out_dir: Path) -> tuple[Path, ...]:
    """Write tune.json, and the figures as PNG and SVG, into a folder; return their paths.

    Without a contact to choose on, the figure of delays is left out. Raises LogError if they can't be written.
    """
    drawings = [draw_roc(tuning)]
    if tuning.candidates[0].choice.chosen.contacts:
        drawings.append(draw_delays(tuning))
    return write_figures(out_dir, "tune", tuning_by_key(tuning), drawings)
