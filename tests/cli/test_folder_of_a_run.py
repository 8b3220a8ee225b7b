"""Where runs go: a new folder each, to which links lead; nothing of yesterday's is lost."""

import contextlib
import subprocess
from pathlib import Path

import pytest
from experiment_runs import BIN, PAPER, adacd_hil

from adacd_hil.cli import output as run_folder_module
from adacd_hil.cli.output import run_folder
from adacd_hil.log.log_files import LogExistsError
from adacd_hil.log.reader import read_log

USAGE = 2


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()}


@pytest.mark.long
@pytest.mark.slow
def test_demos_leave_each_other_as_they_are_and_the_links_lead_to_the_last(tmp_path):
    (tmp_path / "short.toml").write_text("lasts_s = 0.3\n")
    command = [BIN / "adacd-hil", "demo", *PAPER, "--scenario", "short.toml"]
    pair = [subprocess.Popen(command, stdout=subprocess.DEVNULL, cwd=tmp_path) for _ in range(2)]
    assert [process.wait() for process in pair] == [0, 0]
    folders = [file for file in (tmp_path / "runs").iterdir() if not file.is_symlink()]
    assert len(folders) == 2
    for folder in folders:
        assert read_log(folder).is_complete
        assert (folder / "report.html").is_file()
    assert {(tmp_path / "runs" / link).resolve() for link in ("latest", "demo")} <= set(folders)
    before = contents(tmp_path)
    refused = adacd_hil(tmp_path, "demo", *PAPER, "--out", "runs/demo")
    assert refused.status == USAGE
    assert refused.stderr == (
        "adacd-hil: runs/demo/run.mcap is there already; choose another folder with --out, or move it away\n"
    )
    assert contents(tmp_path) == before


def test_runs_of_one_second_are_numbered(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(run_folder_module, "wall_ns", lambda: 1_800_000_000_000_000_000)
    made = []
    for _ in range(3):
        with run_folder(None, ("run.mcap",), "run") as folder:
            (folder.path / "run.mcap").touch()
            folder.link()
        made.append(folder.path.name)
    assert made == [made[0], f"{made[0]}_2", f"{made[0]}_3"]
    assert (tmp_path / "runs" / "latest").readlink() == (tmp_path / "runs" / "run").readlink() == Path(made[2])


@pytest.mark.parametrize("error", [None, LogExistsError("no bus")])
@pytest.mark.parametrize("out", [None, Path("a/b")])
def test_a_run_that_makes_nothing_leaves_no_folder_and_no_link(out, error, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with contextlib.suppress(LogExistsError), run_folder(out, ("run.mcap",), "run") as folder:
        folder.path.mkdir(parents=True, exist_ok=True)
        if error is not None:
            raise error
    assert list(tmp_path.iterdir()) == []


def test_a_folder_of_the_name_of_a_link_stays(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs" / "demo").mkdir(parents=True)
    (tmp_path / "runs" / "demo" / "run.mcap").write_text("yesterday")
    told: list[str] = []
    with run_folder(None, ("run.mcap",), "demo") as folder:
        (folder.path / "run.mcap").touch()
        folder.link(told.append)
    assert told == ["link runs/demo is not set: there is a folder of that name"]
    assert (tmp_path / "runs" / "demo" / "run.mcap").read_text() == "yesterday"
    assert (tmp_path / "runs" / "latest").resolve() == folder.path.resolve()


def test_a_folder_with_a_log_is_refused_before_anything_is_made(tmp_path):
    (tmp_path / "truth.mcap").write_text("yesterday")
    with (
        pytest.raises(LogExistsError, match=r"truth\.mcap is there already"),
        run_folder(tmp_path, ("run.mcap", "truth.mcap"), "demo"),
    ):
        pass
