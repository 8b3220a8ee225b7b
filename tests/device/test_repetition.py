"""What is done every so many cycles."""

from adacd_hil.device.arm_watch import Recurrence


def test_a_recurrence_is_due_every_so_many_cycles() -> None:
    heartbeats = Recurrence(0.1, 0.001)
    assert [cycle for cycle in range(350) if heartbeats.is_due(cycle)] == [0, 100, 200, 300]


def test_a_recurrence_whose_cycle_is_skipped_is_due_in_the_next_one() -> None:
    heartbeats = Recurrence(0.1, 0.001)
    cycles = [0, 98, 99, 103, 104, 199, 402, 403, 499, 500]
    assert [cycle for cycle in cycles if heartbeats.is_due(cycle)] == [0, 103, 402, 500]


def test_an_interval_shorter_than_a_period_is_due_in_every_cycle() -> None:
    often = Recurrence(0.0001, 0.001)
    assert [cycle for cycle in range(3) if often.is_due(cycle)] == [0, 1, 2]
