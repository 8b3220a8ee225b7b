"""One drive as the host sees it on CAN FD: everything protected, the status in the feedback; and how it begins."""

import dataclasses

import pytest

from adacd_hil.device.drive import (
    IMPLAUSIBLE_JUMP_RAD,
    TRANSITIONS,
    Cia402State,
    Controlword,
    Drive,
    Goal,
    torque_limit_permille,
)
from adacd_hil.settings.configuration import load_settings
from adacd_hil.wire.codec import Codec, CodecError, contract_folder, load_codec, parse_codec
from adacd_hil.wire.e2e import E2eStatus

FD = load_codec(contract_folder() / "arm_fd.dbc")
CLASSIC = load_codec()
PERIOD_S = 0.001
FEEDBACK = FD.message("Drive1Feedback")
OPERATION_ENABLED = 0x0237
VALUES = (0.25, -0.5, OPERATION_ENABLED, 10, 0x11, -120, 0x8130, 345, 777)
"""position, velocity, statusword, mode, error register, torque actual, error code, torque demand, acted commands"""


def drive(codec: Codec = FD, **options: int) -> Drive:
    return Drive(codec, 1, PERIOD_S, **options)


class Sender:
    """The drive's end: protects feedback as the drive does."""

    def __init__(self) -> None:
        self._sender = FEEDBACK.sender()

    def frame(self, *values: float) -> bytes:
        return self._sender.protect(FEEDBACK.encode(*(values or VALUES)))


def test_protected_feedback_brings_motion_and_status() -> None:
    seen = drive()
    assert seen.accept_cyclic(Sender().frame(), 7) is True
    assert (seen.values[0], seen.values[1]) == pytest.approx((0.25, -0.5), abs=1e-5)
    assert (seen.sample_cycle, seen.status_cycle) == (7, 7)
    assert (seen.state, seen.mode, seen.statusword) == (Cia402State.OPERATION_ENABLED, 10, OPERATION_ENABLED)
    assert (seen.torque_actual_permille, seen.torque_demand_permille) == (-120, 345)
    assert (seen.error_code, seen.error_register, seen.acted_commands) == (0x8130, 0x11, 777)
    assert (seen.is_protected, seen.has_status_frame) == (True, False)


def test_a_frame_that_fails_its_check_changes_nothing() -> None:
    seen = drive()
    frame = bytearray(Sender().frame())
    frame[5] ^= 0x40
    assert seen.accept_cyclic(bytes(frame), 7) is False
    assert (seen.values[0], seen.sample_cycle, seen.status_cycle, seen.statusword) == (0.0, -1, -1, 0)
    assert dict(seen.end_to_end.tally())[E2eStatus.WRONG_CRC] == 1
    assert seen.implausible_frames == 0


def test_protected_feedback_needs_no_plausibility() -> None:
    seen, sender = drive(), Sender()
    seen.accept_cyclic(sender.frame(), 0)
    assert seen.accept_cyclic(sender.frame(0.25 + 10 * IMPLAUSIBLE_JUMP_RAD, 0.0, *VALUES[2:]), 1) is True


def test_a_cycle_without_feedback_is_counted() -> None:
    seen = drive()
    seen.accept_cyclic(Sender().frame(), 0)
    seen.miss()
    assert dict(seen.end_to_end.tally())[E2eStatus.NO_NEW_DATA] == 1


def test_an_implausible_frame_is_refused_by_a_plain_no() -> None:
    seen = drive(CLASSIC)
    message = CLASSIC.message("Drive1Feedback")
    seen.accept_cyclic(bytes(message.encode(0.0, 0.0)), 0)
    assert seen.accept_cyclic(bytes(message.encode(1.0, 0.0)), 1) is False


@pytest.mark.parametrize("codec", [FD, CLASSIC], ids=["fd", "classic"])
def test_a_drive_begins_with_nothing_known(codec: Codec) -> None:
    begun = drive(codec)
    assert (begun.sample_cycle, begun.status_cycle, begun.implausible_frames) == (-1, -1, 0)
    assert (begun.statusword, begun.mode, begun.state) == (0, 0, Cia402State.NOT_READY_TO_SWITCH_ON)
    assert (begun.torque_actual_permille, begun.torque_demand_permille) == (0, 0)
    assert (begun.error_code, begun.error_register, begun.acted_commands) == (0, 0, 0)
    assert begun.is_protected is (codec is FD)


def command_of(frame: bytes) -> tuple[int, ...]:
    return tuple(int(value) for value in FD.message("Drive1Command").decode_values(frame))


def test_a_command_carries_limit_and_no_offset_and_is_zero_until_it_is_more() -> None:
    assert command_of(drive().lead(Goal.SWITCH_ON_DISABLED)) == (Controlword.DISABLE_VOLTAGE, 0, 0, 1000)
    assert command_of(drive(max_torque_permille=321).lead(Goal.SWITCH_ON_DISABLED))[3] == 321


def test_leading_up_without_a_torque_leaves_zero() -> None:
    seen = drive()
    seen.accept_cyclic(Sender().frame(), 0)
    assert command_of(seen.lead(Goal.OPERATION_ENABLED)) == (Controlword.ENABLE_OPERATION, 0, 0, 1000)
    assert command_of(seen.lead(Goal.OPERATION_ENABLED, 55))[1] == 55


def test_the_first_fault_reset_is_a_rising_edge() -> None:
    seen, sender = drive(), Sender()
    seen.accept_cyclic(sender.frame(0.0, 0.0, 0x0218, *VALUES[3:]), 0)
    words = [command_of(seen.lead(Goal.OPERATION_ENABLED))[0] for _ in range(3)]
    assert words == [Controlword.FAULT_RESET, Controlword.DISABLE_VOLTAGE, Controlword.FAULT_RESET]


def test_each_row_of_the_table_is_reached_by_its_own_command() -> None:
    assert {key: row.command for key, row in TRANSITIONS.items()} == {key: key[1] for key in TRANSITIONS}


def test_the_status_frame_must_be_the_contracts() -> None:
    seen = drive()
    seen.accept_status(bytes(7), 3)  # this contract has none
    assert seen.status_cycle == -1


def test_a_contract_without_a_statusword_is_refused() -> None:
    text = FD.text.replace(b"SG_ statusword :", b"SG_ stateword :")
    with pytest.raises(CodecError, match="Drive1: no message carries signal statusword"):
        drive(parse_codec(text, FD.path))


def test_a_signal_that_is_missing_is_named() -> None:
    with pytest.raises(CodecError, match="Drive1Feedback has no signal torque"):
        FEEDBACK.place("torque")


def test_the_torque_limit_fits_its_object() -> None:
    settings = load_settings()
    strong = dataclasses.replace(settings.arm, torque_limit_Nm=(1000.0, 1000.0), rated_torque_Nm=(0.1, 0.1))
    assert torque_limit_permille(dataclasses.replace(settings, arm=strong), 0) == 0xFFFF
