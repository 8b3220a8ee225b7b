"""The host's clock: a sleep ends when it is due, whatever comes in between."""

import signal
from types import FrameType

from adacd_hil.clock import MonotonicClock


def test_a_time_that_has_passed_is_not_waited_for() -> None:
    clock = MonotonicClock()
    for t_ns in (-1, 0, clock.now_ns() - 1):
        clock.sleep_until_ns(t_ns)


def test_a_signals_handler_runs_during_a_sleep_which_goes_on_after_it() -> None:
    clock = MonotonicClock()
    due_ns = clock.now_ns() + 20_000_000
    handled_ns: list[int] = []

    def handle(_number: int, _frame: FrameType | None) -> None:
        clock.sleep_until_ns(clock.now_ns() + 1_000)  # a handler that sleeps by the same clock is no harm
        handled_ns.append(clock.now_ns())

    before = signal.signal(signal.SIGALRM, handle)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.002)
        clock.sleep_until_ns(due_ns)
    finally:
        signal.signal(signal.SIGALRM, before)
    assert len(handled_ns) == 1
    assert clock.now_ns() >= due_ns
