"""The phase budget of the classic contract, played: when feedback is in, and by when commands must leave.

SYNC and feedback take 565 µs at worst, the two commands 230, which leaves the host 205 µs of a period of 1 ms.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rig import play_lockstep

from adacd_hil.log.reader import RunLog
from adacd_hil.settings.arm_settings import BusSettings, LockstepSettings
from adacd_hil.settings.run_settings import OperatorSettings, RequestSettings


def play(folder: Path, schedule: str = "same_cycle", **lockstep: Any) -> tuple[RunLog, list[int]]:
    """Run an idle arm for half a second with frames as long as can be; give log, and identifiers as they arrive."""
    operator = OperatorSettings(script=(RequestSettings(at_s=0.5, request="finish"),))
    settings = LockstepSettings(**({"stuffing": "worst"} | lockstep))
    log, arrived = play_lockstep(folder, operator, settings, bus=BusSettings(schedule=schedule))
    return log, [frame.can_id for frame in arrived]


def usual(values: np.ndarray) -> int:
    """Return the value of the cycles in which nothing but the cyclic frames is on the bus."""
    found, counts = np.unique(values, return_counts=True)
    return int(found[np.argmax(counts)])


def test_the_last_sensor_frame_is_in_565_us_after_sync_at_worst(tmp_path: Path) -> None:
    log, _ = play(tmp_path)
    assert usual(log.cycle["feedback_ns"]) == 565_000


def test_stamps_are_those_of_the_modelled_bus(tmp_path: Path) -> None:
    log, _ = play(tmp_path)
    sync, feedback = log.decoded["Sync"], log.decoded["Drive1Feedback"]
    count = min(len(sync.t_ns), len(feedback.t_ns))
    assert usual(feedback.t_ns[:count] - sync.t_ns[:count]) == 65_000 + 135_000


@pytest.mark.long
@pytest.mark.parametrize(("latency_us", "growth_ns"), [(205.0, 0), (206.0, 1_000), (215.0, 10_000)])
def test_205_us_are_what_the_host_has_beyond_them_every_cycle_is_later(
    tmp_path: Path, latency_us: float, growth_ns: int
) -> None:
    log, _ = play(tmp_path, latency_us=latency_us)
    assert usual(np.diff(log.cycle["feedback_ns"])) == growth_ns


def test_within_the_hosts_window_sync_is_punctual_and_no_command_late(tmp_path: Path) -> None:
    log, _ = play(tmp_path, latency_us=200.0)
    assert (usual(log.cycle["feedback_ns"]), usual(log.cycle["commands_late"])) == (565_000, 0)


def test_a_host_beyond_its_window_acts_at_k_plus_2_and_the_log_says_so(tmp_path: Path) -> None:
    log, _ = play(tmp_path, latency_us=330.0)
    late = log.cycle["commands_late"]
    first = next(event.message for _, event in log.events if event.name == "late commands")
    cycle = int(log.cycle["cycle"][np.argmax(late > 0)])
    assert first == f"1 command of cycle {cycle - 1} missed SYNC {cycle}, so acting one later"
    assert usual(late) == 1


def test_a_command_that_misses_its_sync_reaches_the_drive_after_it(tmp_path: Path) -> None:
    _, arrived = play(tmp_path, latency_us=330.0)
    cyclic = [can_id for can_id in arrived if can_id in (0x080, 0x201, 0x202)]
    middle = cyclic.index(0x080, len(cyclic) // 2)
    assert cyclic[middle : middle + 6] == [0x080, 0x202, 0x201] * 2


def test_in_a_fifo_late_commands_hold_sync_up_instead(tmp_path: Path) -> None:
    _, arrived = play(tmp_path, latency_us=330.0, queue="fifo")
    cyclic = [can_id for can_id in arrived if can_id in (0x080, 0x201, 0x202)]
    middle = cyclic.index(0x080, len(cyclic) // 2)
    assert cyclic[middle : middle + 6] == [0x080, 0x201, 0x202] * 2


def test_a_host_that_stalls_for_periods_skips_them_and_keeps_the_grid(tmp_path: Path) -> None:
    log, _ = play(tmp_path, latency="constant", stall_us=3_000.0, stall_every_s=0.1)
    assert log.cycle["overruns"][-1] >= 3
    assert usual(log.cycle["lateness_ns"]) == 0


@pytest.mark.long
@pytest.mark.parametrize(("latency_us", "growth_ns"), [(435.0, 0), (436.0, 1_000)])
def test_pipelined_commands_leave_the_host_all_of_the_period_but_sync_and_feedback(
    tmp_path: Path, latency_us: float, growth_ns: int
) -> None:
    log, _ = play(tmp_path, "pipelined", latency_us=latency_us)
    assert usual(np.diff(log.cycle["lateness_ns"])) == growth_ns


def test_pipelined_commands_leave_behind_sync_and_are_never_late(tmp_path: Path) -> None:
    log, arrived = play(tmp_path, "pipelined", latency_us=400.0)
    first = next(index for index, can_id in enumerate(arrived) if can_id == 0x201)
    assert log.cycle["commands_late"].max() == 0
    assert [can_id for can_id in arrived[first - 1 : first + 5] if can_id != 0x77F] == [0x080, 0x201, 0x202] * 2


def test_the_record_of_a_cycle_says_what_the_work_took_and_what_was_left(tmp_path: Path) -> None:
    log, _ = play(tmp_path, latency_us=120.0)
    cycle = log.cycle
    assert usual(cycle["compute_ns"]) == 120_000
    assert usual(cycle["command_ns"]) == 565_000 + 120_000
    assert usual(cycle["slack_ns"]) == 1_000_000 - 685_000
    assert np.array_equal(
        cycle["lateness_ns"] + cycle["command_ns"] + cycle["slack_ns"], np.full(len(cycle), 1_000_000)
    )
    assert usual(cycle["data_age"]) == 0
