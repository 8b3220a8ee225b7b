"""A truth of another run is left out; what a truth doesn't cover isn't judged."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from hand_made_run import A, M, make_run, record, record_truth, touched_run

from adacd_hil.lab.report.report_files import write_report
from adacd_hil.lab.report.run_reading import read_run
from adacd_hil.lab.score.evaluation import evaluate
from adacd_hil.lab.score.run_arrays import Run, host_truth
from adacd_hil.log.log_files import CONFIG_DIGEST_KEY
from adacd_hil.log.logged_run import Truth
from adacd_hil.log.recording.recorder import Recorder
from adacd_hil.score.emulator_truth import TruthTable, config_digest, contacts_beside, foreign_truth
from firmware_sim.bench.bench_time import TruthLog
from firmware_sim.scenario.scenario import load_scenario

CONFIG = 'name = "mine"\n[filter]\na_rad_s = 10.0\n'


def make_logs(
    folder: Path, host: dict[str, str], emulator: dict[str, str], seed: int | None = None
) -> tuple[Path, Path]:
    """Write the logs of a run of which nothing counts but who says what; seed: of an attached scenario."""
    log, truth = folder / "run.mcap", folder / "truth.mcap"
    Recorder(log, attachments={"config.toml": CONFIG.encode()}, metadata=host, blocking=True).close()
    scenario = None if seed is None else load_scenario("idle", seed=seed)
    TruthLog(truth, blocking=True, metadata=emulator, scenario=scenario).close()
    return log, truth


@pytest.mark.parametrize(
    ("host", "emulator", "seed", "reason"),
    [
        ({}, {"scenario": "idle", "seed": "1"}, None, ""),  # on a bus the host doesn't know
        ({"scenario": "idle", "seed": "1"}, {"scenario": "idle", "seed": "1"}, None, ""),
        ({"scenario": "idle", "seed": "4"}, {}, 4, ""),
        ({"scenario": "idle", "seed": "4"}, {}, 5, "its seed is 5, the log's 4"),
        ({"scenario": "paper", "seed": "4"}, {}, 4, "its scenario is idle, the log's paper"),
        ({"truth": "mine 12"}, {"truth": "mine 34"}, None, "its truth is mine 34, the log's mine 12"),
        ({"scenario": "idle"}, {"scenario": "paper"}, None, "its scenario is paper, the log's idle"),
        ({}, {CONFIG_DIGEST_KEY: config_digest(CONFIG)}, None, ""),
        ({}, {CONFIG_DIGEST_KEY: config_digest(f"{CONFIG}[realtime]\ncpu = 'any'\n")}, None, ""),
        ({}, {CONFIG_DIGEST_KEY: config_digest("name = 'x'")}, None, "its host had another configuration"),
    ],
)
def test_logs_tell_runs_apart_by_what_was_played(host, emulator, seed, reason, tmp_path):
    log, truth = make_logs(tmp_path, host, emulator, seed)
    assert foreign_truth(log, truth) == (f"{truth} is of another run: {reason}" if reason else "")
    told: list[str] = []
    assert contacts_beside(log, told.append) is None  # nor has such a truth a cycle
    assert told == ([f"{truth} is of another run: {reason}; it is left out"] if reason else [])


@pytest.mark.parametrize(("content", "reason"), [(b"", "is empty"), (b"hello", "is not an MCAP file")])
def test_a_truth_that_cannot_be_read_is_left_out(content, reason, tmp_path):
    log, truth = make_logs(tmp_path, {}, {})
    truth.write_bytes(content)
    told: list[str] = []
    assert (contacts_beside(log, told.append), told) == (None, [f"{truth} {reason}; it is left out"])


def recorded(folder: Path, run: Run) -> tuple[Path, Path]:
    """Write both logs of a run."""
    record(folder / "run.mcap", run)
    record_truth(folder / "truth.mcap", run)
    return folder / "run.mcap", folder / "truth.mcap"


def with_truth_of(run: Run, rows: slice) -> Run:
    """Give a run whose truth has some of its rows only."""
    assert run.truth is not None
    names = ("cycle", "tau_ext", "contact_link", "contact_index", "payload_kg", "theta", "force_N")
    return dataclasses.replace(
        run, truth=dataclasses.replace(run.truth, **{name: getattr(run.truth, name)[rows] for name in names})
    )


@pytest.mark.slow
@pytest.mark.parametrize("full_cycles", [500_000, 100], ids=["short", "long"])
@pytest.mark.parametrize(
    ("rows", "false_alarms", "unjudged", "judged_s"),
    [
        (slice(None), 1, "", []),
        (slice(3000), 0, "2 detections", [("1.00", "2.95")]),
        (slice(3000, None), 1, "1 detection", [("2.95", "9.30")]),
        (slice(9100), 1, None, [("1.00", "8.95")]),
    ],
)
def test_what_comes_before_or_after_the_truth_is_not_judged(
    rows, false_alarms, unjudged, judged_s, full_cycles, tmp_path
):
    run, gathered, source = read_run(*recorded(tmp_path, with_truth_of(touched_run(), rows)), full_cycles=full_cycles)
    metrics = evaluate(run, gathered)
    assert metrics.false_alarms == false_alarms
    assert re.findall(r"from (\S+) to (\S+) s", metrics.findings[0].text) == judged_s
    said = f"the truth doesn't cover {unjudged}, not judged" if unjudged else unjudged
    said = "truth.mcap doesn't cover all of MONITOR" if said is None else said
    assert (source.log_problem, source.truth_problem, source.is_complete) == ("", said, not said)


@pytest.mark.slow
def test_a_report_without_the_truth_of_another_run_says_so(tmp_path):
    log, _ = recorded(tmp_path, touched_run())
    (tmp_path / "truth.mcap").unlink()
    TruthLog(tmp_path / "truth.mcap", blocking=True, metadata={"scenario": "idle"}).close()
    report = write_report(log, tmp_path / "truth.mcap", tmp_path / "out")
    assert report.metrics.false_alarms is None
    assert not report.is_complete
    assert "truth.mcap is of another run: its scenario is idle, the log's paper" in report.as_text()


@pytest.mark.slow
def test_a_command_for_the_terminal_names_the_log_with_its_folder(tmp_path):
    log, _ = recorded(tmp_path, make_run((A, 1000), (M, 1000)))
    assert write_report(log, None, tmp_path / "out").next_steps[-1].command == f"adacd-hil replay {log}"


def test_a_truth_that_goes_on_with_the_next_host_covers_this_one_to_its_end():
    nothing = np.zeros(1, np.int64)
    truth = Truth(
        nothing, np.zeros((1, 2)), np.zeros(1), np.full(1, -1.0), np.zeros(1), np.zeros((1, 7)),
        model_cycle=nothing, model_attempt=nothing, attempt=nothing, force_N=np.zeros(1), time_s=np.zeros(1),
    )  # fmt: skip
    rows = TruthTable(truth, {}, "", ((0, 3), (1, 50)))
    begun = ([0], [0, 480])
    one, both = (host_truth(rows, np.array(begins), 1000, np.zeros(1)) for begins in begun)
    assert one is not None
    assert both is not None
    assert (one.covers(2), one.covers(3), one.covers(900)) == (False, True, True)
    assert both.span == (3, 530)
