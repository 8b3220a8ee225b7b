"""The bit budget of contracts: which fit, why not, and what the DBC has to say for it."""

import dataclasses
from pathlib import Path

import pytest
from edited_contract import edited

from adacd_hil.wire.budget import Budget, LoadCase, ResponseTime, compute_budget, format_us
from adacd_hil.wire.codec import Codec, CodecError
from adacd_hil.wire.dbc_contract import load_codec, parse_codec
from adacd_hil.wire.moved_contract import move_contract

CONTRACTS = Path(__file__).parent / "contracts"
ARM = load_codec()
SYNCHRONOUS = ("Drive1Feedback", "Drive2Feedback", "Sensor1Torque", "Sensor2Torque")


def budget_of(name: str, period_us: int | None = None) -> Budget:
    return compute_budget(load_codec(CONTRACTS / f"{name}.dbc"), period_us)


def contract(text: bytes) -> Codec:
    return parse_codec(text, Path("x"))


def response_us(budget: Budget, name: str, traffic: LoadCase = LoadCase.OPERATION) -> float:
    (entry,) = [entry for entry in budget.frames if entry.name == name]
    return entry.responses[traffic].time_ns / 1000


@pytest.mark.parametrize(
    ("name", "period_us", "unstuffed", "worst", "cyclic_us", "is_fit"),
    [
        ("naive_cia402", None, 935, 1135, "1135.0", False),
        ("stock", None, 593, 715, "715.0", True),
        ("shared_command", None, 578, 700, "700.0", True),
        ("srdo", None, 832, 1010, "1010.0", False),
        ("fd_1ms", None, None, None, "513.8", True),
        ("fd_1ms", 500, None, None, "513.8", False),
    ],
)
def test_sets_of_frames(
    name: str, period_us: int | None, unstuffed: int | None, worst: int | None, cyclic_us: str, is_fit: bool
) -> None:
    budget = budget_of(name, period_us)
    if unstuffed is not None:
        assert (budget.unstuffed_bits, budget.worst_bits) == (unstuffed, worst)
    assert (format_us(budget.cyclic_ns).removesuffix(".0"), budget.is_fit) == (cyclic_us.removesuffix(".0"), is_fit)


@pytest.mark.parametrize(
    ("edits", "reason"),
    [
        ([('"Trigger"', '"Other"')], "DBC x has no attribute Trigger"),
        (
            [('"event","request"', '"event","request","never"'), ("BO_ 0 3;", "BO_ 0 4;")],
            r"DBC x: Nmt: Trigger = 'never'; known: sync, command, event, request",
        ),
        ([('BA_ "BusPeriod_us" 1000;', 'BA_ "BusPeriod_us" 0;')], "DBC x has no BusPeriod_us, and none is given"),
        (
            [
                ('BA_DEF_ "BusPeriod_us" INT 0 1000000;', 'BA_DEF_ "BusPeriod_us" STRING ;'),
                ('BA_DEF_DEF_ "BusPeriod_us" 1000;', 'BA_DEF_DEF_ "BusPeriod_us" "";'),
                ('BA_ "BusPeriod_us" 1000;', 'BA_ "BusPeriod_us" "1 ms";'),
            ],
            "DBC x: BusPeriod_us = '1 ms'",
        ),
    ],
    ids=["no trigger", "an unknown trigger", "no period", "a period in words"],
)
def test_a_contract_that_does_not_say_when_is_refused(edits: list[tuple[str, str]], reason: str) -> None:
    with pytest.raises(CodecError, match=reason):
        compute_budget(edited(*edits))


def test_the_arm_does_not_fit_half_a_millisecond() -> None:
    budget = compute_budget(ARM, 500)
    assert not budget.is_fit
    assert "arm.dbc at 500 µs doesn't fit: the cyclic frames need 795 µs, 295 µs too many" in budget.line
    assert "Drive2Command misses its deadline of 500 µs by at least 420 µs, 12 more miss theirs" in budget.line


def test_a_contract_can_miss_deadlines_though_its_cyclic_frames_have_room() -> None:
    budget = compute_budget(ARM, 900)
    assert budget.host_ns == 105_000
    # 795 µs, and a drive status of 125 µs that has just begun
    assert [entry.name for entry in budget.late if entry.is_cyclic] == ["Drive2Command"]
    assert "Drive2Command misses its deadline of 900 µs by 20 µs" in budget.line


def test_half_the_bit_rate_takes_twice_the_time() -> None:
    assert compute_budget(ARM, 2000, bitrate=500_000).cyclic_ns == 2 * 795_000
    assert not compute_budget(ARM, 1000, bitrate=500_000).is_fit


def test_response_times_of_the_arm_by_hand() -> None:
    budget = compute_budget(ARM)
    # SYNC waits for one 8-byte frame; the last command for a status and all six others
    assert response_us(budget, "Sync") == 135 + 65
    assert response_us(budget, "Drive1Feedback") == 135 + 65 + 135
    assert response_us(budget, "Sensor1Torque") == 125 + 65 + 2 * 135 + 115
    assert response_us(budget, "Drive2Command") == 125 + 795
    # a status waits for its cycle's frames and, as it doesn't get through before it, not for the next cycle's
    assert response_us(budget, "Drive1Status") == 125 + 795 + 125


def test_one_sdo_frame_per_cycle_blocks_the_last_command_for_135_us() -> None:
    budget = compute_budget(ARM)
    assert response_us(budget, "Drive2Command", LoadCase.REQUESTS) == 135 + 795
    assert "one SDO in every cycle: in time, Drive2Command within 930 µs" in budget.notes


def test_requests_of_several_nodes_are_one_per_cycle() -> None:
    budget = compute_budget(ARM)
    heartbeat = budget.frames[-1]
    assert heartbeat.name == "HostHeartbeat"
    # Eight SDO messages of 135 µs lie above it. Were all of them sent in every cycle, nothing would be left.
    assert heartbeat.responses[LoadCase.REQUESTS].is_bounded
    assert heartbeat.late_ns(LoadCase.REQUESTS) == 0
    assert heartbeat.responses[LoadCase.REQUESTS] > heartbeat.responses[LoadCase.OPERATION]
    requests = [entry for entry in budget.frames if "Sdo" in entry.name]
    assert len(requests) == 8
    assert {entry.responses[LoadCase.REQUESTS] for entry in requests} == {requests[0].responses[LoadCase.REQUESTS]}


def test_a_single_request_gets_through_where_one_per_cycle_would_not() -> None:
    (request,) = [entry for entry in budget_of("fd_500us").frames if entry.name == "Drive1SdoRequest"]
    # a heartbeat, the cyclic frames, itself
    assert request.responses[LoadCase.OPERATION] == ResponseTime(65_000 + 388_500 + 135_000)
    assert not request.responses[LoadCase.REQUESTS].is_bounded


def test_a_frame_without_bound_is_late_whatever_was_found() -> None:
    entry = compute_budget(ARM).frames[1]
    endless = dataclasses.replace(entry, responses={LoadCase.OPERATION: ResponseTime(10_000, is_bounded=False)})
    assert (entry.late_ns(), endless.late_ns()) == (0, 1)


def test_an_emcy_of_every_device_makes_commands_late_and_is_said() -> None:
    budget = compute_budget(ARM)
    # B 135, four EMCY 540: SYNC and feedback of the next two cycles overtake the second command as well
    assert response_us(budget, "Drive2Command", LoadCase.EMERGENCIES) == 135 + 540 + 3 * 680 + 115
    assert "and every EMCY at once: Drive2Command misses its deadline of 1000 µs by 1830 µs" in budget.notes
    assert budget.is_fit


def test_an_inhibit_time_counts_as_the_interval() -> None:
    budget = compute_budget(edited(('BA_DEF_DEF_ "GenMsgDelayTime" 0;', 'BA_DEF_DEF_ "GenMsgDelayTime" 20;')))
    intervals = {entry.name: entry.interval_ns for entry in budget.frames}
    assert (intervals["Drive1Status"], intervals["Sync"]) == (20_000_000, 1_000_000)
    assert not [note for note in budget.notes if "inhibit" in note]
    # four EMCY, four status; a heartbeat keeps its time
    (note,) = [note for note in compute_budget(ARM).notes if "inhibit" in note]
    assert "event frames without inhibit time (GenMsgDelayTime): 4." in note


def test_event_frames_that_come_too_often_miss_their_deadlines() -> None:
    budget = compute_budget(edited(('BA_DEF_DEF_ "GenMsgDelayTime" 0;', 'BA_DEF_DEF_ "GenMsgDelayTime" 1;')))
    assert budget.load > 1.0
    late = [entry.name for entry in budget.late]
    assert late[-1] == "HostHeartbeat"
    assert not budget.is_fit


def test_a_smaller_can_fd_set_at_1m_8m_fits_half_a_millisecond() -> None:
    budget = budget_of("fd_500us")
    assert (budget.period_us, budget.is_fit) == (500, True)
    # SYNC 65; nominal 6 x 33; data 2 x 194 + 4 x 154 at 8 Mbit/s
    assert budget.cyclic_ns == (65 + 6 * 33) * 1000 + (2 * 194 + 4 * 154) * 125
    assert "one SDO in every cycle: Drive2Command misses its deadline of 500 µs by 23.5 µs" in budget.notes


def test_a_can_fd_contract_needs_a_data_bit_rate() -> None:
    text = (CONTRACTS / "fd_1ms.dbc").read_bytes().replace(b'BA_ "BaudrateCANFD" 5000000;', b"")
    with pytest.raises(CodecError, match=r"DBC x has no BaudrateCANFD, and none is given"):
        compute_budget(contract(text))
    assert compute_budget(contract(text), data_bitrate=5_000_000).is_fit


def test_arbitration_is_by_the_bits_on_the_wire() -> None:
    changes = [(f"{word} 1919 ", f"{word} {0x80000000 | 0x081 << 18} ") for word in ("BO_", "VAL_")]
    names = [frame.name for frame in compute_budget(edited(*changes)).frames]
    # An extended frame loses to the base frame with the same first 11 bits and wins over the next one.
    assert names[:5] == ["Nmt", "Sync", "Drive1Emcy", "HostHeartbeat", "Drive2Emcy"]


def test_frames_of_two_arms_compete_by_their_identifiers() -> None:
    shared = compute_budget(ARM, 2000, arms=2)
    order = [f"{entry.can_id:03X} {entry.name}" for entry in shared.frames if entry.is_cyclic]
    assert order == [
        "080 Sync",
        *(f"{0x181 + n:03X} Arm{1 + n // 4}.{name}" for n, name in enumerate(2 * SYNCHRONOUS)),
        *(f"{0x201 + n:03X} Arm{1 + n // 4}.Drive{1 + n % 4}Command" for n in (0, 1, 4, 5)),
    ]
    assert [entry.can_id for entry in shared.frames if entry.name.endswith("HostHeartbeat")] == [0x77E, 0x77F]


def test_devices_and_hosts_of_a_shared_bus_have_no_node_id_in_common() -> None:
    with pytest.raises(CodecError, match="26 arms"):  # devices up to 104, hosts down to 102
        compute_budget(ARM, 2000, arms=26)


def test_which_arm_of_a_shared_bus_asks_makes_no_difference() -> None:
    def times(node_offset: int) -> list[tuple[int, str]]:
        budget = compute_budget(move_contract(ARM, node_offset), 2000, arms=3)
        return [(entry.responses[LoadCase.EMERGENCIES].time_ns, entry.name) for entry in budget.frames]

    assert times(0) == times(8)


def test_each_host_of_a_shared_bus_may_ask_once_per_period() -> None:
    heartbeat = compute_budget(ARM, 4000, arms=2).frames[-1]
    alone = compute_budget(ARM, 4000).frames[-1]
    assert heartbeat.name == "Arm1.HostHeartbeat"
    waits = [
        entry.responses[LoadCase.REQUESTS].time_ns - entry.responses[LoadCase.OPERATION].time_ns
        for entry in (alone, heartbeat)
    ]
    assert waits == [135_000, 2 * 135_000]
