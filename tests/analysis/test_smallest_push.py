"""How small a push is found in time: by thresholds and residuals that are known."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hand_made_run import A, C, M, evaluated, make_certified_run, make_run, react, touch

from adacd_hil.lab.report.page import render
from adacd_hil.lab.report.report_tables import counted_sentence, push_table
from adacd_hil.lab.score.report_wording import rate_sentence
from adacd_hil.log.logged_run import Span
from adacd_hil.scheme.detect.sensitivity import AGREES

SLOWEST = 0.612758  # what 10 and then 200 rad/s show of a step after 0.1 s: 1 - (200 e^-1 - 10 e^-20) / 190


def only_the_slowest(run, threshold_Nm=0.05):
    run.certified.threshold[:] = 100.0
    run.certified.threshold[:, 0] = threshold_Nm
    return run


def smallest_push(run):
    return evaluated(run).evidence.smallest_push


def test_the_channel_that_finds_it_with_the_least_counts():
    run = only_the_slowest(make_certified_run())
    run.certified.threshold[:, -1, 1] = 0.06  # bare, 200 rad/s: all of the step after 0.1 s
    run.certified.threshold[:, 2, 1] = 0.1  # and smoothed, which has to agree
    first, second = smallest_push(run).push_Nm
    assert first["p50"] == pytest.approx(0.05 / SLOWEST, rel=1e-5)
    assert second["p50"] == pytest.approx(0.06, rel=1e-5)


def test_a_bare_channel_finds_nothing_unless_the_smoothed_one_agrees():
    run = only_the_slowest(make_certified_run(), 0.2)
    run.certified.threshold[:, -1, 0] = 0.06
    run.certified.threshold[:, 2, 0] = 0.25
    assert smallest_push(run).push_Nm[0]["p50"] == pytest.approx(AGREES * 0.25, rel=1e-5)


def test_a_residual_is_against_the_push_whatever_its_sign():
    run = only_the_slowest(make_certified_run())
    run.certified.tau_ext[2000, 0, 0], run.certified.tau_ext[2500, 0, 1] = 0.02, -0.03
    found = smallest_push(run)
    assert [joint["max"] for joint in found.push_Nm] == pytest.approx([0.07 / SLOWEST, 0.08 / SLOWEST], rel=1e-5)
    assert [joint["max"] for joint in found.threshold_Nm] == [0.05, 0.05]


def test_only_armed_cycles_that_nothing_touches_count():
    run = make_certified_run((A, 1000), (C, 500), (M, 4000))
    run.certified.threshold[:1500] = 5.0
    touch(run, 3000, 100, (5.0, 0.0))
    run.certified.tau_ext[3000:3050] = 5.0
    found = smallest_push(react(run, 3002, 50))
    assert found.push_Nm[0]["max"] == pytest.approx(0.1)
    is_free = np.ones(4000, np.bool_)
    is_free[1500 : 1500 + 100 + 1000] = False  # the touch, and ten time constants of the slowest filter
    assert found.hours * 3600.0 == pytest.approx(is_free.sum() * 1e-3, abs=0.01)


def test_cycles_that_the_truth_does_not_cover_are_no_hours_without_a_false_alarm():
    whole = make_certified_run()
    part = replace(whole, truth=replace(whole.truth, span=Span(int(whole.cycle[0]), int(whole.cycle[2999]))))
    armed = whole.state[:3000] == M
    assert smallest_push(part).hours * 3600.0 == pytest.approx(armed.sum() * 1e-3)
    assert smallest_push(part).hours < smallest_push(whole).hours


def test_what_was_never_armed_says_nothing():
    assert smallest_push(make_certified_run((A, 1000))) is None
    assert push_table(evaluated(make_certified_run((A, 1000))).evidence) is None
    assert push_table(evaluated(make_run()).evidence) is None


def told(metrics):
    """Give what the page says of it."""
    push = push_table(metrics.evidence)
    counted = counted_sentence(metrics)
    html = render("margins.html.j2", metrics=metrics, margins=None, push=push, push_within="1 s", counted=counted)
    return " ".join(html.split())


def test_the_rate_of_false_alarms_is_bounded_by_counting():
    metrics = evaluated(make_certified_run())
    hours = metrics.evidence.smallest_push.hours
    assert metrics.false_alarm_bound_per_h == pytest.approx(-math.log(0.05) / hours)
    alarmed = evaluated(react(make_certified_run(), 3000, 20))
    assert alarmed.false_alarm_bound_per_h > 1.5 * metrics.false_alarm_bound_per_h
    assert "No false alarms in that time, which is too short to tell a rate" in told(metrics)
    assert "per hour at 95 %" not in told(metrics)
    assert "1 false alarm in that time" in told(alarmed)


def test_the_rate_under_a_gaussian_tail_follows_from_how_near_residuals_came():
    """3600 nu (nu T)^(-1 / s²) of each channel and joint; here of the slowest and one joint, nu = 10 / pi."""
    run = only_the_slowest(make_certified_run(), 0.1)
    run.certified.tau_ext[:] = 0.0
    assert smallest_push(run).tail_rate_per_h == 0.0
    run.certified.tau_ext[2000, 0, 1] = -0.08
    found, nu_Hz = smallest_push(run), 10.0 / math.pi
    expected = 3600.0 * nu_Hz * (nu_Hz * found.hours * 3600.0) ** (-1.0 / 0.8**2)
    assert found.tail_rate_per_h == pytest.approx(expected)
    assert f"; {expected:.2g} per hour if residuals have the tail of a Gaussian" in told(evaluated(run))


def test_the_bound_of_the_rate_is_told_from_an_hour_on():
    assert "at most 2.9 per hour" in rate_sentence(0, 2.9)
    assert "per hour" not in rate_sentence(0, 42127.0)


def test_an_alarm_while_the_arm_learns_is_none_of_those():
    metrics = evaluated(react(make_certified_run((A, 1000), (C, 500), (M, 4000)), 500, 20))
    assert metrics.false_alarms == 1
    assert "No false alarms in that time" in told(metrics)
    assert metrics.false_alarm_bound_per_h == pytest.approx(3.0 / metrics.evidence.smallest_push.hours, rel=0.01)


def test_without_the_truth_nobody_knows_what_a_false_alarm_was():
    metrics = evaluated(make_certified_run(has_truth=False))
    assert metrics.false_alarm_bound_per_h is None
    assert "false alarm" not in told(metrics)
