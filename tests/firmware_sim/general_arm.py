"""The general integrator by itself, for the tests: an arm with mechanics, driven by torque targets."""

import dataclasses
import math

import numpy as np

from adacd_hil.compiled import compiled
from firmware_sim.arm.arms import ARMS, ArmProfile
from firmware_sim.arm.hardware_settings import MechanicsSettings
from firmware_sim.arm.joint_forces import MECHANICS_NUMBERS, gravity_torque
from firmware_sim.arm.mechanics import integrate_mechanics, observe, work_space
from firmware_sim.arm.plant import MECHANICAL_STATE, fit_payload, mass_matrix
from firmware_sim.arm.touch_forces import THING
from firmware_sim.arm.touch_settings import TICK_S, contact_table

NOBODY = contact_table(())
NO_TOUCH = np.zeros(0, THING)
NO_STATE = np.zeros(0)
LOCKED_NM = 1e6


@compiled
def run_arm(
    state, arm, mechanics, contact, touch_numbers, touch_state, first, target1, target2, count, substeps, work, history
):
    """Integrate `count` ticks of the targets (count,) and note the state after each one."""
    for index in range(count):
        time_s = (first + index) * TICK_S
        integrate_mechanics(
            state, arm, mechanics, contact, touch_numbers, touch_state,
            time_s, time_s, target1[index], target2[index], TICK_S, substeps, work,
        )  # fmt: skip
        history[index] = state


@compiled
def integrate(state, arm, mechanics, contact, things, touch_state, elapsed_s, target1, target2, step_s, count, work):
    """Integrate `count` steps of a rigid arm that nothing but the contact touches."""
    for index in range(count):
        integrate_mechanics(
            state, arm, mechanics, contact, things, touch_state,
            0.0, elapsed_s + index * step_s, target1, target2, step_s, 1, work,
        )  # fmt: skip


def run_rigid(state, numbers, contact, target1, target2, step_s, count=1, elapsed_s=0.0) -> None:
    """Integrate `count` steps of a rigid arm; `numbers`: an element of ARM_NUMBERS."""
    mechanics = np.zeros(1, MECHANICS_NUMBERS)[0]
    mechanics["is_free"] = numbers["coulomb_Nm"] == 0.0
    integrate(
        state, numbers, mechanics, contact, NO_TOUCH, NO_STATE,
        elapsed_s, target1, target2, step_s, count, work_space(0),
    )  # fmt: skip


def without_friction(name: str = "S") -> ArmProfile:
    """Nor any stops in its way."""
    return dataclasses.replace(ARMS[name], viscous_Nm_s=(0.0, 0.0), coulomb_Nm=(0.0, 0.0), stop_deg=(1e6, 1e6))


def one_joint(coulomb_Nm: float = 0.0, viscous_Nm_s: float = 0.0) -> tuple[ArmProfile, float]:
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


class GeneralArm:
    """An arm in the general integrator."""

    def __init__(
        self,
        arm: ArmProfile,
        settings: MechanicsSettings,
        q=(0.0, 0.0),
        dq=(0.0, 0.0),
        payload=(0.0, (0.0, 0.0), 0.0),
        substeps: int | None = None,
    ) -> None:
        self.arm, self.settings = arm, settings
        self.numbers, self.mechanics = settings.arm_numbers(arm), settings.numbers(arm)
        self.substeps = settings.substeps(arm, [payload]) if substeps is None else substeps
        self.state = np.zeros(1, MECHANICAL_STATE)[0]
        fit_payload(self.state, self.numbers, payload[0], *payload[1], payload[2])
        self.state["q"][:] = self.state["q_m"][:] = q
        self.state["dq"][:] = self.state["dq_m"][:] = dq
        self.state["temperature_C"][:] = settings.ambient_C
        self.work = work_space(0)
        self.tick = 0

    def run(self, count: int, target1=0.0, target2=0.0, contact=NOBODY) -> np.ndarray:
        """Run `count` ticks; targets are numbers or histories (count,). Gives the state after each tick."""
        targets = [np.broadcast_to(np.asarray(target, dtype=float), count).copy() for target in (target1, target2)]
        history = np.zeros(count, MECHANICAL_STATE)
        run_arm(
            self.state, self.numbers, self.mechanics, contact, NO_TOUCH, NO_STATE,
            self.tick, *targets, count, self.substeps, self.work, history,
        )  # fmt: skip
        self.tick += count
        return history

    def observe(self, contact=NOBODY) -> dict[str, np.ndarray]:
        """What is true now."""
        time_s = self.tick * TICK_S
        values = observe(
            self.state, self.numbers, self.mechanics, contact, NO_TOUCH, NO_STATE, time_s, time_s, self.work
        )
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

    def energy_J(self) -> float:
        """Kinetic energy, energy of the springs and height in the field of gravity; from the end of a tick."""
        state, settings = self.state, self.settings
        m11, m12, m22 = mass_matrix(state, state["q"][1])
        dq1, dq2 = self.dq
        energy = 0.5 * m11 * dq1**2 + m12 * dq1 * dq2 + 0.5 * m22 * dq2**2
        for joint in range(2):
            stiffness = settings.stiffness_Nm_rad[joint]
            if stiffness > 0.0:
                twist = state["q_m"][joint] - state["q"][joint]
                energy += 0.5 * settings.rotor_inertia_kg_m2[joint] * state["dq_m"][joint] ** 2
                energy += 0.5 * stiffness * max(abs(twist) - 0.5 * settings.backlash_rad[joint], 0.0) ** 2
        slope = 9.80665 * math.sin(math.radians(settings.tilt_deg))
        downhill = math.radians(settings.tilt_direction_deg)
        first, second = state["q"][0], state["q"][0] + state["q"][1]
        length = self.numbers["length_m"][0]
        along1 = self.numbers["moment_kg_m"] + state["payload_kg"] * length
        along2, beside2 = state["beta"] / length, state["sigma"] / length
        height = along1 * math.cos(downhill - first) + along2 * math.cos(downhill - second)
        return energy - slope * (height + beside2 * math.sin(downhill - second))

    def gravity_torque(self, q) -> np.ndarray:
        return np.array(gravity_torque(self.state, self.numbers, self.mechanics, *q))
