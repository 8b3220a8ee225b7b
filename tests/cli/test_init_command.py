"""`init` writes the configuration of one's own arm: from a bus, a URDF, a log, options, or answers on a terminal."""

import json
import math
import re
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from called import called, complaints
from click.testing import Result
from eds_variants import EdsVariant
from loaded import loaded_contract
from own_arm import eds_of_two_channels, write_sensor_eds
from rig import Rig, SessionRig

from adacd_hil.control.configuration_check import examine_configuration
from adacd_hil.device.device_files import load_profile
from adacd_hil.lab.commission.arm_draft import planar_from_urdf
from adacd_hil.lab.commission.host_checks import Status, configuration_checks, diagnose
from adacd_hil.lab.commission.profile_draft import DeviceRatings, draft_profile
from adacd_hil.lab.serial_arm.urdf import UrdfError
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.wire.bus import BusError
from adacd_hil.wire.dbc_contract import contract_folder, load_codec
from firmware_sim.cli.own_devices import rehearse

USAGE, BUS_MISSING = 2, 5
NO_BUS = ("--no-bus", "--yes")
URDF = """<robot name="lab">
  <link name="base"/>
  <link name="upper"><inertial><origin xyz="0.2 0 0"/><mass value="3"/>
    <inertia ixx="0" ixy="0" ixz="0" iyy="0.04" iyz="0" izz="0.04"/></inertial></link>
  <link name="lower"><inertial><origin xyz="0.13 0 0"/><mass value="1.5"/>
    <inertia ixx="0" ixy="0" ixz="0" iyy="0.015" iyz="0" izz="0.015"/></inertial></link>
  <link name="tip"/>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="{axis}"/>
    <limit lower="-1.2" upper="1.5" effort="20" velocity="3"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0.35 0 0"/>
    <axis xyz="{axis}"/><limit lower="-2" upper="2" effort="9" velocity="4"/></joint>
  <joint name="wrist" type="{wrist}"><parent link="lower"/><child link="tip"/><origin xyz="0.3 0 0"/>
    <axis xyz="{axis}"/><limit lower="-2" upper="2" effort="2" velocity="4"/></joint>
</robot>"""


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "lab" / "my-arm.toml"


def init(out: Path, *arguments: str, typed: str = "") -> Result:
    return called("init", out, *arguments, typed=typed)


def written(out: Path) -> Settings:
    """The settings of a file that has no error."""
    found = examine_configuration(str(out))
    assert found.errors == []
    assert found.settings is not None
    return found.settings


def urdf(folder: Path, axis: str = "0 0 1", wrist: str = "fixed") -> Path:
    path = folder / "lab.urdf"
    path.write_text(URDF.format(axis=axis, wrist=wrist))
    return path


def test_guesses_are_listed_and_doctor_asks_for_each(out):
    assert init(out, *NO_BUS, "--mass-kg", "1", "0.0005", "--length-m", "0.4", "0.25").exit_code == 0
    settings = written(out)
    assert settings.scheme == "certified"
    assert settings.arm.link_length_m == (0.4, 0.25)
    assert "arm.link_length_m" not in settings.assumed
    assert {"arm.rated_torque_Nm", "arm.sign", "arm.holding_torque_Nm", "devices.drive"} <= set(settings.assumed)
    findings = {one.name: one for one in diagnose(configuration_checks(settings), settings, lambda _: None)}
    assert findings["settings"].status is Status.OK
    for key in settings.assumed:
        assert findings[f"`{key}`"].status is Status.WARNING
    assert findings["`arm.holding_torque_Nm`"].reason.startswith("nothing is given: largest torque that brake")


def test_what_is_known_is_no_guess(out):
    known = ("--rated-torque-nm", "8", "4", "--torque-limit-nm", "7", "3", "--position-limit-deg", "50", "60")
    devices = ("--drive-node", "11", "12", "--sensor-node", "21", "22", "--drive", "stock-drive", "stock-drive")
    assert init(out, *NO_BUS, *known, *devices, "--sensor", "int32-sensor", "int32-sensor", "--flat").exit_code == 0
    settings = written(out)
    assert settings.arm.torque_limit_Nm == (7.0, 3.0)
    assert settings.devices.drive_node == (11, 12)
    assert settings.trajectory.amplitude_deg == (30.0, 48.0)
    guessed = ("link_length_m", "velocity_limit_deg_s", "sign", "holding_torque_Nm")
    assert set(settings.assumed) == {*(f"arm.{name}" for name in guessed), "controller.Kp", "controller.Kd"}


@pytest.mark.parametrize(
    ("options", "keys"),
    [
        (("--position-limit-deg", "1.3", "2.1"), ["arm.position_limit_deg", "trajectory.amplitude_deg"]),
        (("--rated-torque-nm", "8", "4", "--torque-limit-nm", "9", "3"), ["arm.torque_limit_Nm[0]"]),
        (("--rated-torque-nm", "8", "4", "--torque-limit-nm", "7", "3"), []),
    ],
)
def test_an_answer_that_config_check_doubts_is_doubted_at_once(out, options, keys):
    result = init(out, *NO_BUS, *options, "--json")
    assert result.exit_code == 0
    assert re.findall(r"^`([^`]+)`", "\n".join(json.loads(result.stdout)["warnings"]), re.MULTILINE) == keys


def test_doctor_without_a_bus_is_refused_before_anything_is_written_or_played(out):
    assert init(out, *NO_BUS, "--rehearse", "--doctor").exit_code == USAGE
    assert not out.parent.exists()


def test_a_file_that_is_there_is_replaced_by_force_alone(out):
    out.parent.mkdir()
    out.write_text("mine")
    assert init(out, *NO_BUS).exit_code == USAGE
    assert out.read_text() == "mine"
    assert init(out, *NO_BUS, "--force").exit_code == 0
    written(out)


def test_a_draft_that_can_t_be_written_whole_replaces_no_file(out):
    words = (*NO_BUS, "--eds", str(contract_folder() / "stock_drive.eds"))
    assert init(out, *words).exit_code == 0
    out.write_text("mine")
    profile = out.with_name("my-arm-stock_drive.toml")
    profile.unlink()
    profile.mkdir()
    refused = init(out, *words, "--force")
    assert refused.exit_code == 1
    assert f"{profile} can't be written: it is a folder" in refused.stderr
    assert out.read_text() == "mine"


def test_a_urdf_gives_lengths_masses_and_limits(tmp_path, out):
    assert init(out, *NO_BUS, "--urdf", str(urdf(tmp_path))).exit_code == 0
    settings = written(out)
    assert settings.arm.link_length_m == (0.35, 0.3)
    assert settings.arm.position_limit_deg == (68.75, 114.59)
    assert settings.arm.velocity_limit_deg_s == (171.89, 229.18)
    assert settings.arm.torque_limit_Nm == (20.0, 9.0)
    # Profile S of the emulator is that arm.
    theta = [0.040 + 3.0 * 0.04 + 1.5 * 0.1225 + 0.015 + 1.5 * 0.0169, 0.35 * 1.5 * 0.13, 0.015 + 1.5 * 0.0169]
    assert settings.arm.cad_theta[:3] == pytest.approx(theta, rel=1e-5)
    assert "arm.link_length_m" not in settings.assumed


@pytest.mark.parametrize(
    ("option", "doubted"),
    [
        (("--position-limit-deg", "68", "114"), []),
        (("--position-limit-deg", "70", "114"), ["`arm.position_limit_deg[0]` = 70 is above 68.75, the URDF's"]),
        (("--velocity-limit-deg-s", "170", "250"), ["`arm.velocity_limit_deg_s[1]` = 250 is above 229.18, the URDF's"]),
    ],
)
def test_a_limit_above_the_urdf_s_is_doubted(tmp_path, out, option, doubted):
    result = init(out, *NO_BUS, "--urdf", str(urdf(tmp_path)), *option, "--json")
    assert json.loads(result.stdout)["warnings"] == doubted


@pytest.mark.parametrize(
    ("axis", "root_rpy", "mounting", "mounting_deg"),
    [
        ("0 1 0", "0 0 0", (), (90.0, 90.0)),
        ("0 -1 0", "0 0 0", (), (90.0, -90.0)),
        ("0 1 0", "0 1.5707963 0", (), (90.0, 0.0)),
        ("0 0 1", "0.5 0 0", (), (28.65, -90.0)),
        ("0 1 0", "0 0 0", ("--mounting", "wall"), (90.0, 0.0)),
        ("0 0 1", "0 0 0", ("--mounting", "10"), (10.0, 0.0)),
        ("0 0 1", "0 0 0", ("--mounting", "180"), None),
    ],
)
def test_gravity_comes_from_the_root_of_the_urdf_and_its_mounting(
    tmp_path, out, axis, root_rpy, mounting, mounting_deg
):
    file = urdf(tmp_path, axis)
    text = file.read_text()
    shoulder = text[text.index('name="shoulder"') :]
    assert "<origin" not in shoulder[: shoulder.index("</joint>")]
    file.write_text(text.replace('<child link="upper"/>', f'<child link="upper"/><origin rpy="{root_rpy}"/>'))
    assert init(out, *NO_BUS, "--urdf", str(file), *mounting).exit_code == 0
    settings = written(out)
    assert settings.arm.mounting_deg == (None if mounting_deg is None else pytest.approx(mounting_deg, abs=0.01))
    assert settings.estimator.gravity == (mounting_deg is not None)
    share = 0.0 if mounting_deg is None else math.sin(math.radians(mounting_deg[0]))
    expected = (9.80665 * share * (3.0 * 0.2 + 1.5 * 0.35), 9.80665 * share * 1.5 * 0.13) if share else ()
    assert settings.arm.cad_theta[7:] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(
    ("options", "mounting_deg"),
    [
        (("--upright",), (90.0, -90.0)),
        (("--mounting", "floor"), (90.0, 180.0)),
        (("--mounting", "ceiling"), (90.0, 0.0)),
        (("--mounting", "wall", "--at-zero", "90"), (90.0, 90.0)),
        (("--mounting", "10", "--at-zero", "down"), (10.0, 0.0)),
        (("--flat",), None),
    ],
)
def test_words_say_how_an_arm_without_a_urdf_is_mounted(out, options, mounting_deg):
    assert init(out, *NO_BUS, "--length-m", "0.4", "0.25", "--mass-kg", "2", "1", *options).exit_code == 0
    settings = written(out)
    assert settings.arm.mounting_deg == mounting_deg
    assert settings.estimator.gravity == (mounting_deg is not None)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (('elbow" type="revolute', 'elbow" type="prismatic'), "a joint slides; both must turn"),
        (('elbow" type="revolute', 'elbow" type="fixed'), "1 joints move (shoulder), an arm has 2 here"),
        (('lower="-1.2"', 'lower="0.1"'), 'joint "shoulder": 0 is not within its limits'),
        (("0.35 0 0", "0 0 0.35"), "the two axes are the same line"),
        (('<mass value="3"/>', '<mass value="0"/>'), 'link "upper": an inertia without a mass'),
        (('xyz="0.13 0 0"/><mass', 'xyz="0 0 0"/><mass'), 'link "lower": mass 1.5 kg without inertia'),
        (('izz="0.04"', 'izz="400"'), 'link "upper", 0.35 m: an inertia of 400 kg m² with 3 kg'),
        (('xyz="0.13 0 0"/><mass', 'xyz="130 0 0"/><mass'), 'link "lower", 0.3 m: the centre of its mass is 130 m'),
    ],
)
def test_a_urdf_of_another_arm_or_with_a_mass_that_no_link_has_is_refused(change, line):
    text = URDF.format(axis="0 0 1", wrist="fixed").replace('"0.015"', '"0"')
    with pytest.raises(UrdfError) as caught:
        planar_from_urdf(text.replace(*change).encode())
    assert line in str(caught.value)


@pytest.mark.parametrize(
    ("change", "doubted"),
    [
        (('izz="0.04"', 'izz="0.3"'), []),
        (('izz="0.04"', 'izz="0.4"'), ['link "upper", 0.35 m: an inertia of 0.4 kg m²']),
        (('xyz="0.13 0 0"/><mass', 'xyz="1.3 0 0"/><mass'), ['link "lower", 0.3 m: the centre of its mass is 1.3 m']),
    ],
)
def test_a_mass_beyond_its_link_is_doubted(change, doubted):
    text = URDF.format(axis="0 0 1", wrist="fixed").replace(*change)
    found = planar_from_urdf(text.encode()).doubts
    assert [doubt[: len(line)] for doubt, line in zip(found, doubted, strict=True)] == doubted


def test_crossed_axes_are_refused_and_a_bent_zero_is_doubted():
    text = URDF.format(axis="0 0 1", wrist="fixed")
    crossed = text.replace('<axis xyz="0 0 1"/><limit lower="-2" upper="2" effort="9"', '<axis xyz="0 1 0"/><limit')
    with pytest.raises(UrdfError, match="90 deg apart"):
        planar_from_urdf(crossed.encode())
    bent = planar_from_urdf(text.replace('<origin xyz="0.13 0 0"/>', '<origin xyz="0 0.13 0"/>').encode())
    assert bent.zero_deg == (0.0, -90.0)  # q2 = 0 is the stretched arm
    assert bent.position_limit_deg == (68.75, 24.59)
    low = text.replace('<origin xyz="0.13 0 0"/>', '<origin xyz="-0.13 0.001 0"/>')
    (doubt,) = planar_from_urdf(low.encode()).doubts
    assert "180 deg off the line of link 1" in doubt


NO_EFFORT = 'lower="-1" upper="1" effort="0" velocity="3"'


def limited(text: str, limits: str) -> str:
    """A URDF whose joints all have these limits."""
    return re.sub("<limit [^/]*/>", f"<limit {limits}/>", text)


@pytest.mark.parametrize(
    "limits",
    [
        'lower="0" upper="0" effort="0" velocity="0"',
        NO_EFFORT,
        'lower="-1000" upper="1000" effort="1000000" velocity="10000"',
        'lower="-0.001" upper="0.001" effort="0.0001" velocity="0.0001"',
    ],
    ids=["zero", "no effort", "huge", "tiny"],
)
def test_an_arm_with_limits_that_say_nothing_is_drafted_with_guesses(limits, tmp_path, out):
    path = urdf(tmp_path)
    path.write_text(limited(path.read_text(), limits))
    assert init(out, *NO_BUS, "--urdf", str(path)).exit_code == 0
    assert "arm.torque_limit_Nm" in written(out).assumed


def test_a_limit_that_is_not_taken_is_named_with_its_bound():
    text = limited(URDF.format(axis="0 0 1", wrist="fixed"), NO_EFFORT.replace("3", "10000"))
    (doubt,) = planar_from_urdf(text.encode()).doubts
    assert "arm.velocity_limit_deg_s[0]` = 572957.8 deg/s is above 3600 deg/s" in doubt


def test_a_urdf_of_shapes_alone_says_how_the_masses_get_known(tmp_path, out):
    path = urdf(tmp_path)
    path.write_text(re.sub("<inertial>.*?</inertial>", "<visual/>", path.read_text(), flags=re.DOTALL))
    result = init(out, *NO_BUS, "--urdf", str(path))
    assert result.exit_code == 0
    warned = [line for line in result.stdout.splitlines() if "has no <inertial>" in line]
    assert [line.split('"')[1] for line in warned] == ["upper", "lower"]
    assert "--length-m and --mass-kg" in warned[0]
    assert written(out).arm.mass_kg is None


def test_masses_and_friction_of_a_urdf_are_for_the_emulator(tmp_path, out):
    path = urdf(tmp_path)
    path.write_text(path.read_text().replace("</joint>", '<dynamics damping="0.05" friction="0.1"/></joint>'))
    assert init(out, *NO_BUS, "--urdf", str(path)).exit_code == 0
    arm = written(out).arm
    assert (arm.mass_kg, arm.center_m, arm.inertia_kg_m2) == ((3.0, 1.5), (0.2, 0.13), (0.04, 0.015))
    assert (arm.viscous_Nm_s, arm.coulomb_Nm) == ((0.05, 0.05), (0.1, 0.1))
    played = rehearse(str(out), "idle").scenario.own_arm
    assert played is not None
    assert (played.mass_kg, played.coulomb_Nm) == ((3.0, 1.5), (0.1, 0.1))


@pytest.mark.parametrize(
    "limits",
    [("--velocity-limit-deg-s", "5", "5"), ("--velocity-limit-deg-s", "1", "1"), ("--torque-limit-nm", "0.1", "0.1")],
)
def test_an_arm_that_is_slow_or_weak_moves_less_and_within_bounds(out, limits):
    masses = ("--length-m", "0.6", "0.5", "--mass-kg", "10", "6", "--flat")
    result = init(out, *NO_BUS, *masses, *limits)
    assert result.exit_code == 0, result.stderr
    motion = written(out).trajectory
    assert max(motion.half_period_s) <= 60.0
    assert motion.amplitude_deg[0] < 30.0
    assert motion.amplitude_deg[1] == pytest.approx(2.0 * motion.amplitude_deg[0], rel=0.01)
    assert "learning it takes minutes" in result.stdout


def test_an_upright_arm_may_rest_on_its_brakes_and_swings_wide(out):
    arm = ("--mass-kg", "1.5", "1", "--length-m", "0.3", "0.3", "--upright")
    assert init(out, *NO_BUS, *arm, "--position-limit-deg", "90", "120").exit_code == 0
    settings, base = written(out), load_settings("certified")
    gravity_Nm = settings.arm.cad_theta[7] + settings.arm.cad_theta[8]
    assert settings.safety.rest_torque_Nm == pytest.approx(1.0 + 1.2 * gravity_Nm, rel=1e-3)
    assert "safety.rest_torque_Nm" not in settings.assumed
    assert settings.trajectory.amplitude_deg == (60.0, 60.0)
    assert settings.certified.enough_std[4] == 2.0 * base.certified.enough_std[4]
    narrow = init(out, *NO_BUS, *arm, "--position-limit-deg", "40", "120", "--force")
    assert "joint 1 may swing by ±32 deg only" in narrow.stdout
    assert init(out, *NO_BUS, "--upright", "--force").exit_code == 0
    assert "safety.rest_torque_Nm" in written(out).assumed


def test_the_scheme_s_numbers_and_the_motion_are_those_of_the_arm_s_masses(out):
    base = load_settings("certified")

    def of(*arm: str) -> Settings:
        assert init(out, *NO_BUS, *arm, "--force").exit_code == 0
        return written(out)

    alike = of("--mass-kg", "1.5", "0.75")
    assert (alike.certified, alike.detector) == (base.certified, base.detector)
    light = of("--mass-kg", "0.2", "0.2", "--length-m", "0.25", "0.2", "--rated-torque-nm", "2", "2")
    assert light.certified.residual_Nm == pytest.approx(base.certified.residual_Nm / 3.0, rel=1e-3)
    assert light.certified.enough_std[5] == base.certified.enough_std[5]
    assert light.certified.excitation_Nm2s < base.certified.excitation_Nm2s
    assert light.detector.collision_Nm == (0.3333, 0.3333)
    heavy = of("--mass-kg", "8", "8", "--length-m", "0.6", "0.5", "--rated-torque-nm", "150", "150")
    assert heavy.certified.beta_Nm == pytest.approx(12.5 * base.certified.beta_Nm, rel=1e-3)
    assert heavy.certified.prior_std[0] > 2.0 * heavy.arm.cad_theta[0]
    assert heavy.certified.excitation_Nm2s == base.certified.excitation_Nm2s
    assert heavy.detector.collision_Nm == base.detector.collision_Nm  # never less careful than the base
    weak = of("--length-m", "0.6", "0.5", "--mass-kg", "8", "5")
    assert weak.excitation.period_s > 2.0 * base.excitation.period_s
    assert weak.controller.Kp[0] > 10.0 * base.controller.Kp[0]
    assert weak.certified.prior_std[0] == pytest.approx(2.0 * weak.arm.cad_theta[0], rel=1e-3)


def test_three_joints_are_two_when_one_is_locked(tmp_path, out):
    path = str(urdf(tmp_path, wrist="revolute"))
    assert init(out, *NO_BUS, "--urdf", path, "--lock", "wrist").exit_code == 0


def test_profiles_are_drafted_from_eds_files_beside_the_configuration(out, tmp_path, monkeypatch):
    eds = [str(contract_folder() / name) for name in ("stock_drive.eds", "int32_sensor.eds")]
    result = init(out, *NO_BUS, "--eds", eds[0], "--eds", eds[1])
    assert result.exit_code == 0
    assert "torque_Nm = 1e-06: the worth of a count is in the data sheet" in result.stdout
    names = {path.name for path in out.parent.iterdir()} - {"my-arm.toml", "stock_drive.eds", "int32_sensor.eds"}
    assert names == {"my-arm-stock_drive.toml", "my-arm-int32_sensor.toml"}
    settings = written(out)
    assert "devices.sensor" in settings.assumed
    assert "devices.drive" not in settings.assumed
    # The built-in profiles of these devices are the oracle, but for the worth of a count of torque.
    sensor = out.parent / "my-arm-int32_sensor.toml"
    sensor.write_text(sensor.read_text().replace("torque_Nm = 1e-06", "torque_Nm = 1e-05"))
    monkeypatch.chdir(tmp_path)  # the profiles are found from anywhere
    drafted, stock = (loaded_contract(load_settings(name)) for name in ("lab/my-arm.toml", "stock"))
    assert drafted.layout_digest == stock.layout_digest


@pytest.mark.parametrize(
    ("given", "stated"),
    [
        ("prof/own.toml", "../prof/own.toml"),
        ("lab/own.toml", "own.toml"),
        ("lab/prof/own.toml", "prof/own.toml"),
        ("prof/own", "{there}/prof/own"),
    ],
)
def test_a_profile_is_found_by_the_file_wherever_both_are(out, tmp_path, monkeypatch, given, stated):
    own = tmp_path / given
    own.parent.mkdir(parents=True)
    own.with_name("base.toml").write_text('extends = "stock-drive"\nassumed = ["scale.gear_ratio"]\n')
    own.write_text('extends = "base.toml"\n')
    monkeypatch.chdir(tmp_path)
    done = init(Path("lab/my-arm.toml"), *NO_BUS, "--json", "--drive", given, given)
    assert done.exit_code == 0, done.stderr
    assert f"{own.name}: scale.gear_ratio" in json.loads(done.stdout)["assumed"]
    assert f'drive = ["{stated.format(there=tmp_path)}", ' in out.read_text()
    monkeypatch.chdir("/")
    assert [Path(name).resolve() for name in written(out).devices.drive] == [own, own]


def test_an_eds_beside_named_profiles_of_its_kind_is_refused(out):
    words = ("--eds", str(contract_folder() / "stock_drive.eds"), "--drive", "maxon-epos4", "maxon-epos4")
    refused = init(out, *NO_BUS, *words)
    assert refused.exit_code == USAGE
    assert "stock_drive.eds is of a drive, and --drive names" in refused.stderr
    assert not out.parent.exists()


def test_two_eds_of_a_kind_are_of_joint_1_and_2_and_more_or_namesakes_are_refused(out, tmp_path):
    for name in ("a", "b", "c"):
        (tmp_path / name).mkdir()
        shutil.copy(contract_folder() / "stock_drive.eds", tmp_path / name / f"{name}.eds")
    (tmp_path / "b" / "a.eds").write_text((tmp_path / "a" / "a.eds").read_text() + "\n")
    first, second, third, namesake = (str(tmp_path / name) for name in ("a/a.eds", "b/b.eds", "c/c.eds", "b/a.eds"))
    assert init(out, *NO_BUS, "--eds", first, "--eds", second).exit_code == 0
    assert [Path(name).name for name in written(out).devices.drive] == ["my-arm-a.toml", "my-arm-b.toml"]
    for eds in ((first, namesake), (first, second, third)):
        refused = init(tmp_path / "another" / "arm.toml", *NO_BUS, *[word for one in eds for word in ("--eds", one)])
        assert refused.exit_code == USAGE
    assert not (tmp_path / "another").exists()


def test_one_eds_handed_for_each_joint_gives_each_its_own_gear(out, tmp_path):
    eds = EdsVariant().write(tmp_path / "drive.eds")
    for again in (eds, tmp_path / "." / "lab" / ".." / "drive.eds"):
        words = ("--eds", str(eds), "--eds", str(again), "--gear", "30", "50")
        assert init(out, *NO_BUS, *words, "--force").exit_code == 0
        profiles = [load_profile(str(out.parent / name), "drive") for name in written(out).devices.drive]
        assert [profile.settings.scale.gear_ratio for profile in profiles] == [30.0, 50.0]


@pytest.mark.parametrize(("outer_kg", "is_warned"), [("1", False), ("4", True)])
def test_gains_that_are_too_fast_for_a_heavy_outer_link_are_named(out, outer_kg, is_warned):
    done = init(out, *NO_BUS, "--flat", "--length-m", "0.3", "0.3", "--mass-kg", "0.4", outer_kg)
    assert done.exit_code == 0, done.stderr
    assert ("the arm may vibrate" in done.stdout) is is_warned


def test_the_guessed_worth_of_a_count_lets_16_bits_carry_a_joint_s_torque(tmp_path, out):
    assert init(out, *NO_BUS, "--eds", str(write_sensor_eds(tmp_path))).exit_code == 0
    assert "devices.sensor" in written(out).assumed
    warned = examine_configuration(str(out)).warnings
    assert not any("carries" in line for line in warned)
    (signal,) = loaded_contract(written(out)).message("Sensor1Torque").values
    assert (signal.bits, signal.scale) == (16, 2e-3)


def test_a_given_count_of_torque_is_no_guess(tmp_path, out):
    (tmp_path / "twin.eds").write_text(eds_of_two_channels())
    given = init(out, *NO_BUS, "--eds", str(tmp_path / "twin.eds"), "--torque-count-nm", "1e-5", "2e-5")
    assert given.exit_code == 0, given.stderr
    assert "devices.sensor" not in written(out).assumed
    contract = loaded_contract(written(out))
    scales = [[signal.scale for signal in contract.message(f"Sensor{joint}Torque").values] for joint in (1, 2)]
    assert scales == [[1e-5, 1.0], [2e-5, 1.0]]  # the second channel is in counts: nobody told their worth


def test_what_the_device_says_outweighs_the_eds():
    read = {(0x6131, 1): 0x00560100, (0x6132, 1): 4}  # in Nm, four decimals
    draft = draft_profile(contract_folder() / "int32_sensor.eds", DeviceRatings(read))
    assert draft.guesses == ()
    assert "torque_Nm = 0.0001\n" in draft.text


@pytest.fixture
def on_bus(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Rig]:
    """Let `init` open the bus of a rig, in its time."""

    def attach(**parts: object) -> Rig:
        rig = Rig(is_wall=True, **parts)  # type: ignore[arg-type]
        monkeypatch.setattr("adacd_hil.cli.connection.open_bus", lambda *_: rig.bus)
        monkeypatch.setattr("adacd_hil.lab.cli.arm_drafting.MonotonicClock", lambda: rig.clock)
        return rig

    return attach


BUS = ("-i", "virtual", "-c", "lab", "--yes")


def test_devices_are_recognised_with_their_ratings_and_no_drive_is_enabled(out, on_bus):
    rig = on_bus()
    result = init(out, *BUS, "--json")
    assert result.exit_code == 0
    assert json.loads(result.stdout)["drive"] == ["adacd-drive", "adacd-drive"]
    settings = written(out)
    assert settings.devices.drive_node == (1, 2)
    assert settings.devices.sensor == ("adacd-sensor", "adacd-sensor")
    assert settings.arm.rated_torque_Nm == (12.0, 6.0)
    assert "arm.rated_torque_Nm" not in settings.assumed
    assert loaded_contract(settings).layout_digest == load_codec().layout_digest
    # SDO uploads only: no NMT command, no SYNC, no command, no download.
    assert {frame.can_id & 0x780 for frame in rig.sent} == {0x600}
    assert {frame.data[0] & 0xE0 for frame in rig.sent} <= {0x40, 0x60, 0x80}


def test_a_bus_that_fails_has_the_status_of_a_missing_one(out, on_bus):
    def fail(*_: object) -> None:
        raise BusError("lab is gone")

    on_bus().bus.receive = fail
    result = init(out, *BUS)
    assert (result.exit_code, out.exists()) == (BUS_MISSING, False)
    assert result.stderr.splitlines()[-1].endswith("lab is gone")


@pytest.mark.parametrize(
    ("contract", "drive"), [("arm_fd", "adacd-drive-fd"), ("arm_fd_500us", "adacd-drive-fd-500us")]
)
def test_the_frames_of_the_devices_tell_profiles_apart(out, on_bus, contract, drive):
    on_bus(codec=load_codec(contract_folder() / f"{contract}.dbc"))
    assert init(out, *BUS).exit_code == 0
    settings = written(out)
    assert settings.devices.drive == (drive, drive)
    assert settings.bus.period_us == (500 if contract.endswith("500us") else 1000)
    assert loaded_contract(settings).layout_digest == load_codec(contract_folder() / f"{contract}.dbc").layout_digest


@pytest.mark.parametrize(
    ("silent", "options", "status", "line"),
    [
        (4, (), BUS_MISSING, "lab: sensors that answer: 3; an arm has two"),
        (0, ("--drive-node", "1", "3"), USAGE, "node 3 of --drive-node is no drive that answers; there are 1 2"),
    ],
)
def test_a_device_that_is_missing_or_no_drive_is_named(out, on_bus, silent, options, status, line):
    rig = on_bus()
    if silent:
        rig.silence(silent)
    result = init(out, *BUS, *options)
    assert result.exit_code == status
    (complaint,) = complaints(result)
    assert line in complaint
    assert not out.exists()


def test_a_log_gives_its_arm_without_its_user(tmp_path, out):
    config = tmp_path / "arm.toml"
    config.write_text(
        'extends = "certified"\nassumed = ["arm.sign", "arm.holding_torque_Nm", "devices.drive"]\n'
        "[arm]\nlink_length_m = [0.4, 0.25]\n"
        "torque_limit_Nm = [9, 4]\ncad_theta = []\n[operator]\nacknowledge_after_s = 0.6\n"
        'script = [{ at_s = 0.3, request = "finish" }]\n'
    )
    own = load_settings(str(config))
    SessionRig(tmp_path / "run", own).session.run()
    result = init(out, "--from", str(tmp_path / "run"))
    assert result.exit_code == 0
    assert "the scripted user is left out" in result.stdout
    settings = written(out)
    for name in ("link_length_m", "torque_limit_Nm", "cad_theta"):
        assert getattr(settings.arm, name) == getattr(own.arm, name)
    assert set(settings.assumed) == set(own.assumed)
    assert (settings.operator.acknowledges, settings.operator.script) == (False, ())
    assert init(out, "--from", str(tmp_path / "run"), "--drive", *["adacd-drive"] * 2, "--force").exit_code == 0
    assert written(out).assumed == ("arm.sign", "arm.holding_torque_Nm")
    lines = out.read_text().splitlines()
    assert "run.mcap" not in lines[lines.index('drive = ["adacd-drive", "adacd-drive"]') - 1]


def test_what_is_no_log_gives_no_arm(tmp_path, out):
    for name, status, line in (("arm.toml", USAGE, "--config"), ("none.mcap", 1, "none.mcap"), ("no.mcap", 1, "empty")):
        (tmp_path / name.replace("none", "other")).touch()
        refused = init(out, "--from", str(tmp_path / name))
        assert (refused.exit_code, out.exists()) == (status, False)
        (complaint,) = complaints(refused)
        assert line in complaint


def test_on_a_terminal_everything_is_asked_and_wrong_answers_again(out, monkeypatch):
    monkeypatch.setattr("adacd_hil.lab.cli.interview.is_terminal", lambda: True)
    monkeypatch.setattr("adacd_hil.wire.can_interface.can_interfaces", list)
    answers = [
        "none",
        "-",
        "350 300",  # mm
        "0.4, 0.25",
        "floor",
        "90 down",  # no word, no number
        "",  # link 1 at q1 = 0: up, as usual on the floor
        "2 1",
        "",  # rated torque: as proposed
        "10 5",
        "60 a",  # no number
        "60 100",
        "",
        "n",  # no rehearsal
    ]
    result = init(out, typed="\n".join(answers) + "\n")
    assert result.exit_code == 0, result.stderr
    assert "350 mm are 0.35 m" in result.stderr
    assert "must be two numbers" in result.stderr
    settings = written(out)
    assert settings.arm.link_length_m == (0.4, 0.25)
    assert settings.arm.torque_limit_Nm == (10.0, 5.0)
    assert settings.arm.position_limit_deg == (60.0, 100.0)
    assert settings.arm.mounting_deg == (90.0, 180.0)
    assert "gravity ←: the arm points up" in result.stderr
    friction = (0.0,) * 4
    outer = (0.4 * 0.125, 0.0625 / 3.0)  # of 1 kg, 0.25 m long, at the end of 2 kg, 0.4 m long
    weights = (9.80665 * (2.0 * 0.2 + 0.4), 9.80665 * 0.125)
    theta = (2.0 * 0.16 / 3.0 + 0.16 + 0.0625 / 3.0, *outer, *friction, *weights)
    assert settings.arm.cad_theta == pytest.approx(theta, rel=1e-4)
    assert "arm.rated_torque_Nm" in settings.assumed
    assert "arm.torque_limit_Nm" not in settings.assumed


def test_a_question_mark_and_a_mistyped_path_lose_no_answer(tmp_path, out, monkeypatch):
    monkeypatch.setattr("adacd_hil.lab.cli.interview.is_terminal", lambda: True)
    monkeypatch.setattr("adacd_hil.wire.can_interface.can_interfaces", list)
    eds = EdsVariant().without("6091", "608F").write(tmp_path / "drive.eds")
    answers = [
        "?",
        "none",
        "?",
        "fity fity",
        "50 50",  # gear
        "0.8 0.8",
        "?",
        "204800 204800",
        "parsec",
        "rpm",
        str(tmp_path / "lap.urdf"),
        str(urdf(tmp_path)),
        *[""] * 5,
        "n",
    ]
    result = init(out, "--eds", str(eds), typed="\n".join(answers) + "\n")
    assert result.exit_code == 0, result.stderr
    assert "1 without a gear; --gear A B answers it, too; Enter takes 1 1: a guess" in result.stderr
    assert "'parsec' must be one of increment/s, rpm" in result.stderr
    assert "lap.urdf does not exist" in result.stderr
    scale = load_profile(str(out.parent / "my-arm-drive.toml"), "drive").settings.scale
    assert (scale.gear_ratio, scale.gear_efficiency, scale.increments_per_joint_rev) == (50.0, 0.8, 204800.0)
    assert scale.velocity_rad_s == pytest.approx(np.pi / 30.0 / 50.0)
    assert written(out).arm.link_length_m == (0.35, 0.3)


def test_who_ends_the_questions_gets_no_file(out, monkeypatch):
    monkeypatch.setattr("adacd_hil.lab.cli.interview.is_terminal", lambda: True)
    result = init(out, typed="none\n")
    assert result.exit_code != 0
    assert not out.exists()


@pytest.mark.slow
def test_init_ends_with_the_commands_up_to_the_first_run_of_which_tare_is_one(tmp_path):
    out = tmp_path / "my lab" / "my-arm.toml"
    result = init(out, *NO_BUS, "--length-m", "0.4", "0.25", "--mass-kg", "2", "1", "--flat")
    assert result.exit_code == 0, result.stderr
    typed = [shlex.split(line.removeprefix("next:"), comments=True) for line in result.stderr.splitlines()[-4:]]
    assert [words[1] for words in typed] == ["demo", "doctor", "tare", "run"]
    arm = ["-i", "socketcan", "-c", "can0", "--config", str(out)]
    assert typed[2][2:] == [*arm, "--out", str(out.with_name("tare.toml"))]
    assert typed[3][2:] == [*arm, "--tare", str(out.with_name("tare.toml"))]
    assert f"`adacd-hil config check {shlex.quote(str(out))}`" in out.read_text()
