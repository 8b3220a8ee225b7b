"""Many runs: their list, without reading logs that a report is of, and the trend of an arm."""

import csv
import json
import os
import shutil
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from called import called
from hand_made_run import A, M, evaluated, make_certified_run, make_run, record

from adacd_hil.file_access import create_file
from adacd_hil.lab.logs.cut import cut
from adacd_hil.lab.report.report_json import report_json
from adacd_hil.lab.report.run_reading import read_run
from adacd_hil.lab.runs.run_summary import (
    BROKEN,
    CERTIFIED,
    GOOD,
    IDENTIFIED,
    NOT_JUDGED,
    RUNNING,
    CertificateState,
    RunSummary,
    judged,
    reported,
    summarise,
    with_devices,
)
from adacd_hil.lab.runs.run_trend import trends
from adacd_hil.lab.score.metrics import ReportSource
from adacd_hil.log.recording.recorder import Recorder
from adacd_hil.log.time_window import TimeWindow
from adacd_hil.records import Event
from adacd_hil.settings.configuration_files import load_settings

pytestmark = pytest.mark.slow

FAILURE, PARTIAL, USAGE = 1, 3, 2
DATED = "2026-11-25T14-22-33"
CERTIFICATE = {
    "friction_Nm": [0.1, 0.2, 0.3, 0.4, 0.5, 0.6], "friction_std_Nm": [0.01] * 6,
    "offset_Nm": [0.03, 0.04], "offset_std_Nm": [0.001, 0.002],
}  # fmt: skip


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with its report.json, as the judge gives it."""
    folder = tmp_path_factory.mktemp("made") / DATED
    folder.mkdir()
    run = make_run((A, 60), (M, 60))
    record(folder / "run.mcap", run)
    read = read_run(folder / "run.mcap", None)
    table = report_json(evaluated(read.run), read.run.metadata, read.source)
    (folder / "report.json").write_text(json.dumps(table))
    return folder


@pytest.fixture
def one(made: Path, tmp_path: Path) -> Path:
    """A copy of that run, in a folder of its own."""
    return Path(shutil.copytree(made, tmp_path / "runs" / DATED))


def test_a_report_beside_the_log_has_the_figures(one):
    run = summarise(one)
    assert (run.status, run.verdict) == (GOOD, json.loads((one / "report.json").read_text())["verdict"])
    assert run.certificate == CertificateState(IDENTIFIED, 0.06, 1)
    assert run.threshold_Nm == (0.15, 0.15)
    assert (run.found, run.expected, run.scenario) == (0, None, "paper")
    (one / "run.mcap").unlink()
    record(one / "run.mcap", replace(make_run((A, 60), (M, 60)), settings=load_settings("certified")))
    (one / "report.json").touch()
    assert summarise(one).threshold_Nm is None  # as of a certified run without a cycle


def test_a_log_in_lockstep_is_dated_by_its_folder_then_by_its_file(one):
    run = summarise(one)
    assert (run.started_by, run.started) == ("folder", datetime(2026, 11, 25, 14, 22, 33).astimezone())
    odd = one.rename(one.parent / "odd")
    os.utime(odd / "run.mcap", (1_000_000, 1_000_000))
    run = summarise(odd)
    assert (run.started_by, run.started) == ("file", datetime.fromtimestamp(1_000_000).astimezone())


@pytest.mark.parametrize(
    ("values", "why"),
    [
        ({"stretch": {"from_s": 1.0}}, "report.json is of a stretch of the log"),
        ({"schema": 2}, "report.json has layout 2, 3 is read"),
        ({"cycle": {"count": 5}}, "report.json is of another log"),
        ({"run": {"scenario": "idle"}}, "report.json is of another log"),
        ({"is_clean": "yes"}, "report.json is damaged: TypeError 'yes' is neither true nor false"),
        ({"sections": []}, "report.json is damaged: AttributeError 'list' object has no attribute 'values'"),
        ("[" * 100_000, "report.json is damaged: "),
        ("\x00", "report.json is damaged: "),
    ],
)
def test_a_report_that_is_not_of_the_whole_log_is_left_alone_and_that_is_told(one, values, why):
    path = one / "report.json"
    path.write_text(values if isinstance(values, str) else json.dumps({**json.loads(path.read_text()), **values}))
    run = summarise(one)
    assert run.status == NOT_JUDGED
    assert run.verdict.startswith(why)


def test_a_run_without_a_report_is_judged_when_asked(one):
    asked = summarise(one)
    (one / "report.json").unlink()
    quick = summarise(one)
    assert (quick.status, quick.threshold_Nm) == (NOT_JUDGED, None)
    assert judged(quick) == asked


def test_a_whole_log_of_which_not_all_could_be_judged_is_not_called_damaged(one, tmp_path):
    (tmp_path / "part").mkdir()
    cut(one / "run.mcap", tmp_path / "part" / "run.mcap", TimeWindow(end_s=0.1))
    run = judged(summarise(tmp_path / "part"))
    assert run.verdict.endswith(". Not all could be judged: the log is a cut of its run until 0.1 s")


def test_a_log_is_broken_though_a_report_of_it_is_there(one):
    log = one / "run.mcap"
    log.write_bytes(log.read_bytes()[:-100])
    run = summarise(one)
    assert (run.status, run.verdict) == (BROKEN, "run.mcap is cut or damaged: `adacd-hil log check` says how")
    assert run.scenario == "paper"


def test_a_log_that_is_being_written_is_running(tmp_path):
    descriptor = create_file(tmp_path / "run.mcap")
    try:
        run = summarise(tmp_path)
    finally:
        os.close(descriptor)
    assert run.status == RUNNING


def test_friction_and_offsets_are_those_of_the_first_certificate_without_payload(one):
    made = make_certified_run()
    table: dict[str, Any] = report_json(evaluated(made), made.metadata, ReportSource("run.mcap"))
    payload = {key: [9.0] * len(values) for key, values in CERTIFICATE.items()}
    table["certified"]["certificates"] = [{**payload, "is_payload": True}, {**CERTIFICATE, "is_payload": False}]
    run = reported(one, "a", table)
    assert (run.friction_Nm, run.friction_std_Nm) == ((0.2, 0.5), (0.01, 0.01))
    assert (run.offset_Nm, run.offset_std_Nm) == ((0.03, 0.04), (0.001, 0.002))
    assert run.certificate == CertificateState(CERTIFIED, 6.0, 2)
    assert run.threshold_Nm == (0.1, 0.1)


def series(**columns: list[Any]) -> list[RunSummary]:
    """Make judged runs, a day each."""
    count = len(next(iter(columns.values())))
    return [
        RunSummary(
            f"r{day}", Path(f"r{day}/run.mcap"), GOOD, "good", datetime(2026, 1, 1 + day).astimezone(), "log", "lab/P",
            interface="socketcan", **{name: values[day] for name, values in columns.items()},
        )
        for day in range(count)
    ]  # fmt: skip


def test_a_threshold_has_changed_by_a_share_of_it_and_the_settings_that_did_are_named():
    one, other = (replace(load_settings("certified"), name=name) for name in ("one", "other"))
    other = replace(other, certified=replace(other.certified, noise_sigmas=9.0))
    runs = series(threshold_Nm=[(0.1, 0.2), (0.11, 0.2), (0.13, 0.2), (0.12, 0.2)], settings=[one, one, other, other])
    (trend,) = trends(reversed(runs))
    assert "last changed with run r2 of 2026-01-03 00:00: joint 1 0.100 → 0.130 Nm" in trend.sentence
    assert f"certified.noise_sigmas {one.certified.noise_sigmas} → 9.0." in trend.sentence
    runs = [replace(run, settings=one) for run in runs]
    (trend,) = trends(runs)
    assert "not changed since run r0 of 2026-01-01 00:00: 4 runs" in trend.sentence
    (trend,) = trends(runs, threshold_share=0.2)
    assert "last changed with run r2" in trend.sentence
    assert "the settings are those of the run before" in trend.sentence


def test_an_offset_that_creeps_adds_up_and_one_within_its_deviations_does_not():
    creeping = [(0.001 * day, 0.0) for day in range(10)]
    (trend,) = trends(series(offset_Nm=creeping, offset_std_Nm=[(0.001, 0.001)] * 10))
    assert [(change.run.name, change.joint) for change in trend.quantities[2].changes] == [("r6", 1)]
    assert trend.quantities[2].changes[0].sigmas == pytest.approx(6.0 / 2.0**0.5)
    assert "last with run r6 of 2026-01-07 00:00: joint 1 0.000 → 0.006 Nm, 4.2 deviations since r0" in trend.further[1]
    (trend,) = trends(series(offset_Nm=creeping, offset_std_Nm=[(0.01, 0.001)] * 10))
    assert trend.further[1] == "Torque offsets: no change beyond what the certificates' uncertainty explains."


def test_what_has_no_deviation_is_not_said_to_have_changed():
    (trend,) = trends(series(friction_Nm=[(0.1, 0.1), (0.9, 0.9)]))
    assert trend.quantities[1].changes == ()
    assert trend.further[0].startswith(
        "Friction can't be compared: that takes two certificates with a deviation, there are 0."
    )
    assert trend.sentence == "Thresholds can't be compared: 0 of 2 runs have any."


def test_two_arms_of_one_name_have_a_trend_each():
    one = load_settings("certified")
    other = replace(one, arm=replace(one.arm, link_length_m=(0.45, 0.35)))
    tuned = replace(one, certified=replace(one.certified, noise_sigmas=9.0))
    found = trends(series(settings=[one, other, tuned, None, other], threshold_Nm=[(0.1, 0.1)] * 5))
    assert {each.arm: [run.name for run in each.runs] for each in found} == {
        "lab/P": ["r0", "r2", "r3"],
        "lab/P, arm.link_length_m = [0.45, 0.35]": ["r1", "r4"],
    }


def test_runs_without_a_serial_number_in_common_are_of_two_arms_and_without_any_one_is_assumed():
    old, new, other = ({("drive", serial) for serial in pair} for pair in ((1, 2), (2, 3), (8, 9)))
    found = trends(series(devices=list(map(frozenset, (old, other, new, (), {("drive", 3)}, other, {("sensor", 8)})))))
    assert {each.arm: [run.name for run in each.runs] for each in found} == {
        "lab/P": ["r0", "r2", "r3", "r4"],
        "lab/P, serial numbers 8": ["r6"],
        "lab/P, serial numbers 8, 9": ["r1", "r5"],
    }
    assert [each.assumed[:6] for each in found] == ["1 of 4", "", ""]


def test_the_devices_of_a_run_are_those_with_a_serial_number_in_its_log(one: Path, tmp_path: Path):
    said = [Event("info", "Drive", f"node 1: vendor 0x1, product 0x2, revision 0x3, serial {n}") for n in (77, 0)]
    with Recorder(tmp_path / "run.mcap", metadata={"config": "lab"}, blocking=True) as recorder:
        for event in said:
            recorder.event(0, event)
    found = [with_devices(summarise(folder)).devices for folder in (tmp_path, one)]
    assert found == [{("vendor 0x1, product 0x2", 77)}, set()]


def test_an_emulated_arm_is_another_than_that_on_a_bus():
    runs = series(margin=[1.0, 2.0])
    found = trends([runs[0], replace(runs[1], interface="embedded"), replace(runs[1], status=BROKEN)])
    assert [(trend.arm, len(trend.runs), len(trend.left_out)) for trend in found] == [
        ("lab/P", 1, 1),
        ("lab/P, emulated", 1, 0),
    ]


@pytest.fixture
def many(one: Path) -> Path:
    """A folder with a good run, one that is not judged, broken ones, and a link."""
    folder = one.parent
    shutil.copytree(one, folder / "b\x1b[2J<i>")
    (folder / "b\x1b[2J<i>" / "report.json").unlink()
    (folder / "2026-11-26T08-00-00").mkdir()
    (folder / "2026-11-26T08-00-00" / "run.mcap").write_bytes(b"nothing of a log")
    (folder / "only a part").mkdir()
    (folder / "only a part" / "run_001.mcap").write_bytes(b"")
    (folder / "latest").symlink_to(one.name)
    (folder / "notes").mkdir()
    (folder / "notes" / "other.mcap").write_bytes(b"")
    return folder


def test_every_run_is_listed_and_a_broken_one_with_the_reason(many):
    found = called("runs", many)
    assert found.exit_code == PARTIAL
    assert "4 runs, 2 not good, 1 not judged" in found.stdout
    assert "2026-11-26T08-00-00: broken: " in found.stdout
    assert "only a part: broken: " in found.stdout
    assert "\x1b" not in found.stdout


def test_runs_are_chosen_by_verdict_date_and_arm(many):
    def names(*options: str) -> list[str]:
        return [run["run"] for run in json.loads(called("runs", many, "--json", *options).stdout)["runs"]]

    assert names("--verdict", "good") == [DATED]
    assert names("--verdict", "good", "--until", "2026-11-24") == []
    assert names("--verdict", "good", "--since", "2026-11-25", "--until", "2026-11-25") == [DATED]
    assert names("--since", "2026-11-26", "--until", "2026-11-26T09:00") == ["2026-11-26T08-00-00"]
    assert names("--scenario", "idle") == []
    assert names("--judge", "--verdict", "not judged") == []


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (("--since", "2026-11-25", "--until", "2026-11-24"), "is after --until"),
        (("--arm", "lab"), "no run of arm 'lab'"),
        (("--scenario", "papers"), "did you mean 'paper'?"),
    ],
)
def test_a_choice_that_makes_no_sense_is_one_line(many, options, line):
    found = called("runs", many, *options)
    assert found.exit_code == USAGE
    assert line in found.stderr


def test_tables_have_a_row_for_each_run_and_fixed_types(many, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    called("runs", many, "--csv", tmp_path / "runs.csv", "--parquet", tmp_path / "runs.parquet")
    with (tmp_path / "runs.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["threshold_1_Nm"] for row in rows if row["status"] == GOOD] == ["0.15"]
    table = parquet.read_table(tmp_path / "runs.parquet")
    assert table.num_rows == len(rows) == 4
    assert table.column_names == list(rows[0])
    assert str(table.schema.field("offset_1_Nm").type) == "double"  # though nothing is known of it


@pytest.mark.parametrize("option", ["--csv", "--html", "--parquet"])
def test_a_file_of_the_user_stays(many, tmp_path, option):
    (tmp_path / "mine").write_text("t_s,q_1\n0.0,1.0\n")
    assert called("runs", many, option, tmp_path / "mine").exit_code == FAILURE
    assert (tmp_path / "mine").read_text() == "t_s,q_1\n0.0,1.0\n"


def test_the_page_leads_to_the_reports_that_there_are(many):
    (many / DATED / "report.html").write_text("")
    called("runs", many, "--html", many / "index.html")
    page = (many / "index.html").read_text(encoding="utf-8")
    assert page.count("<a href=") == 1
    assert f'<a href="{DATED}/report.html">{DATED}</a>' in page
    assert "&lt;i&gt;" in page
    assert "<i>" not in page


def test_a_trend_is_drawn_and_told(one, tmp_path):
    shutil.copytree(one, one.parent / "2026-11-26T08-00-00")
    found = called("trend", one.parent, "--out", tmp_path / "trend.html")
    assert found.exit_code == 0, found.stderr
    assert (tmp_path / "trend.html").read_text().startswith("<!DOCTYPE")
    assert "Thresholds have not changed since run 2026-11-25T14-22-33 of 2026-11-25 14:22: 2 runs." in found.stdout
    (arm,) = json.loads(called("trend", one.parent, "--json").stdout)["arms"]
    assert arm["threshold_Nm"] == {"values": [[0.15, 0.15]] * 2, "std": [[None, None]] * 2, "changes": []}
    assert called("trend", one.parent, "--out", tmp_path / "trend.svg").exit_code == USAGE
