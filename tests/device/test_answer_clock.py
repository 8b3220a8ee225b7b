"""Which SYNC a cyclic frame answers."""

import pytest

from adacd_hil.device.answer_clock import USUAL_ANSWERS, AnswerClock

USUAL_NS = 300_000


def settled(is_counted: bool = False) -> AnswerClock:
    """A device that has answered every SYNC in time so far, the last of them with the ordinal USUAL_ANSWERS."""
    clock = AnswerClock()
    for ordinal in range(USUAL_ANSWERS + 1):
        assert clock.find(ordinal, USUAL_NS, 1 if is_counted and ordinal else None) == ordinal
        clock.set_answered(ordinal, ordinal, USUAL_NS, is_counted)
    return clock


LAST = USUAL_ANSWERS


def test_a_frame_in_time_and_the_first_of_all_answer_the_last_sync() -> None:
    assert settled().find(LAST + 1, USUAL_NS, None) == LAST + 1
    assert AnswerClock().find(17, USUAL_NS, None) == 17


def test_a_counter_tells_a_late_frame_from_one_behind_a_lost_one() -> None:
    clock = settled(is_counted=True)
    assert clock.find(LAST + 2, USUAL_NS, 1) == LAST + 1
    assert clock.find(LAST + 2, USUAL_NS, 2) == LAST + 2


def test_frames_that_are_late_all_the_time_stay_late_until_two_come_on_one_sync() -> None:
    clock = settled(is_counted=True)
    for newest in range(LAST + 2, LAST + 30):
        assert clock.find(newest, 50_000, 1) == newest - 1
        clock.set_answered(newest - 1, newest, 50_000, True)
    assert clock.find(LAST + 29, USUAL_NS, 1) == LAST + 29


@pytest.mark.parametrize(("off_ns", "answers"), [(-200_000, 1), (-51_000, 1), (0, 2), (51_000, 1)])
def test_without_a_counter_a_frame_off_the_usual_time_is_late_and_one_at_it_follows_a_lost_one(
    off_ns: int, answers: int
) -> None:
    assert settled().find(LAST + 2, USUAL_NS + off_ns, None) == LAST + answers


@pytest.mark.parametrize(("periods", "answers"), [(1, LAST + 1), (2, LAST + 2)])
def test_a_moving_arm_tells_by_its_position_how_much_time_has_passed(periods: int, answers: int) -> None:
    travel_rad = 1e-3

    def error(assumed: int) -> float:
        return abs(periods - assumed) * travel_rad

    for offset_ns in (USUAL_NS, USUAL_NS + 200_000):
        assert settled().find(LAST + 2, offset_ns, None, error) == answers


def test_a_position_that_fits_does_not_make_an_answer_come_before_it_can() -> None:
    assert settled().find(LAST + 2, USUAL_NS - 200_000, None, lambda assumed: abs(2 - assumed) * 1e-3) == LAST + 1


@pytest.mark.parametrize(("sooner_ns", "answers"), [(49_000, LAST + 2), (51_000, LAST + 1)])
def test_where_the_frame_before_it_is_lost_an_answer_comes_as_soon_as_that_one_would_have(
    sooner_ns: int, answers: int
) -> None:
    before_ns = USUAL_NS - 120_000
    assert settled().find(LAST + 2, before_ns - sooner_ns, None, soonest_ns=before_ns) == answers


def test_a_second_frame_on_a_sync_answers_nothing() -> None:
    clock = settled(is_counted=True)
    assert clock.find(LAST, 2 * USUAL_NS, 1) is None
    assert not clock.take_straggler(0)


def test_a_second_frame_shows_that_the_first_was_a_late_one_and_not_behind_a_lost_one() -> None:
    clock = settled()
    assert clock.find(LAST + 2, USUAL_NS, None) == LAST + 2  # a guess: a period late, as it turns out
    clock.set_answered(LAST + 2, LAST + 2, USUAL_NS, False)
    assert clock.find(LAST + 2, USUAL_NS + 20_000, None) == LAST + 2
    clock.set_answered(LAST + 2, LAST + 2, USUAL_NS + 20_000, False)
    assert clock.find(LAST + 2, USUAL_NS + 40_000, None) is None  # nobody guesses twice


def test_an_overtaken_frame_without_counter_is_no_stranger_s() -> None:
    clock = settled()
    clock.set_answered(LAST + 2, LAST + 2, USUAL_NS, False)
    assert clock.find(LAST + 2, USUAL_NS + 200_000, None) is None
    assert clock.take_straggler(0)
    assert not clock.take_straggler(0)


def test_an_overtaken_frame_is_known_by_its_counter_once() -> None:
    clock = settled(is_counted=True)
    clock.set_answered(LAST + 3, LAST + 3, USUAL_NS, True)
    assert not clock.take_straggler(3)  # that one was answered
    assert [clock.take_straggler(behind) for behind in (2, 1, 2, 1)] == [True, True, False, False]


def test_a_device_that_begins_anew_owes_no_answer_from_before() -> None:
    clock = settled()
    clock.begin_anew(500)
    assert clock.find(501, USUAL_NS, None) == 501
