"""The page of a report, put together, and its cards of contacts."""

import math
from typing import Any, Final, NamedTuple

import numpy as np

from adacd_hil.lab.report.next_steps import next_steps, origin_words
from adacd_hil.lab.report.page import (
    TRACED_CONTACTS,
    Cell,
    Table,
    has_paper,
    left_out_text,
    make_table,
    render_page,
    shown_beside,
    shown_contacts,
    stretch_text,
    went_wrong,
)
from adacd_hil.lab.report.report_tables import (
    counted_sentence,
    data_table,
    further_table,
    margins_table,
    origin_table,
    paper_table,
    parameters_table,
    push_table,
    sections_table,
    timing_tables,
)
from adacd_hil.lab.report.run_reading import AROUND_S
from adacd_hil.lab.report.timeline import (
    certificates_of,
    notices_of,
    state_key,
    timeline_of,
    traces_of,
)
from adacd_hil.lab.score.margins import SETTLING_TIME_CONSTANTS
from adacd_hil.lab.score.metrics import Metrics, ReportedContact, ReportSource
from adacd_hil.lab.score.report_wording import (
    centimetres,
    number_text,
    pair_text,
    signs_text,
    state_words,
    uncertain_text,
    yes_text,
)
from adacd_hil.lab.score.run_arrays import Run
from adacd_hil.lab.score.run_judge import row_at
from adacd_hil.lab.score.verdict import LISTED, headlines, is_good
from adacd_hil.records import Location, Vector
from adacd_hil.score.smallest_push import PUSH_WITHIN
from adacd_hil.score.wording import NONE, why_not_found

_Point = tuple[float, float]


class Push(NamedTuple):
    """A force at right angles to a link, to be drawn as an arrow.

    share: its size over that of the strongest one reported; 0.5 where the size is not known. lever_m, from the link's
    joint, and lever_sigma_m: None where not known. Without `lever_m` the arrow points at the link's middle; without
    `lever_sigma_m` it is dashed. side: +1 toward +q, -1, or 0 where not known: no arrow.
    """

    link: int
    side: int
    share: float
    lever_m: float | None
    lever_sigma_m: float | None


class Stroke(NamedTuple):
    """A straight line of a drawing, mm, y up, and its class for the style sheet."""

    start: _Point
    end: _Point
    kind: str


def draw_arm(q: Vector, length_m: tuple[float, float], push: Push | None, description: str) -> dict[str, Any]:
    """Return a drawing of the arm, for its template, at joint angles q, rad (2,), with the arrow of a push, if any.

    Lengths of the drawing are in mm. description: of the picture, in words. Keys: view: left, top, width and height of
    the picture with y down; reach: length of both links; links: their strokes; force: strokes of arrow and spread;
    arrowhead: its corners.
    """
    angles = (float(q[0]), float(q[0] + q[1]))
    l1, l2 = (1000.0 * length for length in length_m)
    elbow = _along((0.0, 0.0), angles[0], l1)
    tip = _along(elbow, angles[1], l2)
    reach = l1 + l2
    kinds = ["link", "link"]
    if push is not None:
        kinds[push.link - 1] = "link touched"
    first, second = Stroke((0.0, 0.0), elbow, kinds[0]), Stroke(elbow, tip, kinds[1])
    force, arrowhead = ([], []) if push is None else _arrow(push, (first, second), angles, reach)
    tails = [stroke.start for stroke in force if stroke.kind.startswith("force")]
    xs, ys = zip((0.0, 0.0), elbow, tip, *tails, strict=True)
    width, height = 1.5 * reach, 1.1 * reach
    left = 0.5 * (min(xs) + max(xs)) - 0.5 * width
    top = -0.5 * (min(ys) + max(ys)) - 0.5 * height
    return {
        "description": description,
        "view": (left, top, width, height),
        "reach": reach,
        "links": (first, second),
        "force": force,
        "arrowhead": arrowhead,
    }


def _along(start: _Point, angle: float, distance: float) -> _Point:
    return (start[0] + distance * math.cos(angle), start[1] + distance * math.sin(angle))


def _arrow(
    push: Push, links: tuple[Stroke, Stroke], angles: tuple[float, float], reach: float
) -> tuple[list[Stroke], list[_Point]]:
    """Return the strokes of a force's arrow and of its place's deviation, and the corners of the arrowhead.

    Without a known side there is no arrow: no corners.
    """
    start, end, _ = links[push.link - 1]
    angle = angles[push.link - 1]
    lever = 0.5 * math.dist(start, end) if push.lever_m is None else 1000.0 * push.lever_m
    head = _along(start, angle, lever)
    strokes = []
    if push.lever_sigma_m is not None:
        spread = 1000.0 * push.lever_sigma_m
        strokes.append(Stroke(_along(start, angle, lever - spread), _along(start, angle, lever + spread), "spread"))
    if push.side == 0:
        return strokes, []
    outward = angle - push.side * 0.5 * math.pi
    tail = _along(head, outward, (0.14 + 0.22 * float(np.clip(push.share, 0.0, 1.0))) * reach)
    neck = _along(head, outward, 0.085 * reach)
    strokes.append(Stroke(tail, neck, "force" if push.lever_sigma_m is not None else "force guessed"))
    return strokes, [head, *(_along(neck, angle, side * 0.04 * reach) for side in (-1.0, 1.0))]


CARDS: Final = 48
"""Contacts with a card of their own; the table has all."""


_CONTACT_HEAD: Final = (
    "contact", "section", "link", "found on link", "first named link", "begins at s", "found after ms",
    "filter's share ms", "ideal detector ms", "direction", "direction right", "true torque Nm", "peak ratio",
)  # fmt: skip


def contacts_table(metrics: Metrics) -> Table | None:
    """Return the table of the contacts of `shown_contacts`, wrong cells marked; None without contacts.

    The delay of the paper's scheme has a column if it is shown beside.
    """
    if not metrics.contacts:
        return None
    beside = shown_beside(metrics)
    theirs = {} if beside is None else {each.number: each for each in beside.contacts}
    rows: list[list[object]] = []
    for contact in shown_contacts(metrics):
        is_found = contact.detected_s is not None
        delay = number_text(contact.delay_ms, 0) if is_found else why_not_found(contact.is_armed)
        link = number_text(contact.link_detected, 0)
        right = yes_text(contact.direction_ok)
        row: list[object] = [
            str(contact.number),
            contact.section or NONE,
            number_text(contact.link, 0),
            Cell(link, "bad") if contact.link_ok is False else link,
            number_text(contact.link_at_alarm, 0),
            number_text(contact.at_s, 3),
            delay if is_found else Cell(delay, "bad"),
            number_text(contact.law_ms, 1),
            number_text(contact.ideal_ms, 0),
            signs_text(contact.direction),
            Cell(right, "bad") if contact.direction_ok is False else right,
            pair_text(contact.tau_ext_Nm, 2),
            number_text(contact.torque_error_ratio, 2),
        ]
        if theirs:
            their = theirs[contact.number]
            row.append(number_text(their.delay_ms, 0) if their.is_armed else "not armed")
        rows.append(row)
    return make_table((*_CONTACT_HEAD, *["paper's scheme ms"][: len(theirs)]), rows, left=())


def contact_cards(metrics: Metrics, run: Run) -> list[dict[str, Any]]:
    """Return the cards of the first CARDS contacts: report with uncertainty, truth, and drawing of the arm.

    Keys: number; link: the reported one, else the true one; at_s; is_wrong; kind: words; entries: (name, text); arm:
    drawing; stretch_s: from and to which time, s since motion start, the traces of a card show.
    """
    contacts = metrics.contacts[:CARDS]
    strongest_N = max((abs(contact.force_N) for contact in contacts if contact.force_N is not None), default=0.0)
    return [_card(contact, run, strongest_N) for contact in contacts]


_PLACES: Final = {
    "KNOWN": "one contact on the link",
    "LINK_1": "only the moment is known: the least force that has it",
    "SINGULAR": "not known: the elbow stands square",
    "UNCERTAIN": "too weak for a lever arm",
    "BEYOND_TIP": "lever arm past the tip",
    "INCONSISTENT": "no single contact without friction",
    "NOT_SOUGHT": "not sought",
}


def _card(contact: ReportedContact, run: Run, strongest_N: float) -> dict[str, Any]:
    why_not = "missed" if contact.is_armed else f"detection was off: {state_words(contact.state)}"
    entries = _found(contact) if contact.detected_s is not None else [("found", why_not)]
    entries += _torques(contact)
    if contact.link is not None:
        force = number_text(contact.true_force_N, 1, "N") if contact.true_force_N is not None else NONE
        entries.append(("truth", f"link {contact.link}, {force}"))
    return {
        "number": contact.number,
        "link": contact.link if contact.link_detected is None else contact.link_detected,
        "at_s": contact.at_s,
        "stretch_s": (contact.at_s - AROUND_S[0], contact.at_s + AROUND_S[1]),
        "is_wrong": went_wrong(contact),
        "kind": _kind(contact),
        "entries": [(term, text) for term, text in entries if text != NONE],
        "arm": _arm(contact, run, strongest_N),
    }


def _kind(contact: ReportedContact) -> str:
    words = [contact.level, contact.kind if contact.kind != "UNKNOWN" else None, contact.reaction]
    kind = " · ".join(word.lower().replace("_", " ") for word in words if word)
    return kind + (" · two-sided" if contact.is_two_sided else "")


def _found(contact: ReportedContact) -> list[tuple[str, str]]:
    """Return six pairs of name and text on a contact that was found; NONE as text for a missing value."""
    lever = uncertain_text(centimetres(contact.lever_m), centimetres(contact.lever_sigma_m), 1, "cm")
    return [
        ("found after", number_text(contact.delay_ms, 0, "ms")),
        ("pushes joints 1 / 2 to", signs_text(contact.direction)),
        _force(contact),
        ("lever arm", lever),
        ("place", _PLACES.get(contact.location or "", NONE)),
        ("blind within", number_text(contact.blind_deg, 1, "°")),
    ]


def _force(contact: ReportedContact) -> tuple[str, str]:
    """Return name and text of a contact's force: NONE if none was computed, "not known" if the torques don't tell it.

    On link 1 it is a lower bound, with its deviation if known. On link 2 it is the force at right angles with its
    deviation, NONE without one.
    """
    location = Location[contact.location or Location.NOT_SOUGHT.name]
    if contact.force_N is None:
        return "force", NONE
    text = location.force_text(contact.force_N)
    if text == NONE:
        return "force", "not known"
    if location is Location.LINK_1:
        spread = contact.force_sigma_N
        return "force", f"{text} N" if spread is None else f"{text} ± {number_text(spread, 1)} N"
    return "force at right angles", uncertain_text(contact.force_N, contact.force_sigma_N, 1, "N")


def _torques(contact: ReportedContact) -> list[tuple[str, str]]:
    """Return pairs of name and text: each joint's peak torque and impulse, [] if no torque was reported.

    A peak without known deviation stands alone; an impulse without one is NONE.
    """
    unknown = (None, None)
    impulses = contact.impulse_Nm_s or unknown
    impulse_sigmas = contact.impulse_sigma_Nm_s or unknown
    peak_sigmas = contact.tau_ext_peak_sigma_Nm or unknown
    entries = []
    for joint, peak_Nm in enumerate(contact.tau_ext_peak_hat_Nm or ()):
        peak = uncertain_text(peak_Nm, peak_sigmas[joint], 2, "Nm")
        impulse = uncertain_text(impulses[joint], impulse_sigmas[joint], 3, "Nm s")
        entries.append((f"joint {joint + 1}: peak", number_text(peak_Nm, 2, "Nm") if peak == NONE else peak))
        entries.append((f"joint {joint + 1}: impulse", impulse))
    return entries


def _arm(contact: ReportedContact, run: Run, strongest_N: float) -> dict[str, Any]:
    """Return a drawing of the arm when a contact was found, or, if it was missed, when it began."""
    at_s = contact.at_s if contact.detected_s is None else contact.detected_s
    q: Vector = run.motion.q[row_at(run, at_s)]
    push = _push(contact, strongest_N, run.settings.arm.link_length_m[0])
    words = [f"Arm at contact {contact.number}", f"joints at {q[0]:.2f} and {q[1]:.2f} rad"]
    if push is not None:
        words.append(f"link {push.link} touched")
    return draw_arm(q, run.settings.arm.link_length_m, push, ", ".join(words))


def _push(contact: ReportedContact, strongest_N: float, length1_m: float) -> Push | None:
    """Return the force of a contact for the drawing; None if neither a link was found nor the true one is known.

    It is on the link that was found, else on the true one. Place and size are those reported; on link 1, of which only
    the least force is known, the place is the end of the link. Without a reported place the size is half the largest,
    and the place unknown. strongest_N: largest force to be shown. length1_m: of link 1.
    """
    link = contact.link if contact.link_detected is None else contact.link_detected
    if link is None:
        return None
    if contact.location in ("KNOWN", "LINK_1") and contact.force_N is not None:
        side = 1 if contact.force_N > 0.0 else -1
        share = abs(contact.force_N) / strongest_N if strongest_N > 0.0 else 0.0
        if contact.location == "KNOWN":
            return Push(link, side, share, contact.lever_m, contact.lever_sigma_m)
        return Push(link, side, share, length1_m, None)
    side = 0 if contact.direction is None else contact.direction[link - 1]
    return Push(link, side, 0.5, None, None)


def report_page(metrics: Metrics, run: Run, source: ReportSource) -> str:
    """Return the HTML of a run's report."""
    steps, more_steps = next_steps(metrics, run, source)
    since_ns = None if run.log_start_ns is None else run.zero_ns - run.log_start_ns
    return render_page(
        "run_page.html.j2",
        f"{_name(run, source)} – run report",
        **_heading(metrics, run, source),
        traces=traces_of(run, metrics),
        run=run,
        metrics=metrics,
        next_steps=steps,
        more_steps=more_steps,
        tiles=_tiles(metrics),
        timeline=timeline_of(run, metrics),
        state_key=state_key(run),
        notices=notices_of(run, metrics),
        certificates=certificates_of(run),
        has_paper=has_paper(metrics),
        paper=paper_table(metrics),
        sections=sections_table(metrics, run),
        margins=margins_table(metrics.evidence),
        push=push_table(metrics.evidence),
        counted=counted_sentence(metrics),
        contacts=contacts_table(metrics),
        left_out=left_out_text(metrics),
        cards=contact_cards(metrics, run),
        parameters=parameters_table(metrics, run),
        further=further_table(metrics.evidence),
        traced_contacts=TRACED_CONTACTS,
        data=data_table(metrics.data),
        timing=timing_tables(metrics.timing),
        origin=origin_table(metrics, run, source),
        settling_constants=f"{SETTLING_TIME_CONSTANTS:g}",
        settling_s=f"{SETTLING_TIME_CONSTANTS / run.settings.cutoff_rad_s:g}",
        push_within=PUSH_WITHIN,
        motion_start_s=None if since_ns is None else since_ns * 1e-9,
    )


def _name(run: Run, source: ReportSource) -> str:
    words = [run.metadata.get("config", ""), run.metadata.get("profile", "")]
    return " ".join(filter(None, words)) or source.log_name


def _heading(metrics: Metrics, run: Run, source: ReportSource) -> dict[str, Any]:
    words = origin_words(run)
    if run.stretch is not None:
        words.append(stretch_text(run.stretch))
    first, *further = headlines(metrics, source)
    return {
        "over": " · ".join(["run report", *words]),
        "headline": first,
        "is_good": is_good(metrics, source),
        "findings": further,
    }


def _tiles(metrics: Metrics) -> list[tuple[str, str, str]]:
    """Return label, number as text, and unit of each figure on the first screen; unknown figures are left out.

    They are adaptation times, the first LISTED, and false alarms; of the contacts while detection was armed: those
    found, links named rightly, and the median delay.
    """
    armed = [contact for contact in metrics.contacts if contact.is_armed]
    seen = [contact for contact in armed if contact.detected_s is not None]
    times_s = [number_text(value, 2) for value in metrics.adaptation_s.values()]
    if len(times_s) > LISTED:
        times_s = [*times_s[:LISTED], "…"]
    delays_ms = [contact.delay_ms for contact in seen if contact.delay_ms is not None]
    links = [contact for contact in seen if contact.link is not None]
    right = sum(contact.link_ok is True for contact in links)
    found = f"{len(seen)} of {len(armed)}" if metrics.missed is not None else str(len(seen))
    if not armed and not metrics.contacts:
        found = NONE
    is_watched = any(section.kind == "detection" for section in metrics.sections) or bool(metrics.false_alarms)
    tiles = [
        ("model learned in", " · ".join(times_s) or NONE, "s"),
        ("contacts found", found, ""),
        ("false alarms", str(metrics.false_alarms) if is_watched and metrics.false_alarms is not None else NONE, ""),
        ("link named rightly", f"{right} of {len(links)}" if links else NONE, ""),
        ("found after, median", number_text(float(np.median(delays_ms)), 1) if delays_ms else NONE, "ms"),
    ]
    return [tile for tile in tiles if tile[1] != NONE]
