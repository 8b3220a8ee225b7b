"""What a run of the certified scheme achieved, and the paper's scheme beside it, on runs whose answers are known."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hand_made_run import (
    FIRST_CYCLE,
    A,
    C,
    M,
    P,
    R,
    S,
    contact_report,
    evaluated,
    make_certified_run,
    make_run,
    react,
    touch,
)

from adacd_hil.lab.report.run_page import report_page
from adacd_hil.lab.score.metrics import ReportSource
from adacd_hil.lab.score.run_arrays import split_sections
from adacd_hil.lab.score.run_judge import step_delay_s
from adacd_hil.log.reader import LoggedEvent
from adacd_hil.records import (
    BEGINS_ANEW,
    ContactKind,
    ContactLevel,
    Event,
    FaultReason,
    Location,
    Reaction,
    SchemeState,
)
from adacd_hil.replay.replayed_outcome import OutcomeGatherer, StateChange
from adacd_hil.score.wording import NONE


def test_an_adaptation_lasts_until_its_model_is_certified():
    assert evaluated(make_certified_run()).adaptation_s == pytest.approx({"A": 1.0, "D": 0.5})


IN_SECTIONS = pytest.mark.parametrize(
    ("stays", "sections"),
    [
        (
            ((A, 100), (R, 50), (A, 100), (C, 60), (R, 50), (S, 10), (C, 60), (M, 100)),
            [("adaptation", True), ("detection", False)],
        ),
        (
            ((A, 10), (M, 10), (P, 10), (R, 10), (P, 10), (A, 10)),
            [("adaptation", True), ("detection", True), ("payload", True), ("adaptation", False)],
        ),
        (
            ((A, 10), (R, 10), (S, 10), (P, 10), (A, 10), (C, 10), (M, 10)),
            [("adaptation", False), ("payload", True), ("adaptation", True), ("detection", False)],
        ),
        (((A, 10), (M, 10), (R, 10), (M, 10)), [("adaptation", True), ("detection", False)]),
        (((A, 10), (SchemeState.FAULT, 5)), [("adaptation", False), ("fault", False)]),
    ],
    ids=["while it learns", "while it parks", "then a payload change", "one that clears", "no contact, a fault"],
)


@IN_SECTIONS
def test_a_contact_belongs_to_the_section_that_it_interrupts(stays, sections):
    assert [(section.kind, section.is_complete) for section in split_sections(make_run(*stays))] == sections


@IN_SECTIONS
def test_a_replay_has_the_adaptations_of_the_report(stays, sections):
    run = make_run(*stays)
    rows = np.flatnonzero(np.diff(run.state, prepend=SchemeState.INIT))
    before = np.concatenate(([SchemeState.INIT], run.state))
    gatherer = OutcomeGatherer(run.settings, None)
    gatherer.transitions += [
        StateChange(row, int(run.t_ns[row]), SchemeState(before[row]), SchemeState(run.state[row]), FaultReason.NONE)
        for row in rows.tolist()
    ]
    took_s = [
        each.duration_s if each.is_complete else None for each in split_sections(run) if each.kind == "adaptation"
    ]
    assert [duration_s for _, duration_s in gatherer.adaptations] == pytest.approx(took_s)
    assert sum(is_complete for kind, is_complete in sections if kind == "adaptation") == sum(map(bool, took_s))


def test_the_last_test_of_each_adaptation_and_their_number_are_told():
    run = make_certified_run((A, 100), (C, 30), (A, 100), (C, 70), (M, 100))
    evidence = evaluated(run).evidence
    assert (evidence.tests, evidence.test_s) == ({"A": 2}, {"A": pytest.approx(0.07)})


def touched_in_adaptation():
    run = make_certified_run()
    touch(run, 400, 100, (5.0, 0.0))
    return react(run, 402, 50)


def test_a_contact_while_adapting_has_its_delay_and_is_not_missed():
    metrics = evaluated(touched_in_adaptation())
    (contact,) = metrics.contacts
    assert (contact.state, contact.is_armed, contact.delay_ms) == ("ADAPT", False, pytest.approx(2.0))
    assert "1 more while it was not watched (1 of them detected)" in metrics.verdict
    assert metrics.missed == 0


def margin_of(run, label, channel):
    return tuple(evaluated(run).evidence.margins[label][channel].margin)


def test_the_margin_is_the_smallest_threshold_over_residual():
    run = make_certified_run()
    run.certified.tau_ext[2000, 4] = (0.05, -0.02)
    run.certified.tau_ext[3000, 4, 0] = 0.08
    run.certified.threshold[3000, 4, 0] = 0.4
    run.certified.tau_ext[500, 1] = 0.025
    assert margin_of(run, "B", 4) == pytest.approx((2.0, 5.0))
    assert margin_of(run, "A", 1) == pytest.approx((4.0, 4.0))  # while it learns
    assert evaluated(run).evidence.smallest_margin == pytest.approx(2.0)


@pytest.mark.parametrize("make", [make_run, make_certified_run])
@pytest.mark.parametrize(
    ("residual", "threshold", "is_good"),
    [(0.0, 0.1, True), (math.nan, 0.1, False), (0.0, math.inf, False), (0.0, 5.9, True), (0.0, 6.1, False)],
)
def test_a_run_whose_joint_was_blind_is_not_good(make, residual, threshold, is_good):
    run = make((A, 600), (M, 1000))
    by = run.certified
    for values, changed in zip(
        (run.tau_ext_hat, run.threshold) if by is None else (by.tau_ext, by.threshold),
        (residual, threshold),
        strict=True,
    ):
        values[1350:, ..., 1] = changed
    found = evaluated(run)
    assert found.is_clean == is_good
    assert [text.text.partition(" of MONITOR")[0] for text in found.findings if text.is_bad] == (
        [] if is_good else ["a joint was blind in 25 %"]
    )


def test_a_touch_is_no_small_margin():
    run = make_certified_run()
    touch(run, 2000, 100, (5.0, 0.0))
    run.certified.tau_ext[2001:2100, 0, 0] = 5.0
    assert margin_of(run, "B", 0) == (math.inf, math.inf)


def test_every_parameter_has_its_standard_deviation():
    estimates = evaluated(make_certified_run()).evidence.estimates["D"]
    assert list(estimates)[-2:] == ["cross_talk1", "cross_talk2"]
    assert (estimates["lag1"].value, estimates["lag1"].std) == (0.001, 0.01)


def test_promotions_are_counted_over_the_certificates():
    run = make_certified_run()
    run.certified.promotions[3000:5000] = 2.0
    run.certified.promotions[8000:] = 1.0
    assert evaluated(run).evidence.promotions == 3


def beside(run):
    return evaluated(run).evidence.paper_beside


def test_the_papers_scheme_is_armed_later_on_the_same_stream_or_never():
    run = make_certified_run()
    assert beside(run).adaptation_s == pytest.approx({"A": 2.0, "D": 2.0})
    run.beside.is_armed[5551:] = False
    assert beside(run).adaptation_s == {"A": pytest.approx(2.0), "D": None}


def test_a_scheme_that_did_not_run_beside_has_no_figures():
    run = make_certified_run()
    assert "5 s" in {row.beside for row in evaluated(run).paper}
    assert {row.beside for row in evaluated(replace(run, beside=None)).paper} == {NONE}


def certificates(*levels):
    events = (LoggedEvent(k, Event(level, "certificate", f"of {level}")) for k, level in enumerate(levels))
    return replace(make_certified_run(), events=tuple(events))


def test_a_verdict_says_that_nothing_anchors_the_offsets_of_some_certificate():
    metrics = evaluated(certificates("info", "warning"))
    assert not metrics.evidence.is_anchored
    assert (
        "offsets that nothing anchors; the paper's scheme on the same stream took 2.00 s and 2.00 s" in metrics.verdict
    )
    assert "anchors" not in evaluated(certificates("info", "info")).verdict


def test_a_certificate_that_was_taken_back_is_what_the_verdict_begins_with_and_the_run_is_not_good():
    why = "2 contacts look like 0.50 ± 0.06 kg picked up: the certificate is taken back"
    run = replace(make_certified_run(), events=(LoggedEvent(5, Event("warning", "revoked", why)),))
    metrics = evaluated(run)
    assert metrics.evidence.revoked == (why,)
    assert metrics.verdict.startswith(f"{why}; ")
    assert not metrics.is_clean
    assert evaluated(make_certified_run()).is_clean


def withheld(*events):
    told = ((s, name, f"offset {s} Nm{clause}") for s, name, clause in events)
    run = make_certified_run()
    logged = (LoggedEvent(run.zero_ns + s * 10**9, Event("warning", name, text)) for s, name, text in told)
    return replace(run, events=tuple(logged))


BEGUN_ANEW = f"; {BEGINS_ANEW}; `accept` helps"


@pytest.mark.parametrize(
    ("events", "text"),
    [
        ((), ""),
        (((1, "anchor", "; the drives stay off; `accept` helps"),), ""),
        (((1, "touch", BEGUN_ANEW),), "a certificate was withheld from 1.00 s on: offset 1 Nm"),
        (
            ((1, "touch", BEGUN_ANEW), (2, "anchor", BEGUN_ANEW), (4, "certificate", ""), (5, "certificate", "")),
            "a certificate was withheld from 1.00 to 4.00 s: offset 2 Nm",
        ),
        (
            ((1, "touch", BEGUN_ANEW), (2, "certificate", ""), (6, "sight", BEGUN_ANEW), (7, "certificate", "")),
            "certificates were withheld 2 times, last from 6.00 to 7.00 s: offset 6 Nm",
        ),
    ],
)
def test_a_verdict_names_for_how_long_and_why_certificates_were_withheld(events, text):
    findings = evaluated(withheld(*events)).findings
    assert [finding.text for finding in findings if "withheld" in finding.text] == [text] * bool(text)
    assert evaluated(withheld(*events)).is_clean


def touched_beside(row, crossing):
    run = make_certified_run()
    touch(run, row, 250, (5.0, 0.0))
    run.beside.tau_ext_hat[crossing : row + 250, 0] = 1.0
    return react(run, row + 1)


@pytest.mark.parametrize(
    ("row", "crossing", "told", "missed"),
    [
        (3000, 3005, (1, True, pytest.approx(5.0)), 0),
        (1500, 1505, (1, False, None), 0),
        (3000, 3250, (1, True, None), 1),
    ],
    ids=["over its threshold", "before it is armed", "below its threshold"],
)
def test_the_papers_scheme_detects_where_it_crosses_its_threshold(row, crossing, told, missed):
    run = touched_beside(row, crossing)
    theirs = beside(run)
    assert [(c.number, c.is_armed, c.delay_ms) for c in theirs.contacts] == [told]
    assert (theirs.missed, theirs.false_alarms, evaluated(run).missed) == (missed, 0, 0)


def test_a_false_alarm_of_the_papers_scheme_counts_once():
    run = make_certified_run()
    run.beside.tau_ext_hat[3000:3010, 0] = 0.2
    run.beside.tau_ext_hat[3500:3510, 1] = -0.2
    run.beside.tau_ext_hat[4900:4910, 1] = 0.2
    run.beside.tau_ext_hat[5100:5500] = 0.5  # while the payload is changed
    assert beside(run).false_alarms_s == pytest.approx((2.95, 4.85))


@pytest.mark.parametrize(("row", "false_alarms"), [(8990, 1), (9000, 0)])
def test_while_the_arm_parks_at_the_end_the_papers_scheme_raises_no_false_alarm(row, false_alarms):
    run = make_certified_run(finish_cycle=FIRST_CYCLE + 9000)
    run.beside.tau_ext_hat[row : row + 5, 0] = 0.2
    assert beside(run).false_alarms == false_alarms


def test_the_papers_residual_counts_where_it_is_armed():
    run = make_certified_run()
    run.beside.tau_ext_hat[1500] = 0.09
    run.beside.tau_ext_hat[3000] = (0.03, -0.04)
    assert beside(run).frozen_residual_max_Nm["B"] == (0.03, 0.04)


def reported(**said):
    run = make_certified_run()
    touch(run, 3000, 250, (6.0, 3.0), link=2)
    run.truth.force_N[3000:3250] = 15.0
    run.state[3002:3100] = R
    made = contact_report(int(run.cycle[3002]), link=2, direction=(1, 1), location=Location.KNOWN, **said)
    return evaluated(replace(run, reports=(made,))).contacts[0]


def test_a_contact_says_what_its_report_says():
    contact = reported(
        level=ContactLevel.CONTACT, kind=ContactKind.HIT, reaction=Reaction.STOP, force_N=15.2, force_sigma=0.8,
        lever_m=0.19, lever_sigma=0.01, blind_rad=0.1, impulse=(0.6, 0.3), impulse_sigma=(0.01, math.inf),
    )  # fmt: skip
    assert (contact.level, contact.kind, contact.reaction, contact.location) == ("CONTACT", "HIT", "STOP", "KNOWN")
    assert (contact.force_N, contact.force_sigma_N, contact.true_force_N) == (15.2, 0.8, 15.0)
    assert (contact.lever_m, contact.lever_sigma_m) == (0.19, 0.01)
    assert contact.blind_deg == pytest.approx(5.73, abs=0.01)
    assert (contact.impulse_Nm_s, contact.impulse_sigma_Nm_s) == ((0.6, 0.3), (0.01, None))


def test_what_a_report_does_not_know_is_none():
    contact = reported(force_N=3.0, lever_m=0.1)
    assert (contact.force_N, contact.lever_m) == (None, None)
    run = react(make_run(), 2000, tau_ext_peak=(5.0, 0.0))  # the paper's scheme seeks no place
    touch(run, 1995, 100, (5.0, 0.0))
    contact = evaluated(run).contacts[0]
    assert (contact.location, contact.force_N, contact.kind) == (None, None, None)


def test_a_step_behind_two_low_passes_takes_as_long_as_it_should_and_below_the_threshold_for_ever():
    # 1 - (1 + x) exp(-x) is 0.5 at x = 1.67835.
    assert step_delay_s(np.array((-2.0, 0.1)), np.ones(2), 100.0, 100.0) == pytest.approx(0.0167835, rel=1e-4)
    assert step_delay_s(np.array((0.0, 1.0)), np.ones(2), 10.0, 200.0) is None


def test_the_law_is_that_of_the_fastest_channel():
    run = make_certified_run()
    touch(run, 3000, 250, (1.0, 0.0))
    (contact,) = evaluated(react(run, 3001)).contacts
    assert contact.law_ms == pytest.approx(-1e3 * math.log1p(-0.1) / 200.0)
    assert contact.ideal_ms == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("location", "words"),
    [
        (Location.KNOWN, "force at right angles</dt><dd>−14.2 ± 0.5 N"),
        (Location.LINK_1, "force</dt><dd>≥ 14.2 ± 0.5 N"),
        (Location.BEYOND_TIP, "force</dt><dd>not known"),
    ],
)
def test_a_force_is_told_as_far_as_it_is_known(location, words):
    run = touched_beside(3000, 3005)
    made = contact_report(int(run.cycle[3001]), location=location, force_N=-14.2, force_sigma=0.5)
    run = replace(run, reports=(made,))
    assert f"<dt>{words}</dd>" in report_page(evaluated(run), run, ReportSource("run.mcap"))
