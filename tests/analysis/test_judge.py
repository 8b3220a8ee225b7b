"""The one judge: which alarm is about which contact, what was found, how late, and what was false."""

from dataclasses import replace

import numpy as np
import pytest

from adacd_hil.log.logged_run import begins_alarm, enters_react
from adacd_hil.records import SchemeState
from adacd_hil.score.emulator_truth import HostCycles, placed_contacts
from adacd_hil.score.judge import (
    Detection,
    Score,
    StreamJudge,
    TrueContact,
    contact_bounds,
    explained_until,
    judge,
)
from adacd_hil.settings.configuration_files import load_settings

MS = 1_000_000


def touch(onset_ms, forgotten_ms, number=1, is_armed=True, is_reacting=False):
    return TrueContact(number, 1, onset_ms * MS, forgotten_ms * MS, is_armed, is_reacting)


def alarms(*at_ms, **changes):
    return [replace(Detection(at * MS, True), **changes) for at in at_ms]


def found_ms(score: Score):
    return [contact.delay_ms for contact in score.contacts]


def false_ms(score: Score):
    return [alarm.t_ns / MS for alarm in score.false_alarms]


@pytest.mark.parametrize(
    ("at_ms", "delay_ms", "false"),
    [(99, None, 1), (100, 0.0, 0), (107, 7.0, 0), (300, 200.0, 0), (301, None, 1)],
    ids=["before", "onset", "during", "forgotten", "later"],
)
def test_a_contact_explains_alarms_from_its_onset_until_it_is_forgotten(at_ms, delay_ms, false):
    score = judge([touch(100, 300)], alarms(at_ms))
    assert found_ms(score) == [delay_ms]
    assert len(score.false_alarms) == false


def test_an_alarm_finds_the_last_contact_that_began_before_it_and_no_other():
    score = judge([touch(100, 300), touch(200, 400, number=2)], alarms(205))
    assert found_ms(score) == [None, 5.0]
    assert score.missed == 1


def test_what_an_earlier_contact_left_is_explained_after_a_later_one_is_forgotten():
    score = judge([touch(100, 400), touch(150, 200, number=2)], alarms(300))
    assert false_ms(score) == []
    assert found_ms(score) == [None, 150.0]


def test_only_what_armed_detection_missed_or_raised_counts_against_it_and_nothing_beyond_the_truth():
    score = judge(
        [touch(100, 300), touch(400, 500, number=2, is_armed=False)],
        [*alarms(10), *alarms(20, is_armed=False), *alarms(30, is_known=False), *alarms(110, 120)],
    )
    assert (found_ms(score), score.missed, score.armed) == ([10.0, None], 0, 1)
    assert (false_ms(score), score.armed_false_alarms) == ([10.0, 20.0], 1)
    assert [alarm.t_ns for alarm in score.unjudged] == [30 * MS]


@pytest.mark.parametrize(
    ("is_reacting", "alarms_ms", "delay_ms"),
    [(True, (), 4.0), (False, (), None), (True, (120,), 20.0)],
    ids=["alone", "not reacting", "an alarm outweighs it"],
)
def test_a_crossing_finds_a_contact_that_begins_while_the_scheme_still_reacts(is_reacting, alarms_ms, delay_ms):
    window = touch(100, 300, is_armed=False, is_reacting=is_reacting)
    assert found_ms(judge([window], alarms(*alarms_ms), crossings_ns=[104 * MS, 150 * MS])) == [delay_ms]


def test_of_a_stretch_only_what_begins_in_it_counts():
    score = judge([touch(100, 150), touch(200, 250, number=2)], alarms(50, 105, 205, 300))
    later = score.since(200 * MS)
    assert [contact.number for contact in later.contacts] == [2]
    assert false_ms(later) == [300.0]


def stream(touches, over_ms, judged=lambda t_ms: t_ms == t_ms, pieces=1):
    t_ms = np.arange(1000)
    over = np.isin(t_ms, over_ms)
    streamed = StreamJudge(100 * MS)
    for part in np.array_split(t_ms, pieces):
        begun = [each for each in touches if each.onset_ns <= part[-1] * MS]
        streamed.add_samples(begun, part * MS, over[part], judged(part))
    return streamed.score(touches)


@pytest.mark.parametrize("pieces", [1, 7, 1000])
def test_a_stream_is_judged_the_same_in_whatever_pieces_it_comes(pieces):
    touches = [touch(100, 300), touch(200, 400, number=2)]
    score = stream(touches, [50, 105, 106, 203, 500, 600, 701], pieces=pieces)
    assert found_ms(score) == [5.0, 3.0]
    assert false_ms(score) == [50.0, 500.0, 701.0]


def test_a_stream_finds_contacts_where_its_false_alarms_do_not_count():
    score = stream([touch(100, 300)], [50, 105, 500], judged=lambda t_ms: t_ms < 50)
    assert (found_ms(score), false_ms(score)) == ([5.0], [])


def test_reacting_begins_once_until_the_stop_is_over():
    m, r, s = SchemeState.MONITOR, SchemeState.REACT, SchemeState.STOPPED
    previous, state = np.array([m, m, r, r, s, s], np.uint8), np.array([m, r, r, s, r, m], np.uint8)
    assert enters_react(previous, state).tolist() == [False, True, False, False, False, False]


def test_another_index_or_another_attempt_is_another_contact():
    index = np.array([-1.0, 0, 0, 1, 1, -1, 1, 1])
    attempt = np.array([0, 0, 0, 0, 0, 0, 0, 1])
    assert contact_bounds(index, None) == [(1, 3), (3, 5), (6, 8)]
    assert contact_bounds(index, attempt) == [(1, 3), (3, 5), (6, 7), (7, 8)]
    assert contact_bounds(np.zeros(0), None) == []


def test_windows_of_contacts_do_not_overlap():
    assert explained_until(np.array([100, 150, 900]), np.array([400, 200, 950])).tolist() == [149, 400, 950]


@pytest.mark.parametrize(
    ("previous", "is_over", "is_reported", "is_alarm"),
    [
        (SchemeState.MONITOR, True, False, True),
        (SchemeState.MONITOR, False, True, True),
        (SchemeState.MONITOR, False, False, False),  # a late host
        (SchemeState.STOPPED, True, True, False),
    ],
)
def test_a_reaction_is_an_alarm_if_something_touches(previous, is_over, is_reported, is_alarm):
    states = (np.array([state], np.uint8) for state in (previous, SchemeState.REACT))
    assert begins_alarm(*states, np.array([is_over]), np.array([is_reported])).tolist() == [is_alarm]


def test_a_contact_from_before_the_first_cycle_is_not_armed():
    cycle, monitor = np.arange(1000, 1010), SchemeState.MONITOR
    host = HostCycles(cycle, cycle * MS, np.full(10, monitor, np.uint8), np.full((10, 2), 0.1))
    onsets = (900, 1000, 1001)
    contacts = [TrueContact(1, 1, cycle=np.arange(onset, 1005), tau_ext=np.ones((1005 - onset, 2))) for onset in onsets]
    placed = placed_contacts(contacts, host, load_settings("paper"))
    assert [contact.is_armed for contact in placed] == [False, False, True]
