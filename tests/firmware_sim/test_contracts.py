"""The contracts that the emulator plays: DBC and EDS describe the same frames, and the devices send them."""

import struct
from pathlib import Path

import canopen
import cantools
import pytest
from bench_host import ENABLING, PERIOD_NS, BenchHost, Nmt, State, remap
from canopen.objectdictionary.datatypes import SIGNED_TYPES

from adacd_hil.settings.schema import ConfigError
from adacd_hil.wire.dbc_contract import contract_folder, load_codec, parse_codec
from firmware_sim.canopen.object_dictionary import CONTRACTS, playable_contract

DRIVE_NODES, SENSOR_NODES = (1, 2), (3, 4)
# What a master has to map on stock drives: record -> COB-ID base, type, entries.
STOCK = {
    0x1400: (0x200, 1, (0x60400010, 0x60710010)),
    0x1800: (0x180, 1, (0x60640020, 0x606C0020)),
    0x1801: (0x280, 255, (0x60410010, 0x60610008, 0x60770010, 0x603F0010)),
}


def layout_of(eds: canopen.ObjectDictionary, entries: tuple[int, ...]) -> list[tuple[int, int, bool]]:
    """Place mapped objects: start bit, length, is signed; each entry's length must be the object's."""
    places, start = [], 0
    for entry in entries:
        variable = eds.get_variable(entry >> 16, entry >> 8 & 0xFF)
        assert entry & 0xFF == len(variable)
        places.append((start, len(variable), variable.data_type in SIGNED_TYPES))
        start += len(variable)
    return places


def default_pdos(eds: canopen.ObjectDictionary) -> dict[int, tuple[int, ...]]:
    """Give the entries of each PDO that exists at power-on, by its COB-ID."""
    pdos = {}
    for record in (*range(0x1400, 0x1404), *range(0x1800, 0x1804)):
        cob_id = eds.get_variable(record, 1).default if record in eds else 1 << 31
        if not cob_id >> 31:
            count = eds.get_variable(record + 0x200, 0).default
            entries = (eds.get_variable(record + 0x200, sub).default for sub in range(1, count + 1))
            pdos[cob_id & 0x7FF] = tuple(entries)
    return pdos


def assert_same_layout(message, eds: canopen.ObjectDictionary, entries: tuple[int, ...]) -> None:
    mapped = layout_of(eds, entries)
    assert mapped[-1][0] + mapped[-1][1] == message.length * 8
    signals = sorted(message.signals, key=lambda signal: signal.start)
    assert {signal.byte_order for signal in signals} == {"little_endian"}
    laid_out = [(signal.start, signal.length, signal.is_signed) for signal in signals]
    if any(signal.name == "e2e_counter" and signal.length == 4 for signal in signals):
        assert laid_out[1:3] == [(8, 4, False), (12, 4, False)]
        laid_out[1:3] = [(8, 8, False)]  # one mapped byte, 0x2100:2, holds both nibbles
    assert laid_out == mapped


@pytest.mark.parametrize("name", ["arm", "arm_fd", "arm_stock"])
def test_mappings_by_default_and_what_is_to_be_mapped_on_stock_drives_are_the_dbcs_frames_bit_for_bit(name):
    contract = CONTRACTS[name]
    database = cantools.database.load_file(contract.path)
    seen = set()
    for node in (*DRIVE_NODES, *SENSOR_NODES):
        file = contract.drive_eds if node in DRIVE_NODES else contract.sensor_eds
        eds = canopen.import_od(str(contract_folder() / file), node)
        pdos = default_pdos(eds)
        if name == "arm_stock" and node in DRIVE_NODES:
            pdos = {base + node: entries for base, _, entries in STOCK.values()}
        for can_id, entries in pdos.items():
            assert_same_layout(database.get_message_by_frame_id(can_id), eds, entries)
            seen.add(can_id)
    cyclic = {message.frame_id for message in database.messages if 0x180 < message.frame_id < 0x580}
    assert seen == cyclic


def test_a_stock_drive_watches_its_commands_by_the_event_timer_only():
    host = BenchHost(contract="arm_stock")
    for node in (*DRIVE_NODES, *SENSOR_NODES):
        host.write(node, 0x1019, 0, 240)
        host.write(node, 0x1006, 0, 1000)
    base, kind, entries = STOCK[0x1400]
    for node in DRIVE_NODES:
        remap(host, node, 0x1400, entries, can_id=base + node, kind=kind, timer_ms=5 if node == 1 else 0)
        host.write(node, 0x6060, 0, 10)
    host.nmt(Nmt.START)
    for word in ENABLING:
        for node in DRIVE_NODES:
            host.put(base + node, struct.pack("<Hh", word, 0))
        host.sync()
    assert [host.state_bits(joint) for joint in (1, 2)] == [State.ENABLED] * 2
    host.sync(times=5)
    assert host.read(1, 0x603F) == 0x8250
    assert host.read(2, 0x603F) == 0
    for index in (0x2000, 0x2100, 0x2200, 0x2201, 0x2210):
        assert host.abort_code(lambda i=index: host.nodes[1].sdo.upload(i, 0)) == 0x06020000


@pytest.mark.parametrize("clock_mode", ["sync", "wall"])
def test_a_stock_drive_that_nobody_has_set_up_answers_a_sync_without_a_counter(clock_mode):
    host = BenchHost(contract="arm_stock", clock_mode=clock_mode)
    assert (host.read(1, 0x1019), host.read(1, 0x1006)) == (0, 0)
    host.write(1, 0x1800, 2, 1)
    host.nmt(Nmt.START)
    host.take()
    for _ in range(5):
        host.t_ns += 10 * PERIOD_NS
        host.put(0x080, b"")
    assert [can_id for can_id, _ in host.take()].count(0x181) == 5


def test_a_drive_that_was_never_told_a_period_does_not_watch_sync():
    host = BenchHost(contract="arm_stock", clock_mode="wall")
    host.nmt(Nmt.START)
    for word in ENABLING:
        host.t_ns += PERIOD_NS
        host.put(0x201, struct.pack("<H", word))
        host.put(0x080, b"")
    host.take()
    host.put(0x080, b"\x01")
    assert [data[:2] for data in host.taken(0x081)] == [struct.pack("<H", 0x8240)]
    host.bench.advance_to(host.t_ns + 1000 * PERIOD_NS)
    assert host.state_bits(1) == 0x27


@pytest.mark.parametrize("sub", [0, 1])
def test_a_stock_sensors_mapping_is_fixed(sub):
    host = BenchHost(contract="arm_stock")
    assert host.abort_code(lambda: host.write(3, 0x1A00, sub, 0)) == 0x06010002
    assert host.abort_code(lambda: host.write(3, 0x1800, 1, 0x80000183)) == 0x06010002


def test_frames_that_no_device_has_are_not_played_by_another() -> None:
    codec = load_codec()
    text = codec.text.replace(b"SG_ torque : 16|32@1- (1e-06,0)", b"SG_ torque : 16|32@1- (1e-05,0)")
    other = parse_codec(text, Path("arm.dbc"))
    with pytest.raises(ConfigError, match=r"no emulated device has the frames of arm\.dbc, layout digest 0x"):
        playable_contract(other)
