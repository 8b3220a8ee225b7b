"""The objects of a device are read again: how long it may take to answer, and how often it is asked."""

import dataclasses
from types import SimpleNamespace

import pytest

from adacd_hil.device.device_setup import ParameterWatch
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.wire.bus import Frame


class WatchedDevice:
    """A device; `sent`: the cycles in which it is asked for an object of the set-up, `asked`: its sub-indices."""

    def __init__(self, answer_s: float = 0.5, pause_ms: float = 0.0, reread_ms: int = 10, objects: int = 1) -> None:
        patience = SimpleNamespace(answer_s=answer_s, pause_ms=pause_ms)
        slave = SimpleNamespace(
            name="Drive1",
            node_id=1,
            known={(0x2200, sub): 10 for sub in range(objects)},
            answer_s=answer_s,
            device=SimpleNamespace(settings=SimpleNamespace(patience=patience)),
            name_object=lambda index, sub: f"0x{index:X}:{sub}",
        )
        settings = load_settings("certified", "P")
        devices = dataclasses.replace(settings.devices, reread_ms=reread_ms)
        self.period_s = settings.bus.period_s
        self.cycle = 0
        self.sent: list[int] = []
        self.asked: list[int] = []
        bus = SimpleNamespace(send=self._hear)
        self.watch = ParameterWatch(dataclasses.replace(settings, devices=devices), bus)  # type: ignore[arg-type]
        self.watch.follow([slave])  # type: ignore[list-item]

    def _hear(self, _: int, request: bytes) -> None:
        self.sent.append(self.cycle)
        self.asked.append(request[3])

    def step(self) -> bool:
        """Run a cycle; return whether the device was asked in it."""
        before = len(self.sent)
        self.watch.step(self.cycle, self.cycle * 1_000_000)
        self.cycle += 1
        return len(self.sent) > before


@pytest.mark.parametrize("answer_s", [0.5, 1.5])
def test_a_device_has_the_time_of_its_profile_to_answer(answer_s: float) -> None:
    slow = WatchedDevice(answer_s)
    warned = []
    for cycle in range(5000):
        slow.step()
        warned += [cycle for _ in slow.watch.take_events()]
    assert warned[0] - slow.sent[0] == pytest.approx(answer_s / slow.period_s, abs=1)


@pytest.mark.parametrize(("pause_ms", "reread_ms", "distances"), [(0.0, 10, {10}), (15.0, 10, {16}), (0.0, 0, set())])
def test_a_device_is_asked_as_soon_as_its_pause_is_over(pause_ms: float, reread_ms: int, distances: set[int]) -> None:
    device = WatchedDevice(0.5, pause_ms, reread_ms)
    for _ in range(100):
        if device.step():
            device.watch.accept(Frame(0x581, bytes.fromhex("4b 00 22 00 0a 00 00 00"), 0))
    assert {after - before for before, after in zip(device.sent, device.sent[1:], strict=False)} == distances
    assert not device.watch.first_difference


@pytest.mark.parametrize(("refused", "asked"), [(1, [0, 1, 2, 0, 2, 0, 2]), (2, [0, 1, 2, 0, 1, 0, 1])])
def test_an_object_that_is_refused_is_left_out_and_no_other(refused: int, asked: list[int]) -> None:
    device = WatchedDevice(objects=3)
    for _ in range(70):
        if device.step():
            head, data = ("80", "00 00 02 06") if device.asked[-1] == refused else ("4b", "0a 00 00 00")
            device.watch.accept(Frame(0x581, bytes.fromhex(f"{head} 00 22 0{device.asked[-1]} {data}"), 0))
    assert device.asked == asked
    assert not device.watch.first_difference
