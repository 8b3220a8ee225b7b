"""Frames of a cycle read in one call, against the same frames taken one by one: damaged, late, lost, doubled."""

from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adacd_hil.clock import VirtualClock
from adacd_hil.device.answer_clock import USUAL_ANSWERS
from adacd_hil.device.arm import Arm
from adacd_hil.device.arm_report import ArmReport
from adacd_hil.device.contract import load_contract
from adacd_hil.device.cycle_frames import CycleFrames
from adacd_hil.settings.configuration import load_settings
from adacd_hil.wire.bus import EmbeddedBus, Frame
from adacd_hil.wire.codec_columns import SignalCodec

NAMES = ("Drive1Feedback", "Drive2Feedback", "Sensor1Torque", "Sensor2Torque")
CONFIGURATIONS = ("paper", "stock", "fd")
LOADED = {name: (load_settings(name), load_contract(load_settings(name))) for name in CONFIGURATIONS}
QUIET_CYCLES = USUAL_ANSWERS + 5


class Fate(NamedTuple):
    """What becomes of one device's frame in one cycle. delay: in cycles, of a frame or of a copy of it."""

    what: str = "comes"
    step: int = 1
    """Of its raw values."""
    bit: int | None = None
    """Flipped on its way, unless None."""
    delay: int = 1


def draw_cycles(seed: int, count: int, share: float) -> list[tuple[list[int], list[Fate]]]:
    """Draw the order and the fates of all frames of some cycles; share: of frames that something happens to."""
    generator = np.random.default_rng(seed)

    def draw() -> Fate:
        if generator.random() > share:
            return Fate()
        what = str(generator.choice(("comes", "lost", "twice", "late", "cut", "again")))
        step = int(generator.choice((1, -1, 0, 300, 20_000)))
        bit = int(generator.integers(512)) if generator.random() < 0.3 else None
        return Fate(what, step, bit, int(generator.integers(1, 4)))

    return [(generator.permutation(4).tolist(), [draw() for _ in NAMES]) for _ in range(count)]


def _fitting(raw: int, signal: SignalCodec) -> int:
    """Bring a raw value into the range of a signal, if it isn't: by its low bits."""
    return raw if signal.raw_low <= raw <= signal.raw_high else raw & min(signal.raw_high, 0x7FFF)


def play(
    name: str, cycles: list[tuple[list[int], list[Fate]]], skipped: int = 1, is_batched: bool = False
) -> list[Any]:
    """Run an arm through quiet cycles and those given; return all that it says of each of them.

    is_batched: what comes is offered as the exchange does, as many frames at once as the cycle lacks.
    """
    chosen, codec = LOADED[name]
    arm = Arm(chosen, codec, EmbeddedBus(VirtualClock()))
    messages = [codec.message(message) for message in NAMES]
    senders = [message.sender() for message in messages]
    period_ns = chosen.bus.period_us * 1000
    raw = [0] * len(NAMES)
    late: list[tuple[int, int, bytes]] = []
    said: list[Any] = []
    number = 0
    quiet = [(list(range(len(NAMES))), [Fate()] * len(NAMES))] * QUIET_CYCLES
    for place, (order, fates) in enumerate([*quiet, *cycles]):
        periods = skipped if place == QUIET_CYCLES + 2 else 1
        number += periods
        for due, can_id, data in late:
            if due == place:
                arm.accept(Frame(can_id, data, number * period_ns - 1000), is_late=True)
        arm.synchronise(number, number * period_ns, periods)
        came: list[Frame] = []
        for index in order:
            message, fate = messages[index], fates[index]
            raw[index] = (raw[index] + fate.step + 2**15) % 2**16 - 2**15
            values = [_fitting(raw[index], signal) for signal in message.values]
            data = bytearray(senders[index].protect(message.encode_raw(*values)))
            if fate.bit is not None:
                data[fate.bit // 8 % len(data)] ^= 1 << fate.bit % 8
            sent = bytes(data[:-1]) if fate.what == "cut" else bytes(data)
            if fate.what in ("late", "again"):
                late.append((place + fate.delay, message.can_id, sent))
            for _ in range({"lost": 0, "late": 0, "twice": 2}.get(fate.what, 1)):
                came.append(Frame(message.can_id, sent, number * period_ns + 100_000 + 10_000 * index))
        while came:
            count = arm.open_answers if is_batched else 1
            batch, came = came[:count], came[count:]
            if not (is_batched and arm.accept_answers(batch)):
                for frame in batch:
                    arm.accept(frame)
        said.append(_all_of(arm))
    return said


def _all_of(arm: Arm) -> tuple[Any, ...]:
    has_all, state, report = arm.has_all_frames, arm.state(), ArmReport(arm)
    return (
        has_all,
        [value.tolist() if isinstance(value, np.ndarray) else value for value in state],
        [(device.values, device.sample_cycle, device.is_steady, device.implausible_frames) for device in arm.devices],
        [(drive.statusword, drive.status_cycle, drive.torque_actual_permille) for drive in arm.drives],
        (arm.frame_checks(), list(arm.repeats), arm.missing_names(), arm.is_settled),
        (report.describe_faults(), report.describe_gaps(), arm.strangers.take_events()),
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", CONFIGURATIONS)
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), share=st.sampled_from((0.02, 0.1, 0.3)), skipped=st.sampled_from((1, 1, 2)))
def test_frames_read_together_leave_the_arm_as_one_by_one(name: str, seed: int, share: float, skipped: int) -> None:
    cycles = draw_cycles(seed, 120, share)
    together = play(name, cycles, skipped)
    with pytest.MonkeyPatch.context() as changed:
        changed.setattr(CycleFrames, "begin", lambda *_: False)
        one_by_one = play(name, cycles, skipped)
    assert together == one_by_one
    assert play(name, cycles, skipped, is_batched=True) == one_by_one


@pytest.mark.parametrize("frames", [0, 3, 5])
def test_what_is_not_one_frame_of_each_device_is_not_taken_at_once(frames: int) -> None:
    chosen, codec = LOADED["paper"]
    arm = Arm(chosen, codec, EmbeddedBus(VirtualClock()))
    arm.synchronise(0, 0, 1)
    message = codec.message(NAMES[0])
    assert not arm.accept_answers([Frame(message.can_id, bytes(message.length), 1)] * frames)
    assert arm.open_answers == 4


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_quiet_cycles_are_read_together(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[Any] = []
    of_one = CycleFrames.read
    monkeypatch.setattr(CycleFrames, "read", lambda frames, cycle: read.append(of_one(frames, cycle)) or read[-1])
    for is_batched in (False, True):
        read.clear()
        play(name, draw_cycles(1, 10, share=0.0), is_batched=is_batched)
        assert len(read) >= 10
        assert None not in read
