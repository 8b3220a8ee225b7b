"""Somebody else at the wheel, drives that don't obey, devices that have changed: noticed, named, stopped."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from long_cases import long_but
from rig import CODEC, TROUBLE_CYCLE, SessionRig, messages, torques_from, transition

from adacd_hil.cli.commands.run_command import as_text, summarise
from adacd_hil.log.reader import RunLog
from adacd_hil.records import FaultReason, Request, SchemeState

pytestmark = pytest.mark.slow

NMT_STOP_ALL = bytes((0x02, 0x00))
SDO_WRITE = bytes.fromhex("2f0022006400 0000".replace(" ", ""))  # 0x2200 = 100
SDO_READ = bytes.fromhex("4000220000000000")


def faulted(log: RunLog) -> int:
    """Return the cycle in which the run faulted."""
    return int(log.scheme["cycle"][np.argmax(log.scheme["state"] == SchemeState.FAULT)])


def rig_with(folder: Path, section: str, **changes: int) -> SessionRig:
    """Make a rig whose session differs in a section of the settings."""
    rig = SessionRig(folder)
    settings = rig.session.settings
    changed = dataclasses.replace(getattr(settings, section), **changes)
    rig.session.settings = dataclasses.replace(settings, **{section: changed})
    return rig


def forged_command() -> bytes:
    """Make a command as this host makes them: right CRC, a counter that fits now and then."""
    message = CODEC.message("Drive1Command")
    values = {"controlword": 0x0F, "target_torque": 300}
    return message.sender().protect(message.encode_raw(*[values.get(signal.name, 0) for signal in message.values]))


@pytest.mark.parametrize(
    ("can_id", "data", "says"),
    long_but(
        2,
        [
            (0x201, forged_command(), "somebody else commands drive 1 (0x201)"),
            (0x080, b"\x07", "somebody else sends SYNC (0x080)"),
            (0x000, NMT_STOP_ALL, "somebody else sends NMT stop to all nodes (0x000)"),
            (0x77F, b"\x05", "somebody else sends this host's heartbeat (0x77F)"),
            (0x602, SDO_WRITE, "somebody else writes objects of drive 2 (0x602)"),
        ],
    ),
)
def test_a_frame_that_only_this_host_sends_is_named_and_faults_at_once(
    tmp_path: Path, can_id: int, data: bytes, says: str
) -> None:
    rig = SessionRig(tmp_path)
    rig.before_sync[TROUBLE_CYCLE] = lambda: rig.bus.deliver(can_id, data)
    result, log = rig.play()
    assert result.fault is FaultReason.FOREIGN_FRAMES
    assert faulted(log) <= TROUBLE_CYCLE + 1
    assert says in transition(log, "FAULT")
    assert messages(log, "bus") == [says]
    assert np.count_nonzero(torques_from(log, TROUBLE_CYCLE + 2)) == 0


def test_who_only_reads_objects_is_named_and_harmless(tmp_path: Path) -> None:
    rig = SessionRig(tmp_path)
    rig.before_sync[TROUBLE_CYCLE] = lambda: rig.bus.deliver(0x602, SDO_READ)
    result, log = rig.play()
    assert result.fault is FaultReason.NONE
    said = [entry.event for entry in log.events if entry.event.name == "bus"]
    assert [(event.level, event.message) for event in said] == [
        ("warning", "somebody else reads objects of drive 2 (0x602)")
    ]


def test_an_arm_that_somebody_commands_before_it_is_enabled_is_not_enabled(tmp_path: Path) -> None:
    rig = SessionRig(tmp_path)
    for cycle in range(50, 6000, 500):
        rig.before_sync[cycle] = lambda: rig.bus.deliver(0x201, forged_command())
    result, log = rig.play()
    assert result.fault is FaultReason.COMMISSION_TIMEOUT
    assert "fault FOREIGN_FRAMES in" in transition(log, "FAULT")
    assert not np.any(log.scheme["state"] == SchemeState.ENABLE)


def test_a_drive_that_does_not_hear_the_quick_stop_is_taken_out_of_operation_by_nmt(tmp_path: Path) -> None:
    rig = rig_with(tmp_path, "bus", command_patience_cycles=250)
    hear, is_deaf = rig.bench.on_frame, [False]

    def on_frame(frame) -> None:  # type: ignore[no-untyped-def]
        if not (is_deaf[0] and frame.can_id == 0x201):
            hear(frame)

    rig.bench.on_frame = on_frame  # type: ignore[method-assign]

    def trouble() -> None:
        is_deaf[0] = True
        rig.tamper = lambda cycle, can_id, data: None if can_id == 0x183 else data

    rig.before_sync[TROUBLE_CYCLE] = trouble
    said: list[str] = []
    rig.session.progress = said.append
    summary, log = rig.run()
    assert summary.result is not None
    assert (summary.result.fault, summary.result.enabled) == (FaultReason.DATA_AGE, ("Drive1",))
    told = as_text(summarise(summary)).splitlines()[0]
    assert ("Drive1" in told, "disabled" in told) == (True, False)
    at = faulted(log)
    sent = [
        (int(frame["t_ns"]) // 1_000_000, bytes(frame["data"][:2]))
        for frame in log.frames
        if frame["is_tx"] and frame["can_id"] == 0x000
    ]
    stops = [time_ms - at for time_ms, data in sent if data == bytes((0x80, 1)) and time_ms > at]
    assert stops[0] == 10
    assert (
        messages(log, "stop")[0] == "Drive1 last reported Operation enabled, 10 cycles after FAULT: NMT pre-operational"
    )
    assert sum(messages(log, "stop")[0] in line for line in said) == 1


def test_a_drive_whose_torque_is_not_the_commanded_one_faults(tmp_path: Path) -> None:
    rig = SessionRig(tmp_path)

    def overstate(cycle: int, can_id: int, data: bytes) -> bytes:
        if can_id != 0x281 or cycle < TROUBLE_CYCLE:
            return data
        return data[:3] + (700).to_bytes(2, "little", signed=True) + data[5:]

    rig.tamper = overstate
    result, log = rig.play()
    assert result.fault is FaultReason.TORQUE
    assert TROUBLE_CYCLE < faulted(log) <= TROUBLE_CYCLE + 210
    assert "Drive1: torque 70.0 % of 12 Nm rated at the joint, " in transition(log, "FAULT")
    assert np.count_nonzero(log.scheme["request"] == Request.FAULT_TORQUE) > 0


def test_a_device_that_has_lost_its_set_up_faults(tmp_path: Path) -> None:
    rig = rig_with(tmp_path, "devices", reread_ms=2)
    rig.before_sync[TROUBLE_CYCLE] = lambda: rig.bench.devices[1].take_over(0x2200, 0, 200)
    result, log = rig.play()
    assert result.fault is FaultReason.TAMPERED
    assert "Drive2 (node 2): 0x2200 " in transition(log, "FAULT")
    assert "is 0xC8, 0xA was set up" in transition(log, "FAULT")
