"""A run over time on a page: marks of the timeline, on the lanes of a drawing 1000 wide, and the curves of the run.

Lanes are states, contacts and notices. A mark carries the stretch that it
stands for, s since motion start, so that a script can enlarge the stretch; without a script the mark still shows its
words.
"""

from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np

from adacd_hil.lab.report.page import MARKS
from adacd_hil.lab.report.traces import Traces, pack_tracks, run_tracks
from adacd_hil.lab.score.metrics import Metrics, ReportedContact
from adacd_hil.lab.score.report_wording import STATE_WORDS, number_text
from adacd_hil.lab.score.run_arrays import Run, Stay, stays_of
from adacd_hil.records import SchemeState

STATE_COLOURS: Final = {
    SchemeState.ADAPT: "adaptation",
    SchemeState.CERTIFY: "certify",
    SchemeState.REACT: "react",
    SchemeState.STOPPED: "stopped",
    SchemeState.PAYLOAD: "payload",
    SchemeState.FAULT: "fault",
}
"""Variables of the page; a state that is not here has the ground's colour."""

_LEFT, _RIGHT = 78.0, 996.0
_LETTER: Final = 6.4
"""Width of a letter and room beside it."""
_NARROWEST: Final = 1.5
_APART: Final = 15.0
"""Numbers of contacts that are nearer than this would overlap."""
_DIGIT: Final = 8.0
"""Width of a digit of a number, and room beside it."""
_TICKS: Final = 12
_MOST_NOTICES: Final = 300


class Notice(NamedTuple):
    """A warning or error of the log, a fault or a false alarm, `at_s` s after motion start.

    is_bad: all but a warning.
    """

    at_s: float
    is_bad: bool
    text: str


class Mark(NamedTuple):
    """A mark on a lane: the time that it stands for, s since motion start, its words, its place on the drawing.

    look: its colour or class. label: text on it, "" for none.
    """

    from_s: float
    to_s: float
    title: str
    left: float
    width: float
    look: str
    label: str = ""


def notices_of(run: Run, metrics: Metrics) -> list[Notice]:
    """Return warnings, errors, faults and false alarms in order of time.

    Of more than `_MOST_NOTICES`, warnings are left out first, then false alarms.
    """
    notices = [
        Notice((t_ns - run.zero_ns) * 1e-9, event.level == "error", f"{event.name}: {event.message}")
        for t_ns, event in run.events
        if event.level in ("warning", "error")
    ]
    notices += [
        Notice(stay.start_s, True, STATE_WORDS[SchemeState.FAULT])
        for stay in stays_of(run)
        if stay.state is SchemeState.FAULT
    ]
    notices += [Notice(at_s, True, "false alarm") for at_s in metrics.false_alarms_s or ()]
    notices.sort(key=lambda notice: not notice.is_bad)
    return sorted(notices[:_MOST_NOTICES])


def certificates_of(run: Run) -> list[tuple[float, bool, list[str]]]:
    """Return an entry per certificate given, and one more if it was taken back.

    Each is: s since motion start, whether this is the taking back, the clauses of its message.
    """
    return [
        ((t_ns - run.zero_ns) * 1e-9, event.name == "revoked", event.message.split("; "))
        for t_ns, event in run.events
        if event.name in ("certificate", "revoked")
    ]


def state_key(run: Run) -> list[tuple[str, str]]:
    """Return (colour, name) of each coloured state that the run has been in, as a key to the timeline."""
    there = {stay.state for stay in stays_of(run)}
    return [(colour, STATE_WORDS[state]) for state, colour in STATE_COLOURS.items() if state in there]


def timeline_of(run: Run, metrics: Metrics) -> dict[str, Any] | None:
    """Return the timeline of a run, for its template, with the marks of each lane; None for a run without cycles.

    left, width: of the lanes; ticks: place and label; is_thinned: whether there are so many stays or contacts that
    narrow neighbours share a mark.
    """
    if run.state.size == 0:
        return None
    time_s, stays = run.time_s(), stays_of(run)
    scale = float(time_s[0]), max(float(time_s[-1]), float(time_s[0]) + 1e-3)
    return {
        "left": _LEFT,
        "width": _RIGHT - _LEFT,
        "states": list(_state_marks(stays, scale)),
        "contacts": list(_contact_marks(metrics, scale)),
        "notices": list(_notice_marks(notices_of(run, metrics), scale)),
        "ticks": list(_ticks(scale)),
        "is_thinned": max(len(stays), len(metrics.contacts)) > MARKS,
    }


_Scale = tuple[float, float]
"""When the drawing begins and ends, s."""


def _x(scale: _Scale, time_s: float) -> float:
    """Return the abscissa of a time on the drawing; the nearer edge for a time outside."""
    start_s, end_s = scale
    share = (time_s - start_s) / (end_s - start_s)
    return _LEFT + min(max(share, 0.0), 1.0) * (_RIGHT - _LEFT)


def _drawn_stays(stays: list[Stay], scale: _Scale) -> Iterator[list[Stay]]:
    """Yield the stays in groups, one mark each.

    Of more than MARKS stays, neighbours that together are no wider than the narrowest mark form a group.
    """
    group: list[Stay] = []
    for stay in stays:
        is_narrow = len(stays) > MARKS and _x(scale, stay.end_s) - _x(scale, stay.start_s) < _NARROWEST
        if group and (not is_narrow or _x(scale, stay.end_s) - _x(scale, group[0].start_s) > _NARROWEST):
            yield group
            group = []
        if is_narrow:
            group.append(stay)
        else:
            yield [stay]
    if group:
        yield group


def _rank(stay: Stay) -> int:
    """Return the rank of a stay's state: of stays that share a mark, the highest gives the colour; 0: no colour."""
    order = list(STATE_COLOURS)
    return 1 + order.index(stay.state) if stay.state in order else 0


def _state_marks(stays: list[Stay], scale: _Scale) -> Iterator[Mark]:
    for drawn in _drawn_stays(stays, scale):
        stay = drawn[0]._replace(state=max(drawn, key=_rank).state, end_s=drawn[-1].end_s)
        left, right = _x(scale, stay.start_s), _x(scale, stay.end_s)
        name, width = STATE_WORDS[stay.state], max(right - left, _NARROWEST)
        label = name if width > _LETTER * len(name) + 8 else ""
        margin_s = 0.05 * (stay.end_s - stay.start_s) + 0.005
        if len(drawn) > 1:
            name = f"{len(drawn)} states"
        title = f"{name}, {number_text(stay.start_s, 2)} to {number_text(stay.end_s, 2, 's')}"
        colour = STATE_COLOURS.get(stay.state, "paper")
        yield Mark(stay.start_s - margin_s, stay.end_s + margin_s, title, left, width, colour, label)


def _contact_marks(metrics: Metrics, scale: _Scale) -> Iterator[Mark]:
    labelled = drawn = -1e9
    is_crowded = len(metrics.contacts) > MARKS
    for contact in metrics.contacts:
        at_s = contact.at_s
        left = _x(scale, at_s)
        is_right = contact.detected_s is not None or not contact.is_armed
        if is_crowded and is_right and left - drawn < _NARROWEST:
            continue  # it would cover the one before
        drawn = left
        end_s = contact.end_s if contact.end_s is not None else at_s
        width = max(_x(scale, end_s) - left, 2.5)
        look = "touch" if contact.detected_s is not None else "touch missed"
        label = str(contact.number)
        if left - labelled >= max(_APART, _DIGIT * len(label)):
            labelled = left
        else:
            label = ""
        title = _contact_title(contact, at_s)
        yield Mark(at_s - 0.15, max(at_s + 0.6, end_s + 0.15), title, left, width, look, label)


def _contact_title(contact: ReportedContact, at_s: float) -> str:
    words = [f"contact {contact.number} at {number_text(at_s, 2, 's')}"]
    if contact.link is not None:
        words.append(f"on link {contact.link}")
    if contact.detected_s is None:
        words.append("missed" if contact.is_armed else "detection not armed")
    else:
        words.append(f"found on link {number_text(contact.link_detected, 0)}")
        if contact.delay_ms is not None:
            words.append(f"after {number_text(contact.delay_ms, 0, 'ms')}")
    return ", ".join(words)


def _notice_marks(notices: list[Notice], scale: _Scale) -> Iterator[Mark]:
    for at_s, is_bad, text in notices:
        title = f"{text}, at {number_text(at_s, 2, 's')}"
        yield Mark(at_s - 0.25, at_s + 0.25, title, _x(scale, at_s), 0.0, "bad" if is_bad else "warn")


def _ticks(scale: _Scale) -> Iterator[tuple[float, str]]:
    span_s = scale[1] - scale[0]
    step_s = next(
        step
        for power in range(-4, 9)
        for step in (10.0**power, 2.0 * 10.0**power, 5.0 * 10.0**power)
        if span_s / step <= _TICKS
    )
    digits = max(0, -int(np.floor(np.log10(step_s))))
    for number in range(int(np.ceil(scale[0] / step_s)), int(scale[1] / step_s) + 1):
        yield _x(scale, number * step_s), number_text(number * step_s, digits)


def traces_of(run: Run, metrics: Metrics) -> Traces | None:
    """Return the curves of a run, packed for the page's script, with states, contacts, faults, errors and false alarms.

    States without a colour are left out. None with fewer than two cycles.
    """
    if run.cycle.size < 2:
        return None
    marks = {
        "bands": [
            [round(stay.start_s, 4), round(stay.end_s, 4), STATE_COLOURS[stay.state]]
            for stay in stays_of(run)
            if stay.state in STATE_COLOURS
        ],
        "contacts": [
            [round(contact.at_s, 4), round(contact.end_s or contact.at_s, 4), contact.number]
            for contact in metrics.contacts
        ],
        "faults": [round(notice.at_s, 4) for notice in notices_of(run, metrics) if notice.is_bad],
    }
    return pack_tracks(run_tracks(run), run.settings.bus.period_s, marks)
