"""The communication test against the emulator in virtual time; verdicts, shares and times are known exactly."""

import numpy as np
import pytest
from loaded import encoded
from rig import PERIOD_NS, Rig

from adacd_hil.device.drive import DISABLE_CYCLES
from adacd_hil.lab.commission.communication_test import (
    CommunicationTest,
    Verdict,
    ZeroTorqueLoop,
    judge,
)
from adacd_hil.records import FaultReason
from adacd_hil.wire.bus import QueueBytes
from adacd_hil.wire.dbc_contract import load_codec

CODEC = load_codec()
COMMAND = CODEC.message("Drive1Command")
COMMANDS = (0x201, 0x202)


def loop_of(rig: Rig, is_enabling: bool = False) -> ZeroTorqueLoop:
    rig.start()
    rig.tap.take_passed()
    return ZeroTorqueLoop(rig.settings, rig.tap, rig.clock, rig.arm, rig.master, is_enabling)


def run(rig: Rig, seconds: float = 0.2, is_enabling: bool = False) -> tuple[CommunicationTest, FaultReason]:
    loop = loop_of(rig, is_enabling)
    test = CommunicationTest(rig.settings, rig.arm, 1_000_000, is_enabling=is_enabling)
    fault = loop.run(seconds, test.observe_cycle)
    return test, fault


def commands(rig: Rig) -> set[tuple[int, int]]:
    """Return all (controlword, target torque) on the wire."""
    return {tuple(map(int, COMMAND.decode_values(frame.data))) for frame in rig.sent if frame.can_id in COMMANDS}


def test_an_undisturbed_connection_is_good_and_complete_and_asks_the_drives_for_no_voltage():
    rig = Rig(is_wall=True)
    report, fault = run(rig)
    assert commands(rig) == {(0x0000, 0)}
    assert (report.cycles, report.complete, report.overruns) == (200, 200, 0)
    assert (report.verdict, report.share, fault) == (Verdict.GOOD, 1.0, FaultReason.NONE)
    assert [device["ages"][0] for device in report.devices().values()] == [200] * 4


def test_enabled_drives_get_no_torque_and_are_disabled_at_the_end():
    rig = Rig(is_wall=True)
    report, fault = run(rig, is_enabling=True)
    assert (report.verdict, fault) == (Verdict.GOOD, FaultReason.NONE)
    assert commands(rig) == {(0x0000, 0), (0x0006, 0), (0x0007, 0), (0x000F, 0)}
    last = [frame for frame in rig.sent if frame.can_id in COMMANDS][-2 * DISABLE_CYCLES :]
    assert {int(COMMAND.decode_values(frame.data)[0]) for frame in last} == {0}
    assert not any(drive.is_enabled for drive in rig.bench.drives)


@pytest.mark.parametrize("is_willing", [True, False])
def test_an_enabled_test_is_good_only_of_drives_that_were_enabled(is_willing):
    rig = Rig(is_wall=True)
    status = CODEC.message("Drive1Status")

    def refuse(cycle: int, can_id: int, data: bytes) -> bytes:
        values = list(status.decode_values(data)) if can_id == status.can_id else []
        if is_willing or not values:
            return data
        values[status.place("statusword")] = 0x40
        return bytes(encoded(status, *values))

    rig.tamper = refuse
    loop = loop_of(rig, is_enabling=True)
    test = CommunicationTest(rig.settings, rig.arm, 1_000_000, is_enabling=True)
    assert loop.run(0.4, test.observe_cycle) is FaultReason.NONE
    assert (test.share, test.enabled > 0) == (1.0, is_willing)
    assert test.verdict is (Verdict.GOOD if is_willing else Verdict.NOT_SUFFICIENT)
    assert [line.split(",")[0] for line in loop.device_faults] == ([] if is_willing else ["Drive1: SWITCH_ON_DISABLED"])


def test_a_drive_that_drops_out_ends_an_enabled_test_with_quick_stop():
    rig = Rig(is_wall=True)
    loop = loop_of(rig, is_enabling=True)
    cycles = []

    def disturb(cycle) -> None:
        cycles.append(cycle)
        if len(cycles) == 50:
            rig.bench.devices[0].on_nmt(b"\x80\x01", rig.clock.now_ns())

    assert loop.run(1.0, disturb) is not FaultReason.NONE
    assert len(cycles) < 60
    last = [frame for frame in rig.sent if frame.can_id in COMMANDS][-1]
    assert COMMAND.decode_values(last.data) == (0x0002, 0)


def test_every_fifteenth_torque_frame_lost_is_a_warning_and_told_by_device():
    rig = Rig(is_wall=True)
    count = [0]

    def lose(cycle: int, can_id: int, data: bytes) -> bytes | None:
        count[0] += can_id == 0x183
        return None if can_id == 0x183 and count[0] % 15 == 0 else data

    rig.tamper = lose
    report, _ = run(rig, 0.3)
    assert report.verdict is Verdict.WARNING
    assert report.complete == 280
    assert [round(device["share"], 3) for device in report.devices().values()] == [1.0, 1.0, 0.933, 1.0]
    sensor = report.devices()["Sensor1"]
    assert (sensor["ages"][:3], sensor["checks"]["OK_SOME_LOST"]) == ([280, 20, 0], 21)  # one more while disabling


def test_skipped_periods_count_as_without_data():
    rig = Rig(is_wall=True)
    loop = loop_of(rig)
    begin_ns = rig.clock.now_ns()
    rig.clock.oversleep_ns = lambda t_ns: 20 * PERIOD_NS + 5_000 if t_ns == begin_ns + 51 * PERIOD_NS else 0
    test = CommunicationTest(rig.settings, rig.arm, 1_000_000)
    loop.run(0.2, test.observe_cycle)
    assert (test.overruns, test.cycles, test.periods) == (20, 180, 200)
    assert (test.share, test.verdict) == (0.9, Verdict.WARNING)
    assert test.columns["lateness_ns"].max() == 5_000
    assert np.median(test.columns["slack_ns"]) - test.columns["slack_ns"].min() == 5_000
    assert test.columns["overruns"][[49, 51, -1]].tolist() == [0, 20, 20]


def test_the_record_of_a_cycle_has_its_queues_and_what_was_lost(monkeypatch):
    rig = Rig(is_wall=True)
    monkeypatch.setattr(type(rig.bus), "queue_bytes", lambda bus: QueueBytes(700, 1400))
    monkeypatch.setattr(type(rig.bus), "frames_lost", 3, raising=False)
    loop = loop_of(rig)
    test = CommunicationTest(rig.settings, rig.arm, 1_000_000)
    records = []
    loop.run(0.02, lambda cycle: records.append(test.observe_cycle(cycle, log_queue_bytes=99)))
    last = records[-1]
    assert (last.receive_queue_bytes, last.transmit_queue_bytes, last.log_queue_bytes) == (700, 1400, 99)
    assert (last.frames_lost, last.data_age) == (3, 0)


@pytest.mark.parametrize(
    ("share", "verdict"),
    [
        (0.95, Verdict.GOOD),
        (np.nextafter(0.95, 0.0), Verdict.WARNING),
        (0.90, Verdict.WARNING),
        (np.nextafter(0.90, 0.0), Verdict.NOT_SUFFICIENT),
    ],
)
def test_verdicts_change_at_the_bounds(share, verdict):
    assert judge(share) is verdict


def test_an_interrupt_ends_the_loop_and_disables():
    rig = Rig(is_wall=True)
    loop = loop_of(rig)
    seen = []
    loop.run(10.0, lambda cycle: (seen.append(cycle), loop.interrupt())[0])
    assert len(seen) == 1
    assert sum(frame.can_id == 0x201 for frame in rig.sent) == 1 + DISABLE_CYCLES
