"""What is done every so many cycles."""

import pytest

from adacd_hil.device.arm_watch import Recurrence


@pytest.mark.parametrize(
    ("interval_s", "cycles", "due"),
    [
        (0.1, range(350), [0, 100, 200, 300]),
        (0.1, [0, 98, 99, 103, 104, 199, 402, 403, 499, 500], [0, 103, 402, 500]),
        (0.0001, range(3), [0, 1, 2]),
    ],
    ids=["every so many", "a skipped cycle: the next", "shorter than a period: every"],
)
def test_a_recurrence_is_due_every_so_many_cycles(interval_s: float, cycles: list[int], due: list[int]) -> None:
    recurrence = Recurrence(interval_s, 0.001)
    assert [cycle for cycle in cycles if recurrence.take_turn(cycle)] == due
