"""What limits an emulated drive's torque, how long it goes without SYNC and commands, and the LSB of its velocity."""

from collections.abc import Callable
from typing import Any

import pytest

from adacd_hil.wire.dbc_contract import load_codec
from adacd_hil.wire.time_marks import NEVER_NS
from firmware_sim.arm.sensing import VELOCITY_LSB_RAD_S
from firmware_sim.nodes.drive_profile import Patience, TorqueLimits, velocity_lsb

TARGET, OFFSET, MOST, MOST_POSITIVE, MOST_NEGATIVE = 0x6071, 0x60B2, 0x6072, 0x60E0, 0x60E1
PERIOD, SYNCS, TOLERANCE = 0x1006, 0x2200, 0x2201


class Objects:
    """Dictionary and PDOs of a drive that has only some objects; a write reaches the watcher, as on the device."""

    def __init__(self, **defaults: int) -> None:
        self.values = {int(name[1:], 16): value for name, value in defaults.items()}
        self.read: dict[int, Callable[[], int]] = {}
        self.written: dict[int, Callable[[int], object]] = {}
        self.received: dict[int, Callable[[int], object]] = {}

    def value(self, index: int) -> int:
        return self.values[index]

    def default_or(self, default: int, index: int) -> int:
        return self.values.get(index, default)

    value_or = default_or

    def serve(self, index: int, subindex: int, read: Callable[[], int]) -> None:
        assert subindex == 0
        self.read[index] = read

    def watch(self, index: int, subindex: int, take: Callable[[int], object]) -> None:
        assert subindex == 0
        self.written[index] = take

    def accept_values(self, index: int, subindex: int, take: Callable[[int], object]) -> None:
        assert subindex == 0
        self.received[index] = take


def limits_of(**defaults: int) -> tuple[TorqueLimits, Objects]:
    objects: Any = Objects(**defaults)
    return TorqueLimits(objects, objects), objects


@pytest.mark.parametrize("way", ["written", "received"])
def test_target_offset_and_limits_come_by_sdo_and_by_pdo_and_are_read_back(way):
    limits, objects = limits_of()
    takes = getattr(objects, way)
    assert set(takes) == set(objects.read) == {TARGET, OFFSET, MOST, MOST_POSITIVE, MOST_NEGATIVE}
    for index, value in ((MOST, 900), (MOST_POSITIVE, 800), (MOST_NEGATIVE, 700), (OFFSET, 50), (TARGET, 790)):
        takes[index](value)
        assert objects.read[index]() == value
    assert (limits.demand, limits.is_limiting) == (800, True)
    takes[TARGET](-740)
    assert (limits.demand, limits.is_limiting) == (-690, False)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_limit_that_the_eds_lacks_limits_no_torque_that_a_frame_can_ask_for(sign):
    limits, objects = limits_of()
    objects.written[TARGET](sign * 32_767)
    objects.written[OFFSET](sign * 32_767)
    assert (limits.demand, limits.is_limiting) == (sign * 65_534, False)


def test_a_drive_begins_with_the_torque_of_its_eds():
    assert (limits_of()[0].demand, limits_of()[0].is_limiting) == (0, False)
    begun, objects = limits_of(x6071=300, x60B2=-100, x6072=150)
    assert (begun.demand, begun.is_limiting) == (150, True)
    assert objects.read[OFFSET]() == -100
    begun.forget_target()
    assert (begun.demand, begun.is_limiting, objects.read[TARGET]()) == (-100, False, 0)


def patience_of(**defaults: int) -> tuple[Patience, Objects]:
    objects: Any = Objects(**{"x1006": 1000} | defaults)
    return Patience(objects), objects


def test_commands_are_missing_before_the_first_and_after_as_many_syncs_as_0x2200_says():
    patience, objects = patience_of(x2200=3)
    assert patience.is_command_missing
    for silent, is_missing in ((0, False), (2, False), (3, True)):
        patience.silent_syncs = silent
        assert patience.is_command_missing is is_missing
    objects.written[SYNCS](255)
    assert not patience.is_command_missing
    patience.forget_command()
    assert patience.is_command_missing


def test_a_drive_without_0x2200_misses_no_command():
    patience, _ = patience_of()
    assert not patience.is_command_missing
    patience.silent_syncs = 10**8
    assert not patience.is_command_missing


def test_sync_is_due_some_tenths_of_a_period_after_the_last():
    patience, objects = patience_of(x2201=12)
    assert patience.sync_due_ns == 1_200_000
    patience.sync_ns = 5_000_000
    objects.written[TOLERANCE](20)
    objects.written[PERIOD](500)
    assert patience.sync_due_ns == 6_000_000
    assert patience_of()[0].sync_due_ns == 1_500_000


@pytest.mark.parametrize(("factory_us", "due_ns"), [(1000, 3_000_000), (0, NEVER_NS)])
def test_a_period_of_0_ends_the_watch_unless_the_drive_has_one_from_its_factory(factory_us, due_ns):
    patience, objects = patience_of(x1006=factory_us)
    objects.written[PERIOD](2000)
    assert patience.sync_due_ns == 3_000_000
    objects.written[PERIOD](0)
    assert patience.sync_due_ns == due_ns


@pytest.mark.parametrize("number", [1, 2])
def test_the_lsb_of_velocity_is_the_contracts_by_the_drives_factor(number):
    codec = load_codec()
    assert velocity_lsb(codec, number, 1.0) is None
    assert velocity_lsb(codec, number, 4.0) == VELOCITY_LSB_RAD_S / 4.0
