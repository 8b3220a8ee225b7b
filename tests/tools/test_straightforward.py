"""tools/straightforward.py: its numpy step gives the numbers of the compiled one, so that it is no straw man."""

import numpy as np
import pytest
from scheme.smooth_motion import PLACES, settings_with, smooth_motion, torque_of
from straightforward import NumpyScheme

from adacd_hil.scheme.kernel import paper_kernel
from adacd_hil.settings.configuration import Settings

LEARNED, WATCHED = 300, 150
THETA = np.array([0.19, 0.034, 0.02, 0.08, 0.05, 0.1, 0.06])


def run_compiled(settings: Settings, q: np.ndarray, dq: np.ndarray, tau_J: np.ndarray) -> np.ndarray:
    """Run the compiled step, first learning, then armed; return blocks (n, size)."""
    constants, memory, block = (
        paper_kernel.constants_of(settings),
        paper_kernel.new_memory(7),
        paper_kernel.new_block(7),
    )
    paper_kernel.begin_adaptation(constants, memory, block)
    rows = []
    for k in range(LEARNED + WATCHED):
        for name, value in (("q", q[k]), ("dq", dq[k]), ("tau_J", tau_J[k])):
            block[0][name][:] = value
        paper_kernel.step(constants, memory, block, 1, 1, paper_kernel.LEARN if k < LEARNED else paper_kernel.ARMED)
        rows.append(block.view(np.float64).copy())
    return np.array(rows)


@pytest.mark.slow
def test_the_numpy_step_learns_and_watches_as_the_compiled_one() -> None:
    settings = settings_with()
    q, dq, ddq = smooth_motion(np.arange(LEARNED + WATCHED) * 1e-3)
    tau_J = torque_of(q, dq, ddq, THETA) + np.random.default_rng(3).normal(0.0, 0.02, q.shape)
    tau_J[LEARNED + 50 :, 1] += 3.0
    scheme = NumpyScheme(settings)
    blocks = run_compiled(settings, q, dq, tau_J)
    alarms = []
    for k, block in enumerate(blocks):
        alarms.append(scheme.step(q[k], dq[k], tau_J[k], is_learning=k < LEARNED))
        for name in ("tau_f", "tau_ext_hat", "tau_ext_hat_cad", "tau_ext_wide_hat", "theta_hat", "threshold"):
            assert np.array_equal(np.isinf(getattr(scheme, name)), np.isinf(block[PLACES[name]]))
            finite = np.isfinite(block[PLACES[name]])
            error = np.abs(getattr(scheme, name)[finite] - block[PLACES[name]][finite])
            assert error.max(initial=0.0) < 1e-9, f"{name} of sample {k}"
    over = (np.abs(blocks[:, PLACES["tau_ext_hat"]]) > blocks[:, PLACES["threshold"]]).any(axis=1)
    assert alarms == over.tolist()
    assert 0 < over.sum() < WATCHED
    assert scheme.quiet_cycles * settings.bus.period_s == blocks[-1, PLACES["quiet_s"]]
    assert abs(scheme.excitation / blocks[-1, PLACES["excitation"]][0] - 1.0) < 1e-6
