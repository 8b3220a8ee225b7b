"""tools/side_by_side.py: CPU time by window, overruns by the grid, ratios by round."""

from pathlib import Path

import numpy as np
import pytest
import side_by_side
from side_by_side import Block, Window


def block(name: str, cpu_us: list[float], overruns: int = 0, compute_ns: int = 50_000) -> Block:
    due_ns = np.arange(100, dtype=np.int64) * 1_000_000
    times_ns = {key: np.full(100, compute_ns, np.int64) for key in side_by_side.TITLES}
    return Block(name, 1000, due_ns, times_ns, {name: np.array(cpu_us)}, overruns, 0, np.array(cpu_us))


def test_overruns_are_the_periods_missing_from_the_grid() -> None:
    due_ns = np.array([0, 1, 2, 5, 6, 8], np.int64) * 500_000
    assert side_by_side.count_overruns(due_ns, 500) == 3
    assert side_by_side.count_overruns(due_ns[:1], 500) == 0


def test_cpu_time_goes_to_the_cycles_that_began_in_its_window() -> None:
    windows = [Window(0, {"host": 0}), Window(1000, {"host": 8000}), Window(2000, {"host": 9000}), Window(3000, {})]
    due_ns = np.array([0, 500, 999, 1000, 1500, 2500], np.int64)
    np.testing.assert_allclose(side_by_side.cpu_per_cycle(windows, due_ns, "host"), [8 / 3, 0.5])


def test_ratios_compare_within_a_round() -> None:
    yardsticks = [block("yardstick", [50.0]), block("yardstick", [100.0])]
    hosts = [block("host", [100.0, 120.0, 900.0]), block("host", [300.0])]
    described = side_by_side.summarise({"yardstick": yardsticks, "host": hosts})
    np.testing.assert_allclose(described["ratios"]["host/yardstick"]["work"], [2.7, 2.4, 3.0])
    assert described["host"]["cpu_us"] == pytest.approx(210.0)
    assert "host/yardstick, work" in side_by_side.as_text(described)


def test_work_is_what_lies_between_two_waits(tmp_path: Path) -> None:
    path = tmp_path / "waits"
    waits = [(0, 1_000_100), (1_010_000, 1_030_000), (1_050_000, 2_000_000), (2_100_000, 3_000_000)]
    clocks = [(7, 500), (7 + 8_000_000, 500 + 4_000_000)]  # two ticks are 1 ns
    ticks = [(7 + 2 * (before - 500), 7 + 2 * (after - 500)) for before, after in waits]
    np.array([*clocks, *ticks], np.int64).tofile(path)
    due_ns = np.array([1_000_000, 2_000_000, 3_000_000], np.int64)
    np.testing.assert_allclose(side_by_side.work_per_cycle(path, due_ns), [9.9 + 20.0, 100.0])
