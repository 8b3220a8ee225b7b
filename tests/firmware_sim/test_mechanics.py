"""The arm in motion: against Pinocchio, laws of conservation and closed forms; friction at standstill, stops, truth."""

import dataclasses
import math
import os

import numpy as np
import pinocchio
import pytest
from general_arm import NO_PAYLOAD, OFF, RIGID, TORQUE, GeneralArm, one_joint, pinocchio_arm, truth_of, without_friction
from lab_arm import theta_of
from long_cases import long_but

from firmware_sim.arm.arms import ARMS
from firmware_sim.arm.hardware_settings import LARGEST_SUBSTEPS, MechanicsSettings
from firmware_sim.arm.plant import accelerate, decide_slips, fit_payload
from firmware_sim.arm.sensing import TORQUE_LSB_NM
from firmware_sim.arm.touch_settings import TICK_S, ContactSettings, contact_table
from firmware_sim.body.body import Body
from firmware_sim.scenario.scenario import PayloadSettings, Scenario

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")
ELASTIC = {"stiffness_Nm_rad": (6000.0, 2000.0), "rotor_inertia_kg_m2": (0.3, 0.05)}
PAYLOAD = (1.5, (0.05, 0.08), 0.01)


# Rigid bodies


@pytest.mark.parametrize("payload", [NO_PAYLOAD, (1.0, (0.0, 0.0), 0.0), PAYLOAD, (2.0, (-0.1, -0.2), 0.0)])
@pytest.mark.parametrize(("name", "tilt_deg"), [("S", 0.0), ("P", 12.0), ("M", 90.0)])
def test_accelerations_are_those_of_pinocchio(name, payload, tilt_deg):
    arm = GeneralArm(
        without_friction(name), MechanicsSettings(tilt_deg=tilt_deg, tilt_direction_deg=35.0), payload=payload
    )
    model = pinocchio_arm(arm.arm, payload, math.radians(tilt_deg), math.radians(35.0))
    data, numbers = model.createData(), RIGID.arm_numbers(ARMS[name])
    generator = np.random.default_rng(3)
    for _ in range(100):
        q, dq, tau = generator.uniform(-3, 3, 2), generator.uniform(-6, 6, 2), generator.uniform(-12, 12, 2)
        held = arm.gravity_torque(q)
        assert held == pytest.approx(pinocchio.computeGeneralizedGravity(model, data, q), abs=1e-12)
        friction = np.array(ARMS[name].viscous_Nm_s) * dq + np.array(ARMS[name].coulomb_Nm) * np.sign(dq)
        slips = decide_slips(arm.state, numbers, *(tau - held), q[1], *dq)
        found = accelerate(arm.state, numbers, *slips, *(tau - held), q[1], *dq)[:2]
        assert np.allclose(found, pinocchio.aba(model, data, q, dq, tau - friction), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(
    ("name", "theta"),
    [
        ("P", [0.19205, 0.034125, 0.020175, 0.03, 0.015, 0.0375, 0.02]),
        ("S", [0.3841, 0.06825, 0.04035, 0.024, 0.012, 0.03, 0.016]),
        ("M", [0.3841, 0.06825, 0.04035, 0.12, 0.06, 0.15, 0.08]),
    ],
)
def test_the_weighed_links_lump_to_the_published_parameters_and_a_kilogram_adds_its_share(name, theta):
    empty = theta_of(ARMS[name])
    assert empty == pytest.approx(theta, rel=1e-14)
    assert theta_of(ARMS[name], 1.0) - empty == pytest.approx([0.2125, 0.105, 0.09, 0, 0, 0, 0], abs=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "payload", "is_struck", "substeps", "bound"),
    long_but(
        2,
        [
            (MechanicsSettings(tilt_deg=90.0, tilt_direction_deg=-20.0), PAYLOAD, False, None, 1e-9),
            (MechanicsSettings(**ELASTIC, tilt_deg=30.0), PAYLOAD, True, 2, 1e-6),
            (MechanicsSettings(**ELASTIC), NO_PAYLOAD, False, None, 1e-7),
            (MechanicsSettings(**ELASTIC), NO_PAYLOAD, True, None, 1e-5),
        ],
    ),
)
def test_energy_stays_without_friction_torque_and_contact(settings, payload, is_struck, substeps, bound):
    """Struck: the motors stand while the links move at full speed, so that a third of the energy vibrates undamped."""
    arm = GeneralArm(without_friction(), settings, q=(0.3, -0.7), dq=(2.0, -5.0), substeps=substeps, payload=payload)
    if is_struck:
        arm.state["dq_m"][:] = 0.0
    at_rest = GeneralArm(without_friction(), settings, q=(0.3, -0.7), payload=payload)
    before_J = arm.energy_J()
    moving_J = before_J - at_rest.energy_J()
    arm.run(6_000 if INTERPRETED else 100_000)
    assert moving_J > 0.5
    print(f"energy changed by {(arm.energy_J() - before_J) / moving_J:.1e}, {arm.substeps} substeps")
    assert abs(arm.energy_J() - before_J) < bound * moving_J


@pytest.mark.parametrize("payload", [(1.0, (0.0, 0.0), 0.0), PAYLOAD])
def test_a_fitted_payload_shares_the_momentum_of_a_moving_arm_and_one_taken_off_leaves_with_its_speed(payload):
    arm = GeneralArm(ARMS["P"], q=(0.4, 0.2), dq=(1.0, -2.0))
    energy_J = arm.energy_J()
    models = [pinocchio_arm(ARMS["P"], carried) for carried in (NO_PAYLOAD, payload)]
    empty, loaded = (pinocchio.crba(model, model.createData(), np.array([0.4, 0.2])) for model in models)
    fit_payload(arm.state, arm.numbers, payload[0], *payload[1], payload[2])
    assert loaded @ arm.dq == pytest.approx(empty @ [1.0, -2.0], rel=1e-12)
    assert arm.mass_matrix() == pytest.approx(loaded, rel=1e-12)
    assert arm.energy_J() < energy_J
    shared = arm.dq.tolist()
    fit_payload(arm.state, arm.numbers, 0.0)
    assert arm.dq.tolist() == shared
    assert arm.mass_matrix() == pytest.approx(empty, rel=1e-12)


# Dry friction


@pytest.mark.parametrize("is_elastic", [False, True])
@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_joint_holds_to_the_bit_below_its_friction_and_breaks_away_above(is_elastic, joint, sign):
    """Also where the torque swings below it: no chatter."""
    settings = RIGID
    level_Nm = ARMS["M"].coulomb_Nm[joint]
    if is_elastic:
        settings = MechanicsSettings(
            **ELASTIC, damping_Nm_s=(2.0, 0.5), motor_coulomb_Nm=(0.1, 0.05), static_Nm=(0.3, 0.2)
        )
        level_Nm = (0.3, 0.2)[joint] + (0.1, 0.05)[joint]
    arm = GeneralArm(ARMS["M"], settings, q=(0.2, -0.4))
    target = np.zeros((2, 2_000))
    target[joint] = 0.85 * level_Nm * (-1.0) ** np.arange(2_000)
    if not is_elastic:
        target[joint, 1_000:] = sign * 0.999 * level_Nm
    history = arm.run(2_000, *target)
    assert np.abs(history["dq"]).max() == 0.0
    assert np.ptp(history["q"][500:], axis=0).tolist() == [0.0, 0.0]
    target[joint] = sign * (1.1 if is_elastic else 1.001) * level_Nm
    arm.run(2_000, *target)
    assert sign * arm.dq[joint] > 1e-6


def test_a_sliding_joint_stops_at_the_analytic_instant_and_stays():
    arm = dataclasses.replace(ARMS["S"], viscous_Nm_s=(0.0, 0.0), coulomb_Nm=(0.5, 100.0))
    sliding = GeneralArm(arm, q=(0.0, 0.4), dq=(0.3, 0.0))
    inertia = sliding.mass_matrix()[0, 0]
    # stops after 0.3 · inertia / 0.5 = 0.306 s, within a step
    sliding.run(math.floor(0.3 * inertia / 0.5 / TICK_S))
    assert sliding.dq[0] > 0.0
    sliding.run(1)
    assert sliding.dq[0] == 0.0
    assert sliding.q[0] == pytest.approx(0.5 * inertia * 0.3**2 / 0.5, rel=1e-11)
    rest = sliding.q.tolist()
    sliding.run(1_000, 0.3)
    assert (sliding.q.tolist(), sliding.dq.tolist()) == (rest, [0.0, 0.0])


def test_a_reversed_joint_turns_at_the_analytic_instant():
    """Torque against the motion, above F_c: the joint passes standstill and goes on the other way."""
    arm, inertia = one_joint(coulomb_Nm=0.5)
    turning = GeneralArm(arm, dq=(0.3, 0.0), tau=(-2.0, 0.0))
    turning.run(2_000, -2.0)
    turned_s = 0.3 * inertia / 2.5
    assert turned_s / TICK_S != pytest.approx(round(turned_s / TICK_S), abs=1e-3)
    assert turning.dq[0] == pytest.approx(-1.5 / inertia * (0.2 - turned_s), rel=1e-10)


def test_a_slowly_pushed_joint_breaks_away_at_the_analytic_instant():
    """The push on link 1 grows by 40 Nm/s and passes F_c = 0.5 Nm at 12.5 ms; at 12.55 ms with another F_c."""
    for coulomb_Nm in (0.5, 0.502, 0.5033):
        arm, inertia = one_joint(coulomb_Nm)
        push = ContactSettings(at_s=0.0, link=1, point_m=0.2, force_N=20.0, duration_s=0.4, shape="push", ramp_s=0.1)
        pushed = GeneralArm(arm)
        pushed.run(300, contact=contact_table((push,)))
        slid_s = 0.03 - coulomb_Nm / 40.0
        assert pushed.dq[0] == pytest.approx(0.5 * 40.0 * slid_s**2 / inertia, rel=1e-10)


def test_friction_at_standstill_obeys_its_law_for_any_torque():
    """The choice of slips against an independent one: least ½ a'M a - a'tau + sum F_c |a|, by coordinate descent."""
    arm = GeneralArm(ARMS["M"])
    coulomb = np.array(arm.arm.coulomb_Nm)
    generator = np.random.default_rng(5)
    seen = set()
    for _ in range(200):
        q2 = arm.q[1] = generator.uniform(-3, 3)
        torque = generator.uniform(-3, 3, 2) * coulomb
        mass = arm.mass_matrix()
        least = np.zeros(2)
        for _ in range(400):
            for i in range(2):
                push = torque[i] - mass[0, 1] * least[1 - i]
                least[i] = math.copysign(max(abs(push) - coulomb[i], 0.0), push) / mass[i, i]
        slips = decide_slips(arm.state, arm.numbers, *torque, q2, 0.0, 0.0)
        ddq1, ddq2, *friction = accelerate(arm.state, arm.numbers, *slips, *torque, q2, 0.0, 0.0)
        assert (ddq1, ddq2) == pytest.approx(tuple(least), abs=1e-9)
        assert np.all(np.abs(friction) <= coulomb)
        seen.add(slips)
    assert len(seen) == 9


# Gravity, stops, brake


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_joint_stop_holds_against_the_drive(way):
    arm, _ = one_joint(viscous_Nm_s=0.1)
    settings = MechanicsSettings(
        stop_low_deg=(-20.0, -90.0), stop_high_deg=(20.0, 90.0), stop_stiffness_Nm_rad=(2000.0, 2000.0)
    )
    stopped = GeneralArm(arm, settings)
    history = stopped.run(20_000, way * 8.0)
    assert np.abs(history["q"][:, 0]).max() < math.radians(20.0) + 0.06
    assert stopped.q[0] == pytest.approx(way * (math.radians(20.0) + 8.0 / 2000.0), abs=1e-6)
    assert stopped.observe()["tau_ext"][0] == pytest.approx(-way * 8.0, rel=1e-3)


def test_a_joint_stop_only_pushes():
    """With damping far above critical, an arm that leaves the stop is not held back by it."""
    arm, _ = one_joint()
    settings = MechanicsSettings(
        stop_low_deg=(-90.0, -90.0),
        stop_high_deg=(10.0, 90.0),
        stop_stiffness_Nm_rad=(2000.0, 2000.0),
        stop_damping_Nm_s=(200.0, 2.0),
    )
    stopped = GeneralArm(arm, settings, q=(math.radians(10.0) + 0.002, 0.0), dq=(-0.5, 0.0))
    stopped.run(20, -1.0)
    stopped.run(1)
    assert stopped.observe()["tau_ext"][0] == 0.0
    assert stopped.dq[0] < -0.5


def test_an_undamped_joint_stop_gives_the_arm_its_speed_back():
    arm, inertia = one_joint()
    settings = MechanicsSettings(stop_low_deg=(-90.0, -90.0), stop_high_deg=(10.0, 90.0), stop_damping_Nm_s=(0.0, 0.0))
    stopped = GeneralArm(arm, settings, dq=(1.0, 0.0))
    history = stopped.run(4_000)
    assert stopped.dq[0] == pytest.approx(-1.0, abs=1e-5)
    deepest = math.radians(10.0) + math.sqrt(inertia / 3000.0)
    assert history["q"][:, 0].max() == pytest.approx(deepest, abs=1e-5)


@pytest.mark.parametrize("is_elastic", [False, True])
def test_the_closed_brake_of_a_drive_that_is_off_holds_the_arm_on_a_slope(is_elastic):
    springs = {**ELASTIC, "damping_Nm_s": (20.0, 5.0)} if is_elastic else {}
    settings = MechanicsSettings(**springs, tilt_deg=45.0, tilt_direction_deg=90.0, holding_brake_Nm=(30.0, 10.0))
    body = Body(Scenario(mechanics=settings, noise=False))
    for _ in range(500):
        body.advance((0.0, 0.0), OFF)
    held = truth_of(body)
    assert [*held["dq"], *held["q_m"]] == [0.0] * 4
    if is_elastic:
        assert held["q"] == pytest.approx(-held["tau_J"] / [6000.0, 2000.0], rel=1e-9)
        assert held["tau_J"] == pytest.approx(held["tau_gravity"], abs=0.04)
        return
    # brake 30 Nm and friction 0.0375 Nm share the load in this ratio
    share = np.array([30.0 / 30.0375, 10.0 / 10.02])
    assert held["tau_J"] == pytest.approx(share * held["tau_gravity"], rel=1e-9)
    assert np.array(body.sample().torque_counts) * TORQUE_LSB_NM == pytest.approx(held["tau_J"], abs=1e-3)
    for _ in range(100):
        body.advance((0.0, 0.0), TORQUE)
    assert truth_of(body)["dq"][0] > 0.1


# Truth


@pytest.mark.parametrize("is_elastic", [False, True])
def test_truth_balances_on_the_link_side(is_elastic):
    """Integral of tau_J + tau_ext - tau_friction - tau_gravity is the momentum that joint 1 gives the arm."""
    contact = ContactSettings(at_s=0.01, link=2, point_m=0.2, force_N=20.0, duration_s=0.04, shape="half_sine")
    others = (
        {**ELASTIC, "damping_Nm_s": (2.0, 0.5), "static_Nm": (0.25, 0.15), "ripple_Nm": (0.2, 0.1)}
        if is_elastic
        else {"rotor_inertia_kg_m2": (0.3, 0.05), "motor_viscous_Nm_s": (0.2, 0.1)}
    )
    settings = MechanicsSettings(**others, motor_coulomb_Nm=(0.3, 0.1), tilt_deg=10.0)
    body = Body(Scenario(profile="M", start_deg=(10.0, 50.0), contacts=(contact,), mechanics=settings))
    body.start_scenario()
    pushes, momenta = [], []
    for _ in range(1_000):
        truth = truth_of(body)
        a1, a2, a3 = truth["theta"][:3]
        cosine = math.cos(truth["q"][1])
        momenta.append((a1 + 2.0 * a2 * cosine) * truth["dq"][0] + (a3 + a2 * cosine) * truth["dq"][1])
        pushes.append((truth["tau_J"] + truth["tau_ext"] - truth["tau_friction"] - truth["tau_gravity"])[0])
        body.advance((2.0, -0.5), TORQUE, 1)
    gained = np.concatenate([[0.0], np.cumsum(np.add(pushes[1:], pushes[:-1]) * 0.5e-4)])
    assert np.abs(momenta).max() > 0.1
    assert np.abs(gained - momenta).max() < 1e-4


def test_truth_tells_the_motor_side():
    body = Body(Scenario(profile="S", mechanics=MechanicsSettings(**ELASTIC, ambient_C=12.0), noise=False))
    for _ in range(3):
        body.advance((6.0, 0.0), TORQUE)
    truth = truth_of(body)
    assert truth["tau_m"] == pytest.approx(body.motor_torque_Nm, rel=1e-15)
    assert truth["tau_J"][0] == pytest.approx(6000.0 * (truth["q_m"] - truth["q"])[0], rel=1e-12)
    assert truth["tau_J"][0] < 5.0
    assert truth["joint_temperature"].tolist() == [12.0, 12.0]
    assert truth["tau_gravity"].tolist() == [0.0, 0.0]


def test_a_scenario_fits_a_payload_with_its_centre_of_mass():
    body = Body(Scenario(payloads=(PayloadSettings(0.0, 1.5, (0.05, 0.08), 0.01),)))
    body.start_scenario()
    a1, a2, a3 = truth_of(body)["theta"][:3]
    empty = theta_of(ARMS["P"])
    own = 1.5 * (0.35**2 + 0.08**2) + 0.01
    assert a3 - empty[2] == pytest.approx(own, rel=1e-12)
    assert a2 - empty[1] == pytest.approx(1.5 * 0.35 * 0.35, rel=1e-12)
    assert a1 - empty[0] == pytest.approx(1.5 * 0.35**2 + own, rel=1e-12)


def test_a_faster_arm_gets_more_substeps_up_to_their_bound():
    counts = [
        MechanicsSettings(stiffness_Nm_rad=(k, k), rotor_inertia_kg_m2=(0.1, 0.1)).substeps(ARMS["S"], [NO_PAYLOAD])
        for k in (100.0, 4e3, 3e4, 1e6)
    ]
    assert counts == sorted(counts)
    assert counts[0] == 1
    assert 1 < counts[1] < counts[2]
    assert counts[3] == LARGEST_SUBSTEPS
    assert RIGID.substeps(ARMS["S"], [NO_PAYLOAD], touch_rad_s=2000.0) == 4
