"""The bench's time: a SYNC samples the arm where it is, and both clocks move it by the same rule."""

import numpy as np
import pytest
from bench_host import PERIOD_NS, BenchHost, Word, moving_host, quiet_scenario

FREE = {"mechanics": {"stop_low_deg": [-720.0, -720.0], "stop_high_deg": [720.0, 720.0]}}


@pytest.mark.parametrize("clock_mode", ["sync", "wall"])
def test_a_torque_that_comes_with_a_sync_moves_the_arm_from_that_sync_on(clock_mode: str):
    host = BenchHost(quiet_scenario(), clock_mode=clock_mode)
    host.enable()
    host.command(Word.ENABLE, 500)
    assert host.bench.drives[0].torque_Nm == 0.0
    host.sync()
    assert host.true("tau_m").tolist() == [0.0, 0.0]
    host.step(Word.DISABLE_VOLTAGE)
    assert host.true("tau_m") == pytest.approx([6.0, 3.0], rel=0.01)
    host.step(Word.DISABLE_VOLTAGE)
    assert np.abs(host.true("tau_m")).max() < 0.02


def test_the_arm_goes_on_between_syncs_by_the_clock():
    host = moving_host(clock_mode="wall")
    before = host.true("q").copy()
    host.t_ns += PERIOD_NS // 2
    host.put(0x080, bytes([1 + host.cycle % 240]))
    assert host.true("q") - before == pytest.approx(host.true("dq") * 0.5e-3, rel=0.1)


def test_a_sync_that_is_lost_before_the_first_cycle_has_no_truth():
    lost = {"kind": "lose", "frame": "sync", "at_s": 0.0, "since": "power_on", "count": 3}
    host = BenchHost(quiet_scenario(faults=[lost]))
    host.sync(times=5)
    assert [cycle for cycle, _, _ in host.truths] == [3, 4]


def test_the_truth_of_a_sync_that_no_device_heard_is_that_of_its_own_period():
    lost = {"kind": "lose", "frame": "sync", "at_s": 0.03, "count": 1}
    host = moving_host(faults=[lost], **FREE)
    assert [cycle for cycle, _, _ in host.truths] == list(range(43))
    assert np.count_nonzero(host.history("faults")) == 1
    q, dq = host.history("q")[5:], host.history("dq")[5:]
    assert np.diff(q, axis=0) == pytest.approx(0.5e-3 * (dq[1:] + dq[:-1]), rel=0.02)
