"""What SDO may not write while a drive is powered or a sensor measures, and what it may make of a commanded drive."""

import struct

import pytest
from bench_host import ENABLING, INVALID, BenchHost, Nmt, State, Word, in_state, remap
from test_object_dictionary import default_of, eds_rows

DEVICE_STATE = 0x08000022
CLEAR_HISTORY, CONTROLWORD = (0x1003, 0), (0x6040, 0)
ZERO = int.from_bytes(b"zero", "little")


def writable(node: int) -> list[tuple[int, int, int]]:
    """List index, sub-index and default of what the EDS lets be written, but the controlword."""
    return [
        (index, sub, ZERO if index == 0x6125 else int(default_of(default, node)))
        for index, sub, access, default in eds_rows(node)
        if access in ("rw", "rww", "wo") and (index, sub) != CONTROLWORD
    ]


def refusals(host: BenchHost, node: int) -> dict[tuple[int, int], int]:
    """Write every writable object of a node with its default; give the abort codes, 0 for none."""
    codes = {}
    for index, sub, value in writable(node):
        try:
            host.write(node, index, sub, value)
        except Exception as error:
            codes[index, sub] = error.code
        else:
            codes[index, sub] = 0
    return codes


@pytest.mark.parametrize("bits", [State.ENABLED, State.STOPPING])
def test_a_powered_drive_refuses_everything_but_to_forget_its_errors(bits):
    codes = refusals(in_state(bits), 1)
    assert len(codes) > 60
    assert {key for key, code in codes.items() if code != DEVICE_STATE} == {CLEAR_HISTORY}


@pytest.mark.parametrize("bits", [State.SWITCHED_ON, State.FAULT])
def test_a_drive_without_power_refuses_nothing_for_being_at_work(bits):
    assert set(refusals(in_state(bits), 1).values()) == {0}


def test_a_download_in_segments_is_refused_as_well():
    host = in_state(State.ENABLED)
    host.take()
    host.put(0x601, struct.pack("<BHBI", 0x21, 0x6072, 0, 2))
    host.put(0x601, bytes([0x0B, 0xD0, 0x07, 0, 0, 0, 0, 0]))
    assert host.taken(0x581)[-1] == struct.pack("<BHBI", 0x80, 0x6072, 0, DEVICE_STATE)
    assert host.read(1, 0x6072) == 1000


def test_a_limit_that_an_rpdo_brings_is_obeyed_in_operation():
    host = BenchHost()
    remap(host, 1, 0x1401, (0x60720010,), can_id=0x301, kind=255)
    host.enable()
    host.put(0x301, struct.pack("<H", 200))
    host.step(Word.ENABLE, 500)
    assert host.bench.drives[0].torque_Nm == pytest.approx(2.4)


@pytest.mark.parametrize("command", [Nmt.PRE_OPERATIONAL, Nmt.RESET_COMMUNICATION])
def test_a_drive_that_was_taken_out_of_operation_by_nmt_can_be_set_up_at_once(command):
    host = in_state(State.ENABLED)
    host.nmt(command)
    assert set(refusals(host, 1).values()) == {0}


@pytest.mark.parametrize("node", [3])
def test_a_sensor_that_measures_refuses_everything_but_to_forget_its_errors(node):
    host = BenchHost()
    host.nmt(Nmt.START)
    codes = refusals(host, node)
    assert (0x6125, 1) in codes
    assert {key for key, code in codes.items() if code != DEVICE_STATE} == {CLEAR_HISTORY}
    host.nmt(Nmt.PRE_OPERATIONAL, node)
    assert set(refusals(host, node).values()) == {0}


WORDS = (
    Word.SHUTDOWN,
    Word.SWITCH_ON,
    Word.ENABLE,
    Word.ENABLE | 0x100,
    Word.FAULT_RESET,
    Word.FAULT_RESET | Word.ENABLE,
)


@pytest.mark.parametrize(
    ("bits", "disabled", "stopped"),
    [
        (State.READY, State.DISABLED, State.DISABLED),
        (State.ENABLED, State.DISABLED, State.STOPPING),
        (State.STOPPING, State.DISABLED, State.STOPPING),
        (State.FAULT, State.FAULT, State.FAULT),
    ],
)
def test_while_an_rpdo_commands_sdo_only_takes_power_away(bits, disabled, stopped):
    host = in_state(bits)
    for word in WORDS:
        assert host.abort_code(lambda word=word: host.write(1, 0x6040, 0, word)) == DEVICE_STATE
    assert host.state_bits() == bits
    host.write(1, 0x6040, 0, Word.QUICK_STOP)
    assert host.state_bits() == stopped
    host.write(1, 0x6040, 0, Word.DISABLE_VOLTAGE)
    assert host.state_bits() == disabled


@pytest.mark.parametrize("word", [Word.DISABLE_VOLTAGE, Word.QUICK_STOP])
def test_what_sdo_took_away_the_rpdos_next_word_does_not_bring_back(word):
    host = BenchHost()
    host.enable()
    host.step(Word.ENABLE, 100)
    host.write(1, 0x6040, 0, word)
    host.step(Word.ENABLE, 100, times=300)
    assert host.state_bits(1) == State.DISABLED
    assert host.bench.drives[0].torque_Nm == 0.0
    assert host.state_bits(2) == State.ENABLED


def test_without_an_rpdo_that_brings_it_the_controlword_goes_by_sdo():
    host = BenchHost()
    remap(host, 1, 0x1400, (0x60710010,), can_id=0x201)
    host.start()
    for word in ENABLING:
        host.put(0x201, struct.pack("<h", 100))
        host.sync()
        host.write(1, 0x6040, 0, word)
    assert host.state_bits() == State.ENABLED
    host.write(1, 0x6040, 0, Word.SHUTDOWN)
    assert host.state_bits() == State.READY


def without_command_pdo(is_operational: bool = True) -> BenchHost:
    """A drive in Switched on that no PDO commands."""
    host = BenchHost()
    host.write(1, 0x1400, 1, INVALID | 0x201)
    host.write(1, 0x6060, 0, 10)
    if is_operational:
        host.nmt(Nmt.START)
    for word in (Word.SHUTDOWN, Word.SWITCH_ON):
        host.write(1, 0x6040, 0, word)
    host.take()
    return host


WARNING = 0x80


@pytest.mark.parametrize(("is_operational", "reason"), [(True, 2), (False, 1)])
def test_a_drive_that_nobody_can_command_says_why_it_stays_in_switched_on(is_operational, reason):
    host = without_command_pdo(is_operational)
    assert host.read(1, 0x2212) == reason
    assert host.statusword() & WARNING == 0
    host.write(1, 0x6040, 0, Word.ENABLE)
    assert host.state_bits() == State.SWITCHED_ON
    assert host.statusword() & WARNING == WARNING
    host.write(1, 0x6040, 0, Word.ENABLE)
    sent = host.take()
    (emergency,) = [data for can_id, data in sent if can_id == 0x081]
    assert struct.unpack_from("<HBB", emergency) == (0x6320, 0x11, 8)
    statuses = [data[0] & WARNING for can_id, data in sent if can_id == 0x281]
    assert statuses == ([WARNING] if is_operational else [])
    assert (host.read(1, 0x2210, 1), host.read(1, 0x2210, 10)) == (8, 1)


@pytest.mark.parametrize("word", [Word.DISABLE_VOLTAGE, Word.SWITCH_ON])
def test_the_warning_ends_when_operation_is_no_longer_asked_for_or_enabled_by_a_command_pdo(word):
    host = without_command_pdo()
    host.write(1, 0x6040, 0, Word.ENABLE)
    host.take()
    host.write(1, 0x6040, 0, word)
    assert struct.unpack_from("<HBB", host.taken(0x081)[0]) == (0, 0, 8)
    assert host.statusword() & WARNING == 0
    for again in ENABLING:
        host.write(1, 0x6040, 0, again)
    assert host.statusword() & WARNING == WARNING
    host.write(1, 0x1400, 1, 0x201)
    host.step(Word.ENABLE)
    assert host.state_bits() == State.ENABLED
    assert (host.statusword() & WARNING, host.read(1, 0x2212), host.read(1, 0x1001)) == (0, 0, 0)


def test_a_fault_of_another_kind_can_be_reset_beside_the_warning():
    host = without_command_pdo()
    host.write(1, 0x6040, 0, Word.ENABLE)
    host.bench.drives[0].fail(0x2310, host.bench.now_ns)
    host.bench.drives[0].mend()
    host.wait_until_at_rest(None)
    assert host.state_bits() == State.FAULT
    host.write(1, 0x6040, 0, Word.FAULT_RESET)
    assert host.state_bits() == State.DISABLED
