"""A recorded arm that doesn't react, played through the certified kernel: many minutes a second, without a supervisor.

For studies of the numbers alone. A recording goes on whatever is found in it, so no reaction is played either.
"""

from typing import NamedTuple

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import SchemeState, Vector
from adacd_hil.scheme.kernel import certified_kernel, certified_memory
from adacd_hil.scheme.kernel.kernel_samples import Numbers
from adacd_hil.scheme.supervisor.findings import CERTIFIED, CONTACT, FITTED, REFUTED, WITHHELD
from adacd_hil.settings.configuration import Settings
from adacd_hil.structured import Structured

_ADAPT = int(SchemeState.ADAPT)
_CERTIFY = int(SchemeState.CERTIFY)
_MONITOR = int(SchemeState.MONITOR)


class PlayedRecord(NamedTuple):
    """What n samples have come to: state (n,), observation (n,), y and h (n, channels, 2).

    theta (n, p): the model in use. numbers: what the kernel worked on, as the last sample left it.
    """

    state: Vector
    observation: Vector
    y: Vector
    h: Vector
    theta: Vector
    numbers: Numbers


def play_record(
    settings: Settings, q: Vector, dq: Vector, tau_J: Vector, payload_at: int = -1, at_rest: int = 0
) -> PlayedRecord:
    """Play q, dq, tau_J (n, 2) at the nominal period, as `step_record` says, after so many samples at rest."""
    numbers = certified_memory.numbers_of(settings)
    constants, memory, block, _ = numbers
    block["q"] = q[0]
    for _ in range(at_rest):
        certified_kernel.step(constants, memory, block, 1, 1, certified_kernel.WATCH)
    count = len(q)
    state, observation, theta = np.zeros(count), np.zeros(count), np.zeros((count, memory[0].models.theta.size))
    y, h = (np.zeros((count, *memory[0].filters.y.shape)) for _ in range(2))
    step_record(constants, memory, block, q, dq, tau_J, payload_at, state, observation, y, h, theta)
    return PlayedRecord(state, observation, y, h, theta, numbers)


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
        out = block[0]
        out.q[:] = q[k]
        out.dq[:] = dq[k]
        out.tau_J[:] = tau_J[k]
        out.period_s = 0.0
        mode = certified_kernel.WATCH
        if begins_in < 0 and now == _ADAPT:
            mode |= certified_kernel.LEARN
        elif begins_in < 0:
            mode |= certified_kernel.TEST if now == _CERTIFY else certified_kernel.REFINE
        found = certified_kernel.step(constants, memory, block, 1, 1, mode)
        state[k] = now
        observation[k] = found
        y[k] = memory[0].filters.y
        h[k] = memory[0].sensitivity.h
        theta[k] = memory[0].models.theta
        if found & CONTACT and now != _MONITOR and begins_in < 0:
            begins_in = int(constants[0].recover_cycles)
        elif found & FITTED:
            certified_kernel.begin_test(constants, memory)
            now = _CERTIFY
        elif found & REFUTED:
            is_payload, begins_in = False, 0
        elif found & WITHHELD:
            begins_in = 0
        elif found & CERTIFIED:
            certified_kernel.begin_refinement(constants, memory)
            now = _MONITOR
