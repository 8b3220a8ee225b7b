"""Fifth-order polynomials in time: the paper's motion between two corners, and ways from anywhere to rest.

Shapes: positions, velocities, accelerations (2,); coefficients (6, 2), lowest order first. Units: rad, s.
"""

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, Vector

PEAK_SPEED_FACTOR = 1.875
"""Peak speed of a rest-to-rest quintic over its mean speed."""


@compiled
def corner_to_corner(
    elapsed_s: float, amplitude: Vector, half_period_s: Vector, q: Vector, dq: Vector, ddq: Vector
) -> None:
    """Fill the motion from -amplitude to the other corner and back, each joint by its own half period."""
    for i in range(JOINTS):
        index = np.floor(elapsed_s / half_period_s[i])
        direction = 1.0 if index % 2.0 == 0.0 else -1.0
        x = elapsed_s / half_period_s[i] - index
        rate = 1.0 / half_period_s[i]
        travel = 2.0 * amplitude[i] * direction
        q[i] = -amplitude[i] * direction + travel * x * x * x * (10.0 + x * (-15.0 + 6.0 * x))
        dq[i] = travel * rate * x * x * (30.0 + x * (-60.0 + 30.0 * x))
        ddq[i] = travel * rate * rate * x * (60.0 + x * (-180.0 + 120.0 * x))


def to_rest(q: Vector, dq: Vector, ddq: Vector, q_end: Vector, duration_s: float) -> Vector:
    """Return the coefficients (6, 2) that lead from (q, dq, ddq) to rest at `q_end` in `duration_s`."""
    T = duration_s
    travel = q_end - q
    return np.vstack(
        [
            q,
            dq,
            ddq / 2.0,
            (20.0 * travel - 12.0 * dq * T - 3.0 * ddq * T**2) / (2.0 * T**3),
            (-30.0 * travel + 16.0 * dq * T + 3.0 * ddq * T**2) / (2.0 * T**4),
            (12.0 * travel - 6.0 * dq * T - ddq * T**2) / (2.0 * T**5),
        ]
    )


@compiled
def evaluate(coefficients: Vector, elapsed_s: float, q: Vector, dq: Vector, ddq: Vector) -> None:
    """Fill the motion of a quintic at `elapsed_s`."""
    t = elapsed_s
    for i in range(JOINTS):
        c0, c1, c2 = coefficients[0, i], coefficients[1, i], coefficients[2, i]
        c3, c4, c5 = coefficients[3, i], coefficients[4, i], coefficients[5, i]
        q[i] = c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * c5))))
        dq[i] = c1 + t * (2.0 * c2 + t * (3.0 * c3 + t * (4.0 * c4 + t * 5.0 * c5)))
        ddq[i] = 2.0 * c2 + t * (6.0 * c3 + t * (12.0 * c4 + t * 20.0 * c5))
