"""The compiled loops over recorded cycles: the kernels' own step, cycle by cycle, to the first that needs a look.

The same calls in the same order as a live cycle, without what comes after them: a cycle that is calm ends there, and
the first that isn't, or the last that was asked for, is the caller's to conclude.

`step_record` plays a record without a supervisor.

Compiled at their first call, which no live run makes.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.compiled import Structured, compiled, released
from adacd_hil.records import ArmBatch, SchemeState, Vector
from adacd_hil.scheme.contact import contact_report
from adacd_hil.scheme.kernel import certified_kernel, paper_kernel
from adacd_hil.scheme.model import filter_bank
from adacd_hil.scheme.supervisor.transitions import Calm, Observation, is_calm

_ADAPT = int(SchemeState.ADAPT)
_CERTIFY = int(SchemeState.CERTIFY)
_MONITOR = int(SchemeState.MONITOR)
_CONTACT = int(Observation.CONTACT)
_FITTED = int(Observation.FITTED)
_CERTIFIED = int(Observation.CERTIFIED)
_REFUTED = int(Observation.REFUTED)
_WITHHELD = int(Observation.WITHHELD)


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


class Numbers(NamedTuple):
    """What a kernel works on. values: the same memory as block, as (size,) float64."""

    constants: Structured
    memory: Structured
    block: Structured
    values: Vector


class Recorded(NamedTuple):
    """What the loops write: bits of `Observation` (n,), blocks (n, size)."""

    observations: NDArray[np.int64]
    blocks: Vector


class TouchWatch(NamedTuple):
    """What of a contact goes on in every cycle.

    rows: of `contact_report.ContactHistory`; written: how many have been. least_Nm: of the filtered external torque
    along the way of a withdrawal, below which that has to be judged.
    """

    rows: Vector
    written: int
    way: tuple[float, float]
    least_Nm: float


def samples_of(arms: ArmBatch, period_s: Vector, findings: NDArray[np.int64]) -> Samples:
    """Lay out the columns as the compiled loops read them."""
    columns = (arms.cycle, arms.is_complete, arms.periods, arms.steps)
    integers = (np.ascontiguousarray(column, dtype=np.int64) for column in columns)
    q, dq, tau_J = (np.ascontiguousarray(column, dtype=np.float64) for column in (arms.q, arms.dq, arms.tau_J))
    cycle, is_complete, periods, steps = integers
    return Samples(cycle, q, dq, tau_J, period_s, is_complete, periods, steps, findings)


@compiled
def _put(block: Structured, samples: Samples, k: int) -> None:
    out = block[0]
    for i in range(samples.q.shape[1]):
        out["q"][i] = samples.q[k, i]
        out["dq"][i] = samples.dq[k, i]
        out["tau_J"][i] = samples.tau_J[k, i]
    out["period_s"][0] = samples.period_s[k]


@released
def run_paper(
    numbers: Numbers, samples: Samples, recorded: Recorded, first: int, last: int, mode: int, calm: Calm
) -> int:
    """Run `kernel.step` from sample `first` to the first that isn't calm, at most to `last`; return which it is."""
    constants, memory, block, values = numbers
    passed = 0
    for k in range(first, last + 1):
        _put(block, samples, k)
        observation = paper_kernel.step(constants, memory, block, samples.is_complete[k], samples.steps[k], mode)
        recorded.observations[k] = observation
        for j in range(values.size):
            recorded.blocks[k, j] = values[j]
        passed += samples.periods[k]
        if not is_calm(calm, observation | samples.findings[k], passed, samples.cycle[k]):
            return k
    return last


@released
def run_certified(
    numbers: Numbers,
    paper: tuple[Structured, Structured, Structured],
    samples: Samples,
    recorded: Recorded,
    first: int,
    last: int,
    mode: int,
    paper_mode: int,
    calm: Calm,
    touch: TouchWatch,
    promotions: float,
) -> tuple[int, int]:
    """Run both schemes as `run_paper` does; return the sample and the paper's next mode.

    A model that has taken over, so that there are not that many promotions any more, is not calm.
    """
    constants, memory, block, values = numbers
    m, out = memory[0], block[0]
    written, passed = touch.written, 0
    for k in range(first, last + 1):
        is_complete, steps = samples.is_complete[k], samples.steps[k]
        _put(block, samples, k)
        observation = certified_kernel.step(constants, memory, block, is_complete, steps, mode)
        paper_mode = paper_kernel.step_shadow(paper[0], paper[1], paper[2], paper_mode, block, is_complete, steps)
        recorded.observations[k] = observation
        for j in range(values.size):
            recorded.blocks[k, j] = values[j]
        passed += samples.periods[k]
        y = m["y"][filter_bank.WIDE]
        along_Nm = y[0] * touch.way[0] + y[1] * touch.way[1]
        if (
            not is_calm(calm, observation | samples.findings[k], passed, samples.cycle[k])
            or out["promotions"][0] != promotions
            or not (along_Nm >= touch.least_Nm)
            or k == last
        ):
            return k, paper_mode
        place = written % (touch.rows.shape[0] // 2)
        contact_report.put_row(
            touch.rows, place, out["q"], out["tau_ext_wide_hat"], m["wide_sigma"], m["wide_threshold"]
        )
        written += 1
    return last, paper_mode


@compiled
def step_record(
    constants: Structured,
    memory: Structured,
    block: Structured,
    q: Vector,
    dq: Vector,
    tau_J: Vector,
    payload_at: int,
    state: Vector,
    observation: Vector,
    y: Vector,
    h: Vector,
    theta: Vector,
) -> None:
    """Play an arm that doesn't react over n samples: ADAPT, CERTIFY, MONITOR; at a payload's sample all again.

    After a contact before the certificate it waits as after one while monitoring, then begins anew.

    q, dq, tau_J (n, 2) at the nominal period; payload_at: sample, -1 for none. Fills state (n,) by `SchemeState`,
    observation (n,), y and h (n, channels, 2), and the model in use theta (n, p).
    """
    now, begins_in = _ADAPT, -1
    is_payload = False
    certified_kernel.begin_adaptation(constants, memory, is_payload, True)
    for k in range(q.shape[0]):
        if k == payload_at:
            is_payload, begins_in = now == _MONITOR, 0
        if begins_in == 0:
            certified_kernel.begin_adaptation(constants, memory, is_payload, k == payload_at)
            now = _ADAPT
        begins_in -= 1
        block[0]["q"][:] = q[k]
        block[0]["dq"][:] = dq[k]
        block[0]["tau_J"][:] = tau_J[k]
        block[0]["period_s"][0] = 0.0
        mode = certified_kernel.WATCH
        if begins_in < 0 and now == _ADAPT:
            mode |= certified_kernel.LEARN
        elif begins_in < 0:
            mode |= certified_kernel.TEST if now == _CERTIFY else certified_kernel.REFINE
        found = certified_kernel.step(constants, memory, block, 1, 1, mode)
        state[k] = now
        observation[k] = found
        y[k] = memory[0]["y"]
        h[k] = memory[0]["h"]
        theta[k] = memory[0]["theta"]
        if found & _CONTACT and now != _MONITOR and begins_in < 0:
            begins_in = int(constants[0]["recover_cycles"])
        elif found & _FITTED:
            certified_kernel.begin_test(constants, memory)
            now = _CERTIFY
        elif found & _REFUTED:
            is_payload, begins_in = False, 0
        elif found & _WITHHELD:
            begins_in = 0
        elif found & _CERTIFIED:
            certified_kernel.begin_refinement(constants, memory)
            now = _MONITOR
