"""Arms that hang, stand, lie or are tilted: from `init` to a certificate, played as their file says and heavier."""

import re
from pathlib import Path

import pytest
from called import called
from long_cases import long_but
from played_outcome import ScenarioOutcome, outcome_of

from adacd_hil.cli.embedded_run import resolve, run_embedded
from adacd_hil.control.operator import ScriptedOperator
from adacd_hil.replay.replay import replay
from adacd_hil.settings.setting_keys import apply_settings

pytestmark = pytest.mark.slow

ARM = ("--no-bus", "--length-m", "0.4", "0.25", "--mass-kg", "2", "1", "--yes")
STRENGTH = ("--rated-torque-nm", "30", "10", "--torque-limit-nm", "30", "10")
MOUNTINGS = {
    "hanging": ("--mounting", "ceiling"),
    "standing": ("--mounting", "floor"),
    "level": ("--mounting", "wall"),
    "level, lowered by +q1": ("--mounting", "wall", "--at-zero", "90"),
    "tilted": ("--mounting", "10", "--at-zero", "level"),
}
START = "start_deg = [-20.0, 25.0]\n"
TOUCHED = f"""
lasts_s = 6.6
{START}contacts = [
    {{ at_s = 4.3, link = 1, point_m = 0.25, angle_deg = 90.0, force_N = 20.0, duration_s = 0.25 }},
    {{ at_s = 5.5, link = 2, point_m = 0.20, angle_deg = -90.0, force_N = 15.0, duration_s = 0.25 }},
]
"""
HEAVIER = "[factor]\nmass = [1.25, 0.8]\n"


def mounted(tilt_deg: float, hangs_deg: float) -> str:
    """Return the truth of an arm that is mounted otherwise."""
    return f"[mechanics]\ntilt_deg = {tilt_deg}\ntilt_direction_deg = {hangs_deg}\n"


def play(folder: Path, mounting: tuple[str, ...], truth: str = "", text: str = TOUCHED) -> tuple[ScenarioOutcome, str]:
    """Draft an arm and play it; return the lines that it printed, too. text: of the scenario; "": `paper`."""
    file, touched, truth_file = folder / "arm.toml", folder / "touched.toml", folder / "truth.toml"
    drafted = called("init", str(file), *ARM, *STRENGTH, *mounting)
    assert drafted.exit_code == 0, drafted.stderr
    touched.write_text(text)
    truth_file.write_text(truth)
    said: list[str] = []
    cast = resolve(str(file), str(touched) if text else "paper", None, None, str(truth_file) if truth else None)
    settings = apply_settings(cast.settings, {"safety.phase_timeout_s": "1.0"})
    ended = run_embedded(cast._replace(settings=settings), "lockstep", folder / "run", said.append)
    return outcome_of(*ended), "\n".join(said)


@pytest.mark.parametrize(
    ("mounting", "truth"),
    long_but(
        3,
        [
            ("hanging", ""),
            ("level, lowered by +q1", HEAVIER),
            ("tilted", HEAVIER),
            ("standing", HEAVIER),
            ("standing", ""),
            ("level", ""),
        ],
    ),
)
def test_a_mounted_arm_is_certified_and_its_touches_are_found(tmp_path: Path, mounting: str, truth: str) -> None:
    outcome, said = play(tmp_path, MOUNTINGS[mounting], truth)
    assert outcome.adaptation_s is not None, said
    assert outcome.adaptation_s <= 4.0
    assert (outcome.contacts, outcome.missed, outcome.false_alarms) == (2, 0, 0), said


@pytest.mark.parametrize(
    ("mounting", "hangs_deg"),
    long_but(2, [("hanging", 40.0), ("tilted", 0.0), ("hanging", -90.0), ("standing", 90.0)]),
)
def test_a_wrong_mounting_is_named_before_a_certificate(tmp_path: Path, mounting: str, hangs_deg: float) -> None:
    tilt_deg = 10.0 if mounting == "tilted" else 90.0
    outcome, said = play(tmp_path, MOUNTINGS[mounting], mounted(tilt_deg, hangs_deg), f"lasts_s = 3.0\n{START}")
    found = re.search(r"link 1 (?:hung|hangs) at about q1 = (-?[0-9]+) deg", said)
    assert found is not None, said
    assert abs(float(found[1]) - hangs_deg) < 25.0
    assert outcome.adaptations == 0


def test_an_arm_that_stands_and_is_told_to_hang_is_named_with_its_certificate(tmp_path: Path) -> None:
    _, said = play(tmp_path, MOUNTINGS["hanging"], mounted(90.0, 180.0), f"lasts_s = 3.6\n{START}")
    assert re.search(r"arm.mounting_deg\[1\] = 0 deg; link 1 hangs at q1 = 180", said), said


def test_a_stop_before_the_first_motion_is_acknowledged_and_the_run_ends(tmp_path: Path) -> None:
    still = "lasts_s = 2.0\nstart_deg = [0.0, 0.0]\n"
    _, said = play(tmp_path, MOUNTINGS["hanging"], mounted(90.0, 20.0), still)
    assert "[ENABLE -> REACT]" in said
    assert "[STOPPED -> ENABLE]" in said
    assert replay(tmp_path / "run" / "run.mcap", script_of=ScriptedOperator).is_identical


def test_the_weight_of_an_arm_that_is_told_to_be_flat_is_named_with_the_mounting(tmp_path: Path) -> None:
    _, said = play(tmp_path, ("--mounting", "flat"), mounted(90.0, -90.0), f"lasts_s = 1.5\n{START}")
    assert re.search(r"joint 1 is loaded: .* the mounting is not flat: estimator.gravity = true", said), said


@pytest.mark.long
def test_a_payload_is_learnt_and_all_touches_are_found_in_gravity(tmp_path: Path) -> None:
    outcome, said = play(tmp_path, MOUNTINGS["hanging"], text="")
    assert outcome.adaptations == 2, said
    assert (outcome.contacts, outcome.missed, outcome.false_alarms) == (8, 0, 0), said
