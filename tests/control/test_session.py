"""Whole runs against the emulator in one process, with something going wrong; torque is judged on the wire."""

import dataclasses
import os
import re
import signal
from pathlib import Path

import numpy as np
import pytest
from rig import (
    DISABLE_VOLTAGE,
    ENABLE_OPERATION,
    ENABLED_CYCLE,
    QUICK_STOP,
    TROUBLE_CYCLE,
    SessionRig,
    controlwords,
    messages,
    scripted,
)

from adacd_hil.control.gate import GateFlag
from adacd_hil.control.session import SessionSummary
from adacd_hil.lab.live.live_view import LiveView
from adacd_hil.lab.serial_arm.urdf import read_urdf
from adacd_hil.log.log_files import LAYOUT_NAME, ROBOT_NAME
from adacd_hil.log.reader import RunLog
from adacd_hil.log.recording import recorder as recorder_module
from adacd_hil.log.recording.recorder import LogSummary, Recorder
from adacd_hil.log.viewer_layout import viewer_files
from adacd_hil.records import JOINT_NAMES, FaultReason
from adacd_hil.wire.e2e import E2eStatus

pytestmark = pytest.mark.slow


LOST, ALIEN, CORRUPT, PASSIVE = (TROUBLE_CYCLE + 100 * k for k in range(4))


@pytest.fixture(scope="module")
def disturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[SessionSummary, RunLog]:
    """Play a run with two lost torques, an odd EMCY, a corrupt torque, and a controller that is error passive."""
    settings = scripted()
    settings = dataclasses.replace(settings, bus=dataclasses.replace(settings.bus, heartbeat_ms=10))
    rig = SessionRig(tmp_path_factory.mktemp("disturbed"), settings)

    def tamper(cycle: int, can_id: int, data: bytes) -> bytes | None:
        if can_id == 0x184 and cycle in (LOST, LOST + 1):
            return None
        is_hit = can_id == 0x183 and cycle == CORRUPT
        return bytes((*data[:5], data[5] ^ 0x40)) if is_hit else data

    rig.tamper = tamper
    rig.before_sync[ALIEN] = lambda: rig.bus.deliver(0x081, b"\x01\x02\x03")
    error_passive = bytes((0, 0x20, 0, 0, 0, 0, 130, 0))
    rig.before_sync[PASSIVE] = lambda: rig.bus.deliver(0x204, error_passive, is_error=True)
    return rig.run()


def test_a_disturbed_run_begins_with_a_closed_gate_and_ends_parked_and_disabled_without_a_fault(
    disturbed: tuple[SessionSummary, RunLog],
) -> None:
    summary, log = disturbed
    assert summary.result is not None
    assert (summary.result.fault, summary.result.is_interrupted, summary.error) == (FaultReason.NONE, False, "")
    assert controlwords(log)[-1] == DISABLE_VOLTAGE
    assert np.abs(log.scheme["dq"][-1]).max() < 0.01
    assert np.count_nonzero(log.control["tau_c"][:ENABLED_CYCLE]) == 0
    assert set(log.control["gate_flags"][:ENABLED_CYCLE].tolist()) == {int(GateFlag.CLOSED)}
    beats, commands = (log.topics[f"/decoded/{name}"].t_ns for name in ("HostHeartbeat", "Drive1Command"))
    assert np.diff([*beats, commands[-1]]).max() <= 10_000_000  # to the last cycle of disabling


def test_wrong_frames_change_no_value_and_the_log_says_and_counts_them(
    disturbed: tuple[SessionSummary, RunLog],
) -> None:
    (_, log), is_missed = disturbed, E2eStatus.NO_NEW_DATA
    (said,) = [entry.event for entry in log.events if entry.event.name == "bus"]
    assert said.level == "warning"
    assert said.message == "error passive (sending); error counters: sending 130, receiving 0"
    *tallies, dropped = messages(log, "frame checks")
    assert dropped == "1 frames dropped that are not what their identifier says"
    (tally,) = [line for line in tallies if line.startswith("Sensor1: ")]
    assert ("1 WRONG_CRC" in tally, "1 OK_SOME_LOST" in tally) == (True, True)
    assert log.cycle["frames_missing"][CORRUPT] == 1
    assert log.scheme["tau_J"][CORRUPT][0] == log.scheme["tau_J"][CORRUPT - 1][0]
    checks = log.topics["/frame_checks"]
    assert checks["sensor2_checks"][:, is_missed].tolist()[:2] == [0, 2]
    assert checks["sensor2_checks"][-1, is_missed] == 2
    assert checks["sensor1_checks"][-1, is_missed] == 0
    cycles = log.cycle["cycle"][-1] + 21  # the cycles of disabling, too
    assert checks["sensor1_checks"][-1, E2eStatus.OK] == cycles - 2  # the corrupt one, and the next, OK_SOME_LOST


def test_an_interrupt_parks_the_arm_before_the_drives_are_disabled(tmp_path: Path) -> None:
    rig = SessionRig(tmp_path, finish_s=30.0)
    rig.before_sync[TROUBLE_CYCLE] = rig.session.interrupt
    said: list[str] = []
    rig.session.progress = said.append
    result, log = rig.play()
    assert result.is_interrupted
    assert sum("parks" in line for line in said) == 1
    assert messages(log, "interrupted") == ["the run was interrupted"]
    assert set(controlwords(log)[300:-20].tolist()) == {ENABLE_OPERATION}
    np.testing.assert_allclose(np.degrees(log.scheme["q"][-1]), [-30.0, -60.0], atol=1.0)


def test_a_second_interrupt_stops_at_once(tmp_path: Path) -> None:
    rig = SessionRig(tmp_path, finish_s=30.0)
    rig.before_sync[TROUBLE_CYCLE] = rig.session.interrupt
    rig.before_sync[TROUBLE_CYCLE + 50] = rig.session.interrupt
    result, log = rig.play()
    assert result.cycles < TROUBLE_CYCLE + 50 + 30
    assert set(controlwords(log)[-20:].tolist()) == {QUICK_STOP}
    (said,) = messages(log, "run")
    assert said == "interrupted again before it was parked: the drives are disabled where the arm is"


@pytest.mark.usefixtures("writer_process")
def test_a_log_that_is_slow_to_end_is_announced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = SessionRig(tmp_path, finish_s=0.3)
    said: list[str] = []
    rig.session.progress = said.append
    close = Recorder.close

    def stop_writer(recorder: Recorder) -> LogSummary:
        os.kill(recorder.pid, signal.SIGSTOP)
        return close(recorder)

    monkeypatch.setattr(Recorder, "close", stop_writer)
    monkeypatch.setattr(recorder_module, "END_TIMEOUT_S", 1.5)
    assert not rig.session.run().log.is_complete
    assert ["the log" in line for line in said][-2:] == [False, True]


@pytest.mark.long
def test_viewers_find_the_arm_and_a_layout_in_the_log_and_beside_it_and_the_address(tmp_path: Path) -> None:
    rig = SessionRig(tmp_path, finish_s=0.3)
    said: list[str] = []
    rig.session.viewer_files = viewer_files(rig.session.settings)
    rig.session.live, rig.session.progress = LiveView("127.0.0.1", 0), said.append
    summary, log = rig.run()
    assert summary.log.is_complete
    for name in (ROBOT_NAME, LAYOUT_NAME):
        assert log.attachments[name] == (tmp_path / name).read_bytes()
    (line,) = [line for line in said if line.startswith("live view")]
    assert re.fullmatch(rf"live view: ws://127\.0\.0\.1:\d+, layout for it: {tmp_path / LAYOUT_NAME}", line)
    assert read_urdf(log.attachments[ROBOT_NAME]).joint_names == JOINT_NAMES
