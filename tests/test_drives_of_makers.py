"""`init` writes of an EDS what `demo` plays: drives that lack objects, count in other units, keep other orders."""

import math
import re
from pathlib import Path

import pytest
from called import called
from click.testing import Result
from eds_variants import EdsVariant

from adacd_hil.api import load
from adacd_hil.cli.embedded_run import resolve, run_embedded
from adacd_hil.cli.output import ExitCode, exit_code
from adacd_hil.device.device_files import load_profile
from adacd_hil.log.log_walk import attachment
from adacd_hil.log.reader import read_log
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.setting_keys import apply_settings

pytestmark = pytest.mark.slow

SHORT = "lasts_s = 0.1\n"
LENGTHS = ("--no-bus", "--length-m", "0.4", "0.25", "--mass-kg", "2", "1", "--flat", "--yes")
RPM = 0x00B44700
RECEIVED, SENT = ("1400", "1401", "1402", "1403"), ("1800", "1801", "1802", "1803")
FIXED_COMMAND = (0x60400010, 0x60710010, 0x60600008)


def every(sub: int, *records: str) -> list[str]:
    return [f"{record}sub{sub}" for record in records]


def fixed_pdos() -> EdsVariant:
    """A drive with a read-only mapping; its command frame has the mode."""
    eds = EdsVariant()
    mapped = {"1600": FIXED_COMMAND, "1A00": (0x60640020, 0x606C0020), "1A01": (0x60410010, 0x60770010)}
    for record, entries in mapped.items():
        eds.with_value(len(entries), f"{record}sub0")
        for sub, entry in enumerate(entries, start=1):
            eds.with_value(f"0x{entry:08X}", f"{record}sub{sub}")
    for record in ("1600", "1601", "1602", "1603", "1A00", "1A01", "1A02", "1A03"):
        eds.with_value("const", *(f"{record}sub{sub}" for sub in range(9)), key="AccessType")
    eds.with_value("$NODEID+0x200", "1400sub1").with_value("$NODEID+0x180", "1800sub1")
    return eds.with_value("$NODEID+0x280", "1801sub1").with_value(1, "1400sub2", "1800sub2")


KINDS = {
    "the least that an EDS may have": EdsVariant().without(
        *("1006", "1014", "1015", "1016", "1019", "6060", "6061", "6076"), *every(5, *SENT), *every(5, *RECEIVED)
    ),
    "a counter without a period, mode and error code in no frame, 2000 increments": EdsVariant()
    .without("1006")
    .with_value(0, "603F", "6061", key="PDOMapping")
    .with_value(2000, "608Fsub1")
    .with_value(1, "6091sub1"),
    "identifiers that can't be written, velocity in rpm": EdsVariant()
    .with_value("ro", *every(1, "1400", "1800", "1801"), key="AccessType")
    .with_value("$NODEID+0x200", "1400sub1")
    .with_value("$NODEID+0x180", "1800sub1")
    .with_value("$NODEID+0x280", "1801sub1")
    .with_object("60A9", RPM),
    "room for two objects in a frame, rated torque in millionths": EdsVariant()
    .without(*(f"{record}sub{sub}" for record in ("1600", "1A00", "1A01") for sub in range(3, 9)))
    .with_value(380_000, "6076")
    .with_value(30, "6091sub1"),
    "a gear of 169 : 6 behind an encoder that the EDS leaves open": EdsVariant()
    .with_value(169, "6091sub1")
    .with_value(6, "6091sub2")
    .with_value("", "608Fsub1"),
    "one increment from the factory": EdsVariant().with_value(1, "608Fsub1", "6091sub1"),
    "fixed mapping with the mode in it": fixed_pdos(),
}


def init(folder: Path, *words: str) -> Result:
    return called("init", str(folder / "my-arm.toml"), *LENGTHS, *words)


def rehearse(folder: Path) -> ExitCode:
    """Play 0.1 s of the arm; return the exit status."""
    (folder / "short.toml").write_text(SHORT)
    cast = resolve(str(folder / "my-arm.toml"), str(folder / "short.toml"), None, None)
    return exit_code(run_embedded(cast, "lockstep", folder / "run")[0])


@pytest.mark.parametrize("kind", KINDS)
def test_a_drive_from_its_eds_is_rehearsed(tmp_path: Path, kind: str) -> None:
    written = init(tmp_path, "--eds", str(KINDS[kind].write(tmp_path / "drive.eds")))
    assert written.exit_code == 0, written.stderr
    assert rehearse(tmp_path) == ExitCode.OK


def test_an_eds_of_any_encoding_is_read_to_the_same_profile(tmp_path: Path) -> None:
    text = EdsVariant().write(tmp_path / "plain.eds").read_text()
    profiles = set()
    for name, head, encoding in (
        ("drive.eds", "; Gr\u00f6\u00dfe in \u00b5Nm\r\n", "latin-1"),
        ("drive.eds", "", "utf-8-sig"),
        ("DRIVE.EDS", "", "ascii"),
    ):
        folder = tmp_path / encoding
        folder.mkdir()
        (folder / name).write_text(head + text, encoding=encoding)
        written = init(folder, "--eds", str(folder / name))
        assert written.exit_code == 0, written.stderr
        (profile,) = folder.glob("my-arm-*.toml")
        profiles.add(profile.read_text().replace(name, ""))
    assert len(profiles) == 1


def test_a_drive_whose_eds_names_no_profile_is_told_to_be_one(tmp_path: Path) -> None:
    eds = str(EdsVariant().with_value("", "1000").write(tmp_path / "drive.eds"))
    refused = init(tmp_path, "--eds", eds)
    assert refused.exit_code == ExitCode.USAGE
    assert f"--drive-eds {eds}" in refused.stderr
    assert init(tmp_path, "--drive-eds", eds).exit_code == 0


def test_what_an_eds_omits_is_made_up_and_said(tmp_path: Path) -> None:
    eds = EdsVariant().without("1006", "6076").write(tmp_path / "drive.eds")
    assert init(tmp_path, "--eds", str(eds)).exit_code == 0
    assert (
        "assumed: 0x1006 (SYNC period), 0x6076 (rated torque), which drive.eds omits and every such device has"
        in resolve(str(tmp_path / "my-arm.toml"), "idle", None, None).assumed
    )


@pytest.mark.parametrize(("name", "gears"), [("maxon-epos4", ("--gear", "50", "30")), ("zeroerr-erob", ())])
def test_a_shipped_profile_is_rehearsed(tmp_path: Path, name: str, gears: tuple[str, ...]) -> None:
    written = init(tmp_path, "--drive", name, name, *gears)
    assert written.exit_code == 0, written.stderr
    drives = load_settings(str(tmp_path / "my-arm.toml")).devices.drive
    named = [load_profile(str(tmp_path / drive) if gears else drive, "drive").settings for drive in drives]
    assert [one.scale.gear_ratio for one in named] == ([50.0, 30.0] if gears else [named[0].scale.gear_ratio] * 2)
    assert ("scale.gear_ratio" in named[0].assumed) == (not gears)
    assert rehearse(tmp_path) == ExitCode.OK


def test_an_eds_of_a_known_maker_is_read_with_what_is_known_of_it(tmp_path: Path) -> None:
    eds = EdsVariant("maxon_epos4.eds").with_value(512871, "6076").write(tmp_path / "drive.eds")
    assert init(tmp_path, "--eds", str(eds), "--gear", "26", "26").exit_code == 0
    profile = load_profile(str(tmp_path / "my-arm-drive.toml"), "drive").settings
    assert 512871 * profile.scale.joint_torque_Nm == pytest.approx(13.3346, rel=1e-5)
    assert profile.scale.velocity_rad_s == pytest.approx(math.pi / 30.0 / 26.0)
    assert profile.patience.pause_ms == 15.0
    assert set(profile.assumed) == {"scale.gear_efficiency", "scale.increments_per_joint_rev"}


# -- an arm whose motors are behind gears

GEARED = EdsVariant().with_value(380_000, "6076").with_value(30, "6091sub1")
"""0.38 Nm in µNm behind a gear of 30: 11.4 Nm at the joint."""


@pytest.fixture(scope="module")
def geared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("geared")
    drive = GEARED.write(folder / "drive.eds")
    known = ("--rated-torque-unit", "µNm", "--gear-efficiency", "1", "1", "--velocity-unit", "increment/s")
    written = init(folder, "--eds", str(drive), *known)
    assert written.exit_code == 0, written.stderr
    assert not any("rated_torque" in line for line in written.stdout.splitlines() if line.startswith("guesses"))
    return folder


def play(geared: Path, folder: Path, gear: tuple[float, float], lasts_s: float, scenario: str = "") -> list[str]:
    """Play an arm whose gears differ by factors from the profile's; return the log's events."""
    (folder / "truth.toml").write_text(f"[factor]\ngear = {list(gear)}\n")
    (folder / "scenario.toml").write_text(f"lasts_s = {lasts_s}\n{scenario}")
    files = str(folder / "scenario.toml"), None, None, str(folder / "truth.toml")
    cast = resolve(str(geared / "my-arm.toml"), *files)
    settings = apply_settings(cast.settings, {"safety.phase_timeout_s": "1.0"})
    run_embedded(cast._replace(settings=settings), "lockstep", folder / "run")
    return [event.message for event in load(folder / "run").events]


def test_the_torque_of_a_geared_arm_is_the_joint_s(geared: Path, tmp_path: Path) -> None:
    arm = load_settings(str(geared / "my-arm.toml")).arm
    assert arm.rated_torque_Nm == pytest.approx((11.4, 11.4))
    said = play(geared, tmp_path, (1.0, 1.0), 4.0)
    assert any("CERTIFY -> MONITOR" in line for line in said)
    ratios = [float(found) for line in said for found in re.findall(r"measures ([\d.]+) .*times the commanded", line)]
    assert ratios == pytest.approx([1.0, 1.0], abs=0.02)
    profile = attachment(tmp_path / "run" / "run.mcap", "Drive1.toml")
    assert profile is not None
    assert b"gear_ratio = 30.0" in profile


@pytest.mark.parametrize(
    ("gear", "joint", "least", "most"),
    [
        ((1.2, 1.0), 1, 1.15, 1.25),
        ((1.0 / 1.2, 1.0), 1, 0.79, 0.87),
        ((1.0, 26.0), 2, 15.0, 35.0),
        ((1.0, 1.0 / 26.0), 2, 0.02, 0.06),
    ],
)
def test_a_gear_that_is_told_wrong_is_named(
    geared: Path, tmp_path: Path, gear: tuple[float, float], joint: int, least: float, most: float
) -> None:
    said = play(geared, tmp_path, gear, 2.7)
    named = [line for line in said if f"scale.gear_ratio = 30 of devices.drive[{joint - 1}]" in line]
    assert named, said
    (number,) = re.findall(rf"joint {joint}: its torque sensor measures \+?([\d.]+) ", named[0])
    assert least <= float(number) <= most
    assert not any("CERTIFY -> MONITOR" in line for line in said)


def test_a_wrong_gear_of_an_arm_that_is_not_at_zero_is_named_before_it_moves(geared: Path, tmp_path: Path) -> None:
    said = play(geared, tmp_path, (26.0, 1.0), 1.5, "start_deg = [-30.0, -60.0]\n")
    (line,) = [line for line in said if "COMMISSION -> FAULT" in line]
    assert "joint 1: position -780" in line
    assert "scale.gear_ratio" in line


def test_a_gear_that_contradicts_the_drive_is_refused_before_anything_moves(geared: Path, tmp_path: Path) -> None:
    for path in geared.glob("*.*"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    profile = tmp_path / "my-arm-drive.toml"
    profile.write_text(profile.read_text().replace("gear_ratio = 30", "gear_ratio = 36"))
    checked = called("config", "check", str(tmp_path / "my-arm.toml"))
    assert "Drive1: `scale.gear_ratio` = 36, 0x6091 = 30 by the EDS: correct it, or" in checked.stdout
    cast = resolve(str(tmp_path / "my-arm.toml"), "idle", None, None)
    summary, _ = run_embedded(cast, "lockstep", tmp_path / "run")
    assert "0x6076 = 380000 µNm, 316667 µNm expected of a motor behind a gear of 36" in summary.error
    assert "scale.gear_ratio" in summary.error


def test_exchanged_drives_behind_different_gears_are_called_so(tmp_path: Path) -> None:
    assert init(tmp_path, "--drive", "maxon-epos4", "maxon-epos4", "--gear", "50", "30").exit_code == 0
    cast = resolve(str(tmp_path / "my-arm.toml"), "idle", None, None, "swapped-drives")
    summary, _ = run_embedded(cast, "lockstep", tmp_path / "run")
    assert "0x6076 = 200000 µNm, 240000 µNm expected of a motor behind a gear of 50" in summary.error
    assert "it is that of joint 2: the drives are exchanged" in summary.error


def test_the_documented_example_has_the_documented_numbers(tmp_path: Path) -> None:
    eds = str(Path(__file__).parents[1] / "docs" / "examples" / "drive.eds")
    known = ("--gear", "30", "30", "--gear-efficiency", "0.8", "0.8", "--increments", "122880", "122880")
    assert init(tmp_path, "--eds", eds, *known, "--rated-torque-unit", "µNm").exit_code == 0
    scale = load_profile(str(tmp_path / "my-arm-drive.toml"), "drive").settings.scale
    assert scale.velocity_rad_s == pytest.approx(math.pi / 30.0 / 30.0)
    assert (scale.increments_per_joint_rev, scale.rated_torque_count_Nm) == (122880.0, 1e-6)
    assert load_settings(str(tmp_path / "my-arm.toml")).arm.rated_torque_Nm == pytest.approx((9.12, 9.12))


def fixed_mode(mode: int) -> EdsVariant:
    eds = EdsVariant().with_value("ro", "6060", key="AccessType").with_value(mode, "6060", "6061")
    return eds.with_value(0, "6061", key="PDOMapping")


@pytest.mark.parametrize(
    ("eds", "code", "said"),
    [
        (fixed_mode(8), ExitCode.BUS_MISSING, "0x6061 = 8, 10 expected"),
        (fixed_mode(10), ExitCode.OK, ""),
        (EdsVariant().without("6061"), ExitCode.OK, "lacks 0x6061"),
    ],
    ids=["another one that can't be written", "the right one", "one that can't be read"],
)
def test_a_mode_that_no_frame_shows_is_compared_or_said_to_be_unknown(
    tmp_path: Path, eds: EdsVariant, code: ExitCode, said: str
) -> None:
    assert init(tmp_path, "--eds", str(eds.write(tmp_path / "drive.eds"))).exit_code == 0
    assert rehearse(tmp_path) == code
    events = [entry.event.message for entry in read_log(tmp_path / "run" / "run.mcap").events]
    assert any((said or "0x6061") in line for line in events) == bool(said)
