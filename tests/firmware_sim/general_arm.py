"""The emulator's integrator by itself, for the tests: an arm with mechanics, torque targets, contacts and things."""

import dataclasses
import math

import numpy as np
import pinocchio

from adacd_hil.compiled import compiled
from adacd_hil.log.types.truth_topic import TRUTH_LAYOUT
from firmware_sim.arm.arms import ARMS, EmulatedArm
from firmware_sim.arm.hardware_settings import MechanicsSettings
from firmware_sim.arm.joint_forces import Surroundings, gravity_torque
from firmware_sim.arm.mechanics import integrate_mechanics, observe, work_space
from firmware_sim.arm.plant import MECHANICAL_STATE, fit_payload, mass_matrix
from firmware_sim.arm.sensing import DriveMode
from firmware_sim.arm.touch_forces import (
    THING,
    THING_STATE,
    TOUCH_HEADER,
    TOUCH_TRUTH,
    change_touch,
    describe_touch,
)
from firmware_sim.arm.touch_settings import TICK_S, contact_table
from firmware_sim.body.body import Body, initial_touch_state, touch_table
from firmware_sim.scenario.scenario import Scenario

TORQUE, OFF, BRAKE = ((mode, mode) for mode in (DriveMode.TORQUE, DriveMode.OFF, DriveMode.BRAKE))
"""Modes of both drives."""
NOBODY = contact_table(())
RIGID = MechanicsSettings()
NOTHING = np.zeros(0, THING)
NO_PAYLOAD = (0.0, (0.0, 0.0), 0.0)
LOCKED_NM = 1e6
LENGTH_M = 0.35  # of link 1, in every profile
SEEN = ("time_s", "q1", "q2", "dq1", "dq2", "force", "link", "index", "power", "energy", "tau1", "tau2")


def truth_of(body: Body) -> dict[str, np.ndarray]:
    """Return the fields of a body's truth, all of which it must fill."""
    block = np.full(TRUTH_LAYOUT.size, np.nan)
    body.truth(block)
    assert np.isfinite(block).all()
    return {name: block[place] for name, place in TRUTH_LAYOUT.slices.items()}


def point_of(link: int, point_m: float, q) -> np.ndarray:
    """Return where a point of a link is, world x and y."""
    along = [np.array([np.cos(angle), np.sin(angle)]) for angle in (q[0], q[0] + q[1])]
    return point_m * along[0] if link == 1 else LENGTH_M * along[0] + point_m * along[1]


def normal_of(link: int, q) -> np.ndarray:
    """Return the normal of a link on the side of +q."""
    angle = q[0] if link == 1 else q[0] + q[1]
    return np.array([-math.sin(angle), math.cos(angle)])


@compiled
def run_arm(
    state, arm, mechanics, contact, things, touch_state, first, target1, target2, substeps, work, history, seen, states
):
    """Integrate the ticks of the targets (count,): the state after each one and, unless empty, touches before it."""
    out = np.zeros(5).view(TOUCH_TRUTH)[0]
    for index in range(target1.size):
        time_s = (first + index) * TICK_S
        if seen.size != 0:
            q1, q2, dq1, dq2 = state["q"][0], state["q"][1], state["dq"][0], state["dq"][1]
            change_touch(things, time_s, q1, q2, touch_state, contact.size != 0)
            tau1, tau2 = describe_touch(
                things, time_s, q1, q2, dq1, dq2, touch_state, contact, 0.0, time_s, arm["link_length_m"][0], out
            )
            seen[index] = (
                time_s, q1, q2, dq1, dq2, out["force_N"], out["link"], out["index"], out["power_W"], out["energy_J"],
                tau1, tau2,
            )  # fmt: skip
            states[index] = touch_state
        around = Surroundings(state, arm, mechanics, contact, things)
        integrate_mechanics(around, touch_state, time_s, time_s, target1[index], target2[index], TICK_S, substeps, work)
        history[index] = state


def without_friction(name: str = "S", viscous_Nm_s: float = 0.0) -> EmulatedArm:
    """Nor any stops in its way; viscous friction if asked for."""
    return dataclasses.replace(
        ARMS[name], viscous_Nm_s=(viscous_Nm_s, viscous_Nm_s), coulomb_Nm=(0.0, 0.0), stop_deg=(1e6, 1e6)
    )


def one_joint(coulomb_Nm: float = 0.0, viscous_Nm_s: float = 0.0) -> tuple[EmulatedArm, float]:
    """An arm whose elbow is locked by friction, and the inertia about its shoulder with the elbow stretched.

    It turns as far as it is driven.
    """
    arm = dataclasses.replace(
        ARMS["S"],
        viscous_Nm_s=(viscous_Nm_s, 0.0),
        coulomb_Nm=(coulomb_Nm, LOCKED_NM),
        rated_torque_Nm=(1e3, 1e3),
        stop_deg=(1e6, 1e6),
    )
    alpha, beta, gamma = arm.inertia()
    return arm, alpha + gamma + 2.0 * beta


def pinocchio_arm(
    arm: EmulatedArm, payload=NO_PAYLOAD, tilt_rad: float = 0.0, direction_rad: float = 0.0
) -> pinocchio.Model:
    """The arm in an engine that is not ours, on a tilted base."""
    model = pinocchio.Model()
    downhill = np.array([math.cos(direction_rad), math.sin(direction_rad), 0.0])
    slope = math.sin(tilt_rad) * downhill - math.cos(tilt_rad) * np.array([0.0, 0.0, 1.0])
    model.gravity = pinocchio.Motion(9.80665 * slope, np.zeros(3))
    parent, place = 0, pinocchio.SE3.Identity()
    for joint in range(2):
        parent = model.addJoint(parent, pinocchio.JointModelRZ(), place, f"joint{joint + 1}")
        about_center = np.diag([0.0, 0.0, arm.inertia_kg_m2[joint]])
        inertia = pinocchio.Inertia(arm.mass_kg[joint], np.array([arm.center_m[joint], 0.0, 0.0]), about_center)
        model.appendBodyToJoint(parent, inertia, pinocchio.SE3.Identity())
        place = pinocchio.SE3(np.eye(3), np.array([arm.link_length_m[joint], 0.0, 0.0]))
    mass_kg, center_m, inertia_kg_m2 = payload
    body = pinocchio.Inertia(mass_kg, np.array([*center_m, 0.0]), np.diag([0.0, 0.0, inertia_kg_m2]))
    model.appendBodyToJoint(parent, body, place)
    return model


class GeneralArm:
    """An arm in the integrator."""

    def __init__(
        self,
        arm: EmulatedArm,
        settings: MechanicsSettings = RIGID,
        q=(0.0, 0.0),
        dq=(0.0, 0.0),
        payload=NO_PAYLOAD,
        substeps: int | None = None,
        things: np.ndarray = NOTHING,
        tau=(0.0, 0.0),
    ) -> None:
        self.arm, self.settings, self.things = arm, settings, things
        self.numbers, self.mechanics = settings.arm_numbers(arm), settings.numbers(arm)
        self.substeps = settings.substeps(arm, [payload]) if substeps is None else substeps
        self.state = np.zeros(1, MECHANICAL_STATE)[0]
        fit_payload(self.state, self.numbers, payload[0], *payload[1], payload[2])
        self.state["q"][:] = self.state["q_m"][:] = q
        self.state["dq"][:] = self.state["dq_m"][:] = dq
        self.state["tau_m"][:] = tau
        self.state["temperature_C"][:] = settings.ambient_C
        self.touch_state = initial_touch_state(things)
        self.work = work_space(self.touch_state.size)
        self.tick = 0

    def run(self, count: int, target1=0.0, target2=0.0, contact=NOBODY, seen=None, states=None) -> np.ndarray:
        """Run `count` ticks; targets are numbers or histories (count,). Gives the state after each tick."""
        targets = [np.broadcast_to(np.asarray(target, dtype=float), count).copy() for target in (target1, target2)]
        history = np.zeros(count, MECHANICAL_STATE)
        run_arm(
            self.state, self.numbers, self.mechanics, contact, self.things, self.touch_state, self.tick, *targets,
            self.substeps, self.work, history,
            np.zeros((0, len(SEEN))) if seen is None else seen, np.zeros((0, 0)) if states is None else states,
        )  # fmt: skip
        self.tick += count
        return history

    def observe(self, contact=NOBODY) -> dict[str, np.ndarray]:
        """External torque, friction and gravity torque now."""
        time_s = self.tick * TICK_S
        around = Surroundings(self.state, self.numbers, self.mechanics, contact, self.things)
        values = observe(around, self.touch_state, time_s, time_s, self.work)
        return {name: np.array(values[2 * i : 2 * i + 2]) for i, name in enumerate(("tau_ext", "friction", "gravity"))}

    @property
    def q(self) -> np.ndarray:
        return self.state["q"]

    @property
    def dq(self) -> np.ndarray:
        return self.state["dq"]

    @property
    def joint_torque(self) -> np.ndarray:
        return self.state["tau_J"]

    def mass_matrix(self) -> np.ndarray:
        m11, m12, m22 = mass_matrix(self.state, self.q[1])
        return np.array([[m11, m12], [m12, m22]])

    def energy_J(self) -> float:
        """Kinetic energy, energy of the springs and height in the field of gravity; from the end of a tick."""
        state, settings = self.state, self.settings
        energy = 0.5 * float(self.dq @ self.mass_matrix() @ self.dq)
        for joint in range(2):
            stiffness = settings.stiffness_Nm_rad[joint]
            if stiffness > 0.0:
                twist = state["q_m"][joint] - state["q"][joint]
                energy += 0.5 * settings.rotor_inertia_kg_m2[joint] * state["dq_m"][joint] ** 2
                energy += 0.5 * stiffness * max(abs(twist) - 0.5 * settings.backlash_rad[joint], 0.0) ** 2
        slope = 9.80665 * math.sin(math.radians(settings.tilt_deg))
        downhill = math.radians(settings.tilt_direction_deg)
        first, second = state["q"][0], state["q"][0] + state["q"][1]
        length = self.numbers["link_length_m"][0]
        along1 = self.numbers["moment_kg_m"] + state["payload_kg"] * length
        along2, beside2 = state["beta"] / length, state["sigma"] / length
        height = along1 * math.cos(downhill - first) + along2 * math.cos(downhill - second)
        return energy - slope * (height + beside2 * math.sin(downhill - second))

    def gravity_torque(self, q) -> np.ndarray:
        return np.array(gravity_torque(self.state, self.numbers, self.mechanics, *q))


class TouchedArm(GeneralArm):
    """One scenario's arm without dry friction and stops, under constant torque, and the things that touch it."""

    def __init__(self, q=(0.0, 0.0), dq=(0.0, 0.0), motor=(0.0, 0.0), substeps=1, damping=0.0, **scenario) -> None:
        start_deg = tuple(math.degrees(angle) for angle in q)
        self.scenario = Scenario(start_deg=start_deg, **scenario)
        arm = without_friction(self.scenario.profile, damping)
        super().__init__(arm, q=q, dq=dq, substeps=substeps, things=touch_table(self.scenario))
        self.motor = np.array(motor, dtype=np.float64)
        self.states = np.zeros((0, 0))

    def play(self, duration_s: float) -> dict[str, np.ndarray]:
        """Go on for a while; histories by name, one value per tick before it, and the touch states."""
        count = round(duration_s / TICK_S)
        seen, self.states = np.zeros((count, len(SEEN))), np.zeros((count, self.touch_state.size))
        self.state["tau_m"][:] = self.motor
        self.run(count, *self.motor, seen=seen, states=self.states)
        return dict(zip(SEEN, seen.T, strict=True))

    def own(self, thing: int, name: str) -> np.ndarray:
        """History of one value of one thing's state."""
        return self.states[:, TOUCH_HEADER:].copy().view(THING_STATE)[name][:, thing]

    def mobility(self, link: int, point_m: float, q, normal) -> float:
        """Inverse of the arm's effective mass at a point of a link along a direction, 1/kg."""
        m11, m12, m22 = mass_matrix(self.state, q[1])
        row = np.array(normal) @ self.jacobian(link, point_m, q)
        return float(row @ np.linalg.solve(np.array([[m11, m12], [m12, m22]]), row))

    def jacobian(self, link: int, point_m: float, q) -> np.ndarray:
        """Jacobian of a point of a link, written out by hand."""
        length1_m = self.arm.link_length_m[0]
        s1, c1, s12, c12 = math.sin(q[0]), math.cos(q[0]), math.sin(q[0] + q[1]), math.cos(q[0] + q[1])
        if link == 1:
            return point_m * np.array([[-s1, 0.0], [c1, 0.0]])
        return np.array(
            [[-length1_m * s1 - point_m * s12, -point_m * s12], [length1_m * c1 + point_m * c12, point_m * c12]]
        )
