"""What is told of a collision: which link, which direction, how strong.

**Strength.** The filter is undone: tau_ext = tau_ext_hat + (d tau_ext_hat / dt) / a. Exactly over one period with a
constant torque, u = (y - E y_old) / (1 - E) with E = exp(-a T) and y = tau_ext_hat; the mean of five such values keeps
the sensor's noise down (0.02 Nm rms of white noise becomes 0.009). The impulse is the integral of tau_ext over the
contact: from y' = a (tau_ext - y) it is y / a + integral of y, no derivative needed. A contact of a joint begins where
|y| was last below half of its threshold, which is before it is detected.

**Link.** A force on link 1 loads joint 1 only, one on link 2 both; so it is link 2 if joint 2 is over its threshold at
any time until the isolation window ends, else link 1. At the alarm the answer is often too early: joint 1 has the
longer arm and crosses first. The report is given at once and becomes final when the window ends.

Shapes: joint vectors (2,); history (WIDE_SAMPLES + 1, 2), newest first.
"""

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, ContactReport, Vector
from adacd_hil.scheme.supervisor.observation import CONTACT_SHIFT
from adacd_hil.scheme.supervisor.skip_conditions import Calm

WIDE_SAMPLES = 5
"""Samples of the mean in tau_ext_wide_hat: at 1 kHz it centres 2 ms late, and gets a half-sine's peak right within
4 % from 20 ms on."""

ONSET_FRACTION = 0.5
"""Part of the threshold below which a joint counts as untouched; above what a frozen model leaves (0.07 of 0.15 Nm)."""


@compiled
def undo_filter(tau_ext_hat: Vector, decay: float, history: Vector, tau_ext_wide_hat: Vector) -> None:
    """Put this sample into `history` and fill tau_ext_wide_hat (2,)."""
    for i in range(tau_ext_hat.shape[0]):
        for k in range(history.shape[0] - 1, 0, -1):
            history[k, i] = history[k - 1, i]
        history[0, i] = tau_ext_hat[i]
        total = 0.0
        for k in range(history.shape[0] - 1):
            total += history[k, i] - decay * history[k + 1, i]
        tau_ext_wide_hat[i] = total / ((1.0 - decay) * (history.shape[0] - 1))


@compiled
def follow_contact(
    tau_ext_hat: Vector,
    tau_ext_wide_hat: Vector,
    threshold: Vector,
    period_s: float,
    is_reporting: bool,
    integral: Vector,
    peak: Vector,
) -> None:
    """Carry on the integral (2,) Nm s and the peak (2,) Nm of each joint's contact in place.

    A joint that counts as untouched begins anew, but not while a report is open: its contact may be over by the end.
    """
    for i in range(tau_ext_hat.shape[0]):
        if abs(tau_ext_hat[i]) <= ONSET_FRACTION * threshold[i] and not is_reporting:
            integral[i] = 0.0
            peak[i] = 0.0
        else:
            integral[i] += period_s * tau_ext_hat[i]
        if abs(tau_ext_wide_hat[i]) > abs(peak[i]):
            peak[i] = tau_ext_wide_hat[i]


class Isolation:
    """Makes the reports of one collision after the other: one at detection, a final one at the end of the window."""

    def __init__(self, window_cycles: int, a_rad_s: float) -> None:
        self._window_cycles = window_cycles
        self._a_rad_s = a_rad_s
        self._begin_cycle = 0
        self._direction = [0] * JOINTS
        self._is_open = False

    @property
    def is_open(self) -> bool:
        """Whether a report is out that is not final yet."""
        return self._is_open

    def calm(self, calm: Calm) -> Calm:
        """Narrow the bounds to those within which no report is due and no direction is new."""
        if not self._is_open:
            return calm
        new = sum(1 << i for i in range(JOINTS) if self._direction[i] == 0)
        return calm._replace(watched=calm.watched | new << CONTACT_SHIFT, due=self._begin_cycle + self._window_cycles)

    def begin(self, cycle: int) -> None:
        """Open the window: a collision is detected in this cycle."""
        self._begin_cycle = cycle
        self._direction = [0] * JOINTS
        self._is_open = True

    def cancel(self) -> None:
        """Close the window without a final report, as a fault does."""
        self._is_open = False

    def report(
        self, cycle: int, joints: int, tau_ext_hat: Vector, integral: Vector, peak: Vector
    ) -> ContactReport | None:
        """Take in this cycle and return a report if it is the first or the last of the window.

        joints: bits of the joints that are over their threshold. integral Nm s and peak Nm (2,): of `follow_contact`.
        """
        for i in range(JOINTS):
            if joints >> i & 1 and self._direction[i] == 0:
                self._direction[i] = int(np.sign(tau_ext_hat[i]))
        is_final = cycle - self._begin_cycle >= self._window_cycles
        if not is_final and cycle != self._begin_cycle:
            return None
        self._is_open = not is_final
        return ContactReport(
            cycle=self._begin_cycle,
            link=2 if self._direction[1] else 1,
            direction=(self._direction[0], self._direction[1]),
            tau_ext_peak=(float(peak[0]), float(peak[1])),
            impulse=(
                float(integral[0] + tau_ext_hat[0] / self._a_rad_s),
                float(integral[1] + tau_ext_hat[1] / self._a_rad_s),
            ),
            is_final=is_final,
        )
