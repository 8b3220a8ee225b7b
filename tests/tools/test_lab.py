"""tools/campaigns/lab.py: it plays the emulator itself, so a record is what the emulator measures, bit for bit."""

import lab
import numpy as np
import pytest
from lab import Push, profile_arm, random_moves, record

from adacd_hil.control.controller import fill_torque
from firmware_sim.arm.sensing import DriveMode
from firmware_sim.arm.touch_settings import ContactSettings
from firmware_sim.body.body import Body
from firmware_sim.scenario.scenario import Scenario

CYCLES = 150
PUSHED = slice(80, 120)


@pytest.fixture(autouse=True)
def uncompiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Play with the emulator's compiled functions from Python: the whole loop takes longer to compile than these."""
    monkeypatch.setattr(lab, "play_loop", getattr(lab.play_loop, "py_func", lab.play_loop))


def short_motion(seed: int = 5):
    return random_moves(seed, CYCLES * 1e-3)


def link1_push(torque_Nm: float) -> ContactSettings:
    return ContactSettings(at_s=0.08, link=1, point_m=0.25, force_N=torque_Nm / 0.25, duration_s=0.04)


def test_a_record_is_what_the_emulator_measures_under_the_same_host():
    arm, motion, contact = profile_arm("M", payload_kg=1.0), short_motion(), link1_push(2.0)
    recording = record(arm, motion, seed=7, contacts=(contact,))
    start_deg = np.degrees(motion.q_d[0])
    body = Body(Scenario(profile="M", seed=7, payload_kg=1.0, start_deg=tuple(start_deg), contacts=(contact,)))
    body.start_scenario()
    measured, command, tau_d = [], np.zeros(2), np.zeros(2)
    rated_Nm = np.array(arm.arm.rated_torque_Nm)
    for k in range(CYCLES):
        sample = body.sample()
        measured.append((sample.q, sample.dq, sample.tau_J))
        motion_d = motion.q_d[k], motion.dq_d[k], motion.ddq_d[k]
        fill_torque(sample.q, sample.dq, *motion_d, np.zeros(7), np.array(arm.Kp), np.array(arm.Kd), 0.0, tau_d)
        body.advance(command, (DriveMode.TORQUE, DriveMode.TORQUE))
        command = np.rint(tau_d / (1e-3 * rated_Nm)) * 1e-3 * rated_Nm
    q, dq, tau_J = (np.array(values) for values in zip(*measured, strict=True))
    assert np.abs(dq).max() > 0.05
    assert recording.q == pytest.approx(q, abs=1e-15)
    assert np.array_equal(recording.dq, dq)
    assert recording.tau_J == pytest.approx(tau_J, abs=0.6e-6)  # the wire's LSB is 1 µNm


def test_a_push_on_a_joint_is_the_force_that_has_its_torque():
    arm, motion = profile_arm("S"), short_motion()
    by_force = record(arm, motion, contacts=(link1_push(2.0),))
    by_torque = record(arm, motion, pushes=(Push(0.08, 0.04, (2.0, 0.0)),))
    assert by_torque.tau_ext == pytest.approx(by_force.tau_ext, abs=1e-12)
    assert by_force.tau_ext[PUSHED, 0] == pytest.approx(2.0)
    assert by_torque.q == pytest.approx(by_force.q, abs=6.1e-6)
    assert by_torque.tau_J == pytest.approx(by_force.tau_J, abs=2e-3)
