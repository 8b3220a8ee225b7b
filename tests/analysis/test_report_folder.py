"""The report of a folder of runs: each run's report, and a page over them."""

import json
import re
from pathlib import Path

import pytest
from click.testing import CliRunner
from hand_made_run import A, M, make_run, record

from adacd_hil.cli.main import cli
from adacd_hil.config import to_toml

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make three runs, one of them not readable, and a link to one."""
    runs = tmp_path_factory.mktemp("runs")
    run = make_run((A, 60), (M, 60))
    for name in ("b/deep", "a c#1"):
        (runs / name).mkdir(parents=True)
        record(runs / name / "run.mcap", run, {"config.toml": to_toml(run.settings).encode()})
    (runs / "d").mkdir()
    (runs / "d" / "run.mcap").write_bytes(b"nothing of a log\x1b[2J")
    (runs / "latest").symlink_to("b")
    (runs / "notes").mkdir()
    return runs


def report(*given: object):
    return CliRunner().invoke(cli, ["report", *map(str, given)])


def test_every_run_of_a_folder_is_reported_and_one_that_cannot_be_keeps_none_back(folder: Path, tmp_path: Path) -> None:
    found = report(folder, "--out", tmp_path)
    assert found.exit_code == 3
    lines = found.stdout.splitlines()
    assert lines[0] == "3 runs, 1 not good"
    assert [line.partition(": ")[0] for line in lines[2:5]] == ["a c#1", "b/deep", "d"]
    assert lines[2].startswith("a c#1: good: 0 detections")
    assert lines[4].startswith("d: NOT GOOD: The log can't be reported: ")
    assert sorted(path.parent.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("report.html")) == [
        "a c#1",
        "b/deep",
    ]


def test_the_index_leads_to_the_reports(folder: Path, tmp_path: Path) -> None:
    report(folder, "--out", tmp_path)
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert re.findall(r'<a href="([^"]+)">', page) == ["a%20c%231/report.html", "b/deep/report.html"]
    assert "\x1b" not in page
    assert '<header class="bad">' in page


def test_the_json_has_a_table_for_each_run(folder: Path, tmp_path: Path) -> None:
    tables = json.loads(report(folder, "--out", tmp_path, "--json").stdout)
    assert [table["folder"] for table in tables] == ["a c#1", "b/deep", "d"]
    assert tables[0]["is_clean"] is True
    assert set(tables[2]) == {"folder", "problem"}


def test_a_folder_without_a_run_is_one_line(tmp_path: Path) -> None:
    found = report(tmp_path)
    assert (found.exit_code, found.stderr) == (1, f"adacd-hil: {tmp_path} has no run.mcap, nor has any folder in it\n")


def test_a_folder_with_a_run_is_that_run(folder: Path, tmp_path: Path) -> None:
    found = report(folder / "b" / "deep", "--out", tmp_path)
    assert found.exit_code == 0
    assert not (tmp_path / "index.html").exists()
