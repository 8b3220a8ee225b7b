"""The plan of faults: when rows act, what they do to frames, values and nodes, and that their draws are their own."""

import statistics

import pytest
from bench_host import CODEC, quiet_scenario
from test_faults import UNTIMED, example

from adacd_hil.settings.parsing import parse
from adacd_hil.settings.schema import ConfigError
from adacd_hil.wire.dbc_contract import load_codec
from adacd_hil.wire.e2e import E2eStatus
from adacd_hil.wire.time_marks import NEVER_NS
from firmware_sim.arm.sensing import POSITION_LSB_RAD, TORQUE_COUNTS, TORQUE_LSB_NM, VELOCITY_LSB_RAD_S
from firmware_sim.bench.fault_plan import ActionKind, FaultPlan
from firmware_sim.bench.fault_rows import EVERYBODY
from firmware_sim.bench.injector import Injector
from firmware_sim.canopen.object_dictionary import CONTRACTS
from firmware_sim.scenario.faults import FaultSettings

MS = 1_000_000
PERIOD_NS = MS
S = 1_000 * MS
DRIVE1, DRIVE2, SENSOR1, SENSOR2 = range(4)
TORQUE = bytes(range(6))
FEEDBACK = bytes(range(8))


def plan_of(*rows: dict[str, object], seed: int = 1, contract: str = "arm") -> FaultPlan:
    codec = CODEC if contract == "arm" else load_codec(CONTRACTS[contract].path)
    return FaultPlan([parse(FaultSettings, row) for row in rows], seed, codec)


def active(*rows: dict[str, object], seed: int = 1) -> FaultPlan:
    """A plan at the onset of its rows, all at 0 s."""
    plan = plan_of(*[row | ({} if row["kind"] in UNTIMED else {"at_s": 0.0}) for row in rows], seed=seed)
    plan.advance(0)
    return plan


def frame_row(kind: str, **keys: object) -> dict[str, object]:
    return {"kind": kind, "node": "sensor1", "frame": "torque", **keys}


# When


def test_a_row_begins_and_ends_at_its_times_and_says_so():
    plan = plan_of(example("silence", node="sensor2", at_s=1.0, duration_s=0.5))
    assert plan.advance(-1, 5 * S) == []
    assert (plan.mask, plan.is_quiet, plan.wait_ns) == (0, True, NEVER_NS)
    events = {ms: plan.advance(ms * MS) for ms in (-1, 0, 999, 1000, 1001, 1499, 1500, 1501)}
    text = "silence of sensor2, duration_s 0.5"
    assert {ms: found for ms, found in events.items() if found} == {
        1000: [("warning", "fault 0", f"begins: {text}")],
        1500: [("info", "fault 0", f"ends: {text}")],
    }


def test_the_mask_has_a_bit_for_each_row_that_is_active():
    plan = plan_of(
        example("silence", at_s=1.0, duration_s=2.0),
        example("lose", at_s=2.0, duration_s=3.0),
        example("clock_drift", at_s=2.5),
    )
    masks = []
    for second in (0.0, 1.0, 2.0, 2.5, 3.0, 5.0, 9.0):
        plan.advance(round(second * 1e9))
        masks.append(plan.mask)
    assert masks == [0b000, 0b001, 0b011, 0b111, 0b110, 0b100, 0b100]


def test_it_says_how_long_nothing_will_change():
    plan = plan_of(
        example("silence", at_s=1.0, duration_s=0.25), example("emcy_storm", at_s=2.0, rate_Hz=4.0, duration_s=1.0)
    )
    waits = {}
    for ms in (0, 400, 1000, 1250, 2000, 2250, 3000):
        plan.advance(ms * MS)
        waits[ms] = plan.wait_ns // MS
    assert waits == {0: 1000, 400: 600, 1000: 250, 1250: 750, 2000: 250, 2250: 250, 3000: NEVER_NS // MS}


# Frames


SENT = [
    ("feedback", "drive1", DRIVE1, 0x181),
    ("feedback", "drive2", DRIVE2, 0x182),
    ("torque", "sensor2", SENSOR2, 0x184),
    ("status", "drive2", DRIVE2, 0x282),
    ("status", "sensor1", SENSOR1, 0x283),
    ("heartbeat", "sensor2", SENSOR2, 0x704),
    ("emcy", "drive1", DRIVE1, 0x081),
    ("sdo_response", "drive2", DRIVE2, 0x582),
]


@pytest.mark.parametrize(("frame", "node", "place", "can_id"), SENT)
def test_what_a_node_sends_is_lost_if_the_row_says_so_and_nothing_else(frame, node, place, can_id):
    plan = active({"kind": "lose", "node": node, "frame": frame})
    sent = {(other, identifier): plan.transmit(other, identifier, b"\0") for _, _, other, identifier in SENT}
    assert [key for key, left in sent.items() if not left] == [(place, can_id)]
    assert plan.receive(DRIVE1, 0x201, TORQUE) == [(0, TORQUE)]


@pytest.mark.parametrize(
    ("frame", "node", "places", "can_id"),
    [
        ("command", "drive1", [DRIVE1], 0x201),
        ("sdo_request", "sensor2", [SENSOR2], 0x604),
        ("sync", "drive2", [DRIVE2], 0x080),
        ("nmt", "sensor1", [SENSOR1], 0x000),
        ("sync", "all", [EVERYBODY], 0x080),
        ("nmt", None, [EVERYBODY], 0x000),
        ("heartbeat", "host", [EVERYBODY], 0x77F),
    ],
)
def test_what_the_host_sends_is_lost_on_its_way_to_whom_the_row_says(frame, node, places, can_id):
    plan = active({"kind": "lose", "frame": frame} | ({} if node is None else {"node": node}))
    left = {other: plan.receive(other, can_id, b"\0") for other in (EVERYBODY, DRIVE1, DRIVE2, SENSOR1, SENSOR2)}
    assert [other for other, frames in left.items() if not frames] == places


@pytest.mark.parametrize(("frame", "first_id", "nodes"), [("torque", 0x181, [2, 3]), ("any", 0x581, [0, 1, 2, 3])])
def test_all_is_every_node_with_such_a_frame(frame, first_id, nodes):
    plan = active({"kind": "lose", "node": "all", "frame": frame})
    assert [node for node in range(4) if not plan.transmit(node, first_id + node, b"\0")] == nodes


LATE, MASK = frame_row("delay", delay_us=1.0), frame_row("corrupt", mask="ff")


@pytest.mark.parametrize(
    ("rows", "handed_over"),
    [
        ([frame_row("duplicate")], ["11", "22", "33"]),
        ([frame_row("reorder", count=1)], ["", "21", "3"]),
        ([frame_row("reorder")], ["", "21", ""]),
        ([frame_row("lose", count=2)], ["", "", "3"]),
        ([frame_row("lose"), MASK], ["", "", ""]),
        ([frame_row("duplicate"), MASK], ["\xce\xce", "\xcd\xcd", "\xcc\xcc"]),
        ([LATE, LATE, MASK], ["\xce", "\xcd", "\xcc"]),
    ],
    ids=["twice", "after the next", "each second one", "so often", "lost", "in their order", "late twice"],
)
def test_rows_about_one_frame_act_in_their_order_and_so_often_as_they_say(rows, handed_over):
    plan = active(*rows)
    found = [plan.transmit(SENSOR1, 0x183, sent) for sent in (b"1", b"2", b"3")]
    assert [b"".join(data for _, data in frames).decode("latin-1") for frames in found] == handed_over
    assert {late_ns for frames in found for late_ns, _ in frames} <= {1000.0 * rows.count(LATE)}
    plan.advance(PERIOD_NS)
    assert plan.is_quiet == any("count" in row for row in rows)


def test_frames_of_two_nodes_do_not_swap_with_each_other():
    plan = active({"kind": "reorder", "node": "all", "frame": "torque"})
    sent = [(SENSOR1, 0x183, b"a"), (SENSOR2, 0x184, b"b"), (SENSOR2, 0x184, b"c"), (SENSOR1, 0x183, b"d")]
    found = [[data for _, data in plan.transmit(*frame)] for frame in sent]
    assert found == [[], [], [b"c", b"b"], [b"d", b"a"]]


def test_chance_strikes_each_frame_that_is_handed_over():
    flip = frame_row("corrupt", bits=1)
    assert len(set(active(frame_row("duplicate"), flip).transmit(SENSOR1, 0x183, bytes(64)))) == 2
    assert len(set(active(flip, frame_row("duplicate")).transmit(SENSOR1, 0x183, bytes(64)))) == 1


def test_a_delayed_frame_says_how_late_it_is():
    plan = active(frame_row("delay", delay_us=100.0, jitter_us=400.0))
    late_us = [plan.transmit(SENSOR1, 0x183, TORQUE)[0][0] / 1e3 for _ in range(2000)]
    assert (min(late_us) >= 100.0, max(late_us) <= 500.0) == (True, True)
    assert statistics.fmean(late_us) == pytest.approx(300.0, abs=10.0)
    assert statistics.stdev(late_us) == pytest.approx(400.0 / 12**0.5, abs=5.0)


def test_a_frame_that_is_held_back_at_the_end_of_its_row_still_comes():
    plan = active(frame_row("reorder", duration_s=0.001))
    first, second = bytes(6), bytes([1] * 6)
    assert plan.transmit(SENSOR1, 0x183, first) == []
    plan.advance(2 * PERIOD_NS)
    assert (plan.mask, plan.is_quiet) == (0, False)
    assert plan.transmit(SENSOR1, 0x183, second) == [(0, second), (0, first)]
    assert plan.is_quiet
    assert plan.transmit(SENSOR1, 0x183, first) == [(0, first)]


def flipped(before: bytes, after: bytes) -> list[int]:
    bits = int.from_bytes(before, "little") ^ int.from_bytes(after, "little")
    return [bit for bit in range(8 * len(before)) if bits >> bit & 1]


@pytest.mark.parametrize("bits", [1, 5, 48, 500])
def test_so_many_bits_flip_as_the_row_says(bits):
    plan = active(frame_row("corrupt", bits=bits))
    seen = set()
    for _ in range(400):
        ((_, data),) = plan.transmit(SENSOR1, 0x183, TORQUE)
        found = flipped(TORQUE, data)
        assert len(found) == min(bits, 48)
        seen |= set(found)
    assert seen == set(range(48))


@pytest.mark.parametrize(("mask", "data"), [("ff", "ff0203"), ("0080", "008203"), ("00000001", "000203")])
def test_a_mask_says_which_bits_flip(mask, data):
    plan = active(frame_row("corrupt", mask=mask))
    assert plan.transmit(SENSOR1, 0x183, bytes.fromhex("000203"))[0][1] == bytes.fromhex(data)


@pytest.mark.parametrize(
    ("contract", "name", "frame", "node"),
    [
        ("arm", "Sensor1Torque", "torque", SENSOR1),
        ("arm", "Drive2Command", "command", DRIVE2),
        ("arm_fd", "Drive1Feedback", "feedback", DRIVE1),
    ],
)
def test_a_frozen_counter_stands_still_under_a_right_crc(contract, name, frame, node):
    message = load_codec(CONTRACTS[contract].path).message(name)
    node_name = ("drive1", "drive2", "sensor1", "sensor2")[node]
    plan = plan_of({"kind": "freeze_counter", "node": node_name, "frame": frame, "at_s": 0.0}, contract=contract)
    sender, receiver = message.sender(), message.receiver()
    statuses = []
    for k in range(6):
        if k == 2:
            plan.advance(0)
        data = sender.protect(bytearray([0] * (message.length - 1) + [k]))
        way = plan.receive if frame == "command" else plan.transmit
        ((_, data),) = way(node, message.can_id, data)
        assert data[-1] == k
        statuses.append(receiver.check(data))
    assert statuses == [E2eStatus.OK] * 3 + [E2eStatus.REPEATED] * 3


@pytest.mark.parametrize(
    ("row", "contract", "message"),
    [
        ({"kind": "freeze_counter", "frame": "feedback"}, "arm", "Drive1Feedback has no counter to freeze in arm.dbc"),
        ({"kind": "lose", "frame": "status"}, "arm_fd", "frame 'status' is not in arm_fd.dbc: "),
        ({"kind": "corrupt", "frame": "heartbeat", "mask": "0001"}, "arm", "mask = '0001' has no bit in the 1 "),
        ({"kind": "babble", "can_id": 0x7F, "rate_Hz": 10.0, "data": "00" * 12}, "arm", "data has 12 bytes; "),
        ({"kind": "babble", "can_id": 0x7F, "rate_Hz": 10.0, "data": "00" * 9}, "arm_fd", "data has 9 bytes; "),
        ({"kind": "wrong_node_id", "node_id": 1}, "arm", "node_id = 1 is drive1's own"),
    ],
)
def test_a_frame_that_the_contract_has_not_is_refused(row, contract, message):
    timed = {} if "node_id" in row else {"at_s": 0.0}
    with pytest.raises(ConfigError) as refusal:
        plan_of({"node": "drive1", **timed, **row}, contract=contract)
    assert str(refusal.value).startswith(f"faults[0]: {message}")


# Chance


def lost_frames(plan: FaultPlan, node: int = SENSOR1, can_id: int = 0x183) -> list[bool]:
    return [not plan.transmit(node, can_id, TORQUE) for _ in range(200)]


HALF = frame_row("lose", probability=0.5)


def test_the_same_seed_hits_the_same_frames_and_another_hits_others():
    assert lost_frames(active(HALF)) == lost_frames(active(HALF))
    assert lost_frames(active(HALF)) != lost_frames(active(HALF, seed=2))


@pytest.mark.parametrize(
    "others",
    [
        [example("lose", node="sensor2")],
        [example("corrupt", node="sensor1", probability=0.5)],
        [frame_row("duplicate", probability=0.5), frame_row("delay", delay_us=1.0, jitter_us=1.0)],
        [frame_row("lose", frame="status"), {"kind": "jump", "node": "sensor1", "signal": "torque", "step": 1.0}],
    ],
)
def test_other_rows_before_and_after_a_row_leave_its_draws_alone(others):
    alone = lost_frames(active(HALF))
    assert lost_frames(active(*others, HALF, *others)) == alone


def test_a_row_draws_for_each_frame_though_another_row_has_lost_it():
    plan, both = active(HALF_CORRUPT), active(HALF, HALF_CORRUPT)
    alone = [plan.transmit(SENSOR1, 0x183, TORQUE)[0][1] != TORQUE for _ in range(200)]
    together = [both.transmit(SENSOR1, 0x183, TORQUE) for _ in range(200)]
    kept = [(a, frames[0][1] != TORQUE) for a, frames in zip(alone, together, strict=True) if frames]
    assert 60 < len(kept) < 140
    assert 0.3 < sum(a for a, _ in kept) / len(kept) < 0.7  # the two rows don't hit the same frames
    assert [a for a, _ in kept] == [b for _, b in kept]


HALF_CORRUPT = frame_row("corrupt", mask="ff", probability=0.5)


def test_the_numbers_of_a_row_do_not_choose_its_stream():
    rare = lost_frames(active(frame_row("lose", probability=0.2)))
    often = lost_frames(active(HALF))
    assert 20 < sum(rare) < 60
    assert all(is_lost for is_lost, was_lost in zip(often, rare, strict=True) if was_lost)


# Values

TOP, BOTTOM = TORQUE_COUNTS[1], TORQUE_COUNTS[0]
JUMPED = 100 + round(1.5 / VELOCITY_LSB_RAD_S)
SENSED = {"kind": "saturate", "node": "sensor2", "signal": "torque"}
FAST = {"kind": "saturate", "node": "drive1", "signal": "velocity", "value": 0.5}
JUMP = {"kind": "jump", "node": "sensor1", "signal": "torque"}


@pytest.mark.parametrize(
    ("node", "signal", "expected"),
    [
        ("drive2", "position", ((1, 6), (3, 4), (11, 12))),
        ("drive1", "velocity", ((1, 2), (7, 4), (11, 12))),
        ("sensor2", "torque", ((1, 2), (3, 4), (11, 10))),
    ],
)
def test_a_value_that_sticks_repeats_the_one_of_the_onset(node, signal, expected):
    plan = active({"kind": "stick", "node": node, "signal": signal})
    plan.distort((5, 6), (7, 8), (9, 10))
    plan.distort((0, 0), (0, 0), (0, 0))
    assert plan.distort((1, 2), (3, 4), (11, 12)) == expected


@pytest.mark.parametrize(
    ("row", "which", "joint", "counts", "seen"),
    [
        (JUMP | {"node": "drive1", "signal": "position", "step": -1.5}, 0, 0, 100, 100 - round(1.5 / POSITION_LSB_RAD)),
        (JUMP | {"node": "drive2", "signal": "velocity", "step": 1.5}, 1, 1, 100, JUMPED),
        (JUMP | {"step": -1.5}, 2, 0, 100, 100 - round(1.5 / TORQUE_LSB_NM)),
        (JUMP | {"step": 200.0}, 2, 0, 0, TOP),
        (JUMP | {"step": -200.0}, 2, 0, 0, BOTTOM),
        (SENSED, 2, 1, 5, TOP),
        (SENSED, 2, 1, 0, TOP),
        (SENSED, 2, 1, -5, BOTTOM),
        (FAST, 1, 0, -2000, -1000),
        (FAST, 1, 0, -1000, -1000),
        (FAST, 1, 0, 3, 3),
        (FAST, 1, 0, 1001, 1000),
    ],
)
def test_a_value_jumps_by_its_step_or_saturates_at_its_bound_and_no_other_does(row, which, joint, counts, seen):
    values = [[7, 7], [7, 7], [7, 7]]
    values[which][joint] = counts
    found = active(row).distort(*values)
    values[which][joint] = seen
    assert [list(pair) for pair in found] == values


@pytest.mark.parametrize(
    ("row", "counts", "seen"),
    [
        (JUMP | {"step": -1.5}, 100, 100 - round(0.75 / TORQUE_LSB_NM)),
        (SENSED | {"node": "sensor1", "value": 2.0}, 9000, round(1.0 / TORQUE_LSB_NM)),
    ],
)
def test_a_torque_of_a_sensor_with_a_wide_range_changes_by_its_own_counts(row, counts, seen):
    sensors = {"torque_range_Nm": [100.0, 50.0], "torque_bits": [16, 16]}
    scenario = quiet_scenario(sensors=sensors, faults=[row | {"at_s": 0.0}])
    plan = Injector(scenario, CODEC, None, None).plan
    plan.advance(0)
    assert plan.distort((0, 0), (0, 0), (counts, counts))[2] == (seen, counts)


# SYNC


def test_sync_is_late_while_the_row_is_active():
    plan = plan_of(example("late_sync", delay_us=200.0, jitter_us=0.0, duration_s=1.0))
    late = []
    for second in (0, 1, 2):
        plan.advance(second * S)
        late.append(plan.sync_delay_ns())
    assert late == [0, 200_000, 0]
    plan = active({"kind": "late_sync", "delay_us": 100.0, "jitter_us": 100.0, "probability": 0.25})
    hits = [delay_ns for _ in range(2000) if (delay_ns := plan.sync_delay_ns())]
    assert abs(len(hits) - 500) < 3.5 * 19.4
    assert (min(hits) >= 100_000, max(hits) <= 200_000) == (True, True)


# Floods


def flood(plan: FaultPlan, periods: int) -> list[tuple[int, int, bytes]]:
    """Return the frames with their times since the onset, in µs."""
    frames = []
    for k in range(periods):
        plan.advance(k * PERIOD_NS)
        frames += [(k * 1000 + offset // 1000, can_id, data) for offset, can_id, data in plan.babble(PERIOD_NS)]
    return frames


def test_a_babbling_node_floods_the_bus_at_its_rate():
    plan = plan_of({"kind": "babble", "node": "drive1", "can_id": 0x10, "rate_Hz": 2500.0, "data": "0102", "at_s": 0.0})
    frames = flood(plan, 4)
    assert [t_us for t_us, _, _ in frames] == [0, 400, 800, 1200, 1600, 2000, 2400, 2800, 3200, 3600]
    assert {(can_id, data) for _, can_id, data in frames} == {(0x10, b"\x01\x02")}


@pytest.mark.parametrize(
    ("end", "count"),
    [({"count": 7}, 7), ({"duration_s": 0.0025}, 13), ({"at_s": 0.0001, "duration_s": 0.0005}, 3)],
)
def test_a_flood_ends_by_count_or_time(end, count):
    plan = plan_of({"kind": "babble", "node": "drive1", "can_id": 0x10, "rate_Hz": 5000.0, "at_s": 0.0, **end})
    assert len(flood(plan, 10)) == count


def test_a_node_without_power_does_not_babble():
    row = {"kind": "babble", "node": "drive1", "can_id": 0x10, "rate_Hz": 1000.0, "at_s": 0.0}
    plan = plan_of(row, {"kind": "power_loss", "node": "drive1", "at_s": 0.002, "duration_s": 0.003})
    assert [t_us for t_us, _, _ in flood(plan, 8)] == [0, 1000, 5000, 6000, 7000]


# Nodes

A = ActionKind


REBOOT, BUS_OFF = {"kind": "reboot", "node": "drive1"}, {"kind": "bus_off", "node": "drive1"}
POWER_LOSS, FAULT = {"kind": "power_loss", "node": "drive1"}, {"kind": "drive_fault", "node": "drive1", "code": 0x2310}
ERROR, DRIFT = {"kind": "sensor_error", "node": "sensor1"}, {"kind": "clock_drift", "node": "drive1"}
STORM = {"kind": "emcy_storm", "node": "sensor1", "code": 0x1000, "rate_Hz": 500.0}
FOR_3_MS = {"duration_s": 0.003}
ACTIONS = [
    ([REBOOT], [(2, A.POWER_OFF, 0, 0), (2, A.POWER_ON, 0, 0)]),
    ([REBOOT | FOR_3_MS], [(2, A.POWER_OFF, 0, 0), (5, A.POWER_ON, 0, 0)]),
    ([BUS_OFF], [(2, A.LEAVE_BUS, 0, 0)]),
    ([BUS_OFF | FOR_3_MS], [(2, A.LEAVE_BUS, 0, 0), (5, A.RETURN_TO_BUS, 0, 0)]),
    ([POWER_LOSS], [(2, A.POWER_OFF, 0, 0)]),
    (
        [{"kind": "power_loss"} | FOR_3_MS],
        [(ms, kind, node, 0) for ms, kind in ((2, A.POWER_OFF), (5, A.POWER_ON)) for node in range(4)],
    ),
    ([REBOOT | {"at_s": 0.0012, "duration_s": 5e-4}], [(2, A.POWER_OFF, 0, 0), (3, A.POWER_ON, 0, 0)]),
    ([FAULT], [(2, A.FAIL, 0, 0x2310), (2, A.MEND, 0, 0)]),
    ([FAULT | {"at_s": 0.0012, "duration_s": 5e-4}], [(2, A.FAIL, 0, 0x2310), (3, A.MEND, 0, 0)]),
    ([FAULT | FOR_3_MS], [(2, A.FAIL, 0, 0x2310), (5, A.MEND, 0, 0)]),
    ([ERROR], [(2, A.SENSOR_STATUS, 2, 1)]),
    ([ERROR | FOR_3_MS | {"status": 5}], [(2, A.SENSOR_STATUS, 2, 5), (5, A.SENSOR_STATUS, 2, 0)]),
    ([DRIFT | FOR_3_MS | {"drift_ppm": -80.0}], [(2, A.DRIFT, 0, -80.0), (5, A.DRIFT, 0, 0)]),
    ([STORM | {"count": 3}], [(ms, A.EMERGENCY, 2, 0x1000) for ms in (2, 4, 6)]),
    ([STORM | {"rate_Hz": 2000.0, "duration_s": 0.002}], [(ms, A.EMERGENCY, 2, 0x1000) for ms in (2, 3, 3, 4)]),
    (
        [
            POWER_LOSS | {"duration_s": 0.005},
            REBOOT | {"at_s": 0.003, "duration_s": 0.002},
            POWER_LOSS | {"at_s": 0.004, "duration_s": 0.005},
        ],
        [(2, A.POWER_OFF, 0, 0), (9, A.POWER_ON, 0, 0)],
    ),
    (
        [ERROR | {"at_s": 0.001, "duration_s": 0.005}, ERROR | {"status": 4, "duration_s": 0.002}],
        [(ms, A.SENSOR_STATUS, 2, status) for ms, status in ((1, 1), (2, 5), (4, 1), (6, 0))],
    ),
    (
        [FAULT | {"at_s": 0.001, "duration_s": 0.002}, FAULT | {"duration_s": 0.004}],
        [(1, A.FAIL, 0, 0x2310), (2, A.FAIL, 0, 0x2310), (6, A.MEND, 0, 0)],
    ),
]
"""Rows from 2 ms on where they don't say otherwise; several of one kind: the last that ends takes its effect away."""


@pytest.mark.parametrize(("rows", "actions"), ACTIONS)
def test_what_happens_to_nodes_happens_when_it_should_and_once(rows, actions):
    plan = plan_of(*[{"at_s": 0.002} | row for row in rows])
    found = []
    for ms in range(13):
        plan.advance(ms * MS)
        was_quiet, due = plan.is_quiet, plan.actions()
        assert not (due and was_quiet)
        found += [(ms, *action[:3]) for action in due]
    assert found == actions
    assert plan.is_acknowledged


@pytest.mark.parametrize(
    ("rows", "is_acknowledged"),
    [
        ([], True),
        ([{"kind": "power_loss"}], False),
        ([{"kind": "power_loss", "node": "drive1"}], True),
        ([{"kind": "bus_off", "node": node} for node in ("drive1", "drive2", "sensor1", "sensor2")], False),
        ([{"kind": "silence", "node": "all"}], True),
    ],
)
def test_what_the_host_sends_is_acknowledged_as_long_as_anybody_is_there(rows, is_acknowledged):
    assert active(*rows).is_acknowledged is is_acknowledged
