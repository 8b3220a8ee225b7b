"""A profile is drafted from an EDS: what may be mapped is mapped, what only the factory says is a guess."""

import math
from pathlib import Path

import pytest
from eds_variants import EdsVariant

from adacd_hil.device.profile import PdoSettings, ScaleSettings
from adacd_hil.lab.commission.device_recognition import fitting_profiles
from adacd_hil.lab.commission.profile_draft import DeviceRatings, ProfileDraft, draft_profile, kind_of
from adacd_hil.lab.commission.survey import Node
from adacd_hil.settings.schema import ConfigError

RPM, MILLI_RPM, DEGREES_PER_S = 0x00B44700, 0xFDB44700, 0x00410300
GEAR = 16.0


@pytest.fixture
def eds(tmp_path: Path) -> Path:
    return tmp_path / "drive.eds"


def draft(eds: Path, variant: EdsVariant, **answers: float) -> ProfileDraft:
    return draft_profile(variant.write(eds), answers=answers)


def frame(drafted: ProfileDraft, message: str) -> PdoSettings:
    return next(pdo for pdo in drafted.settings.pdo if pdo.message == message)


def objects(drafted: ProfileDraft, message: str) -> list[str]:
    return [signal.object for signal in frame(drafted, message).signals]


def guessed(drafted: ProfileDraft) -> set[str]:
    return {key.removeprefix("scale.") for key in drafted.guessed}


@pytest.mark.parametrize(
    ("unit", "rad_s"),
    [
        (RPM, math.pi / 30.0),
        (MILLI_RPM, math.pi / 30_000.0),
        (DEGREES_PER_S, math.pi / 180.0),
        (None, math.tau / 65536),  # a count is guessed to be an increment per second
    ],
)
def test_the_unit_of_velocity_is_that_of_the_motor(eds, unit, rad_s):
    drafted = draft(eds, EdsVariant() if unit is None else EdsVariant().with_object("60A9", unit))
    assert drafted.settings.scale.velocity_rad_s == pytest.approx(rad_s / GEAR)
    assert ("velocity_rad_s" in guessed(drafted)) is (unit is None)


def test_an_answer_is_no_guess(eds):
    drafted = draft(eds, EdsVariant(), velocity_unit=RPM, gear_ratio=50.0, gear_efficiency=0.8)
    scale = drafted.settings.scale
    assert (scale.gear_ratio, scale.gear_efficiency) == (50.0, 0.8)
    assert scale.increments_per_joint_rev == 65536 * 50
    assert scale.velocity_rad_s == pytest.approx(math.pi / 30.0 / 50.0)
    assert guessed(drafted) == set()


@pytest.mark.parametrize("access", ["rw", "rww"])
def test_increments_that_the_factory_sets_are_a_guess_until_the_device_says_them(eds, access):
    variant = EdsVariant().with_value(2000, "608Fsub1").with_value(access, "608Fsub1", key="AccessType")
    drafted = draft(eds, variant)
    assert drafted.settings.scale.increments_per_joint_rev == 2000 * GEAR
    assert "increments_per_joint_rev" in guessed(drafted)
    numbers = {(0x608F, 1): 2000, (0x608F, 2): 1, (0x6091, 1): 16, (0x6091, 2): 1}
    assert "increments_per_joint_rev" not in guessed(draft_profile(eds, DeviceRatings(numbers=numbers)))


@pytest.mark.parametrize("increments", [1, 2000])
def test_fewer_increments_than_a_joint_has_are_nobody_s(eds, increments):
    drafted = draft(eds, EdsVariant().with_value(increments, "608Fsub1").with_value(1, "6091sub1"))
    assert drafted.settings.scale.increments_per_joint_rev > 1e5
    assert "increments_per_joint_rev" in guessed(drafted)


def test_the_coarse_increments_of_a_device_that_was_read_are_kept_as_a_guess(eds):
    numbers = {(0x608F, 1): 2000, (0x608F, 2): 1, (0x6091, 1): 1, (0x6091, 2): 1}
    drafted = draft_profile(EdsVariant().write(eds), DeviceRatings(numbers=numbers), answers={"gear_ratio": 1.0})
    assert drafted.settings.scale.increments_per_joint_rev == 2000
    assert "increments_per_joint_rev" in guessed(drafted)


def test_a_motor_too_strong_for_an_arm_counts_millionths(eds):
    drafted = draft(eds, EdsVariant().with_value(512871, "6076"), gear_ratio=26.0, gear_efficiency=1.0)
    assert drafted.settings.scale.rated_torque_count_Nm == 1e-6
    assert drafted.rated_torque_Nm == pytest.approx(13.334646)
    assert "rated_torque_count_Nm" in guessed(drafted)


def test_an_object_that_may_not_be_mapped_or_has_no_room_is_left_out(eds):
    for variant in (
        EdsVariant().with_value(0, "603F", "6077", key="PDOMapping"),
        EdsVariant().without(*(f"1A01sub{sub}" for sub in range(3, 9))),
    ):
        assert objects(draft(eds, variant), "Status") == ["0x6041", "0x6061"]


def test_a_torque_by_event_comes_no_more_often_than_the_bus_bears(eds):
    assert frame(draft(eds, EdsVariant()), "Status").inhibit_100us == 50
    without = draft(eds, EdsVariant().without("1801sub3"))
    assert "0x6077" not in objects(without, "Status")
    assert frame(without, "Status").inhibit_100us == 0


def test_times_and_an_identifier_that_can_t_be_written_are_the_eds_s(eds):
    variant = EdsVariant().with_value("ro", "1801sub3", "1801sub5", key="AccessType")
    status = frame(draft(eds, variant.with_value(20, "1801sub3").with_value(50, "1801sub5")), "Status")
    assert (status.inhibit_100us, status.event_timer_ms) == (20, 50)
    variant = EdsVariant().with_value("const", "1400sub1", key="AccessType")
    assert frame(draft(eds, variant.with_value("$NODEID+0x240", "1400sub1")), "Command").cob_id == 0x240


def test_an_event_timer_that_is_absent_is_a_remark(eds):
    drafted = draft(eds, EdsVariant().without("1801sub5"))
    assert frame(drafted, "Status").event_timer_ms == 0
    assert any("0x1801:5" in line for line in drafted.remarks)


def test_a_polarity_of_the_position_alone_is_a_remark(eds):
    for polarity, is_odd in ((0x80, True), (0xE0, False)):
        remarks = draft(eds, EdsVariant().with_object("607E", polarity, DataType="0x0005")).remarks
        assert any("0x607E" in line for line in remarks) is is_odd


@pytest.mark.parametrize(
    ("variant", "reason"),
    [
        (EdsVariant().without("6071"), r"no 0x6071 \(target torque\): it can't be commanded by torque"),
        (EdsVariant().with_value(0, "6071", key="PDOMapping"), "0x6071 .* can't be in a frame to the drive"),
        (EdsVariant().with_value("ro", "6071", key="AccessType"), "0x6071 .* can't be in a frame to the drive"),
        (EdsVariant().with_value(0x25, "6502"), "0x6502 = 0x25 has no cyclic synchronous torque"),
        (EdsVariant().with_value(0, "6064", key="PDOMapping"), r"0x6064 \(position\) can't be in a frame"),
        (EdsVariant().without("606C"), r"no 0x606C \(velocity\)"),
        (EdsVariant().without("1400", "1401", "1402", "1403"), "no RPDO takes 0x6040 .* and 0x6071"),
        (EdsVariant().without("1800", "1801", "1802", "1803"), "no TPDO brings 0x6064 .* and 0x606C"),
        (EdsVariant().with_value(0, "1000"), "names no profile, neither a drive's"),
        (EdsVariant().with_value(401, "1000"), "names CiA 401, neither a drive's"),
    ],
)
def test_the_reason_of_a_refusal_is_the_object_that_lacks(eds, variant, reason):
    with pytest.raises(ConfigError, match=reason):
        draft(eds, variant)


def test_a_known_maker_s_drive_without_profile_number_is_one(eds):
    assert kind_of(EdsVariant("maxon_epos4.eds").with_value("", "1000").write(eds)) == "drive"


def test_the_identifiers_of_a_dcf_are_those_of_its_node(eds):
    variant = (
        EdsVariant().with_value("0x187", "1800sub1").with_value("0x287", "1801sub1").with_value("0x207", "1400sub1")
    )
    variant.table["DeviceComissioning"] = {"NodeID": "7"}
    drafted = draft(eds, variant)
    assert [frame(drafted, message).cob_id for message in ("Feedback", "Status", "Command")] == [0x180, 0x280, 0x200]


def test_a_maker_s_drive_is_recognised_whatever_its_model():
    node = Node(5)
    node.vendor, node.product = 0xFB, 0x65510000
    assert fitting_profiles(node, "drive") == ("maxon-epos4",)
    node.vendor = 0xB0B  # whose stock drive has another product
    assert fitting_profiles(node, "drive") == ()


@pytest.mark.parametrize(
    ("rpm", "gear", "degrees_s"),
    [(50_000, None, None), (3000, None, 360.0), (6, None, None), (0, None, None), (3000, 1, 360.0), (3000, 100, 180.0)],
)
def test_a_speed_limit_that_no_joint_has_is_the_factory_s(rpm, gear, degrees_s):
    ratings = DeviceRatings(numbers={(0x6080, 0): rpm} | ({} if gear is None else {(0x6091, 1): gear, (0x6091, 2): 1}))
    assert ratings.velocity_limit_deg_s(ScaleSettings(gear_ratio=50.0)) == degrees_s


@pytest.mark.parametrize(("counts", "degrees"), [(1, None), (25_600, 90.0), (0x7FFFFFFF, None)])
def test_a_position_limit_that_no_joint_has_is_the_factory_s(counts, degrees):
    ratings = DeviceRatings(numbers={(0x607D, 1): -counts, (0x607D, 2): counts})
    assert ratings.position_limit_deg(ScaleSettings(increments_per_joint_rev=102_400.0)) == degrees
