"""Friction beyond viscous and Coulomb: against closed forms, by itself and in the moving arm."""

import math

import numpy as np
import pytest
from general_arm import GeneralArm, one_joint

from adacd_hil.settings.schema import ConfigError
from firmware_sim.arm.hardware_settings import MechanicsSettings
from firmware_sim.arm.joint_forces import advance_bristle, bristle_rate
from firmware_sim.arm.touch_settings import TICK_S

COULOMB_NM, STATIC_NM, STRIBECK_RAD_S = 0.5, 0.8, 0.1
STRIBECK = {"static_Nm": (STATIC_NM, 0.0), "stribeck_velocity_rad_s": (STRIBECK_RAD_S, 0.1)}
LUGRE = {**STRIBECK, "sigma0_Nm_rad": (2000.0, 0.0), "sigma1_Nm_s": (20.0, 0.0), "sigma2_Nm_s": (0.3, 0.0)}


def level(velocity_rad_s: float) -> float:
    return COULOMB_NM + (STATIC_NM - COULOMB_NM) * math.exp(-((velocity_rad_s / STRIBECK_RAD_S) ** 2))


def sliding(
    settings: MechanicsSettings, velocity_rad_s: float, seconds: float = 0.3, viscous: float = 0.0
) -> GeneralArm:
    """The shoulder, moved at a steady speed: by a torque of the drive that balances its friction exactly in the end.

    A heavy rotor keeps the speed while friction settles.
    """
    arm, _ = one_joint(COULOMB_NM, viscous)
    moved = GeneralArm(arm, settings, dq=(velocity_rad_s, 0.0))
    moved.run(round(seconds / TICK_S))
    return moved


@pytest.mark.long
@pytest.mark.parametrize("velocity_rad_s", [0.01, 0.03, 0.1, 0.3, -0.05, 2.0])
@pytest.mark.parametrize("model", [STRIBECK, LUGRE])
def test_friction_at_steady_speed_lies_on_the_stribeck_curve(model, velocity_rad_s):
    moved = sliding(MechanicsSettings(**model, rotor_inertia_kg_m2=(100.0, 0.0)), velocity_rad_s, viscous=0.3)
    now = moved.dq[0]
    assert now == pytest.approx(velocity_rad_s, abs=0.006)
    expected = math.copysign(level(now), now) + 0.3 * now
    assert moved.observe()["friction"][0] == pytest.approx(expected, rel=2e-3)


def test_a_joint_that_has_broken_away_accelerates_by_what_friction_falls():
    """Above v_s the friction has fallen to Coulomb's: the torque that just broke it away accelerates by F_s - F_c."""
    arm, inertia = one_joint(COULOMB_NM)
    moved = GeneralArm(arm, MechanicsSettings(**STRIBECK), dq=(0.5, 0.0))
    moved.state["tau_m"][0] = STATIC_NM
    history = moved.run(1_000, STATIC_NM)
    acceleration = (history["dq"][-1, 0] - history["dq"][500, 0]) / (499 * TICK_S)
    assert acceleration == pytest.approx((STATIC_NM - COULOMB_NM) / inertia, rel=1e-6)


def test_bristles_need_a_friction_that_stays_at_speed():
    frictionless, _ = one_joint(0.0)
    with pytest.raises(ConfigError, match=r"sigma0_Nm_rad\[0\]"):
        MechanicsSettings(**LUGRE).check(frictionless, (0.0, 0.0), ())


def test_a_bristled_joint_is_a_spring_before_it_slides():
    arm, _ = one_joint(COULOMB_NM)
    pressed = GeneralArm(arm, MechanicsSettings(**LUGRE))
    # LuGre's bristle creeps under load with a rate that vanishes with the speed: small loads are a spring
    pressed.run(4_000, np.linspace(0.0, 0.05, 4_000))
    pressed.run(4_000, 0.05)
    assert pressed.q[0] == pytest.approx(0.05 / 2000.0, rel=0.05)
    pressed.run(4_000, np.linspace(0.05, 0.0, 4_000))
    pressed.run(4_000)
    assert abs(pressed.q[0]) < 0.1 * 0.05 / 2000.0


@pytest.mark.parametrize("start_rad", [0.0, 4e-4, -3e-4])
@pytest.mark.parametrize("velocity_rad_s", [1e-3, 0.5, -5.0])
def test_a_bristle_follows_a_steady_speed_as_its_equation_says_with_any_step(start_rad, velocity_rad_s):
    exact = start_rad
    for _ in range(20_000):
        half = exact + 2.5e-8 * bristle_rate(2000.0, exact, velocity_rad_s, 0.7)
        exact += 5e-8 * bristle_rate(2000.0, half, velocity_rad_s, 0.7)
    found = advance_bristle(2000.0, start_rad, velocity_rad_s, 0.7, 1e-3)
    assert found == pytest.approx(exact, abs=2e-9)
    assert abs(advance_bristle(2000.0, start_rad, velocity_rad_s, 0.7, 10.0)) <= 0.7 / 2000.0 * (1.0 + 1e-12)


def test_a_stiff_bristle_at_high_speed_stays_stable():
    arm, _ = one_joint(COULOMB_NM)
    settings = MechanicsSettings(sigma0_Nm_rad=(20_000.0, 0.0), sigma1_Nm_s=(20.0, 0.0))
    fast = GeneralArm(arm, settings, dq=(8.0, 0.0))
    history = fast.run(2_000)
    assert np.all(np.diff(history["dq"][:, 0]) < 0.0)
    assert fast.observe()["friction"][0] == pytest.approx(COULOMB_NM, rel=1e-6)
    assert np.abs(history["bristle_rad"][:, 0]).max() == pytest.approx(COULOMB_NM / 20_000.0, rel=1e-9)


@pytest.mark.parametrize("speed_rad_s", [0.7, -0.7])
def test_dry_friction_grows_with_the_torque_through_the_joint(speed_rad_s):
    arm, _ = one_joint(COULOMB_NM)
    settings = MechanicsSettings(load_friction=(0.05, 0.0), rotor_inertia_kg_m2=(100.0, 0.0))
    for torque_Nm in (0.0, 4.0, -8.0):
        moved = GeneralArm(arm, settings, dq=(speed_rad_s, 0.0))
        moved.run(100, torque_Nm)
        friction_Nm = moved.observe()["friction"][0]
        assert friction_Nm == pytest.approx(math.copysign(COULOMB_NM + 0.05 * abs(torque_Nm), speed_rad_s), rel=2e-3)


def test_friction_of_a_warm_joint_has_fallen_and_of_a_cold_one_risen():
    arm, _ = one_joint(COULOMB_NM, viscous_Nm_s=0.4)
    for ambient_C in (5.0, 25.0, 60.0):
        settings = MechanicsSettings(
            ambient_C=ambient_C, viscous_drop_per_K=(0.03, 0.0), coulomb_drop_per_K=(0.01, 0.0)
        )
        moved = GeneralArm(arm, settings, dq=(1.5, 0.0))
        expected = 0.5 * math.exp(-0.01 * (ambient_C - 25.0)) + 0.6 * math.exp(-0.03 * (ambient_C - 25.0))
        assert moved.observe()["friction"][0] == pytest.approx(expected, rel=1e-9)


def test_a_joint_warms_by_the_power_of_its_friction_and_cools_to_ambient():
    """At a steady 2 rad/s friction of 0.5 Nm is 1 W: up to 1 W · 0.5 s / 0.1 J/K = 5 K, within 0.5 s."""
    arm, _ = one_joint(COULOMB_NM)
    settings = MechanicsSettings(
        heat_capacity_J_K=(0.1, 0.0), cooling_s=(0.5, 1.0), ambient_C=20.0, rotor_inertia_kg_m2=(100.0, 0.0)
    )
    warmed = GeneralArm(arm, settings, dq=(2.0, 0.0))
    history = warmed.run(30_000, COULOMB_NM)
    times_s = np.arange(1, 30_001) * TICK_S
    expected = 20.0 + 5.0 * (1.0 - np.exp(-times_s / 0.5))
    assert np.abs(history["temperature_C"][:, 0] - expected).max() < 0.005
    assert np.ptp(history["temperature_C"][:, 1]) == 0.0
    warmed.state["dq"][0] = 0.0
    warmed.run(5_000)
    assert warmed.state["temperature_C"][0] == pytest.approx(20.0 + 5.0 * math.exp(-1.0), abs=0.02)


def test_motor_side_friction_warms_the_joint_as_well():
    arm, _ = one_joint()
    settings = MechanicsSettings(
        heat_capacity_J_K=(0.1, 0.0),
        cooling_s=(1e5, 1.0),
        rotor_inertia_kg_m2=(100.0, 0.0),
        stiffness_Nm_rad=(1e4, 0.0),
        damping_Nm_s=(20.0, 0.0),
        motor_coulomb_Nm=(0.3, 0.0),
        motor_viscous_Nm_s=(0.1, 0.0),
    )
    warmed = GeneralArm(arm, settings, dq=(2.0, 0.0))
    warmed.run(1_000)
    heat_J = (0.3 + 0.2) * 2.0 * 0.1
    assert warmed.state["temperature_C"][0] == pytest.approx(25.0 + heat_J / 0.1, abs=0.01)
