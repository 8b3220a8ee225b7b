"""The general integrator: energy, gravity, stops, payloads, brake, and truth."""

import dataclasses
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pinocchio
import pytest
from general_arm import LOCKED_NM, GeneralArm, one_joint, without_friction
from long_cases import long_but

from adacd_hil.records import TRUTH_LAYOUT
from adacd_hil.settings.schema import ConfigError, parse
from firmware_sim.arm.arms import ARMS
from firmware_sim.arm.hardware_settings import LARGEST_SUBSTEPS, MechanicsSettings
from firmware_sim.arm.plant import MECHANICAL_STATE, accelerate, fit_payload
from firmware_sim.arm.sensing import DriveMode
from firmware_sim.arm.touch_settings import ContactSettings
from firmware_sim.body.body import Body
from firmware_sim.scenario.scenario import PayloadSettings, Scenario

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")
ELASTIC = {"stiffness_Nm_rad": (6000.0, 2000.0), "rotor_inertia_kg_m2": (0.3, 0.05)}
RIGID = MechanicsSettings()
PAYLOAD = (1.5, (0.05, 0.08), 0.01)
TORQUE = (DriveMode.TORQUE, DriveMode.TORQUE)
OFF = (DriveMode.OFF, DriveMode.OFF)


def truth_of(body: Body) -> dict[str, np.ndarray]:
    block = np.full(TRUTH_LAYOUT.size, np.nan)
    body.truth(block)
    return {name: block[place] for name, place in TRUTH_LAYOUT.slices.items()}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "payload", "is_struck", "substeps", "bound"),
    long_but(
        2,
        [
            (RIGID, None, False, None, 1e-9),
            (MechanicsSettings(tilt_deg=30.0, tilt_direction_deg=50.0), None, False, None, 1e-9),
            (MechanicsSettings(tilt_deg=90.0, tilt_direction_deg=-20.0), PAYLOAD, False, None, 1e-9),
            (MechanicsSettings(**ELASTIC), None, False, None, 1e-7),
            (MechanicsSettings(**ELASTIC, tilt_deg=30.0), PAYLOAD, False, None, 1e-7),
            (MechanicsSettings(**ELASTIC), None, True, None, 1e-5),
            (MechanicsSettings(**ELASTIC), None, True, 2, 1e-6),
            (MechanicsSettings(**ELASTIC, tilt_deg=30.0), PAYLOAD, True, 2, 1e-6),
        ],
    ),
)
def test_energy_stays_for_a_minute_without_friction_torque_and_contact(settings, payload, is_struck, substeps, bound):
    """Struck: the motors stand while the links move at full speed, so that a third of the energy vibrates undamped."""
    chosen = {} if payload is None else {"payload": payload}
    arm = GeneralArm(without_friction(), settings, q=(0.3, -0.7), dq=(2.0, -5.0), substeps=substeps, **chosen)
    if is_struck:
        arm.state["dq_m"][:] = 0.0
    at_rest = GeneralArm(without_friction(), settings, q=(0.3, -0.7), **chosen)
    before_J = arm.energy_J()
    moving_J = before_J - at_rest.energy_J()
    arm.run(6_000 if INTERPRETED else 600_000)
    assert moving_J > 0.5
    print(f"energy changed by {(arm.energy_J() - before_J) / moving_J:.1e}, {arm.substeps} substeps")
    assert abs(arm.energy_J() - before_J) < bound * moving_J


@pytest.mark.slow
def test_an_arm_below_its_breakaway_torque_does_not_move_by_a_bit():
    arm = GeneralArm(
        ARMS["M"],
        MechanicsSettings(**ELASTIC, damping_Nm_s=(2.0, 0.5), motor_coulomb_Nm=(0.1, 0.05), static_Nm=(0.3, 0.2)),
        q=(0.2, -0.4),
    )
    swing = (-1.0) ** np.arange(2_000)
    history = arm.run(2_000, 0.35 * swing, 0.2 * swing)
    assert np.ptp(history["q"][500:], axis=0).tolist() == [0.0, 0.0]
    assert np.abs(history["dq"]).max() == 0.0


def pinocchio_arm(payload, tilt_rad: float, direction_rad: float) -> pinocchio.Model:
    """The arm in an engine that is not ours, on a tilted base."""
    arm = ARMS["S"]
    model = pinocchio.Model()
    downhill = np.array([math.cos(direction_rad), math.sin(direction_rad), 0.0])
    slope = math.sin(tilt_rad) * downhill - math.cos(tilt_rad) * np.array([0.0, 0.0, 1.0])
    model.gravity = pinocchio.Motion(9.80665 * slope, np.zeros(3))
    parent, place = 0, pinocchio.SE3.Identity()
    for index, link in enumerate(arm.links):
        parent = model.addJoint(parent, pinocchio.JointModelRZ(), place, f"joint{index + 1}")
        about_center = np.diag([0.0, 0.0, link.inertia_kg_m2])
        inertia = pinocchio.Inertia(link.mass_kg, np.array([link.center_m, 0.0, 0.0]), about_center)
        model.appendBodyToJoint(parent, inertia, pinocchio.SE3.Identity())
        place = pinocchio.SE3(np.eye(3), np.array([link.length_m, 0.0, 0.0]))
    mass_kg, center_m, inertia_kg_m2 = payload
    body = pinocchio.Inertia(mass_kg, np.array([*center_m, 0.0]), np.diag([0.0, 0.0, inertia_kg_m2]))
    model.appendBodyToJoint(parent, body, place)
    return model


@pytest.mark.parametrize("payload", [(0.0, (0.0, 0.0), 0.0), (1.0, (0.0, 0.0), 0.0), PAYLOAD, (2.0, (-0.1, -0.2), 0.0)])
@pytest.mark.parametrize("tilt_deg", [0.0, 12.0, 90.0])
def test_accelerations_with_a_payload_beside_the_link_and_a_tilted_base_are_those_of_pinocchio(payload, tilt_deg):
    settings = MechanicsSettings(tilt_deg=tilt_deg, tilt_direction_deg=35.0)
    arm = GeneralArm(without_friction(), settings, payload=payload)
    model = pinocchio_arm(payload, math.radians(tilt_deg), math.radians(35.0))
    data = model.createData()
    generator = np.random.default_rng(3)
    for _ in range(100):
        q, dq, tau = generator.uniform(-3, 3, 2), generator.uniform(-6, 6, 2), generator.uniform(-12, 12, 2)
        held = arm.gravity_torque(q)
        assert held == pytest.approx(pinocchio.computeGeneralizedGravity(model, data, q), abs=1e-12)
        found = accelerate(arm.state, arm.numbers, 1, 1, *(tau - held), q[1], *dq)[:2]
        assert np.allclose(found, pinocchio.aba(model, data, q, dq, tau), rtol=1e-10, atol=1e-10)


@pytest.mark.slow
def test_a_hanging_arm_rests_where_the_slope_goes_down():
    settings = MechanicsSettings(tilt_deg=20.0, tilt_direction_deg=40.0, motor_viscous_Nm_s=(1.0, 0.3))
    arm = GeneralArm(without_friction(), settings)
    arm.run(150_000)
    assert np.degrees(arm.q) == pytest.approx([40.0, 0.0], abs=0.01)


def test_gravity_on_a_stretched_arm_is_weight_times_lever():
    arm = GeneralArm(without_friction(), MechanicsSettings(tilt_deg=90.0, tilt_direction_deg=-90.0))
    shoulder_Nm = 9.80665 * (3.0 * 0.20 + 1.5 * (0.35 + 0.13))
    assert arm.gravity_torque((0.0, 0.0)) == pytest.approx([shoulder_Nm, 9.80665 * 1.5 * 0.13], rel=1e-12)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_joint_stop_holds_against_the_drive(way):
    arm, _ = one_joint(coulomb_Nm=0.0, viscous_Nm_s=0.1)
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


def test_a_fitted_payload_beside_the_link_shares_the_momentum_of_a_moving_arm():
    arm = ARMS["P"]
    state = np.zeros(1, MECHANICAL_STATE)[0]
    fit_payload(state, arm.numbers(), 0.0)
    state["q"], state["dq"] = (0.4, 0.2), (1.0, -2.0)
    fit_payload(state, arm.numbers(), *(PAYLOAD[0], *PAYLOAD[1], PAYLOAD[2]))
    light = ARMS["P"].links
    inertias = []
    for payload in ((0.0, (0.0, 0.0), 0.0), PAYLOAD):
        model = pinocchio.Model()
        parent, place = 0, pinocchio.SE3.Identity()
        for index, link in enumerate(light):
            parent = model.addJoint(parent, pinocchio.JointModelRZ(), place, f"joint{index + 1}")
            about = np.diag([0.0, 0.0, link.inertia_kg_m2])
            model.appendBodyToJoint(
                parent,
                pinocchio.Inertia(link.mass_kg, np.array([link.center_m, 0.0, 0.0]), about),
                pinocchio.SE3.Identity(),
            )
            place = pinocchio.SE3(np.eye(3), np.array([link.length_m, 0.0, 0.0]))
        body = pinocchio.Inertia(payload[0], np.array([*payload[1], 0.0]), np.diag([0.0, 0.0, payload[2]]))
        model.appendBodyToJoint(parent, body, place)
        inertias.append(pinocchio.crba(model, model.createData(), np.array([0.4, 0.2])))
    assert inertias[1] @ state["dq"] == pytest.approx(inertias[0] @ [1.0, -2.0], rel=1e-12)


def test_the_closed_brake_of_a_drive_that_is_off_holds_the_arm_on_a_slope():
    settings = MechanicsSettings(tilt_deg=45.0, tilt_direction_deg=90.0, holding_brake_Nm=(30.0, 10.0))
    body = Body(Scenario(mechanics=settings, noise=False))
    for _ in range(100):
        body.advance((0.0, 0.0), OFF)
    held = truth_of(body)
    assert held["dq"].tolist() == [0.0, 0.0]
    # brake 30 Nm and friction 0.0375 Nm share the load in this ratio
    share = np.array([30.0 / 30.0375, 10.0 / 10.02])
    assert held["tau_J"] == pytest.approx(share * held["tau_gravity"], rel=1e-9)
    assert body.sample().tau_J == pytest.approx(held["tau_J"], abs=1e-3)
    for _ in range(100):
        body.advance((0.0, 0.0), TORQUE)
    assert truth_of(body)["dq"][0] > 0.1


def test_the_brake_holds_an_elastic_arm_too():
    settings = MechanicsSettings(
        **ELASTIC, damping_Nm_s=(20.0, 5.0), tilt_deg=45.0, tilt_direction_deg=90.0, holding_brake_Nm=(30.0, 10.0)
    )
    body = Body(Scenario(mechanics=settings, noise=False))
    for _ in range(500):
        body.advance((0.0, 0.0), OFF)
    held = truth_of(body)
    assert held["dq"].tolist() == [0.0, 0.0]
    assert held["q_m"].tolist() == [0.0, 0.0]
    assert held["q"] == pytest.approx(-held["tau_J"] / [6000.0, 2000.0], rel=1e-9)
    assert held["tau_J"] == pytest.approx(held["tau_gravity"], abs=0.04)


def test_truth_balances_on_the_link_side():
    """Integral of tau_J + tau_ext - tau_friction - tau_gravity is the momentum that joint 1 gives the arm."""
    contact = ContactSettings(at_s=0.01, link=2, point_m=0.2, force_N=20.0, duration_s=0.04, shape="half_sine")
    settings = MechanicsSettings(
        **ELASTIC,
        damping_Nm_s=(2.0, 0.5),
        static_Nm=(0.25, 0.15),
        motor_coulomb_Nm=(0.3, 0.1),
        ripple_Nm=(0.2, 0.1),
        tilt_deg=10.0,
    )
    body = Body(Scenario(profile="M", start_deg=(10.0, 50.0), contacts=(contact,), mechanics=settings), 1e-4)
    body.start_scenario()
    pushes, momenta = [], []
    for _ in range(1_000):
        truth = truth_of(body)
        a1, a2, a3 = truth["theta"][:3]
        cosine = math.cos(truth["q"][1])
        momenta.append((a1 + 2.0 * a2 * cosine) * truth["dq"][0] + (a3 + a2 * cosine) * truth["dq"][1])
        pushes.append((truth["tau_J"] + truth["tau_ext"] - truth["tau_friction"] - truth["tau_gravity"])[0])
        body.advance((2.0, -0.5), TORQUE)
    gained = np.concatenate([[0.0], np.cumsum(np.add(pushes[1:], pushes[:-1]) * 0.5e-4)])
    assert np.abs(momenta).max() > 0.1
    assert np.abs(gained - momenta).max() < 1e-4


def test_truth_of_a_stiff_joint_with_rotor_balances_too():
    settings = MechanicsSettings(
        rotor_inertia_kg_m2=(0.3, 0.05), motor_coulomb_Nm=(0.3, 0.1), motor_viscous_Nm_s=(0.2, 0.1)
    )
    body = Body(Scenario(profile="M", start_deg=(10.0, 50.0), mechanics=settings), 1e-4)
    pushes, momenta = [], []
    for _ in range(1_000):
        truth = truth_of(body)
        a1, a2, a3 = truth["theta"][:3]
        cosine = math.cos(truth["q"][1])
        momenta.append((a1 + 2.0 * a2 * cosine) * truth["dq"][0] + (a3 + a2 * cosine) * truth["dq"][1])
        pushes.append((truth["tau_J"] - truth["tau_friction"])[0])
        body.advance((3.0, -0.5), TORQUE)
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


def test_the_same_scenario_gives_the_same_run_to_the_bit():
    runs = []
    for _ in range(2):
        body = Body(Scenario(mechanics=MechanicsSettings(**ELASTIC, sigma0_Nm_rad=(3000.0, 1500.0), tilt_deg=3.0)))
        blocks = []
        for cycle in range(200):
            body.advance((math.sin(0.05 * cycle), 0.3), TORQUE)
            blocks.append(np.concatenate([*truth_of(body).values(), *body.sample()]).tobytes())
        runs.append(blocks)
    assert runs[0] == runs[1]


def test_asking_for_the_truth_changes_nothing():
    ends = []
    for is_asked in (True, False):
        body = Body(Scenario(mechanics=MechanicsSettings(rotor_inertia_kg_m2=(0.1, 0.1), tilt_deg=3.0), noise=False))
        for cycle in range(100):
            if is_asked:
                truth_of(body)
            body.advance((math.sin(0.05 * cycle), 0.3), TORQUE)
        ends.append((body.sample(), np.concatenate([*truth_of(body).values()]).tobytes()))
    assert ends[0] == ends[1]


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"stifness_Nm_rad": [1.0, 1.0]}, "did you mean `mechanics.stiffness_Nm_rad`?"),
        ({"stiffness_Nm_rad": [1000.0]}, "`mechanics.stiffness_Nm_rad` has 1 values, 2 expected"),
        ({"stiffness_Nm_rad": [1000.0, 0.0]}, "needs a `rotor_inertia_kg_m2` above 0 kg m²"),
        ({"backlash_rad": [0.0, 0.01]}, "`mechanics.backlash_rad[1]` = 0.01 needs a `stiffness_Nm_rad` above 0"),
        ({"damping_Nm_s": [1.0, 0.0]}, "`mechanics.damping_Nm_s[0]` = 1 needs a `stiffness_Nm_rad` above 0"),
        ({"static_Nm": [0.03, 0.0]}, "`mechanics.static_Nm[0]` = 0.03 Nm is below the Coulomb friction of profile P"),
        ({"stop_low_deg": [-10.0, -10.0]}, "`mechanics.stop_low_deg` and `mechanics.stop_high_deg` come together"),
        (
            {"stop_low_deg": [10.0, -10.0], "stop_high_deg": [9.0, 10.0]},
            "`mechanics.stop_low_deg[0]` = 10 deg is not below",
        ),
        (
            {"stop_low_deg": [5.0, -10.0], "stop_high_deg": [9.0, 10.0]},
            "`start_deg[0]` = 0 deg is beyond the joint's stops",
        ),
        ({"tilt_deg": 91.0}, "`mechanics.tilt_deg` = 91.0 deg is above 90 deg"),
        ({"encoder_side": "gear"}, "`mechanics.encoder_side` = 'gear' must be one of motor, link"),
        (
            {"stop_low_deg": [-5.0, -10.0], "stop_high_deg": [9.0, 10.0], "stop_damping_Nm_s": [1e4, 1e4]},
            "is above 160000 rad/s",
        ),
    ],
)
def test_mechanics_that_cannot_be_are_refused_with_their_key(table, message):
    with pytest.raises(ConfigError) as refusal:
        parse(Scenario, {"mechanics": table})
    assert message in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_payload_of_nothing_has_no_centre_of_mass():
    with pytest.raises(ConfigError, match=r"`payloads\[0\]\.mass_kg` = 0 kg"):
        parse(Scenario, {"payloads": [{"at_s": 1.0, "mass_kg": 0.0, "center_m": [0.1, 0.0]}]})


def test_a_scenario_fits_a_payload_with_its_centre_of_mass():
    body = Body(Scenario(payloads=(PayloadSettings(0.0, 1.5, (0.05, 0.08), 0.01),)))
    body.start_scenario()
    a1, a2, a3 = truth_of(body)["theta"][:3]
    empty = ARMS["P"].theta()
    own = 1.5 * (0.35**2 + 0.08**2) + 0.01
    assert a3 - empty[2] == pytest.approx(own, rel=1e-12)
    assert a2 - empty[1] == pytest.approx(1.5 * 0.35 * 0.35, rel=1e-12)
    assert a1 - empty[0] == pytest.approx(1.5 * 0.35**2 + own, rel=1e-12)


def test_a_faster_arm_gets_more_substeps_up_to_their_bound():
    payload = [(0.0, (0.0, 0.0), 0.0)]
    counts = [
        MechanicsSettings(stiffness_Nm_rad=(k, k), rotor_inertia_kg_m2=(0.1, 0.1)).substeps(ARMS["S"], payload)
        for k in (100.0, 4e3, 3e4, 1e6)
    ]
    assert counts == sorted(counts)
    assert counts[0] == 1
    assert 1 < counts[1] < counts[2]
    assert counts[3] == LARGEST_SUBSTEPS
    assert MechanicsSettings().substeps(ARMS["S"], payload, touch_rad_s=2000.0) == 4


SPRING_MASS = """
import math, sys
import numpy as np
import firmware_sim.arm.touch_forces
from firmware_sim.arm.touch_settings import contact_table
from adacd_hil.compiled import compiled

@compiled
def touch(numbers, time_s, q1, q2, dq1, dq2, contact_state, rates_out):
    # a mass on a rail, tied to joint 1 by a spring: numbers [[stiffness, inertia]], state [angle, speed]
    torque = numbers[0, 0] * (contact_state[0] - q1)
    rates_out[0] = contact_state[1]
    rates_out[1] = -torque / numbers[0, 1]
    return torque, 0.0

firmware_sim.arm.touch_forces.touch = touch
sys.path.insert(0, sys.argv[1])
from general_arm import MechanicsSettings, one_joint, work_space
from firmware_sim.arm.mechanics import integrate_mechanics
from firmware_sim.arm.plant import MECHANICAL_STATE, fit_payload

arm, inertia = one_joint()
mechanics = MechanicsSettings(rotor_inertia_kg_m2=(0.1, 0.1)).numbers(arm)
state, contact, work = np.zeros(1, MECHANICAL_STATE)[0], np.array([0.02, 0.0]), work_space(2)
fit_payload(state, arm.numbers(), 0.0)
for index in range(500):
    integrate_mechanics(
        state, arm.numbers(), mechanics, contact_table(()), np.array([[400.0, 0.2]]), contact, index * 1e-4,
        0.0, 0.0, 0.0, 1e-4, 1, work
    )
total, spring = inertia + 0.1, 400.0
reduced = total * 0.2 / (total + 0.2)
swing = 0.02 * math.cos(math.sqrt(spring / reduced) * 0.05)
centre = 0.2 * 0.02 / (total + 0.2)
print(contact[0] - state["q"][0] - swing, centre + (swing * -0.2 / (total + 0.2)) - state["q"][0])
"""


@pytest.mark.slow
def test_things_with_a_state_of_their_own_are_integrated_with_the_arm():
    """A body tied to joint 1 by a spring swings against the arm as two masses do; the bound is RK4's."""
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    command = [sys.executable, "-c", SPRING_MASS, str(Path(__file__).parent)]
    finished = subprocess.run(command, env=environment, capture_output=True, check=True, text=True)
    away = [abs(float(text)) for text in finished.stdout.split()]
    assert len(away) == 2
    assert max(away) < 1e-10


def test_a_locked_elbow_of_these_tests_does_not_move():
    arm, _ = one_joint()
    locked = GeneralArm(dataclasses.replace(arm), RIGID)
    locked.run(100, 5.0, 5.0)
    assert locked.dq[1] == 0.0
    assert LOCKED_NM > 1e5
