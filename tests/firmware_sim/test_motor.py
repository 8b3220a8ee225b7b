"""The imperfect drive against closed forms: torque loop, torque constant, I²t, temperature; alone and on the bus."""

import math
import struct

import numpy as np
import pytest
from bench_host import BenchHost, State, Word, moving_host
from general_arm import BRAKE, OFF, TORQUE, truth_of

from adacd_hil.settings.parsing import parse
from firmware_sim.arm.hardware_settings import DriveSettings
from firmware_sim.arm.touch_settings import TICK_S
from firmware_sim.body.body import Body
from firmware_sim.body.motor import (
    available_torque,
    error_code,
    heat_motor,
    motor_numbers,
    motor_state,
    winding_temperature,
)
from firmware_sim.scenario.scenario import Scenario

RATED_NM = (12.0, 6.0)
INTERNAL_LIMIT = 1 << 11
EXCESS_TEMPERATURE, OVER_CURRENT = 0x4310, 0x2310


class Motors:
    """Both motors on a bench of their own: torque in, heat out."""

    def __init__(self, **settings) -> None:
        resolved = parse(DriveSettings, settings)
        self.numbers = motor_numbers(resolved, RATED_NM)
        self.state = motor_state(resolved)

    def hold(self, torque_Nm: float, time_s: float, joint: int = 0) -> None:
        for _ in range(round(time_s / TICK_S)):
            heat_motor(self.numbers, self.state, joint, torque_Nm)

    def until_limited(self, torque_Nm: float, below_Nm: float, joint: int = 0) -> float:
        """Hold a torque until less than `below_Nm` is available; return how long that took, s."""
        ticks = 0
        while self.available_Nm(joint) >= below_Nm:
            heat_motor(self.numbers, self.state, joint, torque_Nm)
            ticks += 1
            assert ticks < 1_000_000
        return ticks * TICK_S

    def available_Nm(self, joint: int = 0) -> float:
        return available_torque(self.numbers, self.state, joint)

    def temperature_C(self, joint: int = 0) -> float:
        return winding_temperature(self.numbers, self.state, joint)

    def error(self, joint: int = 0) -> int:
        is_overloaded = self.state["is_spent"][joint] * self.numbers["can_overload"]
        return error_code(self.state["is_overheated"][joint], is_overloaded)


def arm(**drives) -> Body:
    return Body(parse(Scenario, {"profile": "S", "noise": False, "drives": drives}))


def true_torque(body: Body) -> np.ndarray:
    return truth_of(body)["tau_J"]


@pytest.mark.parametrize("bandwidth_Hz", [20.0, 1_000.0, 5_000.0])
def test_a_step_of_the_set_point_arrives_with_the_lag_of_the_torque_loop(bandwidth_Hz):
    body = arm(current_loop_Hz=[bandwidth_Hz, 1_000.0])
    for tick in range(1, 60):
        body.advance((2.0, 1.0), TORQUE, 1)
        omega1, omega2 = 2.0 * math.pi * bandwidth_Hz, 2.0 * math.pi * 1_000.0
        torque_Nm = true_torque(body)
        assert torque_Nm[0] == pytest.approx(-2.0 * math.expm1(-omega1 * tick * TICK_S), abs=1e-12)
        assert torque_Nm[1] == pytest.approx(-1.0 * math.expm1(-omega2 * tick * TICK_S), abs=1e-12)


def test_a_motor_with_another_torque_constant_gives_more_than_its_drive_believes():
    body = arm(torque_constant_error=[0.05, -0.1])
    for _ in range(5):
        body.advance((2.0, 1.0), TORQUE)
    assert body.motor_torque_Nm == pytest.approx((2.0, 1.0), rel=1e-9)
    assert true_torque(body) == pytest.approx([2.1, 0.9], rel=1e-9)


def test_a_current_offset_is_torque_while_the_motor_is_powered():
    body = arm(torque_offset_Nm=[0.2, 0.0], torque_constant_error=[0.1, 0.0])
    for _ in range(5):
        body.advance((1.0, 1.0), TORQUE)
    assert true_torque(body) == pytest.approx([1.32, 1.0], rel=1e-9)
    assert body.motor_torque_Nm == pytest.approx((1.0, 1.0), rel=1e-9)
    for _ in range(9):
        body.advance((1.0, 1.0), OFF)
    assert true_torque(body) == pytest.approx([0.0, 0.0], abs=1e-9)
    assert body.motor_torque_Nm == pytest.approx((-0.2, 0.0), abs=1e-9)


@pytest.mark.parametrize(("peak_Nm", "available_Nm"), [(0.0, 12.0), (7.5, 7.5), (20.0, 12.0)])
def test_the_peak_current_is_rated_torque_at_most(peak_Nm, available_Nm):
    assert Motors(peak_torque_Nm=[peak_Nm, 0.0]).available_Nm() == available_Nm


def test_a_drive_gives_its_peak_and_says_that_it_is_limited():
    body = arm(peak_torque_Nm=[3.0, 0.0])
    for _ in range(5):
        body.advance((-4.0, 4.0), TORQUE)
    assert body.motor_torque_Nm == pytest.approx((-3.0, 4.0), rel=1e-9)
    assert body.is_torque_limited == (True, False)
    body.advance((-3.0, 4.0), TORQUE)
    assert body.is_torque_limited == (False, False)


def test_a_limited_drive_brakes_with_what_it_has():
    body = arm(peak_torque_Nm=[3.0, 0.0])
    body.advance((3.0, 0.0), TORQUE, 2_000)
    assert body.drive_velocity_rad_s[0] > 1.5
    body.advance((0.0, 0.0), BRAKE, 50)
    assert body.motor_torque_Nm[0] == pytest.approx(-3.0, rel=1e-9)


I2T = {"continuous_torque_Nm": [4.0, 0.0], "peak_torque_Nm": [10.0, 0.0], "peak_time_s": [0.5, 1.0]}


@pytest.mark.parametrize("torque_Nm", [-10.0, 7.0])
def test_i2t_allows_each_torque_for_its_time(torque_Nm):
    expected_s = 0.5 * (10.0**2 - 4.0**2) / (torque_Nm**2 - 4.0**2)
    motors = Motors(**I2T)
    assert motors.until_limited(torque_Nm, 9.9) == pytest.approx(expected_s, abs=1.5 * TICK_S)
    assert motors.available_Nm() == 4.0


def test_i2t_lets_go_when_a_tenth_is_free_again():
    motors = Motors(**I2T)
    motors.hold(4.0, 1.0)  # the continuous torque costs nothing
    assert (motors.available_Nm(), motors.state["effort_Nm2_s"][0]) == (10.0, 0.0)
    motors.until_limited(10.0, 9.9)
    motors.hold(4.0, 1.0)
    assert motors.available_Nm() == 4.0
    free_s = 0.1 * 0.5 * (10.0**2 - 4.0**2) / 4.0**2
    motors.hold(0.0, free_s - 2 * TICK_S)
    assert motors.available_Nm() == 4.0
    motors.hold(0.0, 4 * TICK_S)
    assert motors.available_Nm() == 10.0


HEAT = {
    "winding_rise_K": [300.0, 0.0],
    "winding_time_s": [0.2, 1.0],
    "housing_rise_K": [60.0, 0.0],
    "housing_time_s": [3.0, 1.0],
}


@pytest.mark.parametrize("torque_Nm", [-6.0])
def test_the_winding_warms_with_two_time_constants(torque_Nm):
    motors = Motors(**HEAT, ambient_C=[30.0, 30.0])
    share = (torque_Nm / 12.0) ** 2
    for time_s in (0.1, 0.2, 0.5, 1.0, 2.0):
        motors.hold(torque_Nm, time_s)
    expected_C = 30.0 - share * (300.0 * math.expm1(-3.8 / 0.2) + 60.0 * math.expm1(-3.8 / 3.0))
    assert motors.temperature_C() == pytest.approx(expected_C, rel=1e-9)
    assert motors.temperature_C(1) == 30.0


def test_the_torque_that_heats_is_that_of_the_current():
    """A motor of 10 % more torque constant needs less current for its torque."""
    plain, strong = Motors(**HEAT), Motors(**HEAT, torque_constant_error=[0.1, 0.0])
    plain.hold(6.0, 0.3)
    strong.hold(6.6, 0.3)
    assert strong.temperature_C() == pytest.approx(plain.temperature_C(), rel=1e-12)


@pytest.mark.parametrize(
    ("preheat_K", "available_Nm"), [(84.9, 12.0), (85.0, 12.0), (92.5, 9.0), (100.0, 6.0), (115.0, 0.0), (150.0, 0.0)]
)
def test_the_torque_falls_in_a_line_from_the_derating_start_to_nothing(preheat_K, available_Nm):
    assert Motors(preheat_K=[preheat_K, 0.0]).available_Nm() == pytest.approx(available_Nm, abs=1e-12)


def test_overheating_lasts_until_the_winding_is_below_the_derating_start():
    motors = Motors(winding_rise_K=[300.0, 0.0], winding_time_s=[0.2, 1.0])
    motors.hold(12.0, 0.2 * math.log(300.0 / 195.0) - 2 * TICK_S)  # 130 °C
    assert motors.error() == 0
    motors.hold(12.0, 4 * TICK_S)
    assert motors.error() == EXCESS_TEMPERATURE
    motors.hold(0.0, 0.2 * math.log(105.0 / 85.0) - 10 * TICK_S)
    assert motors.error() == EXCESS_TEMPERATURE
    motors.hold(0.0, 20 * TICK_S)
    assert motors.error() == 0


@pytest.mark.parametrize(("reaction", "code"), [("limit", 0), ("fault", OVER_CURRENT)])
def test_i2t_limits_or_faults_as_the_scenario_says(reaction, code):
    motors = Motors(**I2T, i2t_reaction=reaction)
    motors.hold(10.0, 0.49)
    assert motors.error() == 0
    motors.hold(10.0, 0.02)
    assert motors.error() == code


def make_host(**drives) -> BenchHost:
    return moving_host(times=0, profile="S", drives=drives)


OVERHEATING = {"winding_rise_K": [400.0, 0.0], "winding_time_s": [0.05, 1.0], "overheat_C": [120.0, 130.0]}


def test_the_statusword_says_that_a_limit_is_active():
    host = make_host(peak_torque_Nm=[6.0, 0.0])
    words = []
    for target in (500, 501, 700, 500, 300):
        host.step(Word.ENABLE, target, joints=(1,))
        host.step(Word.ENABLE, target, joints=(1,))
        words.append(bool(host.statusword() & INTERNAL_LIMIT))
    assert words == [False, True, True, False, False]
    assert not host.statusword(2) & INTERNAL_LIMIT


def test_an_overheated_motor_faults_its_drive_and_no_other_until_it_has_cooled_and_is_reset():
    host = make_host(**OVERHEATING)
    syncs = 0
    while not host.statusword() & 0x08:
        host.step(Word.ENABLE, 1000, joints=(1,))
        host.command(Word.ENABLE, 0, joints=(2,))
        syncs += 1
    # 25 + 400 (1 − exp(−t / 50 ms)) = 110 after 12 ms, then ever slower
    assert 12 < syncs < 60
    frames = host.take()
    assert (host.read(1, 0x603F), host.read(1, 0x1001)) == (EXCESS_TEMPERATURE, 0x09)
    emergencies = [struct.unpack("<HBBI", data)[:3] for can_id, data in frames if can_id == 0x081]
    assert emergencies == [(EXCESS_TEMPERATURE, 0x09, 0)]
    assert [data for can_id, data in frames if can_id == 0x082] == []
    statuses = [struct.unpack("<HbhH", data) for can_id, data in frames if can_id == 0x281]
    assert statuses[-1][3] == EXCESS_TEMPERATURE
    assert host.state_bits(2) == State.ENABLED
    host.step(Word.ENABLE, times=400)
    assert (host.state_bits(), host.read(1, 0x603F)) == (State.FAULT, EXCESS_TEMPERATURE)
    host.step(Word.FAULT_RESET)
    assert (host.state_bits(), host.read(1, 0x603F), host.read(1, 0x1001)) == (State.DISABLED, 0, 0)


def test_an_overheat_fault_is_not_reset_while_the_motor_is_hot():
    """0x605E is 2: braking ends before a motor with 2 s of time constant has cooled."""
    host = make_host(preheat_K=[106.0, 0.0], housing_time_s=[2.0, 1.0])
    while host.state_bits() != State.FAULT:
        host.step(Word.ENABLE)
    for controlword in (Word.FAULT_RESET, Word.ENABLE, Word.FAULT_RESET):
        host.step(controlword)
        assert host.state_bits() == State.FAULT
    # 25 + 106 exp(−t / 2 s) = 110
    host.step(Word.ENABLE, times=round(1e3 * 2.0 * math.log(106.0 / 85.0)))
    host.step(Word.FAULT_RESET)
    assert host.state_bits() == State.DISABLED
