"""What a drive's objects say of its counts at the joint."""

import math
import tomllib
from importlib import resources

import pytest

from adacd_hil.device.device_files import place_devices
from adacd_hil.device.drive_units import DriveUnits, name_velocity_unit, read_drive_units
from adacd_hil.device.profile import ProfileSettings, ScaleSettings, enable_timeout_s
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.schema import ConfigError

RPM, MILLI_RPM, INCREMENTS_S, DEG_S = 0x00B44700, 0xFDB44700, 0x00B50300, 0x00410300


def units_of(objects: dict[tuple[int, int], int], gear_ratio: float = 1.0) -> DriveUnits:
    return read_drive_units(lambda index, sub: objects.get((index, sub)), gear_ratio)


@pytest.mark.parametrize(
    ("objects", "gear_ratio", "increments"),
    [
        ({(0x608F, 1): 4096, (0x608F, 2): 1, (0x6091, 1): 50, (0x6091, 2): 1}, 1.0, 204_800.0),
        ({(0x608F, 1): 65536, (0x608F, 2): 16, (0x6091, 1): 101, (0x6091, 2): 2}, 1.0, 206_848.0),
        ({(0x608F, 1): 4096}, 26.0, 106_496.0),  # the drive has no 0x6091
        ({(0x608F, 1): 131_072, (0x6091, 1): 1, (0x6091, 2): 1, (0x6092, 1): 10_000, (0x6092, 2): 1}, 50.0, 10_000.0),
        ({(0x608F, 1): 2000, (0x6092, 1): 1, (0x6092, 2): 1}, 1.0, 2000.0),  # a feed constant of the factory
        ({(0x60A8, 0): 0xFD410000}, 10.0, 3_600_000.0),  # thousandths of a degree of the motor
        ({(0x60A8, 0): 0xFD410000, (0x6092, 1): 360_000, (0x6092, 2): 1}, 10.0, 360_000.0),  # of the joint
        ({(0x60A8, 0): 0x00B50000, (0x608F, 1): 4096}, 1.0, 4096.0),
        ({}, 26.0, None),
    ],
)
def test_increments_of_a_joint_are_encoder_times_gear_or_the_feed_constant(
    objects: dict[tuple[int, int], int], gear_ratio: float, increments: float | None
) -> None:
    assert units_of(objects, gear_ratio).increments_per_joint_rev == pytest.approx(increments)


@pytest.mark.parametrize(
    ("unit", "rad_s"),
    [
        (RPM, math.pi / 30.0 / 16.0),
        (MILLI_RPM, math.pi / 30.0 / 16.0 / 1000.0),
        (INCREMENTS_S, math.tau / (65536 * 16)),
        (DEG_S, math.radians(1.0) / 16.0),
        (0x00100300, 1.0 / 16.0),
        (0x00B40300, math.tau / 16.0),
        (0x00560100, None),  # newton metres
        (0, None),
    ],
)
def test_a_count_of_velocity_is_that_of_the_motor_over_the_gear(unit: int, rad_s: float | None) -> None:
    objects = {(0x608F, 1): 65536, (0x6091, 1): 16, (0x6091, 2): 1, (0x60A9, 0): unit}
    assert units_of(objects).velocity_rad_s == pytest.approx(rad_s)


@pytest.mark.parametrize(
    ("unit", "name"),
    [(RPM, "rpm"), (MILLI_RPM, "10^-3 rpm"), (INCREMENTS_S, "increment/s"), (0x00560100, "0x00560100")],
)
def test_a_unit_of_velocity_has_a_name(unit: int, name: str) -> None:
    assert name_velocity_unit(unit) == name


@pytest.mark.parametrize(("encoder", "has"), [(1, False), (359, False), (360, True)])
def test_one_increment_per_revolution_is_none_of_a_joint(encoder: int, has: bool) -> None:
    assert units_of({(0x608F, 1): encoder}).has_increments is has


def test_rated_torque_at_the_joint_is_that_of_the_motor_by_unit_gear_and_efficiency() -> None:
    scale = ScaleSettings(rated_torque_count_Nm=1e-6, gear_ratio=26.0, gear_efficiency=0.75)
    assert 512_871 * scale.joint_torque_Nm == pytest.approx(10.001, abs=1e-3)
    assert ScaleSettings().joint_torque_Nm == 1e-3


STOCK = tomllib.loads((resources.files("adacd_hil") / "device_profiles" / "stock-drive.toml").read_text())


def test_a_profile_of_one_increment_per_revolution_is_refused() -> None:
    with pytest.raises(ConfigError, match="increments_per_joint_rev = 1 is below 360"):
        parse(ProfileSettings, STOCK | {"scale": STOCK["scale"] | {"increments_per_joint_rev": 1}})


def test_a_profile_names_its_guesses_by_keys_that_exist() -> None:
    known = parse(ProfileSettings, STOCK | {"assumed": ["scale.gear_ratio"]})
    assert known.assumed == ("scale.gear_ratio",)
    with pytest.raises(ConfigError, match=r"'scale.gear_rate' is no key of a profile; did you mean 'scale.gear_ratio'"):
        parse(ProfileSettings, STOCK | {"assumed": ["scale.gear_rate"]})


def test_enabling_may_take_as_long_as_the_most_patient_profile_wants() -> None:
    settings = load_settings("certified")
    assert settings.safety.enable_timeout_s is None
    # 5 s to Operation enabled, 10 s more until the mode shows
    assert enable_timeout_s(settings, place_devices(settings)) == 15.0
