"""The contact report, made from a hand-written course of torques."""

import math

import numpy as np
import pytest
from contact_course import Course
from smooth_motion import settings_with

from adacd_hil.records import ContactKind, ContactLevel, Location, Reaction, SchemeState
from adacd_hil.scheme.contact.contact_report import last_rows, new_rows, put_row, recalled_report

SETTINGS = settings_with(scheme="certified", reaction={"collision": ["stop", "stop"]})
SIGMA, THRESHOLD = np.array([0.03, 0.015]), np.array([0.15, 0.08])
Q = np.array([0.3, 0.4])
L1 = SETTINGS.arm.link_length_m[0]


def course(force_N=20.0, lever_m=0.2, duration=40, onset=50, length=400):
    """Return the torques (n, 2) of a half-sine on link 2."""
    force = np.zeros(length)
    force[onset : onset + duration] = force_N * np.sin(np.pi * np.arange(duration) / duration)
    return np.outer(force, [lever_m + L1 * math.cos(Q[1]), lever_m])


def play(tau, detected, joints=3, level=ContactLevel.COLLISION):
    """Return the reports of a contact that is detected in a cycle."""
    touch = Course(SETTINGS)
    rows, reports = new_rows(SETTINGS), []
    for cycle, row in enumerate(tau):
        put_row(rows, int(touch.m.kept_rows), Q, row, SIGMA, THRESHOLD)
        touch.m.kept_rows += 1
        over = joints if cycle - detected >= 5 else joints & 1
        state = SchemeState.REACT if cycle >= detected else SchemeState.MONITOR
        if touch.step(over if cycle >= detected else 0, row, level, state, is_latched=True):
            reports.append(recalled_report(SETTINGS, touch.m, rows, cycle))
    return reports, touch


def test_a_contact_is_reported_at_once_after_ten_and_after_a_hundred_milliseconds():
    """Only the last report names the kind."""
    reports, touch = play(course(), 55)
    assert [report.is_final for report in reports] == [False, False, True]
    assert {report.cycle for report in reports} == {55}
    assert [report.kind for report in reports] == [ContactKind.UNKNOWN, ContactKind.UNKNOWN, ContactKind.HIT]
    assert not touch.m.is_open


def test_a_final_report_says_all_that_can_be_known():
    final = play(course(), 55)[0][-1]
    assert (final.link, final.direction, final.kind) == (2, (1, 1), ContactKind.HIT)
    assert (final.level, final.reaction, final.location) == (ContactLevel.COLLISION, Reaction.STOP, Location.KNOWN)
    assert final.force_N == pytest.approx(20.0, rel=2e-2)  # a median over the top of a half-sine
    assert final.lever_m == pytest.approx(0.2, rel=1e-3)
    assert final.tau_ext_peak[1] == pytest.approx(4.0, rel=1e-2)
    assert final.impulse[1] == pytest.approx(4.0 * 0.04 * 2.0 / math.pi, rel=2e-2)
    assert final.blind_rad == pytest.approx(math.asin(0.08 / 4.0), rel=2e-2)
    assert final.tau_ext_peak_sigma[1] == pytest.approx(math.hypot(SIGMA[1], 0.03 * 4.0), rel=1e-2)
    assert 0.01 * final.impulse[1] < final.impulse_sigma[1] < 0.02 * final.impulse[1]


def test_what_came_before_the_detection_is_part_of_the_contact():
    late, early = (play(course(duration=200), detected)[0][-1].impulse[1] for detected in (100, 110))
    assert early > late > 0.0


def test_a_force_on_link_1_is_reported_as_a_moment():
    tau = course()
    tau[:, 1] = 0.02 * tau[:, 0]
    final = play(tau, 55, joints=1)[0][-1]
    assert (final.link, final.location) == (1, Location.LINK_1)
    assert final.force_N == pytest.approx(np.max(tau[:, 0]) / L1, rel=0.01)
    assert 0.0 < final.blind_rad < 0.5


def test_joint_2_decides_the_link_before_it_is_over_its_threshold():
    tau = course(force_N=8.0, lever_m=0.05, duration=100)
    first, second, _ = play(tau, 55, joints=1)[0]
    assert (first.link, second.link) == (1, 2)


def test_the_peak_of_a_push_is_the_push_and_not_the_ringing_when_the_arm_begins_to_react():
    tau = np.zeros((300, 2))
    tau[50:, 0] = 3.0
    tau[70:80, 0] *= 1.0 + 0.2 * np.cos(np.pi * np.arange(10) / 2.5)
    final = play(tau, 55, joints=1)[0][-1]
    assert np.max(tau) == pytest.approx(3.6)
    assert final.tau_ext_peak[0] == pytest.approx(3.0, rel=0.05)


@pytest.mark.parametrize("duration", [20, 50, 100])
def test_the_peak_of_a_blow_is_that_of_its_half_sine_however_short_it_is(duration):
    """As the scheme sees it, each sample a mean of five."""
    tau = course(force_N=15.0, duration=duration)
    seen = np.stack([np.convolve(tau[:, i], np.full(5, 0.2))[: len(tau)] for i in range(2)], axis=1)
    final = play(seen, 56)[0][-1]
    np.testing.assert_allclose(final.tau_ext_peak, np.max(tau, axis=0), rtol=0.05)


def test_a_fault_ends_the_report():
    touch = Course(SETTINGS)
    assert touch.step(1, np.ones(2))
    assert touch.m.is_open
    assert not touch.step(1, np.ones(2), state=SchemeState.FAULT)
    assert not touch.m.is_open


def test_the_history_gives_its_last_rows_in_order():
    rows = np.zeros((10, 7))
    for number in range(13):
        put_row(rows, number, np.array([0.0, number]), np.zeros(2), SIGMA, THRESHOLD)
        expected = list(range(max(0, number - 3), number + 1))
        assert last_rows(rows, number + 1, 4)[:, 0].tolist() == expected
    assert last_rows(rows, 13, 99)[:, 0].tolist() == [8, 9, 10, 11, 12]
