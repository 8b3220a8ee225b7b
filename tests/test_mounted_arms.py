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
    "level": ("--mounting", "wall"),
    "level, lowered by +q1": ("--mounting", "wall", "--at-zero", "90"),
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


def mounted(tilt_deg: float, hangs_deg: float) -> str:
    """Return the truth of an arm that is mounted otherwise."""
    return f"[mechanics]\ntilt_deg = {tilt_deg}\ntilt_direction_deg = {hangs_deg}\n"


def play(folder: Path, mounting: tuple[str, ...], truth: str = "", text: str = TOUCHED) -> str:
    """Draft an arm and play it; return what is said of the run. text: of the scenario; "": `paper`."""
    file, touched, truth_file = folder / "arm.toml", folder / "touched.toml", folder / "truth.toml"
    drafted = CliRunner().invoke(cli, ["init", str(file), *ARM, *STRENGTH, *mounting])
    assert drafted.exit_code == 0, drafted.stderr
    touched.write_text(text)
    truth_file.write_text(truth)
    words = [
        "demo",
        "--config",
        str(file),
        "--scenario",
        str(touched) if text else "paper",
        "--out",
        str(folder / "run"),
    ]
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
    assert "All 2 contacts detected" in said, said
    assert "no false alarm" in said, said


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mounting", "hangs_deg"), [("hanging", -90.0), ("hanging", 40.0), ("standing", 90.0), ("tilted", 0.0)]
)
def test_a_wrong_mounting_is_named_before_a_certificate(tmp_path: Path, mounting: str, hangs_deg: float) -> None:
    tilt_deg = 10.0 if mounting == "tilted" else 90.0
    said = play(tmp_path, MOUNTINGS[mounting], mounted(tilt_deg, hangs_deg))
    found = re.search(r"link 1 (?:hung|hangs) at about q1 = (-?[0-9]+) deg", said)
    assert found is not None, said
    assert abs(float(found[1]) - hangs_deg) < 25.0
    assert "certified in" not in said


@pytest.mark.slow
def test_an_arm_that_stands_and_is_told_to_hang_is_named_with_its_certificate(tmp_path: Path) -> None:
    said = play(tmp_path, MOUNTINGS["hanging"], mounted(90.0, 180.0))
    assert re.search(
        r"gravity acts against the mounting, arm.mounting_deg\[1\] = 0 deg; link 1 hangs at q1 = 180", said
    )


@pytest.mark.slow
def test_a_stop_before_the_first_motion_is_acknowledged_and_the_run_ends(tmp_path: Path) -> None:
    still = TOUCHED.replace("[-20.0, 25.0]", "[0.0, 0.0]")
    said = play(tmp_path, MOUNTINGS["hanging"], mounted(90.0, 20.0), still)
    assert "touch: withdraws  [ENABLE -> REACT]" in said
    assert "[STOPPED -> ENABLE]" in said


@pytest.mark.slow
def test_the_weight_of_an_arm_that_is_told_to_be_flat_is_named_with_the_mounting(tmp_path: Path) -> None:
    said = play(tmp_path, ("--mounting", "flat"), mounted(90.0, -90.0))
    assert re.search(r"joint 1 is loaded: .* the mounting is not flat: estimator.gravity = true", said), said


@pytest.mark.slow
def test_a_payload_is_learnt_and_all_touches_are_found_in_gravity(tmp_path: Path) -> None:
    said = play(tmp_path, MOUNTINGS["hanging"], text="")
    assert re.search(r"certified in [0-9.]+ s and again in [01]\.", said), said
    assert "All 8 contacts detected" in said, said
    assert "no false alarm" in said, said
