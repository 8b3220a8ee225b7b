"""Runs that are too long to be kept: what a report says of them is what it would say of all of their cycles."""

import json
from dataclasses import replace
from functools import partialmethod

import numpy as np
import pytest
from called import called
from hand_made_run import evaluated, make_certified_run, make_run, react, record, record_truth, touch, with_columns

from adacd_hil.lab.logs.cut import cut
from adacd_hil.lab.report import run_reading
from adacd_hil.lab.report.page import CONTACTS, left_out_text, shown_contacts, stretch_text
from adacd_hil.lab.report.report_files import write_run_report
from adacd_hil.lab.report.report_json import report_json
from adacd_hil.lab.report.run_reading import TruthClock, read_run
from adacd_hil.lab.report.timeline import timeline_of
from adacd_hil.lab.score.evaluation import evaluate
from adacd_hil.lab.score.run_arrays import AttemptBegins, host_truth
from adacd_hil.lab.score.verdict import identified_text
from adacd_hil.log import reader
from adacd_hil.log.log_files import LogError
from adacd_hil.log.logged_run import Truth
from adacd_hil.log.reader import Series, start_of_log
from adacd_hil.log.time_window import TimeWindow
from adacd_hil.log.types.topics import CYCLE, SCHEME
from adacd_hil.records import CycleRecord, FaultReason, SchemeState
from adacd_hil.score import emulator_truth
from adacd_hil.score.emulator_truth import TruthTable, read_truth


def table_of(read):
    return report_json(evaluate(read.run, read.gathered), read.run.metadata, read.source)


@pytest.fixture
def few_kept(monkeypatch):
    """Read in short pieces, and keep next to nothing."""
    few = {"BUCKETS": 4, "TIME_BUCKETS": 4, "TRACED_CONTACTS": 0, "ADAPTATIONS": 0, "_NOISE_CYCLES": 4, "_WAITING": 700}
    for name, value in few.items():
        monkeypatch.setattr(run_reading, name, value)
    in_short_pieces = partialmethod(reader.LogStream.__init__, cycles_per_piece=333)
    monkeypatch.setattr(reader.LogStream, "__init__", in_short_pieces)


@pytest.fixture(scope="module")
def certified(tmp_path_factory):
    """Record a hand-made run in which everything happens that a report counts."""
    random = np.random.default_rng(5)
    run = make_certified_run()
    count = len(run.cycle)
    run.certified.tau_ext[:] = random.normal(0.0, 0.02, run.certified.tau_ext.shape)
    run.certified.threshold[:] = random.uniform(0.09, 0.11, run.certified.threshold.shape)
    run.certified.promotions[3000:] = 1.0
    run.certified.promotions[6500:] = 3.0
    run.tau_ext_hat[:] = run.certified.tau_ext[:, 0]
    run.tau_ext_hat_cad[:] = random.normal(0.0, 0.3, (count, 2))
    run.theta_hat[:] = np.linspace(0.0, 0.2, count)[:, None]
    run.beside.tau_ext_hat[:] = random.normal(0.0, 0.02, (count, 2))
    for row in (2600, 3100, 8200):  # alarms of the paper's scheme that nothing explains
        run.beside.tau_ext_hat[row : row + 40, 1] = 0.2
    run.truth.payload_kg[5300:] = 1.0
    touch(run, 1500, 250, (5.0, 0.0), index=0)
    touch(run, 4000, 250, (-6.0, -3.0), link=2, index=1)
    touch(run, 7000, 700, (0.05, 0.0), index=2)
    run.beside.tau_ext_hat[4005:4100, 0] = -3.0
    for row, link in ((1503, 1), (4002, 2), (8600, 1)):
        run = react(run, row, link=link, tau_ext_peak=(5.2, 0.0))
    rows = np.arange(count)
    times = {name: 1000 * (1 + rows * place % 977) for place, name in enumerate(CycleRecord._fields[1:6], start=1)}
    run = with_columns(run, **times, **dict.fromkeys(CycleRecord._fields[6:], rows // 4000))
    folder = tmp_path_factory.mktemp("certified")
    record(folder / "run.mcap", run, clock="realtime")
    record_truth(folder / "truth.mcap", run)
    return folder / "run.mcap"


@pytest.fixture(params=["paper", "certified"])
def path(request):
    """Give a log of the paper's scheme, with a fault and another attempt, and one of the certified scheme."""
    return request.getfixturevalue("log" if request.param == "paper" else "certified")


def truth_of(path):
    return path.with_name("truth.mcap")


@pytest.mark.parametrize("has_truth", [True, False])
def test_a_long_run_comes_to_the_same_as_one_that_is_kept_whole(few_kept, path, has_truth):
    truth = truth_of(path) if has_truth else None
    whole, thinned = read_run(path, truth), read_run(path, truth, full_cycles=1000)
    assert thinned.run.all_cycles == whole.run.all_cycles == len(whole.run.cycle)
    assert len(thinned.run.cycle) < len(whole.run.cycle) / 4
    assert table_of(thinned) == table_of(whole)


def test_the_kept_cycles_are_cycles_of_the_run_and_have_every_extreme_of_every_curve(few_kept, path):
    whole, thinned = (read_run(path, truth_of(path), full_cycles=cycles).run for cycles in (10**6, 1000))
    rows = np.searchsorted(whole.cycle, thinned.cycle)
    assert (np.diff(rows) > 0).all()
    assert (thinned.t_ns == whole.t_ns[rows]).all()
    assert (thinned.theta_hat == whole.theta_hat[rows]).all()
    for ours, theirs in ((thinned.tau_ext_hat, whole.tau_ext_hat), (thinned.motion.q, whole.motion.q)):
        assert (ours.min(axis=0) == theirs.min(axis=0)).all()
        assert (ours.max(axis=0) == theirs.max(axis=0)).all()


def test_around_the_first_contacts_every_cycle_is_kept(few_kept, monkeypatch, certified):
    monkeypatch.setattr(run_reading, "TRACED_CONTACTS", 1)
    run = read_run(certified, truth_of(certified), full_cycles=1000).run
    onset_s = 1.45
    around = run.cycle[(run.time_s() > onset_s - 0.14) & (run.time_s() < onset_s + 0.59)]
    assert (len(around), set(np.diff(around).tolist())) == (729, {1})


@pytest.mark.long
def test_the_page_of_a_long_run_says_that_cycles_are_left_out(few_kept, certified, tmp_path):
    read = read_run(certified, truth_of(certified), full_cycles=1000)
    report = write_run_report(read.run, tmp_path, read.source, read.gathered)
    assert f"Of 9050 cycles {len(read.run.cycle)} are here: of every 4096" in report.html_path.read_text()


def test_a_log_of_just_so_many_cycles_is_kept_whole(certified):
    whole, thinned = (read_run(certified, None, full_cycles=cycles).run for cycles in (9050, 9049))
    assert (len(whole.cycle), whole.bucket, thinned.bucket) == (9050, 1, 4)


def test_a_truth_keeps_of_long_contacts_the_ends_and_the_peaks(monkeypatch, certified):
    whole = read_truth(truth_of(certified)).rows
    for name, value in (("_BEGINNING", (50, 20)), ("_ENDING", 60), ("_HELD", 150), ("_BUCKET", 10)):
        monkeypatch.setattr(emulator_truth, name, value)
    thinned = read_truth(truth_of(certified)).rows
    assert (len(whole.cycle), len(thinned.cycle) < 450) == (250 + 250 + 700 + 3, True)
    for index in (0, 1, 2):
        ours, theirs = (rows.tau_ext[rows.contact_index == index] for rows in (thinned, whole))
        cycles = [rows.cycle[rows.contact_index == index] for rows in (thinned, whole)]
        assert (np.abs(ours).max(axis=0) == np.abs(theirs).max(axis=0)).all()
        assert (cycles[0][:50] == cycles[1][:50]).all()
        assert (cycles[0][-60:] == cycles[1][-60:]).all()
    after = thinned.cycle[thinned.contact_index < 0].tolist()
    assert after == [350 + 1500, 350 + 4000, 800 + 7000]


def test_a_truth_says_from_when_on_the_payload_is_another(certified):
    truth = read_truth(truth_of(certified)).rows
    assert list(zip(truth.model_cycle.tolist(), truth.payload_kg.tolist(), strict=True)) == [(100, 0.0), (5400, 1.0)]


def test_what_happens_to_the_arm_after_its_host_has_died_is_none_of_the_host_s():
    rows = Truth(
        attempt=np.zeros(5, np.int64),
        cycle=np.arange(98, 103),
        tau_ext=np.arange(10.0).reshape(5, 2),
        contact_link=np.array([0.0, 0.0, 0.0, 2.0, 2.0]),
        contact_index=np.array([-1.0, -1.0, -1.0, 0.0, 0.0]),
        force_N=np.arange(5.0),
        time_s=np.zeros(5),
        model_attempt=np.zeros(1, np.int64),
        model_cycle=np.array([98]),
        payload_kg=np.zeros(1),
        theta=np.zeros((1, 7)),
    )
    truth = host_truth(
        TruthTable(rows, {}, "", ((0, 98), (0, 102))), np.zeros(1, np.int64), 100, np.linspace(0.0, 0.4, 5)
    )
    assert truth.cycle.tolist() == [98, 99, 100]
    columns = (truth.tau_ext, truth.contact_link, truth.contact_index, truth.force_N, truth.time_s)
    assert [len(column) for column in columns] == [3] * 5
    assert not truth.contact_link.any()


def stretched(path, start_s, end_s, **options):
    return read_run(path, truth_of(path), TimeWindow(start_s, end_s), **options)


def test_a_stretch_has_the_cycles_between_its_times_which_count_from_motion_start(certified):
    start_ns = start_of_log(certified)
    run = stretched(certified, 2.8, 3.5).run
    assert ((run.t_ns[[0, -1]] - start_ns) * 1e-9).tolist() == pytest.approx([2.8, 3.499])
    assert run.time_s()[0] == pytest.approx(2.75)
    metrics = evaluated(run)
    assert metrics.adaptation_s == {}  # which is no fault of a stretch
    assert not any("adapt" in finding.text for finding in metrics.findings)


@pytest.mark.parametrize(
    ("asked", "found"),
    [
        ((4.1, 4.8), (3.8, 5.25 + 0.05 + 1.0)),  # in contact 2, which the adaptation follows before it is forgotten
        ((2.8, 4.01), (2.8, 5.25)),
        ((0.5, 2.8), (-0.15, 2.8)),
    ],
)
def test_a_stretch_that_would_cut_something_is_widened(certified, asked, found):
    run = stretched(certified, *asked).run
    assert run.stretch.found[0] == pytest.approx(found[0])
    assert run.stretch.found[1] <= found[1] + 1e-9


@pytest.mark.parametrize(
    ("bounds", "text"),
    [
        ({"start_s": 2.8, "end_s": 3.5}, "from 2.8 s until 3.5 s"),
        ({"start_s": 2.8}, "from 2.8 s"),
        ({"end_s": 3.5}, "until 3.5 s"),
        ({"end_s": 4.01}, "until 5.25 s, widened so that no contact and no adaptation is cut"),
    ],
)
def test_the_words_for_a_stretch_name_the_bounds_that_it_has_and_say_whether_it_was_widened(certified, bounds, text):
    run = read_run(certified, truth_of(certified), TimeWindow(**bounds)).run
    assert stretch_text(run.stretch) == f"the log {text}"


def test_a_contact_of_a_stretch_is_what_it_is_in_the_whole_log(certified):
    whole = evaluated(read_run(certified, truth_of(certified)).run).contacts[1]
    (part,) = evaluated(stretched(certified, 2.9, 4.9).run).contacts
    assert (part.number, replace(part, section=whole.section)) == (2, whole)
    untold = read_run(certified, None, TimeWindow(2.9, 4.9))
    assert [contact.number for contact in evaluated(untold.run).contacts] == [2]


def test_a_cut_says_so_and_names_the_topics_that_it_lacks(certified, tmp_path):
    sources = []
    for name, topics in (("whole", ()), ("part", (SCHEME.name, CYCLE.name)), ("times", (CYCLE.name,))):
        cut(certified, tmp_path / f"{name}.mcap", TimeWindow(end_s=2.0), topics)
        sources.append(read_run(tmp_path / f"{name}.mcap", None).source)
    assert {source.truth_problem for source in sources} == {"the log is a cut of its run until 2 s"}
    assert [source.is_complete for source in sources] == [True, False, False]
    lacking = ["", "it has no /contact and no /events", "it has no /scheme"]
    assert [source.log_problem.partition(",")[0] for source in sources] == lacking


def test_a_long_stretch_comes_to_the_same_as_one_that_is_kept_whole(few_kept, path):
    whole = stretched(path, 1.0, 2.5)
    thinned = stretched(path, 1.0, 2.5, full_cycles=700)
    assert len(thinned.run.cycle) < len(whole.run.cycle)
    assert table_of(thinned) == table_of(whole)


def test_a_stretch_beside_the_log_is_a_log_error(certified):
    with pytest.raises(LogError, match=r"run\.mcap has no cycle from 100 s until 200 s"):
        stretched(certified, 100.0, 200.0)


def test_a_stretch_that_begins_in_the_second_attempt_knows_the_emulators_cycles(log):
    whole = evaluated(read_run(log, truth_of(log)).run)
    assert whole.fault == FaultReason.DRIVE.name
    (expected,), (found,) = whole.contacts, evaluated(stretched(log, 4.0, 9.0).run).contacts
    assert (found.onset_s, found.delay_ms) == (expected.onset_s, expected.delay_ms)


def scheme_of(cycles, state=SchemeState.MONITOR):
    """Give records of /scheme in some cycles of 1 ms."""
    fields = [("sec", "<u4"), ("nanosec", "<u4"), ("cycle", "<u8"), ("state", "u1"), ("request", "u1")]
    records = np.zeros(len(cycles), np.dtype(fields))
    records["cycle"] = cycles
    records["nanosec"] = np.array(cycles) * 1_000_000
    records["state"] = state
    return Series(records, 0)


def truth_at(cycles, attempt=0):
    nothing = np.zeros(len(cycles))
    cycle, attempts = np.array(cycles), np.full(len(cycles), attempt)
    torque = np.zeros((len(cycles), 2))
    truth = Truth(cycle, torque, *[nothing] * 4, attempts, cycle, attempts, nothing, nothing)
    return TruthTable(truth, {}, "")


def test_the_truth_of_a_cycle_that_was_skipped_between_two_pieces_lies_between_them():
    clock = TruthClock(truth_at([11, 12, 13, 20]))
    begins = np.array([0])
    told = [clock.place_rows(scheme_of(cycles), begins)[0].tolist() for cycles in ([10, 11], [13, 14])]
    assert (told, clock.t_ns.tolist()) == ([[0], [1, 2]], [11_000_000, 12_000_000, 13_000_000, 0])


def test_the_truth_of_an_attempt_waits_for_its_first_cycle():
    clock = TruthClock(truth_at([3, 4], attempt=1))
    assert clock.place_rows(scheme_of([480, 481, 482, 483, 484]), np.array([0]))[0].size == 0
    assert clock.place_rows(scheme_of([485, 486]), np.array([0, 482]))[1].tolist() == [483, 484]


def test_an_attempt_that_begins_in_two_pieces_begins_once():
    attempts = AttemptBegins()
    for cycles, state in (([0, 1], SchemeState.INIT), ([2, 3], SchemeState.COMMISSION), ([4], SchemeState.ENABLE)):
        attempts.add_cycles(np.array(cycles), np.full(len(cycles), state, np.uint8))
    assert attempts.begins.tolist() == [0]


@pytest.mark.long
def test_the_report_of_a_stretch_says_which_it_is(certified, tmp_path):
    ran = called("report", certified, "--from", "2.9", "--until", "3.93", "--out", tmp_path, "--json")
    (table,) = json.loads(ran.stdout)
    assert table["stretch"] == {
        "from_s": pytest.approx(2.9),
        "until_s": pytest.approx(5.25),
        "asked_from_s": 2.9,
        "asked_until_s": 3.93,
        "motion_start_s": pytest.approx(0.05),
    }
    page = (tmp_path / "report.html").read_text()
    assert "the log from 2.9 s until 5.25 s, widened so that no contact and no adaptation is cut" in page


def test_of_many_contacts_the_first_are_listed_and_those_that_went_wrong(certified):
    metrics = evaluated(read_run(certified, truth_of(certified)).run)
    right = next(contact for contact in metrics.contacts if contact.direction_ok)
    many = tuple(replace(right, number=number) for number in range(1, CONTACTS + 2))
    wrong = replace(right, number=CONTACTS + 2, link=2, link_detected=1, link_ok=False)
    metrics = replace(metrics, contacts=(*many, wrong), evidence=None)
    assert [contact.number for contact in shown_contacts(metrics)] == [*range(1, CONTACTS + 1), CONTACTS + 2]
    assert left_out_text(metrics) == (
        "The first 200 and 1 more that went wrong of 202 contacts; all are in contacts.csv."
    )
    assert left_out_text(replace(metrics, contacts=many[:CONTACTS])) == ""


def test_many_adaptations_are_summed_up():
    adaptation_s = dict(zip("ABCDEF", (2.0, 1.0, None, 1.5, 3.0, 1.0), strict=True))
    text = identified_text(adaptation_s, dict.fromkeys(adaptation_s, None), frozenset(), "certified")
    assert "in 1.00 to 3.00 s, 5 times, and not certified 1 times" in text


def test_of_many_stays_those_that_are_narrower_than_a_mark_are_drawn_together():
    stays = [(SchemeState.MONITOR, 3), (SchemeState.REACT, 1)] * 800 + [(SchemeState.MONITOR, 4000)]
    timeline = timeline_of(run := make_run(*stays), evaluated(run))
    marks = [mark.title for mark in timeline["states"]]
    assert 100 < len(marks) < 650  # 612 fit beside each other
    assert sum(int(mark.split()[0]) for mark in marks if "states" in mark) == 1600
    assert any(mark.startswith("watching, 3.20 to") for mark in marks)
