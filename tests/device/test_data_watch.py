"""What a run says while it runs of cyclic data that doesn't come: shares by second, and cycles in a row at once."""

from types import SimpleNamespace

import pytest

from adacd_hil.device.arm_report import DataWatch
from adacd_hil.settings.configuration import Settings

ROW = "no sample for the model in 2 cycles in a row: so much later a contact is found"
AGAIN = "a sample for the model at least every 2 cycles again, for 1000 cycles"


class Cycles:
    """Cycles of one second are 1000. Of two devices the first may fail."""

    def __init__(self):
        devices = [SimpleNamespace(name="drive1"), SimpleNamespace(name="sensor1")]
        self.arm = SimpleNamespace(devices=devices, repeats=[0, 0], missing_frames=0, received=0b11)
        self.watch = DataWatch(Settings(), self.arm)

    def play(self, *are_complete, is_enabled=True):
        for is_complete in are_complete:
            self.arm.missing_frames = 0 if is_complete else 1
            self.arm.received = 0b11 if is_complete else 0b10
            self.watch.count_cycle(SimpleNamespace(is_enabled=is_enabled, is_complete=is_complete))
        return [(event.level, event.message) for event in self.watch.take_events()]


@pytest.fixture
def cycles():
    return Cycles()


def test_two_cycles_in_a_row_without_a_sample_are_said_in_the_second(cycles):
    assert cycles.play(*[True] * 9, False) == []
    assert cycles.play(False) == [("warning", ROW)]


def test_single_cycles_without_a_sample_are_not(cycles):
    assert cycles.play(*[False, True] * 40, *[True] * 920) == []


def test_they_are_said_once_until_a_second_without(cycles):
    assert cycles.play(*[False, False, True] * 12, *[True] * 964) == [("warning", ROW)]
    assert cycles.play(*[True] * 500, False, False, *[True] * 498) == []
    assert cycles.play(*[True] * 999) == []
    assert cycles.play(True) == [("info", AGAIN)]
    assert cycles.play(False, False) == [("warning", ROW)]


def test_cycles_without_power_count_neither_way(cycles):
    assert cycles.play(*[False] * 5, is_enabled=False) == []
    assert cycles.play(False) == []
    assert cycles.play(*[True] * 5, is_enabled=False) == []
    assert cycles.play(False) == [("warning", ROW)]


def test_a_tenth_of_a_second_is_said_at_its_end_by_device(cycles):
    assert cycles.play(*[False, *[True] * 8] * 111, True) == [
        ("warning", "incomplete cycles: 11.1% of the last 1000 cycles, 10.0% allowed"),
        ("warning", "no frame of drive1 in time: 11.1% of the last 1000 cycles, 5.0% allowed"),
    ]
    assert cycles.play(*[True] * 1000) == [
        ("info", "incomplete cycles: 0.0% of the last 1000 cycles, 10.0% allowed"),
        ("info", "no frame of drive1 in time: 0.0% of the last 1000 cycles, 5.0% allowed"),
    ]


def test_the_share_of_late_cycles_is_of_the_same_cycles_as_the_others(cycles):
    late = SimpleNamespace(is_enabled=True, is_complete=True)
    cycles.play(*[True] * 950)
    cycles.arm.missing_frames = 1
    for _ in range(50 + 20):  # the last 20 begin a second that is too short to be judged
        cycles.watch.count_cycle(late)
    shares = cycles.watch.finish_shares()
    assert (shares.cycles, shares.late, shares.incomplete) == (1000, 0.05, 0.05)
