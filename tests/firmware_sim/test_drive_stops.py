"""How the emulated drive stops, by each option code, and which torque it is limited to; seen in state and motion."""

import pytest
from bench_host import BenchHost, State, Word, moving_host, remap_mode, set_mode

from firmware_sim.arm.sensing import VELOCITY_LSB_RAD_S, DriveMode

SLOWLY, RAMP, HARD = DriveMode.BRAKE_SLOWLY, DriveMode.BRAKE, DriveMode.BRAKE_HARD


def moving_by(option: int, code: int) -> BenchHost:
    return moving_host(objects={(node, option, 0): code for node in (1, 2)})


@pytest.mark.parametrize(
    ("option", "codes"),
    [(0x605A, {0, 1, 2, 3, 5, 6, 7}), (0x605B, {0, 1}), (0x605C, {0, 1}), (0x605E, {0, 1, 2, 3})],
)
def test_an_option_code_is_taken_or_refused(option, codes):
    host = BenchHost()
    for code in range(-2, 9):
        if code in codes:
            host.write(1, option, 0, code)
            assert host.read(1, option) == code
        else:
            assert host.abort_code(lambda code=code: host.write(1, option, 0, code)) == 0x06090030


@pytest.mark.parametrize(
    ("code", "mode", "end"),
    [
        (1, SLOWLY, State.DISABLED),
        (2, RAMP, State.DISABLED),
        (3, HARD, State.DISABLED),
        (5, SLOWLY, State.STOPPING),
        (6, RAMP, State.STOPPING),
        (7, HARD, State.STOPPING),
    ],
)
def test_quick_stop_brakes_by_its_ramp_and_ends_as_its_code_says(code, mode, end):
    """Operation resumes only from a stop that stays."""
    host = moving_by(0x605A, code)
    host.step(Word.QUICK_STOP)
    assert host.state_bits() == State.STOPPING
    assert host.bench.drives[0].motor_mode == mode
    host.step(Word.QUICK_STOP)
    host.step(Word.QUICK_STOP)
    assert (host.true("tau_J") * host.true("dq")).max() < 0.0
    host.step(Word.ENABLE)
    assert host.state_bits() == (State.ENABLED if end == State.STOPPING else State.STOPPING)
    host.step(Word.QUICK_STOP, times=200)
    assert host.state_bits() == end
    assert abs(host.true("dq")).max() < 0.02


def damping(code: int) -> float:
    """Return the braking torque of joint 1 per its velocity, Nm s/rad, by what its drive says of both.

    The period after a SYNC passes when the next one comes.
    """
    host = moving_by(0x605A, code)
    host.step(Word.QUICK_STOP, times=2)
    return -host.read(1, 0x6077) * 12e-3 / (host.read(1, 0x606C) * VELOCITY_LSB_RAD_S)


def test_the_ramps_brake_with_half_all_and_one_and_a_half_of_the_damping():
    slow, ramp, hard = (damping(code) for code in (5, 6, 7))
    assert ramp == pytest.approx(12.5, rel=0.05)
    assert slow == pytest.approx(0.5 * 12.5, rel=0.05)
    assert hard == pytest.approx(1.5 * 12.5, rel=0.05)


@pytest.mark.parametrize(
    ("option", "word", "end"), [(0x605B, Word.SHUTDOWN, State.READY), (0x605C, Word.SWITCH_ON, State.SWITCHED_ON)]
)
def test_shutdown_and_disable_operation_may_ramp_down_first(option, word, end):
    host = moving_by(option, 1)
    host.step(word, 300)
    assert host.state_bits() == State.ENABLED
    assert host.statusword() & 0x1000 == 0  # the target isn't followed any more
    assert host.bench.drives[0].motor_mode == SLOWLY
    host.step(Word.ENABLE, 300)  # changes nothing: the stop goes on
    assert host.bench.drives[0].torque_Nm == 0.0
    host.wait_until_at_rest(word)
    assert host.state_bits() == end
    assert abs(host.true("dq")).max() < 0.02


@pytest.mark.parametrize(
    ("option", "words", "end"),
    [
        (0x605A, [Word.QUICK_STOP], State.DISABLED),
        (0x605B, [Word.SHUTDOWN], State.READY),
        (0x605C, [Word.SWITCH_ON], State.SWITCHED_ON),
        (0x605E, [None] * 3, State.FAULT),
    ],
)
def test_without_a_ramp_each_stop_ends_at_once(option, words, end):
    """Commands that are missing are a fault with the third SYNC."""
    host = moving_by(option, 0)
    for word in words:
        if word is not None:
            host.command(word)
        host.sync()
    assert host.state_bits() == end
    assert host.bench.drives[0].motor_mode == DriveMode.OFF


@pytest.mark.parametrize(("word", "end"), [(Word.DISABLE_VOLTAGE, State.DISABLED), (Word.QUICK_STOP, State.STOPPING)])
def test_a_ramp_gives_way_to_a_stronger_stop(word, end):
    host = moving_by(0x605B, 1)
    host.step(Word.SHUTDOWN)
    host.step(word)
    assert host.state_bits() == end


@pytest.mark.parametrize(("code", "mode"), [(1, SLOWLY), (2, RAMP), (3, HARD)])
def test_a_fault_brakes_by_its_reaction_code(code, mode):
    host = moving_by(0x605E, code)
    host.sync(times=4)
    assert host.bench.drives[0].motor_mode == mode
    host.wait_until_at_rest(None)
    assert host.state_bits() == State.FAULT
    assert abs(host.true("dq")).max() < 0.02


def demand_with(host: BenchHost, target: int, **objects: int) -> tuple[int, bool]:
    """Return 0x6074 and the internal limit's bit for a target, with objects written before the drive is enabled."""
    for name, value in objects.items():
        host.write(1, int(name[1:], 16), 0, value)
    host.enable()
    host.step(Word.ENABLE, target)
    return host.read(1, 0x6074), bool(host.statusword() & 0x0800)


@pytest.mark.parametrize(
    ("target", "objects", "demand", "is_limited"),
    [
        (1000, {}, 1000, False),
        (1001, {}, 1000, True),
        (-1001, {}, -1000, True),
        (300, {"x6072": 300}, 300, False),
        (301, {"x6072": 300}, 300, True),
        (301, {"x60E0": 300}, 300, True),
        (-301, {"x60E0": 300}, -301, False),
        (-301, {"x60E1": 300}, -300, True),
        (301, {"x60E1": 300}, 301, False),
        (500, {"x6072": 400, "x60E0": 200}, 200, True),
        (100, {"x60B2": 50}, 150, False),
        (100, {"x60B2": -150}, -50, False),
        (250, {"x60B2": 51, "x6072": 300}, 300, True),
        (1, {"x6072": 0}, 0, True),
    ],
)
def test_of_all_limits_the_smallest_counts_and_shows(target, objects, demand, is_limited):
    host = BenchHost()
    assert demand_with(host, target, **objects) == (demand, is_limited)
    assert host.bench.drives[0].torque_Nm == pytest.approx(demand * 12e-3)


def test_another_mode_takes_effect_at_the_next_sync_while_enabled_and_at_once_elsewhere():
    host = BenchHost()
    host.write(1, 0x6060, 0, 10)
    assert host.read(1, 0x6061) == 10
    remap_mode(host)
    host.enable()
    host.step(Word.ENABLE, 100)
    set_mode(host, 0)
    assert host.read(1, 0x6061) == 10
    assert host.bench.drives[0].torque_Nm == pytest.approx(1.2)
    host.step(Word.ENABLE, 100)
    assert host.read(1, 0x6061) == 0
    assert host.bench.drives[0].torque_Nm == 0.0
