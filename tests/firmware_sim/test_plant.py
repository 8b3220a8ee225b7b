"""The rigid arm: against Pinocchio, against laws of conservation, and friction at standstill."""

import dataclasses
import math
import os

import numpy as np
import pinocchio
import pytest
from general_arm import run_rigid as run

from firmware_sim.arm.arms import ARMS, ArmProfile
from firmware_sim.arm.plant import (
    MECHANICAL_STATE,
    accelerate,
    decide_slips,
    external_torque,
    fit_payload,
    mass_matrix,
)
from firmware_sim.arm.touch_settings import TICK_S, ContactSettings, contact_table

NOBODY = contact_table(())
INERTIA = ("alpha", "beta", "gamma")
INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")


def state_of(arm: ArmProfile, q=(0.0, 0.0), dq=(0.0, 0.0), payload_kg=0.0, tau=(0.0, 0.0)) -> np.ndarray:
    state = np.zeros(1, MECHANICAL_STATE)[0]
    fit_payload(state, arm.numbers(), payload_kg)
    state["q"], state["dq"], state["tau_m"][:] = q, dq, tau
    return state


def without_friction(arm: ArmProfile) -> ArmProfile:
    """Nor any stops in its way."""
    return dataclasses.replace(arm, viscous_Nm_s=(0.0, 0.0), coulomb_Nm=(0.0, 0.0), stop_deg=(1e6, 1e6))


def kinetic_energy_J(state: np.ndarray) -> float:
    m11, m12, m22 = mass_matrix(state, state["q"][1])
    dq1, dq2 = state["dq"][0], state["dq"][1]
    return 0.5 * m11 * dq1**2 + m12 * dq1 * dq2 + 0.5 * m22 * dq2**2


def pinocchio_arm(arm: ArmProfile, payload_kg: float) -> pinocchio.Model:
    """Build the arm in an engine that is not ours, in the horizontal plane."""
    model = pinocchio.Model()
    model.gravity = pinocchio.Motion.Zero()
    parent, place = 0, pinocchio.SE3.Identity()
    for index, link in enumerate(arm.links):
        parent = model.addJoint(parent, pinocchio.JointModelRZ(), place, f"joint{index + 1}")
        about_center = np.diag([0.0, 0.0, link.inertia_kg_m2])
        inertia = pinocchio.Inertia(link.mass_kg, np.array([link.center_m, 0.0, 0.0]), about_center)
        model.appendBodyToJoint(parent, inertia, pinocchio.SE3.Identity())
        place = pinocchio.SE3(np.eye(3), np.array([link.length_m, 0.0, 0.0]))
    point_mass = pinocchio.Inertia(payload_kg, np.zeros(3), np.zeros((3, 3)))
    model.appendBodyToJoint(parent, point_mass, place)
    return model


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("payload_kg", [0.0, 1.0, 3.7])
def test_accelerations_are_those_of_pinocchio(name, payload_kg):
    arm = ARMS[name]
    model = pinocchio_arm(arm, payload_kg)
    data = model.createData()
    generator = np.random.default_rng(11)
    for _ in range(200):
        q, dq, tau = generator.uniform(-3, 3, 2), generator.uniform(-6, 6, 2), generator.uniform(-12, 12, 2)
        friction = np.array(arm.viscous_Nm_s) * dq + np.array(arm.coulomb_Nm) * np.sign(dq)
        expected = pinocchio.aba(model, data, q, dq, tau - friction)
        slips = decide_slips(state_of(arm), arm.numbers(), *tau, q[1], *dq)
        found = accelerate(state_of(arm, payload_kg=payload_kg), arm.numbers(), *slips, *tau, q[1], *dq)[:2]
        assert np.allclose(found, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(
    ("payload_kg", "torque"),
    [(0.0, (0.9391413364143529, -0.10515014859197394)), (1.0, (1.109512623205665, -0.11638114642578004))],
)
def test_profile_m_needs_the_published_torque_for_the_published_motion(payload_kg, torque):
    arm = ARMS["M"]
    ddq1, ddq2, _, _ = accelerate(state_of(arm, payload_kg=payload_kg), arm.numbers(), 1, -1, *torque, -0.7, 1.1, -0.6)
    assert (ddq1, ddq2) == pytest.approx((2.0, -3.0), rel=1e-12)


@pytest.mark.parametrize(
    ("name", "theta"),
    [
        ("P", [0.19205, 0.034125, 0.020175, 0.03, 0.015, 0.0375, 0.02]),
        ("S", [0.3841, 0.06825, 0.04035, 0.024, 0.012, 0.03, 0.016]),
        ("M", [0.3841, 0.06825, 0.04035, 0.12, 0.06, 0.15, 0.08]),
    ],
)
def test_the_weighed_links_lump_to_the_published_parameters(name, theta):
    assert ARMS[name].theta() == pytest.approx(theta, rel=1e-14)


def test_one_kilogram_at_the_tip_adds_its_share_to_the_three_inertias():
    for arm in ARMS.values():
        added = arm.theta(1.0) - arm.theta(0.0)
        assert added == pytest.approx([0.2125, 0.105, 0.09, 0, 0, 0, 0], abs=1e-15)


def test_a_fitted_payload_gives_the_inertia_that_the_arm_computes():
    arm = ARMS["S"]
    state = state_of(arm)
    fit_payload(state, arm.numbers(), 0.8)
    assert [state[name] for name in INERTIA] == pytest.approx(arm.inertia(0.8), rel=1e-15)
    fit_payload(state, arm.numbers(), 0.0)
    assert tuple(state[name] for name in INERTIA) == arm.inertia()


def test_the_mass_matrix_is_positive_definite_in_every_pose():
    for arm in ARMS.values():
        for payload_kg in (0.0, 0.3, 1.0, 5.0):
            for q2 in np.linspace(-math.pi, math.pi, 73):
                m11, m12, m22 = mass_matrix(state_of(arm, payload_kg=payload_kg), q2)
                assert np.linalg.eigvalsh([[m11, m12], [m12, m22]])[0] > 1e-3


@pytest.mark.parametrize("name", ["P", "S"])
def test_energy_stays_in_an_arm_without_friction_torque_and_contact(name):
    arm = without_friction(ARMS[name])
    state = state_of(arm, q=(0.3, -0.7), dq=(2.0, -5.0))
    before_J = kinetic_energy_J(state)
    run(state, arm.numbers(), NOBODY, 0.0, 0.0, TICK_S, 10_000 if INTERPRETED else 600_000)
    assert kinetic_energy_J(state) == pytest.approx(before_J, rel=1e-9)


def test_the_momentum_about_the_base_stays_when_joint_1_is_free():
    arm = without_friction(ARMS["S"])
    state = state_of(arm, q=(0.3, -0.7), dq=(2.0, -5.0))

    def momentum() -> float:
        m11, m12, _ = mass_matrix(state, state["q"][1])
        return m11 * state["dq"][0] + m12 * state["dq"][1]

    before = momentum()
    # Whatever joint 2 does to link 2 it does to link 1 the other way round; joint 1 alone reaches the base.
    run(state, arm.numbers(), NOBODY, 0.0, 1.5, TICK_S, 3_000)
    assert momentum() == pytest.approx(before, rel=1e-9)
    assert abs(state["dq"][1]) > 1.0


def test_a_shoulder_under_constant_torque_moves_as_the_text_book_says():
    """Joint 1 alone, elbow held by friction: constant torque after the current loop has settled."""
    arm = dataclasses.replace(ARMS["S"], viscous_Nm_s=(0.0, 0.0), coulomb_Nm=(0.2, 100.0))
    state = state_of(arm, q=(0.0, 0.0), tau=(1.2, 0.0))
    run(state, arm.numbers(), NOBODY, 1.2, 0.0, TICK_S, 5_000)
    alpha, beta, gamma = arm.inertia()
    acceleration = (1.2 - 0.2) / (alpha + gamma + 2.0 * beta)
    assert state["dq"][0] == pytest.approx(acceleration * 0.5, rel=1e-11)
    assert state["q"][0] == pytest.approx(0.5 * acceleration * 0.25, rel=1e-11)
    assert state["dq"][1] == 0.0


def test_work_done_on_the_arm_is_kinetic_energy_plus_heat():
    arm = ARMS["M"]
    numbers = arm.numbers()
    state = state_of(arm, q=(0.1, 0.6), dq=(0.4, -0.3))
    push = ContactSettings(
        at_s=0.0, link=2, point_m=0.2, force_N=18.0, duration_s=0.3, shape="half_sine", angle_deg=70.0
    )
    contact = contact_table((push,))
    before_J = kinetic_energy_J(state)
    samples = []
    step_s = 2.5e-5
    count = 12_000
    for index in range(count + 1):
        ext1, ext2 = external_torque(numbers, contact, index * step_s, *state["q"], *state["dq"])
        slips = decide_slips(
            state, numbers, state["tau_m"][0] + ext1, state["tau_m"][1] + ext2, state["q"][1], *state["dq"]
        )
        _, _, friction1, friction2 = accelerate(
            state, numbers, *slips, state["tau_m"][0] + ext1, state["tau_m"][1] + ext2, state["q"][1], *state["dq"]
        )
        viscous1, viscous2 = arm.viscous_Nm_s[0] * state["dq"][0], arm.viscous_Nm_s[1] * state["dq"][1]
        samples.append(
            (
                (state["tau_m"][0] + ext1) * state["dq"][0] + (state["tau_m"][1] + ext2) * state["dq"][1],
                (friction1 + viscous1) * state["dq"][0] + (friction2 + viscous2) * state["dq"][1],
            )
        )
        if index < count:
            run(state, numbers, contact, -0.6, 0.25, step_s, elapsed_s=index * step_s)
    work_J, heat_J = np.trapezoid(np.array(samples), dx=step_s, axis=0)
    assert heat_J > 0.005
    assert work_J - heat_J == pytest.approx(kinetic_energy_J(state) - before_J, abs=2e-7)


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("name", ARMS)
def test_a_joint_holds_below_its_coulomb_friction_and_breaks_away_above(name, joint, sign):
    arm = ARMS[name]
    target = [0.0, 0.0]
    target[joint] = sign * 0.999 * arm.coulomb_Nm[joint]
    state = state_of(arm, q=(0.2, -0.4))
    run(state, arm.numbers(), NOBODY, target[0], target[1], TICK_S, 1_000)
    assert [*state["q"], *state["dq"]] == [0.2, -0.4, 0.0, 0.0]
    target[joint] = sign * 1.001 * arm.coulomb_Nm[joint]
    run(state, arm.numbers(), NOBODY, target[0], target[1], TICK_S, 1_000)
    assert sign * state["dq"][joint] > 1e-6


def test_a_sliding_joint_stops_at_the_analytic_instant_and_stays():
    arm = dataclasses.replace(ARMS["S"], viscous_Nm_s=(0.0, 0.0), coulomb_Nm=(0.5, 100.0))
    alpha, beta, gamma = arm.inertia()
    inertia = alpha + gamma + 2.0 * beta * math.cos(0.4)
    state = state_of(arm, q=(0.0, 0.4), dq=(0.3, 0.0))
    # stops after 0.3 · inertia / 0.5 = 0.306 s, within a step
    before_s = math.floor(0.3 * inertia / 0.5 / TICK_S)
    run(state, arm.numbers(), NOBODY, 0.0, 0.0, TICK_S, before_s)
    assert state["dq"][0] > 0.0
    run(state, arm.numbers(), NOBODY, 0.0, 0.0, TICK_S, 1)
    assert state["dq"][0] == 0.0
    assert state["q"][0] == pytest.approx(0.5 * inertia * 0.3**2 / 0.5, rel=1e-11)
    rest = state.copy()
    run(state, arm.numbers(), NOBODY, 0.3, 0.0, TICK_S, 1_000)
    assert (state["q"].tolist(), state["dq"].tolist()) == (rest["q"].tolist(), rest["dq"].tolist())


def test_a_reversed_joint_turns_at_the_analytic_instant():
    """Torque against the motion, above F_c: the joint passes standstill and goes on the other way."""
    arm = dataclasses.replace(ARMS["S"], viscous_Nm_s=(0.0, 0.0), coulomb_Nm=(0.5, 100.0))
    alpha, beta, gamma = arm.inertia()
    inertia = alpha + gamma + 2.0 * beta
    state = state_of(arm, dq=(0.3, 0.0), tau=(-2.0, 0.0))
    run(state, arm.numbers(), NOBODY, -2.0, 0.0, TICK_S, 2_000)
    turned_s = 0.3 * inertia / 2.5
    assert turned_s / TICK_S != pytest.approx(round(turned_s / TICK_S), abs=1e-3)
    assert state["dq"][0] == pytest.approx(-1.5 / inertia * (0.2 - turned_s), rel=1e-10)


def test_a_slowly_pushed_joint_breaks_away_at_the_analytic_instant():
    """The push on link 1 grows by 40 Nm/s and passes F_c = 0.5 Nm at 12.5 ms; at 12.55 ms with another F_c."""
    for coulomb_Nm in (0.5, 0.502, 0.5033):
        arm = dataclasses.replace(ARMS["S"], viscous_Nm_s=(0.0, 0.0), coulomb_Nm=(coulomb_Nm, 100.0))
        alpha, beta, gamma = arm.inertia()
        push = ContactSettings(at_s=0.0, link=1, point_m=0.2, force_N=20.0, duration_s=0.4, shape="push", ramp_s=0.1)
        state = state_of(arm)
        run(state, arm.numbers(), contact_table((push,)), 0.0, 0.0, TICK_S, 300)
        slid_s = 0.03 - coulomb_Nm / 40.0
        assert state["dq"][0] == pytest.approx(0.5 * 40.0 * slid_s**2 / (alpha + gamma + 2.0 * beta), rel=1e-10)


def test_a_held_elbow_is_dragged_only_when_the_shoulder_accelerates_hard():
    arm = ARMS["M"]
    for torque, is_dragged in ((0.5, False), (3.0, True)):
        state = state_of(arm, q=(0.0, 0.5))
        run(state, arm.numbers(), NOBODY, torque, 0.0, TICK_S, 50)
        assert state["dq"][0] > 0.0
        assert (state["dq"][1] != 0.0) == is_dragged


def test_friction_at_standstill_obeys_its_law_for_any_torque():
    """The choice of slips against an independent one: least ½ a'M a - a'tau + sum F_c |a|, by coordinate descent."""
    arm = ARMS["M"]
    numbers = arm.numbers()
    coulomb = np.array(arm.coulomb_Nm)
    generator = np.random.default_rng(5)
    seen = set()
    for _ in range(400):
        q2 = generator.uniform(-3, 3)
        torque = generator.uniform(-3, 3, 2) * coulomb
        state = state_of(arm, q=(0.0, q2))
        m11, m12, m22 = mass_matrix(state, q2)
        least = np.zeros(2)
        for _ in range(400):
            for i, own in enumerate((m11, m22)):
                push = torque[i] - m12 * least[1 - i]
                least[i] = math.copysign(max(abs(push) - coulomb[i], 0.0), push) / own
        slips = decide_slips(state, numbers, *torque, q2, 0.0, 0.0)
        ddq1, ddq2, friction1, friction2 = accelerate(state, numbers, *slips, *torque, q2, 0.0, 0.0)
        assert (ddq1, ddq2) == pytest.approx(tuple(least), abs=1e-9)
        assert abs(friction1) <= coulomb[0]
        assert abs(friction2) <= coulomb[1]
        seen.add(slips)
    assert len(seen) == 9


def test_a_resting_arm_shows_no_chatter_when_torque_swings_below_friction():
    arm = ARMS["M"]
    state = state_of(arm, q=(0.2, -0.4))
    for index in range(500):
        run(state, arm.numbers(), NOBODY, 0.14 * (-1) ** index, 0.07 * (-1) ** index, TICK_S)
        assert [*state["q"], *state["dq"]] == [0.2, -0.4, 0.0, 0.0]


def test_halving_the_step_changes_a_millisecond_by_less_than_1e_8():
    generator = np.random.default_rng(17)
    for arm in ARMS.values():
        for _ in range(100):
            coarse = state_of(
                arm, generator.uniform(-1, 1, 2), generator.uniform(0.05, 3, 2) * generator.choice([-1, 1], 2)
            )
            coarse["tau_m"][:] = generator.uniform(-3, 3, 2)
            fine = coarse.copy()
            target = coarse["tau_m"] + generator.uniform(-2, 2, 2)
            run(coarse, arm.numbers(), NOBODY, target[0], target[1], TICK_S, 10)
            run(fine, arm.numbers(), NOBODY, target[0], target[1], 0.5 * TICK_S, 20)
            assert max(np.abs(coarse[name] - fine[name]).max() for name in ("q", "dq", "tau_m")) < 1e-8


def test_stops_and_reversals_do_not_spoil_the_convergence():
    arm = ARMS["M"]
    coarse = state_of(arm, (0.1, 0.5), (0.05, -0.04))
    fine = coarse.copy()
    for index in range(400):
        target = (0.4 * math.sin(0.05 * index), 0.2 * math.sin(0.07 * index))
        run(coarse, arm.numbers(), NOBODY, target[0], target[1], TICK_S, 10)
        run(fine, arm.numbers(), NOBODY, target[0], target[1], 0.125 * TICK_S, 80)
    assert max(np.abs(coarse[name] - fine[name]).max() for name in ("q", "dq")) < 1e-7


def test_the_motor_torque_follows_its_target_with_the_current_loop():
    arm = ARMS["S"]
    state = state_of(arm)
    run(state, arm.numbers(), NOBODY, 2.0, -1.0, TICK_S, 3)
    reached = 1.0 - math.exp(-2.0 * math.pi * 1000.0 * 3 * TICK_S)
    assert state["tau_m"] == pytest.approx([2.0 * reached, -1.0 * reached], rel=1e-12)


def test_a_payload_fitted_at_rest_moves_nothing():
    arm = ARMS["P"]
    state = state_of(arm, q=(0.4, 0.2))
    fit_payload(state, arm.numbers(), 1.0)
    assert [*state["q"], *state["dq"]] == [0.4, 0.2, 0.0, 0.0]
    assert state["payload_kg"] == 1.0


def test_a_payload_fitted_to_a_moving_arm_shares_its_momentum():
    arm = ARMS["P"]
    state = state_of(arm, q=(0.4, 0.2), dq=(1.0, -2.0))
    before = pinocchio.crba(model := pinocchio_arm(arm, 0.0), model.createData(), state["q"]) @ state["dq"]
    energy_J = kinetic_energy_J(state)
    fit_payload(state, arm.numbers(), 1.0)
    after = pinocchio.crba(model := pinocchio_arm(arm, 1.0), model.createData(), state["q"]) @ state["dq"]
    assert after == pytest.approx(before, rel=1e-12)
    assert kinetic_energy_J(state) < energy_J


def test_a_payload_taken_off_a_moving_arm_leaves_with_its_speed():
    arm = ARMS["P"]
    state = state_of(arm, q=(0.4, 0.2), dq=(1.0, -2.0), payload_kg=1.0)
    fit_payload(state, arm.numbers(), 0.0)
    assert state["dq"].tolist() == [1.0, -2.0]


@pytest.mark.parametrize("profile", ["P", "S", "M"])
@pytest.mark.parametrize("way", [1.0, -1.0])
def test_an_arm_that_is_thrown_stays_between_its_stops_and_comes_to_rest(profile, way):
    arm = ARMS[profile]
    state = state_of(arm, dq=(way * 20.0, -way * 30.0))
    furthest = np.zeros(2)
    for _ in range(1_500):
        run(state, arm.numbers(), NOBODY, 0.0, 0.0, TICK_S, 100)
        furthest = np.maximum(furthest, np.abs(state["q"]))
    stops = np.radians(arm.stop_deg)
    assert (furthest > stops - 0.01).any()
    assert (furthest < stops + 0.2).all()
    assert state["dq"][0] == state["dq"][1] == 0.0
