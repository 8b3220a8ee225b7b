"""A log is replayed: the same bits come out, and what isn't the same, or isn't there, is named."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from analysis.replay_rig import ChangedLog, flipping, record, settings_of_run, with_records, without_cycles, writable

from adacd_hil.control.operator import ScriptedOperator
from adacd_hil.device.device_files import load_profile, place_devices
from adacd_hil.device.profile import enable_timeout_s
from adacd_hil.log.log_files import LogError
from adacd_hil.log.reader import begin_of_log, read_log
from adacd_hil.log.time_window import TimeWindow
from adacd_hil.log.types.topics import run_channels
from adacd_hil.records import FaultReason, SchemeState
from adacd_hil.replay.log_source import LogSource
from adacd_hil.replay.replay import replay_many, replay_source
from adacd_hil.replay.replayed_outcome import Replay, side_by_side
from adacd_hil.score.emulator_truth import contacts_beside
from adacd_hil.score.judge import Score
from adacd_hil.settings.setting_keys import apply_settings
from adacd_hil.settings.toml_text import to_toml
from firmware_sim.bench.bench_time import TruthLog

pytestmark = pytest.mark.slow


def changed(log: Path, change, cycles_per_piece: int = 20_000, is_old: bool = False, by_frames: bool = False):
    source = ChangedLog(log, change, cycles_per_piece, is_old)
    return replay_source(source, [source.settings], script_of=ScriptedOperator, shown=80, by_frames=by_frames)[0]


def test_a_replay_comes_to_the_same_bits_through_contact_fault_and_recovery(log, whole):
    found = whole
    assert found.mismatches == ()
    assert found.is_identical
    assert found.is_whole
    assert found.attempts == 2
    assert found.compared == found.cycles == len(read_log(log, ("/scheme",)).scheme)
    assert [each.fault for each in found.states if each.state is SchemeState.FAULT] == [FaultReason.DRIVE]
    assert len(read_log(log, ("/contact",)).contacts) > 0


@pytest.mark.parametrize(("is_old", "by_frames"), [(False, False), (False, True), (True, False)])
def test_where_the_log_is_cut_into_pieces_doesnt_matter(log, whole, is_old, by_frames):
    found = changed(log, lambda piece: piece, 333, is_old, by_frames)
    assert (found.mismatches, found.attempts, found.notes) == ((), 2, ())
    assert found.states == whole.states
    assert found.arms_compared == (whole.cycles if by_frames else 0)


def said_of(source: LogSource, **changes: str) -> list[str]:
    """Replay with changed settings; return what the replay says meanwhile."""
    said: list[str] = []
    replay_source(source, [source.settings, apply_settings(source.settings, changes)], progress=said.append)
    return said


def test_a_replay_that_must_decode_the_frames_says_why(log):
    assert said_of(LogSource(log), **{"detector.threshold_Nm": "0.3"}) == []
    (why,) = said_of(LogSource(log), **{"safety.tolerated_emergencies": "[4096]"})
    assert why.startswith("a setting is another by which the arm takes its frames")
    (why,) = said_of(ChangedLog(log, lambda piece: piece, is_old=True), **{"detector.threshold_Nm": "0.3"})
    assert why.startswith("the log has no /arm")


def test_the_frames_are_read_by_the_devices_of_the_run_whatever_became_of_their_files(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text(to_toml(load_profile("stock-drive", "drive").settings))
    settings = settings_of_run("stock")
    path = record(tmp_path / "run", replace(settings, devices=replace(settings.devices, drive=(str(file),) * 2)))
    for text in (
        file.read_text().replace("increments_per_joint_rev = 1048576", "increments_per_joint_rev = 524288"),
        "",
    ):
        file.write_text(text)
        source = LogSource(path)
        (found,) = replay_source(source, [source.settings], script_of=ScriptedOperator, by_frames=True)
        assert (found.mismatch_count, found.arms_compared) == (0, found.cycles)
        assert found.cycles > 1000


def test_without_the_states_of_the_arm_a_proof_by_frames_is_not_whole(log, whole):
    found = changed(log, lambda piece: piece, is_old=True, by_frames=True)
    assert (found.is_identical, found.arms_compared, found.compared) == (True, 0, whole.compared)
    assert ["no /arm" in note for note in found.notes] == [True]


ARM_FIELDS = ["steps", "sample_age_ns", "age_q", "age_tau_J", "is_enabled", "is_complete", "fault", "is_late"]


def test_what_the_log_says_of_the_arm_otherwise_than_its_frames_is_named(log):
    change = flipping("/arm", *((300 + 7 * place, name) for place, name in enumerate(ARM_FIELDS)))
    found = changed(log, change, by_frames=True)
    named = {"sample_age_ns": "sampled_ns"}
    assert {(each.topic, each.field, each.cycle) for each in found.mismatches} == {
        ("/arm", named.get(name, name), 300 + 7 * place) for place, name in enumerate(ARM_FIELDS)
    }
    by_field = {each.field: each for each in found.mismatches}
    assert (by_field["age_q"].place, by_field["age_q"].logged, by_field["age_q"].replayed) == ("joint 1", "1", "0")
    assert changed(log, change).arms_compared == 0


def test_a_fault_of_the_arm_that_this_version_does_not_know_is_refused(log):
    def change(piece):
        records = writable(piece.series["/arm"])
        records["fault"][5] = 99
        return with_records(piece, "/arm", records)

    with pytest.raises(LogError, match=r"/arm has fault 99 in cycle 5,"):
        changed(log, change)


def test_every_flipped_bit_is_found_and_named(log):
    """A bit of every field of /scheme, of one value of each, each in a cycle of its own.

    q, dq and tau_J are what the scheme was given: that they are another is seen by the frames.
    """
    fields = read_log(log, ("/scheme",)).scheme.records.dtype
    names = [name for name in fields.names if name not in ("record_length", "log_time", "publish_time", "sec")]
    places = {name: (300 + 7 * k, max(int(np.prod(fields[name].shape)), 1) - 1) for k, name in enumerate(names)}
    change = flipping("/scheme", *((row, name, element) for name, (row, element) in places.items()))
    found = changed(log, change, by_frames=True)
    named = {"nanosec": "stamp_ns"}
    measured = ("q", "dq", "tau_J")
    assert {(each.topic, each.field, each.cycle) for each in found.mismatches} == {
        *(("/scheme", named.get(name, name), row) for name, (row, _) in places.items()),
        *(("/arm", name, places[name][0]) for name in measured),
    }
    assert found.mismatch_count == len(names) + len(measured)
    by_field = {each.field: each for each in found.mismatches}
    assert by_field["q"].place == "joint 2"
    assert by_field["theta_hat"].place == "F_c2"
    assert by_field["q"].logged != by_field["q"].replayed
    assert by_field["request"].logged == "1"
    assert "/scheme.state" in by_field["state"].line()


def test_an_nmt_frame_without_data_tells_nothing(log, whole):
    def change(piece):
        frames = piece.frames.copy()
        first = np.flatnonzero(frames["is_tx"] & (frames["can_id"] == 0))[0]
        frames["length"][first] = 0
        return piece._replace(frames=frames)

    assert changed(log, change, is_old=True).states == whole.states


def at_s(log: Path, t_ns: int) -> float:
    return (t_ns - begin_of_log(log)) * 1e-9


def stretched(log: Path, stretch: TimeWindow, change=lambda piece: piece, cycles_per_piece: int = 20_000) -> Replay:
    source = ChangedLog(log, change, cycles_per_piece)
    settings = [source.settings]
    return replay_source(source, settings, contacts_beside(log), script_of=ScriptedOperator, stretch=stretch)[0]


@pytest.mark.parametrize("cycles_per_piece", [20_000, 333])
def test_of_a_stretch_that_alone_is_compared_and_told(log, cycles_per_piece):
    whole = replay_source(LogSource(log), [LogSource(log).settings], contacts_beside(log))[0]
    contact = whole.score.contacts[0]
    stretch = TimeWindow(at_s(log, contact.onset_ns) - 0.2004, at_s(log, contact.onset_ns) + 0.3)
    found = stretched(log, stretch, cycles_per_piece=cycles_per_piece)
    bounds_ns = stretch.bounds_ns(begin_of_log(log))
    t_ns = read_log(log, ("/scheme",)).scheme.t_ns
    assert found.compared == found.cycles == ((t_ns >= bounds_ns[0]) & (t_ns < bounds_ns[1])).sum() == 500
    assert found.is_identical
    assert found.zero_ns == whole.zero_ns
    assert found.score.contacts == whole.score.contacts
    assert found.states == tuple(each for each in whole.states if bounds_ns[0] <= each.t_ns < bounds_ns[1])
    assert found.ending == found.states[-1]
    assert found.adaptation_s == ()
    assert 0.0 < found.monitored_s < 0.5
    after = stretched(log, TimeWindow(stretch.end_s), cycles_per_piece=cycles_per_piece)
    assert (after.score, after.detections_ns) == (Score((), ()), ())
    before = stretched(log, TimeWindow(end_s=stretch.start_s), cycles_per_piece=cycles_per_piece)
    assert before.cycles + found.cycles + after.cycles == whole.cycles
    assert (before.attempts, before.score.contacts) == (2, ())
    assert before.adaptation_s == whole.adaptation_s


@pytest.mark.parametrize(("row", "count"), [(899, 0), (900, 1), (1099, 1), (1100, 0)])
def test_only_what_differs_in_the_stretch_is_named(log, row, count):
    scheme = read_log(log, ("/scheme",)).scheme
    stretch = TimeWindow(at_s(log, scheme.t_ns[900] - 400_000), at_s(log, scheme.t_ns[1100] - 400_000))
    found = stretched(log, stretch, flipping("/scheme", (row, "tau_ext_hat")))
    assert (found.compared, found.mismatch_count) == (200, count)


def test_a_stretch_in_which_nothing_changes_says_what_state_it_is_in(log, whole):
    last = whole.states[-1]
    found = stretched(log, TimeWindow(at_s(log, last.t_ns) + 0.0014))
    assert found.states == ()
    assert found.ending == last
    assert ("ends in", f"{last.state.name} since {whole.time_s(last.t_ns):.2f} s") in side_by_side([found])


@pytest.mark.parametrize("script_of", [ScriptedOperator, None])
def test_a_request_that_nobody_can_make_is_named(log, script_of):
    source = ChangedLog(log, flipping("/scheme", (900, "request", 0, 6)))
    (found,) = replay_source(source, [source.settings], script_of=script_of)
    (mismatch,) = found.mismatches
    assert (mismatch.name, mismatch.logged, mismatch.replayed) == ("/scheme.request", "64", "0")


def test_a_flipped_bit_of_any_field_of_a_contact_report_is_found_and_named(log):
    (contact,) = (channel.type for channel in run_channels(7) if channel.topic == "/contact")
    names = [name for name in contact.dtype.names if name not in ("sec", "nanosec")]
    found = changed(log, flipping("/contact", *((0, name) for name in names)))
    assert {(each.topic, each.field) for each in found.mismatches} == {("/contact", name) for name in names}


def test_a_report_that_is_not_in_the_log_is_named(log):
    found = changed(log, lambda piece: with_records(piece, "/contact", piece.series["/contact"].records[1:]))
    (mismatch,) = found.mismatches
    assert (mismatch.name, mismatch.logged, mismatch.replayed) == ("/contact.report", "no report", "a report")


def test_a_report_that_the_replay_does_not_make_then_is_named_with_its_cycle(log):
    first, second = changed(log, flipping("/contact", (0, "nanosec"))).mismatches
    assert (first.replayed, second.replayed) == ("a report", "no report")
    assert (first.cycle, first.t_ns + 1) == (second.cycle, second.t_ns)


@pytest.mark.parametrize("is_old", [False, True])
def test_a_gap_is_said_and_what_follows_it_in_the_attempt_is_not_compared(log, whole, is_old):
    found = changed(log, without_cycles(700, 725), cycles_per_piece=1000, is_old=is_old)
    number = read_log(log, ("/cycle",)).cycle["cycle"].astype(int)
    assert found.mismatches == ()
    assert found.compared == 700 + (number > number[np.argmax(np.diff(number))]).sum()
    assert found.cycles == whole.cycles - 25
    assert any("25 cycles with their frames are missing before cycle 725" in note for note in found.notes)
    assert not found.is_whole


def test_a_log_that_goes_back_is_compared_up_to_there(log):
    def set_back(piece):
        arms = writable(piece.series["/arm"])
        arms["cycle"][700:] -= 25
        return with_records(piece, "/arm", arms)

    found = changed(log, set_back)
    assert not found.is_whole
    assert any("goes back to cycle 675" in note for note in found.notes)


@pytest.mark.parametrize("is_old", [False, True])
def test_of_a_log_that_begins_in_the_middle_the_next_attempt_is_compared(log, is_old):
    found = changed(log, without_cycles(0, 500), cycles_per_piece=1000, is_old=is_old)
    assert found.attempts == 1 or found.compared < found.cycles
    assert found.mismatches == ()
    assert found.compared > 1000
    assert not found.is_whole


def test_other_settings_decide_otherwise_about_the_same_motion(log):
    own = settings_of_run()
    resolved = {
        "realtime.sample_period": "nominal",
        "safety.enable_timeout_s": str(enable_timeout_s(own, place_devices(own))),
    }
    own = apply_settings(own, resolved)
    high, deaf, fast = (
        apply_settings(own, changes)
        for changes in (
            {"detector.threshold_Nm": "0.6"},
            {"detector.threshold_Nm": "50"},
            {"filter.a_rad_s": "50", "filter.b_rad_s": "50"},
        )
    )
    tared = replace(own, arm=replace(own.arm, torque_offset_Nm=(0.5, 0.0)))
    mine, later, never, sooner, other = replay_many(log, [own, high, deaf, fast, tared])
    assert mine.is_identical
    assert other.parameters != mine.parameters  # the frames were decoded once more for it
    assert later.compared == 0
    delays = [each.score.contacts[0].delay_ms for each in (sooner, mine, later)]
    assert delays == sorted(delays)
    assert len(set(delays)) == 3
    assert never.score.contacts[0].detected_ns is None
    (row,) = (row for row in side_by_side([mine, later]) if row[0] == "threshold, Nm")
    assert [float(value) for value in row[2].split(" / ")] == pytest.approx([0.6, 0.6], abs=0.01)
    assert row[1] != row[2]
    assert not any(row[0].startswith("smallest push") for row in side_by_side([mine, later]))  # of the certified scheme
    assert never.score.missed == 1
    assert contacts_beside(log) is not None


def test_what_comes_before_or_after_the_truth_is_not_judged(log, whole):
    """As in the report: a detection there is neither right nor a false alarm, and a replay says that there are some."""
    source, truth = LogSource(log), contacts_beside(log)
    attempt, onset = truth.contacts[0].attempt, truth.contacts[0].onset
    first, last = truth.span
    assert first < (attempt, onset) < last

    def judged(*known: tuple[int, int]) -> tuple[int, bool, tuple[str, ...]]:
        found = replay_source(LogSource(log), [source.settings], truth._replace(contacts=(), span=known))[0]
        return len(found.score.false_alarms), found.is_whole, found.notes

    said = "the truth doesn't cover 1 detection, not judged"
    assert judged(first, last) == (1, True, ())
    assert judged(first, (attempt, onset - 1)) == (0, False, (said,))
    assert judged(last, last) == (0, False, (said,))
    shorter = truth._replace(contacts=(), span=(first, (last[0], last[1] - 100)))
    found = replay_source(LogSource(log), [source.settings], shorter)[0]
    assert [note.partition(" s of MONITOR")[0] for note in found.notes] == ["the truth doesn't cover 0.08"]
    assert judged(first, (whole.attempts, 0)) == (1, True, ())  # it goes on with the next host
    assert replay_source(LogSource(log), [source.settings], truth)[0].notes == ()


def test_a_truth_of_another_run_is_noted_by_each_replay(log, tmp_path):
    shutil.copy(log, tmp_path / "run.mcap")
    TruthLog(tmp_path / "truth.mcap", blocking=True, metadata={"scenario": "another"}).close()
    settings = LogSource(log).settings
    others = [settings, apply_settings(settings, {"detector.threshold_Nm": "0.3"})]
    for found in replay_many(tmp_path / "run.mcap", others):
        assert found.score is None
        assert [note.partition(":")[0] for note in found.notes] == [f"{tmp_path / 'truth.mcap'} is of another run"]


def test_an_alarm_behind_missing_cycles_is_not_called_false(log):
    source = ChangedLog(log, without_cycles(2050, 2150))
    found = replay_source(source, [source.settings], contacts_beside(log))[0]
    assert ([alarm.t_ns for alarm in found.score.unjudged], found.score.false_alarms) == ([found.detections_ns[0]], ())
    assert any(note.startswith("1 detection behind missing cycles") for note in found.notes)


def test_where_nothing_was_watched_no_alarm_is_counted(log):
    source = LogSource(log)
    learning = replay_source(source, [source.settings], contacts_beside(log), stretch=TimeWindow(end_s=0.3))[0]
    rows = dict(side_by_side([learning]))
    assert (rows["watched, s"], rows["missed"], rows["false alarms"]) == ("0.00", "–", "–")
