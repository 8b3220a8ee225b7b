"""The external torque: the detector of eq. (13) and (14), and the filter undone.

**Detector.** The collision detector of eq. (13) and (14), one threshold per joint.

The paper's tau_ef = tau_f - W_f theta_hat is the negative of the environment's torque, filtered with DC gain b / a.
Estimates and thresholds here are in Nm and positive when the environment pushes toward +q:

    tau_ext_hat = -(a / b) (tau_f - W_f theta_hat)

A joint that stands still can hold any torque up to its Coulomb friction, which sgn(0) = 0 does not predict: the
threshold of such a joint is raised by F_c, and falls back as the filter forgets the standstill.

A step tau_ext is over the threshold h after -ln(1 - h / |tau_ext|) / a, and never if |tau_ext| <= h; the smallest
impulse that is seen is h / a.

**Strength of a contact.** The filter is undone: tau_ext = tau_ext_hat + (d tau_ext_hat / dt) / a. Exactly over one
period with a constant torque, u = (y - E y_old) / (1 - E) with E = exp(-a T) and y = tau_ext_hat; the mean of five such
values keeps the sensor's noise down (0.02 Nm rms of white noise becomes 0.009). The impulse is the integral of tau_ext
over the contact: from y' = a (tau_ext - y) it is y / a + integral of y, no derivative needed. A contact of a joint
begins where |y| was last below half of its threshold, which is before it is detected.

Shapes: joint vectors (2,); history (WIDE_SAMPLES + 1, 2), newest first.
"""

from adacd_hil import linalg
from adacd_hil.compiled import compiled
from adacd_hil.records import Vector

SMALLEST_UNIT = 0.05
LARGEST_UNIT = 9.0
"""Bounds of the unit: a model counts as at most 4.5 times better, or 3 times worse, than its covariance."""


@compiled
def predict(W_f: Vector, theta: Vector, tau_f_hat: Vector) -> None:
    """Fill tau_f_hat (2,) = W_f theta, eq. (7), in filtered Nm."""
    for i in range(W_f.shape[0]):
        tau_f_hat[i] = linalg.dot(W_f[i], theta)


@compiled
def estimate_external(tau_f: Vector, tau_f_hat: Vector, dc_gain: float, tau_ext_hat: Vector) -> None:
    """Fill tau_ext_hat (2,), Nm, with -(tau_f - tau_f_hat) / dc_gain: equation 13 of the paper with our sign.

    tau_f, tau_f_hat (2,): filtered torque, measured and predicted. dc_gain: b / a of the filter.
    """
    for i in range(tau_f.shape[0]):
        tau_ext_hat[i] = -(tau_f[i] - tau_f_hat[i]) / dc_gain


@compiled
def follow_standstill(dq: Vector, standstill_rad_s: float, decay: float, standstill: Vector) -> None:
    """Update `standstill` (2,) in place: each joint's share of standstill in the filter's memory, 0 to 1.

    A joint slower than standstill_rad_s stands still. decay: share of the old value that stays after one period.
    """
    for i in range(dq.shape[0]):
        target = 1.0 if abs(dq[i]) < standstill_rad_s else 0.0
        standstill[i] = target + decay * (standstill[i] - target)


@compiled
def fill_threshold(threshold_Nm: Vector, standstill: Vector, F_c: Vector, threshold: Vector) -> None:
    """Fill `threshold` (2,), Nm: threshold_Nm plus `standstill`, 0 to 1, times Coulomb friction F_c, if positive."""
    for i in range(threshold.shape[0]):
        threshold[i] = threshold_Nm[i] + standstill[i] * max(F_c[i], 0.0)


@compiled
def joints_over(tau_ext_hat: Vector, threshold: Vector) -> int:
    """Return the joints over their threshold, eq. (14), bit i for joint i + 1; NaN counts as over."""
    joints = 0
    for i in range(tau_ext_hat.shape[0]):
        if not (abs(tau_ext_hat[i]) <= threshold[i]):
            joints |= 1 << i
    return joints


WIDE_SAMPLES = 5
"""Samples of the mean in tau_ext_wide_hat: at 1 kHz it centres 2 ms late, and gets a half-sine's peak right within
4 % from 20 ms on."""

ONSET_FRACTION = 0.5
"""Part of the threshold below which a joint counts as untouched; above a frozen model's residual (0.07 of 0.15 Nm)."""


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
