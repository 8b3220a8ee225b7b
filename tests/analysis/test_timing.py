"""The timing evidence: numbers from columns made by hand, and what the figures show of them."""

from dataclasses import replace

import numpy as np
import pytest
from hand_made_run import A, M, R, S, evaluated, make_run, with_columns

from adacd_hil.lab.report.traces import timing_track
from adacd_hil.lab.score.evaluation import OLDEST_CYCLES, collect_evidence, find_reactions
from adacd_hil.lab.score.run_arrays import COMPUTE, CycleColumns, columns_of_series
from adacd_hil.log.log_files import LogError
from adacd_hil.log.reader import Series
from adacd_hil.records import CycleRecord


def columns(**values: list[int]) -> CycleColumns:
    count = len(next(iter(values.values())))
    made = {name: np.array(column, dtype=np.int64) for name, column in values.items()}
    usual = dict.fromkeys(CycleRecord._fields, np.zeros(count, np.int64)) | {"cycle": np.arange(count)}
    return CycleColumns(np.arange(count) * 1_000_000, usual | made)


def evidence_of(**values: list[int]):
    return collect_evidence(columns(**values), 1000)


def test_a_cycle_without_complete_feedback_has_no_time_of_it():
    found, name = evidence_of(feedback_ns=[5000, 700_000, 7000], frames_missing=[0, 1, 0]), "sync_to_feedback"
    histogram = found.histograms[name]
    assert (found.times[name]["max"], sum(histogram["counts"]), histogram["below"]) == (7.0, 2, 0)


def test_running_counts_end_with_their_last_value_and_others_are_summed():
    found = evidence_of(overruns=[1, 1, 4, 4], frames_lost=[0, 2, 2, 3], frames_missing=[1, 0, 2, 0]).counts
    assert [(found[name].total, found[name].per_100000) for name in ("overruns", "frames_lost", "frames_missing")] == [
        (4, 100_000.0),
        (3, 75_000.0),
        (3, 75_000.0),
    ]


def test_a_running_count_that_began_anew_goes_on():
    assert evidence_of(overruns=[0, 2, 2, 0, 1]).counts["overruns"].total == 3


def test_ages_are_counted_and_the_oldest_together():
    ages = evidence_of(data_age=[0, 0, 1, 3, OLDEST_CYCLES, 500]).data_age
    assert ages == (2, 1, 0, 1, *[0] * (OLDEST_CYCLES - 4), 2)


def test_lockstep_has_no_lateness_and_no_queues():
    found = evaluated(make_run(clock="lockstep")).timing
    assert (found.is_modelled, found.times["lateness"], set(found.queues_bytes.values())) == (True, None, {None})
    assert evaluated(make_run(clock="realtime")).timing.times["lateness"] is not None


def test_a_reaction_takes_the_compute_time_of_the_cycle_in_which_the_state_becomes_react():
    run = make_run((A, 10), (M, 10), (R, 5), (S, 5), (M, 10), (R, 5))
    run = with_columns(run, compute_ns=1000 * np.arange(45, dtype=np.int64))
    reaction = evaluated(run).timing.reaction
    assert (reaction["count"], reaction["p50"], reaction["max"]) == (2, 40.0, 40.0)
    assert run.timing.times_us(COMPUTE)[find_reactions(run.timing, run.cycle, run.state)].tolist() == [20.0, 40.0]


def test_a_reaction_is_found_by_the_number_of_its_cycle_where_cycles_are_lost():
    run = make_run((M, 10), (R, 5))
    cut = CycleColumns(run.timing.t_ns[4:], {name: column[4:] for name, column in run.timing.columns.items()})
    assert np.flatnonzero(find_reactions(cut, run.cycle, run.state)).tolist() == [6]
    begun = make_run((R, 3), (M, 3))
    assert np.flatnonzero(find_reactions(begun.timing, begun.cycle, begun.state)).tolist() == [0]


def test_cycles_without_all_of_their_times_and_counts_are_refused_in_one_line():
    fields = [("sec", "<u4"), ("nanosec", "<u4"), *((name, "<i8") for name in CycleRecord._fields)]
    records = np.zeros(3, fields)
    records["lateness_ns"] = (1, -2, 3)
    assert columns_of_series(Series(records, 0))["lateness_ns"].tolist() == [1, -2, 3]
    with pytest.raises(LogError, match=r"^/cycle has no transmit_queue_bytes, log_queue_bytes$"):
        columns_of_series(Series(records[[name for name, _ in fields[:-2]]], 0))


def panels_of(run):
    is_realtime = run.metadata["clock"] == "realtime"
    track = timing_track(run.timing, run.settings.bus.period_us, run.zero_ns, has_grid=is_realtime)
    return {panel.name: panel for panel in track.panels}


def short_run(**changes):
    run = make_run((M, 100), (R, 20), clock="realtime")
    return with_columns(run, lateness_ns=np.arange(120) * 1000, **changes)


def test_a_skipped_period_and_a_single_late_cycle_are_in_their_curves():
    overruns = np.zeros(120, dtype=np.int64)
    overruns[70:] = 2
    (trace,) = panels_of(short_run(overruns=overruns))["skipped"].traces
    assert (np.flatnonzero(trace.values).tolist(), trace.values[70]) == ([70], 2.0)
    run = make_run((M, 50_000), clock="realtime", has_truth=False)
    lateness_ns = np.full(50_000, 5000)
    lateness_ns[31_417] = 7_000_000
    (trace,) = panels_of(with_columns(run, lateness_ns=lateness_ns))["time-lateness"].traces
    assert (trace.values[31_417], trace.values.max()) == (7000.0, 7000.0)


def test_a_log_has_the_curves_that_it_can_have():
    run = short_run()
    whole = ["time-lateness", "time-compute", "time-sync_to_command", "time-slack", "queues"]
    assert list(panels_of(run)) == whole
    lockstep = replace(run, metadata={**run.metadata, "clock": "lockstep"})
    assert list(panels_of(lockstep)) == whole[1:4]
