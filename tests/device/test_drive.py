"""One drive as the host sees it."""

from pathlib import Path

import pytest

import adacd_hil
from adacd_hil.device.contract import load_contract
from adacd_hil.device.drive import (
    IMPLAUSIBLE_JUMP_RAD,
    TRANSITIONS,
    Cia402State,
    Controlword,
    Drive,
    Goal,
    decode_statusword,
    option_codes,
    torque_limit_permille,
)
from adacd_hil.device.profile import load_profile
from adacd_hil.settings.configuration import Settings, load_settings
from adacd_hil.settings.schema import parse
from adacd_hil.wire.codec import Codec, CodecError, load_codec

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
    up = {Controlword.SHUTDOWN, Controlword.SWITCH_ON, Controlword.ENABLE_OPERATION, Controlword.FAULT_RESET}
    steps = {t.number: (s.name, t.target.name) for (s, command), t in TRANSITIONS.items() if command in up}
    assert {number: steps[number] for number in (2, 3, 4, 15)} == {
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
    arm.accept_status(status_frame(statusword), 0)
    assert command_of(arm.command(0, enable=True, quick_stop=False))[0] == controlword


@pytest.mark.parametrize("statusword", [0x0250, 0x0231, 0x0233, 0x0217, 0x0218])
def test_torque_is_zero_on_the_wire_until_the_drive_is_enabled(statusword: int) -> None:
    arm = drive()
    arm.accept_status(status_frame(statusword), 0)
    assert command_of(arm.command(500, enable=True, quick_stop=False))[1] == 0


def test_an_enabled_drive_gets_its_torque() -> None:
    arm = drive()
    arm.accept_status(status_frame(0x0237), 0)
    assert command_of(arm.command(-500, enable=True, quick_stop=False)) == (0x000F, -500)


def test_a_drive_in_another_mode_gets_no_torque() -> None:
    arm = drive()
    arm.accept_status(status_frame(0x0237, mode=8), 0)
    assert command_of(arm.command(500, enable=True, quick_stop=False))[1] == 0


@pytest.mark.parametrize(("quick_stop", "controlword"), [(True, 0x0002), (False, 0x0000)])
def test_an_unwanted_drive_is_stopped_or_disabled_without_torque(quick_stop: bool, controlword: int) -> None:
    arm = drive()
    arm.accept_status(status_frame(0x0237), 0)
    assert command_of(arm.command(500, enable=False, quick_stop=quick_stop)) == (controlword, 0)


def test_a_faulted_drive_gets_rising_edges_of_fault_reset() -> None:
    arm = drive()
    arm.accept_status(status_frame(0x0218), 0)
    words = [command_of(arm.command(0, enable=True, quick_stop=False))[0] for _ in range(4)]
    assert words == [0x0080, 0x0000, 0x0080, 0x0000]


def test_plausible_feedback_is_taken_with_its_cycle() -> None:
    arm = drive()
    arm.accept_cyclic(feedback_frame(0.5, 1.0), 7)
    assert (round(arm.values[0], 5), arm.values[1], arm.sample_cycle) == (0.5, 1.0, 7)


def test_a_jump_of_position_changes_nothing() -> None:
    arm = drive()
    arm.accept_cyclic(feedback_frame(0.5, 1.0), 0)
    arm.accept_cyclic(feedback_frame(0.5 + 2 * IMPLAUSIBLE_JUMP_RAD, 1.0), 1)
    assert (round(arm.values[0], 5), arm.sample_cycle, arm.implausible_frames) == (0.5, 0, 1)


def test_fast_motion_is_no_jump() -> None:
    arm = drive()
    arm.accept_cyclic(feedback_frame(0.0, 30.0), 0)
    assert arm.accept_cyclic(feedback_frame(0.03, 30.0), 1)


def test_a_gap_of_cycles_is_no_jump() -> None:
    arm = drive()
    arm.accept_cyclic(feedback_frame(0.0, 5.0), 0)
    assert arm.accept_cyclic(feedback_frame(0.05, 5.0), 10)


@pytest.mark.parametrize("length", [0, 7])
def test_a_frame_of_the_wrong_length_changes_nothing(length: int) -> None:
    arm = drive()
    arm.accept_cyclic(feedback_frame(0.5, 1.0), 0)
    arm.accept_status(bytes(length - 1) if length else b"", 0)
    assert arm.accept_cyclic(bytes(length), 1) is False


# IEC 61800-7-201, table of transitions: what each command does in each state; nothing where it isn't listed.
TABLE = {
    "NOT_READY_TO_SWITCH_ON": {},
    "SWITCH_ON_DISABLED": {"SHUTDOWN": (2, "READY_TO_SWITCH_ON")},
    "READY_TO_SWITCH_ON": {
        "SWITCH_ON": (3, "SWITCHED_ON"),
        "ENABLE_OPERATION": (3, "SWITCHED_ON"),
        "QUICK_STOP": (7, "SWITCH_ON_DISABLED"),
        "DISABLE_VOLTAGE": (7, "SWITCH_ON_DISABLED"),
    },
    "SWITCHED_ON": {
        "ENABLE_OPERATION": (4, "OPERATION_ENABLED"),
        "SHUTDOWN": (6, "READY_TO_SWITCH_ON"),
        "QUICK_STOP": (10, "SWITCH_ON_DISABLED"),
        "DISABLE_VOLTAGE": (10, "SWITCH_ON_DISABLED"),
    },
    "OPERATION_ENABLED": {
        "SWITCH_ON": (5, "SWITCHED_ON"),  # as bits: disable operation
        "SHUTDOWN": (8, "READY_TO_SWITCH_ON"),
        "DISABLE_VOLTAGE": (9, "SWITCH_ON_DISABLED"),
        "QUICK_STOP": (11, "QUICK_STOP_ACTIVE"),
    },
    "QUICK_STOP_ACTIVE": {
        "DISABLE_VOLTAGE": (12, "SWITCH_ON_DISABLED"),
        "ENABLE_OPERATION": (16, "OPERATION_ENABLED"),
    },
    "FAULT_REACTION_ACTIVE": {},
    "FAULT": {"FAULT_RESET": (15, "SWITCH_ON_DISABLED")},
}
WORD_OF = {
    "NOT_READY_TO_SWITCH_ON": 0x0000,
    "SWITCH_ON_DISABLED": 0x0250,
    "READY_TO_SWITCH_ON": 0x0231,
    "SWITCHED_ON": 0x0233,
    "OPERATION_ENABLED": 0x0237,
    "QUICK_STOP_ACTIVE": 0x0217,
    "FAULT_REACTION_ACTIVE": 0x021F,
    "FAULT": 0x0218,
}
GOALS = {  # the next controlword by goal and state; quick stop option code unknown
    Goal.OPERATION_ENABLED: (0x00, 0x06, 0x07, 0x0F, 0x0F, 0x00, 0x00, 0x80),
    Goal.SWITCHED_ON: (0x00, 0x06, 0x07, 0x07, 0x07, 0x00, 0x00, 0x80),
    Goal.READY_TO_SWITCH_ON: (0x00, 0x06, 0x06, 0x06, 0x06, 0x00, 0x00, 0x80),
    Goal.SWITCH_ON_DISABLED: (0x00,) * 8,
    Goal.QUICK_STOP_ACTIVE: (0x02,) * 8,
}


@pytest.mark.parametrize("state", list(Cia402State))
@pytest.mark.parametrize("command", list(Controlword))
def test_each_command_in_each_state_is_the_standards(state: Cia402State, command: Controlword) -> None:
    found = TRANSITIONS.get((state, command))
    expected = TABLE[state.name].get(command.name)
    assert (None if found is None else (found.number, found.target.name)) == expected


@pytest.mark.parametrize("goal", list(Goal))
@pytest.mark.parametrize("state", list(Cia402State))
def test_each_goal_in_each_state_has_its_command(goal: Goal, state: Cia402State) -> None:
    arm = drive()
    arm.accept_status(status_frame(WORD_OF[state.name]), 0)
    assert command_of(arm.lead(goal))[0] == GOALS[goal][state]


@pytest.mark.parametrize("goal", [Goal.OPERATION_ENABLED, Goal.SWITCHED_ON, Goal.READY_TO_SWITCH_ON])
@pytest.mark.parametrize("state", list(Cia402State))
def test_only_a_transition_of_the_standard_leads_on(goal: Goal, state: Cia402State) -> None:
    arm = drive()
    arm.accept_status(status_frame(WORD_OF[state.name]), 0)
    word = command_of(arm.lead(goal))[0]
    target = TRANSITIONS.get((state, Controlword(word)))
    reached = state if target is None else target.target
    toward = {Goal.OPERATION_ENABLED: 4, Goal.SWITCHED_ON: 3, Goal.READY_TO_SWITCH_ON: 2}[goal]
    if state in (1, 2, 3, 4):
        assert abs(toward - reached) <= abs(toward - state)
    assert reached is not Cia402State.OPERATION_ENABLED or state in (3, 4)


@pytest.mark.parametrize("goal", [goal for goal in Goal if goal is not Goal.OPERATION_ENABLED])
@pytest.mark.parametrize("state", list(Cia402State))
def test_no_other_goal_passes_torque(goal: Goal, state: Cia402State) -> None:
    arm = drive()
    arm.accept_status(status_frame(WORD_OF[state.name]), 0)
    assert command_of(arm.lead(goal, 500))[1] == 0


@pytest.mark.parametrize("state", list(Cia402State))
@pytest.mark.parametrize("mode", [-1, 0, 4, 8, 9, 10])
def test_torque_passes_in_one_state_and_one_mode_only(state: Cia402State, mode: int) -> None:
    arm = drive()
    arm.accept_status(status_frame(WORD_OF[state.name], mode), 0)
    is_allowed = state is Cia402State.OPERATION_ENABLED and mode == 10
    assert command_of(arm.command(500, enable=True, quick_stop=False))[1] == 500 * is_allowed


def test_fault_reset_rises_once_more_for_the_next_fault() -> None:
    arm = drive()
    words = []
    for statusword in (0x0218, 0x0218, 0x0250, 0x0218, 0x0218):
        arm.accept_status(status_frame(statusword), 0)
        words.append(command_of(arm.command(0, enable=True, quick_stop=False))[0])
    assert words == [0x80, 0x00, 0x06, 0x80, 0x00]


def test_fault_reset_is_low_before_it_is_high_again_even_if_the_fault_is_a_new_one() -> None:
    arm = drive()
    words = []
    for goal in (Goal.OPERATION_ENABLED, Goal.QUICK_STOP_ACTIVE, Goal.OPERATION_ENABLED, Goal.OPERATION_ENABLED):
        arm.accept_status(status_frame(0x0218), 0)
        words.append(command_of(arm.lead(goal))[0])
    assert words == [0x80, 0x02, 0x80, 0x00]


@pytest.mark.parametrize(
    ("option", "statusword", "velocity", "controlword"),
    [
        (None, 0x0217, 1.0, 0x00),  # unknown: out, whatever it does
        (0, 0x0217, 1.0, 0x02),  # below 5 the drive leaves by itself; disable voltage would let it coast
        (2, 0x0217, 1.0, 0x02),
        (2, 0x0617, 0.0, 0x02),
        (4, 0x0217, 0.0, 0x02),
        (5, 0x0217, 1.0, 0x02),  # from 5 on it stays: first it brakes
        (5, 0x0617, 1.0, 0x00),  # bit 10: it stands still
        (6, 0x0217, 0.01, 0x00),  # a drive that leaves bit 10 alone stands still all the same
        (6, 0x0217, -1.0, 0x02),
        (7, 0x0617, 1.0, 0x00),
        (8, 0x0217, 1.0, 0x02),
    ],
)
def test_quick_stop_is_left_as_its_option_code_demands(
    option: int | None, statusword: int, velocity: float, controlword: int
) -> None:
    arm = Drive(CODEC, 1, PERIOD_S, option)
    arm.accept_cyclic(feedback_frame(0.0, velocity), 0)
    arm.accept_status(status_frame(statusword), 0)
    assert command_of(arm.command(500, enable=True, quick_stop=False)) == (controlword, 0)


def test_the_configurations_option_codes_outweigh_the_profiles() -> None:
    profile = load_profile("adacd-drive", "drive").settings
    settings = parse(Settings, {"devices": {"quick_stop_option": 6}})
    assert option_codes(settings, profile) == (6, 2)


def test_the_torque_limit_is_per_mille_of_rated_torque() -> None:
    settings = parse(Settings, {"arm": {"rated_torque_Nm": [12.0, 8.0], "torque_limit_Nm": [6.0, 8.0]}})
    assert [torque_limit_permille(settings, joint) for joint in (0, 1)] == [500, 1000]


def wide_contract(folder: Path, signals: str, command: str = "") -> Codec:
    """A contract of unprotected drives with the status in the feedback."""
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
    path = folder / "wide.toml"
    path.write_text(text)
    sensor = list(load_settings("stock").devices.sensor)
    return load_contract(
        parse(
            Settings,
            {"devices": {"drive": [str(path)] * 2, "sensor": sensor, "contract": "", "data_bitrate": 5_000_000}},
        )
    )


STATUS = '{ object = "0x6041", signal = "statusword" }, '
MODE = '{ object = "0x6061", signal = "mode_display" }, { object = "0x1001", signal = "error_register" }'
ERROR = '{ object = "0x603F", signal = "error_code" }'


def test_the_status_may_travel_in_the_feedback(tmp_path: Path) -> None:
    codec = wide_contract(tmp_path, STATUS + MODE)
    arm = Drive(codec, 1, PERIOD_S)
    frame = bytes(codec.message("Drive1Feedback").encode(0.5, 1.0, 0x0237, 10, 0x81))
    assert arm.accept_cyclic(frame, 7)
    assert (arm.state, arm.mode, arm.error_register, arm.status_cycle) == (Cia402State.OPERATION_ENABLED, 10, 0x81, 7)
    assert (arm.has_status_frame, arm.status_message, arm.is_enabled) == (False, None, True)


def test_an_implausible_frame_changes_no_status_either(tmp_path: Path) -> None:
    codec = wide_contract(tmp_path, STATUS + MODE)
    arm = Drive(codec, 1, PERIOD_S)
    feedback = codec.message("Drive1Feedback")
    arm.accept_cyclic(bytes(feedback.encode(0.5, 0.0, 0x0237, 10, 0)), 0)
    assert not arm.accept_cyclic(bytes(feedback.encode(1.5, 0.0, 0x0218, 10, 0)), 1)
    assert arm.state is Cia402State.OPERATION_ENABLED


def test_without_a_mode_in_any_frame_the_masters_check_stands(tmp_path: Path) -> None:
    codec = wide_contract(tmp_path, STATUS + ERROR)
    arm = Drive(codec, 1, PERIOD_S)
    assert not arm.is_enabled
    arm.accept_cyclic(bytes(codec.message("Drive1Feedback").encode(0.0, 0.0, 0x0237, 0)), 0)
    assert arm.is_enabled


def test_the_command_carries_limit_and_offset_where_the_contract_has_them(tmp_path: Path) -> None:
    extra = '{ object = "0x60B2", signal = "torque_offset" }, { object = "0x6072", signal = "max_torque" },'
    codec = wide_contract(tmp_path, STATUS + ERROR, extra)
    arm = Drive(codec, 1, PERIOD_S, max_torque_permille=750)
    arm.accept_cyclic(bytes(codec.message("Drive1Feedback").encode(0.0, 0.0, 0x0237, 0)), 0)
    frame = arm.command(-300, enable=True, quick_stop=False)
    assert codec.message("Drive1Command").decode_values(frame) == (0x0F, -300, 0, 750)


def test_a_command_signal_that_the_host_cant_fill_is_refused(tmp_path: Path) -> None:
    codec = wide_contract(tmp_path, STATUS + ERROR, '{ object = "0x60E0", signal = "upper_limit" },')
    with pytest.raises(CodecError, match="Drive1Command: signal upper_limit is none that the host can fill"):
        Drive(codec, 1, PERIOD_S)
