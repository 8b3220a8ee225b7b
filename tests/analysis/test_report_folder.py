"""The report of a folder of runs: each run's report, and a page over them."""

import json
import re
from pathlib import Path

import pytest
from called import called, complaints
from hand_made_run import A, M, make_run, record

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make three runs, one of them not readable, and a link to one."""
    runs = tmp_path_factory.mktemp("runs")
    run = make_run((A, 60), (M, 60))
    for name in ("b/deep", "a c#1"):
        (runs / name).mkdir(parents=True)
        record(runs / name / "run.mcap", run)
    (runs / "d").mkdir()
    (runs / "d" / "run.mcap").write_bytes(b"nothing of a log\x1b[2J")
    (runs / "latest").symlink_to("b")
    (runs / "notes").mkdir()
    return runs


def report(*given: object):
    return called("report", *given)


@pytest.mark.long
def test_every_run_of_a_folder_is_reported_and_one_that_cannot_be_keeps_none_back(folder, tmp_path):
    found = report(folder, "--out", tmp_path)
    assert found.exit_code == 3
    lines = found.stdout.splitlines()
    assert lines[0] == "3 runs, 1 not good"
    assert [line.partition(": ")[0] for line in lines[2:5]] == ["a c#1", "b/deep", "d"]
    assert lines[4].startswith("d: NOT GOOD: The log can't be reported: ")
    reported = sorted(path.parent.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("report.html"))
    assert reported == ["a c#1", "b/deep"]
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert re.findall(r'<a href="([^"]+)">', page) == ["a%20c%231/report.html", "b/deep/report.html"]
    assert ("\x1b" in page, '<header class="bad">' in page) == (False, True)
    tables = json.loads(report(folder, "--out", tmp_path / "again", "--json").stdout)
    assert [table["folder"] for table in tables] == ["a c#1", "b/deep", "d"]
    assert tables[0]["is_clean"] is True
    assert set(tables[2]) == {"folder", "problem"}


@pytest.mark.long
def test_a_folder_with_a_run_is_that_run_and_several_are_reported_in_folders_of_their_names(folder, tmp_path):
    one = report(folder / "b" / "deep", "--out", tmp_path / "one")
    assert (one.exit_code, (tmp_path / "one" / "index.html").exists()) == (0, False)
    both = report(folder / "b" / "deep", folder / "a c#1" / "run.mcap", "--out", tmp_path / "both")
    assert both.exit_code == 0, both.output
    assert sorted(path.parent.name for path in (tmp_path / "both").rglob("report.html")) == ["a c#1", "deep"]


def test_a_log_that_cannot_be_read_keeps_no_other_back(folder, tmp_path):
    found = report(folder / "notes", folder / "d" / "run.mcap", folder / "b" / "deep", "--out", tmp_path, "--json")
    assert (found.exit_code, [table["is_clean"] for table in json.loads(found.stdout)]) == (1, [True])
    assert [str(folder / name) in line for name, line in zip("nd", complaints(found), strict=True)] == [True, True]


def test_two_reports_in_one_folder_are_refused_before_the_first(folder, tmp_path):
    run = folder / "b" / "deep"
    found = report(run, run, "--out", tmp_path)
    line = f"adacd-hil: two reports would go to {tmp_path / 'deep'}; report these logs one by one\n"
    assert (found.exit_code, found.stderr) == (2, line)
    assert not list(tmp_path.iterdir())


def test_an_index_is_written_though_no_run_can_be_reported(tmp_path):
    (tmp_path / "runs" / "d").mkdir(parents=True)
    (tmp_path / "runs" / "d" / "run.mcap").write_bytes(b"nothing of a log")
    found = report(tmp_path / "runs", "--out", tmp_path / "new" / "reports")
    assert (found.exit_code, found.stdout.splitlines()[0]) == (3, "1 run, 1 not good")
    assert "1 run, 1 not good" in (tmp_path / "new" / "reports" / "index.html").read_text(encoding="utf-8")
