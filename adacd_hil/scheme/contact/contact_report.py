"""The contact report: what is told of a contact, from a short memory of the external torques around it.

A contact begins with the last sample before its detection that is below half of its joints' thresholds. It is
reported three times: when it is detected, when the link is decided, and when the window has ended, which is also when
push and hit can be told apart.

**Link.** A force on link 1 loads joint 1 only. So it is link 2 if the mean torque of joint 2 since the beginning stands
out of the noise further than chance does, and of what a blow on link 1 leaves there for a few samples.

Per cycle it only writes one row; everything else happens three times in a contact.
"""

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, ContactKind, ContactLevel, ContactReport, Reaction, Vector
from adacd_hil.scheme.contact import classification, localisation
from adacd_hil.scheme.contact.contact_estimate import ONSET_FRACTION
from adacd_hil.scheme.supervisor.observation import CONTACT_SHIFT
from adacd_hil.scheme.supervisor.skip_conditions import Calm
from adacd_hil.settings.configuration import Settings

LINK_S = 0.01
"""From detection until the link is decided."""
BEFORE_S = 0.08
"""How far back from its detection the beginning of a contact is sought; a push of 0.2 Nm/s crosses 0.02 Nm in it."""
CERTAIN = 4.0
"""Standard deviations by which the mean torque of joint 2 stands out of the noise: by chance once in 16000 contacts."""
CROSS_SHARE = 0.04
"""What a blow on link 1 may leave in joint 2 by the model's error, as a part of joint 1's torque. A force on link 2
that has less there is nearly along the link, or within 2 cm of joint 2."""
PEAK_SHARE = 0.03
"""Standard deviation of a peak as a part of it: the mean of five samples takes up to 4 % off a blow's of 20 ms."""
IMPULSE_SHARE = 0.01
"""Standard deviation of an impulse as a part of it: what the model lacks while the arm reacts."""
TOP_PARTS = 8
"""Part of a contact, of its samples above half of its largest one, over which a peak is a mean: of a half-sine's top it
takes 1 %."""
BIAS = 1.5
"""Standard deviations that the largest of the few independent samples of a contact lies above the truth."""
CORRELATED_SAMPLES = 5.0
"""Neighbouring samples with the filter undone share their noise: they are means of five."""

Q2, TAU, SIGMA, THRESHOLD = 0, slice(1, 3), slice(3, 5), slice(5, 7)
_COLUMNS = 7


class ContactHistory:
    """The last samples of elbow angle, external torques, their uncertainty and their thresholds, in order of time."""

    def __init__(self, rows: int) -> None:
        self.rows = np.zeros((2 * rows, _COLUMNS))  # each row twice, so that any window is one piece
        self._size = rows
        self.count = 0

    def put(self, q: Vector, tau_ext_wide_hat: Vector, sigma: Vector, threshold: Vector) -> None:
        """Take in one cycle; vectors (2,)."""
        put_row(self.rows, self.count % self._size, q, tau_ext_wide_hat, sigma, threshold)
        self.count += 1

    def last(self, count: int) -> Vector:
        """Return up to `count` rows, the newest last; a view, good until the next cycle."""
        count = min(count, self.count, self._size)
        end = self._size + (self.count - 1) % self._size + 1
        return self.rows[end - count : end]


@compiled
def put_row(rows: Vector, place: int, q: Vector, tau: Vector, sigma: Vector, threshold: Vector) -> None:
    """Take one cycle into the rows of a `ContactHistory`."""
    half = rows.shape[0] // 2
    for row in (place, place + half):
        rows[row, 0] = q[1]
        for i in range(2):
            rows[row, 1 + i] = tau[i]
            rows[row, 3 + i] = sigma[i]
            rows[row, 5 + i] = threshold[i]


@compiled
def _peak(tau: Vector, sigma: float) -> float:
    """Return the largest torque (n,) as a mean over a part of the contact, less what noise adds to the largest of many.

    The longer a contact lasts the longer the mean: a blow's top is short, but when the arm begins to react the torque
    of its drive jumps, and what the lag makes of that rings for some ten samples around the truth.
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


class ContactReporter:
    """Makes the reports of one contact after the other."""

    def __init__(self, settings: Settings) -> None:
        period_s = settings.bus.period_s
        self._period_s = period_s
        self._length_m = settings.arm.link_length_m
        self._link_cycles = round(LINK_S / period_s)
        self._window_cycles = round(classification.WINDOW_S / period_s)
        self._before_cycles = round(BEFORE_S / period_s)
        self.history = ContactHistory(self._before_cycles + 2 * self._window_cycles)
        self._begin_cycle = 0
        self._detected_cycle = 0
        self._direction = [0] * JOINTS
        self._is_open = False

    def compile(self) -> None:
        """Run every compiled function once."""
        zeros, ones = np.zeros(JOINTS), np.ones(JOINTS)
        history = ContactHistory(4)
        history.put(zeros, ones, ones, ones)
        rows = history.last(1)
        localisation.on_link2(rows[:, TAU], rows[:, Q2], ones, self._length_m)
        classification.classify(rows[:, TAU], ones, self._period_s)
        _peak(rows[:, 1], 1.0)

    @property
    def is_open(self) -> bool:
        """Whether a report is out that is not final yet."""
        return self._is_open

    def observe(self, q: Vector, tau_ext_wide_hat: Vector, sigma: Vector, threshold: Vector) -> None:
        """Take in one cycle's values (2,), whatever the state is; thresholds as finite numbers or inf."""
        self.history.put(q, tau_ext_wide_hat, sigma, threshold)

    def calm(self, calm: Calm, cycle: int) -> Calm:
        """Narrow the bounds to those within which, from this cycle on, no report is due and no direction is new."""
        if not self._is_open:
            return calm
        at_link = self._detected_cycle + self._link_cycles
        due = at_link if cycle <= at_link else self._detected_cycle + self._window_cycles
        new = sum(1 << i for i in range(JOINTS) if self._direction[i] == 0)
        return calm._replace(watched=calm.watched | new << CONTACT_SHIFT, due=due)

    def begin(self, cycle: int) -> None:
        """Open the window: a contact is detected in this cycle."""
        self._detected_cycle = cycle
        rows = self.history.last(self._before_cycles)
        below = np.all(np.abs(rows[:, TAU]) <= np.maximum(ONSET_FRACTION * rows[:, THRESHOLD], rows[:, SIGMA]), axis=1)
        since = rows.shape[0] - int(np.flatnonzero(below)[-1]) - 1 if np.any(below) else rows.shape[0]
        self._begin_cycle = cycle - since
        self._direction = [0] * JOINTS
        self._is_open = True

    def cancel(self) -> None:
        """Close the window without a final report, as a fault does."""
        self._is_open = False

    def report(
        self, cycle: int, joints: int, level: ContactLevel, reaction: Reaction, is_two_sided: bool = False
    ) -> ContactReport | None:
        """Return the report that is due in this cycle, if one is. joints: bits of those over their threshold."""
        elapsed = cycle - self._detected_cycle
        is_final = elapsed >= self._window_cycles
        tau_ext_hat = self.history.last(1)[0, TAU]
        for i in range(JOINTS):
            if joints >> i & 1 and self._direction[i] == 0:
                self._direction[i] = int(np.sign(tau_ext_hat[i]))
        if elapsed not in (0, self._link_cycles) and not is_final:
            return None
        self._is_open = not is_final
        return self._make(cycle, level, reaction, is_two_sided, is_final)

    def _make(
        self, cycle: int, level: ContactLevel, reaction: Reaction, is_two_sided: bool, is_final: bool
    ) -> ContactReport:
        rows = self.history.last(max(cycle - self._begin_cycle, 1))
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
            cycle=self._detected_cycle,
            link=link,
            direction=(self._direction[0], self._direction[1] if link == 2 else 0),
            tau_ext_peak=_pair(peaks),
            impulse=_pair(impulse),
            is_final=is_final,
            level=level,
            kind=classification.classify(tau, sigma, self._period_s) if is_final else ContactKind.UNKNOWN,
            reaction=reaction,
            location=place.location,
            is_two_sided=is_two_sided,
            tau_ext_peak_sigma=_pair(peak_sigma),
            impulse_sigma=_pair(impulse_sigma),
            force_N=place.force_N,
            force_sigma=place.force_sigma,
            lever_m=place.lever_m,
            lever_sigma=place.lever_sigma,
            blind_rad=blind,
        )

    def _link(self, rows: Vector) -> int:
        """Return the link that is touched, by joint 2."""
        mean = np.abs(np.mean(rows[:, TAU], axis=0))
        sigma = float(rows[-1, SIGMA][1]) * np.sqrt(CORRELATED_SAMPLES / rows.shape[0])
        return 2 if mean[1] > CERTAIN * sigma + CROSS_SHARE * mean[0] else 1


def _pair(values: Vector) -> tuple[float, float]:
    return float(values[0]), float(values[1])
