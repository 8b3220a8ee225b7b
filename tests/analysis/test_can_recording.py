"""Frames that others recorded come to the decisions of the run that they are of."""

from pathlib import Path

import numpy as np
import pytest
from analysis.replay_rig import settings_of_run, write_candump

from adacd_hil.control.operator import ScriptedOperator
from adacd_hil.log.log_files import LogError
from adacd_hil.log.reader import read_log
from adacd_hil.records import ContactReport
from adacd_hil.replay.can_recording import RecordingAgainstLog, RecordingAlone, load_recording
from adacd_hil.replay.replay import replay_source
from adacd_hil.wire.dbc_contract import load_codec

pytestmark = [pytest.mark.slow, pytest.mark.long]
CODEC = load_codec()


def against(path: Path, log: Path):
    source = RecordingAgainstLog(path, log)
    return replay_source(source, [source.settings])[0]


def test_a_recording_comes_to_the_bits_of_its_run_whatever_its_clock(log, whole, tmp_path):
    path = tmp_path / "bus.log"
    write_candump(log, path, pace=0.31, start_s=1.79e9)
    found = against(path, log)
    assert found.mismatches == ()
    assert (found.compared, found.attempts, found.notes) == (whole.compared, 2, ())


def test_without_the_log_the_script_plays_the_user(log, whole, tmp_path):
    path = tmp_path / "bus.log"
    write_candump(log, path)
    source = RecordingAlone(path, settings_of_run(), CODEC)
    reports: list[ContactReport] = []
    (found,) = replay_source(
        source, [source.settings], script_of=ScriptedOperator, watch=lambda _, __, batch: reports.extend(batch.contacts)
    )
    assert [each[:1] + each[2:] for each in found.states] == [each[:1] + each[2:] for each in whole.states]
    assert reports == [report for _, report in read_log(log, ("/contact",)).contacts]
    assert found.compared == 0
    assert found.notes == ()


def test_a_recording_that_begins_later_is_found_in_its_run_and_what_it_lacks_is_said(log, whole, tmp_path):
    path = tmp_path / "bus.log"
    write_candump(log, path, first=5000)
    found = against(path, log)
    assert found.mismatches == ()
    assert 2500 < found.compared < whole.compared  # the second attempt
    assert any("are not in bus.log" in note for note in found.notes)


def test_frames_after_the_last_cyclic_one_belong_to_the_next_cycle(tmp_path):
    path = tmp_path / "bus.log"
    cycle = [("080", 0, "01"), ("181", 100, "00" * 8), ("182", 200, "00" * 8), ("183", 300, "00" * 6)]
    late = [
        ("184", 400, "00" * 6),
        ("701", 450, "05"),
        ("201", 500, "00" * 6),
        ("080", 1000, "02"),
        ("703", 1900, "05"),
    ]
    lines = [f"(0.{t_us:06d}) can0 {can_id}#{data}\n" for can_id, t_us, data in (*cycle, *late, ("080", 2000, "03"))]
    path.write_text("".join(lines))
    recording = load_recording(path, settings_of_run(), CODEC)
    assert recording.is_realtime
    owners = dict(zip(recording.frames["can_id"].tolist(), recording.owner.tolist(), strict=True))
    assert (owners[0x184], owners[0x201], owners[0x701]) == (0, 0, 1)
    assert owners[0x703] == 2  # the host awaits feedback for 0.7 periods
    assert recording.number.tolist() == [0, 1, 2]
    assert (np.diff(recording.owner) >= 0).all()


def test_the_counter_goes_round_and_a_gap_is_measured_by_time(tmp_path):
    path = tmp_path / "bus.log"
    cycles = [*range(235, 245), *range(800, 810)]
    path.write_text("".join(f"({k / 1000:.6f}) can0 080#{1 + k % 240:02X}\n" for k in cycles))
    recording = load_recording(path, settings_of_run(), CODEC)
    assert recording.number.tolist() == cycles


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["can0 181#0000000000000000"], "no SYNC"),
        (["can0 080#01", "can1 080#01", "can0 080#02"], "can0 and can1"),
    ],
)
def test_a_recording_without_sync_or_with_that_of_two_buses_is_refused(tmp_path, lines, words):
    path = tmp_path / "bus.log"
    path.write_text("".join(f"(0.000000) {line}\n" for line in lines))
    with pytest.raises(LogError, match=words):
        load_recording(path, settings_of_run(), CODEC)


def test_of_two_buses_the_one_with_sync_counts(tmp_path):
    path = tmp_path / "bus.log"
    path.write_text("(0.000) can1 181#00\n(0.001) can0 080#01\n(0.002) can0 080#02\n")
    assert load_recording(path, settings_of_run(), CODEC).frames["can_id"].tolist() == [0x080, 0x080]
