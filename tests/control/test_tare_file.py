"""Stored tares: written whole or not at all, read with the rules of the configuration, used only where they belong."""

import dataclasses
import math
from pathlib import Path

import pytest

from adacd_hil.control.tare_file import (
    PoseRecord,
    SensorRecord,
    Tare,
    read_tare,
    use_tare,
    write_tare,
)
from adacd_hil.dates import format_date
from adacd_hil.device.canopen_bus import DeviceError
from adacd_hil.device.network import Identity
from adacd_hil.log.log_files import TARE_NAME
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.schema import ConfigError

DATE_NS = 1_767_225_600_000_000_000  # 2026-01-01T00:00:00Z
HOUR_NS = 3_600_000_000_000
SETTINGS = load_settings("paper")

SENSOR1 = SensorRecord("Sensor1", 3, 0x41444143, 0x404, 1, 3001, 23.5)
SENSOR2 = SensorRecord("Sensor2", 4, 0x41444143, 0x404, 1, 3002)
POSES = (
    PoseRecord((0.5, -1.0), (0.31, -0.2), (0.02, 0.021), (0.12, 0.13), (0.001, -0.001), (0.005, 0.0), 2000),
    PoseRecord((0.1, 1.0), (0.3, -0.2), (0.022, 0.023), (0.14, 0.15), (0.002, -0.002), (-0.005, 0.0), 1999),
)
TARE = Tare(
    format=1,
    offset_Nm=(0.305, -0.2),
    standard_error_Nm=(0.005, 0.0004),
    spread_Nm=(0.01, 0.0),
    old_offset_Nm=(0.25, 0.0),
    sign=(1, 1),
    is_auto_zeroed=False,
    gravity_model="none",
    gravity_Nm=(0.0, 0.0),
    condition=1.0,
    samples=3999,
    duration_s=3.999,
    date_utc="2026-01-01T00:00:00Z",
    user='o"neil\\lab',
    host="bench",
    interface="socketcan",
    channel="can0",
    config="paper",
    profile="P",
    wire_version=1,
    layout_digest="0x12345678",
    version="0.1.0",
    git="abc1234",
    sensor1=SENSOR1,
    sensor2=SENSOR2,
    poses=POSES,
)


def stored(folder: Path, **changes: object) -> Path:
    path = folder / "tare.toml"
    write_tare(dataclasses.replace(TARE, **changes), path)  # type: ignore[arg-type]
    return path


def identities(**changes: object) -> list[Identity]:
    """Devices as found at boot; `changes` concern the second sensor."""
    sensors = [Identity(s.name, s.node_id, s.vendor, s.product, s.revision, s.serial) for s in TARE.sensors]
    drives = [Identity(f"Drive{n}", n, 0x41444143, 0x402, 1, 1000 + n) for n in (1, 2)]
    return [*drives, sensors[0], sensors[1]._replace(**changes)]


def test_a_tare_is_read_as_it_was_written(tmp_path: Path) -> None:
    assert read_tare(stored(tmp_path)) == TARE
    assert TARE.measured_ns() == DATE_NS
    assert format_date(DATE_NS + 999_999_999) == TARE.date_utc
    with pytest.raises(ConfigError, match=r"tare .*none.toml does not exist; `adacd-hil tare` makes one"):
        read_tare(tmp_path / "none.toml")


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("\noffset_Nm = [0.305", "\nofset_Nm = [0.305", "unknown key `ofset_Nm`; did you mean `offset_Nm`?"),
        ("serial = 3001", "serail = 3001", "unknown key `sensor1.serail`; did you mean `sensor1.serial`?"),
        ("\noffset_Nm = [0.305", "\noffset_Nm = [nan", "`offset_Nm[0]` = nan is not finite"),
        ("\noffset_Nm = [0.305", "\noffset_Nm = [60.0", "`offset_Nm[0]` = 60.0 Nm is above 50 Nm"),
        ("format = 1", "format = 2", "`format` = 2 is above 1"),
        ("2026-01-01T00:00:00Z", "yesterday", "date_utc = 'yesterday' is not like 2026-01-31T12:00:00Z"),
        ("format = 1", "format", "Expected '=' after a key"),
    ],
)
def test_a_file_that_is_no_tare_is_one_line(tmp_path: Path, old: str, new: str, line: str) -> None:
    path = stored(tmp_path)
    text = path.read_text()
    assert text.count(old) == 1
    path.write_text(text.replace(old, new))
    with pytest.raises(ConfigError) as error:
        read_tare(path)
    assert line in str(error.value)
    assert "\n" not in str(error.value)


def test_a_run_takes_over_the_offset_with_its_deviation_and_nothing_else(tmp_path: Path) -> None:
    used = use_tare(stored(tmp_path), SETTINGS, DATE_NS)
    arm = dataclasses.replace(
        SETTINGS.arm, torque_offset_Nm=(0.305, -0.2), torque_offset_std_Nm=used.offset_std_Nm(SETTINGS.tare)
    )
    assert used.apply(SETTINGS) == dataclasses.replace(SETTINGS, arm=arm)
    assert used.warnings == ()


def test_the_log_gets_the_tare_that_is_used_where_another_takes_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = stored(tmp_path)
    text = path.read_bytes()
    monkeypatch.setattr(Tare, "measured_ns", lambda _: DATE_NS + 0 * path.write_bytes(b"another"))
    assert use_tare(path, SETTINGS, DATE_NS).attachments() == {TARE_NAME: text}


@pytest.mark.parametrize(
    ("age_h", "expected_Nm"),
    [
        # standard error, half the spread, 5 K of 1 mNm/K, 0.02 mNm/√s
        (0.0, (math.hypot(0.005, 0.005, 0.005), math.hypot(0.0004, 0.005))),
        (24.0, (math.hypot(0.005, 0.005, 0.005, 2e-5 * 86400**0.5), math.hypot(0.0004, 0.005, 2e-5 * 86400**0.5))),
        (-1.0, (math.hypot(0.005, 0.005, 0.005), math.hypot(0.0004, 0.005))),
    ],
)
def test_a_tare_knows_the_zero_less_well_as_it_ages(
    tmp_path: Path, age_h: float, expected_Nm: tuple[float, float]
) -> None:
    used = use_tare(stored(tmp_path), SETTINGS, DATE_NS + round(age_h * HOUR_NS))
    assert used.offset_std_Nm(SETTINGS.tare) == pytest.approx(expected_Nm)
    steady = dataclasses.replace(SETTINGS.tare, drift_Nm_K=0.0, drift_Nm_sqrt_s=0.0)
    assert used.offset_std_Nm(steady) == pytest.approx((math.hypot(0.005, 0.005), 0.001))  # at least 1 mNm


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"mounting_deg": (90.0, -90.0), "zero_deg": (0.0, 0.0)}, ""),
        ({}, ""),
        ({"mounting_deg": (90.0, 0.0)}, r"arm.mounting_deg = \[90.0, 0.0\], but the configuration has \[90.0, -90.0\]"),
        ({"zero_deg": (45.0, 0.0)}, r"arm.zero_deg = \[45.0, 0.0\], but the configuration has \[0.0, 0.0\]"),
        ({"gravity_model": "none"}, r"gravity_model = 'none', but the configuration has estimator.gravity = true"),
    ],
    ids=["as measured", "of an earlier version", "turned", "another zero", "taken for flat"],
)
def test_a_tare_of_another_gravity_is_refused(tmp_path: Path, changes: dict[str, object], words: str) -> None:
    estimator = dataclasses.replace(SETTINGS.estimator, gravity=True, P0=(*SETTINGS.estimator.P0, 50.0, 50.0))
    arm = dataclasses.replace(SETTINGS.arm, cad_theta=())
    upright = dataclasses.replace(SETTINGS, estimator=estimator, arm=arm)
    path = stored(tmp_path, **{"gravity_model": "estimated"} | changes)
    if words:
        with pytest.raises(ConfigError, match=words):
            use_tare(path, upright, DATE_NS)
    else:
        assert use_tare(path, upright, DATE_NS).tare.offset_Nm == TARE.offset_Nm
        with pytest.raises(ConfigError, match=r"the configuration has estimator.gravity = false"):
            use_tare(path, SETTINGS, DATE_NS)


@pytest.mark.parametrize(("age_h", "words"), [(24.0, None), (24.1, "is 24.1 h old"), (-0.2, "0.2 h in the future")])
def test_an_old_tare_is_warned_of_or_refused_by_the_settings(tmp_path: Path, age_h: float, words: str | None) -> None:
    path, now_ns = stored(tmp_path), DATE_NS + int(age_h * HOUR_NS)
    warnings = use_tare(path, SETTINGS, now_ns).warnings
    assert [words in line for line in warnings if words] == ([True] if words else [])
    assert len(warnings) == (0 if words is None else 1)
    strict = dataclasses.replace(SETTINGS, tare=dataclasses.replace(SETTINGS.tare, max_age_h=24.0))
    if age_h > 24.0:
        with pytest.raises(ConfigError, match=r"is 24.1 h old, more than tare.max_age_h = 24 h; tare again"):
            use_tare(path, strict, now_ns)
    else:
        assert use_tare(path, strict, now_ns).warnings == warnings


def test_a_tare_of_sensors_that_zeroed_themselves_says_that_a_reset_forgets_it(tmp_path: Path) -> None:
    (warning,) = use_tare(stored(tmp_path, is_auto_zeroed=True), SETTINGS, DATE_NS).warnings
    assert "a sensor that was reset forgot it" in warning


def test_the_sensors_that_were_tared_are_accepted_whatever_the_drives_are(tmp_path: Path) -> None:
    used = use_tare(stored(tmp_path), SETTINGS, DATE_NS + 25 * HOUR_NS)
    found = [identity._replace(serial=9) if identity.name == "Drive1" else identity for identity in identities()]
    info, warning = used.check_devices(found)
    assert (info.level, info.name) == ("info", "tare")
    assert "0.305, -0.2 Nm subtracted" in info.message
    assert (warning.level, "25.0 h old" in warning.message) == ("warning", True)


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"serial": 7}, "Sensor2 (node 4): serial number 7 is not the 3002 of tare "),
        ({"serial": 3001}, "Sensor2 (node 4): serial number 3001 is not the 3002 of tare "),  # the other sensor's
        ({"vendor": 1}, "Sensor2 (node 4): vendor 1 is not the 1094992195 of tare "),
        ({"product": 1}, "Sensor2 (node 4): product code 1 is not the 1028 of tare "),
    ],
)
def test_other_sensors_than_those_that_were_tared_are_refused(
    tmp_path: Path, changes: dict[str, int], line: str
) -> None:
    with pytest.raises(DeviceError) as error:
        use_tare(stored(tmp_path), SETTINGS, DATE_NS).check_devices(identities(**changes))
    assert str(error.value).startswith(line)
