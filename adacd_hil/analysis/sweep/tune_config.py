"""The suggested configuration as TOML: what it extends, the keys that change, and where they come from, as comments."""

import json
import tomllib
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from adacd_hil import __version__
from adacd_hil.analysis.replay.what_if import apply_settings, changed_keys, keep_facts
from adacd_hil.analysis.score.score_words import delays_phrase, rate_phrase, share_phrase
from adacd_hil.analysis.sweep.tune import Candidate, Tuning, free_hours
from adacd_hil.analysis.sweep.tune_roc import Found
from adacd_hil.clock import wall_ns
from adacd_hil.settings.configuration import Settings, builtin_names, load_settings
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.toml_files import to_toml


def base_of(settings: Settings, config: str | None) -> tuple[str, Settings]:
    """Find the configuration that a suggestion extends. config: as the user named it; None: the log's own.

    Raises ConfigError when the log's own isn't one that comes with the package.
    """
    name = settings.name if config is None else config
    if config is None and name not in builtin_names():
        raise ConfigError(f"the logs' configuration {name!r} isn't built in: name its file with --config")
    return name, load_settings(name, settings.arm.profile)


def suggested_toml(tuning: Tuning, best: Candidate, base_name: str, base: Settings) -> str:
    """Write a suggestion as TOML that `load_settings` reads."""
    own = tuning.logs[0].settings
    table = tomllib.loads(to_toml(apply_settings(base, best.changes)))
    differing = [key for key in changed_keys(keep_facts(own, base), own) if key != "name"]
    lines = [*_provenance(tuning, best)]
    if differing:
        lines.append(f"the logs' settings differ from {base_name} in {', '.join(differing)}")
    text = [*(f"# {line}" for line in lines), "", f"extends = {json.dumps(base_name, ensure_ascii=False)}"]
    sections: dict[str, list[str]] = {}
    if own.arm.profile != load_settings(base_name).arm.profile:
        sections["arm"] = [f"profile = {json.dumps(own.arm.profile)}"]
    for key in changed_keys(base, apply_settings(base, best.changes)):
        section, _, last = key.rpartition(".")
        value: Any = table
        for part in key.split("."):
            value = value[part]
        sections.setdefault(section, []).append(f"{last} = {value}")
    for section, entries in sections.items():
        text += ["", f"[{section}]", *entries]
    return "\n".join(text) + "\n"


def _provenance(tuning: Tuning, best: Candidate) -> list[str]:
    date = datetime.fromtimestamp(wall_ns() // 1_000_000_000, tz=UTC).strftime("%Y-%m-%d %H:%M UTC")
    choice, tail = best.choice, best.choice.calibration
    lines = [
        f"Suggested by adacd-hil tune, version {__version__}, {date}.",
        f"From {len(tuning.logs)} logs, {sum(map(free_hours, tuning.logs)):.4f} h of motion that nobody touched:",
        *(f"  {_plain(log.path)}, SHA-256 {log.digest}, {free_hours(log):.4f} h" for log in tuning.logs),
        f"Wanted: {tuning.rate_per_h:g} false alarms per hour. Thresholds: {choice.method}, whose upper 95 % bound is "
        "the wanted rate.",
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


def _plain(path: Path) -> str:
    """Return a path without anything that would end a comment."""
    return "".join(letter if letter.isprintable() else "?" for letter in str(path))


def in_words(found: Found) -> str:
    """Say what thresholds come to in one half."""
    text = rate_phrase(found.alarms, found.hours, found.rate_bound_per_h)
    if found.contacts is None:
        return text
    return f"{text}; {share_phrase(found.delays_ms, found.contacts, found.share_bounds)}"


def outcome_in_words(candidate: Candidate) -> str:
    """Say what the replay of all logs with a candidate came to."""
    outcome = candidate.outcome
    text = f"{len(outcome.adaptation_s)} adaptations"
    if outcome.adaptation_s:
        text += f" of {min(outcome.adaptation_s):.2f} to {max(outcome.adaptation_s):.2f} s"
    if outcome.missed is None:
        return text
    return text + f", {outcome.missed} missed, {outcome.false_alarms} false alarms{delays_phrase(outcome.delays_ms)}"
