"""The contact report: describes a contact from a short memory of the external torques around it.

A contact begins with the last sample before its detection that is below half of its joints' thresholds. It is reported
at three times, which `contact.course` sets: at its detection, when the link is decided, and when the window has ended.
Push and hit differ clearly only then.

**Link.** A force on link 1 loads joint 1 only. So the link is 2 if the mean torque of joint 2 since the beginning
exceeds two bounds: chance noise, and the trace that a blow on link 1 leaves in joint 2 for a few samples.

Each cycle writes only one row; the rest runs three times in a contact.

**The paper's scheme** (`integrated_report`). Link 2 if joint 2 is over its threshold at any time until the isolation
window ends, else link 1. At the alarm the answer is often too early: joint 1 has the longer arm and crosses first. The
report is given at once and becomes final when the window ends.
"""

from typing import Any

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, ContactKind, ContactLevel, ContactReport, Reaction, Vector
from adacd_hil.scheme.contact import localisation
from adacd_hil.scheme.contact.contact_kind import classify
from adacd_hil.scheme.contact.course import CourseMemory, put_link
from adacd_hil.scheme.detect.undone_filter import ONSET_FRACTION
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.scheme_settings import KIND_S

BEFORE_S = 0.08
"""How far before its detection the beginning of a contact is sought; a push of 0.2 Nm/s crosses 0.02 Nm in it."""
CERTAIN = 4.0
"""Standard deviations by which the mean torque of joint 2 stands out of the noise: by chance once in 16000 contacts."""
CROSS_SHARE = 0.04
"""Torque in joint 2 that a blow on link 1 may cause through the model's error, as a part of joint 1's torque. A force
on link 2 with a smaller part is nearly along the link, or within 2 cm of joint 2."""
PEAK_SHARE = 0.03
"""Standard deviation of a peak as a part of it: the mean of five samples takes up to 4 % off a blow's of 20 ms."""
IMPULSE_SHARE = 0.01
"""Standard deviation of an impulse as a part of it: the model's error while the arm reacts."""
TOP_PARTS = 8
"""A peak is a mean over this part (one in so many) of the contact's samples above half of the largest: on a half-sine's
top it takes off 1 %."""
BIAS = 1.5
"""Standard deviations that the largest of the few independent samples of a contact lies above the truth."""
CORRELATED_SAMPLES = 5.0
"""Neighbouring samples with the filter undone share their noise: they are means of five."""

Q2, TAU, SIGMA, THRESHOLD = 0, slice(1, 3), slice(3, 5), slice(5, 7)
_COLUMNS = 7


@compiled
def put_row(rows: Vector, kept: int, q: Vector, tau: Vector, sigma: Vector, threshold: Vector) -> None:
    """Write the row of one cycle: q2, and tau, sigma, threshold (2,) of the external torque, filter undone.

    kept: number of rows written before it. rows (2 m, 7): the last m cycles, each twice, so that any window is
    contiguous.
    """
    half = rows.shape[0] // 2
    place = kept % half
    for row in (place, place + half):
        rows[row, 0] = q[1]
        for i in range(2):
            rows[row, 1 + i] = tau[i]
            rows[row, 3 + i] = sigma[i]
            rows[row, 5 + i] = threshold[i]


def last_rows(rows: Vector, kept: int, count: int) -> Vector:
    """Return the newest `count` rows, newest last, or as many as there are; a view, valid until the next cycle.

    kept: number of rows written so far.
    """
    half = rows.shape[0] // 2
    count = min(count, kept, half)
    end = half + (kept - 1) % half + 1
    return rows[end - count : end]


@compiled
def _peak(tau: Vector, sigma: float) -> float:
    """Return a joint's signed peak torque, Nm, of (n,) samples: the largest moving mean, less a noisy maximum's bias.

    sigma: standard deviation of a sample. The mean is longer in a longer contact. A blow's top is short. When the arm
    begins to react, the torque of its drive jumps, and through the lag the estimate rings for some ten samples around
    the truth.
    """
    largest = np.max(np.abs(tau))
    width = max(int(np.sum(np.abs(tau) > 0.5 * largest)) // TOP_PARTS, 1)
    best = 0.0
    for k in range(tau.shape[0] - width + 1):
        mean = float(np.mean(tau[k : k + width]))
        if abs(mean) > abs(best):
            best = mean
    bias = BIAS * sigma * np.sqrt(CORRELATED_SAMPLES / (CORRELATED_SAMPLES - 1.0 + width))
    return float(np.sign(best) * max(abs(best) - bias, 0.0))


def _report(m: CourseMemory, link: int, direction: tuple[int, int], **evidence: Any) -> ContactReport:
    """Return the report of a contact, final if `m` isn't open, and store `link` in `m`.

    evidence: the report's fields that `m` doesn't have.
    """
    put_link(m, link)
    return ContactReport(
        cycle=int(m.detected_cycle),
        link=link,
        direction=direction,
        is_final=not m.is_open,
        level=ContactLevel(m.level),
        reaction=Reaction(m.reaction),
        is_two_sided=bool(m.is_two_sided),
        **evidence,
    )


def integrated_report(m: CourseMemory, y: Vector, integral: Vector, peak: Vector, a_rad_s: float) -> ContactReport:
    """Return the report of a contact in the paper's scheme, and store its link in `m`.

    Link 2 if joint 2 has crossed its threshold, else 1. y, integral (2,): filtered external torque, Nm, and its
    integral since the contact began, Nm s. peak (2,): the largest torque since then with the filter undone, Nm.
    a_rad_s: bandwidth of that filter; the impulse is y / a + integral.
    """
    direction = int(m.direction[0]), int(m.direction[1])
    link = 2 if direction[1] else 1
    return _report(m, link, direction, tau_ext_peak=_pair(peak), impulse=_pair(integral + y / a_rad_s))


def new_rows(settings: Settings) -> Vector:
    """Return zeros (2 m, 7) for the rows of the last m cycles, see `put_row`."""
    period_s = settings.bus.period_s
    return np.zeros((2 * (round(BEFORE_S / period_s) + 2 * round(KIND_S / period_s)), _COLUMNS))


def compile_recalled(settings: Settings) -> None:
    """Compile the compiled functions of `recalled_report` by a call of each, with one row and with two.

    Both are needed: numpy takes one row's columns as contiguous, which is another type.
    """
    every = np.ones((8, _COLUMNS))
    for count in (1, 2):
        rows = last_rows(every, count, count)
        tau, sigma = rows[:, TAU], rows[-1, SIGMA]
        localisation.on_link2(tau, rows[:, Q2], sigma, settings.arm.link_length_m)
        _peak(tau[:, 0], sigma[0])


def _early_rows(rows: Vector) -> int:
    """Return the number of rows since the last one with both joints below half of their thresholds, or below sigma.

    They belong to the contact that is detected in the cycle of the last row. All rows if there is no such row.
    """
    below = np.all(np.abs(rows[:, TAU]) <= np.maximum(ONSET_FRACTION * rows[:, THRESHOLD], rows[:, SIGMA]), axis=1)
    return len(rows) - int(np.flatnonzero(below)[-1]) - 1 if np.any(below) else len(rows)


def recalled_report(settings: Settings, m: CourseMemory, every_row: Vector, cycle: int) -> ContactReport:
    """Return the report of a contact in the certified scheme, from its rows so far; store link and `early_rows` in `m`.

    every_row: memory that `put_row` writes. cycle: the present one; in that of the detection `early_rows` is set. The
    kind is UNKNOWN while `m` is open, in all reports but the last.
    """
    period_s, length_m = settings.bus.period_s, settings.arm.link_length_m
    elapsed, kept = cycle - int(m.detected_cycle), int(m.kept_rows)
    if elapsed == 0:
        m.early_rows = _early_rows(last_rows(every_row, kept, round(BEFORE_S / period_s)))
    rows = last_rows(every_row, kept, max(elapsed + int(m.early_rows), 1))
    tau, sigma, threshold = rows[:, TAU], rows[-1, SIGMA], rows[-1, THRESHOLD]
    peaks = np.array([_peak(tau[:, i], sigma[i]) for i in range(JOINTS)])
    impulse = period_s * np.sum(tau, axis=0)
    noise = period_s * sigma * np.sqrt(CORRELATED_SAMPLES * rows.shape[0])
    link = _link(rows)
    if link == 2:
        place = localisation.on_link2(tau, rows[:, Q2], sigma, length_m)
        blind = localisation.blind_angle(place.force_N, place.lever_m, float(threshold[1]))
    else:
        place = localisation.on_link1(float(peaks[0]), float(sigma[0]), length_m[0])
        blind = localisation.blind_angle_of_link1(float(peaks[0]), float(rows[-1, Q2]), length_m, float(threshold[1]))
    return _report(
        m,
        link,
        (int(m.direction[0]), int(m.direction[1]) if link == 2 else 0),
        tau_ext_peak=_pair(peaks),
        impulse=_pair(impulse),
        kind=ContactKind.UNKNOWN if m.is_open else classify(tau, sigma, period_s),
        tau_ext_peak_sigma=_pair(np.hypot(sigma, PEAK_SHARE * peaks)),
        impulse_sigma=_pair(np.hypot(noise, IMPULSE_SHARE * impulse)),
        blind_rad=blind,
        **place._asdict(),
    )


def _link(rows: Vector) -> int:
    """Return the touched link, 1 or 2, from the rows of a contact.

    2 if joint 2's mean torque is over CERTAIN sigmas of noise plus CROSS_SHARE of joint 1's mean torque.
    """
    mean = np.abs(np.mean(rows[:, TAU], axis=0))
    sigma = float(rows[-1, SIGMA][1]) * np.sqrt(CORRELATED_SAMPLES / rows.shape[0])
    return 2 if mean[1] > CERTAIN * sigma + CROSS_SHARE * mean[0] else 1


def _pair(values: Vector) -> tuple[float, float]:
    return float(values[0]), float(values[1])
