"""The arm of the touch trials in MuJoCo, an engine that is not ours: mechanics and friction are the engine's.

Drives' velocity loops, encoders and torque sensors stay those of tests/scheme, sampled four times a period.
"""

import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "scheme"))

from planar_arm import ENCODER_LSB_RAD, TRACKING_RAD_S

from adacd_hil.records import Vector

TICKS = 4
LENGTH_M = 0.35
"""From joint 1 to joint 2; which bodies have the inertia then, follows."""


def model_of(theta: Vector, tick_s: float) -> mujoco.MjModel:
    """Build the arm with parameters theta (7,): two bodies on hinges with damping and dry friction, no gravity.

    Raises ValueError if no two bodies have such inertia.
    """
    a1, a2, a3, *friction = (float(value) for value in theta)
    if not 0.0 < a2 * a2 < a3 * (a1 - a3):
        raise ValueError(f"no two links have a1 = {a1:g}, a2 = {a2:g}, a3 = {a3:g} kg m²")
    center_m = LENGTH_M * np.sqrt(a3 / (a1 - a3))
    mass = a2 / (LENGTH_M * center_m)
    second, first = a3 - mass * center_m**2, a1 - a3 - mass * LENGTH_M**2
    text = f"""
    <mujoco>
      <compiler angle="radian" inertiafromgeom="false" balanceinertia="false" boundinertia="1e-12"/>
      <option timestep="{tick_s}" integrator="implicitfast" gravity="0 0 0" iterations="50" tolerance="1e-12"/>
      <default><joint type="hinge" axis="0 0 1" solreffriction="{2.0 * tick_s} 1" solimpfriction="0.99 0.999 1e-4"/>
      </default>
      <worldbody><body>
        <joint name="j0" damping="{friction[0]}" frictionloss="{friction[2]}"/>
        <inertial pos="0 0 0" mass="1" diaginertia="{first} {first} {first}"/>
        <body pos="{LENGTH_M} 0 0">
          <joint name="j1" damping="{friction[1]}" frictionloss="{friction[3]}"/>
          <inertial pos="{center_m} 0 0" mass="{mass}" diaginertia="{second} {second} {second}"/>
        </body>
      </body></worldbody>
    </mujoco>"""
    return mujoco.MjModel.from_xml_string(text)


class MujocoArm:
    """Moves q, dq, tracked_q and tracked_dq (2,) in place, as `planar_arm.advance`."""

    def __init__(self) -> None:
        self._theta: Vector | None = None
        self._model: Any = None
        self._data: Any = None

    def advance(
        self, q: Vector, dq: Vector, tracked_q: Vector, tracked_dq: Vector, tau: Vector, theta: Vector, period_s: float
    ) -> None:
        """Move the arm by one period under the joint torques tau (2,)."""
        tick_s = period_s / TICKS
        if self._theta is None or not np.array_equal(theta, self._theta):
            self._theta = theta.copy()
            self._model = model_of(theta, tick_s)
            self._data = mujoco.MjData(self._model)
        data = self._data
        data.qpos[:], data.qvel[:], data.qfrc_applied[:] = q, dq, tau
        for _ in range(TICKS):
            mujoco.mj_step(self._model, data)
            error = np.round(data.qpos / ENCODER_LSB_RAD) * ENCODER_LSB_RAD - tracked_q
            tracked_q += tick_s * (tracked_dq + 2.0 * TRACKING_RAD_S * error)
            tracked_dq += tick_s * TRACKING_RAD_S**2 * error
        q[:], dq[:] = data.qpos, data.qvel
