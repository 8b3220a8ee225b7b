"""The imperfect torque sensor against closed forms, from its spring to the frame on the bus."""

import math

import numpy as np
import pytest
from bench_host import BenchHost, quiet_scenario
from general_arm import OFF
from scipy import signal

from adacd_hil.settings.parsing import parse
from firmware_sim.arm.hardware_settings import SensorSettings
from firmware_sim.arm.sensing import TORQUE_LSB_NM, TorqueNoise
from firmware_sim.arm.touch_settings import TICK_S
from firmware_sim.body.body import Body
from firmware_sim.body.sensors import (
    TRANSDUCER_STATE,
    converter_ends,
    sample_torque,
    sense_torque,
    transducer_numbers,
    transducer_state,
    walk_offset,
)
from firmware_sim.scenario.scenario import Scenario


class Sensors:
    """Both torque sensors on a bench of their own: loads in, counts out."""

    def __init__(self, offset_Nm=(0.0, 0.0), **settings) -> None:
        self.numbers = transducer_numbers(parse(SensorSettings, settings), offset_Nm)
        self.state = transducer_state(self.numbers)
        self.tick = 0
        self.tau_Nm = (0.0, 0.0)

    def load(self, tau1_Nm: float, tau2_Nm: float = 0.0) -> None:
        """Go on by a tick that ends with this load."""
        sense_torque(self.numbers, self.state, 0, float(self.tick), tau1_Nm, tau2_Nm, 25.0)
        sense_torque(self.numbers, self.state, 1, float(self.tick), tau2_Nm, tau1_Nm, 25.0)
        self.tau_Nm = (tau1_Nm, tau2_Nm)
        self.tick += 1

    def ramp(self, to_Nm: float, ticks: int = 40) -> float:
        """Load joint 1 steadily up or down to `to_Nm`; return what comes out of the spring then."""
        for load_Nm in np.linspace(self.tau_Nm[0], to_Nm, ticks + 1)[1:]:
            self.load(load_Nm)
        return self.state["shaped_Nm"][0]

    def counts(self, joint: int = 0, temperature_C: float = 25.0, noise_Nm: float = 0.0) -> int:
        own, other = self.tau_Nm[joint], self.tau_Nm[1 - joint]
        return sample_torque(
            self.numbers, self.state, joint, float(self.tick), own, other, temperature_C, noise_Nm
        )  # fmt: skip

    def measure(self, joint: int = 0, **changes) -> float:
        return self.counts(joint, **changes) * TORQUE_LSB_NM


def test_gain_error_and_cross_talk_are_a_matrix_on_the_joint_torques():
    sensors = Sensors(gain_error=[0.02, -0.03], cross_talk=[0.01, -0.004])
    matrix = np.array([[1.02, 0.01], [-0.004, 0.97]])
    for tau_Nm in np.random.default_rng(4).normal(0.0, 8.0, (200, 2)):
        sensors.tau_Nm = tuple(tau_Nm)
        expected = matrix @ tau_Nm
        assert sensors.measure(0) == pytest.approx(expected[0], abs=0.51 * TORQUE_LSB_NM)
        assert sensors.measure(1) == pytest.approx(expected[1], abs=0.51 * TORQUE_LSB_NM)


def test_a_warm_joint_shifts_the_zero_and_the_sensitivity():
    sensors = Sensors(offset_drift_Nm_K=[0.01, 0.0], gain_drift_1_K=[0.0, -0.001])
    sensors.tau_Nm = (10.0, 10.0)
    assert sensors.measure(0, temperature_C=45.0) == pytest.approx(10.2, abs=TORQUE_LSB_NM)
    assert sensors.measure(1, temperature_C=45.0) == pytest.approx(9.8, abs=TORQUE_LSB_NM)
    assert sensors.measure(0) == pytest.approx(10.0, abs=TORQUE_LSB_NM)


def test_the_zero_drifts_at_its_slope_from_power_on():
    body = Body(parse(Scenario, {"noise": False, "sensors": {"offset_drift_Nm_s": [0.5, -2.0]}}))
    measured = [body.sample().torque_counts]
    for _ in range(10):
        body.advance((0.0, 0.0), OFF, 1000)
        measured.append(body.sample().torque_counts)
    slopes = np.polyfit(np.arange(11) * 0.1, np.array(measured) * TORQUE_LSB_NM, 1)[0]
    assert slopes == pytest.approx([0.5, -2.0], abs=2e-3)
    assert measured[0] == (0, 0)


@pytest.mark.parametrize("is_regular", [True, False])
def test_the_zero_walks_with_the_variance_of_its_time(is_regular):
    ends = []
    for seed in range(200):
        steps = TorqueNoise(np.random.SeedSequence(seed, spawn_key=(1,)), (0.1, 0.3))
        state = np.zeros(1, TRANSDUCER_STATE)[0]
        ticks = np.linspace(0, 5_000, 51) if is_regular else np.array([0, 0, 7, 800, 801, 4_000, 5_000])
        for tick in ticks:
            walk_offset(state, float(tick), steps.draw())
        ends.append(state["walk_Nm"].copy())
    # after half a second; the rms of 400 values is known within 3.5 %
    assert np.std(ends, axis=0) == pytest.approx([0.1 * math.sqrt(0.5), 0.3 * math.sqrt(0.5)], rel=0.17)
    assert np.abs(np.corrcoef(np.array(ends).T)[0, 1]) < 0.2


LOOP = {"hysteresis_Nm": [0.4, 0.0], "hysteresis_reach_Nm": [4.0, 4.0]}


@pytest.mark.parametrize("at_Nm", [-5.0, 0.0, 3.0])
def test_the_branches_of_the_hysteresis_lie_a_width_apart(at_Nm):
    sensors = Sensors(**LOOP)
    sensors.ramp(-20.0)
    rising = sensors.ramp(at_Nm)
    sensors.ramp(20.0)
    falling = sensors.ramp(at_Nm)
    assert rising == pytest.approx(at_Nm - 0.2, abs=1e-12)
    assert falling == pytest.approx(at_Nm + 0.2, abs=1e-12)


def test_the_hysteresis_returns_to_the_point_where_it_turned():
    """A closed inner loop is wiped out: what follows is as if it had not been."""
    with_loop, without = Sensors(**LOOP), Sensors(**LOOP)
    for sensors in (with_loop, without):
        sensors.ramp(-20.0)
        sensors.ramp(2.0)
    turned = with_loop.state["shaped_Nm"][0]
    inner = with_loop.ramp(0.5)
    returned = with_loop.ramp(2.0)
    assert inner > 0.5 - 0.2 + 0.02
    assert returned == pytest.approx(turned, abs=1e-12)
    assert with_loop.ramp(3.0) == pytest.approx(without.ramp(3.0), abs=1e-12)
    assert with_loop.ramp(-1.0) == pytest.approx(without.ramp(-1.0), abs=1e-12)


def test_the_amplifier_is_a_first_order_low_pass():
    sensors = Sensors(torque_bandwidth_Hz=[80.0, 0.0])
    loads = np.random.default_rng(5).normal(0.0, 5.0, 200)
    loads[0] = 0.0
    outputs = [0.0]
    for load_Nm in loads[1:]:
        sensors.load(load_Nm)
        outputs.append(sensors.state["amplified_Nm"][0])
    omega = 2.0 * math.pi * 80.0
    _, expected, _ = signal.lsim(signal.lti([omega], [1.0, omega]), loads, np.arange(200) * TICK_S, interp=True)
    assert np.allclose(outputs, expected, rtol=0.0, atol=1e-9)


def test_a_sensor_with_fewer_bits_gives_the_steps_of_its_own_converter():
    sensors = Sensors(torque_range_Nm=[20.0, 50.0], torque_bits=[10, 16])
    step_Nm = 40.0 / 1024
    values = []
    for tau_Nm in np.linspace(-1.0, 1.0, 4_001):
        sensors.tau_Nm = (tau_Nm, 0.0)
        values.append(sensors.measure())
        assert values[-1] == pytest.approx(round(tau_Nm / step_Nm) * step_Nm, abs=0.51 * TORQUE_LSB_NM + 5e-4 * step_Nm)
    assert np.unique(values).size == 53
    assert np.diff(np.unique(values)) == pytest.approx(np.full(52, step_Nm), abs=1.01 * TORQUE_LSB_NM)


@pytest.mark.parametrize(
    ("range_Nm", "bits", "ends"),
    [
        (50.0, 16, (-32768, 32767)),
        (50.0, 24, (-32768, 32767)),
        (25.0, 16, (-16384, 16384)),
        (25.0, 4, (-16384, 14336)),
        (20.0, 12, (-13107, 13101)),
    ],
)
def test_a_reduced_range_ends_where_its_converter_ends(range_Nm, bits, ends):
    settings = SensorSettings(torque_range_Nm=(range_Nm, 50.0), torque_bits=(bits, 16))
    assert converter_ends(settings, 0) == ends
    assert converter_ends(settings, 1) == (-32768, 32767)


CLOCK_HZ, CLOCK_PPM, CLOCK_PHASE = 1234.5, 80.0, 0.3


def test_an_own_clock_samples_at_its_own_instants_within_the_tick():
    clock = {"sample_rate_Hz": [CLOCK_HZ, 0.0], "clock_error_ppm": [CLOCK_PPM, 0.0], "clock_phase": [CLOCK_PHASE, 0.0]}
    sensors = Sensors(**clock)
    rate_Hz = CLOCK_HZ * (1.0 + CLOCK_PPM * 1e-6)
    ages_s = []
    for tick in range(1, 20_001):
        sensors.load(20.0 * tick * TICK_S)  # the load tells the time
        if tick % 10 == 0 and tick > 20:
            sampled_s = sensors.state["held_Nm"][0] / 20.0
            assert sampled_s == pytest.approx((sensors.state["index"][0] + CLOCK_PHASE) / rate_Hz, abs=1e-9)
            ages_s.append(tick * TICK_S - sampled_s)
    assert min(ages_s) > -1e-9
    assert max(ages_s) < 1.0 / rate_Hz + 1e-9
    # the clock is not in step with SYNC, so every age within a sample period is equally likely
    shares = np.histogram(ages_s, 10, (0.0, 1.0 / rate_Hz))[0] / len(ages_s)
    assert shares == pytest.approx(np.full(10, 0.1), abs=0.01)


def test_a_frame_without_a_new_sample_repeats_the_old_one_with_its_noise():
    body = Body(parse(Scenario, {"sensors": {"sample_rate_Hz": [500.0, 0.0], "clock_phase": [0.25, 0.0]}}))
    torques = []
    for _ in range(400):
        body.advance((0.0, 0.0), OFF)
        torques.append(body.sample().torque_counts)
    own, at_sync = np.array(torques).T
    assert np.array_equal(own[0::2], own[1::2])
    assert np.count_nonzero(np.diff(own[0::2])) > 150
    assert np.count_nonzero(np.diff(at_sync)) > 300


@pytest.mark.parametrize(("temperature_C", "centidegrees"), [(41.237, 4124), (-10.0, -1000)])
def test_a_sensor_tells_the_temperature_of_its_joint(temperature_C, centidegrees):
    assert BenchHost(quiet_scenario(mechanics={"ambient_C": temperature_C})).read(3, 0x2111) == centidegrees
