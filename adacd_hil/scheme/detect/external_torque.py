"""The external torque: the detector of eq. (13) and (14), one threshold per joint.

The paper's tau_ef = tau_f - W_f theta_hat is the negative of the environment's torque, filtered with DC gain b / a.
Estimates and thresholds here are in Nm and positive when the environment pushes toward +q:

    tau_ext_hat = -(a / b) (tau_f - W_f theta_hat)

A joint that stands still can hold any torque up to its Coulomb friction, which sgn(0) = 0 does not predict: the
threshold of such a joint is raised by F_c, and falls back as the filter forgets the standstill.

A step tau_ext is over the threshold h after -ln(1 - h / |tau_ext|) / a, and never if |tau_ext| <= h; the smallest
impulse that is seen is h / a.

Shapes: joint vectors (2,).
"""

from adacd_hil import linalg
from adacd_hil.compiled import compiled
from adacd_hil.records import Vector


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
