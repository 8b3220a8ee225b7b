"""The bench's time: a SYNC samples the arm where it is, and both clocks move it by the same rule."""

import numpy as np
import pytest
from bench_host import PERIOD_NS, BenchHost, Word, quiet_scenario

from adacd_hil.log.types.truth_topic import TRUTH_LAYOUT

Q, DQ, TAU_M = (TRUTH_LAYOUT.slices[name] for name in ("q", "dq", "tau_m"))
FREE = {"mechanics": {"stop_low_deg": [-720.0, -720.0], "stop_high_deg": [720.0, 720.0]}}


def moving(clock_mode: str = "sync", **scenario) -> BenchHost:
    host = BenchHost(quiet_scenario(**scenario), clock_mode=clock_mode)
    host.enable()
    host.step(Word.ENABLE, 250, times=40)
    return host


def rows(host: BenchHost, place: slice) -> np.ndarray:
    return np.array([block[place] for _, _, block in host.truths])


def run_on(host: BenchHost, periods: int) -> None:
    """Let a host be silent for so long, by the way that its clock has."""
    host.t_ns += periods * PERIOD_NS
    host.bench.advance_to(host.bench.now_ns + periods * PERIOD_NS)


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
    host = moving("wall")
    before = rows(host, Q)[-1]
    host.t_ns += PERIOD_NS // 2
    host.put(0x080, bytes([1 + host.cycle % 240]))
    early = rows(host, Q)[-1] - before
    assert early == pytest.approx(host.true("dq") * 0.5e-3, rel=0.1)


def test_the_truth_of_a_sync_that_no_device_heard_is_that_of_its_own_period():
    lost = {"kind": "lose", "frame": "sync", "at_s": 0.03, "count": 1}
    host = moving(faults=[lost], **FREE)
    assert [cycle for cycle, _, _ in host.truths] == list(range(43))
    assert sum(block[TRUTH_LAYOUT.slices["faults"]][0] != 0.0 for _, _, block in host.truths) == 1
    q, dq = rows(host, Q)[5:], rows(host, DQ)[5:]
    assert np.diff(q, axis=0) == pytest.approx(0.5e-3 * (dq[1:] + dq[:-1]), rel=0.02)


def test_drives_without_sync_brake_from_the_same_instant_in_both_clocks():
    by_sync, by_wall = moving(), moving("wall")
    assert rows(by_sync, Q)[-1].tolist() == rows(by_wall, Q)[-1].tolist()
    by_sync.bench.outlive_host()
    run_on(by_wall, 8)
    died = by_sync.cycle - 1
    found = {
        name: {cycle: np.concatenate([block[Q], block[TAU_M]]) for cycle, _, block in host.truths}
        for name, host in (("sync", by_sync), ("wall", by_wall))
    }
    for cycle in range(died + 4, died + 9):
        assert found["wall"][cycle] == pytest.approx(found["sync"][cycle], abs=1e-12)
    assert found["sync"][died + 2][3] < 0.0 < found["sync"][died + 1][3]
