"""A log takes the place of nothing; only a start that failed makes room for the next."""

import fcntl
import os
import subprocess
import sys

import numpy as np
import pytest
from hang import HANG_S
from mcap.writer import Writer
from recorded_run import feed, make_run, record, start, wait_until_taken

from adacd_hil.log.log_files import LogExistsError, part_path
from adacd_hil.log.reader import read_log
from adacd_hil.log.recording.recorder import Recorder
from adacd_hil.log.recording.run_folder import check_free
from adacd_hil.log.types.truth_topic import TRUTH_LAYOUT
from adacd_hil.records import Event
from adacd_hil.settings.run_settings import LogSettings
from firmware_sim.bench.bench_time import TruthLog

pytestmark = pytest.mark.slow  # each log starts a process


def failed_start(path):
    recorder = start(path, make_run(0))
    recorder.event(0, Event("error", "run", "no boot-up from Drive1"))
    return recorder.close()


def test_a_second_run_leaves_the_log_of_the_first_as_it_is(tmp_path):
    path = tmp_path / "run.mcap"
    record(path, make_run(20))
    before = path.read_bytes()
    with pytest.raises(LogExistsError, match=f"^{path} is there already; choose another folder with --out"):
        Recorder(path)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["run.mcap"]


def test_a_run_beside_one_that_is_going_on_is_told_its_process(tmp_path):
    path = tmp_path / "run.mcap"
    run = make_run(40)
    recorder = start(path, run)
    feed(recorder, run.cycles[:20])
    with pytest.raises(LogExistsError, match=f"^{path} is being written by process {os.getpid()}; choose another"):
        Recorder(path)
    feed(recorder, run.cycles[20:])
    assert recorder.close().is_complete
    assert read_log(path).scheme.block.tobytes() == run.blocks.tobytes()


@pytest.mark.usefixtures("writer_process")
def test_a_run_is_going_on_after_its_first_part(tmp_path):
    path = tmp_path / "run.mcap"
    recorder = start(path, make_run(0), settings=LogSettings(part_MiB=1, part_min=0.0))
    feed(recorder, make_run(1500).cycles)  # more than the first part and what the writer gathers before it writes
    wait_until_taken(recorder)
    while not part_path(path, 1).exists():  # the test's time limit ends it
        os.sched_yield()
    with pytest.raises(LogExistsError, match=f"^{path} is being written by process {os.getpid()}"):
        Recorder(path)
    assert recorder.close().is_complete


def test_of_two_runs_that_begin_at_once_one_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "run.mcap"
    first = start(path, make_run(0))
    monkeypatch.setattr(
        "adacd_hil.log.recording.recorder.make_room", lambda path: None
    )  # it looked before there was one
    with pytest.raises(LogExistsError, match="is being written by another run"):
        Recorder(path)
    assert first.close().is_complete


def link(path):
    path.symlink_to(path.with_name("target"))


@pytest.mark.parametrize("make", [link, os.mkfifo, os.mkdir], ids=["link", "fifo", "folder"])
def test_what_is_no_file_is_no_place_for_a_log(make, tmp_path):
    path = tmp_path / "run.mcap"
    make(path)
    with pytest.raises(LogExistsError, match="is there already, which is no regular file"):
        Recorder(path)
    assert [file.name for file in tmp_path.iterdir()] == ["run.mcap"]


def test_the_log_of_a_start_that_failed_is_kept_aside(tmp_path):
    path = tmp_path / "run.mcap"
    failed = [failed_start(path).path.read_bytes()]
    check_free(path)
    failed.append(failed_start(path).path.read_bytes())
    assert record(path, make_run(3)).is_complete
    assert [(tmp_path / f"failed-start-{number}.mcap").read_bytes() for number in (1, 2)] == failed
    assert len(read_log(path).scheme) == 3


def test_the_emulator_s_log_of_a_start_that_failed_is_kept_aside_and_no_other(tmp_path):
    path = tmp_path / "truth.mcap"
    TruthLog(path, blocking=True).close()
    with TruthLog(path, blocking=True) as log:
        log.write(0, 0, np.zeros(TRUTH_LAYOUT.size))
    assert (tmp_path / "failed-start-1.mcap").exists()
    with pytest.raises(LogExistsError, match=f"^{path} is there already"):
        check_free(path)


def kill_host(path, before_death):
    """Let a host that does this with its recorder die, and wait until the writer, which outlives it, has ended."""
    dies = (
        "import os, sys; from pathlib import Path; from adacd_hil.records import Event;"
        "from adacd_hil.log.recording.recorder import Recorder;"
        "from adacd_hil.log.types.truth_topic import truth_channels;"
        "recorder = Recorder(Path(sys.argv[1]), metadata={'name': 'made'}, messages=(), channels=truth_channels());"
        f"{before_death};"
        "os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", dies, str(path)], check=False, timeout=HANG_S)
    with path.open("rb") as log:
        fcntl.flock(log, fcntl.LOCK_SH)


def test_a_log_with_nothing_in_it_is_kept_aside_though_its_host_was_killed(tmp_path):
    path = tmp_path / "truth.mcap"
    kill_host(path, "pass")
    check_free(path)
    assert record(path, make_run(3)).is_complete
    assert (tmp_path / "failed-start-1.mcap").exists()


def test_a_log_of_a_killed_host_that_has_logged_something_is_no_start_that_failed(tmp_path):
    kill_host(tmp_path / "run.mcap", "recorder.event(0, Event('error', 'run', 'a clue'))")
    with pytest.raises(LogExistsError):
        Recorder(tmp_path / "run.mcap")


def empty_of_others(path):
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()


def cut_start(path):
    failed_start(path)
    path.write_bytes(path.read_bytes()[:-100])


def notes(path):
    path.write_text("notes")


@pytest.mark.parametrize("make", [empty_of_others, cut_start, notes])
def test_what_is_not_surely_a_start_that_failed_is_not_moved(make, tmp_path):
    path = tmp_path / "run.mcap"
    make(path)
    before = path.read_bytes()
    with pytest.raises(LogExistsError):
        Recorder(path)
    assert path.read_bytes() == before
