"""The torque filter F(s) = b / (s + a) of eq. (16), exact for inputs that are straight lines between samples.

One discretisation serves the measured torque and each term of the regressor: the filter acts on both alike, so that the
residual contains only the model's error. A zero-order hold on the velocity terms costs 14 mNm at a = 10 rad/s; the
straight line costs less than 1 mNm. Over one period T with x' = -a x + b u and u going straight from u_old to u_new:

    x_new = E x_old + w_old u_old + w_new u_new,    E = exp(-a T)
    w_new = (b / a) (1 - (1 - E) / (a T)),          w_old = (b / a) (1 - E) - w_new

Filtered regressor, from the paper's eq. (5) with M dq = Y_p theta, and -C' dq + friction + gravity = Y_h theta:

    W_f = b Y_p + S,    S = F (Y_h - a Y_p),    S(0) = -b Y_p(0)

S(0) is the term -f(t) M(q(0)) dq(0) of eq. (5): L[Y_p] starts at (b / a) Y_p(0).

**After a gap** (start-up, start of an adaptation, more missing samples than are interpolated) the motion between two
samples is unknown. tau_f = W_f theta + tau_ef holds for convolutions over any set of times, as it does for the equation
of motion at each of them, so the gap is cut out of time: tau_f and W_f go on with the values they had, and S is set to

    S = W_f - b Y_p(now).

The residual tau_f - W_f theta is then continuous for every theta, and goes on being exactly the filtered external
torque of the times that were seen. From tau_f = 0 and W_f = 0 this is the start of eq. (5).

**The interval** is the one between two samples. Devices sample when SYNC reaches them, so it is the interval of the
SYNCs, which the host measures. With the nominal one in its place, a SYNC that is 0.8 ms late leaves b T tau of 0.08 Nm
in the residual at 10 Nm.

Shapes: Y_p, Y_h, S, W_f (2, p); tau_f (2,).
"""

import math
from typing import NamedTuple

from adacd_hil.compiled import compiled
from adacd_hil.records import Vector


class FirstOrderHold(NamedTuple):
    """Coefficients of a filter for one period: x_new = decay x_old + weight_old u_old + weight_new u_new."""

    decay: float
    weight_old: float
    weight_new: float


@compiled
def first_order_hold(a_rad_s: float, b_rad_s: float, period_s: float) -> FirstOrderHold:
    """Return the coefficients of the filter b / (s + a) for inputs that are straight lines over one period."""
    missing = -math.expm1(-a_rad_s * period_s)  # 1 - E without cancellation
    dc_gain = b_rad_s / a_rad_s
    weight_new = dc_gain * (1.0 - missing / (a_rad_s * period_s))
    return FirstOrderHold(math.exp(-a_rad_s * period_s), dc_gain * missing - weight_new, weight_new)


@compiled
def advance(hold: FirstOrderHold, u_old: Vector, u_new: Vector, x: Vector) -> None:
    """Advance the filtered values x (m,) over one period in place; copy u_new to u_old."""
    for i in range(x.shape[0]):
        x[i] = hold.decay * x[i] + (hold.weight_old * u_old[i] + hold.weight_new * u_new[i])
        u_old[i] = u_new[i]


@compiled
def low_pass(share: float, x: Vector, y: Vector) -> None:
    """Advance y (m,) over one period in place towards x (m,). share: of the old value that stays; 0 copies x."""
    for i in range(y.shape[0]):
        y[i] = x[i] + share * (y[i] - x[i])


@compiled
def advance_regressor(
    hold: FirstOrderHold, a: float, b: float, Y_p: Vector, Y_h: Vector, input_old: Vector, S: Vector, W_f: Vector
) -> None:
    """Advance S and W_f (2, p) over one period in place; input_old (2, p) becomes Y_h - a Y_p of this sample.

    a, b: of F(s), rad/s.
    """
    for i in range(W_f.shape[0]):
        for j in range(W_f.shape[1]):
            input_new = Y_h[i, j] - a * Y_p[i, j]
            S[i, j] = hold.decay * S[i, j] + (hold.weight_old * input_old[i, j] + hold.weight_new * input_new)
            W_f[i, j] = b * Y_p[i, j] + S[i, j]
            input_old[i, j] = input_new


@compiled
def resume(
    a: float,
    b: float,
    Y_p: Vector,
    Y_h: Vector,
    tau_new: Vector,
    input_old: Vector,
    tau_old: Vector,
    S: Vector,
    W_f: Vector,
) -> None:
    """Set S and input_old (2, p), tau_old (2,) in place so that the filters go on from this sample after a gap.

    W_f (2, p) and the filtered torque stay as they were. a, b: of F(s), rad/s.
    """
    for i in range(W_f.shape[0]):
        tau_old[i] = tau_new[i]
        for j in range(W_f.shape[1]):
            S[i, j] = W_f[i, j] - b * Y_p[i, j]
            input_old[i, j] = Y_h[i, j] - a * Y_p[i, j]
