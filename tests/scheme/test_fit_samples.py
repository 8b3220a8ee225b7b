"""The samples of a fit that are kept, and a touch among them that is too short for the thresholds."""

import numpy as np
import pytest
from excited_arm import NAMES, PERIOD_S
from planar_arm import THETA
from test_earlier import FREE, HeldLoop, states

from adacd_hil.records import SchemeState
from adacd_hil.scheme.identify import fit_check
from adacd_hil.scheme.kernel import certified_memory


class Fit:
    """A kernel's memory with a fit that explains what it has learnt, but for noise of 0.01 Nm."""

    def __init__(self, learnt=300):
        self.k, self.m = certified_memory.constants_of(FREE)[0], certified_memory.new_memory(FREE)[0]
        fit_check.begin(self.m)
        random = np.random.default_rng(1)
        self.W = random.standard_normal((learnt, 2, len(NAMES)))
        self.tau = self.W @ self.m["belief"] + 0.01 * random.standard_normal((learnt, 2))

    def learn(self):
        for W, tau in zip(self.W, self.tau, strict=True):
            fit_check.follow(self.k, self.m, W, tau)


def test_the_residual_of_the_better_half_is_not_raised_by_a_touch_of_the_other():
    fit = Fit()
    fit.tau[:100] += 1.0
    fit.learn()
    assert fit_check.better_rms(fit.m) == pytest.approx(0.01, rel=0.2)


def test_a_long_fit_is_kept_in_the_same_room_from_its_beginning_to_its_end():
    fit = Fit(learnt=3000)
    fit.learn()
    kept, every = int(fit.m["samples_kept"]), fit.m["samples_every"]
    assert fit_check.ROOM // 2 <= kept <= fit_check.ROOM
    assert kept * every == pytest.approx(3000, abs=2 * every)
    places = [int(np.argmin(np.abs(fit.tau - tau).sum(axis=1))) for tau in fit.m["samples_tau"][:kept]]
    assert places[0] < fit_check.FIRST_EVERY
    assert places[-1] > 3000 - 2 * every
    np.testing.assert_array_equal(np.diff(places), every)


def test_a_lean_at_the_start_too_short_for_the_thresholds_is_named_and_not_certified():
    loop = HeldLoop(FREE, theta=THETA["M"], seed=91161)
    loop.run_until(SchemeState.ADAPT)
    outputs = loop.lean(0, -0.5, 0.06)
    outputs += loop.run(round(2.3 / PERIOD_S))
    assert not {SchemeState.REACT, SchemeState.MONITOR} & states(outputs)
    assert "no one model explains the whole fit" in loop.said("touch")[0]
    outputs = loop.run_until(SchemeState.MONITOR)
    assert len(outputs) * PERIOD_S < 2.0
    assert np.abs(loop.offset_error_Nm).max() < 0.02
    assert loop.error_of("F_c1") < 0.02
