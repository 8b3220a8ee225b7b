"""The objects of a device are read again: how long it may take to answer."""

from types import SimpleNamespace

import pytest

from adacd_hil.device.device_setup import ParameterWatch
from adacd_hil.settings.configuration_files import load_settings


@pytest.mark.parametrize("answer_s", [0.5, 1.5])
def test_a_device_has_the_time_of_its_profile_to_answer(answer_s: float) -> None:
    slow = SimpleNamespace(
        name="Drive1",
        node_id=1,
        known={(0x2200, 0): 10},
        answer_s=answer_s,
        device=SimpleNamespace(settings=SimpleNamespace(patience=SimpleNamespace(answer_s=answer_s, pause_ms=0.0))),
        name_object=lambda index, sub: f"0x{index:X}:{sub}",
    )
    sent: list[int] = []
    settings = load_settings("certified", "P")
    watch = ParameterWatch(settings, SimpleNamespace(send=lambda *_: sent.append(cycle)))  # type: ignore[arg-type]
    watch.follow([slow])  # type: ignore[list-item]
    warned = []
    for cycle in range(5000):
        watch.step(cycle, cycle * 1_000_000)
        warned += [cycle for _ in watch.take_events()]
    assert warned[0] - sent[0] == pytest.approx(answer_s / settings.bus.period_s, abs=1)
