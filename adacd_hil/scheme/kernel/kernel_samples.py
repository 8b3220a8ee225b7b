"""Input of both kernels: their arrays, the checks of a measurement alone, and the samples lost before it.

A kernel works on three structured arrays of one element each, so that fields have names in compiled code and out of it:
constants from the settings, memory that lasts from one cycle to the next, and the block that is logged. The caller puts
q, dq, tau_J and the measured period_s into the block; a period_s of 0 was not measured.

Shapes: n joints; q, dq, tau_J (n,); last, between (3, n).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, ArmBatch, ArmState, SchemeBlock, Vector
from adacd_hil.scheme.memory import Limits, Sample
from adacd_hil.scheme.supervisor.findings import AT_REST, NOT_A_NUMBER, OVER_LIMIT, UNLOADED, UNSEEN
from adacd_hil.settings.configuration import Settings
from adacd_hil.structured import Structured, described

SHORTEST_SHARE, LONGEST_SHARE = 0.5, 1.5
"""Shortest and longest interval of two samples that follow each other, over the nominal period."""


class Numbers(NamedTuple):
    """A kernel's arrays, each of one element. values: the block's memory as (size,) float64."""

    constants: Structured
    memory: Structured
    block: Structured
    values: Vector


SAMPLE = described(Sample, {"n": JOINTS})


def fill_sample(samples: Structured, arm: ArmState, request: int) -> None:
    """Write arm state and request of one cycle into `samples` (1,), of type SAMPLE.

    `age` is that of the oldest value, `sampled_ns` the cycle's time if the state has no time of the SYNC.
    """
    age = max(*arm.age_q, *arm.age_tau_J)
    sampled_ns = arm.t_ns if arm.sampled_ns is None else arm.sampled_ns
    counts = arm.cycle, arm.periods, arm.steps, sampled_ns, age, arm.fault, request
    samples[0] = (*counts, arm.is_complete, arm.is_enabled, arm.is_late, arm.q, arm.dq, arm.tau_J)


def samples_of(arms: ArmBatch, requests: NDArray[np.uint8]) -> Structured:
    """Return arm states and requests of n cycles as an array of type SAMPLE (n,); `age`: that of the oldest value."""
    samples = np.zeros(arms.cycle.size, SAMPLE)
    for name in SAMPLE.names or ():
        if name not in ("age", "request"):
            samples[name] = getattr(arms, name)
    samples["age"] = np.maximum(arms.age_q.max(axis=1, initial=0), arms.age_tau_J.max(axis=1, initial=0))
    samples["request"] = requests
    return samples


@compiled
def put_sample(block: Structured, sample: Sample, period_s: float) -> None:
    """Write q, dq, tau_J of a sample, and the interval before it, into the block for the kernel's next step.

    period_s: 0: not measured.
    """
    out: SchemeBlock = block[0]
    for i in range(out.q.shape[0]):
        out.q[i] = sample.q[i]
        out.dq[i] = sample.dq[i]
        out.tau_J[i] = sample.tau_J[i]
    out.period_s = period_s


def limits_of(settings: Settings) -> Limits:
    """Return the limits of position and speed, and those of rest, that `observe` checks."""
    return Limits(
        position_limit_rad=settings.arm.position_limit_rad,
        velocity_limit_rad_s=settings.arm.velocity_limit_rad_s,
        rest_velocity_rad_s=settings.safety.rest_velocity_rad_s,
        rest_torque_Nm=settings.safety.rest_torque_Nm,
    )


@compiled
def observe(limits: Limits, nominal_s: float, block: Structured, steps: int, too_fast: int) -> int:
    """Return the findings of the block's q, dq, tau_J as bits: finite or not, within limits or not, at rest, unloaded.

    UNSEEN is always set. Replace a period_s of 0 in the block by `steps` nominal periods. steps: periods since the
    fresh sample before it. too_fast: the bit of a joint beyond its velocity limit.
    """
    out: SchemeBlock = block[0]
    if out.period_s == 0.0:
        out.period_s = max(steps, 1) * nominal_s
    observation = AT_REST | UNLOADED | UNSEEN
    for i in range(out.q.shape[0]):
        q, dq, tau_J = out.q[i], out.dq[i], out.tau_J[i]
        if not (np.isfinite(q) and np.isfinite(dq) and np.isfinite(tau_J)):
            observation |= NOT_A_NUMBER
        if not (abs(q) <= limits.position_limit_rad[i]):
            observation |= OVER_LIMIT
        if not (abs(dq) <= limits.velocity_limit_rad_s[i]):
            observation |= too_fast
        if not (abs(dq) < limits.rest_velocity_rad_s):
            observation &= ~AT_REST
        if not (abs(tau_J) < limits.rest_torque_Nm):
            observation &= ~UNLOADED
    return observation


@compiled
def is_filled(steps: int, period_s: float, nominal_s: float, most: int) -> bool:
    """Return whether the samples missing before a sample may be interpolated; True also if none is missing.

    steps: periods since the sample before. period_s: measured time since then, which must be `SHORTEST_SHARE` to
    `LONGEST_SHARE` of steps * nominal_s. most: largest number of missing samples.
    """
    if not 1 <= steps <= most + 1:
        return False
    return bool(SHORTEST_SHARE * nominal_s * steps <= period_s <= LONGEST_SHARE * nominal_s * steps)


@compiled
def put_between(last: Vector, q: Vector, dq: Vector, tau_J: Vector, share: float, between: Vector) -> None:
    """Fill `between` (3, n) with the sample at a share, 0 to 1, of the way from `last` (3, n) to q, dq, tau_J (n,)."""
    for i in range(between.shape[1]):
        between[0, i] = last[0, i] + share * (q[i] - last[0, i])
        between[1, i] = last[1, i] + share * (dq[i] - last[1, i])
        between[2, i] = last[2, i] + share * (tau_J[i] - last[2, i])


@compiled
def keep_sample(q: Vector, dq: Vector, tau_J: Vector, last: Vector) -> None:
    """Keep q, dq, tau_J (n,) in `last` (3, n)."""
    for i in range(last.shape[1]):
        last[0, i], last[1, i], last[2, i] = q[i], dq[i], tau_J[i]
