"""The bound of every detector: the likelihood ratio of an onset of known instant and shape, in the sensors' noise.

The residual r (n, 2) with the true parameters, the velocity's lag matched and a filter too fast to matter, holds the
noise of all sensors and what friction's model leaves. A vector autoregression whitens it:

    e(k) = r(k) − Σ Aⱼ r(k − j),    cov e = Σ

An external torque of size u adds u s(k) to r, s its known response, measured as the difference of two records with the
same noise, one of them pushed. The likelihood ratio is Gaussian with the distance u d(T),

    d²(T) = Σ_{k ≤ T} s̃(k)ᵀ Σ⁻¹ s̃(k),    s̃ = s whitened

Its median reaches a threshold z, that of the wanted false-alarm rate at a decision per millisecond, joint and sign, as
soon as u d(T) ≥ z.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from campaign_schemes import true_residual
from lab import PERIOD_S, LabArm, Push, Recording, random_moves, record
from numpy.typing import NDArray
from scipy.stats import norm

from firmware_sim.arm.sensing import VELOCITY_LOOP_HZ

FAST_RAD_S = 800.0
LAG_S = 1.0 / (np.pi * VELOCITY_LOOP_HZ)
"""Of the drive's velocity."""
ORDER = 24
WINDOW_S = 0.25
RESPONSE_SAMPLES = 20
"""After these the step response is what it stays, but for noise."""
NOISE_S = 60.0
ONSETS = 12
REVERSAL_RAD_S = 0.02
RATE_PER_H = 1.0 / 24.0
DECISIONS_PER_H = 3600.0 / PERIOD_S * 2 * 2


def threshold_sigma() -> float:
    """Return z of the false-alarm rate that a day without alarm stands for."""
    return float(norm.isf(RATE_PER_H / DECISIONS_PER_H))


@dataclass(frozen=True)
class Bound:
    """The bound of one arm. coefficients (ORDER, 2, 2) Aⱼ, covariance (2, 2) Σ, steps (2, n, 2): s of a unit step."""

    coefficients: NDArray[np.float64]
    covariance: NDArray[np.float64]
    steps: NDArray[np.float64]

    def distance(self, response: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return d (n,) after each sample of a response (n, 2) that begins with its first row."""
        whitened = whiten(response, self.coefficients)
        inverse = np.linalg.inv(self.covariance)
        result: NDArray[np.float64] = np.sqrt(np.cumsum(np.einsum("ki,ij,kj->k", whitened, inverse, whitened)))
        return result

    @cached_property
    def step_distances(self) -> NDArray[np.float64]:
        """Distances d (2, n) of a unit step on either joint."""
        return np.stack([self.distance(self.steps[joint]) for joint in range(2)])

    def delay_s(self, joint: int, step_Nm: float) -> float:
        """Return the median delay of a step, inf when it is not found within WINDOW_S."""
        found = np.flatnonzero(step_Nm * self.step_distances[joint] >= threshold_sigma())
        return float((found[0] + 0.5) * PERIOD_S) if found.size else float("inf")

    def contact_delay_s(self, tau_ext: NDArray[np.float64]) -> float:
        """Return the delay of a contact with this torque (n, 2), from its first sample on; inf when it is not found."""
        response = np.zeros_like(tau_ext)
        for joint in range(2):
            impulse = np.diff(self.steps[joint][:RESPONSE_SAMPLES], axis=0, prepend=np.zeros((1, 2)))
            for i in range(2):
                response[:, i] += np.convolve(tau_ext[:, joint], impulse[:, i])[: len(tau_ext)]
        found = np.flatnonzero(self.distance(response) >= threshold_sigma())
        return float((found[0] + 0.5) * PERIOD_S) if found.size else float("inf")

    def smallest_Nm(self, joint: int, within_s: float = 0.1) -> float:
        """Return the smallest step that is found in time."""
        return float(threshold_sigma() / self.step_distances[joint, round(within_s / PERIOD_S)])


def whiten(values: NDArray[np.float64], coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Apply the autoregression to (n, 2); before the first row there was nothing."""
    out = values.copy()
    for lag, matrix in enumerate(coefficients, start=1):
        out[lag:] -= values[:-lag] @ matrix.T
    return out


def fit(residual: NDArray[np.float64], is_good: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fit coefficients and covariance to the rows of a residual (n, 2) whose whole past is good."""
    n = len(residual)
    past = np.hstack([residual[ORDER - lag : n - lag] for lag in range(1, ORDER + 1)])
    counted = np.convolve(~is_good, np.ones(ORDER + 1))[ORDER:n] == 0
    past, now = past[counted], residual[ORDER:][counted]
    solution, *_ = np.linalg.lstsq(past, now, rcond=None)
    error = now - past @ solution
    coefficients = solution.T.reshape(2, ORDER, 2).transpose(1, 0, 2)
    return coefficients, error.T @ error / len(error)


def bound_of(arm: LabArm, seed: int = 1) -> Bound:
    """Measure the bound of an arm with its payload, on random moves."""
    motion = random_moves(seed, NOISE_S, speed_share=(0.3, 1.0))
    feedforward = ((0.0, arm.theta),)

    def residual(pushes: Sequence[Push]) -> tuple[Recording, NDArray[np.float64]]:
        recording = record(arm, motion, seed, pushes=tuple(pushes), feedforward=feedforward)
        return recording, true_residual(recording, FAST_RAD_S, LAG_S)

    recording, quiet = residual(())
    is_good = (np.abs(recording.dq) > REVERSAL_RAD_S).all(1)
    is_good[:200] = False
    coefficients, covariance = fit(quiet, is_good)
    window = round(WINDOW_S / PERIOD_S)
    steps = []
    onsets = np.linspace(3.0, NOISE_S - 3.0, ONSETS)
    for joint in range(2):
        unit = (1.0, 0.0) if joint == 0 else (0.0, 1.0)
        _, pushed = residual([Push(float(at_s) + 0.5 * PERIOD_S, WINDOW_S, unit) for at_s in onsets])
        firsts = [round(float(at_s) / PERIOD_S) + 1 for at_s in onsets]
        steps.append(np.median([(pushed - quiet)[first : first + window] for first in firsts], axis=0))
    return Bound(coefficients, covariance, np.array(steps))
