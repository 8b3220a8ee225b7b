"""The emulator plays the arm of the configuration that the host reads, and what a truth says otherwise."""

import contextlib
import dataclasses
import math
import shlex
from collections.abc import Callable
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from called import called
from eds_variants import EdsVariant
from own_arm import LINKS, OWN_ARM, describe_arm, describe_geared_arm, touches

from adacd_hil.api import load
from adacd_hil.cli.embedded_run import resolve
from adacd_hil.control.configuration_check import examine_configuration
from adacd_hil.lab.report.run_reading import read_run
from adacd_hil.lab.score.evaluation import evaluate
from adacd_hil.log.log_walk import run_metadata
from adacd_hil.scheme.kernel.certified_memory import constants_of, new_memory
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.schema import ConfigError
from firmware_sim.cli.own_devices import rehearse as rehearse_file
from firmware_sim.scenario.rehearsal import DeviceCounts, ToldArm, compose_scenario
from firmware_sim.scenario.scenario import ArmTruth, Scenario

SHORT = "lasts_s = 0.4\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rehearsal")
    (folder / "my-arm.toml").write_text(OWN_ARM)
    (folder / "short.toml").write_text(SHORT)
    return folder


def rehearse(folder: Path, name: str, *words: str, scenario: str = "short.toml") -> tuple[int, str]:
    """Play a demo of the arm; return the exit status and the text on stderr."""
    command = ["demo", "--config", "my-arm.toml", "--scenario", scenario, "--out", name, *words]
    with contextlib.chdir(folder):
        ran = called(*command)
    return ran.exit_code, ran.stderr


@pytest.mark.slow
def test_a_demo_that_faults_is_played_again_by_the_command_that_it_prints(tmp_path: Path) -> None:
    lab = tmp_path / "my lab"
    lab.mkdir()
    (lab / "arm.toml").write_text(OWN_ARM)
    (lab / "silent.toml").write_text('lasts_s = 0.5\n[[faults]]\nkind = "silence"\nnode = "sensor1"\nat_s = 0.2\n')
    (lab / "real.toml").write_text("[arm]\ntorque_offset_Nm = [0.1, 0.0]\n")
    files = ["--config", "my lab/arm.toml", "--scenario", "my lab/silent.toml", "--truth", "my lab/real.toml"]
    with contextlib.chdir(tmp_path):
        played = called("demo", *files, "--out", "my lab/run")
        reported = called("report", "my lab/run").stdout.splitlines()
    elsewhere = next(
        reported[place - 1] for place, line in enumerate(reported) if line.startswith("    adacd-hil demo")
    )
    assert [name in elsewhere for name in ("arm.toml", "silent.toml", "real.toml")] == [True] * 3
    printed = [shlex.split(line) for line in played.stdout.splitlines() if line.startswith("    adacd-hil ")]
    assert (played.exit_code, printed[0]) == (4, ["adacd-hil", "demo", *files])
    named = {run_metadata(lab / "run" / name)["truth"] for name in ("run.mcap", "truth.mcap")}
    (lab / "real.toml").write_text("[arm]\ntorque_offset_Nm = [0.2, 0.0]\n")
    other = rehearse_file(str(lab / "arm.toml"), "idle", str(lab / "real.toml")).scenario.truth
    assert (len(named), [name.split()[0] for name in (*named, other)], other in named) == (1, ["real", "real"], False)


@pytest.mark.slow
@pytest.mark.parametrize("describe", [describe_arm, describe_geared_arm])
def test_an_arm_of_init_is_certified_and_all_its_touches_are_found(
    describe: Callable[[Path], list[str]], tmp_path: Path
) -> None:
    written = called("init", *describe(tmp_path))
    assert written.exit_code == 0, written.output
    (tmp_path / "touches.toml").write_text(touches(len(LINKS)))
    status, said = rehearse(tmp_path, "played", scenario="touches.toml")
    assert status == 0, said
    assert "model certified" in said
    assert any(line.startswith("assumed: ") and "joint stops" in line for line in said.splitlines())
    run, gathered, _ = read_run(tmp_path / "played" / "run.mcap", tmp_path / "played" / "truth.mcap")
    judged = evaluate(run, gathered)
    assert (len(judged.contacts), judged.missed, judged.false_alarms) == (len(LINKS), 0, 0)
    assert [contact.link_detected for contact in judged.contacts] == LINKS
    assert all(contact.direction_ok for contact in judged.contacts)


@pytest.mark.parametrize(
    ("assumption", "truth"),
    [
        ("quick stop and fault brake with", "[arm]\nbrake_damping_Nm_s = [10.0, 2.0]"),
        ("link 1 mass", "[arm]\nmass_kg = [2.0, 1.0]"),
        ("joint stops at", "[arm]\nstop_deg = [100.0, 130.0]"),
        ("viscous friction", "[arm]\nviscous_Nm_s = [0.1, 0.05]"),
        ("Coulomb friction", "[arm]\ncoulomb_Nm = [0.1, 0.05]"),
        ("torque sensors of ±", "[sensors]\ntorque_range_Nm = [100.0, 50.0]"),
        ("their noise", "[sensors]\ntorque_noise_Nm = [0.02, 0.02]"),
        ("encoders of", "[sensors]\nencoder_bits = [18, 18]"),
        ("drives with a torque loop of", "[drives]\ncurrent_loop_Hz = [500.0, 500.0]"),
        ("stiff joints", "[mechanics]\nrotor_inertia_kg_m2 = [0.1, 0.01]"),
    ],
)
def test_each_assumption_is_a_line_and_goes_when_the_truth_has_the_value(
    folder: Path, assumption: str, truth: str
) -> None:
    (folder / "truth.toml").write_text(truth)
    config = str(folder / "my-arm.toml")
    assumed, known = (resolve(config, "paper", None, None, file).assumed for file in (None, str(folder / "truth.toml")))
    assert [assumption in line for line in assumed].count(True) == 1
    assert not any(assumption in line for line in known)


@pytest.mark.parametrize(
    ("truth", "said"),
    [
        ("wrong-rated-torque", "Drive2 (node 12): rated torque 0x6076 = 6400 mNm, 8000 mNm expected"),
        ("swapped-joints", "it is that of joint 2: the drives are exchanged; exchange `devices.drive_node`"),
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


TEN = "`mechanics.tilt_deg` = 'ten' must be of type float"


@pytest.mark.parametrize(
    ("scenario", "truth", "said"),
    [
        ("sensors = 3", "", "scenario wrong.toml: `sensors` = 3 must be a table"),
        ("sensors = 3", "sensors.encoder_bits = [18, 18]", "scenario wrong.toml: `sensors` = 3 must be a table"),
        ("", "mechanics = 3", "truth lie.toml: `mechanics` = 3 must be a table"),
        ("sensors.torque_range_Nm = 50.0", "", "scenario wrong.toml: `sensors.torque_range_Nm` = 50.0 must be a list"),
        ("mechanics.tilt_deg = 'ten'", "", f"scenario wrong.toml: {TEN}"),
        ("", "mechanics.tilt_deg = 'ten'", f"scenario wrong.toml with truth lie.toml: {TEN}"),
    ],
)
def test_a_wrong_section_of_a_scenario_or_truth_is_refused(folder: Path, scenario: str, truth: str, said: str) -> None:
    (folder / "wrong.toml").write_text(f"{scenario}\n")
    (folder / "lie.toml").write_text(f"{truth}\n")
    status, lines = rehearse(folder, "wrong", *(("--truth", "lie.toml") if truth else ()), scenario="wrong.toml")
    assert (status, lines.splitlines()[-1]) == (2, f"adacd-hil: {said}")


BODY = """
[arm]
link_length_m = [0.4, 0.25]
mass_kg = [2.0, 1.0]
center_m = [0.25, 0.1]
inertia_kg_m2 = [0.03, 0.006]
viscous_Nm_s = [0.02, 0.01]
coulomb_Nm = [0.3, 0.2]
cad_theta = [0.5, 0.02, 0.04, 0.0, 0.0, 0.0, 0.0]
"""


def composed(folder: Path, text: str, scenario: str = "idle", truth: str | None = None) -> tuple[Scenario, list[str]]:
    (folder / "mine.toml").write_text('extends = "certified"\n' + text)
    rehearsed = rehearse_file(str(folder / "mine.toml"), scenario, truth)
    return rehearsed.scenario, rehearsed.assumed


def test_the_masses_of_the_file_are_played_and_those_of_a_truth_in_their_place(tmp_path: Path) -> None:
    scenario, assumed = composed(tmp_path, BODY)
    (tmp_path / "heavier.toml").write_text("[arm]\nmass_kg = [3.0, 2.0]\ncoulomb_Nm = [0.5, 0.4]\n")
    truly, _ = composed(tmp_path, BODY, truth=str(tmp_path / "heavier.toml"))
    told, true = scenario.own_arm, truly.own_arm
    assert told is not None
    assert true is not None
    assert (told.mass_kg, told.center_m, told.inertia_kg_m2) == ((2.0, 1.0), (0.25, 0.1), (0.03, 0.006))
    assert (told.viscous_Nm_s, told.coulomb_Nm) == ((0.02, 0.01), (0.3, 0.2))
    assert not any("mass" in line or "friction" in line for line in assumed)
    assert (true.mass_kg, true.center_m, true.viscous_Nm_s) == ((3.0, 2.0), (0.2, 0.125), (0.02, 0.01))
    assert true.coulomb_Nm == (0.5, 0.4)


@pytest.mark.parametrize(("share", "rel"), [(0.0, 1e-4), (0.3, 1e-4), (0.97, 1e-4), (1.0, 0.02)])
def test_the_links_have_the_inertia_of_the_cad_model(share: float, rel: float, tmp_path: Path) -> None:
    theta = [0.2, math.sqrt(share * 0.16 * 0.04), 0.04]
    scenario, _ = composed(tmp_path, f"[arm]\nlink_length_m = [0.4, 0.25]\ncad_theta = {[*theta, 0, 0, 0, 0]}\n")
    alpha, beta, gamma = scenario.arm.inertia()
    assert [alpha + gamma, beta, gamma] == pytest.approx(theta, rel=rel)


def test_the_host_has_no_use_for_what_the_emulator_plays(tmp_path: Path) -> None:
    mine = tmp_path / "mine.toml"
    mine.write_text('extends = "certified"\n' + BODY)
    with_body = load_settings(str(mine))
    names = ("mass_kg", "center_m", "inertia_kg_m2", "viscous_Nm_s", "coulomb_Nm")
    without = dataclasses.replace(with_body, arm=dataclasses.replace(with_body.arm, **dict.fromkeys(names)))
    assert constants_of(with_body).tobytes() == constants_of(without).tobytes()
    assert new_memory(with_body).tobytes() == new_memory(without).tobytes()


def test_a_light_arm_is_not_thrown_and_has_sensors_of_its_size(tmp_path: Path) -> None:
    light = "[arm]\nlink_length_m = [0.25, 0.2]\nmass_kg = [0.2, 0.2]\nrated_torque_Nm = [2.0, 2.0]\n"
    scenario, _ = composed(tmp_path, light, "paper")
    model, _ = composed(tmp_path, "", "paper")
    gamma = scenario.arm.inertia()[2]
    torque_Nm = scenario.contacts[2].force_N * scenario.contacts[2].point_m
    model_Nm = model.contacts[2].force_N * model.contacts[2].point_m
    assert torque_Nm / gamma == pytest.approx(model_Nm / model.arm.inertia()[2])  # as fast as profile P
    assert scenario.sensors.torque_range_Nm == pytest.approx((25.0 / 3.0, 50.0 / 3.0))


def test_a_hand_guides_an_arm_of_half_the_size_to_a_place_in_its_reach() -> None:
    settings = load_settings("certified")
    arm = dataclasses.replace(settings.arm, link_length_m=(0.175, 0.15))  # profile P: 0.35 and 0.3 m
    told = ToldArm(dataclasses.replace(settings, arm=arm), frozenset({"arm.link_length_m"}))
    counts = DeviceCounts((0.0, 0.0), (100.0, 100.0), (1e-3, 1e-3), (0.0, 0.0))
    hand = {"link": 2, "point_m": 0.3, "move_to_m": [0.4, -0.2], "speed_m_s": 0.1}
    table, _ = compose_scenario(told, ArmTruth(), counts, {"hands": [hand]}, is_builtin=True)
    assert table["hands"] == [{**hand, "point_m": 0.15, "move_to_m": [0.2, -0.1]}]


def test_the_payload_of_a_heavy_arm_is_one_that_a_scenario_takes(tmp_path: Path) -> None:
    heavy = "[arm]\nlink_length_m = [0.6, 0.3]\nmass_kg = [40.0, 30.0]\nrated_torque_Nm = [900.0, 500.0]\n"
    scenario, _ = composed(tmp_path, heavy + "torque_limit_Nm = [900.0, 500.0]\n", "paper")
    assert scenario.payloads[0].mass_kg == 10.0


def with_count(folder: Path, kind: str, count: str) -> str:
    """Write a configuration whose device of joint 1 has this worth of a count."""
    shipped = {"drive": "stock-drive", "sensor": "int32-sensor"}[kind]
    (folder / "own.toml").write_text(f'extends = "{shipped}"\n[scale]\n{count}\n')
    mine = f'extends = "stock"\n[devices]\n{kind} = ["own.toml", "{shipped}"]\ncontract = ""\n'
    (folder / "my-arm.toml").write_text(mine)
    return str(folder / "my-arm.toml")


@pytest.mark.parametrize(
    ("kind", "count", "said"),
    [
        ("drive", "velocity_rad_s = 50.0", "Feedback has 2.86e+03 deg/s a count"),
        ("drive", "velocity_rad_s = 1e-9", "Feedback carries ±123 deg/s"),
        ("sensor", "torque_Nm = 2.0", "Torque has 2 Nm a count"),
    ],
)
def test_a_count_that_does_not_fit_the_arm_is_named(tmp_path: Path, kind: str, count: str, said: str) -> None:
    warnings = examine_configuration(with_count(tmp_path, kind, count)).warnings
    assert [said in line for line in warnings if "own.toml right?" in line] == [True]


@pytest.mark.slow
def test_a_velocity_beyond_its_counts_is_sent_as_the_largest_one(tmp_path: Path) -> None:
    with_count(tmp_path, "drive", "velocity_rad_s = 1e-12")
    (tmp_path / "short.toml").write_text(SHORT)
    status, said = rehearse(tmp_path, "played")
    assert status == 0, said
    moved = np.abs(load(tmp_path / "played" / "run.mcap")["dq"][:, 0]).max()
    assert moved == pytest.approx((2**31 - 1) * 1e-12)


def test_a_drive_whose_position_does_not_reach_the_arm_s_limit_is_named(tmp_path: Path) -> None:
    fine = 'extends = "stock-drive"\n[scale]\nincrements_per_joint_rev = 6553600000\n'  # ±118 deg in 32 bits
    (tmp_path / "fine.toml").write_text(fine)
    text = '[arm]\nposition_limit_deg = [115.0, 120.0]\n[devices]\ndrive = ["fine.toml", "fine.toml"]\ncontract = ""\n'
    (tmp_path / "mine.toml").write_text(text + 'sensor = ["int32-sensor", "int32-sensor"]\n')
    warnings = [line for line in examine_configuration(str(tmp_path / "mine.toml")).warnings if "carries" in line]
    assert [line.partition(" carries ±118 deg")[0] for line in warnings] == ["Drive2Feedback"]


def test_a_sensor_s_range_beyond_its_frame_or_below_the_rated_torque_is_named(tmp_path: Path) -> None:
    for name, range_Nm in (("wide", 30_000.0), ("small", 5.0)):
        text = f'extends = "int32-sensor"\n[plausibility]\ntorque_range_Nm = {range_Nm}\n'
        (tmp_path / f"{name}.toml").write_text(text)
    mine = 'extends = "stock"\n[devices]\nsensor = ["wide.toml", "small.toml"]\ncontract = ""\n'
    (tmp_path / "mine.toml").write_text(mine)
    wide, small = (line for line in examine_configuration(str(tmp_path / "mine.toml")).warnings if "_range_" in line)
    assert "wide.toml = 30000 Nm, Sensor1Torque carries ±2.15e+04 Nm" in wide
    assert "small.toml = 5 Nm is below `arm.rated_torque_Nm[1]` = 6 Nm" in small


def test_a_drive_whose_torque_is_in_no_frame_is_named(tmp_path: Path) -> None:
    stock = resources.files("adacd_hil").joinpath("device_profiles", "stock-drive.toml").read_text()
    torque = '    { object = "0x6077", signal = "torque_actual", unit = "permille" },\n'
    (tmp_path / "mute.toml").write_text(stock.replace(torque, ""))
    mine = 'extends = "stock"\n[devices]\ndrive = ["stock-drive", "mute.toml"]\ncontract = ""\n'
    (tmp_path / "mine.toml").write_text(mine)
    warnings = [line for line in examine_configuration(str(tmp_path / "mine.toml")).warnings if "TORQUE" in line]
    assert [line.partition(":")[0] for line in warnings] == ["no frame of Drive2 carries `torque_actual`"]


def test_a_sensor_whose_frames_carry_next_to_nothing_is_named(tmp_path: Path) -> None:
    config = with_count(tmp_path, "sensor", "torque_Nm = 1e-11")
    with pytest.raises(ConfigError, match=r"torque sensor 1 carry ±0\.0215 Nm, rated torque is 12 Nm: `torque_Nm`"):
        rehearse_file(config, "idle", None)
    assert any("Sensor1Torque carries ±0.0215 Nm" in line for line in examine_configuration(config).warnings)


@pytest.mark.parametrize(
    ("variant", "said"),
    [
        (EdsVariant().without("1A00"), "0x1A00 of [[pdo]] Feedback is not in"),
        (EdsVariant().without("1801"), "0x1801:1 of [[pdo]] Status is not in"),
        (EdsVariant().with_value("0x0003", "6064", key="DataType"), "0x6064 is INTEGER16 in"),
        (EdsVariant().with_value("0x0005", "6041", key="DataType"), "0x6041 is UNSIGNED8 in"),
        (EdsVariant().with_value("0x0007", "6040", key="DataType"), "0x6040 is UNSIGNED32 in"),
        (EdsVariant().with_value("0x0007", "6064", key="DataType"), "0x6064 is UNSIGNED32 in"),
        (EdsVariant().with_value("0", "6064", key="PDOMapping"), "fits no PDO: PDOMapping=0 in"),
        (EdsVariant().with_value("ro", "6071", key="AccessType"), "can't be written by a PDO"),
    ],
)
def test_a_drive_that_its_eds_lets_nobody_play_is_named(tmp_path: Path, variant: EdsVariant, said: str) -> None:
    variant.write(tmp_path / "odd.eds")
    stock = resources.files("adacd_hil").joinpath("device_profiles", "stock-drive.toml").read_text()
    (tmp_path / "odd.toml").write_text(stock.replace("stock_drive.eds", "odd.eds"))
    devices = 'drive = ["odd.toml", "odd.toml"]\nsensor = ["int32-sensor", "int32-sensor"]\n'
    (tmp_path / "my-arm.toml").write_text(OWN_ARM.replace("[devices]\n", f"[devices]\n{devices}"))
    (tmp_path / "short.toml").write_text(SHORT)
    status, error = rehearse(tmp_path, "played")
    assert status == 2
    assert said in error
    found = examine_configuration(str(tmp_path / "my-arm.toml")).errors
    assert any(said in line for line in found)  # the host needs them, too
