"""The thresholds of the certified scheme: largest output of each channel of the bank without a contact.

    h = max(e sqrt((k_tau sigma_tau)² + nu² (M R M')_ii + (k_m g)² + G) + pull, tail) + F_s max(s, LOW_SPEED_SHARE s')

- sigma_tau: white noise of the torque sensor through the channel. A filter of cut-off a leaves sigma sqrt(a T / 2), one
  that is smoothed by s as well sigma sqrt(a s / (a + s) T / 2). A sensor that is noisier at rest raises it.
  Its steps add their own noise and pull (`follow_torque_step`).
- nu, rad/s²: noise of the velocity through the momentum M(q) dq, as its largest value: it stems from the encoder's
  counts and is bounded, not Gaussian. The bare filter multiplies it by a, and BARE; smoothing leaves 0.335 (s / 200) /
  (1 + a / 600) of a (measured with 2^20 counts and a 200 Hz tracking loop, over hours of motion, 2026-11).
- g² = w (u P + D) w': the belief's uncertainty for this very motion, w the filtered regressor's row, and D the errors
  that no parameter explains however long the arm learns. u is the unit of P's variances: 1 for the settings' residual
  of a good model, less or more by the measured residual without contact. While the arm is monitored the mean square of
  the positive residuals and that of the negative ones are followed apart, and the smaller one counts: a push has one
  sign, an error of the model has both. In smoothed channels g is smoothed, too: a bound, since |F x| <= F |x|.
- R: the velocity's noise over that of the settings, squared, measured in its second difference.
- e: 1, or more of a joint that has shown contacts while the arm learnt, or right after going on (`raise_strain`).
- G: uncertainty after lost samples (`lost_samples`). tail: floor by the largest residual seen (`tail`).
- s, s': shares of standstill, and of low speed, in the filter's memory. At standstill friction may hold any torque
  up to F_s: F_c, static friction and friction by load where they are in the model, and as much more as the first two
  are uncertain.

Shapes: C filters, 2 C - 1 channels, n joints, p parameters; r, still, doubt (C, n); y, h (2 C - 1, n); W_f (C, n, p);
M (n, n). Units: Nm.
"""

import math

import numpy as np

from adacd_hil import linalg
from adacd_hil.compiled import compiled
from adacd_hil.records import Vector
from adacd_hil.scheme.detect.undone_filter import WIDE_SAMPLES
from adacd_hil.scheme.memory import Constants, Memory, NoiseConstants
from adacd_hil.scheme.model import filter_bank, further_friction, regressor
from adacd_hil.settings.scheme_settings import CertifiedSettings

SECOND_DIFFERENCE = 0.36
"""Rms of the velocity's second difference over the largest error of a sample: 1e-3 of 3.3e-3 rad/s, and a fifth."""
JUMP = 5.0
"""Largest size of a single jump, in deviations of the noise."""
PULL = 1.3
"""Largest residual by the sensor's steps, over their pull: the model has learnt some of it, too."""
CHANGES, LARGEST_STEP_NM = 50.0, 0.2
"""Changes of a torque sensor's value after which the smallest is taken as its step, and the largest plausible step."""
ROUGHNESS_S, ROUGHNESS_LOST_S = 0.3, 20.0
"""Memory of the velocity's roughness, and time constant of its decay while the joint moves."""
STRAIN = 2.0
LARGEST_STRAIN = 8.0
"""A contact while learning doubles the thresholds, three times at most."""
STRAIN_S = 10.0
"""Time constant of the strain's decay, and of the forgetting of the residual's largest share."""
RELAXED = 0.6
"""Share of its threshold below which the residual must stay for the strain to decay."""
LOW_SPEED_RAD_S, LOW_SPEED_SHARE = 0.1, 0.1
"""Below this speed friction is known less well, by this share of the static friction: bristles bend, lubricant thins.
LuGre friction of 4 mrad on profile M errs by 0.02 Nm there, in each of 14 false alarms of 50 min without this."""
RESTING, MOVING = 0.2, 0.05
"""Share of standstill in a filter's memory above which a joint counts as resting, and below which friction counts as
the model's."""
AGREES = 0.4
"""Share of its threshold that the smoothed channel has at least when the bare one finds a push: 0.5 to 0.75."""
BARE = 1.15
"""Factor for a bare filter, which averages no further: in 24 h of clean motion it came to 1.02 of a threshold
without."""
UNIT_PEAK = 2.5
"""Mean square of the residual in its hard moments over that of all: friction errs where a joint turns round."""
SMALLEST_UNIT = 0.05
LARGEST_UNIT = 9.0
"""Bounds of the unit: a model counts as at most 4.5 times better, or 3 times worse, than its covariance."""
UNIT_S = 20.0
"""Memory of the unit: some swings of a slow motion."""
UNIT_TEST_S = 0.3
"""The same while a frozen model is tested: begun with a unit of 1 it ends near a quarter of it if all is well."""

_SMOOTHED_SHARE = 0.335 / 200.0
_SMOOTHED_FALL_RAD_S = 600.0


def noise_constants(certified: CertifiedSettings, period_s: float) -> NoiseConstants:
    """Return the constants by which noise enters the thresholds: variances by channel (2 C - 1,), weights of a sample.

    The weights (`_share`, `_loss`) are those of one sample in running means. torque_variance: (k_tau sigma_tau)², Nm²;
    torque_gain: the same for a noise of 1 Nm; velocity_variance: nu², rad²/s⁴.
    """
    a, s = np.array(certified.cutoffs_rad_s), certified.smoothing_rad_s
    width = np.concatenate([a * s / (a + s), a[1:]])
    smoothed = np.minimum(_SMOOTHED_SHARE * s / (1.0 + a / _SMOOTHED_FALL_RAD_S), 1.0)
    share = np.concatenate([smoothed, np.full(a.size - 1, BARE)])
    nu = certified.velocity_noise_rad_s * np.concatenate([a, a[1:]]) * share
    gain = certified.noise_sigmas**2 * 0.5 * period_s * width
    return NoiseConstants(
        torque_variance=certified.torque_noise_Nm**2 * gain,
        torque_gain=gain,
        velocity_variance=nu**2,
        velocity_noise_rad_s=certified.velocity_noise_rad_s,
        roughness_share=period_s / ROUGHNESS_S,
        roughness_loss=period_s / ROUGHNESS_LOST_S,
        strain_share=period_s / STRAIN_S,
        unit_share=period_s / UNIT_S,
        unit_test_share=period_s / UNIT_TEST_S,
        velocity_std_rad_s=filter_bank.VELOCITY_STD_SHARE * certified.velocity_noise_rad_s,
    )


@compiled
def follow_standstill(k: Constants, m: Memory, dq: Vector) -> None:
    """Update by one sample each joint's share of standstill in each filter's memory, 0 to 1.

    Written: `still` (C, n); `still_smooth`, the same behind the second low-pass; `low_speed`, for a joint that moves
    slowly or not at all. A joint that turns round between two samples has stood still: by its lag friction may turn a
    sample or two before the measured velocity does.
    """
    own = m.sensitivity
    for c in range(own.still.shape[0]):
        for i in range(dq.shape[0]):
            has_turned = dq[i] * own.dq_old[i] < 0.0
            target = 1.0 if abs(dq[i]) < k.still_rad_s or has_turned else 0.0
            own.still[c, i] = target + k.decay[c] * (own.still[c, i] - target)
            own.still_smooth[c, i] = own.still[c, i] + k.smoothing * (own.still_smooth[c, i] - own.still[c, i])
            target = 1.0 if abs(dq[i]) < LOW_SPEED_RAD_S or has_turned else 0.0
            own.low_speed[c, i] = target + k.decay[c] * (own.low_speed[c, i] - target)


@compiled
def measure_noise(k: Constants, m: Memory, tau_J: Vector) -> None:
    """Add one sample at rest to `roughness` (n,): the torque's variance over that of the settings, at least 1.

    The variance is that of all samples since the start, by the differences of successive ones; the first is only
    stored.
    """
    own = m.sensitivity
    own.rest_samples += 1.0
    for i in range(tau_J.shape[0]):
        if own.rest_samples > 1.0:
            own.rest_square[i] += 0.5 * (tau_J[i] - own.rest_tau[i]) ** 2
            variance = own.rest_square[i] / (own.rest_samples - 1.0)
            own.roughness[i] = max(variance / max(k.torque_noise_Nm**2, 1e-12), 1.0)
        own.rest_tau[i] = tau_J[i]


@compiled
def follow_torque_step(k: Constants, m: Memory, tau_J: Vector) -> None:
    """Update the torque sensors' step L (n,), the smallest change ever seen, and its pull on their mean, by one sample.

    A mean of samples of standard deviation sigma, rounded to L, is off by L / pi exp(-2 (pi sigma / L)²) at most; the
    pull is PULL times that. L is at most LARGEST_STEP_NM, and 0 until CHANGES changes were seen: the first ones may be
    a push.
    """
    own = m.sensitivity
    for i in range(tau_J.shape[0]):
        change = abs(tau_J[i] - m.gaps.last[2, i])  # nan for the first sample
        if not change > 0.0:
            continue
        own.torque_changes[i] += 1.0
        own.torque_change_Nm[i] = change if own.torque_changes[i] == 1.0 else min(change, own.torque_change_Nm[i])
        step_Nm = min(own.torque_change_Nm[i], LARGEST_STEP_NM)
        if own.torque_changes[i] >= CHANGES and step_Nm != own.torque_step_Nm[i]:
            own.torque_step_Nm[i] = step_Nm
            variance = k.torque_noise_Nm**2 * own.roughness[i]
            own.torque_pull_Nm[i] = PULL * step_Nm / np.pi * math.exp(-2.0 * np.pi**2 * variance / step_Nm**2)


@compiled
def follow_velocity_noise(k: Constants, m: Memory, dq: Vector, is_steady: bool) -> None:
    """Update `velocity_roughness` (n,), at least 1, by one sample: the velocity's noise over the settings', squared.

    Noise shows in the second difference of dq, motion does not: at 1 kHz 50 rad/s³ make 5e-5 rad/s of it, a coarse
    encoder's counts 1e-3 and more. A single jump, as of a blow, counts as at most JUMP deviations of the present noise.
    Without is_steady (a gap, or a line over one) only store the sample.

    The roughness decays soon, except for the part that `keep_velocity_noise` keeps.
    """
    own = m.sensitivity
    floor = (SECOND_DIFFERENCE * k.noise.velocity_noise_rad_s) ** 2
    for i in range(dq.shape[0]):
        ddq = dq[i] - own.dq_old[i]
        if is_steady and floor > 0.0:
            square = (ddq - own.ddq_old[i]) ** 2 / floor
            square = min(square, JUMP**2 * own.roughness_now[i])
            now = max(own.roughness_now[i] + k.noise.roughness_share * (square - own.roughness_now[i]), 1.0)
            own.roughness_now[i] = now
            own.velocity_roughness[i] = max(now, own.roughness_kept[i])
        own.ddq_old[i] = ddq
        own.dq_old[i] = dq[i]


@compiled
def keep_velocity_noise(k: Constants, m: Memory) -> None:
    """Raise `roughness_kept` (n,) to the velocity's roughness in a sample without contact; it decays in motion.

    At rest an encoder without counts shows no noise, but shows it again with the first count.
    """
    own = m.sensitivity
    for i in range(own.roughness_kept.shape[0]):
        now, kept = own.roughness_now[i], own.roughness_kept[i]
        if abs(own.dq_old[i]) > regressor.SLOW_RAD_S:
            kept -= k.noise.roughness_loss * (kept - now)
        own.roughness_kept[i] = max(kept, now)


@compiled
def raise_strain(m: Memory, largest: float) -> None:
    """Double `strain`, a factor on thresholds, of each joint over one in any channel, up to `largest`; lower none.

    A contact while learning may be the model's failure. One contact may be a hand; repeated ones come from an error
    that no parameter explains, such as backlash. Then the arm is armed with higher thresholds rather than never.
    """
    own = m.sensitivity
    for i in range(own.strain.shape[0]):
        for c in range(m.filters.y.shape[0]):
            if not (abs(m.filters.y[c, i]) <= own.h[c, i]):
                own.strain[i] = min(STRAIN * own.strain[i], max(largest, own.strain[i]))
                break


@compiled
def decay_strain(k: Constants, m: Memory) -> None:
    """Update `strain`, a factor on the thresholds, and `peak_share` (n,) by one sample without contact.

    The strain decays towards 1 while the residual has stayed below RELAXED of its threshold over about STRAIN_S.
    `peak_share` rises to the sample's largest residual over its threshold.
    """
    own = m.sensitivity
    for i in range(own.strain.shape[0]):
        share = 0.0
        for c in range(m.filters.y.shape[0]):
            share = max(share, abs(m.filters.y[c, i]) / own.h[c, i])
        own.peak_share[i] = max(own.peak_share[i], share)
        own.used[i] = max(share, own.used[i] * (1.0 - k.noise.strain_share))
        if own.used[i] < RELAXED:
            own.strain[i] = max(own.strain[i] * (1.0 - k.noise.strain_share), 1.0)


@compiled
def follow_unit(k: Constants, m: Memory, is_monitored: bool) -> None:
    """Update `unit` (n,), a factor on the belief's variances, by one sample.

    The slow filter's residual counts; in a faster one the velocity's noise would count as the model's error.
    is_monitored: the sample is without contact, and the unit is the smaller one of those of positive and of negative
    residuals. Else the model is in its test, and the unit is that of all residuals, with which both signs begin. A
    joint with an infinite variance, as one at rest, keeps its unit.
    """
    own, share = m.sensitivity, k.noise.unit_share if is_monitored else k.noise.unit_test_share
    for i in range(own.unit.shape[0]):
        w, r = m.filters.W_f[filter_bank.SLOW, i], m.filters.r[filter_bank.SLOW, i]
        believed = k.residual_Nm**2 + own.held[filter_bank.SLOW, i] ** 2
        for j in range(w.shape[0]):
            believed += w[j] * linalg.dot(m.models.P[j], w)
        if not np.isfinite(believed):
            continue
        square = UNIT_PEAK * r**2 / believed
        if not is_monitored:
            own.unit[i] = _approach(own.unit[i], square, share)
            own.unit_by_sign[:, i] = own.unit[i]
            continue
        for sign in range(2):
            has_sign = r > 0.0 if sign else r < 0.0
            own.unit_by_sign[sign, i] = _approach(own.unit_by_sign[sign, i], 2.0 * square if has_sign else 0.0, share)
        own.unit[i] = np.min(own.unit_by_sign[:, i])


@compiled
def _approach(unit: float, square: float, share: float) -> float:
    """Return `unit` moved by `share` of its way to `square`, within SMALLEST_UNIT and LARGEST_UNIT."""
    unit += share * (square - unit)
    return float(min(max(unit, SMALLEST_UNIT), LARGEST_UNIT))


@compiled
def fill_thresholds(k: Constants, m: Memory) -> None:
    """Fill h (2 C - 1, n) with the present thresholds of all channels, Nm; update `doubt` and `h_model`."""
    own, h, filters = m.sensitivity, m.sensitivity.h, m.filters.r.shape[0]
    for i in range(h.shape[1]):
        momentum, hold = momentum_noise(m, i), own.hold[i]
        for c in range(filters):
            g = k.model_sigmas * np.sqrt(_doubt(k, m, m.filters.W_f[c, i], own.unit[i]))
            own.doubt[c, i] = g + k.smoothing * (own.doubt[c, i] - g)
            slow = LOW_SPEED_SHARE * own.low_speed[c, i]
            held = hold * max(own.still_smooth[c, i], slow)
            h[c, i] = _threshold(k, m, c, i, momentum, own.doubt[c, i]) + held
            if c > 0:
                bare = filters + c - 1
                h[bare, i] = _threshold(k, m, bare, i, momentum, g) + hold * max(own.still[c, i], slow)


@compiled
def momentum_noise(m: Memory, joint: int) -> float:
    """Return (M R M')_ii of a joint, from 0: variance of its momentum for a velocity noise of variance R."""
    total = 0.0
    for j in range(m.regressor.M.shape[1]):
        total += m.sensitivity.velocity_roughness[j] * m.regressor.M[joint, j] ** 2
    return float(total)


@compiled
def follow_friction(k: Constants, m: Memory, tau_J: Vector) -> None:
    """Fill `hold` (n,), the torque that friction may hold at rest, and `held` (C, n), its part in each filter, Nm.

    Friction at rest is not noise that averages out: `held` is inf for a joint that rested for a share RESTING or more
    of the filter's memory, so that the joint is not learnt.
    """
    own = m.sensitivity
    for i in range(own.hold.shape[0]):
        own.hold[i] = k.standstill_share * _static_friction(k, m, i, tau_J[i])
        for c in range(own.held.shape[0]):
            own.held[c, i] = held_Nm(m, i, own.still[c, i])


@compiled
def held_Nm(m: Memory, joint: int, still: float) -> float:
    """Return the torque, Nm, that friction at rest may add to a filter's output; inf from a share RESTING on.

    joint: from 0. still: share of standstill in the filter's memory, 0 to 1.
    """
    return float(m.sensitivity.hold[joint] * still) if still < RESTING else np.inf


@compiled
def _static_friction(k: Constants, m: Memory, joint: int, load_Nm: float) -> float:
    """Return the largest friction, Nm, that the model in use allows for a joint at standstill under load_Nm."""
    coulomb, joints = regressor.F_C1 + joint, m.filters.r.shape[1]
    total = max(m.models.theta[coulomb], 0.0) + np.sqrt(max(m.models.P[coulomb, coulomb], 0.0))
    further = 0.0
    for position in range(k.terms.shape[0]):
        term = int(k.first_offset) + (2 + position) * joints + joint
        if k.terms[position] == further_friction.STRIBECK:
            open_Nm = min(np.sqrt(max(m.models.P[term, term], 0.0)), STATIC_SHARE * total)
            further += max(m.models.theta[term], 0.0) + open_Nm
        elif k.terms[position] == further_friction.LOAD:
            further += max(m.models.theta[term], 0.0) * abs(load_Nm)
    return float(total + further)


@compiled
def _threshold(k: Constants, m: Memory, channel: int, joint: int, momentum: float, g: float) -> float:
    """Return a channel's threshold, Nm, without the part for rest; store it in `h_model` without the tail's floor.

    momentum: result of `momentum_noise`. g: deviation by the model's uncertainty, Nm.
    """
    own = m.sensitivity
    lost = m.lost.lost_Nm2[filter_bank.filter_of(channel, own.still.shape[0]), joint]
    noise = k.noise.torque_variance[channel] * own.roughness[joint] + k.noise.velocity_variance[channel] * momentum
    noise += k.noise.torque_gain[channel] * own.torque_step_Nm[joint] ** 2 / 12.0 + lost
    own.h_model[channel, joint] = own.strain[joint] * np.sqrt(noise + g * g) + own.torque_pull_Nm[joint]
    return float(max(own.h_model[channel, joint], m.tail.tail_Nm[channel, joint]))


@compiled
def fill_wide(k: Constants, m: Memory) -> None:
    """Fill `wide_sigma` and `wide_threshold` (n,), Nm: deviation and threshold of the torque with filter WIDE undone.

    The undone filter is a mean over five samples of its input: its noise is white torque noise over five, and the
    velocity's change over five samples. The slow filters detect a slow push first: the threshold is the least of all
    channels'.
    """
    own = m.sensitivity
    samples = float(WIDE_SAMPLES)
    span_s = samples * k.period_s
    for i in range(m.filters.r.shape[1]):
        momentum = momentum_noise(m, i)
        noise = k.torque_noise_Nm**2 * own.roughness[i] / samples
        velocity = 2.0 * (k.noise.velocity_std_rad_s / span_s) ** 2 * momentum
        doubt = own.doubt[filter_bank.WIDE, i] / k.model_sigmas
        own.wide_sigma[i] = np.sqrt(noise + velocity + doubt * doubt)
        own.wide_threshold[i] = np.min(own.h[:, i])


@compiled
def _doubt(k: Constants, m: Memory, w: Vector, unit: float) -> float:
    """Return w (u P + D) w', Nm²: variance of the model's torque for a regressor's row w (p,); unit: u."""
    total = 0.0
    for j in range(w.shape[0]):
        total += unit * w[j] * linalg.dot(m.models.P[j], w) + (k.model_error[j] * m.models.theta[j] * w[j]) ** 2
    return max(total, 0.0)


@compiled
def joints_over(y: Vector, h: Vector) -> int:
    """Return the joints over their threshold in any channel, bit i for joint i + 1; NaN counts as over.

    A bare channel needs the smoothed one of its filter to agree, see AGREES. A push makes them rise together; the trace
    of an encoder's step or a gear's play, a sample or two long, is in the bare one alone.
    """
    filters = (y.shape[0] + 1) // 2
    joints = 0
    for c in range(y.shape[0]):
        for i in range(y.shape[1]):
            is_over = not (abs(y[c, i]) <= h[c, i])
            if is_over and c >= filters and np.isfinite(y[c, i]):
                smoothed = filter_bank.filter_of(c, filters)
                is_over = not (abs(y[smoothed, i]) <= AGREES * h[smoothed, i])
            if is_over:
                joints |= 1 << i
    return joints


STATIC_SHARE = 1.0
"""Largest uncertain static friction beyond Coulomb's, as a share of it: bearings and gears have up to twice."""


def begin(m: Memory) -> None:
    """Set roughness, unit and strain to 1 before the first sample: noise and residuals as in the settings."""
    own = m.sensitivity
    for ones in (own.roughness, own.roughness_now, own.roughness_kept, own.velocity_roughness, own.unit, own.strain):
        ones[:] = 1.0


@compiled
def begin_fit(m: Memory) -> None:
    """Set `unit`, the factor on the belief's variances, to 1 as a fit begins.

    Residuals count as the settings' of a good model until they are measured.
    """
    m.sensitivity.unit[:] = 1.0


@compiled
def lift(m: Memory) -> None:
    """Set `wide_threshold` (n,) to inf, so that no torque counts as over it."""
    m.sensitivity.wide_threshold[:] = np.inf


def take_peak_shares(m: Memory) -> Vector:
    """Return each joint's largest residual over its threshold (n,) in contact-free samples since the last call.

    Set `peak_share` to 0.
    """
    shares = np.array(m.sensitivity.peak_share)
    m.sensitivity.peak_share[:] = 0.0
    return shares
