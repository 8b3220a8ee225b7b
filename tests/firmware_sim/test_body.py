"""The emulated arm as the device nodes see it: timing, measurements, truth, braking, determinism."""

import dataclasses
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from adacd_hil.records import TRUTH_LAYOUT
from adacd_hil.settings.schema import parse
from firmware_sim.arm.arms import ARMS
from firmware_sim.arm.sensing import TORQUE_LSB_NM, DriveMode
from firmware_sim.arm.touch_settings import ContactSettings
from firmware_sim.body.body import Body
from firmware_sim.scenario.scenario import PayloadSettings, Scenario, load_scenario

TORQUE = (DriveMode.TORQUE, DriveMode.TORQUE)
OFF = (DriveMode.OFF, DriveMode.OFF)
BRAKE = (DriveMode.BRAKE, DriveMode.BRAKE)
GAINS = {"P": 1.0, "S": 2.0, "M": 2.0}


class Truth:
    """Names the fields of one truth block."""

    def __init__(self, body: Body) -> None:
        self.block = np.full(TRUTH_LAYOUT.size, np.nan)
        body.truth(self.block)
        assert np.isfinite(self.block).all()

    def __getattr__(self, name: str) -> np.ndarray:
        values = self.block[TRUTH_LAYOUT.slices[name]]
        return values if values.size > 1 else values[0]


def step(at_s: float, **changes) -> ContactSettings:
    values = {"at_s": at_s, "link": 1, "point_m": 0.25, "force_N": 20.0, "duration_s": 0.05} | changes
    return ContactSettings(**values)


def paper_motion(time_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Desired position and velocity of the paper's motion as printed, from the corner (-30, -60) degrees."""
    amplitude, half_s = np.radians([30.0, 60.0]), np.array([1.125, 4.5])
    count, phase = np.divmod(time_s / half_s, 1.0)
    way = np.where(count % 2 == 0, 1.0, -1.0)
    position = way * amplitude * (2.0 * phase**3 * (10.0 - 15.0 * phase + 6.0 * phase**2) - 1.0)
    return position, way * amplitude * 60.0 * phase**2 * (1.0 - phase) ** 2 / half_s


def follow(body: Body, profile: str, cycles: int, first: int = 0) -> None:
    """Play a host: joint PD along the paper's motion, commands one cycle late."""
    stiffness, damping = GAINS[profile] * np.array([250.0, 20.0]), GAINS[profile] * np.array([12.5, 0.75])
    latched = np.zeros(2)
    for cycle in range(first, first + cycles):
        measured = body.sample()
        q_d, dq_d = paper_motion(cycle * 1e-3)
        body.advance(latched, TORQUE)
        latched = np.clip(stiffness * (q_d - measured.q) + damping * (dq_d - measured.dq), [-12, -6], [12, 6])


def test_an_arm_at_power_on_rests_in_its_start_pose():
    body = Body(dataclasses.replace(load_scenario("idle"), noise=False))
    measured = body.sample()
    assert measured.q == pytest.approx(np.radians([-30, -60]), abs=3e-6)
    assert measured.dq.tolist() == [0.0, 0.0]
    assert measured.tau_J.tolist() == [0.0, 0.0]
    for _ in range(50):
        body.advance((0.0, 0.0), OFF)
        assert body.sample() == measured
    assert Truth(body).dq.tolist() == [0.0, 0.0]


def test_a_positive_set_point_moves_its_joint_forward():
    for joint in range(2):
        body = Body(load_scenario("idle"))
        setpoint = [0.0, 0.0]
        setpoint[joint] = 1.0
        for _ in range(50):
            body.advance(setpoint, TORQUE)
        assert Truth(body).dq[joint] > 0.1
        assert body.sample().dq[joint] > 0.1


def test_the_set_point_is_within_99_8_percent_after_one_millisecond():
    body = Body(load_scenario("idle"))
    body.advance((2.0, -1.0), TORQUE)
    assert body.motor_torque_Nm == pytest.approx((2.0, -1.0), rel=2e-3)
    assert Truth(body).tau_J == pytest.approx(body.motor_torque_Nm, rel=1e-15)


def test_a_drive_gives_no_more_than_its_rated_torque():
    body = Body(load_scenario("idle"))
    for _ in range(20):
        body.advance((20.0, -20.0), TORQUE)
    assert body.motor_torque_Nm == pytest.approx((12.0, -6.0), rel=1e-9)


def test_a_drive_that_is_off_gives_no_torque_whatever_the_set_point():
    body = Body(load_scenario("idle"))
    for _ in range(20):
        body.advance((5.0, 5.0), OFF)
    assert body.motor_torque_Nm == (0.0, 0.0)
    assert Truth(body).dq.tolist() == [0.0, 0.0]


def test_the_modes_of_the_two_drives_are_independent():
    body = Body(load_scenario("idle"))
    body.advance((1.0, 1.0), (DriveMode.OFF, DriveMode.TORQUE))
    assert body.motor_torque_Nm == pytest.approx((0.0, 1.0), rel=2e-3)


@pytest.mark.parametrize("profile", ARMS)
@pytest.mark.parametrize("payload_kg", [0.0, 1.0])
@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_braking_drive_brings_every_arm_to_rest(profile, payload_kg, way):
    body = Body(Scenario(profile=profile, payload_kg=payload_kg, start_deg=(0.0, 40.0)))
    while abs(Truth(body).dq[0]) < 2.5:
        body.advance((12.0, 3.0 * way), TORQUE)
    fastest = np.abs(Truth(body).dq).max()
    for _ in range(500):
        body.advance((12.0, 3.0), BRAKE)
        truth = Truth(body)
        assert np.abs(truth.dq).max() < 1.05 * fastest
        assert np.all(np.abs(truth.tau_J) <= [12.0 + 1e-9, 6.0 + 1e-9])
    assert np.abs(Truth(body).dq).max() < 0.02
    for _ in range(300):
        body.advance((12.0, 3.0), BRAKE)
    rest = Truth(body)
    assert rest.dq.tolist() == [0.0, 0.0]


def test_the_measured_velocity_lags_by_1_59_ms_while_the_arm_accelerates():
    body = Body(Scenario(profile="S", noise=False))
    true, measured = [], []
    for _ in range(60):
        body.advance((8.0, 0.0), TORQUE)
        true.append(Truth(body).dq[0])
        measured.append(body.sample().dq[0])
    assert true[-1] - true[-2] > 1e-3
    # when the true velocity was what is measured now
    lags_ms = np.arange(40, 60) - np.interp(measured[40:], true, np.arange(60))
    assert lags_ms.mean() == pytest.approx(1.59, abs=0.01)


def test_measured_torque_is_true_torque_with_20_mnm_of_noise():
    body = Body(load_scenario("idle", seed=5))
    for _ in range(20):
        body.advance((0.01, -0.01), TORQUE)
    samples = np.array([body.sample().tau_J for _ in range(10_000)])
    assert samples.mean(axis=0) == pytest.approx([0.01, -0.01], abs=1e-3)
    assert samples.std(axis=0) == pytest.approx([0.02, 0.02], rel=0.03)
    assert np.unique(np.round(samples / TORQUE_LSB_NM, 6) % 1.0).tolist() == [0.0]


def test_torque_beyond_the_sensor_saturates_and_says_so():
    body = Body(dataclasses.replace(load_scenario("idle"), torque_offset_Nm=(50.0, -49.0), noise=False))
    body.advance((1.0, -6.0), TORQUE)
    measured = body.sample()
    assert measured.torque_counts == (32767, -32768)
    assert body.torque_ends == ((-32768, 32767), (-32768, 32767))


def test_a_sensor_offset_is_measured_and_not_true():
    body = Body(dataclasses.replace(load_scenario("idle"), torque_offset_Nm=(0.5, -0.25), noise=False))
    assert body.sample().tau_J == pytest.approx([0.5, -0.25], abs=TORQUE_LSB_NM)
    assert Truth(body).tau_J.tolist() == [0.0, 0.0]


def test_nobody_comes_before_the_drives_are_enabled():
    scenario = Scenario(contacts=(step(0.0),), payloads=(PayloadSettings(0.0, 1.0),))
    body = Body(scenario)
    for _ in range(20):
        body.advance((0.0, 0.0), OFF)
    truth = Truth(body)
    assert (truth.contact_force, truth.contact_index, truth.payload) == (0.0, -1.0, 0.0)
    assert (body.is_started, body.scenario_time_s) == (False, 0.0)
    body.start_scenario()
    truth = Truth(body)
    assert (truth.contact_force, truth.contact_index, truth.payload) == (20.0, 0.0, 1.0)


@pytest.mark.parametrize("period_s", [0.5e-3, 1e-3, 2e-3, 4e-3])
def test_a_contact_acts_exactly_from_its_onset_to_its_end(period_s):
    """tau_J is known, so what the arm does in the last period before the onset and in the first after it tells."""
    body = Body(Scenario(contacts=(step(0.02), step(0.1, link=2, point_m=0.2, angle_deg=-90.0))), period_s)
    for _ in range(7):
        body.advance((0.0, 0.0), OFF)
    body.start_scenario()
    rows = []
    for _ in range(round(0.16 / period_s)):
        truth = Truth(body)
        rows.append((body.scenario_time_s, truth.contact_force, truth.contact_link, truth.contact_index, *truth.dq))
        body.advance((0.0, 0.0), OFF)
    for time_s, force_N, link, index, dq1, _ in rows:
        tick = round(time_s * 1e4)
        first, second = 200 <= tick < 700, 1000 <= tick < 1500
        assert force_N == (20.0 if first or second else 0.0)
        assert link == (1.0 if first else 2.0 if second else 0.0)
        assert index == (0.0 if first else 1.0 if second else -1.0)
        assert (dq1 != 0.0) == (tick > 200)


def test_the_arm_gains_the_momentum_that_the_truth_says():
    contact = step(0.01, link=2, point_m=0.2, duration_s=0.04, shape="half_sine")
    body = Body(Scenario(profile="M", start_deg=(10.0, 50.0), contacts=(contact,)), 1e-4)
    body.start_scenario()
    pushes, momenta = [], []
    for _ in range(600):
        truth = Truth(body)
        a1, a2, a3 = truth.theta[:3]
        cosine = math.cos(truth.q[1])
        momenta.append((a1 + 2.0 * a2 * cosine) * truth.dq[0] + (a3 + a2 * cosine) * truth.dq[1])
        pushes.append(truth.tau_J[0] + truth.tau_ext[0] - truth.tau_friction[0])
        body.advance((0.0, 0.0), TORQUE)
    gained = np.concatenate([[0.0], np.cumsum(np.add(pushes[1:], pushes[:-1]) * 0.5e-4)])
    assert max(momenta) > 0.15
    assert np.abs(gained - momenta).max() < 5e-5


def test_starting_twice_does_not_restart_the_scenario():
    body = Body(load_scenario("idle"))
    body.start_scenario()
    for _ in range(5):
        body.advance((0.0, 0.0), OFF)
    body.start_scenario()
    assert body.scenario_time_s == pytest.approx(0.005, abs=1e-12)


def test_truth_tells_the_torque_of_the_contact_and_the_friction_that_holds_against_it():
    scenario = Scenario(profile="M", contacts=(step(0.0, force_N=0.4, duration_s=1.0),))
    body = Body(scenario)
    body.start_scenario()
    for _ in range(20):
        body.advance((0.02, 0.03), TORQUE)
    truth = Truth(body)
    assert truth.dq.tolist() == [0.0, 0.0]
    assert truth.tau_ext == pytest.approx([0.1, 0.0], abs=1e-15)
    assert truth.tau_friction == pytest.approx([0.12, 0.03], rel=1e-9)


def test_truth_tells_the_friction_of_a_moving_arm():
    body = Body(Scenario(profile="M", start_deg=(0.0, 30.0)))
    for _ in range(60):
        body.advance((2.0, -1.0), TORQUE)
    truth = Truth(body)
    arm = ARMS["M"]
    expected = np.array(arm.viscous_Nm_s) * truth.dq + np.array(arm.coulomb_Nm) * np.sign(truth.dq)
    assert truth.tau_friction == pytest.approx(expected, rel=1e-12)
    assert np.abs(truth.dq).min() > 0.2


def test_truth_tells_the_parameters_with_payload():
    scenario = dataclasses.replace(
        load_scenario("idle"), payloads=(PayloadSettings(0.005, 1.0), PayloadSettings(0.008, 0.0))
    )
    body = Body(scenario)
    body.start_scenario()
    for cycle in range(12):
        payload_kg = 1.0 if 5 <= cycle < 8 else 0.0
        truth = Truth(body)
        assert truth.payload == payload_kg
        assert truth.theta == pytest.approx(ARMS["P"].theta(payload_kg), rel=1e-14)
        body.advance((0.0, 0.0), OFF)


def test_asking_for_the_truth_changes_nothing():
    ends = []
    for is_asked in (True, False):
        body = Body(load_scenario("paper", profile="M"))
        body.start_scenario()
        for cycle in range(200):
            if is_asked:
                Truth(body)
            body.advance((math.sin(0.02 * cycle), 0.3), TORQUE)
        ends.append((body.sample(), Truth(body).block.tobytes()))
    assert ends[0] == ends[1]


def run(seed: int | None, cycles: int = 300) -> bytes:
    body = Body(Scenario(profile="M", seed=3, contacts=(step(0.1),)), seed=seed)
    body.start_scenario()
    rows = []
    for cycle in range(cycles):
        measured = body.sample()
        truth = Truth(body).block
        rows.append(np.concatenate([*measured, truth]))
        body.advance((1.2 * math.sin(0.03 * cycle), 0.4 * math.cos(0.05 * cycle)), TORQUE)
    return np.array(rows).tobytes()


def test_the_same_seed_gives_the_same_run_to_the_bit():
    assert run(9) == run(9)
    assert run(None) == run(3)


def test_another_seed_gives_another_run():
    assert run(9) != run(10)


@pytest.mark.long
@pytest.mark.slow
def test_the_interpreted_arm_moves_like_the_compiled_one():
    script = (
        "import sys\n"
        f"sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "import test_body\n"
        "sys.stdout.buffer.write(test_body.run(9, 150))\n"
    )
    results = []
    for is_disabled in ("0", "1"):
        environment = {**os.environ, "NUMBA_DISABLE_JIT": is_disabled}
        finished = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, check=True)
        results.append(np.frombuffer(finished.stdout))
    assert results[0].size == 150 * (6 + TRUTH_LAYOUT.size)
    assert np.allclose(results[0], results[1], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("period_s", [0.0, 0.5e-4, 1.05e-3, -1e-3])
def test_a_period_off_the_drives_ticks_is_refused(period_s):
    with pytest.raises(ValueError, match=r"is no multiple of 0\.0001 s"):
        Body(load_scenario("idle"), period_s)


def test_two_half_periods_are_one_period():
    whole, halves = (Body(load_scenario("idle"), period_s) for period_s in (1e-3, 5e-4))
    for _ in range(100):
        whole.advance((0.7, -0.3), TORQUE)
        halves.advance((0.7, -0.3), TORQUE)
        halves.advance((0.7, -0.3), TORQUE)
    assert Truth(whole).block.tobytes() == Truth(halves).block.tobytes()


def test_arm_profiles_and_scenarios_share_their_names():
    for name in ARMS:
        assert parse(Scenario, {"profile": name}).arm.name == name


@pytest.mark.parametrize("profile", ARMS)
@pytest.mark.slow
def test_the_first_contact_of_the_paper_meets_a_moving_arm_and_stays_within_its_limits(profile):
    body = Body(load_scenario("paper", profile=profile))
    body.start_scenario()
    follow(body, profile, 9_999)
    before = Truth(body)
    assert (before.contact_force, before.contact_index) == (0.0, -1.0)
    assert np.all(np.abs(np.degrees(before.dq)) > 5.0)
    follow(body, profile, 1, first=9_999)
    onset = Truth(body)
    assert (onset.contact_force, onset.contact_link, onset.contact_index) == (20.0, 1.0, 0.0)
    assert onset.tau_ext == pytest.approx([5.0, 0.0], abs=1e-12)
    follow(body, profile, 400, first=10_000)
    assert np.all(np.abs(np.degrees(Truth(body).q)) < [75.0, 120.0])


@pytest.mark.parametrize("profile", ARMS)
def test_every_arm_follows_the_paper_motion_under_joint_pd(profile):
    body = Body(load_scenario("idle", profile=profile))
    body.start_scenario()
    follow(body, profile, 3_000)
    error_deg = np.degrees(Truth(body).q - paper_motion(3.0)[0])
    assert np.abs(error_deg).max() < 4.0
