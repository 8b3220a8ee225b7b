"""The gear between motor and sensor: spring, rotor, backlash, ripple, and friction that the sensor does not see."""

import math

import numpy as np
import pytest
from general_arm import TORQUE, GeneralArm, one_joint, truth_of, without_friction

from firmware_sim.arm.arms import ARMS
from firmware_sim.arm.hardware_settings import MechanicsSettings
from firmware_sim.arm.joint_forces import spring_torque
from firmware_sim.arm.plant import mass_matrix
from firmware_sim.arm.sensing import POSITION_LSB_RAD
from firmware_sim.arm.touch_settings import ContactSettings, contact_table
from firmware_sim.body.body import Body
from firmware_sim.scenario.scenario import Scenario


def test_a_rotor_of_the_elbow_does_not_turn_the_shoulder():
    """Kinetic energy of a geared rotor is J dq² / 2 of its own joint: no coupling term."""
    driven = GeneralArm(without_friction(), MechanicsSettings(rotor_inertia_kg_m2=(0.0, 0.4)))
    driven.run(1)
    m11, m12, m22 = mass_matrix(driven.state, 0.0)
    bare11, bare12, bare22 = mass_matrix(GeneralArm(without_friction(), MechanicsSettings()).state, 0.0)
    assert (m11, m12) == (bare11, bare12)
    assert m22 == pytest.approx(bare22 + 0.4, rel=1e-14)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_motor_holds_below_its_own_friction_and_the_sensor_sees_the_load(way):
    """A push on the link twists the spring against a motor that friction holds."""
    arm, _ = one_joint()
    settings = MechanicsSettings(
        rotor_inertia_kg_m2=(0.3, 0.0),
        stiffness_Nm_rad=(2000.0, 0.0),
        damping_Nm_s=(30.0, 0.0),
        motor_coulomb_Nm=(5.0, 0.0),
    )
    pushed = GeneralArm(arm, settings)
    push = ContactSettings(at_s=0.0, link=1, point_m=0.2, force_N=10.0, duration_s=100.0, angle_deg=way * 90.0)
    history = pushed.run(10_000, contact=contact_table((push,)))
    assert not np.any(history["q_m"][:, 0])
    assert not np.any(history["dq_m"][:, 0])
    assert pushed.q[0] == pytest.approx(way * 2.0 / 2000.0, rel=1e-6)
    assert pushed.joint_torque[0] == pytest.approx(-way * 2.0, rel=1e-6)


def test_a_gear_with_backlash_transmits_nothing_in_its_dead_zone():
    numbers = MechanicsSettings(
        stiffness_Nm_rad=(1000.0, 1000.0),
        rotor_inertia_kg_m2=(0.1, 0.1),
        backlash_rad=(0.01, 0.0),
        damping_Nm_s=(5.0, 5.0),
    ).numbers(ARMS["P"])
    assert [spring_torque(numbers, 0, twist, 3.0) for twist in (-0.005, -0.002, 0.0, 0.004, 0.005)] == [0.0] * 5
    assert spring_torque(numbers, 0, 0.007, 0.0) == pytest.approx(2.0, rel=1e-12)
    assert spring_torque(numbers, 0, -0.008, 0.0) == pytest.approx(-3.0, rel=1e-12)
    assert spring_torque(numbers, 0, 0.007, -3.0) == 0.0
    assert spring_torque(numbers, 1, 0.007, -3.0) == pytest.approx(-8.0, rel=1e-12)


@pytest.mark.parametrize("is_elastic", [False, True])
def test_the_ripple_has_its_line_in_the_spectrum_of_the_sensor(is_elastic):
    """Over whole revolutions at a steady speed: one line at the periods per revolution, of the given height."""
    arm, inertia = one_joint()
    spring = {"stiffness_Nm_rad": (20_000.0, 0.0), "damping_Nm_s": (40.0, 0.0)} if is_elastic else {}
    settings = MechanicsSettings(
        rotor_inertia_kg_m2=(0.01, 0.0),
        ripple_Nm=(0.2, 0.0),
        ripple_periods=(36.0, 1.0),
        ripple_phase_deg=(30.0, 0.0),
        **spring,
    )
    turning = GeneralArm(arm, settings, dq=(2.0 * math.pi, 0.0))
    history = turning.run(20_000)
    torque_Nm = history["tau_J"][10_000:, 0]
    amplitude = np.abs(np.fft.rfft(torque_Nm)) * 2.0 / torque_Nm.size
    assert int(np.argmax(amplitude[1:])) + 1 == 36
    assert amplitude[36] == pytest.approx(0.2 * inertia / (inertia + 0.01), rel=0.03)
    others = np.delete(amplitude, [0, 35, 36, 37])
    assert others.max() < 0.05 * amplitude[36]


def test_the_ripple_begins_with_its_phase_and_grows_with_the_motor_torque():
    arm, _ = one_joint(coulomb_Nm=1e3)
    settings = MechanicsSettings(ripple_Nm=(0.2, 0.0), ripple_share=(0.05, 0.0), ripple_phase_deg=(30.0, 0.0))
    held = GeneralArm(arm, settings)
    for torque_Nm in (0.0, 4.0, -4.0):
        held.run(500, torque_Nm)
        assert held.joint_torque[0] == pytest.approx(torque_Nm + 0.5 * (0.2 + 0.05 * abs(torque_Nm)), abs=1e-9)


@pytest.mark.parametrize("side", ["motor", "link"])
def test_the_encoder_is_on_its_side_of_the_spring(side):
    settings = MechanicsSettings(
        stiffness_Nm_rad=(500.0, 500.0), rotor_inertia_kg_m2=(0.2, 0.05), damping_Nm_s=(1.0, 1.0), encoder_side=side
    )
    body = Body(Scenario(mechanics=settings, noise=False))
    for _ in range(10):
        body.advance((5.0, 2.0), TORQUE)
    state = truth_of(body)
    read = state["q_m"] if side == "motor" else state["q"]
    assert np.abs(state["q_m"] - state["q"]).min() > 10.0 * POSITION_LSB_RAD
    assert body.sample().position_counts == pytest.approx(read / POSITION_LSB_RAD, abs=0.51)
    assert body.motor_torque_Nm == pytest.approx((5.0, 2.0), rel=1e-9)
