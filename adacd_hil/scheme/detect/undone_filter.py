"""The external torque with its filter undone, and a contact's peak and impulse by it.

    tau_ext = tau_ext_hat + (d tau_ext_hat / dt) / a

Exactly over one period with a constant torque, u = (y - E y_old) / (1 - E) with E = exp(-a T) and y = tau_ext_hat; the
mean of five such values keeps the sensor's noise down (0.02 Nm rms of white noise becomes 0.009). The impulse is the
integral of tau_ext over the contact: from y' = a (tau_ext - y) it is y / a + integral of y, no derivative needed. A
contact of a joint begins where |y| was last below half of its threshold, which is before it is detected.

Shapes: joint vectors (2,); history (WIDE_SAMPLES + 1, 2), newest first.
"""

from adacd_hil.compiled import compiled
from adacd_hil.records import Vector

WIDE_SAMPLES = 5
"""Samples of the mean in tau_ext_wide_hat: at 1 kHz it centres 2 ms late, and gets a half-sine's peak right within
4 % from 20 ms on."""
ONSET_FRACTION = 0.5
"""Part of the threshold below which a joint counts as untouched; above a frozen model's residual (0.07 of 0.15 Nm)."""


@compiled
def forget(history: Vector) -> None:
    """Set `history` to zeros: the filter begins anew."""
    history[:] = 0.0


@compiled
def undo_filter(tau_ext_hat: Vector, decay: float, history: Vector, tau_ext_wide_hat: Vector) -> None:
    """Put tau_ext_hat (2,) first in `history`; fill tau_ext_wide_hat (2,), the mean torque with the filter undone.

    The mean is over the last WIDE_SAMPLES samples. decay: E = exp(-a T), the share of its old output that the filter
    keeps over one period.
    """
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
    """Update each joint's contact: the integral (2,) of tau_ext_hat, Nm s, and the peak (2,) of tau_ext_wide_hat, Nm.

    peak: the value of largest size, with its sign. While a joint's |tau_ext_hat| is at most ONSET_FRACTION of its
    threshold, the integral is 0 and the peak the present value. is_reporting: a report is still due, so both go on
    there, too.
    """
    for i in range(tau_ext_hat.shape[0]):
        if abs(tau_ext_hat[i]) <= ONSET_FRACTION * threshold[i] and not is_reporting:
            integral[i] = 0.0
            peak[i] = 0.0
        else:
            integral[i] += period_s * tau_ext_hat[i]
        if abs(tau_ext_wide_hat[i]) > abs(peak[i]):
            peak[i] = tau_ext_wide_hat[i]
