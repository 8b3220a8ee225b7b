"""A small 2R arm with drives and sensors, in closed loop with the pipeline; for the tests of the scheme only."""

import numpy as np

from adacd_hil.compiled import compiled

THETA = {
    "P": np.array([0.19205, 0.034125, 0.020175, 0.03, 0.015, 0.0375, 0.02]),
    "S": np.array([0.3841, 0.06825, 0.04035, 0.024, 0.012, 0.03, 0.016]),
    "M": np.array([0.3841, 0.06825, 0.04035, 0.12, 0.06, 0.15, 0.08]),
}
PAYLOAD_1KG = np.array([0.2125, 0.105, 0.090, 0.0, 0.0, 0.0, 0.0])

SUBSTEPS = 8
STICTION_RAD_S = 1e-3
TRACKING_RAD_S = 2.0 * np.pi * 200.0
ENCODER_LSB_RAD = 2.0 * np.pi / 2**20
VELOCITY_LSB_RAD_S = 5e-4
TORQUE_LSB_NM = 100.0 / 2**16
TORQUE_NOISE_NM = 0.02


@compiled
def acceleration(q, dq, tau, theta):
    """Forward dynamics, from the Lagrangian T = ½ M11 dq1² + M12 dq1 dq2 + ½ M22 dq2²."""
    a1, a2, a3, fv1, fv2, fc1, fc2 = theta
    c2, s2 = np.cos(q[1]), np.sin(q[1])
    m11, m12, m22 = a1 + 2.0 * a2 * c2, a3 + a2 * c2, a3
    slope11, slope12 = -2.0 * a2 * s2, -a2 * s2
    # d/dt (dT/d dq) - dT/dq without the terms of ddq
    h1 = slope11 * dq[1] * dq[0] + slope12 * dq[1] * dq[1]
    h2 = slope12 * dq[1] * dq[0] - (0.5 * slope11 * dq[0] * dq[0] + slope12 * dq[0] * dq[1])
    f1 = fv1 * dq[0] + fc1 * min(max(dq[0] / STICTION_RAD_S, -1.0), 1.0)
    f2 = fv2 * dq[1] + fc2 * min(max(dq[1] / STICTION_RAD_S, -1.0), 1.0)
    r1, r2 = tau[0] - h1 - f1, tau[1] - h2 - f2
    determinant = m11 * m22 - m12 * m12
    return np.array([(m22 * r1 - m12 * r2) / determinant, (m11 * r2 - m12 * r1) / determinant])


@compiled
def advance(q, dq, tracked_q, tracked_dq, tau, theta, period_s):
    """Move the arm and the drives' velocity loops by one period, RK4, in place."""
    h = period_s / SUBSTEPS
    for _ in range(SUBSTEPS):
        k1 = acceleration(q, dq, tau, theta)
        k2 = acceleration(q + 0.5 * h * dq, dq + 0.5 * h * k1, tau, theta)
        k3 = acceleration(q + 0.5 * h * dq + 0.25 * h * h * k1, dq + 0.5 * h * k2, tau, theta)
        k4 = acceleration(q + h * dq + 0.5 * h * h * k2, dq + h * k3, tau, theta)
        q += h * dq + h * h / 6.0 * (k1 + k2 + k3)
        dq += h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        error = np.round(q / ENCODER_LSB_RAD) * ENCODER_LSB_RAD - tracked_q
        tracked_q += h * (tracked_dq + 2.0 * TRACKING_RAD_S * error)
        tracked_dq += h * TRACKING_RAD_S * TRACKING_RAD_S * error
