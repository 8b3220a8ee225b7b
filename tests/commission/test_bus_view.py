"""A listener's view of a bus: frames by hand in, counts, rates, checks and values out."""

from typing import Any

import pytest
from loaded import encoded

from adacd_hil.lab.commission.survey import BusView
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.dbc_contract import load_codec

CODEC = load_codec()
TORQUE = CODEC.message("Sensor1Torque")
MS = 1_000_000


def view() -> BusView:
    return BusView(CODEC, 1_000_000, 0, 0)


def by_name(described: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {message["message"]: message for message in described["messages"]}


def torque_frames(count: int) -> list[bytes]:
    sender = TORQUE.sender()
    return [sender.protect(encoded(TORQUE, 0.001 * number)) for number in range(count)]


def test_a_message_has_rate_age_and_the_values_of_its_last_frame():
    seen = view()
    for number, data in enumerate(torque_frames(100)):
        seen.accept(Frame(0x183, data, 10 * MS * number))
    message = by_name(seen.describe(1000 * MS))["Sensor1Torque"]
    assert (message["count"], message["rate_Hz"], message["age_s"]) == (100, 100.0, pytest.approx(0.010))
    assert (message["values"], message["units"]) == ({"torque": pytest.approx(0.099)}, {"torque": "Nm"})


def test_a_lost_frame_and_a_wrong_crc_are_told_apart_and_change_no_value():
    seen = view()
    frames = torque_frames(6)
    frames[5] = frames[5][:-1] + bytes((frames[5][-1] ^ 1,))
    for number in (0, 1, 3, 4, 5):
        seen.accept(Frame(0x183, frames[number], number * MS))
    message = by_name(seen.describe(10 * MS))["Sensor1Torque"]
    assert (message["lost"], message["errors"]) == (1, 1)
    assert message["values"] == {"torque": pytest.approx(0.004)}


def test_a_frame_of_the_wrong_length_is_an_error_and_has_no_value():
    seen = view()
    seen.accept(Frame(0x181, b"\x01\x02", MS))
    message = by_name(seen.describe(2 * MS))["Drive1Feedback"]
    assert (message["errors"], message["values"], message["data"]) == (1, {}, "0102")


def test_nodes_are_told_by_their_heartbeats():
    seen = view()
    seen.accept(Frame(0x702, b"\x7f", 100 * MS))
    seen.accept(Frame(0x709, b"\x05", 150 * MS))
    nodes = [tuple(node.values()) for node in seen.describe(200 * MS)["nodes"]]
    assert nodes == [(2, "Drive2", "pre-operational", 0.1), (9, "", "operational", 0.05)]


def test_a_node_filter_leaves_that_nodes_identifiers():
    seen = view()
    for can_id in (0x080, 0x181, 0x182, 0x201, 0x701, 0x702):
        seen.accept(Frame(can_id, b"\x05", MS))
    described = seen.describe(2 * MS, node_id=1)
    assert [message["id"] for message in described["messages"]] == [0x181, 0x201, 0x701]
    assert [node["node_id"] for node in described["nodes"]] == [1]
    assert described["frames"] == 6


def test_a_rate_follows_a_talker_that_falls_silent():
    seen = view()
    for number in range(1000):
        seen.accept(Frame(0x080, b"\x01", number * MS))
    rates = [by_name(seen.describe(second * 1000 * MS))["Sync"]["rate_Hz"] for second in (1, 2, 3, 4)]
    assert rates == [1000.0, 500.0, 0.0, 0.0]


def test_the_load_is_that_since_the_call_before():
    seen = view()
    for number in range(100):
        seen.accept(Frame(0x7FF, bytes(8), number * MS))
    first, second = seen.describe(100 * MS), seen.describe(200 * MS)
    assert 10.0 < first["load_percent"] < 14.0
    assert second["load_percent"] == 0.0


def test_a_frame_too_long_for_the_contracts_bus_is_counted_and_left_out_of_the_load():
    seen = view()
    seen.accept(Frame(0x055, bytes(12), MS))
    described = seen.describe(2 * MS)
    assert (described["strange_frames"], described["load_percent"], described["messages"][0]["count"]) == (1, 0.0, 1)


def test_error_frames_are_counted_apart():
    seen = view()
    seen.accept(Frame(0x040, bytes(8), MS, is_error=True))
    described = seen.describe(2 * MS)
    assert (described["error_frames"], described["messages"], described["frames"]) == (1, [], 1)
