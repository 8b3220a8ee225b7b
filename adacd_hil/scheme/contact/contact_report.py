"""The contact report: describes a contact from a short memory of the external torques around it.

A contact begins with the last sample before its detection that is below half of its joints' thresholds. It is reported
at three times, which `contact.course` sets: at its detection, when the link is decided, and when the window has ended.
Push and hit differ clearly only then.

**Link.** A force on link 1 loads joint 1 only. So the link is 2 if the mean torque of joint 2 since the beginning
exceeds two bounds: chance noise, and the trace that a blow on link 1 leaves in joint 2 for a few samples.

Each cycle writes only one row; the rest runs three times in a contact.

**Kind.** Push or hit: by the share of the torque that remains 100 ms after the detection.

A hit is over by then: after a blow of 100 ms at most a seventh of its largest torque remains, and after a body is
pushed away no torque remains. A push still grows or lasts. The remaining torque is measured in standard deviations of
the joints, so that the more certain joint weighs more.

A hand that grasps a moving arm stops it and then guides it; the kind follows from the torque that remains when the arm
has stopped. A clamped body is a hit if it springs back, a push if it stays under load: transient and quasi-static
contact of ISO/TS 15066.

**The paper's scheme** (`IntegratedContact`). Link 2 if joint 2 is over its threshold at any time until the isolation
window ends, else link 1. At the alarm the answer is often too early: joint 1 has the longer arm and crosses first. The
report is given at once and becomes final when the window ends.
"""

from abc import ABC, abstractmethod

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, ContactKind, ContactLevel, ContactReport, Reaction, Vector
from adacd_hil.scheme.contact import localisation
from adacd_hil.scheme.contact.course import CourseMemory
from adacd_hil.scheme.detect.external_torque import ONSET_FRACTION
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.scheme_settings import KIND_S

LINK_S = 0.01
"""Time from detection until the link is decided."""
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
    """Write the row of one cycle. kept: number of rows before it.

    rows (2 m, 7): the last m cycles, each twice, so that any window is contiguous.
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
    """Return up to `count` rows, newest last; a view, valid until the next cycle. kept: rows written so far."""
    half = rows.shape[0] // 2
    count = min(count, kept, half)
    end = half + (kept - 1) % half + 1
    return rows[end - count : end]


@compiled
def _peak(tau: Vector, sigma: float) -> float:
    """Return the largest torque of (n,) samples: a mean over a part of the contact, less the bias of a noisy maximum.

    The mean is longer in a longer contact. A blow's top is short. When the arm begins to react, the torque of its drive
    jumps, and through the lag the estimate rings for some ten samples around the truth.
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


class ContactEvidence(ABC):
    """A scheme's data on a contact that it reports; values that the scheme doesn't estimate stay empty."""

    due_cycles: tuple[int, ...]
    """Cycles from detection to each report: the first report at once, the final one last."""

    def compile(self) -> None:
        """Run each compiled function once, so that it is compiled."""

    @abstractmethod
    def report(self, detected: int, elapsed: int, direction: tuple[int, int], is_final: bool) -> ContactReport:
        """Report a contact. detected: cycle of its detection; elapsed: cycles since then."""


def report_of(evidence: ContactEvidence, m: CourseMemory, cycle: int) -> ContactReport:
    """Return the report that is due in this cycle, and record its link in the contact's course."""
    direction = int(m.direction[0]), int(m.direction[1])
    detected = int(m.detected_cycle)
    report = evidence.report(detected, cycle - detected, direction, not m.is_open)
    m.link = report.link
    return report._replace(
        level=ContactLevel(m.level), reaction=Reaction(m.reaction), is_two_sided=bool(m.is_two_sided)
    )


class IntegratedContact(ContactEvidence):
    """The paper's evidence: its kernel's integrals since the contact began, at detection and when the window ends.

    tau_ext_hat, integral, peak: of the kernel (2,), views.
    """

    def __init__(self, settings: Settings, tau_ext_hat: Vector, integral: Vector, peak: Vector) -> None:
        self.due_cycles = (0, round(settings.detector.isolation_window_s / settings.bus.period_s))
        self._tau_ext = tau_ext_hat
        self._integral, self._peak = integral, peak
        self._a_rad_s = settings.filter.a_rad_s

    def report(
        self,
        detected: int,
        elapsed: int,  # noqa: ARG002
        direction: tuple[int, int],
        is_final: bool,
    ) -> ContactReport:
        """Report the contact; its impulse is y / a + integral of y."""
        return ContactReport(
            cycle=detected,
            link=2 if direction[1] else 1,
            direction=direction,
            tau_ext_peak=_pair(self._peak),
            impulse=_pair(self._integral + self._tau_ext / self._a_rad_s),
            is_final=is_final,
        )


class RecalledContact(ContactEvidence):
    """The certified scheme's evidence: the last samples, at detection, and when the link and the kind are decided."""

    def __init__(self, settings: Settings, m: CourseMemory) -> None:
        period_s = settings.bus.period_s
        window_cycles = round(KIND_S / period_s)
        self.due_cycles = (0, round(LINK_S / period_s), window_cycles)
        self._m = m
        self._period_s = period_s
        self._length_m = settings.arm.link_length_m
        self._before_cycles = round(BEFORE_S / period_s)
        self.rows = np.zeros((2 * (self._before_cycles + 2 * window_cycles), _COLUMNS))
        self._since = 0

    def compile(self) -> None:
        """Run each compiled function, for one row and for several: numpy takes one row's columns as contiguous."""
        every = np.ones((8, _COLUMNS))
        for count in (1, 2):
            rows = last_rows(every, count, count)
            tau, sigma = rows[:, TAU], rows[-1, SIGMA]
            localisation.on_link2(tau, rows[:, Q2], sigma, self._length_m)
            classify(tau, sigma, self._period_s)
            _peak(tau[:, 0], sigma[0])

    def _begin(self) -> None:
        """Find how many cycles ago the contact detected in this cycle began."""
        rows = last_rows(self.rows, int(self._m.kept_rows), self._before_cycles)
        below = np.all(np.abs(rows[:, TAU]) <= np.maximum(ONSET_FRACTION * rows[:, THRESHOLD], rows[:, SIGMA]), axis=1)
        self._since = rows.shape[0] - int(np.flatnonzero(below)[-1]) - 1 if np.any(below) else rows.shape[0]

    def report(self, detected: int, elapsed: int, direction: tuple[int, int], is_final: bool) -> ContactReport:
        """Report the contact from the samples since it began."""
        if elapsed == 0:
            self._begin()
        rows = last_rows(self.rows, int(self._m.kept_rows), max(elapsed + self._since, 1))
        tau, sigma, threshold = rows[:, TAU], rows[-1, SIGMA], rows[-1, THRESHOLD]
        peaks = np.array([_peak(tau[:, i], sigma[i]) for i in range(JOINTS)])
        impulse = self._period_s * np.sum(tau, axis=0)
        peak_sigma = np.hypot(sigma, PEAK_SHARE * peaks)
        noise = self._period_s * sigma * np.sqrt(CORRELATED_SAMPLES * rows.shape[0])
        impulse_sigma = np.hypot(noise, IMPULSE_SHARE * impulse)
        link = self._link(rows)
        if link == 2:
            place = localisation.on_link2(tau, rows[:, Q2], sigma, self._length_m)
            blind = localisation.blind_angle(place.force_N, place.lever_m, float(threshold[1]))
        else:
            place = localisation.on_link1(float(peaks[0]), float(sigma[0]), self._length_m[0])
            blind = localisation.blind_angle_of_link1(
                float(peaks[0]), float(rows[-1, Q2]), self._length_m, float(threshold[1])
            )
        return ContactReport(
            cycle=detected,
            link=link,
            direction=(direction[0], direction[1] if link == 2 else 0),
            tau_ext_peak=_pair(peaks),
            impulse=_pair(impulse),
            is_final=is_final,
            kind=classify(tau, sigma, self._period_s) if is_final else ContactKind.UNKNOWN,
            location=place.location,
            tau_ext_peak_sigma=_pair(peak_sigma),
            impulse_sigma=_pair(impulse_sigma),
            force_N=place.force_N,
            force_sigma=place.force_sigma,
            lever_m=place.lever_m,
            lever_sigma=place.lever_sigma,
            blind_rad=blind,
        )

    def _link(self, rows: Vector) -> int:
        """Return the touched link, 1 or 2, from the torque of joint 2."""
        mean = np.abs(np.mean(rows[:, TAU], axis=0))
        sigma = float(rows[-1, SIGMA][1]) * np.sqrt(CORRELATED_SAMPLES / rows.shape[0])
        return 2 if mean[1] > CERTAIN * sigma + CROSS_SHARE * mean[0] else 1


def _pair(values: Vector) -> tuple[float, float]:
    return float(values[0]), float(values[1])


END_S = 0.01
"""The remaining torque is the mean over this time at the end of the window."""
LEFT = 0.18
"""A push retains at least this part of its largest torque. Of 600 random contacts of 5 to 60 N the 299 half-sines of 20
to 100 ms left at most 0.142, the 301 pushes that rise in 0.2 to 1 s at least 0.239."""


def classify(tau_ext_wide_hat: Vector, sigma: Vector, period_s: float) -> ContactKind:
    """Return the kind of a contact from its external torque (n, 2) with the filter undone, the window's end the last.

    sigma: its standard deviation (2,), Nm.
    """
    share = share_left(tau_ext_wide_hat, sigma, max(1, round(END_S / period_s)))
    return ContactKind.PUSH if share >= LEFT else ContactKind.HIT


@compiled
def share_left(tau: Vector, sigma: Vector, end_samples: int) -> float:
    """Return the ratio of the torque at the end to the largest, 0 to 1."""
    count = tau.shape[0]
    largest = 0.0
    for k in range(count):
        largest = max(largest, (tau[k, 0] / sigma[0]) ** 2 + (tau[k, 1] / sigma[1]) ** 2)
    left = 0.0
    for i in range(2):
        left += (np.mean(tau[max(count - end_samples, 0) :, i]) / sigma[i]) ** 2
    return float(np.sqrt(left / largest)) if largest > 0.0 else 0.0
