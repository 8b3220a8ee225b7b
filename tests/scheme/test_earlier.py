"""A touch that begins or ends while the arm learns: what was known before judges what is learnt after."""

import re
from dataclasses import replace

import numpy as np
import pytest
from excited_arm import FREE, NAMES, OFFSETS, PERIOD_S, TouchedLoop, added, kernel_of, learnt_s, states
from long_cases import long_but
from planar_arm import THETA

from adacd_hil.records import FRICTION_SPEEDS_RAD_S, FaultReason, Request, SchemeState
from adacd_hil.scheme.identify import anchor, earlier, evidence, fit_check
from adacd_hil.scheme.kernel import certified_memory
from adacd_hil.scheme.pipeline.certificate_watch import BY_FITS_THAT_AGREE, BY_WORD

UNKNOWN = replace(FREE, arm=replace(FREE.arm, holding_torque_Nm=None))
BRAKED = replace(FREE, arm=replace(FREE.arm, holding_torque_Nm=(8.0, 8.0)))
VISCOUS, COULOMB, INERTIA = NAMES.index("F_v1"), NAMES.index("F_c1"), NAMES.index("a1")


@pytest.mark.parametrize(
    ("hand", "named"),
    [
        (added(F_c1=0.4), r"friction of joint 1 at [\d.]+ rad/s is 0\.\d\d\d Nm more than"),
        (added(F_v2=0.25), r"friction of joint 2 at 1.2 rad/s is 0\.\d\d\d Nm more than"),
        (added(a1=0.08), r"a1 is 0\.\d\d\d kg m² more than"),
    ],
)
def test_a_hand_that_begins_to_hold_while_the_arm_learns_gets_no_certificate_and_is_named(hand, named):
    loop = TouchedLoop(FREE)
    loop.learn(1.0)
    held = loop.hold(hand, 8.0)
    assert SchemeState.MONITOR not in states(held)
    said = loop.said("touch")
    assert any(re.search(named, text) for text in said)
    assert any("a touch that began then has not been seen to end" in text for text in said)
    assert earlier.is_keeping(loop.m)
    released_at = loop.cycle
    loop.recover()
    assert (loop.cycle - released_at) * PERIOD_S < 6.5
    assert not earlier.is_keeping(loop.m)
    for name in ("a1", "F_v1", "F_c1", "F_v2"):
        assert loop.error_of(name) < 0.02


@pytest.mark.long
def test_a_hand_that_dragged_and_lets_go_leaves_less_and_less_is_the_arms_once_enough_fits_agree():
    loop = TouchedLoop(FREE)
    loop.run_until(SchemeState.ADAPT)
    loop.hold(added(F_c1=0.4), 1.0)
    loop.recover(within_s=12.0)
    assert loop.said("certificate")[0].endswith(f"; {BY_FITS_THAT_AGREE}")
    assert loop.error_of("F_c1") < 0.02


def test_a_hand_that_helps_the_motion_after_a_reported_contact_gets_no_certificate_and_is_named():
    loop = TouchedLoop(FREE)
    loop.learn(1.0)
    helped = loop.hold(added(F_c1=-0.3), 8.0)
    assert any(output.contact is not None for output in helped)
    assert SchemeState.MONITOR not in states(helped)
    assert any(
        re.search(r"friction of joint 1 at .* less than .*: a hand helps the motion", t) for t in loop.said("touch")
    )


@pytest.mark.parametrize("settings", long_but(1, [BRAKED, UNKNOWN]), ids=["brakes leave it open", "no anchor"])
def test_without_an_anchor_a_lean_that_begins_while_the_arm_learns_is_known_by_the_offset_before(settings):
    """What was kept is not forgotten for the word of an anchor that bounds nothing."""
    loop = TouchedLoop(settings)
    loop.learn(1.0)
    leant = loop.lean(0, 0.5, 6.0)
    assert SchemeState.MONITOR not in states(leant)
    assert loop.said("touch")[0].startswith("torque offset of joint 1 is 0.50")
    loop.recover()
    assert abs(loop.offset_error_Nm[0]) < 0.03


@pytest.mark.long
def test_the_word_of_the_user_that_nobody_touches_the_arm_ends_the_comparison():
    loop = TouchedLoop(FREE)
    loop.learn(1.0)
    loop.theta = loop.theta + added(F_c1=0.4)  # a brake that drags from now on
    outputs = loop.run(6000)
    assert SchemeState.MONITOR not in states(outputs)
    loop.request = Request.ACCEPT
    loop.recover()
    assert "the user says that nobody touches the arm" in loop.said("touch")[-1]
    assert loop.said("certificate")[0].endswith(f"; {BY_WORD}what the run had learnt before")
    assert loop.error_of("F_c1") < 0.02


def test_a_hand_that_never_lets_go_is_a_fault_that_says_what_contradicts_what():
    loop = TouchedLoop(replace(FREE, termination=replace(FREE.termination, timeout_s=6.0)))
    loop.learn(1.0)
    outputs = loop.hold(added(F_c1=0.4), 12.0)
    assert outputs[-1].fault is FaultReason.ADAPT_TIMEOUT
    lines = loop.pipeline.describe_missing()
    assert re.search(r"friction of joint 1 at .* more than \d+\.\d s ago, bound 0\.\d\d\d Nm: a touch", lines[0])
    assert any(re.fullmatch(r"certificates withheld: \d", line) for line in lines)
    assert "`accept` says that nobody touches the arm" in lines


@pytest.mark.parametrize("profile", ["P", "S", "M"])
def test_an_untouched_arm_is_certified_at_once_and_far_from_the_bound_whatever_its_offset(profile):
    loop = TouchedLoop(FREE, (0.2, -0.2), theta=THETA[profile], seed=5)
    outputs = loop.run_until(SchemeState.CERTIFY)
    m = loop.m
    furthest = max(fit_check.distance(m, s) for s in range(int(m.fit_check.steps_used)))
    assert furthest < 0.5 * fit_check.STEADY * fit_check.SMALLEST_SQUARE
    outputs += loop.run_until(SchemeState.MONITOR)
    assert learnt_s(outputs) == pytest.approx(2.0, abs=0.01)
    assert loop.said("touch") + loop.said("anchor") == []
    assert np.abs(loop.offset_error_Nm).max() < 0.02


class Compared:
    """A kernel's memory with a fit and something kept, both known to `std` in every parameter."""

    def __init__(self, settings=FREE, std=0.01):
        self.k, self.m = kernel_of(settings)
        self.m.models.P_belief = std**2 * np.eye(len(NAMES))
        self.m.models.belief = 0.1
        self.m.fit_check.fit_square, self.m.fit_check.fit_rows = 1.0, fit_check.HARD  # u = 1
        self.keep(self.m.models.belief, std)
        self.m.evidence.limit[: anchor.KINDS] = np.inf if settings is UNKNOWN else 0.04

    def keep(self, theta, std, unit=1.0, age_s=0.0):
        """Keep one more belief."""
        earlier.keep_belief(self.k, self.m, theta, std**2 * np.eye(len(NAMES)), unit, age_s)

    def keep_only(self, theta, std):
        """Keep one belief in place of all."""
        earlier.forget(self.m)
        self.keep(theta, std)

    def agrees_with(self, name, change):
        self.m.models.belief = 0.1
        self.m.models.belief[NAMES.index(name)] += change
        return self.agrees()

    def agrees(self):
        evidence.fit(self.k, self.m, self.m.models.belief, self.m.models.P_belief, fit_check.fit_unit(self.m))
        return earlier.is_no_more(self.k, self.m)


@pytest.mark.parametrize(("name", "floor"), [("F_c2", 0.03), ("a3", 0.006), ("offset2", 0.03)])
def test_less_than_the_floor_is_nothing_however_well_all_is_known(name, floor):
    compared = Compared(UNKNOWN, std=1e-5)
    assert compared.agrees_with(name, 0.99 * floor)
    assert not compared.agrees_with(name, 1.01 * floor)


def test_an_offset_counts_both_ways_and_where_something_anchors_it_shows_that_what_was_kept_was_leant_on():
    compared = Compared(std=1e-5)
    assert compared.agrees_with("offset1", 0.0)
    compared.m.evidence.limit[: anchor.KINDS] = np.inf
    assert not compared.agrees_with("offset1", -0.05)
    compared.m.evidence.limit[0] = 0.04
    assert compared.agrees_with("offset1", -0.05)
    assert not earlier.is_keeping(compared.m)


def test_of_two_joints_only_the_one_without_an_anchor_is_judged_by_its_earlier_offset():
    compared = Compared(std=1e-5)
    compared.m.evidence.limit[: anchor.KINDS, evidence.OFFSETS + 1] = np.inf
    assert not compared.agrees_with("offset2", 0.05)
    assert earlier.is_keeping(compared.m)
    assert earlier.describe_more(compared.m)[0].startswith("torque offset of joint 2 is 0.050 Nm more than 0.0 s ago")
    assert compared.agrees_with("offset1", 0.05)


def test_a_fit_that_is_not_a_number_agrees_with_nothing_that_was_kept():
    for settings in (FREE, UNKNOWN):
        compared = Compared(settings)
        compared.m.models.belief = np.nan
        assert not compared.agrees()
        assert earlier.is_keeping(compared.m)


def test_what_the_prior_alone_says_judges_nothing():
    prior = Compared()
    earlier.forget(prior.m)
    P = np.diag(certified_memory.new_memory(FREE)[0].models.P_belief.diagonal())
    earlier.keep_belief(prior.k, prior.m, prior.m.models.belief, P, fit_check.SMALLEST_UNIT, 0.0)
    assert prior.agrees_with("F_c1", 1.0)
    assert prior.agrees_with("a1", 1.0)


@pytest.mark.parametrize(("share", "is_steady"), [(0.95, True), (1.05, False)])
def test_a_fit_that_has_come_further_than_its_variance_allows_has_changed(share, is_steady):
    compared = Compared(std=0.01)
    m = compared.m
    earlier.forget(m)
    m.fit_check.steps_used, m.fit_check.steps_theta[:2] = 2.0, 0.1
    m.fit_check.steps_P[:2] = 0.02**2 * np.eye(len(NAMES))
    m.fit_check.steps_square[:2], m.fit_check.steps_rows[:2] = 0.0, 50.0
    m.fit_check.fit_square, m.fit_check.fit_rows = 0.0, 100.0
    added_variance = (1.0 + fit_check.REGULAR) * 0.02**2 - 0.01**2
    m.models.belief[INERTIA] += share * np.sqrt(fit_check.STEADY * fit_check.SMALLEST_SQUARE * added_variance)
    assert (fit_check.last_unsteady_step(m) == fit_check.NONE) is is_steady
    earlier.keep_fit(compared.k, m)
    assert m.earlier.kept_count == (2.0 if is_steady else 1.0)
    assert m.evidence.value[evidence.KEPT, evidence.FRICTIONS] == 0.1


UPRIGHT = replace(
    FREE, arm=replace(FREE.arm, cad_theta=()), estimator=replace(FREE.estimator, gravity=True, P0=(1.0,) * 9)
)


class Halves:
    """A fit whose steps had each half of its information, or less; all its samples are of parameters 0 and 1 alone."""

    def __init__(self, steps_used=2, settings=FREE):
        self.k, self.m = kernel_of(settings)
        count = len(certified_memory.parameter_names(settings))
        random = np.random.default_rng(5)
        root = random.standard_normal((count, count))
        self.m.models.P_belief = 0.01**2 * (np.eye(count) + root @ root.T / count)
        self.m.fit_check.samples_W[:3], self.m.fit_check.samples_tau[:3] = np.eye(2, count), self.m.models.belief[:2]
        self.m.fit_check.samples_kept = 3.0
        self.m.fit_check.steps_used = steps_used
        self.m.fit_check.steps_theta[:] = self.m.models.belief
        self.m.fit_check.steps_P[:] = 2.0 * self.m.models.P_belief

    def differ(self, step, change):
        """Let a step have had other parameters; return how far its later samples then are from the belief (p,)."""
        self.m.fit_check.steps_theta[step] -= change
        P, P_0 = self.m.models.P_belief, (1.0 + fit_check.REGULAR) * self.m.fit_check.steps_P[step]
        alone = np.linalg.solve(
            np.linalg.inv(P) - np.linalg.inv(P_0),
            np.linalg.solve(P, self.m.models.belief) - np.linalg.solve(P_0, self.m.fit_check.steps_theta[step]),
        )
        return alone - self.m.models.belief


def is_whole(fit):
    return fit_check.last_step_before_change(fit.k, fit.m) == fit_check.NONE


def test_the_model_of_the_later_samples_is_that_of_their_own_information():
    fit = Halves()
    root = 0.005 * np.random.default_rng(6).standard_normal((len(NAMES), 4))
    fit.m.fit_check.steps_P[0] += root @ root.T
    alone = fit.differ(0, np.linspace(-0.02, 0.03, len(NAMES)))
    m = fit.m
    assert fit_check.find_later(m, 0)
    assert m.fit_check.later == pytest.approx(alone, rel=1e-6)


@pytest.mark.parametrize("steps_used", [2, 11])
@pytest.mark.parametrize(("share", "is_borne_out"), [(0.97, True), (1.03, False)])
def test_later_samples_that_come_to_another_torque_do_not_bear_the_fit_out(share, is_borne_out, steps_used):
    fit = Halves(steps_used)
    unit = np.zeros(len(NAMES))
    unit[1] = 1.0
    far = np.abs(Halves().differ(0, unit)[:2]).max()
    fit.differ(0, share * fit_check.LATER_NM / far * unit)
    step = fit_check.last_step_before_change(fit.k, fit.m)
    assert step == (fit_check.NONE if is_borne_out else steps_used - 1)
    earlier.keep_steps(fit.k, fit.m, steps_used - 1)
    assert fit.m.earlier.kept_count == min(steps_used - earlier.YOUNG_STEPS, fit_check.STEPS)
    fit.m.models.is_payload = 1.0
    assert fit_check.last_step_before_change(fit.k, fit.m) == fit_check.NONE


@pytest.mark.parametrize(("share", "is_borne_out"), [(0.97, True), (1.03, False)])
def test_where_gravity_acts_later_samples_may_differ_by_what_they_do_not_know(share, is_borne_out):
    fit, count = Halves(settings=UPRIGHT), len(certified_memory.parameter_names(UPRIGHT))
    P, P_0 = fit.m.models.P_belief, (1.0 + fit_check.REGULAR) * fit.m.fit_check.steps_P[0]
    variance = np.diag(np.linalg.inv(np.linalg.inv(P) - np.linalg.inv(P_0)) - P)[:2]
    unknown_Nm = np.sqrt(fit_check.SMALLEST_UNIT * variance)
    far = np.abs(Halves(settings=UPRIGHT).differ(0, np.eye(count)[1])[:2])
    room = np.min((fit_check.LATER_NM + unknown_Nm) / far)
    assert room * far.max() > 1.2 * fit_check.LATER_NM
    fit.differ(0, share * room * np.eye(count)[1])
    assert is_whole(fit) is is_borne_out


def test_a_fit_with_noise_may_differ_by_more():
    fit = Halves()
    unit = np.eye(len(NAMES))[1]
    fit.differ(0, 1.4 * fit_check.LATER_NM / np.abs(Halves().differ(0, unit)[:2]).max() * unit)
    assert not is_whole(fit)
    fit.m.fit_check.samples_tau[:3] += 0.25 * fit_check.LATER_NM
    assert is_whole(fit)


@pytest.mark.parametrize(("share", "is_borne_out"), [(0.97, True), (1.03, False)])
def test_a_fit_whose_learnt_residuals_are_large_may_differ_by_a_share_of_the_better_part_of_them(share, is_borne_out):
    fit = Halves(steps_used=1)
    m, unit = fit.m, np.eye(len(NAMES))[1]
    m.fit_check.steps_square[0], m.fit_check.steps_rows[0] = 2.0, 50.0
    m.fit_check.fit_square, m.fit_check.fit_rows = 2.5, 100.0
    noise_Nm = fit_check.LEARNT_SHARE * FREE.certified.residual_Nm * np.sqrt(0.5 / 50.0)
    far = np.abs(Halves().differ(0, unit)[:2]).max()
    fit.differ(0, share * (fit_check.LATER_NM + noise_Nm) / far * unit)
    assert is_whole(fit) is is_borne_out


def test_what_is_kept_is_from_before_the_contact():
    loop = TouchedLoop(FREE)
    loop.learn(1.1)
    m = loop.m
    steps, of_steps = int(m.fit_check.steps_used), m.fit_check.steps_theta.copy()
    kept = steps - earlier.YOUNG_STEPS
    loop.lean(0, 3.0, 0.05)
    assert m.earlier.kept_count == kept + 1 > 3
    said = m.evidence.value[evidence.KEPT : evidence.KEPT + kept + 1]
    a1 = of_steps[earlier.YOUNG_STEPS : steps, NAMES.index("a1")]
    np.testing.assert_array_equal(said[:kept, evidence.FRICTIONS], a1)
    friction = said[-1, 0] - (THETA["P"][5] + FRICTION_SPEEDS_RAD_S[0] * THETA["P"][3])
    assert abs(friction) < 0.02  # what it had come to at the contact, with nothing of the lean


def test_nothing_is_kept_of_a_fit_that_is_as_young_as_a_touch_of_its_beginning():
    loop = TouchedLoop(FREE)
    loop.learn(0.3)
    m = loop.m
    assert m.fit_check.steps_used == 1.0
    outputs = loop.lean(0, 5.0, 0.05)
    assert any(output.contact is not None for output in outputs)
    assert not earlier.is_keeping(m)


@pytest.mark.parametrize(("offset_Nm", "is_kept"), [(0.12, True), (0.2, False)])
def test_a_kept_belief_whose_offset_an_anchor_excludes_was_leant_on_however_wide_the_anchor_is(offset_Nm, is_kept):
    compared = Compared()
    m = compared.m
    m.evidence.limit[: anchor.KINDS] = np.inf
    m.evidence.limit[anchor.REST] = 0.15  # wider than `beta_Nm`
    m.anchor.anchor_Nm[anchor.REST] = m.models.belief[OFFSETS]
    kept = m.models.belief.copy()
    kept[OFFSETS] += (offset_Nm, 0.0)
    compared.keep_only(kept, 0.01)
    compared.agrees()
    assert earlier.is_keeping(m) is is_kept


def test_of_several_kept_beliefs_the_one_that_knew_the_arm_untouched_judges():
    compared = Compared()
    m, compared_with = compared.m, compared.m.models.belief.copy()
    for touched, std in ((0.3, 0.01), (0.0, 1.0)):  # one that has learnt the hand, one that knows nothing
        compared_with[NAMES.index("F_c1")] = 0.1 + touched
        compared.keep(compared_with, std, age_s=1.0)
    m.evidence.age_s[evidence.KEPT] = 7.0
    assert not compared.agrees_with("F_c1", 0.3)
    (line,) = earlier.describe_more(m)
    assert line.startswith("friction of joint 1 at 0.2 rad/s is 0.300 Nm more than 7.0 s ago, bound 0.05")


def test_no_arm_has_less_friction_than_none_whatever_a_touched_belief_says():
    compared = Compared(std=1e-5)
    none = np.full(len(NAMES), 0.1)
    none[[VISCOUS, COULOMB]] = 0.0, -0.025
    compared.keep_only(none, 1e-5)
    compared.m.models.belief[[VISCOUS, COULOMB]] = 0.0, 0.04
    assert not compared.agrees()  # as one of none, 0.04 Nm more
    none[COULOMB] = -0.06  # who pushed the arm on was there
    compared.keep_only(none, 1e-5)
    assert not earlier.is_keeping(compared.m)
    assert compared.agrees()
    assert compared.m.earlier.kept_count == 0.0


def test_less_friction_lapses_what_was_kept_after_more_fits_than_more_of_it_does():
    compared = Compared(std=1e-5)
    agreed = [compared.agrees_with("F_c1", -0.09) for _ in range(int(earlier.LESS_FITS))]  # three times the bound
    assert agreed == [False] * (int(earlier.LESS_FITS) - 1) + [True]
    leant = Compared(UNKNOWN, std=1e-5)
    leant.m.models.belief[OFFSETS] -= 0.09
    leant.keep_only(leant.m.models.belief + 0.09 * np.isin(np.arange(len(NAMES)), [COULOMB, *OFFSETS]), 1e-5)
    assert not any(leant.agrees() for _ in range(10))
    more = Compared(std=1e-5)
    assert not any(more.agrees_with("F_c1", 0.09) for _ in range(10))


@pytest.mark.parametrize(
    ("first", "second", "lapses"),
    [(0.04, 0.04, True), (0.04, 0.08, False), (0.08, 0.04, False), (0.04, 0.0, True)],
    ids=["the same twice", "not the same", "much more first", "no more the second time"],
)
def test_what_was_kept_lapses_where_two_fits_agree_that_exceed_it_by_little(first, second, lapses):
    compared = Compared(std=1e-5)  # the bound is the floor, 0.03 Nm
    assert not compared.agrees_with("F_c1", first)
    assert compared.agrees_with("F_c1", second) is lapses
    assert bool(compared.m.earlier.has_lapsed) is (lapses and second > 0.0)


def test_a_contact_between_two_fits_keeps_what_was_kept():
    compared = Compared(std=1e-5)
    assert not compared.agrees_with("F_c1", 0.04)
    earlier.keep_fit(compared.k, compared.m)
    assert not compared.agrees_with("F_c1", 0.04)
    assert compared.agrees_with("F_c1", 0.04)


def test_a_kept_belief_that_was_leant_on_is_forgotten_and_the_others_go_on_judging():
    compared = Compared(std=1e-5)
    leant = compared.m.models.belief.copy()
    leant[NAMES.index("offset1")] += 0.3
    compared.keep(leant, 1e-5)
    assert not compared.agrees_with("F_c1", 0.04)
    assert np.isinf(compared.m.evidence.variance[evidence.KEPT : evidence.KEPT + 2, 0]).tolist() == [False, True]
