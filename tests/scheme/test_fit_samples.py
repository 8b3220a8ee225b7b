"""A fit's model must explain each of its samples: a short touch among them bends it, and stands out."""

import numpy as np
import pytest
from excited_arm import FREE, NAMES, PERIOD_S, TouchedLoop, kernel_of, states
from planar_arm import THETA

from adacd_hil.records import SchemeState
from adacd_hil.scheme.identify import fit_check


class Fit:
    """A kernel's memory with a fit that explains what it has learnt, but for noise of 0.01 Nm."""

    def __init__(self, learnt=300):
        self.k, self.m = kernel_of(FREE)
        fit_check.begin(self.m)
        random = np.random.default_rng(1)
        self.W = random.standard_normal((learnt, 2, len(NAMES)))
        self.tau = self.W @ self.m.models.belief + 0.01 * random.standard_normal((learnt, 2))

    @property
    def first(self):
        for W, tau in zip(self.W, self.tau, strict=True):
            fit_check.follow(self.k, self.m, W, tau)
        return fit_check.first_unexplained(self.m)


def test_a_fit_that_explains_its_samples_has_none_that_stands_out():
    assert Fit().first == -1


@pytest.mark.parametrize(("share", "is_explained"), [(0.9, True), (1.15, False)])
def test_a_sample_stands_out_by_the_residual_of_the_better_half(share, is_explained):
    fit = Fit()
    limit_Nm = fit_check.LIMIT_NM + fit_check.LIMIT_SHARE * 0.01
    fit.tau[29, 1] = fit.W[29, 1] @ fit.m.models.belief - share * limit_Nm
    assert (fit.first == -1) is is_explained


def test_the_first_of_a_touchs_samples_is_named():
    fit = Fit()
    fit.tau[100:150] += 1.0
    assert fit.first == 99  # kept: 98, 101


def test_a_long_fit_is_kept_in_the_same_room_from_its_beginning_to_its_end():
    fit = Fit(learnt=3000)
    fit.tau[:90] += 1.0
    assert fit.first == 0
    kept, every = int(fit.m.fit_check.samples_kept), fit.m.fit_check.samples_every
    assert fit_check.ROOM // 2 <= kept <= fit_check.ROOM
    assert kept * every == pytest.approx(3000, abs=2 * every)
    fit = Fit(learnt=3000)
    fit.tau[2900:] += 1.0
    assert (every, fit.first) == (24.0, 2904)  # kept: 2882, 2906


def test_a_payloads_fit_is_not_asked():
    fit = Fit()
    fit.m.models.is_payload = 1.0
    fit.tau[98:104] += 5.0
    assert fit.first == -1


def test_a_lean_at_the_start_too_short_for_the_thresholds_is_named_and_not_certified():
    loop = TouchedLoop(FREE, theta=THETA["M"], seed=91161)
    loop.run_until(SchemeState.ADAPT)
    outputs = loop.lean(0, -0.5, 0.06)
    outputs += loop.run(round(2.3 / PERIOD_S))
    assert not {SchemeState.REACT, SchemeState.MONITOR} & states(outputs)
    assert "no one model explains the whole fit" in loop.said("touch")[0]
    outputs = loop.run_until(SchemeState.MONITOR)
    assert len(outputs) * PERIOD_S < 2.0
    assert np.abs(loop.offset_error_Nm).max() < 0.02
    assert loop.error_of("F_c1") < 0.02
