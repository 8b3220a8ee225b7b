"""Arms that hang, stand, lie or are tilted: from `init` to a certificate, played as their file says and heavier."""

import re
from pathlib import Path

import pytest
from click.testing import CliRunner

from adacd_hil.cli.main import cli

ARM = ("--no-bus", "--length-m", "0.4", "0.25", "--mass-kg", "2", "1", "--yes")
STRENGTH = ("--rated-torque-nm", "30", "10", "--torque-limit-nm", "30", "10")
MOUNTINGS = {
    "hanging": ("--mounting", "ceiling"),
    "standing": ("--mounting", "floor"),
    "tilted": ("--mounting", "10", "--at-zero", "level"),
}
TOUCHED = """
lasts_s = 8.0
start_deg = [-20.0, 25.0]
contacts = [
    { at_s = 5.0, link = 1, point_m = 0.25, angle_deg = 90.0, force_N = 20.0, duration_s = 0.25 },
    { at_s = 6.5, link = 2, point_m = 0.20, angle_deg = -90.0, force_N = 15.0, duration_s = 0.25 },
]

[expect]
adaptations = 1
contacts = 2
"""
HEAVIER = "[factor]\nmass = [1.25, 0.8]\n"
UPSIDE_DOWN = "[mechanics]\ntilt_deg = 90.0\ntilt_direction_deg = 180.0\n"


def play(folder: Path, mounting: tuple[str, ...], truth: str = "") -> str:
    """Draft an arm and play it; return what is said of the run."""
    file, scenario, truth_file = folder / "arm.toml", folder / "touched.toml", folder / "truth.toml"
    drafted = CliRunner().invoke(cli, ["init", str(file), *ARM, *STRENGTH, *mounting])
    assert drafted.exit_code == 0, drafted.stderr
    scenario.write_text(TOUCHED)
    truth_file.write_text(truth)
    words = ["demo", "--config", str(file), "--scenario", str(scenario), "--out", str(folder / "run")]
    played = CliRunner().invoke(cli, [*words, *(["--truth", str(truth_file)] if truth else [])])
    return played.output


@pytest.mark.slow
@pytest.mark.parametrize("truth", ["", HEAVIER], ids=["as told", "other masses"])
@pytest.mark.parametrize("mounting", MOUNTINGS.values(), ids=MOUNTINGS)
def test_a_mounted_arm_is_certified_and_its_touches_are_found(
    tmp_path: Path, mounting: tuple[str, ...], truth: str
) -> None:
    said = play(tmp_path, mounting, truth)
    certified = re.search(r"certified in ([0-9.]+) s", said)
    assert certified is not None, said
    assert float(certified[1]) <= 4.0
    assert re.search(r"Contacts detected +2 of 2", said), said
    assert re.search(r"False alarms +0", said), said


@pytest.mark.slow
def test_an_arm_that_stands_and_is_told_to_hang_gets_no_certificate(tmp_path: Path) -> None:
    assert "certified in" not in play(tmp_path, MOUNTINGS["hanging"], UPSIDE_DOWN)
