"""A sweep computes every row once, tries again what failed by accident, and goes on where it was stopped."""

import errno
import json
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest
from called import called
from hang import HANG_S
from sweep_work import Dying, Work

from adacd_hil.lab.tune.sweep import Plan, Subject, SweepStore, log_subjects, plan_of, replay_task, run_sweep
from adacd_hil.lab.tune.workers import connect
from adacd_hil.log.log_files import LogError

parquet = pytest.importorskip("pyarrow.parquet")

THRESHOLDS = [{"detector.threshold_Nm": "0.1"}, {"detector.threshold_Nm": "0.4"}]


def plan_of_runs(seeds=range(1, 6), variants=THRESHOLDS) -> Plan:
    return plan_of([Subject(scenario="paper", seed=seed) for seed in seeds], variants, "paper", "", "1")


@pytest.fixture(scope="module")
def client():
    """Threads of this process, which end with the tests, and of which none dies."""
    with ThreadPoolExecutor(2) as pool:
        yield SimpleNamespace(room=2, submit=pool.submit)


@pytest.mark.slow
def test_a_task_that_kills_its_worker_costs_its_own_rows_alone(tmp_path):
    work = Dying(tmp_path, always=(2,), once=(4,))
    with connect("", 2, preload=("adacd_hil.lab.tune.sweep",)) as workers:
        outcome, rows, lines = sweep(tmp_path, workers, work)
    assert (outcome.computed, outcome.failed) == (10, 2)
    assert [row["seed"] for row in rows if row["status"] == "failed"] == [2, 2]
    assert {row["error"] for row in rows if row["seed"] == 2} == {"the worker process died each time"}
    assert "a worker process has died: killed, or out of memory" in lines
    assert [row["seed"] for row in rows] == [1, 1, 2, 2, 3, 3, 4, 4, 5, 5]


SLOW_SWEEP = """
import sys, time
from pathlib import Path
from adacd_hil.lab.tune.workers import connect

def sleep(seconds):
    print("asleep", flush=True)
    time.sleep(seconds)

if __name__ == "__main__":
    with connect("", 2) as workers:
        futures = [workers.submit(sleep, 600) for _ in range(2)]
        try:
            futures[0].result()
        except KeyboardInterrupt:
            sys.exit(130)
"""


@pytest.mark.slow
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGKILL, -signal.SIGKILL)])
def test_no_process_outlives_the_sweep(tmp_path, number, status):
    script = tmp_path / "slow_sweep.py"
    script.write_text(SLOW_SWEEP)
    command = [sys.executable, script]
    played = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True, text=True
    )
    assert [played.stdout.readline() for _ in range(2)] == ["asleep\n"] * 2
    if number == signal.SIGINT:
        os.killpg(played.pid, number)  # as a terminal does
    else:
        played.send_signal(number)
    assert played.wait(HANG_S) == status
    said = played.communicate(timeout=HANG_S)  # which waits until nobody holds the pipes any more
    if number == signal.SIGINT:
        assert said == ("", "")


def sweep(folder: Path, client, work, plan=None, rows_per_task=2):
    plan = plan or plan_of_runs()
    lines: list[str] = []
    store = SweepStore(folder)
    outcome = run_sweep(plan, work, store, client, lines.append, rows_per_task)
    rows = parquet.read_table(store.join(plan.row_keys(), {"version": plan.version})).to_pylist()
    return outcome, rows, lines


def test_every_row_is_computed_and_stands_in_the_order_of_the_plan_though_a_task_fails_twice(tmp_path, client):
    work = Work(tmp_path, {2: 2})
    outcome, rows, lines = sweep(tmp_path, client, work)
    assert (outcome.computed, outcome.found, outcome.failed) == (10, 0, 0)
    assert [work.tries(seed) for seed in range(1, 6)] == [1, 3, 1, 1, 1]
    assert {row["status"] for row in rows} == {"ok"}
    assert [row["seed"] for row in rows] == [1, 1, 2, 2, 3, 3, 4, 4, 5, 5]
    assert [row["detector.threshold_Nm"] for row in rows] == ["0.1", "0.4"] * 5
    assert lines[-1].startswith("10 of 10 rows")


def test_a_sweep_that_is_begun_again_computes_what_is_missing(tmp_path, client):
    sweep(tmp_path, client, Work(tmp_path), plan_of_runs(range(1, 4)))
    for name in ("0a", "a0"):
        (tmp_path / f"parts/{name}.parquet").write_text("no part of a sweep")
    work = Work(tmp_path)
    outcome, rows, _ = sweep(tmp_path, client, work)
    assert (outcome.computed, outcome.found, len(rows)) == (4, 6, 10)
    assert [work.tries(seed) for seed in range(1, 6)] == [0, 0, 0, 1, 1]


def test_a_task_that_always_fails_leaves_rows_that_say_why_and_are_computed_the_next_time(tmp_path, client):
    outcome, rows, lines = sweep(tmp_path, client, Work(tmp_path, {3: 9}))
    assert (outcome.computed, outcome.failed) == (10, 2)
    assert {row["error"] for row in rows if row["seed"] == 3} == {"OSError: the disk was away"}
    assert lines[-1].endswith("2 failed")
    outcome, rows, _ = sweep(tmp_path, client, Work(tmp_path))
    assert (outcome.computed, outcome.found, outcome.failed) == (2, 8, 0)
    assert {row["status"] for row in rows} == {"ok"}


def test_a_key_changes_with_all_that_a_result_depends_on(tmp_path):
    log = tmp_path / "run.mcap"
    log.write_bytes(b"one")

    def keys(variants=THRESHOLDS, config="", profile="", version="1"):
        return list(plan_of(log_subjects([log]), variants, config, profile, version).row_keys())

    first = keys()
    assert len(set(first)) == 2
    assert keys() == first
    for other in (
        keys([{"detector.threshold_Nm": "0.3"}, {"filter.a_rad_s": "0.1"}]),
        keys(config="paper"),
        keys(profile="S"),
        keys(version="2"),
    ):
        assert not set(first) & set(other)
    log.write_bytes(b"another")
    assert not set(first) & set(keys())


def test_tasks_are_of_one_subject_and_of_so_many_rows_at_most():
    plan = plan_of_runs(range(1, 3), [{"filter.a_rad_s": str(value)} for value in range(10, 17)])
    tasks = list(plan.tasks(frozenset(), 3))
    assert [(task.subject.seed, len(task.rows)) for task in tasks] == [(1, 3), (1, 3), (1, 1), (2, 3), (2, 3), (2, 1)]


def test_a_part_that_can_not_be_written_is_named_with_the_reason(tmp_path, client, monkeypatch):
    """pyarrow's error names no file."""

    def full(*_arguments, **_keywords):
        raise OSError(errno.ENOSPC, "Error writing bytes to file")

    monkeypatch.setattr(parquet, "write_table", full)
    with pytest.raises(LogError, match=r"parts/000000.parquet can't be written: No space left on device; the same"):
        sweep(tmp_path / "out", client, Work(tmp_path))
    assert not list((tmp_path / "out").rglob("*.parquet"))


def test_a_part_that_is_damaged_is_named(tmp_path, client):
    sweep(tmp_path, client, Work(tmp_path))
    part = next((tmp_path / "parts").glob("*.parquet"))
    part.write_bytes(part.read_bytes()[:-9])
    with pytest.raises(LogError, match=f"{part}.*remove it") as refusal:
        SweepStore(tmp_path).done()
    assert "\n" not in str(refusal.value)


def test_a_row_of_a_log_says_what_its_replay_came_to(log, whole):
    variants = [{}, {"detector.threshold_Nm": "9.0"}, {"detector.threshold_Nm": "-1"}]
    (task,) = plan_of(log_subjects([log]), variants, "", "", "1").tasks(frozenset(), 10)
    own, deaf, wrong = replay_task(task)
    assert [row["key"] for row in (own, deaf, wrong)] == [row.key for row in task.rows]
    assert (own["status"], own["identical"], own["cycles"], own["attempts"]) == ("ok", True, whole.cycles, 2)
    assert (own["detections"], own["missed"]) == (len(whole.detections_ns), whole.score.missed)
    assert own["theta_hat.a1"] == whole.parameters["a1"]
    assert 0.0 < own["monitored_s"] < whole.cycles * 1e-3
    assert (deaf["status"], deaf["identical"], deaf["detections"]) == ("ok", None, 0)
    assert deaf["set.detector.threshold_Nm"] == "9.0"
    assert wrong["status"] == "failed"
    assert "detector.threshold_Nm" in wrong["error"]


def test_what_a_replay_says_of_a_damaged_log_a_sweep_says_too(log, tmp_path):
    content = log.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(content[: len(content) // 2])
    played = called("sweep", log, cut, "--out", tmp_path / "out", "--workers", "1", "--json")
    (replayed,) = json.loads(called("replay", cut, "--json").stdout)
    result = json.loads(played.stdout)
    whole, damaged = parquet.read_table(result["table"]).column("notes").to_pylist()
    assert (played.exit_code, whole, damaged) == (3, None, "; ".join(replayed["notes"]))
    assert result["notes"] == [f"{cut}: {damaged}"]
