"""What the paper's scheme made of the same stream, where it ran beside the certified one.

It adapts when that one does, ends by eq. (15) and compares with its own thresholds, but decides nothing: a contact that
is reacted to has been found by the other. So a *detection* of it is the first sample over its threshold, while it is
armed, that a true contact explains; a *false alarm* is one that none explains, counted once in 10 time constants. While
the payload is changed it does not detect.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adacd_hil.analysis.run import Mask, PaperStream, Run
from adacd_hil.analysis.sections import Section, rows_of
from adacd_hil.analysis.touches import Touch, forgotten_s, row_at
from adacd_hil.records import Vector

SETTLING_TIME_CONSTANTS = 10.0
"""Time constants of a filter after which a contact counts as forgotten; e^-10 of 5 Nm is 0.2 mNm."""


@dataclass(frozen=True)
class BesideContact:
    """A true contact as the paper's scheme would have seen it; number as in the list of contacts."""

    number: int
    is_armed: bool
    detected_s: float | None
    delay_ms: float | None


@dataclass(frozen=True)
class Beside:
    """What the paper's scheme would have come to, by the definitions of the module's first lines.

    Without the truth there are no contacts, and false alarms and misses are None.
    """

    adaptation_s: dict[str, float | None]
    frozen_residual_max_Nm: dict[str, tuple[float, float] | None]
    contacts: tuple[BesideContact, ...]
    false_alarms: int | None
    false_alarms_s: tuple[float, ...] | None
    missed: int | None


def evaluate_beside(
    run: Run, stream: PaperStream, sections: Sequence[Section], touches: Sequence[Touch], free: Mask
) -> Beside:
    """Judge the paper's scheme. free: cycles (n,) in which nothing touches the arm."""
    time_s = run.time_s()
    armed = stream.is_armed & ~_parked(run, sections)
    over = armed & (np.abs(stream.tau_ext_hat) > stream.threshold).any(axis=1)
    a = run.settings.filter.a_rad_s
    threshold = np.array(run.settings.detector.threshold_Nm)
    unexplained = over if run.finish_cycle is None else over & (run.cycle < run.finish_cycle)
    contacts = []
    for number, touch in enumerate(touches, start=1):
        explained = (time_s >= touch.onset_s) & (time_s <= forgotten_s(run, touch, a, threshold))
        unexplained = unexplained & ~explained
        first = np.flatnonzero(over & explained)
        detected_s = float(time_s[first[0]]) if first.size else None
        contacts.append(
            BesideContact(
                number=number,
                is_armed=bool(armed[max(row_at(run, touch.onset_s) - 1, 0)]),
                detected_s=detected_s,
                delay_ms=None if detected_s is None else (detected_s - touch.onset_s) * 1e3,
            )
        )
    false_s = _episodes(time_s[unexplained], SETTLING_TIME_CONSTANTS / a)
    has_truth = run.truth is not None
    return Beside(
        adaptation_s=_adaptation_s(run, stream, sections),
        frozen_residual_max_Nm={
            section.label: largest_of(stream.tau_ext_hat[rows_of(run, section) & free & armed])
            for section in sections
            if section.kind == "detection"
        },
        contacts=tuple(contacts),
        false_alarms=len(false_s) if has_truth else None,
        false_alarms_s=false_s if has_truth else None,
        missed=sum(contact.is_armed and contact.detected_s is None for contact in contacts) if has_truth else None,
    )


def largest_of(residual: Vector) -> tuple[float, float] | None:
    """Give the largest |residual| (n, 2) of each joint, Nm; None of no cycle."""
    if residual.shape[0] == 0:
        return None
    largest = np.abs(residual).max(axis=0)
    return float(largest[0]), float(largest[1])


def _parked(run: Run, sections: Sequence[Section]) -> Mask:
    parked = np.zeros(run.cycle.size, dtype=np.bool_)
    for section in sections:
        if section.kind == "payload":
            parked |= rows_of(run, section)
    return parked


def _adaptation_s(run: Run, stream: PaperStream, sections: Sequence[Section]) -> dict[str, float | None]:
    """Give how long the paper's scheme has adapted, from the start of each adaptation up to the next payload change."""
    time_s = run.time_s()
    found: dict[str, float | None] = {}
    for section in sections:
        if section.kind != "adaptation":
            continue
        ends_s = [other.start_s for other in sections if other.start_s > section.start_s and other.kind != "detection"]
        # In the first cycle of ADAPT it is still what it was before.
        rows = np.flatnonzero((time_s > section.start_s) & (time_s <= min(ends_s, default=np.inf)) & stream.is_armed)
        found[section.label] = float(time_s[rows[0]]) - section.start_s if rows.size else None
    return found


def _episodes(times_s: Vector, pause_s: float) -> tuple[float, ...]:
    """Give the first of the times (k,) and each that comes more than a pause after the one before, s."""
    if times_s.size == 0:
        return ()
    begins = np.concatenate(([True], np.diff(times_s) > pause_s))
    return tuple(times_s[begins].tolist())
