"""The torque filter F(s) = b / (s + a) of eq. (16), exact for inputs that are straight lines between samples; its bank.

One discretisation serves the measured torque and each term of the regressor: the filter acts on both alike, so that the
residual contains only the model's error. A zero-order hold on the velocity terms costs 14 mNm at a = 10 rad/s; the
straight line costs less than 1 mNm. Over one period T with x' = -a x + b u and u going straight from u_old to u_new:

    x_new = E x_old + w_old u_old + w_new u_new,    E = exp(-a T)
    w_new = (b / a) (1 - (1 - E) / (a T)),          w_old = (b / a) (1 - E) - w_new

Filtered regressor, from the paper's eq. (5) with M dq = Y_p theta, and -C' dq + friction + gravity = Y_h theta:

    W_f = b Y_p + S,    S = F (Y_h - a Y_p),    S(0) = -b Y_p(0)

S(0) is the term -f(t) M(q(0)) dq(0) of eq. (5): L[Y_p] starts at (b / a) Y_p(0).

**After a gap** (start-up, start of an adaptation, an overrun, a lost frame) the motion between two samples is unknown.
tau_f = W_f theta + tau_ef holds for convolutions over any set of times, as it does for the equation of motion at each
of them, so the gap is cut out of time: tau_f and W_f go on with the values they had, and S is set to

    S = W_f - b Y_p(now).

The residual tau_f - W_f theta is then continuous for every theta, and goes on being exactly the filtered external
torque of the times that were seen. From tau_f = 0 and W_f = 0 this is the start of eq. (5).

**The interval** is the one between two samples. Devices sample when SYNC reaches them, so it is the interval of the
SYNCs, which the host measures. With the nominal one in its place, a SYNC that is 0.8 ms late leaves b T tau of 0.08 Nm
in the residual at 10 Nm.

Shapes: Y_p, Y_h, S, W_f (2, p); tau_f (2,).

**The bank.** The bank of filters: the torque filter of eq. (16) with several cut-offs on one stream, each with its own
regressor.

A filter that is slow keeps noise and short errors of the model down and finds the smallest torque; one that is fast
finds a larger one sooner. Each obeys the equations above, with b = a, so its DC gain is 1.

Beside the columns of the dynamic parameters a filtered regressor has those of the torque sensors' offsets (input 1)
and of the lag by which the measured velocity is older than the torque. For a lag d the torque that belongs to the
measured motion is tau_J(t - d), so tau_J = W theta + d tau_J' to first order, and the filtered derivative needs no
differentiation: F s tau_J = a (tau_J - tau_f).

A filter's output is smoothed to make its channel. The faster ones have a second channel that isn't, the bare one.

The learnt signals are smoothed as well, regressor and torque alike. Least squares take noise in a regressor for motion
without torque, and find less inertia the more noise there is: with encoders of 18 bits 3 to 7 % less from the bare
filter of 50 rad/s, less than 0.2 % from the smoothed one (profile P, nine minutes of motion, 2026-11).

Shapes: C filters, 2 C - 1 channels, n joints, p columns. cutoff, decay, weight_old, weight_new (C,); Y_p, Y_h (n, p);
tau_f (C, n); S, W_f, input_old (C, n, p); W_learnt (n, p), tau_learnt (n,). Units: rad/s, Nm.
"""

import math
from typing import NamedTuple

from adacd_hil import linalg
from adacd_hil.compiled import compiled
from adacd_hil.records import Vector
from adacd_hil.scheme.memory import Constants, Memory
from adacd_hil.settings.configuration import Settings


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
def advance_torque(hold: FirstOrderHold, tau_old: Vector, tau_new: Vector, tau_f: Vector) -> None:
    """Advance tau_f (2,) over one period in place; copy tau_new to tau_old."""
    for i in range(tau_f.shape[0]):
        tau_f[i] = hold.decay * tau_f[i] + (hold.weight_old * tau_old[i] + hold.weight_new * tau_new[i])
        tau_old[i] = tau_new[i]


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

    W_f (2, p) and tau_f stay as they were. a, b: of F(s), rad/s.
    """
    for i in range(W_f.shape[0]):
        tau_old[i] = tau_new[i]
        for j in range(W_f.shape[1]):
            S[i, j] = W_f[i, j] - b * Y_p[i, j]
            input_old[i, j] = Y_h[i, j] - a * Y_p[i, j]


SLOW = 0
"""Index of the filter for a model's test and report: the slow one, with the least noise."""
LEARNT = 1
"""Index of the filter for learning: faster than the slow one, so its samples are soon independent, and reversals
show."""
WIDE = 1
"""Index of the filter that is undone for the external torque of contact reports: undoing a faster one would bring back
the noise that it let through."""


VELOCITY_STD_SHARE = 0.12
"""Standard deviation of the velocity's noise over its largest value: 4e-4 of 3.3e-3 rad/s, with 2^20 counts and a 200
Hz tracking loop, over hours of motion, 2026-11."""


@compiled
def filter_of(channel: int, filters: int) -> int:
    """Return the index of a channel's filter, from 0. filters: C.

    Channels, from 0: C smoothed ones, then the bare ones of all filters but the slow one.
    """
    return channel if channel < filters else channel - filters + 1


def channels_of(settings: Settings) -> tuple[tuple[float, float | None], ...]:
    """Return cut-off and smoothing, rad/s, of the channels, in their order; smoothing None for a bare one."""
    cutoffs, smoothing = settings.certified.cutoffs_rad_s, settings.certified.smoothing_rad_s
    return (*((cutoff, smoothing) for cutoff in cutoffs), *((cutoff, None) for cutoff in cutoffs[1:]))


def step_response(after_s: float, a_rad_s: float, b_rad_s: float | None) -> float:
    """Return the output of a low-pass, after_s after a step of 1 at its input.

    Of cut-off a, or with b_rad_s of two in a row: 1 - (b e^(-a t) - a e^(-b t)) / (b - a).
    """
    if b_rad_s is None:
        return 1.0 - math.exp(-a_rad_s * after_s)
    a, b = a_rad_s, b_rad_s if b_rad_s != a_rad_s else b_rad_s * (1.0 + 1e-6)
    return 1.0 - (b * math.exp(-a * after_s) - a * math.exp(-b * after_s)) / (b - a)


@compiled
def forget(m: Memory) -> None:
    """Set the filtered torque and regressor, and the learnt ones, to 0."""
    own = m.filters
    own.W_f[:] = 0.0
    own.tau_f[:] = 0.0
    own.W_learnt[:] = 0.0
    own.tau_learnt[:] = 0.0


@compiled
def rest(m: Memory) -> None:
    """Set each filter's regressor and torque to their values after a long rest in the present pose, gravity included.

    From 0, that torque would be a step: the columns of the lag would have its derivative.
    """
    own = m.filters
    for c in range(own.tau_f.shape[0]):
        own.W_f[c] = m.regressor.Y_h
        own.tau_f[c] = own.tau_old[c]


@compiled
def choose_rates(k: Constants, m: Memory, period_s: float) -> None:
    """Fill `rates` (3, C) with each filter's coefficients for a period of period_s, see `FirstOrderHold`."""
    decay, old, new = m.filters.rates[0], m.filters.rates[1], m.filters.rates[2]
    if period_s == k.period_s:
        decay[:] = k.decay
        old[:] = k.weight_old
        new[:] = k.weight_new
    else:
        discretise(k.cutoff, period_s, decay, old, new)


@compiled
def discretise(cutoff_rad_s: Vector, period_s: float, decay: Vector, weight_old: Vector, weight_new: Vector) -> None:
    """Fill decay, weight_old, weight_new (C,) of filters with DC gain 1 for one period, see `FirstOrderHold`."""
    for c in range(cutoff_rad_s.shape[0]):
        decay[c], weight_old[c], weight_new[c] = first_order_hold(cutoff_rad_s[c], cutoff_rad_s[c], period_s)


@compiled
def take_sample(k: Constants, m: Memory, tau_J: Vector, is_seen: bool) -> None:
    """Advance all filters over one period to a sample, Y_p, Y_h of `m` and tau_J (n,); after a gap they resume from it.

    `rates` (3, C) of `m`: the filters' coefficients for the period, see `FirstOrderHold`.
    """
    own = m.filters
    rates = own.rates
    for c in range(k.cutoff.shape[0]):
        a, tau_old, input_old, S, W_f = (
            k.cutoff[c],
            own.tau_old[c],
            own.input_old[c],
            own.S[c],
            own.W_f[c],
        )
        if is_seen:
            hold = FirstOrderHold(rates[0, c], rates[1, c], rates[2, c])
            advance_torque(hold, tau_old, tau_J, own.tau_f[c])
            advance_regressor(hold, a, a, m.regressor.Y_p, m.regressor.Y_h, input_old, S, W_f)
        else:
            resume(a, a, m.regressor.Y_p, m.regressor.Y_h, tau_J, input_old, tau_old, S, W_f)


@compiled
def fill_lag(cutoff_rad_s: Vector, tau_J: Vector, tau_f: Vector, first_column: int, W_f: Vector) -> None:
    """Fill the columns of the lag in W_f (C, n, p), from `first_column` on: the filtered derivative of each tau_J."""
    for c in range(cutoff_rad_s.shape[0]):
        for i in range(tau_J.shape[0]):
            W_f[c, i, first_column + i] = cutoff_rad_s[c] * (tau_J[i] - tau_f[c, i])


@compiled
def fill_cross_talk(tau_f: Vector, first_column: int, W_f: Vector) -> None:
    """Fill the columns of cross-talk in W_f (C, n, p), from `first_column` on: the other joint's filtered torque.

    For two joints. The other joint's torque is itself distorted by cross-talk, but that error is of second order.
    """
    for c in range(W_f.shape[0]):
        W_f[c, 0, first_column] = tau_f[c, 1]
        W_f[c, 1, first_column + 1] = tau_f[c, 0]


@compiled
def smooth_learnt(smoothing: float, W_f: Vector, tau_f: Vector, W_learnt: Vector, tau_learnt: Vector) -> None:
    """Advance the learnt signals, W_learnt (n, p) and tau_learnt (n,), over one period behind the filter `LEARNT`."""
    for i in range(tau_learnt.shape[0]):
        tau_learnt[i] = tau_f[LEARNT, i] + smoothing * (tau_learnt[i] - tau_f[LEARNT, i])
        for j in range(W_learnt.shape[1]):
            W_learnt[i, j] = W_f[LEARNT, i, j] + smoothing * (W_learnt[i, j] - W_f[LEARNT, i, j])


@compiled
def estimate_external(tau_f: Vector, W_f: Vector, theta: Vector, tau_ext_hat: Vector) -> None:
    """Fill the external torque (C, n) that each filter sees, Nm: eq. (13) with our sign, for filters with DC gain 1."""
    for c in range(W_f.shape[0]):
        for i in range(W_f.shape[1]):
            tau_ext_hat[c, i] = linalg.misfit(W_f[c, i], theta, tau_f[c, i])


@compiled
def smooth(smoothing: float, r: Vector, y: Vector) -> None:
    """Advance the channels y (2 C - 1, n) by one period: r (C, n) through a second low-pass, then all but r[0] as is.

    The drive's velocity noise rises with frequency up to the bandwidth of its tracking loop. A first-order filter
    passes it on through the momentum undiminished; a second pole takes it away, for a few milliseconds of a small
    step's detection. A large step is detected in the bare residual first.
    """
    count = r.shape[0]
    for c in range(count):
        for i in range(r.shape[1]):
            y[c, i] = r[c, i] + smoothing * (y[c, i] - r[c, i])
            if c > 0:
                y[count + c - 1, i] = r[c, i]
