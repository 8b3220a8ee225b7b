"""The arm against MuJoCo, an engine that is not ours: trajectories with springs and backlash."""

import math

import mujoco
import numpy as np
import pytest
from general_arm import NO_PAYLOAD, GeneralArm, without_friction
from long_cases import long_but

from adacd_hil.control.motions import corner_to_corner
from firmware_sim.arm.hardware_settings import MechanicsSettings
from firmware_sim.arm.plant import CURRENT_LOOP_RAD_S
from firmware_sim.arm.touch_settings import TICK_S

POINT_PAYLOAD = (1.0, (0.0, 0.0), 0.0)
BODY_PAYLOAD = (1.5, (0.05, 0.08), 0.01)
CORNER = np.radians([-30.0, -60.0])
AS_RIGID = MechanicsSettings(heat_capacity_J_K=(1e9, 1e9))
SPRINGS = {"stiffness_Nm_rad": (6000.0, 2000.0), "rotor_inertia_kg_m2": (0.3, 0.05)}


def engine(arm: GeneralArm, payload=NO_PAYLOAD) -> mujoco.MjModel:
    """Build the arm: links as bodies, rotors as wheels of their own, springs as tendons between wheel and joint."""
    settings = arm.settings
    lengths_m, masses_kg, centers_m, inertias = (
        arm.arm.link_length_m, arm.arm.mass_kg, arm.arm.center_m, arm.arm.inertia_kg_m2,
    )  # fmt: skip
    slope = 9.80665 * math.sin(math.radians(settings.tilt_deg))
    downhill = math.radians(settings.tilt_direction_deg)
    mass_kg, (along_m, beside_m), inertia = payload
    load = ""
    if mass_kg > 0.0:
        # an engine wants some inertia about every axis; only the one about z moves
        load = (
            f'<body pos="{lengths_m[1]} 0 0"><inertial pos="{along_m} {beside_m} 0" mass="{mass_kg}" '
            f'diaginertia="{max(inertia, 1e-12)} {max(inertia, 1e-12)} {max(inertia, 1e-12)}"/></body>'
        )
    wheels, tendons = "", ""
    for joint in range(2):
        if settings.stiffness_Nm_rad[joint] > 0.0:
            rotor = settings.rotor_inertia_kg_m2[joint]
            wheels += (
                f'<body><joint name="m{joint}" type="hinge" axis="0 0 1"/>'
                f'<inertial pos="0 0 0" mass="1" diaginertia="{rotor} {rotor} {rotor}"/></body>'
            )
            half = 0.5 * settings.backlash_rad[joint]
            tendons += (
                f'<fixed stiffness="{settings.stiffness_Nm_rad[joint]}" springlength="{-half} {half}" '
                f'damping="{settings.damping_Nm_s[joint]}">'
                f'<joint joint="m{joint}" coef="1"/><joint joint="j{joint}" coef="-1"/></fixed>'
            )
    text = f"""
    <mujoco>
      <compiler angle="radian" inertiafromgeom="false" balanceinertia="false" boundinertia="1e-12"/>
      <option timestep="{TICK_S}" integrator="RK4"
        gravity="{slope * math.cos(downhill)} {slope * math.sin(downhill)} 0"/>
      <worldbody>
        <body name="link1">
          <joint name="j0" type="hinge" axis="0 0 1"/>
          <inertial pos="{centers_m[0]} 0 0" mass="{masses_kg[0]}"
            diaginertia="{inertias[0]} {inertias[0]} {inertias[0]}"/>
          <body name="link2" pos="{lengths_m[0]} 0 0">
            <joint name="j1" type="hinge" axis="0 0 1"/>
            <inertial pos="{centers_m[1]} 0 0" mass="{masses_kg[1]}"
              diaginertia="{inertias[1]} {inertias[1]} {inertias[1]}"/>
            {load}
          </body>
        </body>
        {wheels}
      </worldbody>
      <tendon>{tendons}</tendon>
    </mujoco>"""
    return mujoco.MjModel.from_xml_string(text)


def place(model: mujoco.MjModel, name: str) -> int:
    return int(model.joint(name).dofadr[0])


def paper_torque(arm: GeneralArm, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Play a host that moves the motors by joint PD; gives q each millisecond and the mean torque of each tick."""
    amplitude, half_s = np.radians([30.0, 60.0]), np.array([1.125, 4.5])
    q_d, dq_d, ddq_d = np.zeros(2), np.zeros(2), np.zeros(2)
    positions, torques = [], []
    is_elastic = arm.settings.stiffness_Nm_rad[0] > 0.0
    turn = CURRENT_LOOP_RAD_S * TICK_S
    share = -math.expm1(-turn) / turn
    for cycle in range(round(seconds * 1e3)):
        corner_to_corner(cycle * 1e-3, amplitude, half_s, q_d, dq_d, ddq_d)
        shaft = arm.state["q_m"] if is_elastic else arm.q
        speed = arm.state["dq_m"] if is_elastic else arm.dq
        target = np.array([500.0, 40.0]) * (q_d - shaft) + np.array([25.0, 1.5]) * (dq_d - speed)
        before = arm.state["tau_m"].copy()
        history = arm.run(10, *target)
        reached = np.vstack([before, history["tau_m"][:-1]])
        torques.append(target + (reached - target) * share)
        positions.append(arm.q.copy())
    return np.array(positions), np.concatenate(torques)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "payload", "seconds", "bound_rad"),
    long_but(
        1,
        [
            (MechanicsSettings(**SPRINGS, damping_Nm_s=(3.0, 1.0), tilt_deg=20.0), BODY_PAYLOAD, 2.0, 1e-5),
            (AS_RIGID, POINT_PAYLOAD, 10.0, 1e-4),
            (MechanicsSettings(tilt_deg=20.0, tilt_direction_deg=-60.0), BODY_PAYLOAD, 10.0, 1e-4),
            # a spring that is off by 1 % moves the links by 4e-5 rad
            (MechanicsSettings(**SPRINGS), POINT_PAYLOAD, 10.0, 1e-5),
            # flanks that rattle undamped forget their past: each knock enlarges what the knock before it left
            (MechanicsSettings(**SPRINGS, backlash_rad=(2e-3, 2e-3)), NO_PAYLOAD, 2.0, 1e-3),
        ],
    ),
)
def test_the_paper_motion_is_that_of_mujoco_within_a_milliradian(settings, payload, seconds, bound_rad):
    """The drives' torque of our run, played open loop into the engine."""
    arm = GeneralArm(without_friction("S"), settings, q=CORNER, payload=payload)
    model = engine(arm, payload)
    data = mujoco.MjData(model)
    links = [place(model, "j0"), place(model, "j1")]
    data.qpos[links] = CORNER
    motors = links
    if settings.stiffness_Nm_rad[0] > 0.0:
        motors = [place(model, "m0"), place(model, "m1")]
        data.qpos[motors] = CORNER
    positions, torques = paper_torque(arm, seconds)
    found = np.zeros_like(positions)
    for index, torque in enumerate(torques):
        data.qfrc_applied[motors] = torque
        mujoco.mj_step(model, data)
        if index % 10 == 9:
            found[index // 10] = data.qpos[links]
    assert np.ptp(positions, axis=0).min() > 0.2
    assert np.abs(torques).max() > 2.0
    print(f"largest distance {np.abs(found - positions).max():.1e} rad")
    assert np.abs(found - positions).max() < bound_rad
