"""Detectors of an external torque, all on one stream, each with one statistic per channel and joint.

**The stream** is the external torque of one sample, unfiltered, in Nm, positive when the environment pushes toward +q.
With M dq = Y_p theta and -C' dq + g + friction = Y_h theta, and a velocity that is `lag_s` older than the torque,

    z = (Y_p,new - Y_p,old) theta / T + (Y_h,new + Y_h,old) theta / 2
        - (tau_new + tau_old) / 2 + lag_s (tau_new - tau_old) / T

the mean over the interval. Every detector here is a filter of z; the paper's residual is z through 1 / (s + a) times a.

**A joint that stands still** can hold any torque up to F_c, which no model predicts. Its largest effect on a channel is
F_c times the channel's own filter of the indicator "stands still". This is subtracted: a statistic is

    |x| - allowance,                                           in Nm but for `likelihood ratio` and `cusum`

and there is an alarm when it is above the threshold h of that channel and joint.

channel            x
first-order a      low-pass of cut-off a; a = 10 rad/s is the paper's
smoothed a         the same with a second low-pass: a velocity from a tracking loop has noise that grows with frequency
                   up to the loop's cut-off, which one pole passes on as it is
band-pass          first-order at its upper less first-order at its lower cut-off
observer K         generalised-momentum observer of gain K by the implicit trapezoid
likelihood N       log-likelihood of a step that began N samples ago: the stream's own covariance whitens it; in sigmas
cusum              sum of the excess of the smoothed channel of highest cut-off over a drift; in Nm s

**Further detectors** are registered (`detector_registry`), one channel each. They run wherever those above do: in
thresholds, in the comparison of `thresholds --report`, and in `tune`.

A step of tau_ext passes h of a first-order channel after -ln(1 - h / |tau_ext|) / a. Without the drift, the sum is h
after h / |tau_ext|.

Sources: De Luca and Mattone, "Sensorless robot collision detection and hybrid force/motion control", ICRA 2005
(observer); Basseville and Nikiforov, "Detection of Abrupt Changes", 1993, chapters 2 and 7 (the last two).
"""

import math
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from scipy.linalg import solve_toeplitz

from adacd_hil.compiled import compiled
from adacd_hil.lab.detectors.detector_registry import (
    CUTOFFS_RAD_S,
    OBSERVERS_RAD_S,
    ONSET_SAMPLES,
    OWN_CHANNELS,
    registered,
    statistics_of,
)
from adacd_hil.records import Vector
from adacd_hil.scheme.model import regressor
from adacd_hil.structured import PerJoint, Structured, packed, zeros_of

VELOCITY_LAG_S: Final = 1.25e-3
"""The emulated drives: 1.59 ms of their tracking loop less 0.34 ms, since a commanded torque is a step at the start of
the interval and not a straight line over it."""
SMOOTHING_RAD_S: Final = 200.0
"""The second pole of the smoothed channels."""
BAND_RAD_S: Final = (10.0, 100.0)
"""Lower and upper cut-off of the band-pass."""
DRIFT_NM: Final = 0.02
"""Smoothed torque that cusum ignores."""
FLOOR_NM: Final = 2e-3
"""Slow errors of the model, a constant of unknown size; without them a likelihood window would trust averages longer
than any model deserves."""
STANDSTILL_RAD_S: Final = 2e-3
"""A slower joint stands still; five times the velocity's noise."""


def likelihood_windows(autocovariance: Vector, onset_samples: tuple[int, ...], lag_s: float, period_s: float) -> Vector:
    """Return one joint's likelihood weights (N, L), the newest sample's first, from the covariance (L,) of its z.

    N: number of `onset_samples`, the ages of the steps. With the covariance R of the last L samples, FLOOR_NM included,
    and the step's shape s, w = R^-1 s / sqrt(s' R^-1 s): noise of the covariance R comes out with a standard deviation
    of 1, and no other window gives the step more. The shape is the response of a critically damped loop to a step.
    lag_s: of that loop. Raises ValueError unless L is at least the largest age and the variance, the covariance's first
    element, is positive.
    """
    length = autocovariance.shape[0]
    if length < max(onset_samples):
        raise ValueError(f"a covariance of {length} samples for a step of {max(onset_samples)}")
    if not autocovariance[0] > 0.0:
        raise ValueError(f"the stream's variance is {autocovariance[0]} Nm²")
    weights = np.zeros((len(onset_samples), length))
    for row, age in enumerate(onset_samples):
        since = 2.0 * period_s * (age - np.arange(length)) / max(lag_s, 1e-9)
        shape = np.where(since > 0.0, 1.0 - (1.0 + since) * np.exp(-np.maximum(since, 0.0)), 0.0)
        column = autocovariance + FLOOR_NM**2
        whitened = solve_toeplitz(column, shape)
        weights[row] = whitened / math.sqrt(float(whitened @ shape))
    return weights


def autocovariance(z: Vector, length: int) -> Vector:
    """Return an estimate of the covariance (length,) of a zero-mean series (n,) with itself, at lags from 0.

    The mean is not subtracted. Biased, so that it is positive semidefinite. Raises ValueError if the series is shorter
    than ten times `length`.
    """
    if z.shape[0] < 10 * length:
        raise ValueError(f"{z.shape[0]} samples are too few for a covariance of {length}")
    size = 1 << (z.shape[0] + length - 1).bit_length()
    spectrum = np.abs(np.fft.rfft(z, size)) ** 2
    return np.asarray(np.fft.irfft(spectrum, size)[:length] / z.shape[0])


class DetectorMemory:
    """The memory of the detectors of n joints; last axis: x, and its allowance for friction.

    ring: the last L samples, the newest at index head. up, down: sums of cusum for torques toward +q and -q.
    """

    low: Annotated[Vector, "filters n 2"]
    smooth: Annotated[Vector, "filters n 2"]
    band: Annotated[Vector, "2 n 2"]
    observer: Annotated[Vector, "gains n 2"]
    ring: Annotated[Vector, "length n 2"]
    head: float
    up: PerJoint
    down: PerJoint


@dataclass(frozen=True)
class DetectorConstants:
    """The constants of the detectors of n joints on one stream.

    decay, smoothing, band: share of the old value that each low-pass keeps after one period. gain: of the observers,
    rad/s. weights (n, N, L): of the likelihood, newest sample first. drift_Nm: torque that cusum ignores.
    """

    period_s: float
    decay: Vector
    smoothing: float
    band: Vector
    gain: Vector
    weights: Vector
    drift_Nm: float


def constants_of(weights: Vector, period_s: float) -> Structured:
    """Return the detectors' constants with the joints' likelihood weights (n, N, L), for the compiled `step`."""
    return packed(
        DetectorConstants(
            period_s=period_s,
            decay=np.exp(-np.array(CUTOFFS_RAD_S) * period_s),
            smoothing=math.exp(-SMOOTHING_RAD_S * period_s),
            band=np.exp(-np.array(BAND_RAD_S) * period_s),
            gain=np.array(OBSERVERS_RAD_S),
            weights=weights,
            drift_Nm=DRIFT_NM,
        )
    )


def new_memory(constants: Structured) -> Structured:
    """Return the detectors' memory before the first sample: all zeros. constants: of `constants_of`."""
    c: DetectorConstants = constants[0]
    joints = c.weights.shape[0]
    return zeros_of(
        DetectorMemory, {"n": joints, "filters": c.decay.size, "gains": c.gain.size, "length": c.weights.shape[-1]}
    )


@compiled
def step(constants: Structured, memory: Structured, z: Vector, held_Nm: Vector, statistics: Vector) -> None:
    """Process one sample z (n,), Nm: update `memory`, and overwrite `statistics` (channels, n), both in place.

    The channels are the built-in ones. held_Nm (n,): the friction that may hold each joint, F_c if it stands still,
    else 0.
    """
    c: DetectorConstants = constants[0]
    m: DetectorMemory = memory[0]
    decay, gain, weights = c.decay, c.gain, c.weights
    length = m.ring.shape[0]
    head = (int(m.head) + 1) % length
    m.head = head
    for i in range(z.shape[0]):
        row = 0
        for part in range(2):
            u = z[i] if part == 0 else held_Nm[i]
            m.ring[head, i, part] = u
            for k in range(decay.shape[0]):
                m.low[k, i, part] = u + decay[k] * (m.low[k, i, part] - u)
                low = m.low[k, i, part]
                m.smooth[k, i, part] = low + c.smoothing * (m.smooth[k, i, part] - low)
            for k in range(2):
                m.band[k, i, part] = u + c.band[k] * (m.band[k, i, part] - u)
            for k in range(gain.shape[0]):
                half = 0.5 * gain[k] * c.period_s
                m.observer[k, i, part] = ((1.0 - half) * m.observer[k, i, part] + 2.0 * half * u) / (1.0 + half)
        for k in range(decay.shape[0]):
            statistics[row + k, i] = abs(m.low[k, i, 0]) - m.low[k, i, 1]
            statistics[row + decay.shape[0] + k, i] = abs(m.smooth[k, i, 0]) - m.smooth[k, i, 1]
        row += 2 * decay.shape[0]
        band = m.band[1, i, 0] - m.band[0, i, 0]
        statistics[row, i] = abs(band) - (m.band[1, i, 1] + m.band[0, i, 1])
        row += 1
        for k in range(gain.shape[0]):
            statistics[row + k, i] = abs(m.observer[k, i, 0]) - m.observer[k, i, 1]
        row += gain.shape[0]
        for k in range(weights.shape[1]):
            likelihood, allowance = 0.0, 0.0
            for past in range(length):
                place = head - past if past <= head else head - past + length
                likelihood += weights[i, k, past] * m.ring[place, i, 0]
                allowance += abs(weights[i, k, past]) * m.ring[place, i, 1]
            statistics[row + k, i] = abs(likelihood) - allowance
        row += weights.shape[1]
        last = decay.shape[0] - 1
        x, ignored = m.smooth[last, i, 0], c.drift_Nm + m.smooth[last, i, 1]
        m.up[i] = max(0.0, m.up[i] + (x - ignored) * c.period_s)
        m.down[i] = max(0.0, m.down[i] - (x + ignored) * c.period_s)
        statistics[row, i] = max(m.up[i], m.down[i])


@compiled
def record(
    constants: Structured, memory: Structured, z: Vector, held_Nm: Vector, block_samples: int, peaks: Vector
) -> None:
    """Run `step` over N samples, and write the largest statistic of each block of samples to `peaks`.

    z, held_Nm (N, n); peaks (ceil(N / block_samples), channels, n), overwritten. Updates `memory`. One sample per block
    keeps every statistic.
    """
    statistics = np.empty((peaks.shape[1], peaks.shape[2]))
    for k in range(z.shape[0]):
        step(constants, memory, z[k], held_Nm[k], statistics)
        block = k // block_samples
        for row in range(peaks.shape[1]):
            for i in range(peaks.shape[2]):
                if k % block_samples == 0 or statistics[row, i] > peaks[block, row, i]:
                    peaks[block, row, i] = statistics[row, i]


class DetectorBank:
    """All detectors, built-in and registered, on one stream, from its beginning."""

    def __init__(self, weights: Vector, period_s: float) -> None:
        """Begin all detectors on one stream of a period, s. weights (n, N, L): the joints' likelihood weights.

        Raises DetectorError if a registered detector can't be used.
        """
        self._constants = constants_of(weights, period_s)
        self._memory = new_memory(self._constants)
        self._registered = {name: make(period_s) for name, make in registered().items()}

    def take_stream(self, z: Vector, held_Nm: Vector, block_samples: int = 1) -> Vector:
        """Process N more samples (N, n); return the largest statistic of each block of them.

        The result has the shape (ceil(N / block_samples), channels, n). held_Nm (N, n): the friction that may hold a
        standing joint. One sample per block keeps every statistic. The next call continues the stream with a new block.
        Raises DetectorError if a registered detector raises an error, or breaks its contract.
        """
        if not len(z):
            return np.empty((0, len(OWN_CHANNELS) + len(self._registered), z.shape[1]))
        starts = np.arange(0, len(z), block_samples)
        own = np.empty((len(starts), len(OWN_CHANNELS), z.shape[1]))
        record(self._constants, self._memory, z, held_Nm, block_samples, own)
        further = [
            np.maximum.reduceat(statistics_of(name, detector, z, held_Nm), starts)[:, None]
            for name, detector in self._registered.items()
        ]
        return np.concatenate((own, *further), axis=1)


@compiled
def stream(
    q: Vector,
    dq: Vector,
    tau_J: Vector,
    theta: Vector,
    interval_s: Vector,
    lag_s: float,
    z: Vector,
    held_Nm: Vector,
) -> None:
    """Write a recording's stream z, and the friction that may hold a standing joint, to `z` and `held_Nm` (N, 2), Nm.

    q, dq, tau_J (N, 2), theta (N, p), interval_s (N,). The first sample has z = 0, and so has one whose interval is not
    positive, because the motion before it is unknown. Both ends of an interval are judged by the theta of its end, so
    that a change of theta is not a torque. q1 counts from the level, for the direction of gravity; the rest is
    independent of its zero. lag_s: as of `make_stream`.
    """
    count, joints = q.shape
    Y_p = np.zeros((2, joints, theta.shape[1]))
    Y_h = np.zeros((2, joints, theta.shape[1]))
    for k in range(count):
        new, old = k % 2, (k + 1) % 2
        regressor.fill_momentum(q[k], dq[k], Y_p[new])
        regressor.fill_remainder(q[k], dq[k], 0.0, Y_h[new])
        for i in range(joints):
            stands = abs(dq[k, i]) < STANDSTILL_RAD_S
            if stands:
                Y_h[new, i, regressor.F_C1 + i] = 0.0
            held_Nm[k, i] = max(theta[k, regressor.F_C1 + i], 0.0) if stands else 0.0
            z[k, i] = 0.0
            if k == 0 or not interval_s[k] > 0.0:
                continue
            for j in range(theta.shape[1]):
                rate = (Y_p[new, i, j] - Y_p[old, i, j]) / interval_s[k]
                z[k, i] += (rate + 0.5 * (Y_h[new, i, j] + Y_h[old, i, j])) * theta[k, j]
            z[k, i] -= 0.5 * (tau_J[k, i] + tau_J[k - 1, i])
            z[k, i] += lag_s * (tau_J[k, i] - tau_J[k - 1, i]) / interval_s[k]


def make_stream(
    q: Vector,
    dq: Vector,
    tau_J: Vector,
    theta: Vector,
    interval_s: Vector,
    lag_s: float,
) -> tuple[Vector, Vector]:
    """Return the stream z of a recording, and the friction that may hold a standing joint, both (N, 2), Nm.

    q, dq, tau_J (N, 2), q1 from the level; theta (p,), or (N, p) if it changes, p = 7 or 9; interval_s (N,): time since
    the sample before, 0 or less where samples are missing between. lag_s: by which dq is older than tau_J.
    """
    z, held_Nm = np.zeros(q.shape), np.zeros(q.shape)
    every = np.ascontiguousarray(np.broadcast_to(theta, (q.shape[0], np.shape(theta)[-1])))
    stream(q, dq, tau_J, every, interval_s, lag_s, z, held_Nm)
    return z, held_Nm


def likelihood_weights(z: Vector, lag_s: float, period_s: float) -> Vector:
    """Return the likelihood weights (n, N, L) of all joints, from a contact-free stream z (n_samples, n), Nm.

    lag_s: as of `likelihood_windows`. N is the number of `ONSET_SAMPLES`, L the largest of them plus 16. Raises
    ValueError if z has fewer than 10 L samples, or a joint's variance is 0.
    """
    length = max(ONSET_SAMPLES) + 16
    return np.array(
        [likelihood_windows(autocovariance(column, length), ONSET_SAMPLES, lag_s, period_s) for column in z.T]
    )
