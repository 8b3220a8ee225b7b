"""What survives when a process is killed, the disk is full, or the file is cut or damaged."""

import os
import re
import resource
import select
import shutil
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from made_log import flipped
from recorded_run import feed, make_run, record, start, wait_until_taken

from adacd_hil.error_texts import is_disk_full
from adacd_hil.log.log_files import LogError
from adacd_hil.log.mcap.record_layout import MAGIC
from adacd_hil.log.reader import read_log
from adacd_hil.log.recording import recorder as recorder_module
from adacd_hil.log.recording.recorder import Recorder
from adacd_hil.records import Event
from adacd_hil.settings.run_settings import LogSettings
from adacd_hil.wire.message_table import MessageTable

pytestmark = pytest.mark.usefixtures("writer_process")

CONTROL_PROCESS = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from recorded_run import feed, make_run, start
run = make_run(400)
recorder = start(Path(sys.argv[1]), run, blocking=sys.argv[3] == "lockstep")
feed(recorder, run.cycles)
print(recorder.pid, recorder.dropped, flush=True)
sys.stdin.read()
"""


@pytest.fixture(scope="module")
def run():
    return make_run(300, has_fd=True)


@pytest.fixture(scope="module")
def whole(run, tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "run.mcap"
    record(path, run)
    return path.read_bytes()


def wait_for_end(pid):
    descriptor = os.pidfd_open(pid)
    ended, _, _ = select.select([descriptor], [], [], 30)
    os.close(descriptor)
    return bool(ended)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_a_killed_control_process_leaves_a_finished_log(mode, tmp_path):
    path = tmp_path / "run.mcap"
    command = [sys.executable, "-c", CONTROL_PROCESS, str(path), str(Path(__file__).parent), mode]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as control:
        writer_pid, dropped = map(int, control.stdout.readline().split())
        control.kill()
        assert wait_for_end(writer_pid)
    log = read_log(path)
    assert log.problem == ""
    assert log.summary["ending"] == "control process died"
    assert int(log.summary["dropped"]) == dropped == 0
    assert log.scheme.block.tobytes() == make_run(400).blocks.tobytes()


@pytest.mark.slow
@pytest.mark.parametrize("blocking", [True, False])
def test_a_killed_writer_costs_the_log_its_end_and_the_control_process_nothing(blocking, tmp_path):
    run = make_run(2000)
    recorder = start(tmp_path / "run.mcap", run, blocking=blocking)
    feed(recorder, run.cycles[:1500])
    wait_until_taken(recorder)
    while len(read_log(tmp_path / "run.mcap").scheme) <= 1000:  # the test's time limit ends it
        os.sched_yield()
    os.kill(recorder.pid, signal.SIGKILL)
    assert wait_for_end(recorder.pid)
    feed(recorder, run.cycles[1500:])
    summary = recorder.close()
    assert not summary.is_complete
    assert summary.error == "the writer died (exit status -9)"
    log = read_log(tmp_path / "run.mcap")
    assert re.fullmatch(r"cut after \d+ bytes", log.problem)
    assert not log.is_complete
    count = len(log.scheme)
    assert 1000 < count <= 1500
    lost = 2000 - count + sum(cycle.event is not None for cycle in run.cycles) - len(log.events)
    assert lost <= summary.dropped <= lost + 300  # a chunk may be on the disk and not yet be counted
    assert log.scheme.block.tobytes() == run.blocks[:count].tobytes()
    assert log.attachments["run.toml"] == run.attachments["run.toml"]


@pytest.mark.slow
def test_a_dead_writer_whose_folder_is_gone_raises_nothing_at_the_end(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    recorder = Recorder(folder / "run.mcap")
    os.kill(recorder.pid, signal.SIGKILL)
    shutil.rmtree(folder)
    summary = recorder.close()
    assert (summary.is_complete, summary.parts) == (False, 1)
    assert recorder.close() is summary


@pytest.mark.slow
@pytest.mark.wallclock
def test_what_is_logged_reaches_the_disk_though_nothing_follows(tmp_path):
    run = make_run(10)
    recorder = start(tmp_path / "run.mcap", run, blocking=False)
    feed(recorder, run.cycles)
    while len(read_log(tmp_path / "run.mcap").scheme) < 10:  # the test's time limit ends it
        os.sched_yield()
    os.kill(recorder.pid, signal.SIGKILL)
    assert not recorder.close().is_complete
    assert read_log(tmp_path / "run.mcap").scheme.block.tobytes() == run.blocks.tobytes()


@pytest.mark.slow
def test_a_writer_that_is_behind_costs_packets_not_time(tmp_path):
    run = make_run(50)
    packets = 50 + sum(cycle.event is not None for cycle in run.cycles)
    recorder = start(tmp_path / "run.mcap", run, blocking=False)
    os.kill(recorder.pid, signal.SIGSTOP)
    sent = 0
    while recorder.dropped < 50:
        feed(recorder, run.cycles)
        sent += packets
    assert 4 * 2**20 - 1000 < recorder.waiting_bytes <= 4 * 2**20
    os.kill(recorder.pid, signal.SIGCONT)
    wait_until_taken(recorder)
    dropped = recorder.dropped
    feed(recorder, run.cycles)
    sent += packets
    summary = recorder.close()
    assert summary.dropped == dropped
    assert summary.queue_peak_bytes > 4 * 2**20 - 1000
    assert not summary.is_complete
    log = read_log(tmp_path / "run.mcap")
    assert log.problem == f"{dropped} packets never reached the log"
    assert not log.is_complete
    notices = [event.message for _, event in log.events if event.name == "log"]
    # More than one: an event still fits where a cycle doesn't.
    assert 1 <= len(notices) <= 4
    missing = [re.fullmatch(r"(\d+) packets are missing before this", notice) for notice in notices]
    assert sum(int(found[1]) for found in missing) == dropped
    assert len(log.scheme) + len(log.events) - len(notices) + dropped == sent


@pytest.mark.slow
def test_in_lockstep_a_writer_that_is_behind_is_waited_for(tmp_path):
    recorder = start(tmp_path / "run.mcap", make_run(0), settings=LogSettings(buffer_MiB=1))
    has_continued = threading.Event()
    sent = []

    def send():
        while not has_continued.is_set() or len(sent) < 10:
            recorder.event(len(sent), Event("info", "n", 4000 * "x"))
            sent.append(len(sent))

    os.kill(recorder.pid, signal.SIGSTOP)
    sender = threading.Thread(target=send)
    sender.start()
    while len(sent) < 2**20 // 4200:
        os.sched_yield()
    for _ in range(1000):  # lets the sender run against it
        os.sched_yield()
    assert len(sent) < 2**20 // 4000
    os.kill(recorder.pid, signal.SIGCONT)
    has_continued.set()
    sender.join()
    assert recorder.close().is_complete
    assert [t_ns for t_ns, _ in read_log(tmp_path / "run.mcap").events] == sent


@pytest.mark.slow
@pytest.mark.parametrize("blocking", [True, False])
def test_what_is_logged_after_the_end_is_dropped_and_raises_nothing(blocking, tmp_path):
    run = make_run(3)
    recorder = start(tmp_path / "run.mcap", run, blocking=blocking)
    assert recorder.close().is_complete
    feed(recorder, run.cycles)
    assert recorder.dropped == 3
    assert recorder.waiting_bytes == 0


@pytest.mark.slow
@pytest.mark.parametrize(("limit", "least"), [(30_000, 0), (400_000, 150)])
def test_a_full_disk_is_said_when_it_happens_and_stops_nobody(limit, least, tmp_path, capfd):
    run = make_run(2000)
    recorder = start(tmp_path / "run.mcap", run)
    resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (limit, limit))
    feed(recorder, run.cycles)
    assert recorder.dropped == 0
    line = f"adacd-hil: log {recorder.path} can't be written: File too large; the log ends here\n"
    said = ""
    while not said:  # the test's time limit ends it
        said = capfd.readouterr().err
    assert said == line
    summary = recorder.close()
    assert capfd.readouterr().err == ""
    assert re.fullmatch(r"File too large after \d+ bytes", summary.error)
    assert not summary.is_complete
    assert summary.dropped > 0
    log = read_log(tmp_path / "run.mcap")
    assert (tmp_path / "run.mcap").stat().st_size <= limit
    assert re.fullmatch(r"cut after \d+ bytes", log.problem)
    count = len(log.scheme)
    assert count >= least
    assert log.attachments["run.toml"] == run.attachments["run.toml"]
    assert log.scheme.block.tobytes() == run.blocks[:count].tobytes()


@pytest.mark.slow
def test_a_disk_that_is_full_from_the_start_is_an_error_before_the_run(tmp_path, monkeypatch):
    path = tmp_path / "run.mcap"

    def create_full(path):
        path.touch()
        return os.open("/dev/full", os.O_WRONLY)

    monkeypatch.setattr(recorder_module, "create_file", create_full)
    with pytest.raises(LogError, match=f"^log {path} can't be written: No space left on device after 0 bytes$") as said:
        Recorder(path)
    assert is_disk_full(said.value)
    assert not path.exists()


@pytest.mark.parametrize(
    ("name", "reason"), [("missing/run.mcap", "No such file or directory"), ("file/run.mcap", "Not a directory")]
)
def test_a_path_that_can_not_be_created_is_an_error_before_the_run(name, reason, tmp_path):
    (tmp_path / "file").touch()
    path = tmp_path / name
    with pytest.raises(LogError, match=f"^log {path} can't be created: {reason}$"):
        Recorder(path)


@pytest.mark.slow
def test_messages_that_have_no_topic_are_an_error_before_the_run_and_leave_no_file(tmp_path):
    path = tmp_path / "run.mcap"
    with pytest.raises(LogError, match=f"^log {path} can't be written: .*adacd_hil_msgs/msg/Scheme is taken$"):
        Recorder(path, messages=[MessageTable("Scheme", 1, 0, ())])
    assert not path.exists()


def cuts(size):
    generator = np.random.default_rng(7)
    first = len(MAGIC)  # a shorter file is refused
    return sorted({*range(first, 60), *range(size - 60, size), *generator.integers(first, size, 250).tolist()})


@pytest.mark.long
@pytest.mark.slow
def test_a_log_cut_anywhere_gives_what_came_before(run, whole, tmp_path):
    path = tmp_path / "cut.mcap"
    times = [frame.t_ns for *_, frame in run.frames]
    counts = []
    for size in cuts(len(whole)):
        path.write_bytes(whole[:size])
        log = read_log(path)
        count = len(log.scheme)
        counts.append(count)
        assert log.problem == f"cut after {size} bytes"
        assert not log.is_complete
        assert log.scheme.block.tobytes() == run.blocks[:count].tobytes()
        assert log.frames["t_ns"].tolist() == times[: len(log.frames)]
    assert counts == sorted(counts)
    assert counts[0] == 0
    assert counts[-1] == 300
    assert len(set(counts)) > 2


@pytest.mark.long
@pytest.mark.slow
def test_a_flipped_bit_is_noticed_or_harmless(run, whole, tmp_path):
    path = tmp_path / "flipped.mcap"
    generator = np.random.default_rng(11)
    noticed = 0
    for place in (*range(8, 60), *generator.integers(8, len(whole), 200).tolist()):
        path.write_bytes(flipped(whole, place, int(generator.integers(8))))
        log = read_log(path)
        noticed += not log.is_complete
        if log.is_complete:
            assert log.scheme.block.tobytes() == run.blocks.tobytes(), place
            assert len(log.frames) == len(run.frames), place
            assert {name: log.attachments[name] for name in run.attachments} == run.attachments, place
    assert noticed > 150


@pytest.mark.slow
def test_a_damaged_attachment_is_not_handed_out(whole, run, tmp_path):
    path = tmp_path / "damaged.mcap"
    path.write_bytes(flipped(whole, whole.index(run.attachments["run.toml"])))
    log = read_log(path)
    assert "run.toml" not in log.attachments
    assert log.attachments["arm.dbc"] == run.attachments["arm.dbc"]
    assert log.problem.startswith("damaged at byte ")
