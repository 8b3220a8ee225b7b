"""Sections `[sensors]` and `[drives]`: what is refused, what their absence means, and that runs repeat."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from general_arm import TORQUE

from adacd_hil.log.types.truth_topic import TRUTH_LAYOUT
from adacd_hil.settings.parsing import parse
from firmware_sim.arm.sensing import (
    DriveMode,
)
from firmware_sim.body.body import Body
from firmware_sim.scenario.scenario import Scenario

EVERY_SENSOR_ERROR = {
    "offset_drift_Nm_s": [0.1, -0.1],
    "offset_walk_Nm_rs": [0.1, 0.2],
    "offset_drift_Nm_K": [0.01, 0.01],
    "gain_error": [0.02, -0.01],
    "gain_drift_1_K": [1e-4, 1e-4],
    "cross_talk": [0.01, -0.02],
    "hysteresis_Nm": [0.2, 0.1],
    "torque_bandwidth_Hz": [300.0, 0.0],
    "torque_noise_Nm": [0.01, 0.03],
    "torque_range_Nm": [30.0, 20.0],
    "torque_bits": [14, 18],
    "sample_rate_Hz": [1500.0, 700.0],
    "clock_error_ppm": [50.0, -50.0],
    "clock_phase": [0.2, 0.9],
    "encoder_bits": [16, 22],
    "encoder_noise_counts": [1.0, 2.0],
    "index_error_rad": [0.01, -0.01],
    "eccentricity_rad": [1e-3, 0.0],
    "ellipticity_rad": [0.0, 1e-3],
}
EVERY_DRIVE_ERROR = {
    "current_loop_Hz": [300.0, 1500.0],
    "velocity_loop_Hz": [100.0, 300.0],
    "torque_constant_error": [0.03, -0.03],
    "torque_offset_Nm": [0.05, 0.02],
    "peak_torque_Nm": [9.0, 5.0],
    "continuous_torque_Nm": [0.5, 0.1],
    "peak_time_s": [0.01, 0.01],
    "winding_rise_K": [100.0, 100.0],
    "housing_rise_K": [30.0, 30.0],
    "preheat_K": [80.0, 90.0],
}


def run(seed: int, cycles: int = 150, **changes) -> np.ndarray:
    """Give what is measured, true and believed over a run with commands given in advance, one row per cycle."""
    body = Body(parse(Scenario, {"profile": "M", "seed": seed, **changes}))
    body.start_scenario()
    block = np.zeros(TRUTH_LAYOUT.size)
    rows = []
    for cycle in range(cycles):
        measured = body.sample()
        body.truth(block)
        believed = (*body.motor_torque_Nm, *body.drive_velocity_rad_s)
        rows.append(np.concatenate([*measured, block, believed]))
        body.advance((2.0 * np.sin(0.03 * cycle), 0.9 * np.cos(0.05 * cycle)), TORQUE)
    return np.array(rows)


def run_with_everything(seed: int, cycles: int = 150) -> np.ndarray:
    return run(seed, cycles, sensors=EVERY_SENSOR_ERROR, drives=EVERY_DRIVE_ERROR)


@pytest.mark.parametrize(
    ("sensors", "changed"),
    [({"offset_walk_Nm_rs": [0.5, 0.0]}, {4}), ({"encoder_noise_counts": [0.0, 5.0]}, {1, 3})],
)
def test_chance_of_one_error_leaves_all_other_numbers_alone_to_the_bit(sensors, changed):
    """Columns 0 to 5: position, velocity and torque of both joints. The arm itself has no feedback here."""
    plain, erroneous = run(4), run(4, sensors=sensors)
    differing = {column for column in range(6 + TRUTH_LAYOUT.size) if np.any(plain[:, column] != erroneous[:, column])}
    assert differing == changed


CHANCE = {
    "walk": {"offset_walk_Nm_rs": [10.0, 0.0], "torque_noise_Nm": [0.0, 0.0]},
    "torque": {"torque_noise_Nm": [0.1, 0.0]},
    "encoder": {"encoder_noise_counts": [1000.0, 0.0], "torque_noise_Nm": [0.0, 0.0]},
}


def chance(source: str) -> np.ndarray:
    """Give what one source of chance adds at each tick to the measurements of a resting joint 1."""
    body = Body(parse(Scenario, {"seed": 2, "sensors": CHANCE[source]}))
    rows = []
    for _ in range(1_000):
        measured = body.sample()
        rows.append(measured.position_counts[0] if source == "encoder" else measured.torque_counts[0])
        body.advance((0.0, 0.0), (DriveMode.OFF, DriveMode.OFF), 1)
    return np.diff(rows, prepend=0) if source == "walk" else np.array(rows)


@pytest.mark.parametrize("pair", [("walk", "torque"), ("walk", "encoder"), ("torque", "encoder")])
def test_sources_of_chance_have_nothing_in_common(pair):
    first, second = chance(pair[0])[5:-5], chance(pair[1])
    for shift in range(11):
        correlation = np.corrcoef(first, second[shift : shift + first.size])[0, 1]
        assert abs(correlation) < 0.13  # four times the rms of that of 990 independent pairs


def test_a_run_with_every_error_repeats_with_its_seed_and_not_with_another():
    first = run_with_everything(9).tobytes()
    assert first == run_with_everything(9).tobytes()
    assert first != run_with_everything(10).tobytes()


@pytest.mark.long
@pytest.mark.slow
def test_the_interpreted_errors_are_those_of_the_compiled_ones():
    script = (
        "import sys\n"
        f"sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "import test_sensor_settings\n"
        "sys.stdout.buffer.write(test_sensor_settings.run_with_everything(9, 60).tobytes())\n"
    )
    results = []
    for is_disabled in ("0", "1"):
        environment = {**os.environ, "NUMBA_DISABLE_JIT": is_disabled}
        finished = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, check=True)
        results.append(np.frombuffer(finished.stdout))
    assert results[0].size == 60 * (10 + TRUTH_LAYOUT.size)
    assert np.allclose(results[0], results[1], rtol=1e-9, atol=1e-9)
