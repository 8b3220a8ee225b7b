"""One drive as the host sees it: its states and commands, and its frames on both contracts."""

import dataclasses
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from loaded import encoded, loaded_contract

import adacd_hil
from adacd_hil.control.fault_recovery import SelfChecks
from adacd_hil.device.device_files import load_profile, place_devices
from adacd_hil.device.drive import (
    Cia402State,
    Controlword,
    Drive,
    decode_statusword,
    option_codes,
    torque_limit_permille,
)
from adacd_hil.device.profile import PdoSettings, PlausibilitySettings
from adacd_hil.records import FaultReason, Request, SchemeState
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.parsing import parse
from adacd_hil.wire.codec import Codec, CodecError
from adacd_hil.wire.dbc_contract import parse_codec
from adacd_hil.wire.e2e import E2eStatus

PAPER, FD_SETTINGS = load_settings("paper"), load_settings("fd")
CLASSIC, FD = loaded_contract(PAPER), loaded_contract(FD_SETTINGS)
PERIOD_S = 0.001
JUMP_RAD = 0.02
LSB_RAD = 2.0 * math.pi / 2**20

# IEC 61800-7-201, table "state coding": bits 7…0 of the statusword, x where the standard leaves a bit open.
CODING = [
    ("x0xx0000", Cia402State.NOT_READY_TO_SWITCH_ON),
    ("x1xx0000", Cia402State.SWITCH_ON_DISABLED),
    ("x01x0001", Cia402State.READY_TO_SWITCH_ON),
    ("x01x0011", Cia402State.SWITCHED_ON),
    ("x01x0111", Cia402State.OPERATION_ENABLED),
    ("x00x0111", Cia402State.QUICK_STOP_ACTIVE),
    ("x0xx1111", Cia402State.FAULT_REACTION_ACTIVE),
    ("x0xx1000", Cia402State.FAULT),
]
WORDS = dict(zip(Cia402State, (0x0000, 0x0250, 0x0231, 0x0233, 0x0237, 0x0217, 0x021F, 0x0218), strict=True))
WANTED = dict(zip(Cia402State, (0x00, 0x06, 0x07, 0x0F, 0x0F, 0x00, 0x00, 0x80), strict=True))
"""The next controlword of a drive that is to be enabled, by its state; quick stop option code unknown."""


def drive(settings: Settings = PAPER, codec: Codec = CLASSIC, joint: int = 0, **profile: Any) -> Drive:
    """A drive of the settings, with changes to its profile."""
    placed = place_devices(settings)[joint]
    own = placed.profile._replace(settings=dataclasses.replace(placed.settings, **profile))
    return Drive(settings, codec, dataclasses.replace(placed, profile=own))


def limited(settings: Settings, permille: int) -> Settings:
    """The settings with a lower torque limit of joint 1."""
    torque_Nm = permille * 1e-3 * settings.arm.rated_torque_Nm[0]
    arm = dataclasses.replace(settings.arm, torque_limit_Nm=(torque_Nm, settings.arm.torque_limit_Nm[1]))
    return dataclasses.replace(settings, arm=arm)


def status(statusword: int, mode: int = 10, torque: int = 0, error: int = 0) -> bytes:
    return bytes(encoded(CLASSIC.message("Drive1Status"), statusword, mode, torque, error))


def feedback(position_rad: float, velocity_rad_s: float) -> bytes:
    return bytes(encoded(CLASSIC.message("Drive1Feedback"), position_rad, velocity_rad_s))


def with_period(period_ms: int) -> tuple[PdoSettings, ...]:
    """The frames of a drive, with another period of its status."""
    periods = {"Status": period_ms}
    pdos = place_devices(PAPER)[0].settings.pdo
    return tuple(dataclasses.replace(pdo, event_timer_ms=periods.get(pdo.message, 0)) for pdo in pdos)


def in_state(state: Cia402State, mode: int = 10) -> Drive:
    found = drive(quick_stop_option=None)
    found.accept_status(status(WORDS[state], mode), 0)
    return found


def command_of(frame: bytes, codec: Codec = CLASSIC) -> tuple[int, ...]:
    return tuple(int(value) for value in codec.message("Drive1Command").decode_values(frame))


def expected_state(statusword: int) -> Cia402State:
    bits = f"{statusword & 0xFF:08b}"
    for pattern, state in CODING:
        if all(bit in ("x", given) for bit, given in zip(pattern, bits, strict=True)):
            return state
    return Cia402State.NOT_READY_TO_SWITCH_ON


def test_every_statusword_reads_as_the_standard_says() -> None:
    assert [word for word in range(0x10000) if decode_statusword(word) is not expected_state(word)] == []


def test_states_and_controlwords_have_the_numbers_that_logs_and_wire_hold() -> None:
    names = "NOT_READY_TO_SWITCH_ON SWITCH_ON_DISABLED READY_TO_SWITCH_ON SWITCHED_ON OPERATION_ENABLED "
    names += "QUICK_STOP_ACTIVE FAULT_REACTION_ACTIVE FAULT"
    assert [(state.name, state.value) for state in Cia402State] == [(n, k) for k, n in enumerate(names.split())]
    assert {word.name: int(word) for word in Controlword} == {
        "DISABLE_VOLTAGE": 0x00,
        "QUICK_STOP": 0x02,
        "SHUTDOWN": 0x06,
        "SWITCH_ON": 0x07,
        "ENABLE_OPERATION": 0x0F,
        "FAULT_RESET": 0x80,
    }


@pytest.mark.parametrize("state", list(Cia402State))
def test_a_wanted_drive_is_led_up_and_an_unwanted_one_stopped_or_disabled(state: Cia402State) -> None:
    for enable, quick_stop, expected in (
        (True, False, WANTED[state]),
        (False, False, 0x00),
        (False, True, 0x02),
        (True, True, 0x02),
    ):
        word, torque = command_of(in_state(state).command(500, enable=enable, quick_stop=quick_stop))
        is_passed = enable and not quick_stop and state is Cia402State.OPERATION_ENABLED
        assert (word, torque) == (expected, 500 * is_passed)


@pytest.mark.parametrize("mode", [-1, 0, 4, 8, 9])
@pytest.mark.parametrize("state", list(Cia402State))
def test_torque_passes_in_no_other_mode(state: Cia402State, mode: int) -> None:
    assert command_of(in_state(state, mode).command(500, enable=True, quick_stop=False))[1] == 0


@pytest.mark.parametrize(
    ("statuswords", "quick_stops", "words"),
    [
        ((0x0218,) * 4, (), [0x80, 0x00, 0x80, 0x00]),
        ((0x0218, 0x0218, 0x0250, 0x0218, 0x0218), (), [0x80, 0x00, 0x06, 0x80, 0x00]),  # the next fault
        ((0x0218,) * 4, (1,), [0x80, 0x02, 0x80, 0x00]),
    ],
)
def test_fault_reset_rises_once_for_each_fault_and_is_low_before(
    statuswords: tuple[int, ...], quick_stops: tuple[int, ...], words: list[int]
) -> None:
    seen, found = drive(), []
    for place, statusword in enumerate(statuswords):
        seen.accept_status(status(statusword), 0)
        found.append(command_of(seen.command(0, enable=True, quick_stop=place in quick_stops))[0])
    assert found == words


@pytest.mark.parametrize(
    ("option", "statusword", "velocity", "controlword"),
    [
        (None, 0x0217, 1.0, 0x00),  # unknown: out, whatever it does
        (0, 0x0217, 1.0, 0x02),  # below 5 the drive leaves by itself; disable voltage would let it coast
        (2, 0x0617, 0.0, 0x02),
        (4, 0x0217, 0.0, 0x02),
        (5, 0x0217, 1.0, 0x02),  # from 5 on it stays: first it brakes
        (5, 0x0617, 1.0, 0x00),  # bit 10: it stands still
        (6, 0x0217, 0.01, 0x00),  # a drive that leaves bit 10 alone stands still all the same
        (6, 0x0217, -1.0, 0x02),
        (8, 0x0217, 1.0, 0x02),
        (8, 0x0A17, 1.0, 0x02),  # bit 11 is another's
    ],
)
def test_quick_stop_is_left_as_its_option_code_demands(
    option: int | None, statusword: int, velocity: float, controlword: int
) -> None:
    seen = drive(quick_stop_option=option)
    seen.accept_cyclic(feedback(0.0, velocity), 0)
    seen.accept_status(status(statusword), 0)
    assert command_of(seen.command(500, enable=True, quick_stop=False)) == (controlword, 0)


@pytest.mark.parametrize(("settings", "codec"), [(FD_SETTINGS, FD), (PAPER, CLASSIC)], ids=["fd", "classic"])
@pytest.mark.parametrize("joint", [1, 2])
def test_a_drive_that_has_said_nothing_is_nowhere_and_not_ready(joint: int, settings: Settings, codec: Codec) -> None:
    begun = drive(settings, codec, joint - 1)
    assert (begun.name, begun.node_id, begun.command_id) == (f"Drive{joint}", joint, 0x200 + joint)
    assert (begun.values, begun.sample_cycle, begun.status_cycle) == ((0.0, 0.0), -1, -1)
    assert (begun.state, begun.statusword, begun.mode) == (Cia402State.NOT_READY_TO_SWITCH_ON, 0, 0)
    assert (begun.torque_actual_permille, begun.error_code, begun.implausible_frames) == (0, 0, 0)
    assert (begun.is_enabled, begun.is_protected) == (False, codec is FD)
    frame = begun.command(100, enable=True, quick_stop=False)
    message = codec.message(f"Drive{joint}Command")
    assert message.decode_values(frame)[0] == 0
    assert codec is CLASSIC or message.decode_values(frame)[3] == 1000


def test_a_status_frame_of_its_length_says_state_mode_torque_and_error() -> None:
    seen = drive()
    seen.accept_status(status(0x0218, 10, -123, 0x8250), 3)
    for length in (0, 6, 8):  # such a frame says nothing
        seen.accept_status((status(0x0237) + b"\x00")[:length], 4)
    found = (seen.state, seen.mode, seen.torque_actual_permille, seen.error_code, seen.status_cycle)
    assert found == (Cia402State.FAULT, 10, -123, 0x8250, 3)


@pytest.mark.parametrize("length", [0, 7, 9])
def test_feedback_of_the_wrong_length_is_counted_and_leaves_the_next_frame_as_good_as_it_was(length: int) -> None:
    seen = drive()
    assert seen.accept_cyclic(feedback(0.5, 0.0), 0) is True
    for cycle in (1, 2):
        assert seen.accept_cyclic((feedback(0.5, 0.0) + b"\x00")[:length], cycle) is False
        assert seen.implausible_frames == cycle
    assert seen.accept_cyclic(feedback(0.5, 0.0), 3) is True


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("start_rad", "velocity_rad_s", "periods"),
    [(0.0, 0.0, 1), (0.75, 2.0, 3), (-1.5, -4.0, 1), (0.0, 30.0, 1), (0.0, 5.0, 10)],
)
def test_a_step_is_plausible_up_to_its_bound_off_what_the_velocity_says(
    start_rad: float, velocity_rad_s: float, periods: int, sign: float
) -> None:
    expected_rad = start_rad + velocity_rad_s * periods * PERIOD_S
    for off_rad, is_plausible in ((JUMP_RAD - 2 * LSB_RAD, True), (JUMP_RAD + 2 * LSB_RAD, False)):
        seen = drive()
        seen.accept_cyclic(feedback(start_rad, velocity_rad_s), 5)
        position_rad = expected_rad + sign * off_rad
        taken = seen.accept_cyclic(feedback(position_rad, velocity_rad_s), 5 + periods)
        assert taken is is_plausible
        assert (seen.sample_cycle, seen.implausible_frames) == ((5 + periods, 0) if is_plausible else (5, 1))
        kept_rad = position_rad if is_plausible else start_rad
        assert seen.values == pytest.approx((kept_rad, velocity_rad_s), abs=1e-5)


def test_a_status_may_be_as_old_as_two_and_a_half_periods_while_the_drives_are_enabled() -> None:
    silent, seen = (drive(pdo=with_period(period_ms)) for period_ms in (0, 16))
    for each in (silent, seen):
        each.accept_status(status(0x0237), 3)
    assert silent.fault(10**9, is_enabled=True) is FaultReason.NONE  # a frame without a period has no age
    assert [seen.fault(cycle, is_enabled=True) for cycle in (3, 43, 44)] == [
        FaultReason.NONE,
        FaultReason.NONE,
        FaultReason.DATA_AGE,
    ]
    assert seen.fault(44, is_enabled=False) is FaultReason.NONE


@pytest.mark.parametrize("is_enabled", [False, True])
@pytest.mark.parametrize(("has_excess", "fault"), [(False, FaultReason.NONE), (True, FaultReason.DRIVE)])
def test_a_value_outside_its_bounds_is_a_fault_of_the_drive(
    monkeypatch: pytest.MonkeyPatch, has_excess: bool, fault: FaultReason, is_enabled: bool
) -> None:
    monkeypatch.setattr(Drive, "has_excess", lambda self, cycle: has_excess)
    assert in_state(Cia402State.OPERATION_ENABLED).fault(5, is_enabled) is fault


@pytest.mark.parametrize(("statusword", "is_limited"), [(0x0237, False), (0x0A37, True), (0xF7FF, False)])
def test_bit_11_reports_a_limit_of_the_drives_own(statusword: int, is_limited: bool) -> None:
    seen = drive()
    seen.accept_status(status(statusword), 0)
    assert seen.is_limited is is_limited


def test_the_torques_of_the_last_commands_are_kept() -> None:
    seen = in_state(Cia402State.OPERATION_ENABLED)
    assert list(seen.recent_permille) == [0]
    for torque in range(1, 12):
        seen.command(torque, enable=torque != 11, quick_stop=torque == 10)
    assert list(seen.recent_permille) == [4, 5, 6, 7, 8, 9, 0, 0]


@pytest.mark.parametrize(("position_rad", "periods"), [(0.5, 1), (0.506, 1), (0.49, 4), (0.5, 2)])
def test_a_frame_misses_the_last_position_and_the_travel_since(position_rad: float, periods: int) -> None:
    seen = drive()
    frame = feedback(position_rad, 2.0)
    assert seen.position_error(frame, periods) == 0.0
    seen.accept_cyclic(feedback(0.5, -1.0), 0)
    expected = abs(position_rad - 0.5 - 2.0 * periods * PERIOD_S)
    assert seen.position_error(frame, periods) == pytest.approx(expected, abs=2 * LSB_RAD)
    assert [seen.position_error(wrong, periods) for wrong in (frame[:-1], frame + b"\x00", b"")] == [0.0] * 3
    assert seen.values == pytest.approx((0.5, -1.0), abs=1e-5)


def test_a_drive_that_may_not_jump_may_stand_still() -> None:
    seen = drive(plausibility=PlausibilitySettings(position_jump_rad=0.0))
    assert [seen.accept_cyclic(feedback(0.5, 0.0), cycle) for cycle in (0, 1)] == [True, True]


def test_the_configurations_option_codes_outweigh_the_profiles() -> None:
    profile = load_profile("adacd-drive", "drive").settings
    settings = parse(Settings, {"devices": {"quick_stop_option": 6}})
    assert option_codes(settings, profile) == (6, 2)


def test_the_torque_limit_is_per_mille_of_rated_torque_and_fits_its_object() -> None:
    settings = parse(Settings, {"arm": {"rated_torque_Nm": [12.0, 8.0], "torque_limit_Nm": [6.0, 8.0]}})
    assert [torque_limit_permille(settings, joint) for joint in (0, 1)] == [500, 1000]
    strong = dataclasses.replace(settings.arm, torque_limit_Nm=(1000.0, 1000.0), rated_torque_Nm=(0.1, 0.1))
    assert torque_limit_permille(dataclasses.replace(settings, arm=strong), 0) == 0xFFFF


FD_VALUES = (0.25, -0.5, WORDS[Cia402State.OPERATION_ENABLED], 10, 0x11, -120, 0x8130, 345, 777)
"""position, velocity, statusword, mode, error register, torque actual, error code, torque demand, acted commands"""


class Sender:
    """The drive's end on CAN FD: protects feedback as the drive does."""

    def __init__(self) -> None:
        self._sender = FD.message("Drive1Feedback").sender()

    def frame(self, *values: float) -> bytes:
        return self._sender.protect(encoded(FD.message("Drive1Feedback"), *(values or FD_VALUES)))


def test_protected_feedback_brings_motion_and_status_and_lets_torque_pass() -> None:
    seen = drive(limited(FD_SETTINGS, 321), FD)
    assert command_of(seen.command(55, enable=True, quick_stop=False), FD) == (0, 0, 0, 321)
    assert seen.accept_cyclic(Sender().frame(), 7) is True
    assert seen.values == pytest.approx((0.25, -0.5), abs=1e-5)
    assert (seen.sample_cycle, seen.torque_cycle, seen.has_status_frame) == (7, 7, False)
    assert (seen.state, seen.mode) == (Cia402State.OPERATION_ENABLED, 10)
    assert (seen.torque_actual_permille, seen.error_code) == (-120, 0x8130)
    assert command_of(seen.command(55, enable=True, quick_stop=False), FD) == (0x0F, 55, 0, 321)


def test_a_protected_frame_that_fails_its_check_changes_nothing() -> None:
    seen, frame = drive(FD_SETTINGS, FD), bytearray(Sender().frame())
    frame[5] ^= 0x40
    assert seen.accept_cyclic(bytes(frame), 7) is False
    assert (seen.values[0], seen.sample_cycle, seen.status_cycle, seen.statusword) == (0.0, -1, -1, 0)
    assert dict(seen.end_to_end.tally())[E2eStatus.WRONG_CRC] == 1
    assert seen.implausible_frames == 0


def test_protected_feedback_needs_no_plausibility_and_is_missed_when_it_does_not_come() -> None:
    seen, sender = drive(FD_SETTINGS, FD), Sender()
    seen.accept_cyclic(sender.frame(), 0)
    assert seen.accept_cyclic(sender.frame(0.25 + 10 * JUMP_RAD, 0.0, *FD_VALUES[2:]), 1) is True
    seen.miss()
    assert dict(seen.end_to_end.tally())[E2eStatus.NO_NEW_DATA] == 1


def test_a_contract_without_a_statusword_is_refused() -> None:
    text = FD.text.replace(b"SG_ statusword :", b"SG_ stateword :")
    with pytest.raises(CodecError, match="Drive1: no message carries signal statusword"):
        drive(FD_SETTINGS, parse_codec(text, FD.path))


def wide_drive(
    folder: Path, signals: str, command: str = "", status: str = "", permille: int = 1000
) -> tuple[Drive, Codec]:
    """An unprotected drive with the status in the feedback, or each 16 ms in a frame of its own, and its contract."""
    text = (Path(adacd_hil.__file__).parent / "device_profiles" / "stock-drive.toml").read_text()
    head, _ = text.split("[[pdo]]", 1)
    text = (
        head
        + f"""
[[pdo]]
message = "Feedback"
number = 1
cob_id = 0x180
signals = [{{ object = "0x6064", signal = "position" }}, {{ object = "0x606C", signal = "velocity" }}, {signals}]
[[pdo]]
message = "Command"
number = 1
cob_id = 0x200
signals = [
    {{ object = "0x6040", signal = "controlword" }},
    {{ object = "0x6071", signal = "target_torque" }},{command}
]
"""
    )
    if status:
        text += f'[[pdo]]\nmessage = "Status"\nnumber = 2\ncob_id = 0x280\nevent_timer_ms = 16\nsignals = [{status}]\n'
    path = folder / "wide.toml"
    path.write_text(text)
    sensor = list(load_settings("stock").devices.sensor)
    settings = parse(
        Settings,
        {"devices": {"drive": [str(path)] * 2, "sensor": sensor, "contract": "", "data_bitrate": 5_000_000}},
    )
    codec = loaded_contract(settings)
    return drive(limited(settings, permille), codec), codec


STATUS = '{ object = "0x6041", signal = "statusword" }, '
MODE = '{ object = "0x6061", signal = "mode_display" }, { object = "0x1001", signal = "error_register" }'
ERROR = '{ object = "0x603F", signal = "error_code" }'
TORQUE = '{ object = "0x6077", signal = "torque_actual" }, '


def test_the_status_may_travel_in_the_feedback(tmp_path: Path) -> None:
    arm, codec = wide_drive(tmp_path, STATUS + MODE)
    frame = bytes(encoded(codec.message("Drive1Feedback"), 2.5, 1.0, 0x0237, 10, 0x81))
    assert arm.accept_cyclic(frame, 7)
    assert (arm.state, arm.mode, arm.sample_cycle) == (Cia402State.OPERATION_ENABLED, 10, 7)
    assert (arm.has_status_frame, arm.status_message, arm.is_enabled) == (False, None, True)
    assert (arm.torque_actual_permille, arm.error_code, arm.torque_cycle) == (0, 0, -1)


@pytest.mark.parametrize("first", ["mode_display", "torque_actual", "error_code"])
def test_a_signal_of_the_status_may_be_the_first_of_its_frame(tmp_path: Path, first: str) -> None:
    objects = {"mode_display": "0x6061", "torque_actual": "0x6077", "error_code": "0x603F"}
    rows = f'{{ object = "{objects[first]}", signal = "{first}" }}, {STATUS}'
    arm, _ = wide_drive(tmp_path, "", status=rows)
    assert arm.status_message is not None
    raw = {"mode_display": 9, "torque_actual": -7, "error_code": 0x8130}
    arm.accept_status(bytes(encoded(arm.status_message, raw[first], 0x0237)), 2)
    assert arm.state is Cia402State.OPERATION_ENABLED
    kept = {"mode_display": 10, "torque_actual": 0, "error_code": 0} | {first: raw[first]}
    assert (arm.mode, arm.torque_actual_permille, arm.error_code) == tuple(kept.values())
    assert arm.torque_cycle == (2 if first == "torque_actual" else -1)


def test_the_status_may_travel_in_both_frames(tmp_path: Path) -> None:
    arm, codec = wide_drive(tmp_path, TORQUE + MODE, status=STATUS + ERROR)
    feedback = codec.message("Drive1Feedback")
    assert arm.status_message is not None
    arm.accept_status(bytes(encoded(arm.status_message, 0x0237, 0x8130)), 2)
    assert arm.accept_cyclic(bytes(encoded(feedback, 0.5, 1.0, -7, 10, 0x81)), 3)
    assert (arm.state, arm.statusword, arm.mode) == (Cia402State.OPERATION_ENABLED, 0x0237, 10)
    arm.accept_status(bytes(encoded(arm.status_message, 0x0237, 0x8131)), 4)
    assert (arm.torque_actual_permille, arm.error_code, arm.torque_cycle) == (-7, 0x8131, 3)
    assert arm.accept_cyclic(bytes(encoded(feedback, 0.5, 0.0, -8, 10, 0x81)), 5)
    assert (arm.torque_actual_permille, arm.error_code, arm.status_cycle) == (-8, 0x8131, 4)


@pytest.mark.parametrize(
    ("cyclic", "status", "fault"),
    [
        (TORQUE + MODE, STATUS, FaultReason.DATA_AGE),
        (TORQUE + STATUS, MODE, FaultReason.DATA_AGE),
        (STATUS + MODE, TORQUE, FaultReason.DATA_AGE),
        (STATUS + MODE, ERROR, FaultReason.NONE),  # the host only shows it
    ],
    ids=["statusword", "mode", "torque", "error code"],
)
def test_a_status_frame_that_stays_away_is_missed_whatever_the_feedback_brings(
    tmp_path: Path, cyclic: str, status: str, fault: FaultReason
) -> None:
    arm, codec = wide_drive(tmp_path, cyclic, status=status)
    raw = {"statusword": 0x0237, "mode_display": 10}

    def frame(name: str) -> bytes:
        message = codec.message(name)
        return bytes(encoded(message, *(raw.get(signal.name, 0) for signal in message.values)))

    arm.accept_status(frame("Drive1Status"), 3)
    for cycle in range(3, 45):
        assert arm.fault(cycle - 1, is_enabled=True) is FaultReason.NONE
        arm.accept_cyclic(frame("Drive1Feedback"), cycle)
    assert (arm.is_enabled, arm.fault(44, is_enabled=True)) == (True, fault)


def test_a_wrong_torque_counts_once_however_often_the_feedback_brings_the_mode(tmp_path: Path) -> None:
    arm, codec = wide_drive(tmp_path, f"{MODE}, {ERROR}", status=TORQUE + STATUS)
    parts: Any = SimpleNamespace(drives=[arm, drive(joint=1)], limits=PAPER.arm, first_difference="", line="")
    checks = SelfChecks(PAPER, parts, parts, np.zeros(2), parts)
    requests = []
    for cycle in range(101):
        if cycle % 100 == 0:
            arm.accept_status(bytes(encoded(codec.message("Drive1Status"), 700, 0x0237)), cycle)
        arm.accept_cyclic(bytes(encoded(codec.message("Drive1Feedback"), 0.5, 0.0, 10, 0, 0)), cycle)
        requests.append(checks.judge(SimpleNamespace(cycle=cycle, is_enabled=True), SchemeState.ENABLE))  # type: ignore[arg-type]
    assert requests == [Request.NONE] * 100 + [Request.FAULT_TORQUE]


def test_an_implausible_frame_changes_no_status_either(tmp_path: Path) -> None:
    arm, codec = wide_drive(tmp_path, STATUS + MODE)
    feedback = codec.message("Drive1Feedback")
    arm.accept_cyclic(bytes(encoded(feedback, 0.5, 0.0, 0x0237, 10, 0)), 0)
    assert not arm.accept_cyclic(bytes(encoded(feedback, 1.5, 0.0, 0x0218, 10, 0)), 1)
    assert arm.state is Cia402State.OPERATION_ENABLED


def test_without_a_mode_in_any_frame_the_masters_check_stands(tmp_path: Path) -> None:
    arm, codec = wide_drive(tmp_path, STATUS + ERROR)
    assert not arm.is_enabled
    arm.accept_cyclic(bytes(encoded(codec.message("Drive1Feedback"), 0.0, 0.0, 0x0237, 0)), 0)
    assert arm.is_enabled


def test_the_command_carries_limit_and_offset_where_the_contract_has_them(tmp_path: Path) -> None:
    extra = '{ object = "0x60B2", signal = "torque_offset" }, { object = "0x6072", signal = "max_torque" },'
    arm, codec = wide_drive(tmp_path, STATUS + ERROR, extra, permille=750)
    arm.accept_cyclic(bytes(encoded(codec.message("Drive1Feedback"), 0.0, 0.0, 0x0237, 0)), 0)
    frame = arm.command(-300, enable=True, quick_stop=False)
    assert codec.message("Drive1Command").decode_values(frame) == (0x0F, -300, 0, 750)


def test_a_command_signal_that_the_host_cant_fill_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CodecError, match="Drive1Command: signal upper_limit is none that the host can fill"):
        wide_drive(tmp_path, STATUS + ERROR, '{ object = "0x60E0", signal = "upper_limit" },')
