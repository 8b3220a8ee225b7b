"""The bank of filters: the torque filter of eq. (16) with several cut-offs on one stream, each with its own regressor.

A filter that is slow keeps noise and short errors of the model down and finds the smallest torque; one that is fast
finds a larger one sooner. Each obeys the equations of `torque_filter`, with b = a, so its DC gain is 1.

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

from adacd_hil import linalg
from adacd_hil.compiled import compiled
from adacd_hil.records import Vector
from adacd_hil.scheme.memory import Constants, Memory
from adacd_hil.scheme.model.torque_filter import (
    FirstOrderHold,
    advance,
    advance_regressor,
    first_order_hold,
    low_pass,
    resume,
)
from adacd_hil.settings.configuration import Settings

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
    """Return (cut-off, smoothing), rad/s, of each channel; smoothing None for a bare one.

    First the smoothed ones of all filters, then the bare ones of all but the slow filter.
    """
    cutoffs, smoothing = settings.certified.cutoffs_rad_s, settings.certified.smoothing_rad_s
    return (*((cutoff, smoothing) for cutoff in cutoffs), *((cutoff, None) for cutoff in cutoffs[1:]))


def step_response(after_s: float, a_rad_s: float, b_rad_s: float | None) -> float:
    """Return the output, after_s after a step of 1 at the input, of a low-pass of cut-off a_rad_s.

    With b_rad_s, of two low-passes in a row: 1 - (b e^(-a t) - a e^(-b t)) / (b - a).
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
    """Advance all filters over one period to a sample, Y_p, Y_h of `m` and tau_J (n,).

    is_seen: False after a gap: the filters resume from the sample. `rates` (3, C) of `m`: the filters' coefficients for
    the period, see `choose_rates`.
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
            advance(hold, tau_old, tau_J, own.tau_f[c])
            advance_regressor(hold, a, a, m.regressor.Y_p, m.regressor.Y_h, input_old, S, W_f)
        else:
            resume(a, a, m.regressor.Y_p, m.regressor.Y_h, tau_J, input_old, tau_old, S, W_f)


@compiled
def fill_lag(cutoff_rad_s: Vector, tau_J: Vector, tau_f: Vector, first_column: int, W_f: Vector) -> None:
    """Write the columns of the lag into W_f (C, n, p), from `first_column` on: the filtered derivative of each tau_J.

    Only the cells of a joint's own lag are written.
    """
    for c in range(cutoff_rad_s.shape[0]):
        for i in range(tau_J.shape[0]):
            W_f[c, i, first_column + i] = cutoff_rad_s[c] * (tau_J[i] - tau_f[c, i])


@compiled
def fill_cross_talk(tau_f: Vector, first_column: int, W_f: Vector) -> None:
    """Write the other joint's filtered torque into W_f (C filters, 2, p).

    Joint 1's row at `first_column`, joint 2's at the next. All other cells stay as they are. The other joint's torque
    is itself distorted by cross-talk, but that error is of second order.
    """
    for c in range(W_f.shape[0]):
        W_f[c, 0, first_column] = tau_f[c, 1]
        W_f[c, 1, first_column + 1] = tau_f[c, 0]


@compiled
def smooth_learnt(smoothing: float, W_f: Vector, tau_f: Vector, W_learnt: Vector, tau_learnt: Vector) -> None:
    """Advance the learnt signals, W_learnt (n, p) and tau_learnt (n,), over one period behind the filter `LEARNT`.

    smoothing: share of the old value that stays; 0 passes W_f and tau_f of that filter unchanged.
    """
    low_pass(smoothing, tau_f[LEARNT], tau_learnt)
    for i in range(W_learnt.shape[0]):
        low_pass(smoothing, W_f[LEARNT, i], W_learnt[i])


@compiled
def estimate_external(tau_f: Vector, W_f: Vector, theta: Vector, tau_ext_hat: Vector) -> None:
    """Fill the external torque (C, n) that each filter sees, Nm: eq. (13) with our sign, for filters with DC gain 1."""
    for c in range(W_f.shape[0]):
        for i in range(W_f.shape[1]):
            tau_ext_hat[c, i] = linalg.misfit(W_f[c, i], theta, tau_f[c, i])


@compiled
def smooth(smoothing: float, r: Vector, y: Vector) -> None:
    """Advance the channels y (2 C - 1, n) by one period: r (C, n) through a second low-pass, then copies of r[1:].

    smoothing: share of the old value that stays after one period; 0 passes r unchanged. The drive's velocity noise
    rises with frequency up to the bandwidth of its tracking loop. A first-order filter passes it on through the
    momentum undiminished; a second pole takes it away, for a few milliseconds of a small step's detection. A large step
    is detected in the bare residual first.
    """
    count = r.shape[0]
    for c in range(count):
        low_pass(smoothing, r[c], y[c])
        for i in range(r.shape[1]):
            if c > 0:
                y[count + c - 1, i] = r[c, i]
