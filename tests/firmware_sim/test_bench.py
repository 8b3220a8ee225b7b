"""The bench: order within a cycle, time, lost SYNCs, resets, and what it ignores."""

import numpy as np
import pytest
from bench_host import PERIOD_NS, BenchHost, Nmt, Word, quiet_scenario

from adacd_hil.wire.bus import Frame

TWITCH = [{"at_s": 0.02, "link": 2, "point_m": 0.3, "force_N": 20.0, "duration_s": 0.02}]


def play(host: BenchHost, cycles: int = 300) -> None:
    """Enable and move; the targets depend on the cycle only."""
    host.enable()
    for k in range(cycles):
        host.step(Word.ENABLE, round(80 * np.sin(0.05 * k)))


def test_the_cyclic_frames_come_last_so_that_a_host_in_lockstep_has_everything():
    host = BenchHost()
    play(host, 5)
    host.take()
    host.step(Word.DISABLE_VOLTAGE)
    assert [can_id for can_id, _ in host.take()] == [0x281, 0x282, 0x181, 0x182, 0x183, 0x184]


def test_scenario_time_starts_when_both_drives_are_first_enabled():
    host = BenchHost(quiet_scenario(contacts=TWITCH))
    host.start()
    for controlword in (0x06, 0x07, 0x0F):
        host.step(controlword, joints=(1,))
    assert not host.bench.is_scenario_started
    for controlword in (0x06, 0x07, 0x0F):
        host.command(Word.ENABLE, joints=(1,))
        host.command(controlword, joints=(2,))
        host.sync()
    assert host.bench.is_scenario_started
    enabled_at = host.truths[-1][0]
    host.step(Word.ENABLE, times=30)
    assert np.flatnonzero(host.history("contact_force"))[0] == enabled_at + 20


def test_by_sync_the_arm_moves_one_period_per_sync_however_long_it_takes():
    quick, slow = BenchHost(), BenchHost()
    play(quick)
    slow.put = lambda can_id, data: slow.bench.on_frame(Frame(can_id, bytes(data), slow.t_ns * 977))  # type: ignore
    play(slow)
    assert quick.frames == slow.frames
    assert quick.bench.now_ns == 302 * PERIOD_NS


@pytest.mark.parametrize("command", [Nmt.PRE_OPERATIONAL, Nmt.RESET_COMMUNICATION, Nmt.RESET_NODE])
def test_another_period_can_be_written_again_once_the_nodes_have_left_operational(command):
    host = BenchHost()
    play(host, 50)
    position = host.true("q").copy()
    host.bench.drives[0].fail(0x2310, host.bench.now_ns)  # so that only the device's state can refuse
    host.wait_until_at_rest()
    assert host.abort_code(lambda: host.write(1, 0x1006, 0, 2000)) == 0x08000022
    position = host.true("q").copy()
    host.nmt(command)
    for node in (1, 2, 3, 4):
        host.write(node, 0x1006, 0, 2000)
        assert host.read(node, 0x1006) == 2000
    host.nmt(Nmt.START)
    host.cycle = 0 if command != Nmt.PRE_OPERATIONAL else host.cycle
    host.sync()
    now_ns = host.bench.now_ns
    host.sync()
    assert host.bench.now_ns == now_ns + 2 * PERIOD_NS
    assert np.abs(host.true("q") - position).max() < 0.05
    assert np.abs(position).max() > 0.005
    host.nmt(Nmt.RESET_COMMUNICATION)  # a second host that leaves the default period
    assert host.read(1, 0x1006) == 1000
    host.cycle = 0
    host.sync()
    assert (host.bench.cycle, host.truths[-1][0]) == (0, 0)
    now_ns = host.bench.now_ns
    host.sync()
    assert host.bench.now_ns == now_ns + PERIOD_NS


def test_error_frames_and_strangers_frames_are_ignored():
    host = BenchHost()
    host.take()
    host.bench.on_frame(Frame(0x080, b"\x01", 0, is_error=True))
    host.put(0x7E5, bytes(8))
    assert host.take() == []
    assert host.bench.cycle == -1
