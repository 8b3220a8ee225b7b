"""PDOs that a master maps as it likes: rules of CiA 301 over the wire, and what then goes over the bus."""

import struct

import pytest
from bench_host import ENABLING, BenchHost, Nmt, Word, remap

NO_OBJECT, NO_SUBINDEX, NOT_MAPPABLE, TOO_LONG = 0x06020000, 0x06090011, 0x06040041, 0x06040042
INCOMPATIBLE, VALUE_RANGE, DEVICE_STATE, READ_ONLY = 0x06040043, 0x06090030, 0x08000022, 0x06010002
COMMAND = (0x60400010, 0x60710010)


def entry(index: int, bits: int, sub: int = 0) -> int:
    return index << 16 | sub << 8 | bits


def abort_of(host: BenchHost, index: int, sub: int, value: int, node: int = 1) -> int:
    return host.abort_code(lambda: host.write(node, index, sub, value))


@pytest.mark.parametrize("record", [0x1401, 0x1802])
def test_an_identifier_of_another_service_or_of_29_bits_is_refused(host, record):
    others = (0x000, 0x001, 0x07F, 0x080, 0x081, 0x101, 0x180, 0x581, 0x601, 0x6E0, 0x701, 0x7FF)
    for can_id in (*others, 0x2000_0185, 0x0000_0985, 0x1234_5678):
        assert abort_of(host, record, 1, can_id) == VALUE_RANGE


@pytest.mark.parametrize("record", [0x1400, 0x1801])
def test_the_transmission_types_of_the_standard_are_taken_and_no_others(host, record):
    for kind in (0, 1, 2, 240, 254, 255):
        host.write(1, record, 2, kind)
        assert host.read(1, record, 2) == kind
    for kind in (241, 251, 252, 253):
        assert abort_of(host, record, 2, kind) == VALUE_RANGE


POSITION, TORQUE = entry(0x6064, 32), entry(0x6077, 16)
HEADER = (entry(0x2100, 8, 1), entry(0x2100, 8, 2))


@pytest.mark.parametrize(
    ("entries", "place", "value", "code"),
    [
        ((), (0x1400, 1), 0x202, DEVICE_STATE),  # a PDO that exists is not changed
        ((), (0x1600, 0), 0, DEVICE_STATE),
        ((), (0x1600, 1), COMMAND[0], DEVICE_STATE),
        ((), (0x1800, 1), 0x191, DEVICE_STATE),
        ((), (0x1801, 3), 10, DEVICE_STATE),
        ((), (0x1A00, 2), TORQUE, DEVICE_STATE),
        ((), (0x1401, 1), 0x190, VALUE_RANGE),  # the controller doesn't listen to it
        ((), (0x1602, 1), entry(0x5000, 16), NO_OBJECT),
        ((), (0x1602, 1), entry(0x6071, 16, 1), NO_SUBINDEX),
        ((), (0x1602, 1), entry(0x6076, 32), NOT_MAPPABLE),  # the EDS says so
        ((), (0x1602, 1), POSITION, NOT_MAPPABLE),  # can't be written
        ((), (0x1602, 1), entry(0x6071, 8), NOT_MAPPABLE),  # has 16 bits
        ((), (0x1602, 1), entry(0x0005, 16), NOT_MAPPABLE),  # a dummy of 8 bits
        ((), (0x1602, 1), entry(0x0004, 32), NO_OBJECT),  # DummyUsage lacks it
        ((), (0x1A02, 1), entry(0x0005, 8), NOT_MAPPABLE),  # dummies are for receiving
        ((), (0x1A02, 1), COMMAND[0], NOT_MAPPABLE),  # rww: for receiving
        ((POSITION, entry(0x606C, 32), entry(0x6041, 16)), (0x1A02, 0), 3, TOO_LONG),
        ((), (0x1A02, 0), 9, TOO_LONG),
        ((), (0x1A02, 0), 1, NO_OBJECT),  # more than were written
        ((HEADER[0], POSITION), (0x1A02, 0), 2, INCOMPATIBLE),  # half a header
        ((POSITION, *HEADER), (0x1A02, 0), 3, INCOMPATIBLE),  # not leading
        ((*HEADER, POSITION), (0x1A02, 0), 3, INCOMPATIBLE),  # the message of this PDO has no data ids
    ],
)
def test_what_a_pdo_can_not_be_is_refused_with_the_reason_and_changes_nothing(host, entries, place, value, code):
    for sub, mapped in enumerate(entries, start=1):
        host.write(1, 0x1A02, sub, mapped)
    before = host.read(1, *place)
    assert abort_of(host, *place, value) == code
    assert host.read(1, *place) == before


def test_entries_are_fixed_while_their_number_is_not_zero(host):
    host.write(1, 0x1A02, 1, TORQUE)
    host.write(1, 0x1A02, 0, 1)
    assert abort_of(host, 0x1A02, 1, POSITION) == DEVICE_STATE


def test_what_is_mapped_is_sent_in_that_order_under_the_new_identifier(host):
    remap(host, 1, 0x1802, (0x60410010, 0x60610008, 0x603F0010, 0x60770010), can_id=0x1C1)
    host.write(1, 0x6060, 0, 10)
    host.nmt(Nmt.START)
    host.take()
    host.sync()
    assert host.taken(0x1C1) == [struct.pack("<HbHh", 0x0250, 10, 0, 0)]


@pytest.mark.parametrize(("kind", "count"), [(1, 12), (2, 6), (5, 2)])
def test_a_synchronous_pdo_comes_on_every_nth_sync(host, kind, count):
    remap(host, 1, 0x1802, (0x60410010,), can_id=0x1C1, kind=kind)
    host.nmt(Nmt.START)
    host.take()
    host.sync(times=12)
    assert len(host.taken(0x1C1)) == count


def test_type_0_comes_with_the_sync_after_an_event(host):
    remap(host, 1, 0x1802, (0x60410010,), can_id=0x1C1, kind=0)
    host.start()
    host.sync()
    host.take()
    host.sync(times=5)
    assert host.taken(0x1C1) == []
    host.step(Word.SHUTDOWN)
    host.sync()
    assert len(host.taken(0x1C1)) == 1


def test_an_event_driven_pdo_without_a_state_in_it_comes_when_its_content_changes(host):
    remap(host, 1, 0x1802, (0x60740010,), can_id=0x1C1, kind=255)
    host.enable()
    host.step(Word.ENABLE)
    host.take()
    host.step(Word.ENABLE, times=5)
    assert host.taken(0x1C1) == []
    host.step(Word.ENABLE, 100)
    host.step(Word.ENABLE, 100)
    assert host.taken(0x1C1) == [struct.pack("<h", 100)]


def test_a_command_of_type_255_acts_without_waiting_for_sync(host):
    host.write(1, 0x6060, 0, 10)
    remap(host, 1, 0x1400, COMMAND, can_id=0x201, kind=255)
    host.nmt(Nmt.START)
    for word in ENABLING:
        host.put(0x201, struct.pack("<Hh", word, 0))
    host.put(0x201, struct.pack("<Hh", Word.ENABLE, 250))
    assert host.state_bits() == 0x27
    assert host.bench.drives[0].torque_Nm == pytest.approx(3.0)
    host.sync(times=2)
    assert host.state_bits() == 0x27
    host.sync()
    host.sync()
    assert host.read(1, 0x603F) == 0x8250


def test_one_frame_commands_both_drives_by_dummy_entries(host):
    dummies = (entry(0x0006, 16), entry(0x0006, 16))
    remap(host, 1, 0x1400, (*COMMAND, *dummies), can_id=0x210)
    remap(host, 2, 0x1400, (*dummies, *COMMAND), can_id=0x210)
    host.start()
    for word in ENABLING:
        host.put(0x210, struct.pack("<HhHh", word, 100, word, -200))
        host.sync()
    assert [drive.torque_Nm for drive in host.bench.drives] == pytest.approx([1.2, -1.2])


def test_controlword_and_torque_may_come_in_two_pdos(host):
    host.write(1, 0x6060, 0, 10)
    remap(host, 1, 0x1400, (0x60400010,), can_id=0x201, kind=255)
    remap(host, 1, 0x1401, (0x60710010, 0x60B20010), can_id=0x301)
    host.nmt(Nmt.START)
    for word in ENABLING:
        host.put(0x301, struct.pack("<hh", 0, 0))
        host.sync()
        host.put(0x201, struct.pack("<H", word))
    host.put(0x301, struct.pack("<hh", 100, 50))
    host.sync()
    assert host.bench.drives[0].torque_Nm == pytest.approx(1.8)
    for _ in range(3):
        host.put(0x201, struct.pack("<H", Word.ENABLE))  # the word alone is no command
        host.sync()
    assert host.read(1, 0x603F) == 0x8250


def test_a_received_value_that_the_object_can_not_take_changes_nothing(host):
    remap(host, 1, 0x1401, (0x60600008,), can_id=0x301, kind=255)
    host.nmt(Nmt.START)
    host.put(0x301, b"\x0a")
    assert host.read(1, 0x6061) == 10
    host.put(0x301, b"\x08")
    assert host.read(1, 0x6061) == 10


def test_a_reset_of_communication_restores_mapping_and_identifier(host):
    remap(host, 1, 0x1800, (0x60410010,), can_id=0x1C1, kind=2)
    host.nmt(Nmt.RESET_COMMUNICATION)
    host.nmt(Nmt.START)
    host.take()
    host.sync()
    assert [len(data) for data in host.taken(0x181)] == [8]
    assert (host.read(1, 0x1800, 1), host.read(1, 0x1800, 2), host.read(1, 0x1A00, 0)) == (0x181, 1, 2)


def test_a_default_mapping_that_no_master_could_write_is_empty_after_a_reset_and_can_be_replaced(host, monkeypatch):
    mapped = host.bench.devices[0].pdos.dictionary.find(0x1A00, 1)
    monkeypatch.setattr(mapped, "default", COMMAND[0])  # rww: for receiving
    host.nmt(Nmt.RESET_COMMUNICATION)
    host.nmt(Nmt.START)
    host.take()
    host.sync()
    assert host.taken(0x181) == []
    remap(host, 1, 0x1800, (POSITION,), can_id=0x181, kind=1)
    host.sync()
    assert [len(data) for data in host.taken(0x181)] == [4]


def test_the_content_of_a_received_frame_is_checked_with_the_mapped_header_only(host):
    remap(host, 1, 0x1400, (entry(0x2100, 8, 1), entry(0x2100, 8, 2), *COMMAND), can_id=0x201)
    host.start()
    host.step(Word.SHUTDOWN)
    assert host.state_bits() == 0x21
    host.put(0x201, struct.pack("<BBHh", 0, 0, Word.SWITCH_ON, 0))
    host.sync()
    assert host.state_bits() == 0x21
    assert host.bench.drives[0].rejected_commands == 1
