"""SYNCs that come twice, out of order, too early or with the wrong length: what devices take, count, say and do."""

import struct

import pytest
from bench_host import PERIOD_NS, BenchHost, Nmt, State, Word, moving_host, quiet_scenario

from firmware_sim.canopen.error_control import SyncKind, SyncOrder, Watchdog

NODES = (1, 2, 3, 4)
TOLERATED, CLEAN_SYNCS = 3, 100  # as docs/protocol.md says
ORDER, LENGTH = 6, 7


def running(clock_mode: str = "sync") -> BenchHost:
    """Both drives enabled, more than one overflow of the counter ago."""
    return moving_host(0, 250, clock_mode)


def again(host: BenchHost) -> None:
    """Send the last SYNC once more."""
    host.put(0x080, bytes([1 + (host.cycle - 1) % 240]))


def counts(host: BenchHost, node: int = 1) -> list[int]:
    """Read how often each kind of odd SYNC was heard."""
    return [host.read(node, 0x2211, sub) for sub in range(1, 6)]


@pytest.mark.parametrize("clock_mode", ["sync", "wall"])
def test_one_doubled_sync_is_ignored_counted_and_reported_by_every_node(clock_mode):
    host = running(clock_mode)
    cycle, truths, now_ns = host.bench.cycle, len(host.truths), host.bench.now_ns
    again(host)
    assert (host.bench.cycle, len(host.truths), host.bench.now_ns) == (cycle, truths, now_ns)
    frames = host.take()
    assert [can_id for can_id, _ in frames] == [0x081, 0x082, 0x083, 0x084, 0x283, 0x284]
    assert {struct.unpack_from("<HBB", data) for _, data in frames[:4]} == {(0x8200, 0x11, ORDER)}
    assert {data for _, data in frames[4:]} == {b"\x00\x11"}  # the sensors' error register
    assert [counts(host, node) for node in NODES] == [[1, 0, 0, 0, 0]] * 4
    assert host.read(1, 0x2210, 2 + ORDER) == 1
    host.step(Word.ENABLE)
    assert [host.state_bits(1), host.state_bits(2)] == [State.ENABLED] * 2


def test_odd_syncs_are_tolerated_for_ever_if_100_right_ones_lie_between_them():
    host = running()
    for _ in range(TOLERATED + 2):
        again(host)
        host.step(Word.ENABLE, times=CLEAN_SYNCS)
    assert [host.state_bits(1), host.state_bits(2)] == [State.ENABLED] * 2
    assert [(code, watchdog) for code, _, watchdog, _ in host.emergencies()] == [(0x8200, ORDER), (0, ORDER)] * (
        TOLERATED + 2
    )
    assert host.read(1, 0x1001) == 0


def test_fault_reset_is_refused_until_100_syncs_were_right():
    host = running()
    for _ in range(TOLERATED + 1):
        again(host)
    host.step(Word.ENABLE, times=CLEAN_SYNCS - 1)
    assert host.state_bits(1) == State.FAULT
    host.command(0x80)
    again(host)
    host.sync()
    assert host.state_bits(1) == State.FAULT
    host.step(Word.ENABLE, times=CLEAN_SYNCS)
    host.step(0x80)
    assert host.state_bits(1) == 0x40


def test_a_warning_about_sync_does_not_keep_another_fault_from_being_reset():
    host = running()
    again(host)
    host.bench.drives[0].fail(0x2310, host.bench.now_ns)
    host.bench.drives[0].mend()
    host.step(Word.ENABLE, times=CLEAN_SYNCS - 10)
    assert (host.state_bits(1), host.bench.devices[0].tripped) == (State.FAULT, {Watchdog.SYNC_ORDER})
    host.step(0x80)
    assert host.state_bits(1) == 0x40


@pytest.mark.parametrize(
    ("steps", "periods", "seen"),
    [(-1, 1, [0, 1, 0, 0, 0]), (-119, 1, [0, 1, 0, 0, 0]), (2, 2, [0, 0, 0, 0, 1]), (120, 120, [0, 0, 0, 0, 119])],
)
def test_a_counter_that_runs_backwards_is_odd_and_one_period_and_forward_it_is_lost_syncs(steps, periods, seen):
    host = running()
    now_ns, cycle = host.bench.now_ns, host.bench.cycle
    host.cycle += steps - 1
    host.step(Word.ENABLE)
    assert (host.bench.now_ns, host.bench.cycle) == (now_ns + periods * PERIOD_NS, cycle + periods)
    assert [error[:3] for error in host.emergencies(3)] == [(0x8200, 0x11, ORDER)] * seen[1]
    assert counts(host) == seen
    host.step(Word.ENABLE)
    assert (host.state_bits(1) == State.ENABLED, counts(host)) == (periods < 10, seen)


@pytest.mark.parametrize("data", [b"\x09", b"\x00", b"\xf1", b"\x01\x02"])
def test_an_odd_sync_begins_no_fault_before_its_time(data):
    fault = {"kind": "drive_fault", "node": "drive1", "code": 0x2310, "since": "power_on", "at_s": 0.2}
    host = BenchHost(quiet_scenario(faults=[fault]))
    host.sync(11)
    host.put(0x080, data)
    assert host.bench.now_ns <= 11 * PERIOD_NS
    assert host.read(1, 0x603F) == 0
    host.sync(200)
    assert host.read(1, 0x603F) == 0x2310


@pytest.mark.parametrize(
    ("kind", "node", "count", "hit"),
    [("lose", "sensor1", 5, [3]), ("duplicate", "sensor2", 2, [4]), ("duplicate", "all", 2, NODES)],
)
def test_a_fault_that_loses_or_doubles_sync_is_counted_by_those_whom_it_hits(kind, node, count, hit):
    host = moving_host(0, 30, faults=[{"kind": kind, "node": node, "frame": "sync", "at_s": 0.01, "count": count}])
    seen = [count, 0, 0, 0, 0] if kind == "duplicate" else [0, 0, 0, 0, count]
    assert {number: counts(host, number) for number in NODES} == {
        number: seen if number in hit else [0] * 5 for number in NODES
    }
    assert host.bench.cycle == 32


@pytest.mark.parametrize("data", [b"\x00", b"\xf1"])
def test_a_counter_that_there_is_not_is_ignored(data):
    host = running()
    cycle = host.bench.cycle
    host.put(0x080, data)
    assert host.bench.cycle == cycle
    assert [error[:3] for error in host.emergencies()] == [(0x8200, 0x11, ORDER)]
    assert counts(host) == [0, 1, 0, 0, 0]


@pytest.mark.parametrize("data", [b"", b"\x01\x02"])
def test_a_sync_of_the_wrong_length_is_ignored_and_never_a_fault(data):
    host = running()
    cycle = host.bench.cycle
    for _ in range(20):
        host.put(0x080, data)
    assert host.bench.cycle == cycle
    assert [error[:3] for error in host.emergencies()] == [(0x8240, 0x11, LENGTH)]
    assert counts(host) == [0, 0, 0, 20, 0]
    host.step(Word.ENABLE)
    assert [error[:3] for error in host.emergencies()] == [(0, 0, LENGTH)]
    again(host)  # one that comes twice is the first that counts
    assert host.state_bits(1) == State.ENABLED


def test_a_node_takes_syncs_by_its_own_overflow():
    host = BenchHost()
    for value in (0, 1000):
        host.write(3, 0x1006, 0, value)
        if value == 0:
            host.write(3, 0x1019, 0, 0)
    host.nmt(Nmt.START)
    host.sync()
    host.take()
    host.sync()
    host.put(0x080, b"")
    sent = [can_id for can_id, _ in host.take()]
    assert [can_id for can_id in sent if can_id in (0x181, 0x182, 0x183, 0x184)] == [0x181, 0x182, 0x184, 0x183]
    assert {can_id for can_id in sent if can_id < 0x100} == {0x081, 0x082, 0x083, 0x084}  # 0x083: it's over
    assert [counts(host, node)[3] for node in NODES] == [1, 1, 2, 1]


def test_the_counts_outlive_a_reset_of_communication_and_not_one_of_the_node():
    host = running()
    again(host)
    host.nmt(Nmt.RESET_COMMUNICATION)
    assert counts(host) == [1, 0, 0, 0, 0]
    host.nmt(Nmt.RESET_NODE)
    assert counts(host) == [0] * 5


def wall_sync(host: BenchHost, periods: float, steps: int = 1) -> None:
    """Send commands and a SYNC so long after the last, its counter so many steps further."""
    host.command(Word.ENABLE)
    host.t_ns += round(periods * PERIOD_NS)
    host.bench.advance_to(host.t_ns)
    host.cycle += steps
    host.put(0x080, bytes([1 + (host.cycle - 1) % 240]))


def test_by_the_clock_a_second_sync_within_a_period_is_counted_as_early():
    host = running("wall")
    for periods in (0.1, 0.9, 1.0, 1.0):
        wall_sync(host, periods)
    assert counts(host) == [0, 0, 1, 0, 0]


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_by_the_clock_two_masters_that_take_turns_stop_the_drives_within_4_periods(share):
    host = running("wall")
    for _ in range(4):
        wall_sync(host, share)
        wall_sync(host, 1.0 - share)
    assert host.read(1, 0x603F) == 0x8700


RIGHT, EARLY, ODD = SyncKind.RIGHT, SyncKind.EARLY, SyncKind.OUT_OF_SEQUENCE


def judged(*syncs: tuple[int, float]) -> list[SyncKind]:
    """Judge by the clock, after 250 SYNCs from 0 on, some by their steps of counter and periods since the last."""
    order, kinds, counter, at = SyncOrder(is_timed=True), [], 0, -1.0
    for steps, periods in (*[(1, 1.0)] * 250, *syncs):
        counter, at = counter + steps, at + periods
        order.judge((counter - 1) % 240 + 1, 240, round(at * PERIOD_NS), PERIOD_NS)
        kinds.append(order.kind)
    assert set(kinds[:250]) == {RIGHT}
    return kinds[250:]


@pytest.mark.parametrize(
    ("syncs", "kinds"),
    [
        ([(1, 0.1), (1, 0.9), (1, 1.0)], [EARLY, RIGHT, RIGHT]),
        ([(1, 0.5), (1, 0.5), (1, 1.0)], [EARLY, EARLY, RIGHT]),
        ([(1, 0.9), (1, 0.1), (1, 1.0)], [RIGHT, EARLY, RIGHT]),
        ([(1, 1.05), (1, 0.95), (1, 1.0)] * 20, [RIGHT] * 60),
        ([(1, 1.45), (1, 0.55), (1, 1.0)] * 20, [RIGHT] * 60),
        ([(2, 1.4)], [ODD]),
        ([(50, 1.0)], [ODD]),
        ([(3, 3.0)] * 5, [RIGHT] * 5),
        ([(148, 998.0), (1, 1.0)], [RIGHT] * 2),
        ([(1, 5.0), *[(1, 0.01)] * 4, (1, 0.96), (1, 1.0)], [RIGHT] * 7),
        ([(1, 2.9), (1, 0.1), (1, 1.0)], [RIGHT] * 3),
        ([(1, 1.002)] * 2000 + [(1, 0.3)], [RIGHT] * 2000 + [EARLY]),
    ],
    ids=[
        "a second SYNC soon after the first", "half-way between two", "soon before the next",
        "late ones make no next one early", "even much later ones", "a counter ahead of time", "far ahead",
        "a gap that took its time", "any counter after a long pause", "waited for a busy receiver, in a row",
        "back on the grid after a stall", "a slow clock gathers no lateness that a second SYNC could use",
    ],
)  # fmt: skip
def test_by_the_clock_a_sync_is_judged_by_its_counter_and_its_time(syncs, kinds):
    assert judged(*syncs) == kinds
