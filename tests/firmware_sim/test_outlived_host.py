"""A host that dies: the arm's time goes on until it is at rest, and the truth with it."""

import numpy as np
import pytest
from bench_host import PERIOD_NS, BenchHost, Nmt, State, Word, moving_host
from served_bench import MS, enabling_script, serve

from adacd_hil.log.types.truth_topic import TRUTH_LAYOUT

REST_RAD_S = 0.02
DQ = TRUTH_LAYOUT.slices["dq"]
PUSHED = {
    "contacts": [{"at_s": 0.0, "link": 1, "point_m": 0.3, "force_N": 40.0, "duration_s": 60.0}],
    "mechanics": {"stop_low_deg": [-720.0, -720.0], "stop_high_deg": [720.0, 720.0]},
}
"""Round and round."""


def speeds(host: BenchHost, first: int) -> np.ndarray:
    return np.abs(host.history("dq")[first:]).max(axis=1)


def test_the_truth_goes_on_period_by_period_until_the_arm_is_at_rest():
    host = moving_host()
    begun = len(host.truths)
    assert speeds(host, begun - 1)[0] > 1.0
    host.bench.outlive_host()
    told = host.truths[begun - 1 :]
    assert np.diff([cycle for cycle, _, _ in told]).tolist() == [1] * (len(told) - 1)
    assert np.diff([t_ns for _, t_ns, _ in told]).tolist() == [PERIOD_NS] * (len(told) - 1)
    assert 0.05 < len(told) * 1e-3 < 1.0
    assert speeds(host, begun)[-50:].max() < REST_RAD_S
    assert speeds(host, begun)[-52:].max() >= REST_RAD_S / 2  # and no longer than that
    assert [host.state_bits(joint) for joint in (1, 2)] == [State.FAULT] * 2
    assert host.read(1, 0x603F) == 0x8700


def test_it_is_outlived_once_until_a_sync_comes_again():
    host = moving_host(**PUSHED)
    host.bench.outlive_host()
    told = len(host.truths)
    host.bench.outlive_host()
    assert len(host.truths) == told
    host.step(Word.ENABLE)
    assert host.truths[-1][0] == host.truths[-2][0] + 1  # numbers never run backwards
    host.bench.outlive_host()
    assert len(host.truths) > told + 2


def test_an_arm_that_is_pushed_all_the_time_is_left_after_5_s():
    host = moving_host(**PUSHED)
    begun, begun_ns = len(host.truths), host.bench.now_ns
    host.bench.outlive_host()
    assert 4_999 * MS <= host.bench.now_ns - begun_ns <= 5_000 * MS
    assert len(host.truths) - begun <= 5000


def test_after_an_ordinary_end_nothing_is_added():
    host = moving_host(torque=0)
    host.step(Word.DISABLE_VOLTAGE, times=20)
    told, now_ns = len(host.truths), host.bench.now_ns
    frames = len(host.frames)
    host.bench.outlive_host()
    assert (len(host.truths), host.bench.now_ns, len(host.frames)) == (told, now_ns, frames)


def test_a_second_host_finds_an_arm_at_rest_and_its_own_count():
    host = moving_host()
    host.bench.outlive_host()
    host.nmt(Nmt.RESET_COMMUNICATION)
    host.cycle = 0
    host.start()
    for word in (0x80, 0x06, 0x07, Word.ENABLE, Word.ENABLE):
        host.step(word)
    assert [cycle for cycle, _, _ in host.truths[-5:]] == [0, 1, 2, 3, 4]
    assert host.state_bits() == State.ENABLED
    host.bench.advance_to(host.bench.now_ns + 10_000 * MS)  # by SYNC a living host may take its time again
    assert host.state_bits() == State.ENABLED


def test_by_the_clock_a_lost_sync_or_two_leave_a_gap_as_ever():
    patience = {(node, index, 0): value for node in (1, 2) for index, value in ((0x2200, 255), (0x2201, 10_000))}
    host = moving_host(clock_mode="wall", objects=patience)
    begun = len(host.truths)
    for lost in (1, 2):
        host.cycle += lost
        host.t_ns += lost * PERIOD_NS
        host.bench.advance_to(host.t_ns)
        host.step(Word.ENABLE)
    assert [cycle for cycle, _, _ in host.truths[begun:]] == [begun + 1, begun + 4]
    assert host.bench.now_ns == host.t_ns


HEARTBEAT_250 = bytes([0x23, 0x16, 0x10, 1, 250, 0, 127, 0])


@pytest.mark.parametrize(
    ("clock_mode", "beat", "is_once"),
    [("sync", False, False), ("sync", True, True), ("wall", False, True), ("wall", True, False)],
)
def test_the_emulator_outlives_its_host(clock_mode, beat, is_once):
    """The host enables and turns the arm from 1 ms on, and dies after 50 cycles."""
    rows: list[tuple[int, int, float]] = []
    script = enabling_script(50, 300, (HEARTBEAT_250,) if beat else (), is_beating=beat)
    _, bench, clock = serve(
        script, 4_000, clock_mode, is_once,
        on_truth=lambda cycle, t_ns, block: rows.append((cycle, t_ns, float(np.abs(block[DQ]).max()))),
    )  # fmt: skip
    assert rows[49][2] > 1.0
    assert rows[-1][2] < REST_RAD_S
    assert [drive.state.value for drive in bench.drives] == ["fault"] * 2
    assert np.diff([cycle for cycle, _, _ in rows]).min() > 0
    assert (clock.now_ns() < 2_300 * MS) == is_once
    if clock_mode == "sync" and is_once:  # it ends with an arm at rest, and no later
        assert bench.is_at_rest
        assert clock.now_ns() < 400 * MS  # the heartbeat's 250 ms, and what notices it
        assert rows[-1][1] - rows[49][1] < 1_000 * MS


def test_once_by_the_clock_ends_no_sooner_than_the_arm_is_at_rest():
    script = [*enabling_script(50, 300), (51, 0x000, bytes([Nmt.STOP, 0]))]
    _, bench, clock = serve(script, 4_000, "wall", is_once=True)
    assert [drive.state.value for drive in bench.drives] == ["fault"] * 2
    assert bench.is_at_rest
    assert clock.now_ns() < 1_500 * MS
