"""A certificate that is wrong meets the same cause again and again: it is named, and taken back."""

import re

import numpy as np
import pytest
from excited_arm import FREE, PERIOD_S, SETTINGS, TouchedLoop, added, kernel_of
from long_cases import long_but
from planar_arm import PAYLOAD_1KG, THETA

from adacd_hil.records import Request, SchemeState
from adacd_hil.scheme.identify import doubt
from adacd_hil.scheme.identify.doubt import Doubt
from adacd_hil.scheme.model import filter_bank
from adacd_hil.scheme.pipeline.certificate_watch import BY_WORD

PAYLOAD, COULOMB1 = range(2)


class MonitoredLoop(TouchedLoop):
    """An arm that has been certified, and two seconds more."""

    def __init__(self, profile="P", **options):
        super().__init__(FREE, theta=THETA[profile], **options)
        self.run_until(SchemeState.MONITOR)
        self.run(2000)

    def run_until_taken_back(self, seconds=20.0):
        """Return how many contacts there were; the user acknowledges those that are collisions."""
        contacts = stopped = 0
        for _ in range(round(seconds / PERIOD_S)):
            output = self.step()
            contacts += output.state is SchemeState.REACT and output.previous_state is SchemeState.MONITOR
            if self.said("revoked"):
                assert output.state is SchemeState.STOPPED
                return contacts
            stopped = stopped + 1 if output.state is SchemeState.STOPPED else 0
            if stopped == 600:
                self.request, stopped = Request.ACKNOWLEDGE, 0
        raise AssertionError(f"{contacts} contacts, and nothing was taken back")


@pytest.mark.parametrize("profile", ["P", "S", "M"])
@pytest.mark.parametrize("kg", long_but(1, [0.5, 0.1, 1.0]))
def test_a_payload_that_nobody_announced_is_named_and_learnt_at_a_word(profile, kg):
    loop = MonitoredLoop(profile)
    loop.theta = loop.theta + kg * PAYLOAD_1KG
    assert loop.run_until_taken_back() <= 5
    assert any("s after going on: if nobody has touched the arm, a load was picked up" in t for t in loop.said("touch"))
    (text,) = loop.said("revoked")
    named = re.fullmatch(r"\d contacts look like (\S+) ± (\S+) kg picked up: .*, `changed` learns it", text)
    assert float(named[1]) == pytest.approx(kg, rel=0.1)
    loop.request = Request.PAYLOAD_CHANGED
    loop.run_until(SchemeState.ADAPT)
    assert len(loop.run_until(SchemeState.MONITOR)) * PERIOD_S < 1.5
    assert loop.error_of("a1") < 0.01


@pytest.mark.parametrize(
    ("hand", "named", "most"),
    [
        (added(F_c1=0.3), r"0\.3\d ± 0\.\d\d Nm more Coulomb friction of joint 1", 10),
        (added(F_v2=0.2), r"0\.(19|20|21) ± 0\.\d\d Nm s/rad more viscous friction of joint 2", 3),
    ],
)
def test_friction_that_is_not_the_certified_one_is_named_and_learnt_at_a_word(hand, named, most):
    loop = MonitoredLoop()
    loop.theta = loop.theta + hand
    assert loop.run_until_taken_back() <= most
    assert re.search(rf"[34] contacts look like {named} than was certified", loop.said("revoked")[0])
    loop.request = Request.ACKNOWLEDGE
    loop.recover()
    assert loop.error_of("F_c1") < 0.02
    assert loop.error_of("F_v2") < 0.02
    assert loop.said("certificate")[1].endswith(f"; {BY_WORD}the certificate that was taken back")


@pytest.mark.parametrize(("seconds", "is_said"), [(0.4, False), (4.0, True)])
def test_a_push_at_rest_is_said_once_the_filters_have_forgotten_a_hand_that_has_gone(seconds, is_said):
    loop = MonitoredLoop()
    outputs = loop.lean(0, 2.0, seconds) + loop.run(2000)
    stopped = [output.state for output in outputs].index(SchemeState.STOPPED) * PERIOD_S
    assert stopped < seconds + 0.3  # the slowest filter still has a part of the hand
    assert [text.startswith("something still pushes the arm at rest, 2.0") for text in loop.said("touch")] == [
        True
    ] * is_said


def test_a_contact_that_never_ends_has_an_exit():
    """A sensor that has moved by 0.5 Nm looks like somebody who leans: only the user knows, and says it by a word."""
    loop = MonitoredLoop()
    loop.offset_Nm[0] = 0.5
    loop.run_until(SchemeState.STOPPED, 15_000)
    loop.run(1100)
    assert re.match(r"something still pushes the arm at rest, -?0\.[45]\d, ", loop.said("touch")[-1])
    assert "`relearn`" in loop.told("touch")[-1]
    loop.request = Request.ACKNOWLEDGE
    assert {output.state for output in loop.run(1000)} == {SchemeState.STOPPED}
    loop.request = Request.RELEARN
    outputs = loop.run_until(SchemeState.ADAPT, 100)
    assert not outputs[-1].is_model_valid
    assert (outputs[-1].theta_ff == 0.0).all()
    assert loop.said("revoked") == ["at the user's word the arm is learnt anew"]
    loop.run(3000)
    assert "joint 1 has a fitted torque offset of 0." in loop.said("anchor")[-1]  # the reading at rest says otherwise
    loop.request = Request.ACCEPT
    loop.recover()
    assert abs(loop.offset_error_Nm[0]) < 0.03
    assert loop.said("certificate")[1].endswith(f"; {BY_WORD}the certificate that was taken back")


def sums(size, sigma=0.02, share=1.0, cause=PAYLOAD):
    """The sums of a contact that one cause explains to this share, with this sigma of its size."""
    correlated = 2.0 / (SETTINGS.certified.cutoffs_rad_s[filter_bank.LEARNT] * PERIOD_S)
    ww = correlated * (doubt.RESIDUAL_NM / sigma) ** 2
    rw = np.zeros(doubt.CAUSES)
    rw[cause] = size * ww
    return rw, ww, size * size * ww / share


def verdict_of(contacts, gap_s=1.0, lasts_s=0.5, peak=3.0, ways=(0.5, 0.5)):
    k, m = kernel_of()
    m.models.theta = 0.0
    judge, cycle, verdict = Doubt(SETTINGS, k, m), 0, None
    for rw, ww, rr in contacts:
        judge.go_on(cycle)
        cycle += round(gap_s / PERIOD_S)
        judge.begin_contact(cycle, is_touched=True)
        m.doubt.b[: doubt.CAUSES], m.doubt.L, m.doubt.rr = rw, ww * np.eye(len(m.doubt.L)), rr
        m.doubt.load_ww = np.array(ways) * ww
        m.doubt.peak = peak
        cycle += round(lasts_s / PERIOD_S)
        verdict = judge.end_contact(cycle)
    return verdict


@pytest.mark.parametrize("cause", [doubt.LOAD, COULOMB1])
def test_contacts_right_after_going_on_that_come_to_the_same_are_named_by_their_agreement(cause):
    """Each tells little: its deviation is larger than the size."""
    alike = [sums(size, cause=cause, sigma=1.0) for size in (0.5, 0.52, 0.48, 0.5)]
    assert verdict_of(alike[:3], gap_s=0.2) is None
    assert verdict_of(alike, gap_s=doubt.HELD_S + 0.01) is None
    verdict = verdict_of(alike, gap_s=0.2)
    assert verdict.is_payload is (cause == doubt.LOAD)
    assert verdict.text.startswith("4 contacts look like 0.50 ± 0.15")
    unlike = [sums(size, cause=cause, sigma=1.0) for size in (0.5, 0.6, 0.4, 0.5)]
    assert verdict_of(unlike, gap_s=0.2) is None


FRICTION = sums(0.3, cause=COULOMB1)


@pytest.mark.parametrize(
    ("contacts", "named"),
    [
        ([sums(0.5)] * 3, "0.50 ± 0.03 kg picked up"),
        ([sums(-0.5)] * 3, "0.50 ± 0.03 kg put down"),
        ([FRICTION] * 3, "0.30 ± 0.03 Nm more Coulomb friction of joint 1"),
    ],
)
def test_three_contacts_that_agree_are_named(contacts, named):
    verdict = verdict_of(contacts, ways=(1.0, 0.15))
    assert verdict.is_payload is ("kg" in named)
    assert verdict.text.startswith(f"3 contacts look like {named}")


@pytest.mark.parametrize(
    ("contacts", "options"),
    [
        ([sums(0.5)] * 2, {}),
        ([sums(0.5)] * 3, {"ways": (1.0, 0.05)}),
        ([sums(0.5), sums(0.5), sums(0.5, share=0.7)], {}),
        ([sums(0.5, share=0.88)] * 3, {}),
        ([sums(0.5), sums(0.5), sums(0.8)], {}),
        ([sums(0.5), sums(0.5), sums(-0.5)], {}),
        ([sums(0.5, sigma=0.2)] * 3, {}),
        ([sums(0.5), sums(0.5)], {"gap_s": doubt.WITHIN_S}),
        ([FRICTION] * 2, {}),
        ([FRICTION] * 3, {"gap_s": doubt.AT_ONCE_S + 0.1}),
        ([sums(-0.3, cause=COULOMB1)] * 3, {}),
        ([sums(2.1, cause=COULOMB1)] * 3, {}),
    ],
    ids=[
        "two payloads", "who pushes one way", "one is something else", "not all of it", "another size",
        "another sign", "hardly known", "a minute ago", "friction twice", "friction not at once",
        "less friction than none", "more friction than any",
    ],
)  # fmt: skip
def test_contacts_that_no_one_cause_explains_take_nothing_back(contacts, options):
    assert verdict_of(contacts, **options) is None


UNEXPLAINED = sums(0.3, cause=COULOMB1, share=0.3)


def test_contacts_that_nothing_explains_take_the_certificate_back_when_the_arm_cannot_go_on():
    assert verdict_of([UNEXPLAINED] * (doubt.MANY - 1), gap_s=0.25) is None
    assert verdict_of([UNEXPLAINED] * doubt.MANY, gap_s=doubt.HELD_S + 0.01) is None
    verdict = verdict_of([UNEXPLAINED] * doubt.MANY, gap_s=0.25)
    assert not verdict.is_payload
    assert verdict.text.startswith("10 contacts came within 0.3 s of going on each, and no one error explains them")


def test_weak_contacts_take_the_certificate_back_where_they_are_many():
    """Three in 6.9 minutes are 1000 times likelier at 30 an hour than at one."""
    weak = 0.99 * doubt.WEAK
    assert verdict_of([UNEXPLAINED] * 2, gap_s=5.0, peak=weak) is None
    assert verdict_of([UNEXPLAINED] * 3, gap_s=215.0, peak=weak) is None
    assert verdict_of([UNEXPLAINED] * 3, gap_s=5.0, peak=1.01 * doubt.WEAK) is None
    assert verdict_of([UNEXPLAINED] * 3, gap_s=0.99 * doubt.AT_REST_S, peak=weak) is None
    text = verdict_of([UNEXPLAINED] * 3, gap_s=195.0, peak=weak).text
    assert text.startswith("3 contacts came to less than 1.5 times their threshold, and no one error explains them")


def test_a_contact_as_the_arm_goes_on_lets_it_move_further_the_next_time_four_times_at_most():
    loop = MonitoredLoop()
    loop.theta = loop.theta + added(F_c1=0.3)
    loop.run_until_taken_back()
    assert loop.m.sensitivity.strain.tolist() == [doubt.MOST_STRAIN, 1.0]


@pytest.mark.parametrize("lasts_s", [3600.0, doubt.AT_ONCE_S + 1.0])
def test_how_long_a_contact_and_its_acknowledgement_took_is_not_asked(lasts_s):
    assert (verdict_of([FRICTION] * 3, lasts_s=lasts_s) is not None) == (lasts_s < doubt.WITHIN_S)
    assert verdict_of([sums(0.5)], lasts_s=lasts_s) is None


@pytest.mark.parametrize("torque_Nm", [0.05, -0.06])
def test_who_leans_more_and_more_is_found_and_takes_the_certificate_back(torque_Nm):
    loop = MonitoredLoop()
    for k in range(60_000):
        loop.tau_ext[0] = torque_Nm * min(k * PERIOD_S / 30.0, 1.0)
        loop.step()
        if loop.said("revoked"):
            break
    assert "a torque sensor that has moved" in loop.said("revoked")[0]
    assert loop.step().state is SchemeState.STOPPED
    loop.tau_ext[:] = 0.0
    loop.request = Request.ACKNOWLEDGE
    loop.recover()
    assert abs(loop.offset_error_Nm[0]) < 0.02


@pytest.mark.long
def test_an_arm_that_only_warms_up_keeps_its_certificate():
    loop = MonitoredLoop("M")
    cold = loop.theta.copy()
    for k in range(120_000):
        loop.theta[3:] = cold[3:] * (1.0 - 0.2 * k / 120_000)
        assert loop.step().state is SchemeState.MONITOR
    assert loop.said("revoked") == []
