"""A frictionless arm touched by things, integrated by classical RK4, for tests of `firmware_sim.arm.touch_forces`."""

import math

import numpy as np

from adacd_hil.compiled import compiled
from firmware_sim.arm.arms import ARMS, ArmProfile
from firmware_sim.arm.plant import MECHANICAL_STATE, accelerate, fit_payload, mass_matrix
from firmware_sim.arm.touch_forces import THING_STATE, TOUCH_HEADER, TOUCH_TRUTH, change_touch, describe_touch, touch
from firmware_sim.arm.touch_settings import TICK_S, contact_table
from firmware_sim.body.body import initial_touch_state, touch_table
from firmware_sim.scenario.scenario import Scenario

HISTORY = ("time_s", "q1", "q2", "dq1", "dq2", "force", "link", "index", "power", "energy", "tau1", "tau2")
NOBODY = contact_table(())


@compiled
def _rates(mechanical, arm, things, time_s, motor1, motor2, y, rates):
    ext1, ext2 = touch(things, time_s, y[0], y[1], y[2], y[3], y[4:], rates[4:])
    ddq1, ddq2, _, _ = accelerate(mechanical, arm, 1, 1, motor1 + ext1, motor2 + ext2, y[1], y[2], y[3])
    rates[0], rates[1], rates[2], rates[3] = y[2], y[3], ddq1, ddq2


@compiled
def play(mechanical, arm, things, nobody, y, start_s, tick_count, substeps, motor, history, states):
    """Integrate `tick_count` ticks; one row of history and one state per tick, before it."""
    step_s = TICK_S / substeps
    a, b, c, d = np.zeros(y.size), np.zeros(y.size), np.zeros(y.size), np.zeros(y.size)
    truth = np.zeros(5)
    out = truth.view(TOUCH_TRUTH)[0]
    for tick in range(tick_count):
        time_s = start_s + tick * TICK_S
        change_touch(things, time_s, y[0], y[1], y[4:], False)
        tau1, tau2 = describe_touch(
            things, time_s, y[0], y[1], y[2], y[3], y[4:], nobody, -1.0, 0.0, arm["length_m"][0], out
        )
        history[tick, 0] = time_s
        history[tick, 1:5] = y[:4]
        history[tick, 5:10] = truth
        history[tick, 10], history[tick, 11] = tau1, tau2
        states[tick] = y[4:]
        for substep in range(substeps):
            at_s = time_s + substep * step_s
            _rates(mechanical, arm, things, at_s, motor[0], motor[1], y, a)
            _rates(mechanical, arm, things, at_s + 0.5 * step_s, motor[0], motor[1], y + 0.5 * step_s * a, b)
            _rates(mechanical, arm, things, at_s + 0.5 * step_s, motor[0], motor[1], y + 0.5 * step_s * b, c)
            _rates(mechanical, arm, things, at_s + step_s, motor[0], motor[1], y + step_s * c, d)
            y += step_s / 6.0 * (a + 2.0 * (b + c) + d)


class TouchedArm:
    """One scenario's arm without friction, and the things that touch it."""

    def __init__(self, q=(0.0, 0.0), dq=(0.0, 0.0), motor=(0.0, 0.0), substeps=1, damping=0.0, **scenario) -> None:
        start_deg = tuple(math.degrees(angle) for angle in q)
        self.scenario = Scenario(start_deg=start_deg, **scenario)
        self.arm: ArmProfile = ARMS[self.scenario.profile]
        self.numbers = self.arm.numbers()
        self.numbers["viscous_Nm_s"], self.numbers["coulomb_Nm"] = damping, 0.0
        self.things = touch_table(self.scenario)
        self.mechanical = np.zeros(1, MECHANICAL_STATE)[0]
        fit_payload(self.mechanical, self.numbers, self.scenario.payload_kg)
        self.mechanical["q"], self.mechanical["dq"][:] = q, dq
        self.y = np.concatenate([q, dq, initial_touch_state(self.things)])
        self.motor = np.array(motor, dtype=np.float64)
        self.substeps = substeps
        self.time_s = 0.0
        self.states = np.zeros((0, 0))

    def play(self, duration_s: float) -> dict[str, np.ndarray]:
        """Go on for a while; histories by name, one value per tick, and the touch states."""
        count = round(duration_s / TICK_S)
        history = np.zeros((count, len(HISTORY)))
        self.states = np.zeros((count, self.y.size - 4))
        play(
            self.mechanical, self.numbers, self.things, NOBODY, self.y, self.time_s, count, self.substeps, self.motor,
            history, self.states,
        )  # fmt: skip
        self.time_s += count * TICK_S
        return dict(zip(HISTORY, history.T, strict=True))

    def own(self, thing: int, name: str) -> np.ndarray:
        """History of one value of one thing's state."""
        return self.states[:, TOUCH_HEADER:].copy().view(THING_STATE)[name][:, thing]

    def kinetic_J(self, history: dict[str, np.ndarray]) -> np.ndarray:
        """Kinetic energy of the arm over time."""
        rows = [mass_matrix(self.mechanical, q2) for q2 in history["q2"]]
        m11, m12, m22 = np.array(rows).T
        dq1, dq2 = history["dq1"], history["dq2"]
        return 0.5 * m11 * dq1**2 + m12 * dq1 * dq2 + 0.5 * m22 * dq2**2

    def mobility(self, link: int, point_m: float, q, normal) -> float:
        """Inverse of the arm's effective mass at a point of a link along a direction, 1/kg."""
        m11, m12, m22 = mass_matrix(self.mechanical, q[1])
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

    def tip(self, q1, q2) -> np.ndarray:
        """Where the tip is, world x and y."""
        length1_m, length2_m = self.arm.link_length_m
        return np.array(
            [length1_m * np.cos(q1) + length2_m * np.cos(q1 + q2), length1_m * np.sin(q1) + length2_m * np.sin(q1 + q2)]
        )
