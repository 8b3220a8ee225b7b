"""tools/campaigns/property_campaign.py: its decoder, each of its rules, and some of its runs."""

from collections.abc import Callable

import cantools
import numpy as np
import property_campaign
import pytest
import run_rules
import wire_record
from crccheck.crc import Crc16CcittFalse
from long_cases import long_but
from made_run import DISABLED_WORD, ENABLED, ENABLED_WORD, Made, states
from wire_record import Passed, WireRecord

from adacd_hil.records import Request, SchemeState
from adacd_hil.settings.parsing import parse
from adacd_hil.wire.dbc_contract import contract_folder
from firmware_sim.scenario.scenario import Scenario

ADAPT, MONITOR, REACT, STOPPED = SchemeState.ADAPT, SchemeState.MONITOR, SchemeState.REACT, SchemeState.STOPPED


def violated(made: Made) -> set[str]:
    return {violation.rule for violation in run_rules.judge(made.play())}


# The decoder


@pytest.mark.parametrize("name", ["arm", "arm_fd", "arm_fd_500us", "arm_stock"])
def test_signals_are_read_as_cantools_reads_them(name: str) -> None:
    path = contract_folder() / f"{name}.dbc"
    random = np.random.default_rng(1)
    for message in cantools.database.load_file(path).messages:
        frames = [random.bytes(message.length) for _ in range(5)]
        record = WireRecord(
            path, [Passed(k, "HOST" in message.senders, message.frame_id, d) for k, d in enumerate(frames)]
        )
        sight = record[message.name]
        for row, data in enumerate(frames):
            decoded = message.decode(data, decode_choices=False)
            assert {key: values[row] for key, values in sight.signals.items()} == pytest.approx(decoded)


def test_crcs_of_fd_frames_are_those_of_crccheck() -> None:
    """Those of classic frames decide whether a run without fault violates nothing: made_run.py has them of crccheck."""
    columns = np.frombuffer(np.random.default_rng(2).bytes(1200), np.uint8).reshape(50, 24)
    expected = [Crc16CcittFalse.calc(bytes(row[2:]) + b"\xc6\x8e") for row in columns]
    assert wire_record.crc_of(columns, b"\xc6\x8e").tolist() == expected


def test_a_frame_is_fresh_if_its_crc_is_right_and_its_counter_new() -> None:
    played = Made(cycles=4).play()
    frames = [frame for frame in played.wire.passed if frame.can_id == 0x183]
    first, second = frames[0].data, frames[1].data
    passed = [
        Passed(k, False, 0x183, data) for k, data in enumerate((first, first, second[:-1] + b"\x55", second, b""))
    ]
    sight = WireRecord(contract_folder() / "arm.dbc", passed)["Sensor1Torque"]
    assert sight.is_right.tolist() == [True, True, False, True, False]
    assert sight.is_fresh.tolist() == [True, False, False, True, False]


def test_resets_without_sync_between_them_are_one_boot() -> None:
    frames = [(0x000, b"\x82\x01"), (0x000, b"\x82\x02"), (0x080, b"\1"), (0x000, b"\x01\x00"), (0x000, b"\x81\x00")]
    record = WireRecord(contract_folder() / "arm.dbc", [Passed(k, True, *frame) for k, frame in enumerate(frames)])
    assert record.boots.tolist() == [0, 4]
    assert record.attempt(np.array([0, 3, 4])).tolist() == [0, 0, 1]


# The rules


def test_a_run_without_fault_violates_nothing() -> None:
    assert violated(Made()) == set()


def _late(frame: tuple[bool, int, bytes]) -> dict[int, list[tuple[bool, int, bytes]]]:
    return {400: [frame]}


def _drops(cycle: int) -> Callable[[int], int]:
    return lambda at: DISABLED_WORD if at < ENABLED + 3 or at == cycle else ENABLED_WORD


def _pushed(begin: int, end: int, torque_Nm: float = 1.0) -> Callable[[int], float]:
    return lambda cycle: torque_Nm if begin <= cycle < end else 0.0


def _stuck(signal: str, *nodes: str) -> Scenario:
    return parse(
        Scenario, {"faults": [{"kind": "stick", "node": node, "signal": signal, "at_s": 0.1} for node in nodes]}
    )


_STICK, _STUCK_DRIVES = _stuck("torque", "sensor1"), _stuck("velocity", "drive1", "drive2")

BROKEN: dict[str, tuple[Made, str]] = {
    "torque before the status": (Made(torque=lambda k: 10 if 231 <= k < 590 else 0), "torque-before-enabled"),
    "torque while one drive is in another mode": (
        Made(extra=_late((False, 0x282, b"\x27\x00\x08\0\0\0\0"))),
        "torque-before-enabled torque-after-drive-fault",
    ),
    "enabled at once": (Made(controlword=lambda k: 0x0F if k >= 100 else 0), "enabled-too-early"),
    "enabled in motion": (Made(velocity_rad_s=lambda k: 0.1 if k == 150 else 0.0), "enabled-in-motion"),
    "enabled in motion that a fault hides": (
        Made(scenario=_STUCK_DRIVES, faults=lambda k: 3 * (k < 200), true_speed=lambda k: 0.1),
        "enabled-in-motion",
    ),
    "enabled in motion beside a fault of a sensor": (
        Made(velocity_rad_s=lambda k: 0.1 if k == 150 else 0.0, scenario=_STICK, faults=lambda k: 1),
        "enabled-in-motion",
    ),
    "too much": (Made(torque=lambda k: min(160 * max(k - 240, 0), 1002) if k < 590 else 0), "torque-limit"),
    "too fast": (Made(torques={400: 179}), "torque-rate"),
    "torque after a quick stop": (
        Made(controlword=lambda k: 0x02 if k == 400 else 0x0F if k >= ENABLED else 0),
        "torque-after-stop",
    ),
    "torque after a drive has dropped out": (
        Made(statusword=_drops(400), torques={400: 0, 401: 0}),
        "torque-after-drive-fault",
    ),
    "torque after an EMCY": (Made(extra=_late((False, 0x081, b"\x10\x23\x03\0\0\0\0\0"))), "torque-after-emergency"),
    "torque after a sensor's value is not valid": (
        Made(extra=_late((False, 0x283, b"\1\0"))),
        "torque-after-emergency",
    ),
    "torque after a node has rebooted": (
        Made(extra={250: [(False, 0x703, b"\5")], 400: [(False, 0x703, b"\0")]}),
        "torque-after-departure",
    ),
    "torque on old data": (Made(has_feedback=lambda k: not 400 <= k <= 404), "torque-on-old-data"),
    "torque that grows blindly": (
        Made(torques={402: 13}, has_feedback=lambda k: not 400 <= k <= 402),
        "torque-grew-blindly",
    ),
    "beyond the position limit": (Made(position_rad=lambda k: 1.32 if k >= 400 else 0.0), "limit-not-stopped"),
    "beyond the velocity limit": (Made(velocity_rad_s=lambda k: -5.3 if k >= 400 else 0.0), "limit-not-stopped"),
    "a SYNC counter that jumps": (Made(sync=lambda k: 1 + (k + (k > 400)) % 240), "sync-counter"),
    "a wrong CRC": (Made(command=lambda k, _, data: [b"\0" + data[1:]] if k == 400 else [data]), "command-crc"),
    "a counter that stands": (
        Made(command=lambda k, _, data: [data, data] if k == 400 else [data]),
        "command-counter two-commands",
    ),
    "an object is written": (
        Made(extra=_late((True, 0x601, b"\x2f\x00\x22\x00\xff\0\0\0"))),
        "sdo-write-while-powered",
    ),
    "a model that stands still": (Made(tau_f=lambda k: 0.1 if 400 <= k < 410 else 1e-4 * k), "blind"),
    "a missed contact": (Made(cycles=1200, tau_ext=_pushed(700, 900)), "contact-missed"),
    "a reaction to nothing": (Made(cycles=2000, state=states((1600, REACT), (1700, MONITOR))), "reaction-to-nothing"),
    "a stop that goes by itself": (
        Made(
            cycles=2000, state=states((1000, REACT), (1100, STOPPED), (1800, MONITOR)), tau_ext=_pushed(990, 1000, 0.2)
        ),
        "stop-not-latched",
    ),
    "motion while stopped": (
        Made(
            cycles=2000,
            state=states((1000, REACT), (1100, STOPPED)),
            tau_ext=_pushed(990, 1000, 0.2),
            true_speed=lambda k: 0.1,
        ),
        "moves-while-stopped",
    ),
    "a traceback": (Made(changes={"crash": "KeyError: 3"}), "crash"),
    "no end": (Made(changes={"overdue": "still running"}), "unending"),
    "torque in the last command": (Made(torques=dict.fromkeys(range(590, 600), 10)), "torque-at-the-end"),
    "a drive left enabled": (Made(changes={"enabled_at_end": (True, False)}), "enabled-at-the-end"),
    "no log": (Made(changes={"log": None}), "no-log"),
    "a fault without cause": (
        Made(events=[(500, "error", "supervisor", "MONITOR -> FAULT: DRIVE")]),
        "fault-not-named",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_breaks_a_rule_is_named(name: str) -> None:
    made, rules = BROKEN[name]
    assert violated(made) == set(rules.split())


ALLOWED: dict[str, Made] = {
    "motion that a fault has made up, and the truth doesn't know": Made(
        velocity_rad_s=lambda k: 67109.0 if k == 150 else 0.0, scenario=_STUCK_DRIVES, faults=lambda k: 3 * (k == 150)
    ),
    "torque that falls blindly": Made(torques={402: 3}, has_feedback=lambda k: not 400 <= k <= 402),
    "torque that goes to zero at once": Made(torques={400: 0}),
    "a drive that the host has disabled and enabled again": Made(
        cycles=900,
        controlword=lambda k: 0x0F if ENABLED <= k < 400 or k >= 600 else 0x06,
        statusword=lambda k: DISABLED_WORD if k < ENABLED + 3 or 402 <= k < 603 else ENABLED_WORD,
        torques=dict.fromkeys(range(390, 605), 0),
    ),
    "five cycles without a fresh sample": Made(tau_f=lambda k: 0.1 if 400 <= k < 406 else 1e-4 * k),
    "an object that is read": Made(extra=_late((True, 0x601, b"\x40\x00\x22\x00\0\0\0\0"))),
    "an EMCY that resets an error": Made(extra=_late((False, 0x081, bytes(8)))),
    "a contact that was found": Made(
        cycles=1200, tau_ext=_pushed(700, 900), state=states((740, REACT), (800, STOPPED))
    ),
    "a contact that a lying sensor hides": Made(
        cycles=1200, tau_ext=_pushed(700, 900), scenario=_STICK, faults=lambda k: 1
    ),
    "a weak contact": Made(cycles=1200, tau_ext=_pushed(700, 900, 0.4)),
    "a reaction to nothing that is named": Made(
        cycles=2000,
        state=states((1600, REACT), (1700, MONITOR)),
        events=[(1600, "warning", "supervisor", "MONITOR -> REACT: no fresh sample for 5 cycles; Sensor1")],
    ),
    "a stop that is acknowledged": Made(
        cycles=2000,
        state=states((1000, REACT), (1100, STOPPED), (1800, MONITOR)),
        request=lambda k: Request.ACKNOWLEDGE if k == 1800 else Request.NONE,
        tau_ext=_pushed(990, 1000, 0.2),
    ),
}


@pytest.mark.parametrize("name", ALLOWED)
def test_what_is_allowed_is_not_named(name: str) -> None:
    assert violated(ALLOWED[name]) == set()


# Half a dozen short runs: both schemes, faults of frames, values and nodes


@pytest.mark.slow
@pytest.mark.parametrize("seed", long_but(1, [18, 8, 23, 53, 70, 76, 32665]))
def test_a_random_run_keeps_every_rule(seed: int) -> None:
    result = property_campaign.run_seed(seed, None, is_replayed=False)
    assert result.violations == []
    assert result.is_armed
    assert result.cycles > 1000
