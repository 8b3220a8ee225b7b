"""The emulator plays the arm of the configuration that the host reads, and what a truth says otherwise."""

import subprocess
import sys
from pathlib import Path

import pytest

OWN_ARM = """
extends = "certified"

[arm]
link_length_m = [0.4, 0.25]
rated_torque_Nm = [20.0, 8.0]
torque_limit_Nm = [18.0, 7.0]
position_limit_deg = [80.0, 110.0]
cad_theta = []

[devices]
drive_node = [11, 12]
sensor_node = [21, 22]
contract = ""
"""
SHORT = "lasts_s = 0.4\n"
HOST = "from adacd_hil.cli.main import main; main()"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rehearsal")
    (folder / "my-arm.toml").write_text(OWN_ARM)
    (folder / "short.toml").write_text(SHORT)
    return folder


def rehearse(folder: Path, name: str, *words: str) -> tuple[int, str]:
    """Play a short demo of the arm; return the exit status, and what was said on stderr."""
    command = ["demo", "--config", "my-arm.toml", "--scenario", "short.toml", "--out", name, *words]
    ran = subprocess.run(
        [sys.executable, "-c", HOST, *command], cwd=folder, capture_output=True, text=True, check=False
    )
    return ran.returncode, ran.stderr


def test_an_own_arm_is_composed_and_what_is_assumed_of_it_is_said(folder: Path) -> None:
    status, said = rehearse(folder, "own")
    assert status == 0
    assert "ENABLE -> ADAPT" in said or "moves" in said
    assumed = [line for line in said.splitlines() if line.startswith("assumed: ")]
    assert any("link 1 mass" in line for line in assumed)
    assert any("joint stops" in line for line in assumed)


@pytest.mark.parametrize(
    ("truth", "said"),
    [
        ("wrong-rated-torque", "Drive2 (node 12): rated torque 0x6076 = 6400 mNm, 8000 mNm expected"),
        ("swapped-joints", "Drive1 (node 11): rated torque 0x6076 = 8000 mNm, 20000 mNm expected"),
    ],
)
def test_what_the_drives_contradict_is_refused_before_they_are_enabled(folder: Path, truth: str, said: str) -> None:
    status, lines = rehearse(folder, truth, "--truth", truth)
    assert status == 5
    assert said in lines
    assert "ADAPT" not in lines


def test_a_truth_that_no_file_names_is_refused_with_the_nearest_name(folder: Path) -> None:
    status, lines = rehearse(folder, "none", "--truth", "wrong-lenght")
    assert status == 2
    assert "wrong-length" in lines.splitlines()[-1]
