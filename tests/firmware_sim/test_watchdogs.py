"""The emulated devices' watchdogs: each trips, says which and when, clears by itself, and leaves the fault latched."""

import struct

import pytest
from bench_host import PERIOD_NS, BenchHost, Nmt, State, Word, remap
from served_bench import HOST_BEAT, MS, enabling_script, serve

SYNC, COMMAND, HEARTBEAT, OPERATIONAL, LENGTH = 1, 2, 3, 4, 5
CODES = {SYNC: 0x8700, COMMAND: 0x8250, HEARTBEAT: 0x8130, OPERATIONAL: 0x8100, LENGTH: 0x8210}


class Watched:
    """A bench whose drives are enabled, with everything watched; `lose` and `find` take a cause away and back."""

    def __init__(self, watchdog: int) -> None:
        self.host = BenchHost(clock_mode="wall" if watchdog == SYNC else "sync")
        self.watchdog = watchdog
        if watchdog == HEARTBEAT:
            self.host.write(1, 0x1016, 1, 127 << 16 | 50)
        remap(self.host, 1, 0x1402, (0x60400010,), can_id=0x401, kind=255)
        self.host.enable()
        self.host.step(Word.ENABLE)
        if watchdog == HEARTBEAT:
            self.host.put(*HOST_BEAT)
        self.host.take()

    def lose(self) -> None:
        host = self.host
        if self.watchdog == SYNC:
            host.t_ns += 2 * PERIOD_NS
            host.bench.advance_to(host.t_ns)
        elif self.watchdog == COMMAND:
            host.step(Word.ENABLE, joints=(2,), times=3)
        elif self.watchdog == HEARTBEAT:
            host.step(Word.ENABLE, times=51)
        elif self.watchdog == OPERATIONAL:
            host.nmt(Nmt.PRE_OPERATIONAL, 1)
        else:
            host.put(0x201, b"\0")

    def last(self, periods: int) -> None:
        """Let the cause last."""
        for _ in range(periods):
            self.host.t_ns += PERIOD_NS
            if self.watchdog == SYNC:
                self.host.bench.advance_to(self.host.t_ns)
            else:
                self.host.step(Word.ENABLE, joints=(2,) if self.watchdog == COMMAND else (1, 2))

    def find(self) -> None:
        host = self.host
        if self.watchdog == HEARTBEAT:
            host.put(*HOST_BEAT)
        if self.watchdog in (HEARTBEAT, OPERATIONAL):
            host.nmt(Nmt.START, 1)
        host.step(Word.ENABLE, times=8)  # the first are out of sequence where the drive hasn't listened for a while

    def say(self, word: int) -> None:
        """Send drive 1 a controlword that acts at once: by PDO, where none is exchanged by SDO."""
        if self.host.bench.devices[0].is_operational:
            self.host.put(0x401, bytes([word, 0]))
        else:
            self.host.write(1, 0x6040, 0, word)


FAULTING = (SYNC, COMMAND, HEARTBEAT, OPERATIONAL)


@pytest.mark.parametrize("watchdog", CODES)
def test_a_watchdog_says_that_it_tripped_and_that_its_cause_has_gone_and_leaves_the_fault_latched(watchdog):
    """Fault reset is refused while the cause lasts, and works by its edge after."""
    watched, is_fault = Watched(watchdog), watchdog in FAULTING
    host, before_ms = watched.host, watched.host.bench.now_ns // MS
    watched.lose()
    (error,) = watched.host.emergencies()
    assert error[:3] == (CODES[watchdog], 0x11, watchdog)
    assert before_ms <= error[3] <= host.bench.now_ns // MS
    assert (host.read(1, 0x2210, 1), host.read(1, 0x2210, 2)) == (watchdog, error[3])
    assert [host.read(1, 0x2210, 2 + number) for number in CODES] == [int(number == watchdog) for number in CODES]
    if is_fault:
        watched.last(60)  # the reaction ends at rest
        assert host.state_bits(1) == State.FAULT
        watched.say(0)
        watched.say(Word.FAULT_RESET)
        assert host.state_bits(1) == State.FAULT
    host.take()
    watched.find()
    clearing = [error for error in watched.host.emergencies() if error[0] == 0]
    assert [(code, register, number) for code, register, number, _ in clearing] == [(0, int(is_fault), watchdog)]
    assert (host.read(1, 0x1001), host.read(1, 0x603F)) == (int(is_fault), is_fault * CODES[watchdog])
    if is_fault:
        watched.say(Word.FAULT_RESET)
        assert (host.state_bits(1), host.read(1, 0x1001)) == (State.DISABLED, 0)


def test_a_watchdog_that_trips_again_is_counted_and_reported_again():
    watched = Watched(LENGTH)
    for count in (1, 2, 3):
        watched.lose()
        watched.lose()
        assert watched.host.read(1, 0x2210, 7) == count
        assert [error[0] for error in watched.host.emergencies()] == [0x8210]
        watched.find()
        assert [error[:3] for error in watched.host.emergencies()] == [(0, 0, LENGTH)]


def test_several_tripped_watchdogs_keep_the_communication_error_until_the_last_has_cleared():
    watched = Watched(HEARTBEAT)
    watched.lose()
    watched.host.put(0x201, b"\0")
    watched.host.nmt(Nmt.START, 1)
    watched.host.put(0x201, b"\0")
    assert watched.host.read(1, 0x1001) == 0x11
    watched.host.step(Word.ENABLE)
    assert watched.host.read(1, 0x1001) == 0x11
    watched.host.put(*HOST_BEAT)
    assert watched.host.read(1, 0x1001) == 0x01


def test_a_heartbeat_that_is_no_longer_watched_is_not_missing():
    watched = Watched(HEARTBEAT)
    watched.lose()
    watched.host.emergencies()
    watched.host.write(1, 0x1016, 1, 0)
    assert [error[:3] for error in watched.host.emergencies()] == [(0, 1, HEARTBEAT)]


def test_a_reset_of_the_node_forgets_what_has_tripped():
    watched = Watched(COMMAND)
    watched.lose()
    watched.host.nmt(Nmt.RESET_NODE, 1)
    assert [watched.host.read(1, 0x2210, sub) for sub in range(1, 8)] == [0] * 7


@pytest.mark.parametrize(("tenths", "patience_ns"), [(15, 1_500_000), (20, 2_000_000), (500, 50_000_000)])
def test_the_sync_tolerance_is_a_number_of_tenths_of_the_period(tenths, patience_ns):
    host = BenchHost(clock_mode="wall")
    for node in (1, 2):
        host.write(node, 0x2201, 0, tenths)
    host.enable()
    last_ns = host.t_ns
    host.bench.advance_to(last_ns + patience_ns - 1)
    assert host.state_bits() == State.ENABLED
    host.bench.advance_to(last_ns + patience_ns)
    assert host.read(1, 0x603F) == 0x8700


@pytest.mark.parametrize("node", [1, 3])
def test_the_devices_time_begins_at_power_on(node):
    host = BenchHost()
    host.bench.boot(5_000 * MS)
    host.write(node, 0x1016, 1, 127 << 16 | 50)
    host.put(*HOST_BEAT)
    host.bench.advance_to(5_100 * MS)
    assert host.read(node, 0x2210, 2) == 50


HEARTBEAT_300 = bytes([0x23, 0x16, 0x10, 1, 0x2C, 0x01, 0x7F, 0])
DEADLINE_300 = bytes([0x2B, 0x00, 0x14, 5, 0x2C, 0x01, 0, 0])


def serve_dying_host(deadline: bytes, reaction: int, end_ms: int):
    """Enable and turn both drives by SYNC, then let the host die at 50 ms."""
    set_up = (bytes([0x2B, 0x5E, 0x60, 0, reaction, 0, 0, 0]), deadline)
    return serve(enabling_script(50, 300, set_up, is_beating=True), end_ms)[:2]


@pytest.mark.parametrize(
    ("deadline", "code", "reaction"),
    [(HEARTBEAT_300, 0x8130, 0), (HEARTBEAT_300, 0x8130, 2), (DEADLINE_300, 0x8250, 3)],
)
def test_by_sync_too_a_host_that_dies_leaves_no_torque_after_the_watchdogs_time(deadline, code, reaction):
    bus, bench = serve_dying_host(deadline, reaction, 1_000)
    emergencies = [(t_ns, data) for t_ns, can_id, data in bus.sent if can_id == 0x081]
    assert [struct.unpack_from("<H", data)[0] for _, data in emergencies] == [code]
    assert 350 * MS <= emergencies[0][0] <= 371 * MS
    assert [(drive.torque_Nm, drive.state.value, drive.motor_mode) for drive in bench.drives] == [(0.0, "fault", 0)] * 2


def test_by_sync_a_host_that_pauses_within_the_watchdogs_time_finds_everything_as_it_left_it():
    bus, bench = serve_dying_host(HEARTBEAT_300, 2, 340)
    assert [drive.state.value for drive in bench.drives] == ["operation enabled"] * 2
    assert [can_id for _, can_id, _ in bus.sent if can_id in (0x081, 0x082)] == []
    assert bench.cycle == 49
