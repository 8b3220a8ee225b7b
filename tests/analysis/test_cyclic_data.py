"""How much of the cyclic data came, by the log; what a run's verdict says of it, of faults and of what broke it off."""

from dataclasses import replace

import numpy as np
import pytest
from hand_made_run import EPOCH_NS, A, M, evaluated, make_certified_run, make_run, with_columns, without_cycles

from adacd_hil.lab.report.next_steps import next_steps
from adacd_hil.lab.score.metrics import ReportSource
from adacd_hil.lab.score.report_wording import percent_text
from adacd_hil.lab.score.run_arrays import CheckCounts, columns_of_records
from adacd_hil.lab.score.run_faults import find_breaks, find_faults
from adacd_hil.lab.score.verdict import data_text
from adacd_hil.log.reader import LoggedEvent
from adacd_hil.records import Event, SchemeState

ZERO = EPOCH_NS + 100_000_000
"""When the first cycle of a hand-made run is, ns."""


def missing_frames(run, rows, age=0):
    """Let a frame be missing in some rows, and the values used be so old."""
    missing = np.zeros(len(run.cycle), np.int64)
    missing[rows] = 1
    return with_columns(run, frames_missing=missing, data_age=missing * age)


def gather_data(run):
    return evaluated(run).data


def said(t_ms, name, message, level="error"):
    return LoggedEvent(ZERO + t_ms * 1_000_000, Event(level, name, message))


def test_shares_are_those_of_cycles_with_powered_drives():
    run = make_run((SchemeState.COMMISSION, 1000), (A, 1000), (M, 3000), (SchemeState.FAULT, 500))
    rows = np.r_[0:900, 1000:1040, 5100:5400]
    data = gather_data(missing_frames(run, rows, age=2))
    assert (data.cycles, data.incomplete, data.aged) == (4000, 0.01, 0.01)


@pytest.mark.parametrize(
    ("stays", "rows", "worst"),
    [
        (((A, 1000), (M, 59_000)), slice(30_000, 30_120), 0.12),
        (((A, 1000), (M, 1000)), slice(0, 100), 0.1),
        (((A, 700), (SchemeState.FAULT, 500), (A, 700)), slice(600, 700), 100 / 700),
        (((A, 1000), (M, 100)), slice(1050, 1100), 0.0),
    ],
    ids=["a share of the run hides it", "at its limit", "not over a stay without power", "a few last cycles are none"],
)
def test_the_worst_second_tells_whether_too_much_was_missing(stays, rows, worst):
    data = gather_data(missing_frames(make_run(*stays), rows))
    assert data.worst_incomplete == pytest.approx(worst)
    text = f"incomplete cycles: {100 * worst:.2g} % of the cycles of a second, 10 % allowed"
    assert data.excesses == ((text,) if worst > 0.1 else ())


def test_a_log_that_lacks_the_counts_is_not_called_free_of_losses():
    nothing = replace(make_run((A, 100)), timing=columns_of_records([], []))
    assert data_text(gather_data(nothing)) == "whether cyclic data was late or lost is not in the log"


def checks(run, *logged):
    """Let counts be logged: row, and of the two devices the cycles without new data and those repeated."""
    counts = np.zeros((len(logged), 2, 7), np.int64)
    for place, (_, *found) in enumerate(logged):
        counts[place, :, 5], counts[place, :, 2] = found
    cycle = run.cycle[[row for row, *_ in logged]]
    return replace(run, checks=CheckCounts(("drive1", "sensor1"), cycle, counts))


def test_shares_of_a_device_are_what_the_counts_grew_by_while_the_drives_were_powered():
    run = make_run((SchemeState.COMMISSION, 1500), (A, 2500), (SchemeState.FAULT, 1000))
    run = checks(
        run, (0, (0, 0), (0, 0)), (1000, (900, 0), (0, 0)), (2000, (900, 20), (0, 0)), (3000, (900, 100), (5, 0)),
        (4500, (900, 900), (5, 0)),
    )  # fmt: skip
    found = gather_data(run).devices
    sensor = found["sensor1"]
    assert (sensor.cycles, sensor.no_new_data, sensor.worst_no_new_data) == (2000, 0.05, 0.08)
    assert (found["drive1"].no_new_data, found["drive1"].repeated, found["drive1"].worst_repeated) == (0, 0.0025, 0.005)


def test_counts_that_begin_anew_are_of_another_attempt():
    run = make_run((A, 5000))
    run = checks(run, (1000, (0, 500), (0, 0)), (2000, (0, 3), (0, 0)), (3000, (0, 13), (0, 0)))
    assert gather_data(run).devices["sensor1"].no_new_data == 0.01


def test_a_device_over_its_limit_makes_a_run_unclean():
    run = make_run()
    assert evaluated(run).is_clean is True
    run = checks(run, (1000, (0, 0), (0, 0)), (2000, (0, 0), (0, 51)))
    metrics = evaluated(run)
    assert metrics.is_clean is False
    assert metrics.data.excesses == ("repeated frames of sensor1: 5.1 % of the cycles of a second, 1 % allowed",)
    assert metrics.verdict.endswith("; repeated frames of sensor1 in 5.1 %, more than allowed.")


@pytest.mark.parametrize(
    ("share", "text"),
    [(0.0, "0 %"), (1e-7, "less than 0.01 %"), (0.00123, "0.12 %"), (0.996, "100 %"), (1.5, "150 %")],
)
def test_a_share_is_never_rounded_to_nothing(share, text):
    assert percent_text(share) == text


def test_a_margin_below_1_makes_a_run_unclean_and_stands_in_front():
    run = make_certified_run()
    run.certified.tau_ext[2000, 0, 0] = 0.244
    metrics = evaluated(run)
    assert metrics.verdict.partition("; ")[0].endswith("smallest margin 0.41")
    assert metrics.is_clean is False


CAUSE = "ADAPT -> FAULT: DRIVE; Drive2: over-current"


def test_a_fault_has_the_cause_that_was_logged():
    run = make_run(
        (A, 500), (SchemeState.FAULT, 10), events=(said(400, "supervisor", "no"), said(500, "supervisor", CAUSE))
    )
    assert evaluated(run).verdict.startswith("The run ended in FAULT (DRIVE) at 0.50 s: Drive2: over-current;")


def test_a_run_that_went_on_after_a_fault_did_not_end_in_it():
    run = make_run((A, 500), (SchemeState.FAULT, 10), (SchemeState.INIT, 10), (A, 500), (M, 100))
    verdict = evaluated(run).verdict
    assert verdict.startswith("FAULT (DRIVE) at 0.50 s, after which it began anew; no contact")
    assert "the model was not identified at first, then in 0.50 s" in verdict
    assert evaluated(run).is_clean is False


def test_of_many_faults_the_first_and_the_last_are_said():
    run = make_run((A, 500), *[(SchemeState.FAULT, 10), (A, 90)] * 3, (SchemeState.FAULT, 10))
    assert [fault.is_last for fault in find_faults(run)] == [False, False, False, True]
    many, last, *_ = evaluated(run).verdict.split("; ")
    assert many.startswith("4 faults, the first and the last: FAULT (DRIVE) at 0.50 s")
    assert last == "the run ended in FAULT (DRIVE) at 0.80 s"


def test_a_run_that_never_booted_has_its_cause_as_verdict():
    events = (said(0, "run", "no boot-up from Drive1\x1b[2J within 2 s"),) * 2
    run = without_cycles(make_run((A, 1), has_truth=False, events=events))
    metrics = evaluated(run)
    assert metrics.verdict == "No cycle was run: no boot-up from Drive1\\u001b[2J within 2 s."
    assert metrics.is_clean is False
    assert evaluated(replace(run, events=())).verdict == "No cycle was run: the log does not say why."


@pytest.mark.parametrize(
    ("changes", "is_last"),
    [
        ({"events": (said(20_000, "run", "can0 went away"), said(0, "run", "hello", "info"))}, True),
        ({"events": (said(100, "run", "can0 went away"),)}, False),
        ({"broken_off": "can0 went away"}, True),
    ],
)
def test_what_broke_a_run_off_makes_it_unclean_and_did_not_end_it_if_cycles_follow(changes, is_last):
    run = make_run(**changes)
    metrics = evaluated(run)
    assert find_breaks(run) == (("can0 went away", is_last),)
    assert ("began anew: can0 went away; no contact" in metrics.verdict, metrics.is_clean) == (not is_last, False)
    assert next_steps(metrics, run, ReportSource("run.mcap"))[0][0].command.startswith("adacd-hil demo ")


@pytest.mark.parametrize(("metadata", "is_clean"), [({}, True), ({"scenario": "paper"}, False)])
def test_an_interruption_breaks_off_what_has_a_script(metadata, is_clean):
    events = (said(9000, "interrupted", "the run was interrupted", "warning"),)
    assert evaluated(make_run(events=events, metadata=metadata)).is_clean is is_clean
