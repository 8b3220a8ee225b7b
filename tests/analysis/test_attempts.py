"""What belongs together in a log: attempts, gaps, skipped periods."""

import numpy as np

from adacd_hil.log.mcap.record_layout import record_dtype
from adacd_hil.log.reader import FRAME_DTYPE, LONG_FRAME_DTYPE, Piece, Series
from adacd_hil.log.types.topics import run_channels
from adacd_hil.records import SchemeState
from adacd_hil.replay.log_source import AttemptSplitter

DTYPES = {channel.topic: record_dtype(channel.type.dtype) for channel in run_channels(7) if channel.type.fields}
M, F, N = SchemeState.MONITOR, SchemeState.FAULT, SchemeState.INIT
SYNC, NMT, RESET = 0x080, 0x000, 0x82


def piece(rows, frames=(), dtype=FRAME_DTYPE) -> Piece:
    """Rows: cycle, overruns, state before, state. Frames: time in ms, identifier, first byte."""
    scheme, cycle = (np.zeros(len(rows), DTYPES[topic]) for topic in ("/scheme", "/cycle"))
    for k, (number, overruns, previous, state) in enumerate(rows):
        for records in (scheme, cycle):
            records["publish_time"][k] = number * 1_000_000
            records["cycle"][k] = number
        cycle["overruns"][k] = overruns
        scheme["previous_state"][k], scheme["state"][k] = previous, state
    passed = np.zeros(len(frames), dtype)
    for k, (t_ms, can_id, byte) in enumerate(frames):
        passed["cycle_t_ns"][k] = round(t_ms * 1_000_000)
        passed["can_id"][k], passed["length"][k], passed["is_tx"][k] = can_id, 2, True
        passed["data"][k, 0] = byte
    return Piece({"/scheme": Series(scheme, 0), "/cycle": Series(cycle, 0)}, passed, {})


def piece_of_arms(rows, frames=()) -> Piece:
    """Rows: cycle, the attempt's first cycle, periods."""
    whole = piece([(number, 0, N, N) for number, _, _ in rows], frames)
    arm = np.zeros(len(rows), DTYPES["/arm"])
    arm["publish_time"] = whole.series["/cycle"].records["publish_time"]
    for name, values in zip(("cycle", "first_cycle", "periods"), zip(*rows, strict=True), strict=True):
        arm[name] = values
    return whole._replace(series={"/scheme": whole.series["/scheme"], "/arm": Series(arm, 0)})


def test_of_states_of_the_arm_attempts_gaps_and_periods_are_as_they_say():
    splitter = AttemptSplitter(0)
    rows = [(0, 0, 1), (1, 0, 1), (4, 0, 3), (9, 0, 2), (20, 18, 1), (21, 18, 1), (30, 30, 2)]
    pieces = [piece_of_arms(rows[:3]), piece_of_arms(rows[3:5]), piece_of_arms(rows[5:])]
    found = [stretch for each in pieces for stretch in splitter.split(each)]
    assert [stretch.ticks.cycle.tolist() for stretch in found] == [[0, 1, 4], [9], [20], [21], [30]]
    assert [stretch.ticks.periods.tolist() for stretch in found] == [[1, 1, 3], [5], [1], [1], [2]]
    assert [stretch.attempt for stretch in found] == [0, 0, 1, 1, 2]
    assert [stretch.is_begin for stretch in found] == [True, False, True, False, True]
    assert [stretch.is_exact for stretch in found] == [True, False, False, False, True]
    assert splitter.gaps == [(9, 3), (20, 2)]


def test_of_states_of_the_arm_what_begins_in_the_middle_is_left_out():
    splitter = AttemptSplitter(0)
    assert list(splitter.split(piece_of_arms([(700, 3, 1), (701, 3, 1)]))) == []
    (after,) = splitter.split(piece_of_arms([(702, 3, 1), (720, 720, 1)]))
    assert (splitter.headless_cycles, after.is_exact, after.attempt, splitter.gaps) == (3, True, 1, [])


def test_the_frames_of_an_attempt_begin_with_its_reset_where_the_log_names_its_first_cycle():
    frames = [(0, SYNC, 1), (1, SYNC, 2), (5, NMT, RESET), (9, NMT, RESET), (20, SYNC, 21)]
    before, after = AttemptSplitter(0).split(piece_of_arms([(0, 0, 1), (1, 0, 1), (20, 20, 1)], frames))
    assert before.frames["can_id"].tolist() == [SYNC, SYNC, NMT]
    assert after.frames["can_id"].tolist() == [NMT, SYNC]


def test_skipped_periods_are_no_gap():
    splitter = AttemptSplitter(0)
    (stretch,) = splitter.split(piece([(0, 0, N, N), (1, 0, N, M), (4, 2, M, M), (5, 2, M, M)]))
    assert stretch.ticks.periods.tolist() == [1, 1, 3, 1]
    assert stretch.is_begin
    assert stretch.is_exact
    assert splitter.gaps == []


def test_cycles_that_are_missing_are_a_gap_and_the_time_goes_on():
    splitter = AttemptSplitter(0)
    before, after = splitter.split(piece([(0, 0, N, N), (1, 0, N, M), (9, 2, M, M), (10, 2, M, M)]))
    assert (before.is_exact, after.is_exact, after.is_begin) == (True, False, False)
    assert after.ticks.periods.tolist() == [8, 1]
    assert splitter.gaps == [(9, 5)]


def test_a_reset_begins_an_attempt_also_at_the_border_of_pieces_and_before_longer_frames():
    splitter = AttemptSplitter(0)
    first = piece([(0, 0, N, N), (1, 0, M, F)], [(0, SYNC, 1), (1, SYNC, 2), (2, SYNC, 3), (9, NMT, RESET)])
    second = piece([(20, 0, N, N)], [(20, SYNC, 21)], LONG_FRAME_DTYPE)
    (before,) = splitter.split(first)
    (after,) = splitter.split(second)
    assert (before.attempt, after.attempt) == (0, 1)
    assert after.is_begin
    assert after.is_exact
    assert before.frames["can_id"].tolist() == [SYNC] * 3
    assert after.frames["can_id"].tolist() == [NMT, SYNC]
    assert after.frames["data"][:, 0].tolist() == [RESET, 21]


def test_periods_skipped_while_the_drives_were_disabled_dont_count_for_the_next_attempt():
    frames = [(0, SYNC, 1), (1, SYNC, 2), (2, SYNC, 3), (5, SYNC, 6), (9, NMT, RESET), (21, SYNC, 22)]
    rows = [(0, 0, N, N), (1, 0, M, F), (21, 3, N, N)]
    _, after = AttemptSplitter(0).split(piece(rows, frames))
    assert after.ticks.periods.tolist() == [2]  # of the three, two were skipped before the SYNC with counter 6


def test_a_begin_whose_first_cycles_are_missing_is_not_compared():
    splitter = AttemptSplitter(0)
    (stretch,) = splitter.split(piece([(700, 0, M, M)], [(0, NMT, RESET)]))
    assert stretch.is_begin
    assert not stretch.is_exact
    assert splitter.gaps == [(700, 700)]


def test_what_begins_in_the_middle_is_left_out():
    splitter = AttemptSplitter(0)
    assert list(splitter.split(piece([(700, 0, M, M), (701, 0, M, M)]))) == []
    assert splitter.headless_cycles == 2


def test_after_a_fault_a_scheme_that_begins_anew_is_an_attempt_even_if_the_frames_are_lost():
    before, after = AttemptSplitter(0).split(piece([(0, 0, N, N), (1, 0, M, F), (2, 0, N, N)]))
    assert (before.attempt, after.attempt, after.is_begin) == (0, 1, True)


def test_records_without_their_counterpart_are_counted():
    whole = piece([(0, 0, N, N), (1, 0, N, M)])
    series = {**whole.series, "/cycle": Series(whole.series["/cycle"].records[:1], 0)}
    splitter = AttemptSplitter(0)
    (stretch,) = splitter.split(whole._replace(series=series))
    assert stretch.ticks.cycle.tolist() == [0]
    assert splitter.unpaired == 1
