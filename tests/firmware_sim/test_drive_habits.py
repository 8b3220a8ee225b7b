"""Habits of drives: what real ones do where the standard leaves it open, or beside it."""

import struct
from typing import Any

import pytest
from bench_host import BenchHost, State, Word, quiet_scenario

TORQUE_MODE = 10
IN_BETWEEN = -1
DEVICE_STATE = 0x08000022
READ_STATUSWORD = struct.pack("<BHB4x", 0x40, 0x6041, 0)


def host_of(**habits: Any) -> BenchHost:
    """A host of an arm whose first drive has habits, the second has none."""
    return BenchHost(quiet_scenario(habits=[habits, {}]))


def shown_mode(host: BenchHost) -> int:
    return host.read(1, 0x6061)


def test_a_mode_may_be_shown_only_once_the_drive_is_enabled() -> None:
    host = host_of(shows_mode="enabled")
    host.start()
    host.step(Word.SHUTDOWN)
    host.step(Word.SWITCH_ON)
    before = shown_mode(host)
    host.step(Word.ENABLE)
    host.step(Word.ENABLE)
    assert (before, shown_mode(host)) == (0, TORQUE_MODE)


@pytest.mark.parametrize(("shows_change", "meanwhile"), [(False, 0), (True, IN_BETWEEN)])
def test_a_mode_may_be_shown_long_after_it_was_asked_for(shows_change: bool, meanwhile: int) -> None:
    """Scenario time begins when both drives show theirs."""
    host = host_of(mode_s=0.05, shows_change=shows_change)
    host.enable()
    started, shown = [], []
    for _ in range(60):
        host.step(Word.ENABLE)
        started.append(host.bench.is_scenario_started)
        shown.append(shown_mode(host))
    assert shown[:40] == [meanwhile] * 40
    assert shown[-1] == TORQUE_MODE
    assert abs(started.index(True) - shown.index(TORQUE_MODE)) <= 1


def test_a_drive_may_take_its_time_to_be_enabled() -> None:
    host = host_of(enable_s=0.02)
    host.enable()
    states = []
    for _ in range(30):
        host.step(Word.ENABLE)
        states.append(host.state_bits())
    assert states[:15] == [State.SWITCHED_ON] * 15
    assert states[-1] == State.ENABLED


def test_enabling_that_is_given_up_begins_anew() -> None:
    host = host_of(enable_s=0.02)
    host.enable()
    host.step(Word.ENABLE, times=15)
    for controlword in (Word.DISABLE_VOLTAGE, Word.SHUTDOWN, Word.SWITCH_ON):
        host.step(controlword)
    host.step(Word.ENABLE, times=10)
    assert host.state_bits() == State.SWITCHED_ON


@pytest.mark.parametrize(("after_ms", "answers"), [(14, 0), (16, 1)])
def test_requests_soon_after_an_answer_may_be_lost(after_ms: int, answers: int) -> None:
    host = host_of(pause_ms=15.0)
    host.put(0x601, READ_STATUSWORD)
    host.bench.advance_to(after_ms * 1_000_000)
    host.take()
    host.put(0x601, READ_STATUSWORD)
    assert len(host.taken(0x581)) == answers


def test_a_drive_under_halt_refuses_another_mode() -> None:
    host = host_of(is_halted=True)
    assert host.abort_code(lambda: host.write(1, 0x6060, 0, TORQUE_MODE)) == DEVICE_STATE
    host.write(1, 0x6040, 0, 0)
    host.write(1, 0x6060, 0, TORQUE_MODE)
    assert shown_mode(host) == TORQUE_MODE
