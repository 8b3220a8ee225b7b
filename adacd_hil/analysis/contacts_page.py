"""The contacts of a run on a page: a table, and a card for each that has been told of."""

from collections.abc import Sequence
from html import escape
from typing import Final

from adacd_hil.analysis.metrics import Contact, Metrics
from adacd_hil.analysis.page import NONE, Cell, make_table, number_text
from adacd_hil.analysis.report_words import contact_rows, scaled, uncertain_text


def contacts_table(metrics: Metrics) -> str:
    """Write a row per contact, marked where something went wrong."""
    if not metrics.contacts:
        return '<p class="note">None.</p>'
    rows: list[Sequence[Cell]] = []
    head, words = contact_rows(metrics)
    for contact, row in zip(metrics.contacts, words, strict=True):
        cells: list[Cell] = [escape(word) for word in row]
        if contact.detected_s is None:
            cells[6] = (str(cells[6]), "bad")
        if contact.link is not None and contact.link_detected not in (None, contact.link):
            cells[3] = (str(cells[3]), "bad")
        if contact.direction_ok is False:
            cells[10] = (str(cells[10]), "bad")
        rows.append(cells)
    note = ""
    if metrics.false_alarms_s:
        times = ", ".join(number_text(time_s, 3) for time_s in metrics.false_alarms_s)
        note = f'<p class="note bad">False alarms at {times} s.</p>'
    return make_table(head, rows, left=()) + note


def contact_cards(metrics: Metrics) -> str:
    """Write what the reports say of each contact, with its uncertainty and the truth."""
    told = [contact for contact in metrics.contacts if contact.location is not None]
    return f'<div class="cards">{"".join(map(_card, told))}</div>' if told else ""


_PLACES: Final = {
    "KNOWN": "one contact on the link",
    "LINK_1": "only the moment is known: the least force that has it",
    "SINGULAR": "not known: the elbow stands square",
    "UNCERTAIN": "too weak for a lever arm",
    "BEYOND_TIP": "lever arm past the tip",
    "INCONSISTENT": "no single contact without friction",
}


def _card(contact: Contact) -> str:
    words = [contact.level, contact.kind if contact.kind != "UNKNOWN" else None, contact.reaction]
    kind = " · ".join(word.lower().replace("_", " ") for word in words if word)
    if contact.is_two_sided:
        kind += " · two-sided"
    lever_m, sigma_m = contact.lever_m, contact.lever_sigma_m
    lever = uncertain_text(scaled(lever_m, 100.0), scaled(sigma_m, 100.0), 1, "cm")
    true_force = "" if contact.true_force_N is None else f", true {number_text(contact.true_force_N, 1)}"
    entries = [
        ("found after", number_text(contact.delay_ms, 0, "ms")),
        ("force", uncertain_text(contact.force_N, contact.force_sigma_N, 1, "N") + true_force),
        ("lever arm", lever),
        ("place", _PLACES.get(contact.location or "", NONE)),
        ("blind within", number_text(contact.blind_deg, 1, "°")),
    ]
    peaks, peak_sigmas = contact.tau_ext_peak_hat_Nm or (), contact.tau_ext_peak_sigma_Nm or ()
    impulses, impulse_sigmas = contact.impulse_Nm_s or (), contact.impulse_sigma_Nm_s or ()
    for joint in range(len(peaks)):
        peak = uncertain_text(peaks[joint], peak_sigmas[joint], 2, "Nm")
        impulse = uncertain_text(impulses[joint], impulse_sigmas[joint], 3, "Nm s")
        entries.append((f"joint {joint + 1}", f"peak {peak}, impulse {impulse}"))
    link = number_text(contact.link_detected, 0)
    items = "".join(f"<dt>{escape(term)}</dt><dd>{escape(text)}</dd>" for term, text in entries)
    return f"<div><h3>{contact.number}  link {link}</h3><p>{escape(kind)}</p><dl>{items}</dl></div>"
