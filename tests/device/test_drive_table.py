"""The host's tables of a drive over every word that the bus can carry, and a drive that has said nothing yet."""

import math

import pytest

from adacd_hil.device.drive import (
    IMPLAUSIBLE_JUMP_RAD,
    TRANSITIONS,
    Cia402State,
    Controlword,
    Drive,
    decode_statusword,
)
from adacd_hil.wire.codec import load_codec

CODEC = load_codec()
PERIOD_S = 0.001

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


def expected_state(statusword: int) -> Cia402State:
    bits = f"{statusword & 0xFF:08b}"
    for pattern, state in CODING:
        if all(bit in ("x", given) for bit, given in zip(pattern, bits, strict=True)):
            return state
    return Cia402State.NOT_READY_TO_SWITCH_ON


def feedback(position_rad: float, velocity_rad_s: float) -> bytes:
    return bytes(CODEC.message("Drive1Feedback").encode(position_rad, velocity_rad_s))


def status(statusword: int, mode: int = 10, torque: int = 0, error: int = 0) -> bytes:
    return bytes(CODEC.message("Drive1Status").encode(statusword, mode, torque, error))


def controlword_of(frame: bytes) -> int:
    return int(CODEC.message("Drive1Command").decode_values(frame)[0])


def test_every_statusword_reads_as_the_standard_says() -> None:
    wrong = [word for word in range(0x10000) if decode_statusword(word) is not expected_state(word)]
    assert wrong == []


def test_states_and_controlwords_have_the_numbers_that_logs_and_wire_hold() -> None:
    assert [(state.name, state.value) for state in Cia402State] == [
        ("NOT_READY_TO_SWITCH_ON", 0),
        ("SWITCH_ON_DISABLED", 1),
        ("READY_TO_SWITCH_ON", 2),
        ("SWITCHED_ON", 3),
        ("OPERATION_ENABLED", 4),
        ("QUICK_STOP_ACTIVE", 5),
        ("FAULT_REACTION_ACTIVE", 6),
        ("FAULT", 7),
    ]
    words = {name: int(word) for name, word in Controlword.__members__.items() if name != "DISABLE_OPERATION"}
    assert words == {
        "DISABLE_VOLTAGE": 0x00,
        "QUICK_STOP": 0x02,
        "SHUTDOWN": 0x06,
        "SWITCH_ON": 0x07,
        "ENABLE_OPERATION": 0x0F,
        "FAULT_RESET": 0x80,
    }


def test_the_way_up_commands_what_the_standard_says() -> None:
    way = {
        "SWITCH_ON_DISABLED": (2, 0x06, "READY_TO_SWITCH_ON"),
        "READY_TO_SWITCH_ON": (3, 0x07, "SWITCHED_ON"),
        "SWITCHED_ON": (4, 0x0F, "OPERATION_ENABLED"),
        "FAULT": (15, 0x80, "SWITCH_ON_DISABLED"),
    }
    for state, expected in way.items():
        step = TRANSITIONS[Cia402State[state], Controlword(expected[1])]
        assert (step.number, int(step.command), step.target.name) == expected


@pytest.mark.parametrize("joint", [1, 2])
def test_a_drive_that_has_said_nothing_is_nowhere_and_not_ready(joint: int) -> None:
    drive = Drive(CODEC, joint, PERIOD_S)
    assert (drive.name, drive.node_id, drive.command_id) == (f"Drive{joint}", joint, 0x200 + joint)
    assert (drive.values[0], drive.values[1], drive.sample_cycle) == (0.0, 0.0, -1)
    assert (drive.state, drive.mode, drive.is_enabled) == (Cia402State.NOT_READY_TO_SWITCH_ON, 0, False)
    assert (drive.torque_actual_permille, drive.error_code, drive.implausible_frames) == (0, 0, 0)
    assert controlword_of(drive.command(100, enable=True, quick_stop=False)) == 0


def test_a_status_frame_says_state_mode_torque_and_error() -> None:
    drive = Drive(CODEC, 1, PERIOD_S)
    drive.accept_status(status(0x0218, 10, -123, 0x8250), 0)
    found = (drive.state, drive.mode, drive.torque_actual_permille, drive.error_code)
    assert found == (Cia402State.FAULT, 10, -123, 0x8250)


@pytest.mark.parametrize("length", [0, 6, 8])
def test_a_status_frame_of_the_wrong_length_says_nothing(length: int) -> None:
    drive = Drive(CODEC, 1, PERIOD_S)
    drive.accept_status((status(0x0237) + b"\x00")[:length], 0)
    assert (drive.state, drive.mode) == (Cia402State.NOT_READY_TO_SWITCH_ON, 0)


@pytest.mark.parametrize("length", [0, 7, 9])
def test_feedback_of_the_wrong_length_is_counted_and_leaves_the_next_frame_as_good_as_it_was(length: int) -> None:
    drive = Drive(CODEC, 1, PERIOD_S)
    assert drive.accept_cyclic(feedback(0.5, 0.0), 0) is True
    assert drive.accept_cyclic((feedback(0.5, 0.0) + b"\x00")[:length], 1) is False
    assert drive.implausible_frames == 1
    assert drive.accept_cyclic(feedback(0.5, 0.0), 2) is True


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("start_rad", "velocity_rad_s"), [(0.0, 0.0), (0.75, 2.0), (-1.5, -4.0)])
@pytest.mark.parametrize("periods", [1, 3])
def test_a_step_is_plausible_up_to_its_bound_off_what_the_velocity_says(
    start_rad: float, velocity_rad_s: float, periods: int, sign: float
) -> None:
    expected_rad = start_rad + velocity_rad_s * periods * PERIOD_S
    lsb_rad = 2.0 * math.pi / 2**20
    for off_rad, is_plausible in (
        (IMPLAUSIBLE_JUMP_RAD - 2 * lsb_rad, True),
        (IMPLAUSIBLE_JUMP_RAD + 2 * lsb_rad, False),
    ):
        drive = Drive(CODEC, 1, PERIOD_S)
        drive.accept_cyclic(feedback(start_rad, velocity_rad_s), 5)
        taken = drive.accept_cyclic(feedback(expected_rad + sign * off_rad, velocity_rad_s), 5 + periods)
        assert taken is is_plausible
        assert (drive.sample_cycle, drive.implausible_frames) == ((5 + periods, 0) if is_plausible else (5, 1))


def test_every_implausible_frame_is_counted() -> None:
    drive = Drive(CODEC, 1, PERIOD_S)
    for cycle, position_rad in enumerate((0.0, 1.0, 2.0, 3.0)):
        drive.accept_cyclic(feedback(position_rad, 0.0), cycle)
    assert drive.implausible_frames == 3


def test_the_bound_is_where_the_protocol_says() -> None:
    assert IMPLAUSIBLE_JUMP_RAD == 0.02
