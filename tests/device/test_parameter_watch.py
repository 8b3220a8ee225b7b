"""The objects of a device are read again: how long it may take to answer, and how often it is asked."""

import dataclasses
from types import SimpleNamespace

import pytest

from adacd_hil.device.device_setup import ParameterWatch
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.wire.bus import Frame


class WatchedDevice:
    """A device with one object of the set-up; `sent`: the cycles in which it is asked for it."""

    def __init__(self, answer_s: float = 0.5, pause_ms: float = 0.0, reread_ms: int = 10) -> None:
        patience = SimpleNamespace(answer_s=answer_s, pause_ms=pause_ms)
        slave = SimpleNamespace(
            name="Drive1",
            node_id=1,
            known={(0x2200, 0): 10},
            answer_s=answer_s,
            device=SimpleNamespace(settings=SimpleNamespace(patience=patience)),
            name_object=lambda index, sub: f"0x{index:X}:{sub}",
        )
        settings = load_settings("certified", "P")
        devices = dataclasses.replace(settings.devices, reread_ms=reread_ms)
        self.period_s = settings.bus.period_s
        self.cycle = 0
        self.sent: list[int] = []
        bus = SimpleNamespace(send=lambda *_: self.sent.append(self.cycle))
        self.watch = ParameterWatch(dataclasses.replace(settings, devices=devices), bus)  # type: ignore[arg-type]
        self.watch.follow([slave])  # type: ignore[list-item]

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
