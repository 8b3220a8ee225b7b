"""The emulated drive against the standard: states, commands, torque, watchdogs; seen on the wire and in the arm."""

import struct

import pytest
from bench_host import (
    DISABLE_VOLTAGE,
    ENABLE,
    FAULT_RESET,
    PERIOD_NS,
    PRE_OPERATIONAL,
    QUICK_STOP,
    RESET_COMMUNICATION,
    RESET_NODE,
    SHUTDOWN,
    START,
    STOP,
    SWITCH_ON,
    BenchHost,
    quiet_scenario,
    remap,
    remap_mode,
    set_mode,
)

from firmware_sim.nodes.drive_profile import TRANSITIONS, DriveEvent, DriveState, decode_command, find_transition

S, E = DriveState, DriveEvent
NEGATIVE_RATED_TORQUE = -1000

# Statusword bits 0-3, 5, 6 by state, from the standard's table; x in the table is 0 here.
NOT_READY_BITS, DISABLED_BITS, READY_BITS, SWITCHED_ON_BITS = 0x00, 0x40, 0x21, 0x23
ENABLED_BITS, QUICK_STOP_BITS, REACTION_BITS, FAULT_BITS = 0x27, 0x07, 0x0F, 0x08

# CiA 402-2, written down by hand from its figure and table of transitions, independently of the code:
# state -> {event: (transition number, next state)}. What is absent changes nothing.
STANDARD = {
    S.START: {E.POWER_ON: (0, S.NOT_READY_TO_SWITCH_ON)},
    S.NOT_READY_TO_SWITCH_ON: {
        E.INITIALISED: (1, S.SWITCH_ON_DISABLED),
        E.FAULT_DETECTED: (13, S.FAULT_REACTION_ACTIVE),
    },
    S.SWITCH_ON_DISABLED: {
        E.SHUTDOWN: (2, S.READY_TO_SWITCH_ON),
        E.FAULT_DETECTED: (13, S.FAULT_REACTION_ACTIVE),
    },
    S.READY_TO_SWITCH_ON: {
        E.SWITCH_ON: (3, S.SWITCHED_ON),
        E.ENABLE_OPERATION: (3, S.SWITCHED_ON),
        E.QUICK_STOP: (7, S.SWITCH_ON_DISABLED),
        E.DISABLE_VOLTAGE: (7, S.SWITCH_ON_DISABLED),
        E.FAULT_DETECTED: (13, S.FAULT_REACTION_ACTIVE),
    },
    S.SWITCHED_ON: {
        E.ENABLE_OPERATION: (4, S.OPERATION_ENABLED),
        E.SHUTDOWN: (6, S.READY_TO_SWITCH_ON),
        E.QUICK_STOP: (10, S.SWITCH_ON_DISABLED),
        E.DISABLE_VOLTAGE: (10, S.SWITCH_ON_DISABLED),
        E.FAULT_DETECTED: (13, S.FAULT_REACTION_ACTIVE),
    },
    S.OPERATION_ENABLED: {
        E.SWITCH_ON: (5, S.SWITCHED_ON),
        E.SHUTDOWN: (8, S.READY_TO_SWITCH_ON),
        E.DISABLE_VOLTAGE: (9, S.SWITCH_ON_DISABLED),
        E.QUICK_STOP: (11, S.QUICK_STOP_ACTIVE),
        E.FAULT_DETECTED: (13, S.FAULT_REACTION_ACTIVE),
    },
    S.QUICK_STOP_ACTIVE: {
        E.QUICK_STOP_DONE: (12, S.SWITCH_ON_DISABLED),
        E.DISABLE_VOLTAGE: (12, S.SWITCH_ON_DISABLED),
        E.ENABLE_OPERATION: (16, S.OPERATION_ENABLED),
        E.FAULT_DETECTED: (13, S.FAULT_REACTION_ACTIVE),
    },
    S.FAULT_REACTION_ACTIVE: {E.FAULT_REACTION_DONE: (14, S.FAULT)},
    S.FAULT: {E.FAULT_RESET: (15, S.SWITCH_ON_DISABLED)},
}


@pytest.mark.parametrize("state", list(DriveState))
@pytest.mark.parametrize("event", list(DriveEvent))
def test_every_event_in_every_state_does_what_the_standard_says(state, event):
    transition = find_transition(state, event)
    done = None if transition is None else (transition.number, transition.target)
    assert done == STANDARD[state].get(event)


def test_the_table_has_every_number_of_the_standard():
    assert {row.number for row in TRANSITIONS} == set(range(17))


@pytest.mark.parametrize(
    ("controlword", "previous", "event"),
    [
        (0x0006, 0x0000, E.SHUTDOWN),
        (0x000E, 0x0000, E.SHUTDOWN),
        (0x0007, 0x0006, E.SWITCH_ON),
        (0x000F, 0x0007, E.ENABLE_OPERATION),
        (0x010F, 0x0007, E.ENABLE_OPERATION),  # halt has no meaning in mode 10
        (0x0000, 0x000F, E.DISABLE_VOLTAGE),
        (0x000D, 0x000F, E.DISABLE_VOLTAGE),
        (0x0002, 0x000F, E.QUICK_STOP),
        (0x000B, 0x000F, E.QUICK_STOP),
        (0x0080, 0x0000, E.FAULT_RESET),
        (0x008F, 0x000F, E.FAULT_RESET),
        (0x0080, 0x0080, None),
        (0x0086, 0x0080, None),
        (0x008F, 0x0080, None),
    ],
)
def test_controlwords_are_decoded_by_the_standards_bit_patterns(controlword, previous, event):
    assert decode_command(controlword, previous) is event


def emergency(code: int, watchdog: int, time_ms: int) -> bytes:
    """Make the EMCY of a watchdog that has tripped."""
    return struct.pack("<HBBI", code, 0x11, watchdog, time_ms)


@pytest.fixture
def host() -> BenchHost:
    return BenchHost()


def pushed_host(objects: dict[tuple[int, int], int] | None = None) -> BenchHost:
    """An enabled arm that moves fast enough to need more than one period to brake. objects: value by node and index."""
    host = BenchHost()
    for (node, index), value in (objects or {}).items():
        host.write(node, index, 0, value)
    host.enable()
    for _ in range(30):
        host.step(ENABLE, 300)
    return host


def in_state(bits: int) -> BenchHost:
    """Bring both drives to a state that the bus can reach."""
    if bits in (QUICK_STOP_BITS, REACTION_BITS):
        host = pushed_host()
        if bits == QUICK_STOP_BITS:
            host.step(QUICK_STOP)
        else:
            for _ in range(3):
                host.sync()
        return host
    host = BenchHost()
    host.start()
    if bits == FAULT_BITS:
        host = BenchHost()
        host.enable()
        for _ in range(20):
            host.sync()
        return host
    words = {
        DISABLED_BITS: (),
        READY_BITS: (SHUTDOWN,),
        SWITCHED_ON_BITS: (SHUTDOWN, SWITCH_ON),
        ENABLED_BITS: (SHUTDOWN, SWITCH_ON, ENABLE),
    }
    for word in words[bits]:
        host.step(word)
    return host


COMMANDS = (SHUTDOWN, SWITCH_ON, ENABLE, DISABLE_VOLTAGE, QUICK_STOP, FAULT_RESET)
# Rows: state. Columns: statusword bits one SYNC after each of COMMANDS.
WIRE_TABLE = {
    DISABLED_BITS: (READY_BITS, DISABLED_BITS, DISABLED_BITS, DISABLED_BITS, DISABLED_BITS, DISABLED_BITS),
    READY_BITS: (READY_BITS, SWITCHED_ON_BITS, SWITCHED_ON_BITS, DISABLED_BITS, DISABLED_BITS, READY_BITS),
    SWITCHED_ON_BITS: (
        READY_BITS,
        SWITCHED_ON_BITS,
        ENABLED_BITS,
        DISABLED_BITS,
        DISABLED_BITS,
        SWITCHED_ON_BITS,
    ),
    ENABLED_BITS: (READY_BITS, SWITCHED_ON_BITS, ENABLED_BITS, DISABLED_BITS, QUICK_STOP_BITS, ENABLED_BITS),
    QUICK_STOP_BITS: (
        QUICK_STOP_BITS,
        QUICK_STOP_BITS,
        QUICK_STOP_BITS,  # 0x605A = 2: no way back
        DISABLED_BITS,
        QUICK_STOP_BITS,
        QUICK_STOP_BITS,
    ),
    REACTION_BITS: (REACTION_BITS,) * 6,
    FAULT_BITS: (FAULT_BITS, FAULT_BITS, FAULT_BITS, FAULT_BITS, FAULT_BITS, DISABLED_BITS),
}


@pytest.mark.parametrize("before", WIRE_TABLE)
@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_in_every_state_shows_in_the_statusword_one_sync_later(before, command):
    host = in_state(before)
    assert host.state_bits() == before
    host.step(command)
    assert (host.state_bits(1), host.state_bits(2)) == (WIRE_TABLE[before][COMMANDS.index(command)],) * 2


@pytest.mark.parametrize("before", WIRE_TABLE)
def test_the_statusword_says_voltage_and_remote_and_never_target_reached(before):
    assert in_state(before).statusword() & 0x0610 == 0x0210


@pytest.mark.parametrize("before", [DISABLED_BITS, READY_BITS, SWITCHED_ON_BITS, FAULT_BITS])
def test_below_operation_enabled_the_motor_has_no_torque_whatever_the_target(before):
    host = in_state(before)
    keep = {DISABLED_BITS: 0, READY_BITS: SHUTDOWN, SWITCHED_ON_BITS: SWITCH_ON, FAULT_BITS: ENABLE}[before]
    for _ in range(20):
        host.step(keep, 1000)
        assert host.state_bits() == before
        assert host.true("tau_J").tolist() == [0.0, 0.0]
        assert host.bench.drives[0].torque_Nm == 0.0
    host.bench.advance_to(host.bench.now_ns + 100_000_000)
    status = host.taken(0x281)[-1]
    assert struct.unpack("<HbhH", status)[2] == 0


def test_operation_enabled_without_mode_10_has_no_torque():
    host = BenchHost()
    host.enable(mode=0)
    assert host.state_bits() == ENABLED_BITS
    for _ in range(20):
        host.step(ENABLE, 1000)
        assert host.true("tau_J").tolist() == [0.0, 0.0]


def test_leaving_mode_10_while_enabled_ends_the_torque(host):
    remap_mode(host)
    host.enable()
    for _ in range(10):
        host.step(ENABLE, 500)
    assert host.true("tau_J")[0] > 5.0
    set_mode(host, 0)
    for _ in range(10):
        host.step(ENABLE, 500)
    assert abs(host.true("tau_J")[0]) < 1e-9
    assert host.true("tau_J")[1] > 2.5


def test_target_torque_is_per_mille_of_rated_torque_in_the_motors_direction(host):
    host.enable()
    for _ in range(10):
        host.step(ENABLE, -250)
    assert host.true("tau_J").tolist() == pytest.approx([-3.0, -1.5], abs=1e-9)
    assert host.true("dq")[1] < 0.0
    assert host.read(1, 0x6077) == -250


def test_a_command_acts_at_the_next_sync_and_not_before(host):
    host.enable()
    host.step(ENABLE, 0)
    host.sync()
    host.command(ENABLE, 100)
    assert host.bench.drives[0].torque_Nm == 0.0
    host.sync()  # latched here: from this SYNC to the next the torque builds up
    assert host.true("tau_J")[0] == 0.0
    host.sync()
    assert host.true("tau_J")[0] == pytest.approx(1.2, rel=0.01)


def test_of_two_commands_before_one_sync_the_last_acts(host):
    host.enable()
    host.command(ENABLE, 100)
    host.command(ENABLE, 200)
    host.sync()
    assert host.bench.drives[0].torque_Nm == pytest.approx(2.4)


def test_max_torque_limits_both_ways_and_shows_as_internal_limit(host):
    host.write(1, 0x6072, 0, 300)
    host.enable()
    host.step(ENABLE, 300)
    assert host.bench.drives[0].torque_Nm == pytest.approx(3.6)
    assert host.statusword() & 0x0800 == 0
    host.step(ENABLE, 301)
    assert host.bench.drives[0].torque_Nm == pytest.approx(3.6)
    assert host.statusword() & 0x0800 == 0x0800
    host.step(ENABLE, NEGATIVE_RATED_TORQUE)
    assert host.bench.drives[0].torque_Nm == pytest.approx(-3.6)


@pytest.mark.parametrize("bit", range(48))
def test_a_command_with_any_one_bit_flipped_changes_nothing(host, bit):
    host.enable()
    host.step(ENABLE, 100)
    frame = bytearray(host.command_frame(1, ENABLE, 200))
    frame[bit // 8] ^= 1 << bit % 8
    host.put(0x201, frame)
    host.sync()
    assert host.bench.drives[0].torque_Nm == pytest.approx(1.2)
    assert host.state_bits() == ENABLED_BITS
    assert host.bench.drives[0].rejected_commands == 1


def test_a_repeated_command_counts_as_none(host):
    host.enable()
    frame = host.command_frame(1, ENABLE, 100)
    for _ in range(4):
        host.put(0x201, frame)
        host.command(ENABLE, 0, joints=(2,))
        host.sync()
    assert host.state_bits(1) == REACTION_BITS
    assert host.state_bits(2) == ENABLED_BITS


def test_a_command_of_the_wrong_length_is_reported_once_and_changes_nothing(host):
    host.enable()
    host.take()
    for _ in range(2):
        host.put(0x201, host.command_frame(1, ENABLE, 500)[:5])
    host.sync()
    assert host.taken(0x081) == [emergency(0x8210, 5, 2)]
    assert host.bench.drives[0].torque_Nm == 0.0
    host.step(ENABLE)
    assert host.taken(0x081) == [struct.pack("<HBBI", 0, 0, 5, 3)]
    assert host.read(1, 0x1001) == 0


def test_commands_count_in_operational_only(host):
    host.write(1, 0x6060, 0, 10)
    for _ in range(3):
        host.step(SHUTDOWN)
    assert host.state_bits() == DISABLED_BITS


def test_two_syncs_without_command_are_forgiven_and_hold_the_torque_and_the_third_faults(host):
    host.enable()
    host.step(ENABLE, 10)
    host.sync()
    host.sync()
    assert host.state_bits() == ENABLED_BITS
    assert host.bench.drives[0].torque_Nm == pytest.approx(0.12)
    host.take()
    host.sync()
    assert host.state_bits() == REACTION_BITS
    frames = host.take()
    assert (0x081, emergency(0x8250, 2, 6)) in frames
    assert host.read(1, 0x603F) == 0x8250
    status = next(data for can_id, data in frames if can_id == 0x281)
    assert struct.unpack("<HbhH", status)[3] == 0x8250


def test_a_fault_stays_latched_until_the_rising_edge_of_fault_reset():
    host = in_state(FAULT_BITS)
    for controlword in (ENABLE, SHUTDOWN, DISABLE_VOLTAGE, SWITCH_ON):
        host.step(controlword)
        assert host.state_bits() == FAULT_BITS
    host.take()
    host.step(FAULT_RESET)
    assert host.state_bits() == DISABLED_BITS
    assert host.taken(0x081) == [bytes(8)]
    assert (host.read(1, 0x603F), host.read(1, 0x1001)) == (0, 0)


def test_bit_7_that_was_set_already_when_the_fault_came_resets_nothing(host):
    host.enable()
    host.step(FAULT_RESET | ENABLE)
    for _ in range(20):
        host.sync()
    assert host.state_bits() == FAULT_BITS
    host.step(FAULT_RESET | ENABLE)
    assert host.state_bits() == FAULT_BITS
    host.step(ENABLE)
    host.step(FAULT_RESET)
    assert host.state_bits() == DISABLED_BITS


def test_fault_reset_is_refused_while_commands_are_still_missing():
    host = BenchHost()
    remap(host, 1, 0x1400, (0x60400010,), can_id=0x201, kind=255)
    remap(host, 1, 0x1401, (0x60710010,), can_id=0x301)
    host.start()
    for word in (SHUTDOWN, SWITCH_ON, ENABLE):
        host.put(0x301, bytes(2))
        host.sync()
        host.put(0x201, bytes([word, 0]))
    for _ in range(20):
        host.sync()
    assert host.state_bits() == FAULT_BITS
    host.put(0x201, bytes([FAULT_RESET, 0]))  # the word alone is no command
    host.sync()
    assert host.state_bits() == FAULT_BITS
    host.put(0x201, bytes(2))
    host.put(0x301, bytes(2))
    host.sync()
    host.put(0x201, bytes([FAULT_RESET, 0]))
    assert host.state_bits() == DISABLED_BITS


def test_fault_reset_during_the_fault_reaction_does_not_shorten_it():
    host = in_state(REACTION_BITS)
    host.step(FAULT_RESET)
    assert host.state_bits() == REACTION_BITS
    host.wait_until_at_rest()
    assert host.state_bits() == FAULT_BITS


def test_a_fault_brakes_the_moving_arm_to_rest_and_then_lets_it_go():
    host = pushed_host()
    speed_before = abs(host.true("dq")[0])
    assert speed_before > 0.05
    for _ in range(3):
        host.sync()
    host.sync()
    assert host.state_bits() == REACTION_BITS
    assert (host.true("tau_J") * host.true("dq")).max() < 0.0
    for _ in range(300):
        host.sync()
    assert host.state_bits() == FAULT_BITS
    assert abs(host.true("dq")).max() < 0.02
    assert host.bench.drives[0].motor_mode == 0


def test_fault_reaction_option_0_lets_the_arm_coast_at_once():
    host = pushed_host({(1, 0x605E): 0})
    for _ in range(3):
        host.sync()
    assert host.state_bits(1) == FAULT_BITS
    assert host.state_bits(2) == REACTION_BITS


def test_a_fault_reaction_ends_even_when_someone_keeps_pushing():
    contact = {"at_s": 0.05, "link": 1, "point_m": 0.3, "force_N": 40.0, "duration_s": 5.0}
    host = BenchHost(quiet_scenario(contacts=[contact]))
    host.enable()
    for _ in range(100):
        host.step(ENABLE)
    for _ in range(3):
        host.sync()
    host.wait_until_at_rest()
    assert abs(host.true("dq")[0]) > 0.05
    assert host.state_bits(1) == FAULT_BITS


def test_quick_stop_brakes_until_standstill_and_then_disables():
    host = pushed_host()
    host.step(QUICK_STOP)
    host.step(QUICK_STOP)
    assert host.state_bits() == QUICK_STOP_BITS
    assert (host.true("tau_J") * host.true("dq")).max() < 0.0
    host.wait_until_at_rest(QUICK_STOP)
    assert host.state_bits() == DISABLED_BITS
    assert abs(host.true("dq")).max() < 0.02


def test_quick_stop_option_6_stays_and_lets_operation_resume():
    host = pushed_host({(1, 0x605A): 6, (2, 0x605A): 6})
    host.wait_until_at_rest(QUICK_STOP)
    assert host.state_bits() == QUICK_STOP_BITS
    host.step(ENABLE)
    assert host.state_bits() == ENABLED_BITS


@pytest.mark.parametrize("command", [STOP, PRE_OPERATIONAL, RESET_COMMUNICATION])
def test_leaving_operational_while_enabled_is_a_fault(command):
    host = pushed_host()
    host.take()
    host.nmt(command)
    assert host.bench.drives[0].state is DriveState.FAULT_REACTION_ACTIVE
    assert host.bench.drives[0].torque_Nm == 0.0
    assert host.taken(0x081)[0][:2] == b"\x00\x81"
    host.nmt(START)
    host.wait_until_at_rest()
    assert host.state_bits() == FAULT_BITS
    host.step(FAULT_RESET)
    assert host.state_bits() == DISABLED_BITS


def test_leaving_operational_while_disabled_is_no_fault(host):
    host.enable()
    host.step(DISABLE_VOLTAGE)
    host.nmt(STOP)
    host.nmt(START)
    assert host.state_bits() == DISABLED_BITS
    assert host.read(1, 0x603F) == 0


def test_a_node_reset_starts_the_state_machine_over():
    host = in_state(FAULT_BITS)
    host.nmt(RESET_NODE)
    assert host.state_bits() == DISABLED_BITS
    assert host.read(1, 0x603F) == 0


def test_the_masters_heartbeat_lost_while_enabled_is_a_fault_until_it_is_back(host):
    for joint in (1, 2):
        host.write(joint, 0x1016, 1, (127 << 16) | 50)
    host.enable()
    host.put(0x77F, b"\x05")
    for _ in range(49):
        host.step(ENABLE)
    assert host.state_bits() == ENABLED_BITS
    for _ in range(2):
        host.step(ENABLE)
    assert host.read(1, 0x603F) == 0x8130
    host.nmt(START)
    host.wait_until_at_rest()
    host.step(FAULT_RESET)
    assert host.state_bits() == FAULT_BITS
    host.put(0x77F, b"\x05")
    host.step(ENABLE)
    host.step(FAULT_RESET)
    assert host.state_bits() == DISABLED_BITS


def test_the_rpdo_deadline_faults_by_time(host):
    host.write(1, 0x1400, 5, 5)
    host.enable()
    host.bench.advance_to(host.bench.now_ns + 4_999_999)
    assert host.state_bits() == ENABLED_BITS
    host.bench.advance_to(host.bench.now_ns + 1)
    assert host.state_bits(1) == REACTION_BITS
    assert host.state_bits(2) == ENABLED_BITS
    assert host.read(1, 0x603F) == 0x8250


def wall_host() -> BenchHost:
    host = BenchHost(clock_mode="wall")
    host.enable()
    return host


def test_by_wall_clock_one_and_a_half_periods_without_sync_fault_and_brake():
    host = wall_host()
    host.take()
    host.bench.advance_to(host.t_ns + PERIOD_NS * 3 // 2 - 1)
    assert host.state_bits() == ENABLED_BITS
    host.bench.advance_to(host.t_ns + PERIOD_NS * 3 // 2)
    assert host.state_bits() == REACTION_BITS
    assert host.taken(0x081)[0] == emergency(0x8700, 1, 4)
    host.t_ns += 1_000_000_000
    host.bench.advance_to(host.t_ns)
    assert host.state_bits() == FAULT_BITS
    assert host.read(1, 0x603F) == 0x8700


def test_by_wall_clock_the_fault_can_be_reset_once_sync_is_back():
    host = wall_host()
    host.t_ns += 1_000_000_000
    host.bench.advance_to(host.t_ns)
    host.command(FAULT_RESET)
    assert host.state_bits() == FAULT_BITS
    host.step(ENABLE)
    host.step(FAULT_RESET)
    assert host.state_bits() == DISABLED_BITS


def test_by_sync_the_drives_wait_for_sync_as_long_as_it_takes(host):
    host.enable()
    host.bench.advance_to(600_000_000_000)
    assert host.state_bits() == ENABLED_BITS


def test_feedback_comes_on_every_sync_in_operational_only(host):
    host.sync()
    assert host.taken(0x181) == []
    host.nmt(START)
    host.take()
    for _ in range(3):
        host.sync()
    assert len(host.taken(0x181)) == 3
    host.nmt(STOP)
    host.take()
    host.sync()
    assert host.taken(0x181) == []


def test_feedback_carries_encoder_counts_and_velocity_as_served_by_sdo():
    host = BenchHost(quiet_scenario(start_deg=[-30.0, -60.0]))
    host.enable()
    for _ in range(20):
        host.step(ENABLE, 300)
    host.take()
    host.sync()
    position, velocity = struct.unpack("<ii", host.taken(0x182)[0])
    assert position == pytest.approx(host.true("q")[1] * (1 << 20) / 6.283185307179586, abs=1.0)
    assert velocity == pytest.approx(host.true("dq")[1] / 5e-4, rel=0.2)
    assert (host.read(2, 0x6064), host.read(2, 0x606C)) == (position, velocity)


def test_status_comes_on_entering_operational_on_change_and_every_100_ms(host):
    host.nmt(START)
    assert len(host.taken(0x281)) == 1
    for _ in range(99):
        host.sync()
    assert host.taken(0x281) == []
    for _ in range(2):
        host.sync()
    assert len(host.taken(0x281)) == 1
    host.step(SHUTDOWN)
    assert [struct.unpack_from("<H", data)[0] & 0x6F for data in host.taken(0x281)] == [READY_BITS]
    host.write(1, 0x6060, 0, 10)
    assert [data[2] for data in host.taken(0x281)] == [10]


def test_status_keeps_its_inhibit_time(host):
    host.write(1, 0x1801, 1, 0x80000281)
    host.write(1, 0x1801, 3, 100)
    host.write(1, 0x1801, 1, 0x281)
    host.nmt(START)
    host.take()
    for controlword in (SHUTDOWN, SWITCH_ON, SHUTDOWN, SWITCH_ON):
        host.step(controlword)
    assert host.taken(0x281) == []
    for _ in range(10):
        host.step(SWITCH_ON)
    assert [data[0] & 0x6F for data in host.taken(0x281)] == [SWITCHED_ON_BITS]
