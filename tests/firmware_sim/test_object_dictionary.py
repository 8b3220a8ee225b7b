"""The devices' CANopen side, as canopen's own client and bare frames see it."""

import configparser
import struct

import pytest
from bench_host import CODEC, EDS, Nmt
from eds_variants import EdsVariant

from adacd_hil.wire.dbc_contract import contract_folder
from firmware_sim.canopen.error_control import Watchdog
from firmware_sim.canopen.object_dictionary import DeviceDescription
from firmware_sim.nodes.device import EmulatedDevice, NmtState

WRITE_ONLY, NO_DATA = 0x06010001, 0x08000024

# What differs from the EDS default right after boot-up: live values.
LIVE = {
    (1, 0x2000, 1): CODEC.wire_version,
    (1, 0x2000, 2): CODEC.layout_digest,
    (1, 0x2212, 0): 1,
    (1, 0x6041, 0): 0x0250,
    (1, 0x6076, 0): 12_000,
    (3, 0x2000, 1): CODEC.wire_version,
    (3, 0x2000, 2): CODEC.layout_digest,
    (3, 0x6150, 1): 1,
    (3, 0x2111, 0): 2500,
}


def eds_rows(node: int) -> list[tuple[int, int, str, str]]:
    """Read index, sub-index, access and default of every variable of an EDS, without canopen."""
    parser = configparser.ConfigParser()
    parser.read(contract_folder() / EDS[node])
    rows = []
    for section in parser.sections():
        index, _, sub = section.partition("sub")
        if len(index) == 4 and "DataType" in parser[section]:
            row = parser[section]
            rows.append((int(index, 16), int(sub or "0", 16), row["AccessType"], row.get("DefaultValue", "0")))
    return rows


def default_of(text: str, node: int) -> int | str:
    if text.startswith("$NODEID+"):
        return node + int(text.removeprefix("$NODEID+"), 0)
    try:
        return int(text, 0)
    except ValueError:
        return text


@pytest.mark.parametrize("node", [1, 3])
def test_every_listed_object_is_served_with_its_default_or_live_value(host, node):
    rows = eds_rows(node)
    assert len(rows) > 60
    for index, sub, access, default in rows:
        if access == "wo":
            assert host.abort_code(lambda i=index, s=sub: host.read(node, i, s)) == WRITE_ONLY
        elif index == 0x1003 and sub > 0:
            assert host.abort_code(lambda i=index, s=sub: host.read(node, i, s)) == NO_DATA
        else:
            expected = LIVE.get((node, index, sub), default_of(default, node))
            assert (index, sub, host.read(node, index, sub)) == (index, sub, expected)


STATES = {Nmt.START: 5, Nmt.STOP: 4, Nmt.PRE_OPERATIONAL: 127, Nmt.RESET_NODE: 127, Nmt.RESET_COMMUNICATION: 127}


@pytest.mark.parametrize("first", STATES)
def test_every_nmt_command_leads_from_every_state_to_its_own(host, first):
    for second, state in STATES.items():
        host.nmt(first)
        host.take()
        host.nmt(second)
        assert [device.state for device in host.bench.devices] == [state] * 4
        boot_ups = [can_id for can_id, _ in host.take() if can_id >= 0x700]
        assert boot_ups == ([0x701, 0x702, 0x703, 0x704] if second in (Nmt.RESET_NODE, Nmt.RESET_COMMUNICATION) else [])
    host.nmt(Nmt.START)
    host.nmt(Nmt.PRE_OPERATIONAL, 3)
    assert [device.state for device in host.bench.devices] == [5, 5, 127, 5]


def test_a_stopped_device_answers_no_sdo_and_sends_no_emergency(host):
    host.nmt(Nmt.STOP)
    host.take()
    host.put(0x601, bytes([0x40, 0x00, 0x10, 0, 0, 0, 0, 0]))
    host.bench.devices[0].trip(Watchdog.HEARTBEAT, 0)
    assert host.take() == []


@pytest.mark.parametrize("data", [b"", b"\x01", b"\x01\x00\x00", b"\x07\x00"])
def test_an_nmt_frame_that_makes_no_sense_changes_nothing(host, data):
    host.put(0x000, data)
    assert {device.state for device in host.bench.devices} == {NmtState.PRE_OPERATIONAL}


def test_heartbeats_come_by_bench_time_with_the_nmt_state(host):
    host.write(1, 0x1017, 0, 100)
    host.take()
    host.bench.advance_to(99_999_999)
    assert host.take() == []
    host.bench.advance_to(100_000_000)
    assert host.take() == [(0x701, b"\x7f")]
    host.nmt(Nmt.STOP)
    host.bench.advance_to(450_000_000)
    assert host.take() == [(0x701, b"\x04")] * 3
    host.nmt(Nmt.PRE_OPERATIONAL)
    host.write(1, 0x1017, 0, 0)
    host.take()
    host.bench.advance_to(1_000_000_000)
    assert host.take() == []


def test_one_heartbeat_comes_after_missed_ones_and_the_next_in_its_place(host):
    host.write(1, 0x1017, 0, 100)
    host.take()
    for t_ms, count in ((350, 1), (350, 0), (399, 0), (400, 1)):
        host.bench.time.poll(t_ms * 1_000_000)
        assert len(host.taken(0x701)) == count


@pytest.mark.parametrize("key", ["DefaultValue", "ParameterValue"])
def test_what_an_eds_gives_error_control_counts_from_the_first_power_on(tmp_path, key):
    sent = []
    eds = EdsVariant("drive.eds").with_value(700, "1015", key=key).with_value(100, "1017", key=key)
    described = DeviceDescription(eds.with_value(127 << 16 | 50, "1016sub1", key=key).write(tmp_path / "drive.eds"))
    device = EmulatedDevice(1, described, lambda can_id, _data: sent.append(can_id), CODEC.by_id, 8)
    device.power_on(0)
    device.on_heartbeat(127, 0)
    device.report_fault(0x2310, 0)
    device.report_no_error(0)
    assert [device.poll(t_ms * 1_000_000) for t_ms in (0, 50, 70)] == [50_000_000, 70_000_000, 100_000_000]
    device.poll(100_000_000)
    assert sent == [0x701, 0x081, 0x081, 0x701]


def test_a_reset_restores_the_communication_profile_or_everything(host):
    host.write(1, 0x1017, 0, 100)
    host.write(1, 0x6072, 0, 500)
    host.nmt(Nmt.RESET_COMMUNICATION)
    assert (host.read(1, 0x1017), host.read(1, 0x6072)) == (0, 500)
    host.take()
    host.bench.advance_to(1_000_000_000)
    assert host.take() == []
    host.nmt(Nmt.RESET_NODE)
    assert host.read(1, 0x6072) == 1000


def test_a_pdo_that_is_switched_off_is_not_sent_until_it_is_switched_on(host):
    host.nmt(Nmt.START)
    host.write(1, 0x1800, 1, 0x80000181)
    host.take()
    host.sync()
    assert host.taken(0x181) == []
    host.write(1, 0x1800, 1, 0x181)
    host.take()
    host.sync()
    assert len(host.taken(0x181)) == 1


def test_the_loss_of_the_masters_heartbeat_is_reported_and_ends_operational(host):
    host.write(3, 0x1016, 1, (127 << 16) | 300)
    host.nmt(Nmt.START)
    host.bench.advance_to(10_000_000_000)
    assert host.bench.devices[2].is_operational  # monitoring begins with the first heartbeat
    host.put(0x77F, b"\x05")
    host.take()
    host.bench.advance_to(10_299_999_999)
    assert host.taken(0x083) == []
    host.bench.advance_to(10_300_000_000)
    assert host.taken(0x083) == [struct.pack("<HBBI", 0x8130, 0x11, 3, 10_300)]
    assert host.bench.devices[2].state == NmtState.PRE_OPERATIONAL
    assert host.read(3, 0x1001) == 0x11
    assert host.read(3, 0x1003, 1) == 0x8130
    host.put(0x77F, b"\x05")
    assert host.taken(0x083) == [struct.pack("<HBBI", 0, 0, 3, 10_300)]
    assert host.read(3, 0x1001) == 0


def test_the_error_history_holds_the_last_four_newest_first_and_can_be_cleared(host):
    for watchdog in (Watchdog.HEARTBEAT, Watchdog.COMMAND, Watchdog.SYNC, Watchdog.OPERATIONAL, Watchdog.LENGTH):
        host.bench.devices[0].trip(watchdog, 0)
    assert host.read(1, 0x1003, 0) == 4
    assert [host.read(1, 0x1003, sub) for sub in (1, 2, 3, 4)] == [0x8210, 0x8100, 0x8700, 0x8250]
    host.write(1, 0x1003, 0, 0)
    assert host.read(1, 0x1003, 0) == 0


def test_emergency_messages_keep_their_inhibit_time_and_none_is_lost(host):
    host.write(1, 0x1015, 0, 50)
    host.take()
    for watchdog in (Watchdog.HEARTBEAT, Watchdog.COMMAND, Watchdog.SYNC):
        host.bench.devices[0].trip(watchdog, 0)
    sent = []
    for t_ms in range(12):
        host.bench.time.poll(t_ms * 1_000_000)
        sent.extend((t_ms, struct.unpack_from("<H", data)[0]) for data in host.taken(0x081))
    assert sent == [(0, 0x8130), (5, 0x8250), (10, 0x8700)]
