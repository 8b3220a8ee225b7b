"""A sample on its way into either kernel: what is worked on, what the measurement alone says, lost ones before it.

A kernel works on three structured arrays of one element each, so that fields have names in compiled code and out of it:
constants from the settings, memory that lasts from one cycle to the next, and the block that is logged. The caller puts
q, dq, tau_J and the measured period_s into the block; a period_s of 0 was not measured.

Shapes: n joints; q, dq, tau_J (n,); last, between (3, n).
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.compiled import Structured, compiled, float_fields
from adacd_hil.records import ArmBatch, Layout, Vector
from adacd_hil.scheme.supervisor.transitions import AT_REST, NOT_A_NUMBER, OVER_LIMIT, UNLOADED, UNSEEN
from adacd_hil.settings.configuration import Settings

_SHORTEST_SHARE, _LONGEST_SHARE = 0.5, 1.5
"""Of the nominal period: the shortest and the longest interval of two samples that follow each other."""


class Numbers(NamedTuple):
    """What a kernel works on. values: the same memory as block, as (size,) float64."""

    constants: Structured
    memory: Structured
    block: Structured
    values: Vector


class Samples(NamedTuple):
    """What the loops read of n cycles, as columns. period_s: 0 where not measured; steps, findings: of the arm."""

    cycle: NDArray[np.int64]
    q: Vector
    dq: Vector
    tau_J: Vector
    period_s: Vector
    is_complete: NDArray[np.int64]
    periods: NDArray[np.int64]
    steps: NDArray[np.int64]
    findings: NDArray[np.int64]


class Recorded(NamedTuple):
    """What the loops write: bits of `Observation` (n,), blocks (n, size)."""

    observations: NDArray[np.int64]
    blocks: Vector


def samples_of(arms: ArmBatch, period_s: Vector, findings: NDArray[np.int64]) -> Samples:
    """Lay out the columns as the compiled loops read them."""
    columns = (arms.cycle, arms.is_complete, arms.periods, arms.steps)
    integers = (np.ascontiguousarray(column, dtype=np.int64) for column in columns)
    q, dq, tau_J = (np.ascontiguousarray(column, dtype=np.float64) for column in (arms.q, arms.dq, arms.tau_J))
    cycle, is_complete, periods, steps = integers
    return Samples(cycle, q, dq, tau_J, period_s, is_complete, periods, steps, findings)


@compiled
def put_sample(block: Structured, samples: Samples, k: int) -> None:
    """Put sample k where the next step of a kernel finds it."""
    out = block[0]
    for i in range(samples.q.shape[1]):
        out["q"][i] = samples.q[k, i]
        out["dq"][i] = samples.dq[k, i]
        out["tau_J"][i] = samples.tau_J[k, i]
    out["period_s"][0] = samples.period_s[k]


@compiled
def take_out(recorded: Recorded, k: int, observation: int, values: Vector) -> None:
    """Record what a kernel's step on sample k has found, and its block's values (size,)."""
    recorded.observations[k] = observation
    for j in range(values.size):
        recorded.blocks[k, j] = values[j]


def block_dtype(layout: Layout) -> np.dtype[np.void]:
    """Describe a block as a structure; its bytes are those of the float64 block."""
    return float_fields({field.name: (field.size,) for field in layout.fields})


def limits_of(settings: Settings) -> dict[str, Any]:
    """Return the constants with which measurements alone are judged."""
    return {
        "position_limit_rad": settings.arm.position_limit_rad,
        "velocity_limit_rad_s": settings.arm.velocity_limit_rad_s,
        "rest_velocity_rad_s": settings.safety.rest_velocity_rad_s,
        "rest_torque_Nm": settings.safety.rest_torque_Nm,
    }


@compiled
def observe(k: Any, out: Any, steps: int, too_fast: int) -> int:
    """Return what the measurements alone say, and UNSEEN; fill period_s with the nominal one where not measured.

    steps: periods since the fresh sample before it. too_fast: the bit of a joint beyond its velocity limit.
    """
    if out["period_s"][0] == 0.0:
        out["period_s"][0] = max(steps, 1) * k["period_s"]
    observation = AT_REST | UNLOADED | UNSEEN
    for i in range(out["q"].shape[0]):
        q, dq, tau_J = out["q"][i], out["dq"][i], out["tau_J"][i]
        if not (np.isfinite(q) and np.isfinite(dq) and np.isfinite(tau_J)):
            observation |= NOT_A_NUMBER
        if not (abs(q) <= k["position_limit_rad"][i]):
            observation |= OVER_LIMIT
        if not (abs(dq) <= k["velocity_limit_rad_s"][i]):
            observation |= too_fast
        if not (abs(dq) < k["rest_velocity_rad_s"]):
            observation &= ~AT_REST
        if not (abs(tau_J) < k["rest_torque_Nm"]):
            observation &= ~UNLOADED
    return observation


@compiled
def is_filled(steps: int, period_s: float, nominal_s: float, most: int) -> bool:
    """Tell whether a sample follows the one before it near enough. steps: periods between them, taking period_s.

    most: missing samples that may be put on the line between them.
    """
    if not 1 <= steps <= most + 1:
        return False
    return bool(_SHORTEST_SHARE * nominal_s * steps <= period_s <= _LONGEST_SHARE * nominal_s * steps)


@compiled
def put_between(last: Vector, q: Vector, dq: Vector, tau_J: Vector, share: float, between: Vector) -> None:
    """Fill `between` (3, n) with the sample at a share of the way from `last` (3, n) to q, dq, tau_J (n,)."""
    for i in range(between.shape[1]):
        between[0, i] = last[0, i] + share * (q[i] - last[0, i])
        between[1, i] = last[1, i] + share * (dq[i] - last[1, i])
        between[2, i] = last[2, i] + share * (tau_J[i] - last[2, i])


@compiled
def keep_sample(q: Vector, dq: Vector, tau_J: Vector, last: Vector) -> None:
    """Keep q, dq, tau_J (n,) in `last` (3, n)."""
    for i in range(last.shape[1]):
        last[0, i], last[1, i], last[2, i] = q[i], dq[i], tau_J[i]
