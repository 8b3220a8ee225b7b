"""Whole runs against the emulator in one process, with something going wrong; torque is judged on the wire."""

import re
from pathlib import Path

import numpy as np
import pytest
from long_cases import long_but
from rig import (
    CODEC,
    DISABLE_VOLTAGE,
    ENABLE_OPERATION,
    ENABLED_CYCLE,
    QUICK_STOP,
    TROUBLE_CYCLE,
    SessionRig,
    controlwords,
    torques_from,
)

from adacd_hil.control.gate import GateFlag
from adacd_hil.lab.live.live_view import LiveView
from adacd_hil.log.robot_description import ROBOT_NAME
from adacd_hil.log.viewer_layout import LAYOUT_NAME
from adacd_hil.records import JOINT_NAMES, FaultReason, SchemeState
from adacd_hil.scheme.model.urdf import read_urdf
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.e2e import E2eStatus

pytestmark = pytest.mark.slow


def test_a_run_that_nothing_disturbs_ends_parked_and_disabled(tmp_path: Path) -> None:
    summary, log = SessionRig(tmp_path).run()
    assert summary.result is not None
    assert (summary.result.fault, summary.result.is_interrupted, summary.error) == (FaultReason.NONE, False, "")
    assert controlwords(log)[-1] == DISABLE_VOLTAGE
    assert np.abs(log.scheme["dq"][-1]).max() < 0.01


def test_the_gate_is_closed_until_the_arm_is_enabled(tmp_path: Path) -> None:
    _, log = SessionRig(tmp_path).run()
    assert np.count_nonzero(log.control["tau_c"][:ENABLED_CYCLE]) == 0
    assert set(log.control["gate_flags"][:ENABLED_CYCLE].tolist()) == {int(GateFlag.CLOSED)}


@pytest.mark.parametrize("can_id", long_but(1, [0x183, 0x181, 0x182, 0x184]))
def test_a_device_that_falls_silent_faults_the_run_after_its_age_budget(tmp_path: Path, can_id: int) -> None:
    rig = SessionRig(tmp_path)
    rig.tamper = lambda cycle, i, data: None if i == can_id and cycle >= TROUBLE_CYCLE else data
    summary, log = rig.run()
    assert summary.result is not None
    assert summary.result.fault is FaultReason.DATA_AGE
    first = int(np.argmax(log.scheme["state"] == SchemeState.FAULT))
    assert first == TROUBLE_CYCLE + 3


def test_a_device_whose_heartbeat_stops_faults_the_run_and_is_named(tmp_path: Path) -> None:
    rig = SessionRig(tmp_path)
    rig.tamper = lambda cycle, i, data: None if i == 0x703 and cycle >= TROUBLE_CYCLE else data
    summary, log = rig.run()
    assert summary.result is not None
    assert summary.result.fault is FaultReason.HEARTBEAT
    first = int(np.argmax(log.scheme["state"] == SchemeState.FAULT))
    assert TROUBLE_CYCLE + 150 < first <= TROUBLE_CYCLE + 260  # 2.5 periods of 100 ms after the last one
    (reason,) = [entry.event.message for entry in log.events if "-> FAULT" in entry.event.message]
    assert "Sensor1 (node 3): no heartbeat for" in reason


@pytest.mark.long
def test_error_frames_are_in_the_log_in_words(tmp_path: Path) -> None:
    rig = SessionRig(tmp_path)
    error_passive = bytes((0, 0x20, 0, 0, 0, 0, 130, 0))
    rig.before_sync[TROUBLE_CYCLE] = lambda: rig.bus.deliver(0x204, error_passive, is_error=True)
    summary, log = rig.run()
    assert summary.result is not None
    assert summary.result.fault is FaultReason.NONE
    (said,) = [entry.event for entry in log.events if entry.event.name == "bus"]
    assert (said.level, said.message) == (
        "warning",
        "error passive (sending); error counters: sending 130, receiving 0",
    )


def test_a_frame_that_is_not_what_its_identifier_says_is_dropped_and_counted(tmp_path: Path) -> None:
    rig = SessionRig(tmp_path)
    rig.before_sync[TROUBLE_CYCLE] = lambda: rig.bus.deliver(0x081, b"\x01\x02\x03")
    summary, log = rig.run()
    assert summary.result is not None
    assert summary.result.fault is FaultReason.NONE
    said = [entry.event.message for entry in log.events if entry.event.name == "frame checks"]
    assert said[-1] == "1 frames dropped that are not what their identifier says"


def test_after_a_fault_there_is_no_torque_on_the_wire_and_drives_are_stopped(tmp_path: Path) -> None:
    rig = SessionRig(tmp_path)
    rig.tamper = lambda cycle, i, data: None if i == 0x183 and cycle >= TROUBLE_CYCLE else data
    _, log = rig.run()
    assert np.any(torques_from(log, ENABLED_CYCLE)[:700] != 0)
    assert np.count_nonzero(torques_from(log, TROUBLE_CYCLE + 3)) == 0
    assert set(controlwords(log)[TROUBLE_CYCLE + 4 : -21].tolist()) == {QUICK_STOP}


def test_a_fault_is_latched_though_the_data_come_back(tmp_path: Path) -> None:
    rig = SessionRig(tmp_path)
    gap = range(TROUBLE_CYCLE, TROUBLE_CYCLE + 20)
    rig.tamper = lambda cycle, i, data: None if i == 0x183 and cycle in gap else data
    _, log = rig.run()
    assert set(log.scheme["state"][TROUBLE_CYCLE + 3 :].tolist()) == {int(SchemeState.FAULT)}


def test_two_lost_torque_frames_are_forgiven(tmp_path: Path) -> None:
    rig = SessionRig(tmp_path)
    gap = range(TROUBLE_CYCLE, TROUBLE_CYCLE + 2)
    rig.tamper = lambda cycle, i, data: None if i == 0x183 and cycle in gap else data
    summary, _ = rig.run()
    assert summary.result is not None
    assert summary.result.fault is FaultReason.NONE


@pytest.mark.long
def test_corrupted_torque_frames_count_as_lost_and_change_no_value(tmp_path: Path) -> None:
    rig = SessionRig(tmp_path)

    def corrupt(cycle: int, can_id: int, data: bytes) -> bytes:
        is_hit = can_id == 0x183 and cycle == TROUBLE_CYCLE
        return bytes((*data[:5], data[5] ^ 0x40)) if is_hit else data

    rig.tamper = corrupt
    _, log = rig.run()
    assert log.cycle["frames_missing"][TROUBLE_CYCLE] == 1
    (tally,) = [entry.event.message for entry in log.events if entry.event.message.startswith("Sensor1: ")][-1:]
    assert "1 WRONG_CRC" in tally
    assert "1 OK_SOME_LOST" in tally
    assert log.scheme["tau_J"][TROUBLE_CYCLE][0] == log.scheme["tau_J"][TROUBLE_CYCLE - 1][0]


@pytest.mark.long
def test_the_log_counts_what_the_checks_said_of_each_frame(tmp_path: Path) -> None:
    rig = SessionRig(tmp_path)
    lost = range(TROUBLE_CYCLE, TROUBLE_CYCLE + 2)
    rig.tamper = lambda cycle, i, data: None if i == 0x184 and cycle in lost else data
    _, log = rig.run()
    checks = log.topics["/frame_checks"]
    is_missed = E2eStatus.NO_NEW_DATA
    assert checks["sensor2_checks"][:, is_missed].tolist()[:3] == [0, 0, 2]
    assert checks["sensor2_checks"][-1, is_missed] == 2
    assert checks["sensor1_checks"][-1, is_missed] == 0
    assert checks["sensor1_checks"][-1, E2eStatus.OK] == log.cycle["cycle"][-1] + 21  # the cycles of disabling, too


def test_an_interrupt_parks_the_arm_before_the_drives_are_disabled(tmp_path: Path) -> None:
    rig = SessionRig(tmp_path, finish_s=30.0)
    rig.before_sync[TROUBLE_CYCLE] = rig.session.interrupt
    summary, log = rig.run()
    assert summary.result is not None
    assert summary.result.is_interrupted
    assert set(controlwords(log)[300:-20].tolist()) == {ENABLE_OPERATION}
    np.testing.assert_allclose(np.degrees(log.scheme["q"][-1]), [-30.0, -60.0], atol=1.0)


def test_a_second_interrupt_stops_at_once(tmp_path: Path) -> None:
    rig = SessionRig(tmp_path, finish_s=30.0)
    rig.before_sync[TROUBLE_CYCLE] = rig.session.interrupt
    rig.before_sync[TROUBLE_CYCLE + 50] = rig.session.interrupt
    summary, log = rig.run()
    assert summary.result is not None
    assert summary.result.cycles < TROUBLE_CYCLE + 50 + 30
    assert set(controlwords(log)[-20:].tolist()) == {QUICK_STOP}
    (said,) = [entry.event.message for entry in log.events if entry.event.name == "run"]
    assert said == "interrupted again before it was parked: the drives are disabled where the arm is"


def test_an_arm_that_moves_before_it_is_enabled_is_never_enabled(tmp_path: Path) -> None:
    rig = SessionRig(tmp_path)
    feedback = CODEC.message("Drive1Feedback")

    def push(cycle: int, can_id: int, data: bytes) -> bytes:
        if can_id != 0x181:
            return data
        position, _ = feedback.decode_values(data)
        return bytes(feedback.encode(position, 0.2))

    rig.tamper = push
    summary, log = rig.run()
    assert summary.result is not None
    assert summary.result.fault is FaultReason.COMMISSION_TIMEOUT
    assert ENABLE_OPERATION not in controlwords(log)


def test_the_log_says_which_drive_faulted_and_why(tmp_path: Path) -> None:
    rig = SessionRig(tmp_path)
    rig.before_sync[TROUBLE_CYCLE] = lambda: rig.bench.on_frame(Frame(0x000, bytes((0x80, 1)), 0))  # NMT to drive 1
    summary, log = rig.run()
    assert summary.result is not None
    assert summary.result.fault in (FaultReason.DRIVE, FaultReason.DATA_AGE)
    assert any(entry.event.name == "Drive1" and "EMCY 0x8100" in entry.event.message for entry in log.events)


@pytest.mark.long
def test_viewers_find_the_arm_and_a_layout_in_the_log_and_beside_it_and_the_address(tmp_path: Path) -> None:
    rig = SessionRig(tmp_path, finish_s=0.3)
    said: list[str] = []
    rig.session.live, rig.session.progress = LiveView("127.0.0.1", 0), said.append
    summary, log = rig.run()
    assert summary.log.is_complete
    for name in (ROBOT_NAME, LAYOUT_NAME):
        assert log.attachments[name] == (tmp_path / name).read_bytes()
    (line,) = [line for line in said if line.startswith("live view")]
    assert re.fullmatch(rf"live view: ws://127\.0\.0\.1:\d+, layout for it: {tmp_path / LAYOUT_NAME}", line)
    assert read_urdf(log.attachments[ROBOT_NAME]).joint_names == JOINT_NAMES
