"""What a bench sends while a scenario's faults act: SYNCs that nobody hears, and floods."""

import pytest
from bench_host import PERIOD_NS, BenchHost, Word, quiet_scenario


def test_by_the_clock_a_drive_that_hears_no_sync_has_nothing_to_count() -> None:
    host = BenchHost(
        quiet_scenario(faults=[{"kind": "lose", "frame": "sync", "node": "drive1", "at_s": 0.001}]), clock_mode="wall"
    )
    for node in (1, 2):
        host.nodes[node].sdo[0x2201].raw = 255  # 25 periods: nothing else stops it within the test
    host.enable()
    host.step(Word.ENABLE, times=20)
    assert [drive.error_code for drive in host.bench.drives] == [0, 0]


def test_held_back_frames_go_out_although_a_sync_is_lost() -> None:
    host = BenchHost(
        quiet_scenario(
            faults=[
                {"kind": "delay", "node": "sensor1", "frame": "torque", "delay_us": 1200.0, "at_s": 0.001, "count": 1},
                {"kind": "lose", "frame": "sync", "at_s": 0.002, "count": 1},
            ]
        )
    )
    host.enable()
    while not host.bench.is_scenario_started:
        host.step(Word.ENABLE)
    host.step(Word.ENABLE)
    host.take()
    host.step(Word.ENABLE)
    assert [can_id for can_id, _ in host.take()] == [0x183]


@pytest.mark.parametrize("clock_mode", ["sync", "wall"])
def test_a_node_babbles_without_any_sync(clock_mode: str) -> None:
    flood = {"kind": "babble", "node": "drive1", "can_id": 0x7F0, "rate_Hz": 2000.0, "since": "power_on"}
    host = BenchHost(quiet_scenario(faults=[{**flood, "at_s": 0.01, "duration_s": 0.02}]), clock_mode)
    for t_ns in range(0, 50_000_000, 250_000):
        host.bench.advance_to(t_ns)
    assert len(host.taken(0x7F0)) == 40


@pytest.mark.parametrize("clock_mode", ["sync", "wall"])
def test_a_node_babbles_on_between_syncs(clock_mode: str) -> None:
    flood = {"kind": "babble", "node": "drive1", "can_id": 0x7F0, "rate_Hz": 4000.0}
    host = BenchHost(quiet_scenario(faults=[{**flood, "at_s": 0.005, "duration_s": 0.01}]), clock_mode)
    host.enable()
    for _ in range(40):
        host.step(Word.ENABLE)
        if clock_mode == "wall":
            host.bench.advance_to(host.t_ns + PERIOD_NS - 1)
    assert len(host.taken(0x7F0)) == 40
