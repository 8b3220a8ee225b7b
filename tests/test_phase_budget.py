"""The phase budget of the classic contract, played: when feedback is in, and by when commands must leave.

SYNC and feedback take 565 µs at worst, the two commands 230, which leaves the host 205 µs of a period of 1 ms.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from rig import play_lockstep

from adacd_hil.log.reader import RunLog
from adacd_hil.printable import number_of
from adacd_hil.settings.arm_settings import BusSettings, LockstepSettings
from adacd_hil.settings.run_settings import OperatorSettings, RequestSettings


class Played(NamedTuple):
    """A log, and the identifiers of the frames in the order in which they reached the devices."""

    log: RunLog
    arrived: list[int]


@pytest.fixture(scope="module")
def play(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Played]:
    """Plays an idle arm for 0.3 s with frames as long as can be, each case once."""

    @functools.cache
    def played(schedule: str = "same_cycle", **lockstep: Any) -> Played:
        operator = OperatorSettings(script=(RequestSettings(at_s=0.3, request="finish"),))
        settings = LockstepSettings(**({"stuffing": "worst"} | lockstep))
        folder = tmp_path_factory.mktemp("played")
        log, arrived = play_lockstep(folder, operator, settings, bus=BusSettings(schedule=schedule))
        return Played(log, [frame.can_id for frame in arrived])

    return played


def usual(values: np.ndarray) -> int:
    """Return the value of the cycles in which nothing but the cyclic frames is on the bus."""
    found, counts = np.unique(values, return_counts=True)
    return int(found[np.argmax(counts)])


def middle(arrived: list[int]) -> list[int]:
    """Return SYNC and commands of two cycles in the middle of a run."""
    cyclic = [can_id for can_id in arrived if can_id in (0x080, 0x201, 0x202)]
    start = cyclic.index(0x080, len(cyclic) // 2)
    return cyclic[start : start + 6]


def test_stamps_are_those_of_the_modelled_bus(play) -> None:
    log, _ = play(latency_us=200.0)
    sync, feedback = log.topics["/decoded/Sync"], log.topics["/decoded/Drive1Feedback"]
    count = min(len(sync.t_ns), len(feedback.t_ns))
    assert usual(feedback.t_ns[:count] - sync.t_ns[:count]) == 65_000 + 135_000


def test_within_the_hosts_window_a_cycle_says_what_the_work_took_and_what_was_left(play) -> None:
    cycle = play(latency_us=200.0).log.cycle
    assert usual(cycle["feedback_ns"]) == 565_000
    assert usual(cycle["commands_late"]) == 0
    assert usual(cycle["compute_ns"]) == 200_000
    assert usual(cycle["command_ns"]) == 565_000 + 200_000
    assert usual(cycle["slack_ns"]) == 1_000_000 - 765_000
    assert np.array_equal(
        cycle["lateness_ns"] + cycle["command_ns"] + cycle["slack_ns"], np.full(len(cycle), 1_000_000)
    )
    assert usual(cycle["data_age"]) == 0


@pytest.mark.long
@pytest.mark.parametrize(("latency_us", "growth_ns"), [(205.0, 0), (206.0, 1_000), (215.0, 10_000)])
def test_205_us_are_what_the_host_has_beyond_them_every_cycle_is_later(play, latency_us: float, growth_ns: int) -> None:
    assert usual(np.diff(play(latency_us=latency_us).log.cycle["feedback_ns"])) == growth_ns


def test_a_host_beyond_its_window_acts_at_k_plus_2_and_the_log_says_so(play) -> None:
    log, arrived = play(latency_us=330.0)
    late = log.cycle["commands_late"]
    first = next(event.message for _, event in log.events if event.name == "late commands")
    at = np.argmax(late > 0)
    cycle, count = int(log.cycle["cycle"][at]), number_of(int(late[at]), "command")
    assert first == f"{count} of cycle {cycle - 1} missed SYNC {cycle}, so acting one later"
    assert usual(late) == 1
    assert middle(arrived) == [0x080, 0x202, 0x201] * 2


def test_in_a_fifo_late_commands_hold_sync_up_instead(play) -> None:
    assert middle(play(latency_us=330.0, queue="fifo").arrived) == [0x080, 0x201, 0x202] * 2


def test_a_host_that_stalls_for_periods_skips_them_and_keeps_the_grid(play) -> None:
    cycle = play(latency="constant", stall_us=3_000.0, stall_every_s=0.1).log.cycle
    assert cycle["overruns"][-1] >= 3
    assert usual(cycle["lateness_ns"]) == 0


@pytest.mark.long
@pytest.mark.parametrize(("latency_us", "growth_ns"), [(435.0, 0), (436.0, 1_000)])
def test_pipelined_commands_leave_the_host_all_of_the_period_but_sync_and_feedback(
    play, latency_us: float, growth_ns: int
) -> None:
    assert usual(np.diff(play("pipelined", latency_us=latency_us).log.cycle["lateness_ns"])) == growth_ns


def test_pipelined_commands_leave_behind_sync_and_are_never_late(play) -> None:
    log, arrived = play("pipelined", latency_us=400.0)
    arrived = [can_id for can_id in arrived if can_id != 0x77F]  # the host's heartbeat
    first = next(index for index, can_id in enumerate(arrived) if can_id == 0x201)
    assert log.cycle["commands_late"].max() == 0
    assert arrived[first - 1 : first + 5] == [0x080, 0x201, 0x202] * 2
