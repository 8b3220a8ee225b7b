"""What a device does when it loses power or the bus, fails by itself, or has a clock that drifts."""

import pytest
from bench_host import PERIOD_NS, BenchHost, Nmt, State, Word, moving_host

from adacd_hil.wire.time_marks import NEVER_NS
from firmware_sim.arm.sensing import DriveMode
from firmware_sim.nodes.device import NmtState, NodeClock

MS = 1_000_000
ERROR = 0x2310


def enabled_host(objects: dict[tuple[int, int, int], int] | None = None) -> BenchHost:
    """An arm in motion. objects: value by node, index and sub-index."""
    return moving_host(100, 5, objects={(node, 0x1017, 0): 10 for node in (1, 2, 3, 4)} | (objects or {}))


def poll(host: BenchHost) -> None:
    """Let the bench look again after something was done to a device."""
    host.bench.time.poll(host.bench.now_ns)


def pass_ms(host: BenchHost, count: int) -> None:
    for _ in range(count):
        host.t_ns += MS
        host.bench.advance_to(host.t_ns)


def errors(host: BenchHost, node: int) -> list[int]:
    return [code for code, *_ in host.emergencies(node)]


@pytest.mark.parametrize(
    ("loss", "state", "heartbeat_ms"),
    [("power_off", NmtState.INITIALISING, 0), ("leave_bus", NmtState.PRE_OPERATIONAL, 10)],
)
@pytest.mark.parametrize("node", [1, 3])
def test_a_device_without_power_or_bus_says_and_hears_nothing(node, loss, state, heartbeat_ms):
    host = enabled_host()
    device = host.bench.devices[node - 1]
    getattr(device, loss)(host.bench.now_ns)
    poll(host)
    host.put(0x600 + node, bytes([0x40, 0x00, 0x10, 0, 0, 0, 0, 0]))
    host.nmt(Nmt.START, node)
    host.put(0x600 + node, bytes([0x2B, 0x17, 0x10, 0, 77, 0, 0, 0]))
    if loss == "leave_bus":
        device.send_emergency(0x1000, host.bench.now_ns)
    pass_ms(host, 50)
    assert [can_id for can_id, _ in host.take() if can_id & 0x7F == node] == []
    assert (device.state, device.value(0x1017)) == (state, heartbeat_ms)


def test_a_drive_without_power_has_no_torque_and_does_not_brake():
    host = enabled_host()
    assert host.bench.drives[0].torque_Nm != 0.0
    host.bench.devices[0].power_off(host.bench.now_ns)
    drive = host.bench.drives[0]
    assert (drive.torque_Nm, drive.motor_mode) == (0.0, DriveMode.OFF)
    host.bench.devices[0].power_on(host.bench.now_ns)
    assert (host.state_bits(1), host.state_bits(2)) == (State.DISABLED, State.ENABLED)


@pytest.mark.parametrize("node", [1, 3])
def test_power_brings_a_device_back_as_it_was_delivered(node):
    host = enabled_host({(node, 0x1016, 1): 127 << 16 | 50})
    device = host.bench.devices[node - 1]
    device.power_off(host.bench.now_ns)
    device.power_on(host.bench.now_ns)
    poll(host)
    assert host.taken(0x700 + node) == [b"\0"]
    assert device.state is NmtState.PRE_OPERATIONAL
    assert [host.read(node, 0x1017), host.read(node, 0x1016, 1), host.read(node, 0x1003)] == [0, 0, 0]
    host.nmt(Nmt.START, node)
    host.take()
    host.sync()
    assert len(host.taken(0x180 + node)) == 1


def test_emergencies_that_waited_the_history_and_the_time_are_gone_with_the_power():
    host = enabled_host({(1, 0x1015, 0): 1000})
    pass_ms(host, 500)
    host.nmt(Nmt.START, 1)
    host.take()
    host.put(0x201, b"\0")  # wrong length, right length: two messages, of which the second must wait
    host.command(Word.ENABLE)
    assert errors(host, 1)[-1] == 0x8210
    host.bench.devices[0].power_off(host.bench.now_ns)
    host.bench.devices[0].power_on(host.bench.now_ns)
    assert host.read(1, 0x1003) == 0
    poll(host)
    pass_ms(host, 30)
    assert errors(host, 1) == []
    host.nmt(Nmt.START, 1)
    host.put(0x201, b"\0")
    assert [time_ms for *_, time_ms in host.emergencies()] == [30]


def test_a_powered_drive_off_the_bus_faults_and_brakes():
    host = enabled_host()
    host.bench.devices[0].leave_bus(host.bench.now_ns)
    drive = host.bench.drives[0]
    assert drive.state.value == "fault reaction active"
    assert drive.error_code == 0x8100
    assert drive.torque_Nm == 0.0


@pytest.mark.parametrize("node", [1, 3])
def test_a_device_that_returns_to_the_bus_says_so_and_stays_pre_operational(node):
    host = enabled_host()
    device = host.bench.devices[node - 1]
    device.leave_bus(host.bench.now_ns)
    pass_ms(host, 50)
    host.take()
    device.return_to_bus(host.bench.now_ns)
    assert errors(host, node) == [0x8140]
    poll(host)
    pass_ms(host, 20)
    assert set(host.taken(0x700 + node)) == {b"\x7f"}
    assert host.read(node, 0x1000) & 0xFFFF == (402 if node == 1 else 404)


def test_a_device_off_the_bus_does_not_hear_the_masters_heartbeat():
    host = BenchHost()
    host.write(3, 0x1016, 1, 127 << 16 | 50)
    host.nmt(Nmt.START)
    host.put(0x77F, b"\x05")
    device = host.bench.devices[2]
    device.leave_bus(host.bench.now_ns)
    for _ in range(55):
        host.put(0x77F, b"\x05")
        pass_ms(host, 1)
    assert [int(watchdog) for watchdog in device.tripped] == [3]


def test_a_drive_says_by_its_own_clock_when_it_lost_its_commands_with_sync():
    host = enabled_host({(1, 0x2200, 0): 10})
    start_ns = host.bench.now_ns
    host.bench.devices[0].clock.set_drift(500_000.0, start_ns)
    host.cycle += 20
    host.sync()
    code, _, _, time_ms = host.emergencies()[0]
    assert (code, time_ms) == (0x8250, (start_ns + 1.5 * 10 * PERIOD_NS) // MS)


def test_a_drive_that_fails_says_so_by_its_first_code_and_is_not_reset_until_the_failure_is_mended():
    host = enabled_host()
    drive = host.bench.drives[0]
    drive.fail(ERROR, host.bench.now_ns)
    assert (host.state_bits(1), drive.torque_Nm) == (State.REACTION, 0.0)
    assert host.emergencies()[0][:3] == (ERROR, 0x03, 0)
    assert host.read(1, 0x1003, 1) == ERROR
    host.wait_until_at_rest()
    drive.fail(0x4310, host.bench.now_ns)
    assert host.read(1, 0x603F) == ERROR
    host.step(0)
    host.step(Word.FAULT_RESET)
    assert host.state_bits(1) == State.FAULT
    drive.mend()
    host.step(0)
    assert host.state_bits(1) == State.FAULT
    host.step(Word.FAULT_RESET)
    assert host.state_bits(1) == State.DISABLED
    assert host.read(1, 0x603F) == 0


def test_a_failure_that_lasts_is_back_after_a_reset_of_the_node_or_with_the_power():
    host = enabled_host()
    drive = host.bench.drives[0]
    drive.fail(ERROR, host.bench.now_ns)
    host.wait_until_at_rest()
    host.take()
    host.nmt(Nmt.RESET_NODE, 1)
    assert (host.read(1, 0x603F), errors(host, 1)) == (ERROR, [ERROR])
    host.bench.devices[0].power_off(host.bench.now_ns)
    assert drive.error_code == 0
    host.bench.devices[0].power_on(host.bench.now_ns)
    poll(host)
    assert drive.error_code == ERROR


@pytest.mark.parametrize("bits", [1, 6])
def test_a_sensor_that_finds_fault_with_itself_says_so_in_frame_and_status(bits):
    host = enabled_host()
    host.bench.sensors[0].set_error(bits)
    host.sync()
    frames = dict(host.take())
    assert frames[0x183][1] >> 4 == bits
    assert frames[0x283][0] == bits
    host.bench.sensors[0].set_error(0)
    host.sync()
    assert host.taken(0x283)[0][0] == 0


@pytest.mark.parametrize(("bits", "counts"), [(4, 32767), (2, -32768)])
def test_an_overload_is_added_to_the_error_of_a_sensor(bits, counts):
    host = enabled_host()
    sensor = host.bench.sensors[0]
    sensor.set_error(bits)
    sensor.on_sync(counts)
    assert host.read(3, 0x6150, 1) == 7


def test_a_device_out_of_control_sends_emergencies_whatever_their_inhibit_time():
    host = enabled_host({(1, 0x1015, 0): 10_000})
    for _ in range(5):
        host.bench.devices[0].send_emergency(0x1000, host.bench.now_ns)
    assert errors(host, 1) == [0x1000] * 5


@pytest.mark.parametrize(("ppm", "patience_ns"), [(0.0, 1_500_000), (200_000.0, 1_250_000), (-250_000.0, 2_000_000)])
def test_a_drive_with_a_fast_clock_misses_sync_sooner(ppm, patience_ns):
    host = BenchHost(clock_mode="wall")
    host.bench.devices[0].clock.set_drift(ppm, 0)
    host.enable()
    host.bench.advance_to(host.t_ns + patience_ns - 1)
    assert host.bench.drives[0].error_code == 0
    host.bench.advance_to(host.t_ns + patience_ns)
    assert host.bench.drives[0].error_code == 0x8700


@pytest.mark.parametrize("ppm", [0.0, 1.0, -1.0, 33.3, 500_000.0, -500_000.0])
def test_a_time_of_the_device_is_reached_at_the_first_time_of_the_bench_that_shows_it(ppm):
    clock = NodeClock()
    clock.set_drift(ppm, 7_000_001)
    for own_ns in (7_000_001, 7_000_002, 8_123_457, 1_000_000_007, 3_600_000_000_001):
        t_ns = clock.bench_ns(own_ns)
        assert clock.own_ns(t_ns) >= own_ns
        assert clock.own_ns(t_ns - 1) < own_ns


def test_a_clock_that_drifts_no_more_keeps_its_lead():
    clock = NodeClock()
    clock.set_drift(100_000.0, 1_000)
    assert clock.bench_ns(NEVER_NS) == NEVER_NS
    clock.set_drift(0.0, 2_000)
    assert clock.own_ns(2_000) == 2_100
    assert clock.own_ns(5_000) == 5_100
    assert clock.bench_ns(5_100) == 5_000
    assert not clock.is_true


@pytest.mark.parametrize(("is_distorted", "velocity_rad_s"), [(True, 0.5), (False, 0.0)])
def test_a_distorted_velocity_counts_where_the_contract_has_an_lsb_of_its_own(is_distorted, velocity_rad_s):
    host = BenchHost(contract="arm_stock")
    host.bench.drives[0].on_sync(0, 1000, PERIOD_NS, is_distorted=is_distorted)
    raw = host.bench.devices[0].reader(0x606C, 0)()
    assert raw * 5.992112452678286e-06 == pytest.approx(velocity_rad_s, abs=1e-5)
