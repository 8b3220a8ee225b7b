"""Drives and sensors joined into one arm."""

import math

import numpy as np
import pytest
from loaded import encoded

from adacd_hil.clock import VirtualClock
from adacd_hil.device.arm import Arm
from adacd_hil.device.arm_report import describe_checks, describe_excess, describe_faults
from adacd_hil.device.device_files import place_devices
from adacd_hil.records import ArmCommand, FaultReason
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.parsing import parse
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.dbc_contract import load_codec
from adacd_hil.wire.e2e import E2eSender
from adacd_hil.wire.embedded_bus import EmbeddedBus

CODEC = load_codec()


class Devices:
    """Answers with what a test wants, and keeps what the host sent."""

    def __init__(self, arm_table: dict[str, object] | None = None, schedule: str = "same_cycle") -> None:
        self.sent: list[Frame] = []
        bus = EmbeddedBus(VirtualClock())
        bus.attach(self.sent.append)
        settings = parse(Settings, {"arm": arm_table or {}, "bus": {"schedule": schedule}})
        self.arm = Arm(settings, CODEC, place_devices(settings), bus)
        self._senders: dict[str, E2eSender] = {n: CODEC.message(n).sender() for n in ("Sensor1Torque", "Sensor2Torque")}

    def send(self, name: str, *values: float) -> None:
        frame = encoded(CODEC.message(name), *values)
        data = self._senders[name].protect(frame) if name in self._senders else bytes(frame)
        self.arm.accept(Frame(CODEC.message(name).can_id, data, 0))

    def answer(self, without: tuple[str, ...] = ()) -> None:
        values = {
            "Drive1Feedback": (0.1, 0.01),
            "Drive2Feedback": (-0.2, -0.02),
            "Sensor1Torque": (1.5,),
            "Sensor2Torque": (-2.5,),
        }
        for name in values.keys() - set(without):
            self.send(name, *values[name])

    def enable(self) -> None:
        for name in ("Drive1Status", "Drive2Status"):
            self.send(name, 0x0237, 10, 0, 0)


@pytest.mark.parametrize("missing", ["Drive1Feedback", "Drive2Feedback", "Sensor1Torque", "Sensor2Torque"])
def test_a_cycle_is_complete_when_all_four_frames_are_in_and_a_missing_one_is_named(missing: str) -> None:
    devices = Devices()
    devices.arm.synchronise(0, 0, 1)
    devices.answer(without=(missing,))
    assert devices.arm.missing_names() == [missing.removesuffix("Feedback").removesuffix("Torque")]
    devices.answer()
    assert devices.arm.state().is_complete


def test_sign_zero_and_offset_are_applied_in_joint_order_and_the_raw_torque_stays() -> None:
    devices = Devices({"sign": [1, -1], "zero_deg": [30.0, -20.0], "torque_offset_Nm": [0.5, 0.25]})
    devices.arm.synchronise(0, 0, 1)
    devices.answer()
    state = devices.arm.state()
    np.testing.assert_allclose(state.q, [0.1 - math.radians(30.0), 0.2 + math.radians(20.0)], atol=3e-6)
    np.testing.assert_allclose([*state.dq, *state.tau_J], [0.01, 0.02, 1.0, 2.25], atol=3e-6)
    assert [sensor.values[0] for sensor in devices.arm.sensors] == [1.5, -2.5]


def test_ages_count_cycles_since_the_sample() -> None:
    devices = Devices()
    devices.arm.synchronise(0, 0, 1)
    devices.answer()
    devices.arm.state()
    devices.arm.synchronise(2, 0, 2)
    devices.answer(without=("Drive2Feedback", "Sensor1Torque"))
    state = devices.arm.state()
    assert (state.age_q, state.age_tau_J, state.periods) == ((0, 2), (2, 0), 2)


def test_a_frame_with_a_wrong_crc_counts_as_seen_but_changes_nothing() -> None:
    devices = Devices()
    devices.arm.synchronise(0, 0, 1)
    devices.answer(without=("Sensor2Torque",))
    devices.arm.accept(Frame(CODEC.message("Sensor2Torque").can_id, bytes(6), 0))
    assert (devices.arm.has_all_frames, devices.arm.missing_frames) == (True, 1)
    devices.arm.synchronise(1, 0, 1)
    assert "1 WRONG_CRC, 0 NO_NEW_DATA" in describe_checks(devices.arm)[3]


def test_the_sync_counter_runs_from_1_to_240() -> None:
    devices = Devices()
    for cycle in (0, 239, 240, 481):
        devices.arm.synchronise(cycle, 0, 1)
    assert [frame.data[0] for frame in devices.sent] == [1, 240, 1, 2]


def test_torque_goes_out_per_mille_of_rated_torque_with_the_joints_sign() -> None:
    devices = Devices({"sign": [1, -1], "rated_torque_Nm": [12.0, 6.0]})
    devices.enable()
    devices.arm.send_command(ArmCommand(np.array((3.0, 1.5)), enable=True, quick_stop=False))
    values = [CODEC.by_id[frame.can_id].decode_values(frame.data) for frame in devices.sent]
    assert values == [(15.0, 250.0), (15.0, -250.0)]


def test_a_drive_that_was_enabled_and_drops_out_is_a_fault_and_described() -> None:
    devices = Devices()
    devices.send("Drive1Status", 0x0237, 10, 0, 0)
    assert not devices.arm.state().is_enabled  # both must be
    assert describe_faults(devices.arm) == []
    devices.send("Drive2Status", 0x0218, 10, 0, 0x8250)
    assert devices.arm.state().fault is FaultReason.NONE  # it has not been enabled
    assert describe_faults(devices.arm) == ["Drive2: FAULT, error code 0x8250: RPDO timeout"]
    devices.enable()
    assert devices.arm.state().is_enabled
    devices.send("Drive1Status", 0x0250, 10, 0, 0)
    assert devices.arm.state().fault is FaultReason.DRIVE
    expected = "Drive1: SWITCH_ON_DISABLED, mode 10, OPERATION_ENABLED in mode 10 expected"
    assert describe_faults(devices.arm) == [expected]


def test_a_sensor_that_says_its_value_is_not_valid_is_a_fault_described_in_words() -> None:
    devices = Devices()
    devices.send("Sensor1Status", 3, 0)
    assert devices.arm.state().fault is FaultReason.SENSOR
    assert describe_faults(devices.arm) == ["Sensor1: status 0x03: positive overload, not valid"]


def test_a_joint_beyond_its_limits_is_described_with_value_and_bound() -> None:
    devices = Devices({"sign": [1, -1], "zero_deg": [10.0, 0.0]})
    devices.arm.synchronise(0, 0, 1)
    devices.send("Drive1Feedback", np.radians(85.2), np.radians(250.0) - 1e-3)
    devices.send("Drive2Feedback", np.radians(119.9), np.radians(301.0))
    assert describe_excess(devices.arm) == [
        "joint 1: position 75.20 deg, ±75 deg allowed",
        "joint 2: velocity -301.00 deg/s, ±300 deg/s allowed",
    ]


def test_signals_that_are_too_old_are_described_with_age_and_limit() -> None:
    said = []
    for age in (3, 4):
        devices = Devices()
        devices.arm.synchronise(0, 0, 1)
        devices.answer()
        devices.arm.synchronise(age, 0, age)
        devices.answer(without=("Drive2Feedback", "Sensor1Torque"))
        said.append(describe_faults(devices.arm))
    assert said == [
        [],
        ["Drive2: position, velocity 4 cycles old, 3 allowed", "Sensor1: torque 4 cycles old, 3 allowed"],
    ]


def test_a_frame_with_the_same_counter_is_counted_as_repeated_and_answers_nothing() -> None:
    devices = Devices()
    can_id, sender = CODEC.message("Sensor1Torque").can_id, CODEC.message("Sensor1Torque").sender()
    data = sender.protect(encoded(CODEC.message("Sensor1Torque"), 1.5))
    for cycle in range(3):
        devices.arm.synchronise(cycle, 0, 1)
        devices.arm.accept(Frame(can_id, data, 0))
    assert devices.arm.repeats == [0, 0, 2, 0]
    assert devices.arm.sensors[0].sample_cycle == 0


@pytest.mark.parametrize(("cycle", "fault"), [(250, FaultReason.NONE), (251, FaultReason.DATA_AGE)])
def test_a_status_that_stays_away_from_an_enabled_drive_is_a_fault(cycle: int, fault: FaultReason) -> None:
    devices = Devices()
    devices.arm.synchronise(0, 0, 1)
    devices.enable()
    devices.arm.synchronise(cycle, 0, 1)
    devices.answer()
    assert devices.arm.state().fault is fault
    said = [f"Drive{joint}: status {cycle} cycles old, 250 allowed" for joint in (1, 2)]
    assert describe_faults(devices.arm) == (said if cycle > 250 else [])


def test_a_late_frame_is_of_the_cycle_before_skipped_periods_and_leaves_the_present_one_open() -> None:
    devices = Devices()
    devices.arm.synchronise(0, 0, 1)
    devices.arm.synchronise(75, 0, 75)
    feedback = CODEC.message("Drive1Feedback")
    status = CODEC.message("Drive1Status")
    devices.arm.accept(Frame(feedback.can_id, bytes(encoded(feedback, 0.1, 0.01)), 0), is_late=True)
    devices.arm.accept(Frame(status.can_id, bytes(encoded(status, 0x0237, 10, 0, 0)), 0), is_late=True)
    assert (devices.arm.drives[0].sample_cycle, devices.arm.drives[0].status_cycle) == (0, 0)
    assert devices.arm.missing_frames == 4
    assert not devices.arm.has_all_frames
    assert devices.arm.state().age_q[0] == 75


COMMANDED = ArmCommand(np.array((1.2, -0.6)), enable=True, quick_stop=False)
TORQUES = (100, -100)
"""Per mille of the rated 12 and 6 Nm."""


def enabled_devices(schedule: str) -> Devices:
    devices = Devices(schedule=schedule)
    devices.arm.synchronise(0, 0, 1)
    devices.enable()
    devices.sent.clear()
    return devices


def sent_torques(devices: Devices) -> tuple[int, ...]:
    command = CODEC.message("Drive1Command")
    return tuple(int(command.decode_values(frame.data)[-1]) for frame in devices.sent if frame.can_id != 0x080)


def test_commands_of_the_same_cycle_leave_at_once_and_once() -> None:
    devices = enabled_devices("same_cycle")
    devices.arm.send_command(COMMANDED)
    assert [frame.can_id for frame in devices.sent] == [0x201, 0x202]
    assert sent_torques(devices) == TORQUES
    devices.arm.synchronise(1, 0, 1)
    assert [frame.can_id for frame in devices.sent] == [0x201, 0x202, 0x080]


def test_pipelined_commands_leave_behind_the_next_sync_and_once() -> None:
    devices = enabled_devices("pipelined")
    devices.arm.send_command(COMMANDED)
    assert devices.sent == []
    devices.arm.synchronise(1, 0, 1)
    assert [frame.can_id for frame in devices.sent] == [0x080, 0x201, 0x202]
    assert sent_torques(devices) == TORQUES
    devices.arm.synchronise(2, 0, 1)
    assert [frame.can_id for frame in devices.sent] == [0x080, 0x201, 0x202, 0x080]


@pytest.mark.parametrize(("periods", "torques"), [(3, TORQUES), (4, (0, 0))])
def test_a_pipelined_command_kept_for_longer_than_the_age_budget_carries_no_torque(
    periods: int, torques: tuple[int, ...]
) -> None:
    devices = enabled_devices("pipelined")
    devices.arm.send_command(COMMANDED)
    devices.arm.synchronise(periods, 0, periods)
    assert sent_torques(devices) == torques
