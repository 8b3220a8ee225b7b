"""One drive as the host sees it."""

import pytest

from adacd_hil.device.drive import IMPLAUSIBLE_JUMP_RAD, TOWARD_ENABLED, Cia402State, Drive, decode_statusword
from adacd_hil.wire.codec import load_codec

CODEC = load_codec()
PERIOD_S = 0.001

# statusword as a drive sends it, with bits beyond the mask set at will; IEC 61800-7-201 table 30
STATUSWORDS = [
    (0x0000, Cia402State.NOT_READY_TO_SWITCH_ON),
    (0x0250, Cia402State.SWITCH_ON_DISABLED),
    (0x0270, Cia402State.SWITCH_ON_DISABLED),
    (0x0231, Cia402State.READY_TO_SWITCH_ON),
    (0x0233, Cia402State.SWITCHED_ON),
    (0x1637, Cia402State.OPERATION_ENABLED),
    (0x0217, Cia402State.QUICK_STOP_ACTIVE),
    (0x021F, Cia402State.FAULT_REACTION_ACTIVE),
    (0x0218, Cia402State.FAULT),
    (0x0238, Cia402State.FAULT),
    (0x0211, Cia402State.NOT_READY_TO_SWITCH_ON),
]


def drive() -> Drive:
    return Drive(CODEC, 1, PERIOD_S)


def status_frame(statusword: int, mode: int = 10) -> bytes:
    return bytes(CODEC.message("Drive1Status").encode(statusword, mode, 0, 0))


def feedback_frame(position_rad: float, velocity_rad_s: float) -> bytes:
    return bytes(CODEC.message("Drive1Feedback").encode(position_rad, velocity_rad_s))


def command_of(frame: bytes) -> tuple[int, int]:
    controlword, torque = CODEC.message("Drive1Command").decode_values(frame)
    return int(controlword), int(torque)


@pytest.mark.parametrize(("statusword", "state"), STATUSWORDS)
def test_a_statusword_reads_as_the_standards_state(statusword: int, state: Cia402State) -> None:
    assert decode_statusword(statusword) is state


def test_the_way_up_has_the_standards_numbers() -> None:
    assert {t.number: (s.name, t.target.name) for s, t in TOWARD_ENABLED.items()} == {
        2: ("SWITCH_ON_DISABLED", "READY_TO_SWITCH_ON"),
        3: ("READY_TO_SWITCH_ON", "SWITCHED_ON"),
        4: ("SWITCHED_ON", "OPERATION_ENABLED"),
        15: ("FAULT", "SWITCH_ON_DISABLED"),
    }


@pytest.mark.parametrize(
    ("statusword", "controlword"),
    [(0x0250, 0x0006), (0x0231, 0x0007), (0x0233, 0x000F), (0x0237, 0x000F), (0x0217, 0x0000), (0x021F, 0x0000)],
)
def test_a_wanted_drive_is_led_up_state_by_state(statusword: int, controlword: int) -> None:
    arm = drive()
    arm.accept_status(status_frame(statusword))
    assert command_of(arm.command(0, enable=True, quick_stop=False))[0] == controlword


@pytest.mark.parametrize("statusword", [0x0250, 0x0231, 0x0233, 0x0217, 0x0218])
def test_torque_is_zero_on_the_wire_until_the_drive_is_enabled(statusword: int) -> None:
    arm = drive()
    arm.accept_status(status_frame(statusword))
    assert command_of(arm.command(500, enable=True, quick_stop=False))[1] == 0


def test_an_enabled_drive_gets_its_torque() -> None:
    arm = drive()
    arm.accept_status(status_frame(0x0237))
    assert command_of(arm.command(-500, enable=True, quick_stop=False)) == (0x000F, -500)


def test_a_drive_in_another_mode_gets_no_torque() -> None:
    arm = drive()
    arm.accept_status(status_frame(0x0237, mode=8))
    assert command_of(arm.command(500, enable=True, quick_stop=False))[1] == 0


@pytest.mark.parametrize(("quick_stop", "controlword"), [(True, 0x0002), (False, 0x0000)])
def test_an_unwanted_drive_is_stopped_or_disabled_without_torque(quick_stop: bool, controlword: int) -> None:
    arm = drive()
    arm.accept_status(status_frame(0x0237))
    assert command_of(arm.command(500, enable=False, quick_stop=quick_stop)) == (controlword, 0)


def test_a_faulted_drive_gets_rising_edges_of_fault_reset() -> None:
    arm = drive()
    arm.accept_status(status_frame(0x0218))
    words = [command_of(arm.command(0, enable=True, quick_stop=False))[0] for _ in range(4)]
    assert words == [0x0080, 0x0000, 0x0080, 0x0000]


def test_plausible_feedback_is_taken_with_its_cycle() -> None:
    arm = drive()
    arm.accept_feedback(feedback_frame(0.5, 1.0), 7)
    assert (round(arm.position_rad, 5), arm.velocity_rad_s, arm.sample_cycle) == (0.5, 1.0, 7)


def test_a_jump_of_position_changes_nothing() -> None:
    arm = drive()
    arm.accept_feedback(feedback_frame(0.5, 1.0), 0)
    arm.accept_feedback(feedback_frame(0.5 + 2 * IMPLAUSIBLE_JUMP_RAD, 1.0), 1)
    assert (round(arm.position_rad, 5), arm.sample_cycle, arm.implausible_frames) == (0.5, 0, 1)


def test_fast_motion_is_no_jump() -> None:
    arm = drive()
    arm.accept_feedback(feedback_frame(0.0, 30.0), 0)
    assert arm.accept_feedback(feedback_frame(0.03, 30.0), 1)


def test_a_gap_of_cycles_is_no_jump() -> None:
    arm = drive()
    arm.accept_feedback(feedback_frame(0.0, 5.0), 0)
    assert arm.accept_feedback(feedback_frame(0.05, 5.0), 10)


@pytest.mark.parametrize("length", [0, 7])
def test_a_frame_of_the_wrong_length_changes_nothing(length: int) -> None:
    arm = drive()
    arm.accept_feedback(feedback_frame(0.5, 1.0), 0)
    arm.accept_status(bytes(length - 1) if length else b"")
    assert arm.accept_feedback(bytes(length), 1) is False
