"""What if: other settings for the same log. What a change means, and how results are set side by side.

A key is dotted, `detector.threshold_Nm`; a value is TOML, where a word may go without quotes and a number stands for a
list of such numbers.
"""

import dataclasses
import itertools
import math
import statistics
import tomllib
import typing
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from adacd_hil.analysis.replay.replay import Replay
from adacd_hil.analysis.score.judge import found_text, why_not_found
from adacd_hil.records import PARAMETER_UNITS, SchemeState
from adacd_hil.remedies import nearest_name
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.schema import SUCCESSORS, ConfigError, parse
from adacd_hil.settings.toml_files import parse_toml, to_toml

_FACTS: Final = ("profile", "sign", "torque_offset_Nm", "torque_offset_std_Nm", "rated_torque_Nm")
"""Settings of the arm that made the numbers of a log."""
NOTE: Final = (
    "The arm in the log moved as it did, and the user asked for what was asked: what another scheme would have done "
    "about a contact, and all that would have followed from it, is not in here."
)
Row = tuple[str, ...]


def apply_settings(settings: Settings, changes: Mapping[str, str]) -> Settings:
    """Return the settings with some keys changed, each `section.key` to a TOML value.

    Raises ConfigError, of an unknown key with the nearest known one.
    """
    table = tomllib.loads(to_toml(settings))
    for key, text in changes.items():
        kind = _known_keys().get(key)
        if kind is None:
            raise ConfigError(_unknown(key))
        parts = key.split(".")
        section: dict[str, Any] = table
        for part in parts[:-1]:
            section = section.setdefault(part, {})
        section[parts[-1]] = _spread(_read_value(key, text), kind, section.get(parts[-1]))
    return parse(Settings, table)


def refuse_facts(changes: Mapping[str, str]) -> None:
    """Raise ConfigError if a key is what made the numbers of a log: no other value can be given to it afterwards."""
    facts = {f"arm.{name}" for name in _FACTS} | {"bus.period_us", "realtime.sample_period"}
    for key in changes:
        if key in facts or key.startswith("devices."):
            raise ConfigError(f"`{key}` made the numbers of the log; a replay can't change it")


def _known_keys() -> dict[str, Any]:
    """Return the type of every key."""
    return dict(_keys(Settings, ""))


def _keys(section: type[Any], prefix: str) -> Iterator[tuple[str, Any]]:
    hints = typing.get_type_hints(section)
    for field in dataclasses.fields(section):
        kind = hints[field.name]
        if dataclasses.is_dataclass(kind):
            yield from _keys(typing.cast(type[Any], kind), f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}", kind


def _unknown(key: str) -> str:
    keys = list(_known_keys())
    below = [known for known in keys if known.startswith(f"{key}.")]
    if below:
        return f"`{key}` is a section; its keys are {', '.join(below)}"
    if key in SUCCESSORS:
        return f"unknown key `{key}`; its successor is {SUCCESSORS[key]}"
    section, _, last = key.rpartition(".")
    by_name = {known.rpartition(".")[2]: known for known in reversed(keys)}
    found = nearest_name(key, keys) or by_name.get(nearest_name(last, by_name) or "")
    if found:
        return f"unknown key `{key}`; did you mean `{found}`?"
    beside = [known.rpartition(".")[2] for known in keys if section and known.rpartition(".")[0] == section]
    if beside:
        return f"unknown key `{key}`; `{section}` has {', '.join(beside)}"
    sections = dict.fromkeys(known.partition(".")[0] for known in keys)
    return f"unknown key `{key}`; it begins with a section: {', '.join(sections)}"


def _read_value(key: str, text: str) -> Any:
    try:
        return parse_toml(f"value = {text}")["value"]
    except ConfigError:
        if text and not set(text) & set("\"'[]{}=\n#"):
            return text
        raise ConfigError(f"`{key}` = {text} is not a TOML value") from None


def _spread(value: Any, kind: Any, present: Any) -> Any:
    """Let a single value stand for a list of it, as long as the one that is there."""
    if typing.get_origin(kind) is tuple and not isinstance(value, list):
        elements = [element for element in typing.get_args(kind) if element is not Ellipsis]
        count = len(present) if isinstance(present, list) else len(elements)
        return [value] * count
    return value


def keep_facts(own: Settings, other: Settings) -> Settings:
    """Return other settings with what a log says of its arm, bus and devices, and of how time went.

    Signs, torque offsets, rated torques, the contract and the sample period made the numbers of the log: no
    configuration changes them afterwards. What the motors hold without power, and how much torque depends on the place,
    are the arm's, if the log says it.
    """
    facts = {name: getattr(own.arm, name) for name in _FACTS}
    if own.arm.holding_torque_Nm is not None:
        facts["holding_torque_Nm"] = own.arm.holding_torque_Nm
    if own.arm.position_torque_Nm > 0.0:
        facts["position_torque_Nm"] = own.arm.position_torque_Nm
    realtime = dataclasses.replace(other.realtime, sample_period=own.realtime.sample_period)
    arm = dataclasses.replace(other.arm, **facts)
    return dataclasses.replace(other, arm=arm, bus=own.bus, devices=own.devices, realtime=realtime)


def parse_changes(given: Sequence[str]) -> dict[str, str]:
    """Read `key=value` of several options. Raises ConfigError."""
    changes: dict[str, str] = {}
    for text in given:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            raise ConfigError(f"{text!r} must be key=value, such as detector.threshold_Nm=0.1")
        changes[key.strip()] = value.strip()
    return changes


def parse_variations(given: Sequence[str]) -> list[dict[str, str]]:
    """Read `key=a,b,c` of several options and return every combination. Raises ConfigError."""
    lists = [[(key, value) for value in split_list(text)] for key, text in parse_changes(given).items()]
    return [dict(choice) for choice in itertools.product(*lists)]


def split_list(text: str) -> list[str]:
    """Split at the commas that are outside brackets and quotes."""
    parts, depth, quote, start = [], 0, "", 0
    for place, letter in enumerate(text):
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        elif letter in "[{":
            depth += 1
        elif letter in "]}":
            depth -= 1
        elif letter == "," and depth == 0:
            parts.append(text[start:place].strip())
            start = place + 1
    return [*parts, text[start:].strip()]


def changed_keys(before: Settings, after: Settings) -> dict[str, tuple[str, str]]:
    """Return the settings that differ, in words, by their keys."""
    tables = [_flat(tomllib.loads(to_toml(settings)), "") for settings in (before, after)]
    keys = [*tables[0], *(key for key in tables[1] if key not in tables[0])]
    words = {key: (tables[0].get(key, "unset"), tables[1].get(key, "unset")) for key in keys}
    return {key: pair for key, pair in words.items() if pair[0] != pair[1]}


def _flat(table: Mapping[str, Any], prefix: str) -> dict[str, str]:
    flat: dict[str, str] = {}
    for key, value in table.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = repr(value)
    return flat


def side_by_side(replays: Sequence[Replay]) -> list[Row]:
    """Return a row per quantity: its name, then its value in each replay."""
    rows = [("contacts detected", *map(_detected, replays))]
    if any(each.score is None for each in replays):
        rows.append(("detections at", *(_times(each, each.detections_ns) for each in replays)))
    rows += _contact_rows(replays)
    rows += [
        ("missed", *("–" if each.score is None else str(each.score.missed) for each in replays)),
        ("false alarms", *map(_false_alarms, replays)),
        ("median delay, ms", *map(_median_delay, replays)),
    ]
    for index in range(max(len(each.adaptation_s) for each in replays)):
        rows.append((f"adaptation {index + 1}, s", *(_adaptation(each, index) for each in replays)))
    for name in dict.fromkeys(itertools.chain.from_iterable(each.parameters for each in replays)):
        unit = PARAMETER_UNITS.get(name, "")
        rows.append((f"{name}, {unit}", *(_number(each.parameters.get(name)) for each in replays)))
    rows.append(("ends in", *map(_end, replays)))
    return rows


def _contact_rows(replays: Sequence[Replay]) -> list[Row]:
    contacts = [
        {contact.number: contact for contact in (each.score.contacts if each.score else ())} for each in replays
    ]
    rows = []
    for number in sorted(set().union(*contacts)):
        known = [each.get(number) for each in contacts]
        first = next(contact for contact in known if contact is not None)
        name = f"contact {number}, link {first.link}, at {replays[0].time_s(first.onset_ns):.2f} s"
        cells = (
            "–" if contact is None
            else f"after {contact.delay_ms:.1f} ms" if contact.delay_ms is not None
            else why_not_found(contact.is_armed)
            for contact in known
        )  # fmt: skip
        rows.append((name, *cells))
    return rows


def _detected(found: Replay) -> str:
    if found.score is None:
        return str(len(found.detections_ns))
    return found_text(len(found.score.delays_ms), len(found.score.contacts))


def _times(found: Replay, times_ns: Sequence[int]) -> str:
    return ", ".join(f"{found.time_s(t_ns):.2f} s" for t_ns in times_ns) or "–"


def _false_alarms(found: Replay) -> str:
    if found.score is None:
        return "–"
    times_ns = [alarm.t_ns for alarm in found.score.false_alarms]
    count = len(times_ns)
    return f"{count}, at {_times(found, times_ns[:3])}{', …' if count > 3 else ''}" if count else "0"


def _median_delay(found: Replay) -> str:
    delays = () if found.score is None else found.score.delays_ms
    return f"{statistics.median(delays):.1f}" if delays else "–"


def _adaptation(found: Replay, index: int) -> str:
    if index >= len(found.adaptation_s):
        return "–"
    took_s = found.adaptation_s[index]
    return "not finished" if took_s is None else f"{took_s:.3f}"


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.6g}"


def _end(found: Replay) -> str:
    last = found.ending
    if last is None:
        return SchemeState.INIT.name
    fault = f" ({last.fault.name})" if last.state is SchemeState.FAULT else ""
    return f"{last.state.name}{fault} since {found.time_s(last.t_ns):.2f} s"


def as_json(found: Replay) -> dict[str, Any]:
    """Give a replay in plain values; times in s since motion start."""
    return {
        "cycles": found.cycles,
        "attempts": found.attempts,
        "contacts": None
        if found.score is None
        else [
            {
                "number": contact.number,
                "link": contact.link,
                "onset_s": found.time_s(contact.onset_ns),
                "is_armed": contact.is_armed,
                "detected_s": None if contact.detected_ns is None else found.time_s(contact.detected_ns),
                "delay_ms": contact.delay_ms,
            }
            for contact in found.score.contacts
        ],
        "detections_s": [found.time_s(t_ns) for t_ns in found.detections_ns],
        "false_alarms_s": None
        if found.score is None
        else [found.time_s(alarm.t_ns) for alarm in found.score.false_alarms],
        "missed": None if found.score is None else found.score.missed,
        "adaptation_s": list(found.adaptation_s),
        "parameters": {name: value if math.isfinite(value) else None for name, value in found.parameters.items()},
        "states": [
            {
                "cycle": each.cycle,
                "time_s": found.time_s(each.t_ns),
                "from": each.previous.name,
                "to": each.state.name,
                "fault": each.fault.name,
            }
            for each in found.states
        ],
    }
