"""The imperfect encoder against closed forms, alone and in the arm."""

import math

import numpy as np
import pytest
from general_arm import BRAKE, OFF, TORQUE, truth_of

from adacd_hil.settings.parsing import parse
from firmware_sim.arm.hardware_settings import SensorSettings
from firmware_sim.arm.sensing import POSITION_LSB_RAD
from firmware_sim.body.body import Body
from firmware_sim.body.sensors import NOISE_TICKS, encoder_numbers, read_angle
from firmware_sim.scenario.scenario import Scenario


def errors_over_a_turn(joint: int, count: int = 4096, **settings) -> np.ndarray:
    """Give reading less true angle (count,) over one revolution, rad."""
    numbers = encoder_numbers(parse(SensorSettings, settings))
    angles = np.arange(count) * 2.0 * math.pi / count
    return np.array([read_angle(numbers, joint, angle, 0.0) - angle for angle in angles])


def arm(noise: bool = True, **sensors) -> Body:
    return Body(parse(Scenario, {"profile": "S", "noise": noise, "sensors": sensors}))


@pytest.mark.parametrize(("error", "joint", "times"), [("eccentricity", 0, 1), ("ellipticity", 1, 2)])
def test_an_eccentric_disc_errs_once_and_an_elliptic_one_twice_per_revolution(error, joint, times):
    of_joint = np.eye(2)[joint]
    settings = {f"{error}_rad": (2e-3 * of_joint).tolist(), f"{error}_phase_rad": (0.7 * of_joint).tolist()}
    own, other = (errors_over_a_turn(place, encoder_bits=[24, 24], **settings) for place in (joint, 1 - joint))
    harmonics = np.fft.rfft(own) / 2048
    assert abs(harmonics[times]) == pytest.approx(2e-3, abs=1e-7)
    assert np.angle(harmonics[times]) == pytest.approx(0.7 - math.pi / 2, abs=1e-4)
    assert np.abs(np.delete(harmonics, times)).max() < 1e-7
    assert np.abs(other).max() < 4e-7


@pytest.mark.parametrize("bits", [8, 12, 17, 20])
def test_a_coarser_encoder_steps_in_whole_counts_of_the_wire(bits):
    body = arm(noise=False, encoder_bits=[bits, 20])
    positions = []
    for _ in range(120):
        body.advance((4.0, 0.0), TORQUE)
        positions.append(body.sample().position_counts[0])
    assert {position % (1 << (20 - bits)) for position in positions} == {0}
    assert positions[-1] > 1 << 14
    assert np.abs(errors_over_a_turn(0, 4099, encoder_bits=[bits, 20])).max() <= math.pi / (1 << bits) * (1 + 1e-9)


def test_an_index_error_shifts_the_position_from_power_on_and_gives_no_velocity():
    body = arm(noise=False, index_error_rad=[0.01, -0.02], eccentricity_rad=[1e-3, 1e-3])
    first = body.sample()
    assert np.array(first.position_counts) * POSITION_LSB_RAD == pytest.approx([0.01, -0.02], abs=3.1e-6)
    for _ in range(20):
        body.advance((0.0, 0.0), OFF)
        assert body.sample() == first
    assert first.velocity_counts == (0, 0)


def test_the_noise_has_its_rms_in_the_encoders_own_counts():
    body = arm(encoder_bits=[16, 20], encoder_noise_counts=[3.0, 8.0])
    rows = []
    for _ in range(6_000):
        body.advance((0.0, 0.0), OFF, 1)
        rows.append(body.sample().position_counts)
    deviations = np.array(rows).std(axis=0)
    # rounding adds a twelfth of a count squared
    assert deviations[0] / 16 == pytest.approx(math.sqrt(9.0 + 1 / 12), rel=0.03)
    assert deviations[1] == pytest.approx(math.sqrt(64.0 + 1 / 12), rel=0.03)
    assert abs(np.corrcoef(np.array(rows).T)[0, 1]) < 0.05


@pytest.mark.parametrize("ticks", [1, NOISE_TICKS - 1, NOISE_TICKS + 1, 257])
def test_encoder_noise_does_not_depend_on_how_the_ticks_are_asked_for(ticks):
    """A braking drive answers the noise of its velocity with torque, so the arm remembers all of it."""
    blocks = []
    for step in (1_500, ticks):
        body = arm(encoder_noise_counts=[20.0, 20.0])
        for first in range(0, 1_500, step):
            body.advance((0.0, 0.0), BRAKE, min(step, 1_500 - first))
        blocks.append(truth_of(body))
    assert blocks[0]["q"].all()
    assert list(map(bytes, blocks[0].values())) == list(map(bytes, blocks[1].values()))
