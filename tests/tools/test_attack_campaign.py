"""attack_campaign.py: what each attack sends, what the judge makes of a run, and two attacks in virtual time."""

from pathlib import Path
from typing import Any

import attack_vcan
import attacked_run
import numpy as np
import pytest
from attacked_run import Finding
from attacks import ATTACKS, MS, Forged, Forger, find_attack
from crccheck.crc import Crc8Autosar

from adacd_hil.log.reader import LoggedEvent
from adacd_hil.log.types.truth_topic import TRUTH_LAYOUT
from adacd_hil.records import Event
from adacd_hil.wire.dbc_contract import contract_folder, load_codec
from adacd_hil.wire.e2e import E2eStatus
from firmware_sim.arm.sensing import POSITION_LSB_RAD

FORGER = Forger((contract_folder() / "arm.dbc").read_bytes())
COMMAND = bytes.fromhex("00050f006400")  # counter 5, Enable operation, 100 per mille
TORQUE = bytes.fromhex("0007") + (2_000_000).to_bytes(4, "little")  # counter 7, 2 Nm


def test_a_forged_frame_has_the_crc_of_its_data_id_and_passes_the_receivers_check() -> None:
    message = load_codec().message("Drive1Command")
    frame = FORGER.sign(0x201, COMMAND, 6)
    assert frame[1:] == b"\x06" + COMMAND[2:]
    assert frame[0] == Crc8Autosar.calc(frame[1:] + bytes.fromhex("728145e7085e7852626d872b902e3d3c")[6:7])
    receiver = message.receiver()
    assert receiver.check(FORGER.sign(0x201, COMMAND, 5)) is E2eStatus.OK
    assert receiver.check(frame) is E2eStatus.OK


BOTH = ((0x201, COMMAND), (0x202, COMMAND))
FEEDBACK = (1000).to_bytes(4, "little") + (7).to_bytes(4, "little")
SYNC = (0x080, b"\xf0")
OFFSET, DRIFT = (1000 + round(rad / POSITION_LSB_RAD) for rad in (0.018, 0.1))
TAILS = {0x080: slice(0, 1), 0x181: slice(0, 4), 0x183: slice(2, 6), 0x184: slice(2, 6)}
"""Where the value is that an attack forges; in a command it is the torque, 4 to 5."""


@pytest.mark.parametrize(
    ("name", "heard", "t_ms", "sent"),
    [
        ("command-one", BOTH, 0, [(0x201, 6, 500)]),
        ("command-both", BOTH, 0, [(0x201, 6, 500), (0x202, 6, 500)]),
        ("command-single", BOTH[1:] * 2, 0, [(0x202, 6, 1000)]),
        ("command-small", BOTH, 0, [(0x201, 6, 120), (0x202, 6, 120)]),
        ("sensor-jump", [(0x183, TORQUE)], 0, [(0x183, 8, 5_000_000)]),
        ("sensor-repeated", [(0x184, TORQUE)], 0, [(0x184, 7, 5_000_000)]),
        ("sensor-ramp", [(0x183, TORQUE)], 2000, [(0x183, 8, 3_000_000)]),
        ("sensor-jump-ahead", [(0x183, TORQUE), (0x080, b"\1")], 0, [(0x183, 8, 5_000_000)]),
        ("feedback-offset", [(0x181, FEEDBACK)], 0, [(0x181, None, OFFSET)]),
        ("feedback-drift", [(0x181, FEEDBACK), (0x182, FEEDBACK)], 1000, [(0x181, None, DRIFT)]),
        ("sync-doubled", [SYNC], 0, [(0x080, None, 240)]),
        ("sync-next", [SYNC], 0, [(0x080, None, 1)]),
        ("sync-between", [SYNC], 0, [(0x080, None, 1)]),
    ],
)
def test_an_attack_answers_with_its_value_and_the_counter_that_is_due(
    name: str, heard: list[tuple[int, bytes]], t_ms: int, sent: list[tuple[int, int | None, int]]
) -> None:
    attack = find_attack(name).make(FORGER)
    forged = [each for can_id, data in heard for each in attack.hears(can_id, data, t_ms * MS)]
    values = [int.from_bytes(each.data[TAILS.get(each.can_id, slice(4, 6))], "little") for each in forged]
    counters = [None if each.can_id in (0x080, 0x181) else each.data[1] & 15 for each in forged]
    assert list(zip([each.can_id for each in forged], counters, values, strict=True)) == sent
    assert all(each.data[4:] == FEEDBACK[4:] for each in forged if each.can_id == 0x181)
    assert [each.is_ahead for each in forged] == [name.endswith("ahead")] * len(sent)
    assert [each.after_ns for each in forged] == [500_000 if name == "sync-between" else 0] * len(sent)


def test_drives_are_enabled_again_only_after_the_hosts_quick_stop() -> None:
    attack = find_attack("enable-after-fault").make(FORGER)
    assert attack.hears(0x201, COMMAND, 0) == []
    assert attack.tick(5 * MS) == []
    stop = COMMAND[:2] + b"\x02\x00" + bytes(2)
    sent = [attack.hears(can_id, stop, 10 * MS)[0].data[2] for can_id in (0x201, 0x202) * 4]
    assert sent == [0x80, 0x80, 0x06, 0x06, 0x07, 0x07, 0x0F, 0x0F]
    assert [forged.can_id for forged in attack.tick(800 * MS)] == [0x201, 0x202]


def test_an_object_is_written_by_an_expedited_download() -> None:
    first, second = find_attack("sdo-command-patience").make(FORGER).tick(0)
    assert (first.can_id, second.can_id) == (0x601, 0x602)
    assert first.data == bytes.fromhex("2f002200ff000000")
    (period, _) = find_attack("sdo-period").make(FORGER).tick(0)
    assert period.data == bytes.fromhex("23061000d0070000")


def test_a_recorded_second_is_sent_again_at_its_own_times() -> None:
    attack = find_attack("replay").make(FORGER)
    attack.hears(0x183, TORQUE, 20 * MS)
    assert attack.tick(1019 * MS) == []
    assert attack.tick(1020 * MS) == [Forged(0x183, TORQUE)]
    assert attack.tick(1021 * MS) == []


def test_a_silent_sensor_is_played_on() -> None:
    attack = find_attack("dead-node-kept-alive").make(FORGER)
    sync = (0x080, b"\1")
    frames = [sync, (0x183, TORQUE), sync, sync, sync]
    sent = [attack.hears(can_id, data, 0) for can_id, data in frames]
    assert [len(answer) for answer in sent] == [0, 0, 0, 1, 1]
    assert [answer[0].data[1] & 15 for answer in sent[3:]] == [8, 9]


def test_every_attack_has_a_name_of_its_own_and_sends_something() -> None:
    names = [case.name for case in ATTACKS]
    assert len(names) == len(set(names))
    cyclic = [(can_id, bytes(8)) for can_id in (0x181, 0x182)] + [(0x183, TORQUE), (0x184, TORQUE), (0x281, bytes(7))]
    commands = [(0x201, COMMAND), (0x202, COMMAND), (0x201, COMMAND[:2] + b"\2\0\0\0")]
    heard = [(0x080, b"\1"), *cyclic, *commands, (0x080, b"\2"), (0x080, b"\3")]
    for case in ATTACKS:
        attack = case.make(FORGER)
        sent = [forged for can_id, data in heard for forged in attack.hears(can_id, data, 0)]
        sent += attack.tick(0) + attack.tick(1100 * MS)
        assert sent, case.name


# The judge


def finding(**changes: Any) -> Finding:
    values: dict[str, Any] = {
        "name": "command-both", "about": "", "forged": 1, "noticed_ms": 2.0,
        "noticed_by": "bus: somebody else commands drive 1", "is_named": True, "stopped_ms": 2.0, "rest_ms": 60.0,
        "rest_after_notice_ms": 58.0, "travelled_deg": 1.0, "fastest_deg_s": 10.0, "furthest_deg": 3.0, "end": "",
        "verdict": "",
    }  # fmt: skip
    return Finding(**values | changes)


@pytest.mark.parametrize(
    ("name", "changes", "expected"),
    [
        ("command-both", {}, "ok"),
        ("command-both", {"rest_after_notice_ms": 119.0}, "ok"),
        ("command-both", {"rest_after_notice_ms": 121.0}, "NOT AT REST"),
        ("command-both", {"rest_after_notice_ms": None}, "NOT AT REST"),
        ("command-both", {"is_named": False}, "NOT NAMED"),
        ("command-both", {"noticed_ms": None}, "UNNOTICED"),
        ("sensor-jump", {"stopped_ms": None, "rest_after_notice_ms": None}, "ok"),
        ("sensor-jump", {"rest_after_notice_ms": 400.0}, "NOT AT REST"),
        ("flood", {"noticed_ms": None, "stopped_ms": None}, "ok, no effect"),
        ("sdo-answers", {"noticed_ms": None, "stopped_ms": 3.0}, "UNNOTICED"),
        ("sensor-jump", {"noticed_ms": 1502.0}, "UNNOTICED"),
        ("nmt-reset-node-drive", {"rest_after_notice_ms": 1900.0}, "ok"),
    ],
)
def test_a_verdict_follows_from_notice_name_and_rest(name: str, changes: dict[str, Any], expected: str) -> None:
    assert attacked_run.verdict(find_attack(name), finding(**changes)) == expected


def test_without_an_attack_nothing_may_be_noticed() -> None:
    assert attacked_run.verdict(None, finding(noticed_ms=None)) == "ok"
    assert attacked_run.verdict(None, finding()) == "FALSE ALARM"


def test_rest_is_where_the_arm_begins_to_stand_for_long_enough() -> None:
    times_ns = np.arange(1000) * MS
    speed = np.full(1000, 50.0)
    speed[300:350] = 0.0  # 50 ms: not yet
    speed[400:] = 0.0
    assert attacked_run.rest_from(times_ns, speed, 100 * MS) == 400 * MS
    assert attacked_run.rest_from(times_ns, speed, 500 * MS) == 500 * MS
    assert attacked_run.rest_from(times_ns, np.full(1000, 3.0), 0) is None


def test_the_first_notice_is_a_warning_or_a_reaction_since_the_attack() -> None:
    events = [
        LoggedEvent(1 * MS, Event("warning", "realtime", "not granted")),
        LoggedEvent(50 * MS, Event("info", "supervisor", "ADAPT -> MONITOR")),
        LoggedEvent(60 * MS, Event("info", "supervisor", "MONITOR -> REACT")),
        LoggedEvent(62 * MS, Event("error", "bus", "somebody else sends SYNC")),
    ]
    line = "supervisor: MONITOR -> REACT | bus: somebody else sends SYNC"
    assert attacked_run.first_notice(events, 10 * MS, ()) == (60 * MS, line)
    assert attacked_run.first_notice(events, 10 * MS, ("REACT", "SYNC")) == (None, "")


def test_travel_counts_from_the_attack_to_rest() -> None:
    times_ns = np.arange(1000) * MS
    blocks = np.zeros((1000, TRUTH_LAYOUT.size))
    angle_deg = np.concatenate((np.zeros(100), np.linspace(0.0, 10.0, 100), np.full(800, 10.0)))
    blocks[:, TRUTH_LAYOUT.slices["q"]] = np.radians(angle_deg)[:, None]
    blocks[100:200, TRUTH_LAYOUT.slices["dq"]] = np.radians(100.0)
    case = find_attack("command-both")
    found = attacked_run.finding(
        case, 7, 110 * MS, 120 * MS, "somebody else", times_ns, blocks, times_ns[120:], "FAULT"
    )
    assert (found.noticed_ms, found.stopped_ms, found.rest_after_notice_ms) == (10.0, 10.0, 80.0)
    assert found.travelled_deg == pytest.approx(9.0, abs=0.15)
    assert (found.fastest_deg_s, found.furthest_deg, found.verdict) == (100.0, 10.0, "ok")


@pytest.mark.parametrize(
    ("name", "status", "said", "stopped_ms", "expected"),
    [
        ("second-run", 5, "another host drives this arm", None, "ok"),
        ("second-run", 0, "", None, "NOT REFUSED"),
        ("second-run", 5, "no boot-up", None, "NOT NAMED"),
        ("second-doctor", 1, "another master is present", 3.0, "RUN DISTURBED"),
        ("second-scan", 0, "nodes: 4", None, "ok"),
    ],
)
def test_a_second_user_is_refused_by_name_and_disturbs_nobody(
    name: str, status: int, said: str, stopped_ms: float | None, expected: str
) -> None:
    assert attack_vcan.second_verdict(name, status, said, finding(stopped_ms=stopped_ms)) == expected


@pytest.mark.long
@pytest.mark.slow
def test_in_virtual_time_nobody_who_attacks_is_no_alarm_and_forged_commands_reach_the_drives(tmp_path: Path) -> None:
    quiet, _ = attacked_run.play_attack(None, tmp_path / "quiet")
    assert (quiet.verdict, quiet.forged, quiet.end.split(";")[0]) == ("ok", 0, "MONITOR NONE")
    attacked, _ = attacked_run.play_attack(find_attack("command-both"), tmp_path / "attacked")
    assert attacked.forged > 10
    assert attacked.noticed_ms is not None
    assert attacked.end.split(";")[0].startswith("FAULT")
