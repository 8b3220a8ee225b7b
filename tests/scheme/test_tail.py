"""The floor of the thresholds: the factor against its formula and against noise, and which residuals count."""

import re

import numpy as np
import pytest
from excited_arm import NAMES, SETTINGS, Kernel

from adacd_hil.scheme.detect import margin_watch, sensitivity, tail
from adacd_hil.scheme.kernel import certified_kernel, certified_memory
from adacd_hil.scheme.supervisor import findings

CONSTANTS = certified_memory.constants_of(SETTINGS)
K = CONSTANTS[0]
PERIOD_S = SETTINGS.bus.period_s
COUNT = len(NAMES)
RECOVER = round(SETTINGS.certified.recover_s / PERIOD_S)
CUTOFFS = np.array(SETTINGS.certified.cutoffs_rad_s)
NU_HZ = np.concatenate([CUTOFFS, CUTOFFS[1:]]) / np.pi
BLOCK = round(tail.BLOCK_S / PERIOD_S)
HOUR_S = 3600.0
MODEL_NM = 0.5


def factor(nu_Hz, seen_s):
    return np.minimum(
        np.sqrt(np.maximum(np.log(nu_Hz * HOUR_S) / np.log(nu_Hz * max(0.5 * seen_s, 1.0)), 1.0)), tail.LARGEST
    )


class Tailed:
    """The memory of an arm that moves, with residuals of both signs; its thresholds without a floor are MODEL_NM."""

    def __init__(self):
        self.memory = certified_memory.new_memory(SETTINGS)
        self.m = self.memory[0]
        self.m.sensitivity.h_model[:] = MODEL_NM

    def see(self, y, samples):
        for sample in range(samples):
            self.m.filters.y[:] = y if sample % 2 else np.negative(y)
            tail.follow_tail(K, self.m)

    def push(self, y, samples):
        """See the same sign all the time."""
        self.m.filters.y[:] = y
        for _ in range(samples):
            tail.follow_tail(K, self.m)

    def skip(self, blocks, y=0.0):
        """See as much as these blocks at once, each by its last sample."""
        for _ in range(blocks):
            self.m.tail.block_used = BLOCK - 2.0
            self.see(y, 2)


@pytest.mark.parametrize("seen_s", [0.1, 10.0, 600.0, HOUR_S, 2.0 * HOUR_S])
def test_the_floor_is_the_largest_residual_times_the_formula_s_factor(seen_s):
    tailed = Tailed()
    largest = np.random.default_rng(1).uniform(-0.3, 0.3, (5, 2))
    tailed.m.tail.tail_s = seen_s - tail.BLOCK_S
    tailed.see(largest, BLOCK)
    tailed.see(0.5 * largest, BLOCK)
    expected = factor(NU_HZ, seen_s)[:, None] * np.abs(largest)
    np.testing.assert_allclose(tailed.m.tail.tail_Nm, expected, rtol=1e-10)


def test_a_residual_counts_when_its_block_and_the_one_after_it_are_over():
    tailed = Tailed()
    tailed.see(0.2, 2)
    tailed.see(0.1, 2 * BLOCK - 3)
    assert not tailed.m.tail.tail_Nm.any()
    tailed.see(0.1, 1)
    np.testing.assert_allclose(tailed.m.tail.peak, 0.2)


def test_a_joint_that_has_just_rested_shows_no_tail():
    """A smoothed channel remembers rest longer than its bare filter."""
    tailed = Tailed()
    tailed.m.sensitivity.still_smooth[1, 0] = tailed.m.sensitivity.still[2, 1] = 1.1 * sensitivity.MOVING
    tailed.m.sensitivity.still_smooth[2, 1] = tailed.m.sensitivity.still[1, 0] = 0.9 * sensitivity.MOVING
    tailed.see(0.2, 2 * BLOCK)
    moving = np.full((5, 2), 0.2)
    moving[1, 0] = moving[4, 1] = 0.0
    np.testing.assert_allclose(tailed.m.tail.peak, np.tile(moving, (2, 1, 1)))


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_push_of_one_sign_raises_no_floor_above_what_the_other_sign_has_shown(sign):
    tailed = Tailed()
    tailed.see(0.02, 20 * BLOCK)
    before = tailed.m.tail.tail_Nm.copy()
    for push_Nm in np.linspace(0.02, 0.4, 200):
        tailed.push(sign * push_Nm, BLOCK)
    assert np.all(tailed.m.tail.tail_Nm <= before)


def test_an_error_of_both_signs_raises_the_floor_by_the_factor_at_most():
    tailed = Tailed()
    for error_Nm in (0.45, 0.9, 2.0, 50.0):
        tailed.skip(100, error_Nm)
        np.testing.assert_allclose(tailed.m.tail.peak, min(error_Nm, MODEL_NM))
        assert np.all(tailed.m.tail.tail_Nm <= factor(NU_HZ, 1.0)[:, None] * MODEL_NM)


def test_no_threshold_is_below_the_floor_and_a_floor_below_the_threshold_changes_nothing():
    m = Tailed().m
    m.regressor.M[:] = [[0.4, 0.1], [0.1, 0.05]]
    m.sensitivity.hold[:], m.sensitivity.still[:], m.sensitivity.still_smooth[:] = 0.3, 0.2, 0.1
    sensitivity.fill_thresholds(K, m)
    h, model = m.sensitivity.h.copy(), m.sensitivity.h_model.copy()
    m.tail.tail_Nm[:] = model * [0.9, 1.5]
    sensitivity.fill_thresholds(K, m)
    np.testing.assert_allclose(m.sensitivity.h_model, model, rtol=1e-12)
    np.testing.assert_allclose(m.sensitivity.h - h, model * [0.0, 0.5], rtol=1e-10, atol=1e-15)


def test_near_a_contact_its_block_and_the_one_before_do_not_count():
    tailed = Tailed()
    tailed.see(0.1, BLOCK)
    tailed.see(0.3, BLOCK)
    tailed.see(0.4, BLOCK // 2)
    tail.discard_tail(tailed.m)
    tailed.see(0.05, 3 * BLOCK)
    np.testing.assert_allclose(tailed.m.tail.peak, 0.1, rtol=1e-3)
    tailed.see(0.2, 2 * BLOCK)
    np.testing.assert_allclose(tailed.m.tail.peak, 0.2)


def test_the_largest_is_forgotten_over_ten_minutes_of_motion():
    tailed = Tailed()
    tailed.skip(1, 0.4)
    tailed.skip(1)
    first = tailed.m.tail.tail_Nm.copy()
    tailed.skip(round(tail.FORGOTTEN_S / tail.BLOCK_S))
    np.testing.assert_allclose(tailed.m.tail.peak, 0.4 / np.e, rtol=1e-3)
    np.testing.assert_allclose(tailed.m.tail.tail_Nm, first / np.e, rtol=1e-3)


def test_only_time_in_which_something_was_seen_counts():
    tailed = Tailed()
    tailed.skip(1, 0.4)
    tailed.skip(50)
    assert float(tailed.m.tail.tail_s) == pytest.approx(tail.BLOCK_S)
    tailed.skip(50, 0.1)
    assert float(tailed.m.tail.tail_s) == pytest.approx(50 * tail.BLOCK_S)


def test_a_fit_of_another_model_begins_without_a_floor():
    tailed = Tailed()
    tailed.see(0.2, 2 * BLOCK + 1)
    assert tailed.m.tail.tail_Nm.all()
    certified_kernel.begin_adaptation(CONSTANTS, tailed.memory, False, True)
    for name in ("peak", "peak_now", "peak_last", "tail_Nm", "block_used", "tail_s"):
        assert not tailed.m.tail[name].any()


@pytest.mark.parametrize(("mode", "is_followed"), [("LEARN", False), ("TEST", True), ("REFINE", True)])
def test_residuals_are_followed_while_a_frozen_model_is_in_use(mode, is_followed):
    kernel = steady(mode)
    assert bool(kernel.m.tail.tail_Nm.any()) is is_followed


def steady(mode, samples=1000):
    """Let an arm of nothing, with a model of nothing, move on with 5 mNm on it, this way and that."""
    kernel = Kernel(theta=np.zeros(COUNT), P=np.zeros((COUNT, COUNT)))
    go_on(kernel, mode, samples // 2, -0.005)
    go_on(kernel, mode, samples // 2, 0.005)
    return kernel


def go_on(kernel, mode, samples, push_Nm):
    mode = certified_kernel.WATCH | getattr(certified_kernel, mode)
    found = [kernel.step([0.0, 0.0], [0.5, -0.5], [-push_Nm, -push_Nm], mode) for _ in range(samples)]
    return np.array(found) & findings.CONTACT != 0


def test_what_of_a_touch_was_seen_before_it_was_flagged_raises_no_threshold():
    kernel = steady("REFINE")
    before = kernel.m.tail.peak.copy()
    for push_Nm in np.linspace(0.005, 0.5, 80):
        is_touched = go_on(kernel, "REFINE", 1, push_Nm)[0]
        if is_touched:
            break
    assert is_touched
    assert np.abs(kernel.m.filters.y).max() > 4.0 * before.max()
    go_on(kernel, "REFINE", 600, 0.005)
    assert kernel.m.models.recovering_cycles < RECOVER
    go_on(kernel, "REFINE", RECOVER + 3 * BLOCK, 0.005)
    assert kernel.m.models.recovering_cycles == 0.0
    np.testing.assert_allclose(kernel.m.tail.peak, before, rtol=0.06)


def test_a_margin_that_shrinks_is_named_against_what_it_was_once_the_watch_had_settled():
    watch = margin_watch.MarginWatch()
    for _ in range(margin_watch.MEMORY_BLOCKS + 1):
        watch.add_block(np.array([0.4, 0.4]))
        assert watch.warning == ""
    watch.add_block(np.array([np.inf, 0.4]))  # not finite: ignored
    for _ in range(10):
        watch.add_block(np.array([0.4, 0.9]))
    assert re.fullmatch(r"joint 2: margin \d\.\d x, was 2\.5 x", watch.warning)
    watch.forget()
    assert watch.warning == ""
    assert np.isinf(watch.margin).all()


def test_the_largest_share_is_that_of_the_threshold_in_force():
    memory = certified_memory.new_memory(SETTINGS)[0]
    memory.sensitivity.h_model[:] = MODEL_NM
    assert tail.largest_share(memory) == 0.0
    memory.tail.peak[0, 1] = 0.4 * MODEL_NM, 0.5 * MODEL_NM
    assert tail.largest_share(memory) == pytest.approx(0.5)
    memory.tail.tail_Nm[1, 1] = 1.25 * MODEL_NM  # where the floor is the threshold in force, it is what counts
    assert tail.largest_share(memory) == pytest.approx(0.4)


def test_a_residual_too_small_to_square_makes_no_excursion():
    assert tail.rate_per_h(10.0, 60.0, 1e-200) == 0.0
