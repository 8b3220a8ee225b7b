"""The bank of filters: the torque filter of eq. (16) with several cut-offs on one stream, each with its own regressor.

A filter that is slow keeps noise and short errors of the model down and finds the smallest torque; one that is fast
finds a larger one sooner. Each obeys the equations of `adacd_hil.scheme.model.filters` with b = a, so its DC gain is 1.

Beside the columns of the dynamic parameters a filtered regressor has those of the torque sensors' offsets (input 1)
and of the lag by which the measured velocity is older than the torque. For a lag d the torque that belongs to the
measured motion is tau_J(t - d), so tau_J = W theta + d tau_J' to first order, and the filtered derivative needs no
differentiation: F s tau_J = a (tau_J - tau_f).

A filter's output is smoothed to make its channel. The faster ones have a second channel that isn't, the bare one.

What is learnt from is smoothed as well, regressor and torque alike. Least squares take noise in a regressor for motion
that made no torque, and find the less inertia the more there is of it: with encoders of 18 bits 3 to 7 % less from the
bare filter of 50 rad/s, less than 0.2 % from the smoothed one (profile P, nine minutes of motion, 2026-11).

Shapes: C filters, 2 C - 1 channels, n joints, p columns. cutoff, decay, weight_old, weight_new (C,); Y_p, Y_h (n, p);
tau_f (C, n); S, W_f, input_old (C, n, p); W_learnt (n, p), tau_learnt (n,). Units: rad/s, Nm.
"""

import math

from adacd_hil.compiled import compiled
from adacd_hil.records import Vector
from adacd_hil.scheme.model import filters
from adacd_hil.settings.configuration import Settings

SLOW = 0
"""Filter by which a model is tested and reported: the slow one, whose noise is least."""
LEARNT = 1
"""Filter that is learnt from: faster than that, so its samples are soon independent, and reversals show."""
WIDE = 1
"""Filter whose output, with the filter undone, is the external torque of contact reports: undoing a faster one would
bring back the noise that it let through."""


@compiled
def filter_of(channel: int, filters: int) -> int:
    """Return the filter of a channel: C smoothed ones, then the bare ones of all filters but the slow one."""
    return channel if channel < filters else channel - filters + 1


def channels_of(settings: Settings) -> tuple[tuple[float, float | None], ...]:
    """List cut-off and smoothing, rad/s, of the channels, in their order; smoothing None of a bare one."""
    cutoffs, smoothing = settings.certified.cutoffs_rad_s, settings.certified.smoothing_rad_s
    return (*((cutoff, smoothing) for cutoff in cutoffs), *((cutoff, None) for cutoff in cutoffs[1:]))


def step_response(after_s: float, a_rad_s: float, b_rad_s: float | None) -> float:
    """Return what a low-pass, or two in a row, shows of a step of 1: 1 - (b e^(-a t) - a e^(-b t)) / (b - a)."""
    if b_rad_s is None:
        return 1.0 - math.exp(-a_rad_s * after_s)
    a, b = a_rad_s, b_rad_s if b_rad_s != a_rad_s else b_rad_s * (1.0 + 1e-6)
    return 1.0 - (b * math.exp(-a * after_s) - a * math.exp(-b * after_s)) / (b - a)


@compiled
def discretise(cutoff_rad_s: Vector, period_s: float, decay: Vector, weight_old: Vector, weight_new: Vector) -> None:
    """Fill what one period does to each filter (C,)."""
    for c in range(cutoff_rad_s.shape[0]):
        decay[c], weight_old[c], weight_new[c] = filters.first_order_hold(cutoff_rad_s[c], cutoff_rad_s[c], period_s)


@compiled
def advance(
    cutoff_rad_s: Vector,
    decay: Vector,
    weight_old: Vector,
    weight_new: Vector,
    Y_p: Vector,
    Y_h: Vector,
    tau_J: Vector,
    tau_old: Vector,
    input_old: Vector,
    S: Vector,
    tau_f: Vector,
    W_f: Vector,
) -> None:
    """Take all filters over one period in place; tau_J (n,) becomes tau_old."""
    for c in range(cutoff_rad_s.shape[0]):
        filters.advance_torque(decay[c], weight_old[c], weight_new[c], tau_old[c], tau_J, tau_f[c])
        a = cutoff_rad_s[c]
        filters.advance_regressor(
            decay[c], weight_old[c], weight_new[c], a, a, Y_p, Y_h, input_old[c], S[c], W_f[c]
        )  # fmt: skip


@compiled
def resume(
    cutoff_rad_s: Vector,
    Y_p: Vector,
    Y_h: Vector,
    tau_J: Vector,
    tau_old: Vector,
    input_old: Vector,
    S: Vector,
    W_f: Vector,
) -> None:
    """Start again from this sample after a gap, with tau_f and W_f as they were; see `filters`."""
    for c in range(cutoff_rad_s.shape[0]):
        filters.resume(cutoff_rad_s[c], cutoff_rad_s[c], Y_p, Y_h, tau_J, input_old[c], tau_old[c], S[c], W_f[c])


@compiled
def fill_lag(cutoff_rad_s: Vector, tau_J: Vector, tau_f: Vector, first_column: int, W_f: Vector) -> None:
    """Fill the columns of the lag, one per joint from `first_column` on: the filtered derivative of the torque."""
    for c in range(cutoff_rad_s.shape[0]):
        for i in range(tau_J.shape[0]):
            W_f[c, i, first_column + i] = cutoff_rad_s[c] * (tau_J[i] - tau_f[c, i])


@compiled
def fill_cross_talk(tau_f: Vector, first_column: int, W_f: Vector) -> None:
    """Fill the columns of cross-talk, one per joint from `first_column` on: the other joint's filtered torque.

    Of two joints. What another joint's sensor shows too much or too little is in that torque as well, but to a share of
    a share.
    """
    for c in range(W_f.shape[0]):
        W_f[c, 0, first_column] = tau_f[c, 1]
        W_f[c, 1, first_column + 1] = tau_f[c, 0]


@compiled
def smooth_learnt(smoothing: float, W_f: Vector, tau_f: Vector, W_learnt: Vector, tau_learnt: Vector) -> None:
    """Take what is learnt from, W_learnt (n, p) and tau_learnt (n,), over one period behind the filter `LEARNT`."""
    for i in range(tau_learnt.shape[0]):
        tau_learnt[i] = tau_f[LEARNT, i] + smoothing * (tau_learnt[i] - tau_f[LEARNT, i])
        for j in range(W_learnt.shape[1]):
            W_learnt[i, j] = W_f[LEARNT, i, j] + smoothing * (W_learnt[i, j] - W_f[LEARNT, i, j])


@compiled
def estimate_external(tau_f: Vector, W_f: Vector, theta: Vector, tau_ext_hat: Vector) -> None:
    """Fill the external torque (C, n) that each filter sees, Nm: eq. (13) with our sign, for filters with DC gain 1."""
    for c in range(W_f.shape[0]):
        for i in range(W_f.shape[1]):
            total = -tau_f[c, i]
            for j in range(W_f.shape[2]):
                total += W_f[c, i, j] * theta[j]
            tau_ext_hat[c, i] = total


@compiled
def smooth(smoothing: float, r: Vector, y: Vector) -> None:
    """Take the channels y (2 C - 1, n) over one period: r (C, n) through a second low-pass, then all but r[0] as is.

    The drive's velocity noise rises with frequency up to the bandwidth of its tracking loop. A first-order filter
    passes it on through the momentum undiminished; a second pole takes it away, for a few milliseconds of a small
    step's detection. What is large enough is found in the bare residual first.
    """
    count = r.shape[0]
    for c in range(count):
        for i in range(r.shape[1]):
            y[c, i] = r[c, i] + smoothing * (y[c, i] - r[c, i])
            if c > 0:
                y[count + c - 1, i] = r[c, i]
