"""The emulated arm: its state, its properties, and the measurements of its devices.

Per SYNC k the device nodes `sample` (and record the `truth` of the same instant), then `advance` to SYNC k + 1 with
the set-point that was latched at SYNC k; inside a period the body runs on the drives' 100 µs ticks
(`firmware_sim.body.body_ticks`). The state lies in two vectors, that of the touches apart, and in the generators of
noise. Bodies, hands and walls are a table for compiled code, with the rates at which they make the arm swing.
"""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.log.types.truth_topic import TRUTH_LAYOUT
from adacd_hil.records import Vector
from adacd_hil.structured import Structured
from firmware_sim.arm.arms import EmulatedArm
from firmware_sim.arm.mechanics import work_space
from firmware_sim.arm.plant import fit_payload
from firmware_sim.arm.sensing import Measurement, TorqueNoise
from firmware_sim.arm.touch_forces import BODY, HAND, THING, THING_PLACES, TOUCH_HEADER, TOUCH_TRUTH, WALL
from firmware_sim.arm.touch_settings import (
    FADE_M_S,
    TICK_S,
    BodySettings,
    HandSettings,
    WallSettings,
    contact_table,
    ticks,
)
from firmware_sim.body.body_ticks import (
    BODY_NUMBERS,
    BODY_STATE,
    PAYLOAD_CHANGE,
    advance_body,
    fill_truth,
    sample_body,
)
from firmware_sim.body.motor import error_code, motor_numbers, motor_state
from firmware_sim.body.sensors import (
    NOISE_TICKS,
    EncoderNoise,
    encoder_numbers,
    read_angle,
    transducer_numbers,
    transducer_state,
)
from firmware_sim.scenario.scenario import PayloadSettings, Scenario

PERIOD_TICKS: Final = 10
"""Ticks of a period of 1 ms."""
_POSES: Final = 181
_POINTS: Final = 61
"""Grid on which the smallest effective mass of the arm is searched: 1° of the elbow, 1/60 of the link."""
_FASTEST_BLOW_M_S: Final = 2.0
"""Fastest blow that `largest_rate_rad_s` covers: the tip of both links, straight, at 180 deg/s."""


def _largest_mobility(arm: EmulatedArm, link: int, points_m: Vector) -> float:
    """Return the largest 1/mass, 1/kg, by which a force at one of these points of a link moves it, in any pose.

    The arm carries no payload. points_m: distances from the joint that carries the link.
    """
    alpha, beta, gamma = arm.inertia()
    length1_m = arm.link_length_m[0]
    elbow_rad, point_m = np.meshgrid(np.linspace(0.0, math.pi, _POSES), points_m)
    if link == 1:
        point_m, length1_m = np.zeros_like(point_m), float(points_m.max())
    # At q₁ = 0. In absolute link angles the point's velocity is l₁ φ̇₁ (0, 1) + p φ̇₂ (−sin q₂, cos q₂), the mass matrix
    # [[α, β cos q₂], [β cos q₂, γ]]; its inverse lies between two Jacobians.
    coupling = beta * np.cos(elbow_rad)
    determinant = alpha * gamma - coupling**2
    j21, j12, j22 = length1_m, -point_m * np.sin(elbow_rad), point_m * np.cos(elbow_rad)
    w11 = j12 * j12 * alpha / determinant
    w12 = (j12 * j22 * alpha - j12 * j21 * coupling) / determinant
    w22 = (j21 * j21 * gamma - 2.0 * j21 * j22 * coupling + j22 * j22 * alpha) / determinant
    largest = 0.5 * (w11 + w22) + np.sqrt(0.25 * (w11 - w22) ** 2 + w12**2)
    return float(largest.max())


def _row(
    kind: int,
    arm: EmulatedArm,
    thing: BodySettings | HandSettings | WallSettings,
    angle_deg: float | None,
    stiffness: float,
    damping: float,
    mobility: float,
) -> np.void:
    """Return a row of THING for a body, hand or wall, with its equally named settings; fields that it lacks are NaN.

    mobility: the largest 1/mass, 1/kg, that spring and damper meet.
    """
    row: np.void = np.full(THING.itemsize // 8, np.nan).view(THING)[0]
    for name in THING.names or ():
        if getattr(thing, name, None) is not None:
            row[name] = getattr(thing, name)
    row["kind"] = kind
    row["onset_s"] = ticks(thing.at_s) * TICK_S
    row["end_s"] = math.inf if thing.duration_s is None else (ticks(thing.at_s) + ticks(thing.duration_s)) * TICK_S
    row["length1_m"], row["length2_m"] = arm.link_length_m
    row["angle_rad"] = math.nan if angle_deg is None else math.radians(angle_deg)
    row["stiffness"], row["damping"] = stiffness, damping
    row["stiff_rate_rad_s"], row["damped_rate_1_s"] = math.sqrt(stiffness * mobility), damping * mobility
    return row


def _body_row(arm: EmulatedArm, body: BodySettings) -> np.void:
    points_m = np.linspace(0.0, arm.link_length_m[body.link - 1], _POINTS)
    mobility = _largest_mobility(arm, body.link, points_m) + 1.0 / body.mass
    row = _row(BODY, arm, body, body.free_deg, body.stiffness, body.damping_N_s_m, mobility)
    row["mass_kg"] = body.mass
    return row


def _hand_row(arm: EmulatedArm, hand: HandSettings) -> np.void:
    mobility = _largest_mobility(arm, hand.link, np.array([hand.point_m]))
    row = _row(HAND, arm, hand, hand.direction_deg, hand.stiffness_N_m, hand.damping_N_s_m, mobility)
    if hand.move_to_m is not None:
        row["x_m"], row["y_m"] = hand.move_to_m
    return row


def _wall_row(arm: EmulatedArm, wall: WallSettings) -> np.void:
    mobility = max(_largest_mobility(arm, link, np.array([arm.link_length_m[link - 1]])) for link in (1, 2))
    row = _row(WALL, arm, wall, wall.normal_deg, wall.stiffness_N_m, wall.damping_s_m, mobility)
    # ∂F/∂δ̇ = K χ δ is largest at the deepest point of a blow with v, about v/√(K/μ).
    row["damped_rate_1_s"] = row["stiff_rate_rad_s"] * wall.damping_s_m * _FASTEST_BLOW_M_S
    return row


def touch_table(scenario: Scenario) -> Structured:
    """Return a scenario's bodies, then hands, then walls, as a table (n,) of dtype THING for compiled functions."""
    arm = scenario.arm
    rows = [_body_row(arm, body) for body in scenario.bodies]
    rows += [_hand_row(arm, hand) for hand in scenario.hands]
    rows += [_wall_row(arm, wall) for wall in scenario.walls]
    table = np.array(rows, dtype=THING)
    table["index"] = len(scenario.contacts) + np.arange(len(rows))
    return table


def initial_touch_state(things: Structured) -> Vector:
    """Return the touch state at power-on, zeros (TOUCH_HEADER + n THING_PLACES,): no body, hand or wall yet."""
    return np.zeros(TOUCH_HEADER + things.size * THING_PLACES)


def largest_rate_rad_s(things: Structured) -> float:
    """Return a bound of the fastest rate that bodies, hands and walls give the unloaded arm, rad/s; 0 without any.

    Rates of things that are there at the same time are summed: those of springs by squares, those of dampers as they
    are. The result is the larger of the two sums.
    """
    largest = 0.0
    for onset_s in things["onset_s"]:
        there = things[(things["onset_s"] <= onset_s) & (things["end_s"] > onset_s)]
        largest = max(
            largest, math.sqrt(float(np.sum(there["stiff_rate_rad_s"] ** 2))), float(np.sum(there["damped_rate_1_s"]))
        )
    return largest


def fade_rate_rad_s(scenario: Scenario) -> float:
    """Return the fastest rate, rad/s, by which a scripted force of frame "motion" damps the slow, unloaded arm.

    0 without one.
    """
    return max(
        (
            one.force_N / FADE_M_S * _largest_mobility(scenario.arm, one.link, np.array([one.point_m]))
            for one in scenario.contacts
            if one.frame == "motion"
        ),
        default=0.0,
    )


# Each source of chance has a stream of its own beside the sensors' noise, which has the seed itself.
_WALK_STREAM: Final = (1,)
_ENCODER_STREAM: Final = (2,)


def payload_table(payloads: tuple[PayloadSettings, ...]) -> Structured:
    """Return payload changes as a table (n,) of dtype PAYLOAD_CHANGE, in the same order, for compiled functions."""
    rows = [(change.tick, change.mass_kg, *change.center_m, change.inertia_kg_m2) for change in payloads]
    return np.array(rows, dtype=PAYLOAD_CHANGE)


class BodyParts(NamedTuple):
    """Arguments of `body_ticks.advance_body` before set-points, modes and ticks; the first seven are `fill_truth`'s.

    The arrays are the body's own, not copies.
    """

    state: Vector
    numbers: Vector
    contacts: Structured
    things: Structured
    touch_state: Vector
    payloads: Structured
    work: Vector
    encoder_noise: NDArray[np.float64]
    substeps: int


def _pack_numbers(scenario: Scenario) -> Vector:
    """Return the properties of the arm and its devices as a flat array, laid out by BODY_NUMBERS."""
    vector = np.zeros(BODY_NUMBERS.itemsize // 8)
    numbers: np.void = vector.view(BODY_NUMBERS)[0]
    numbers["arm"] = scenario.mechanics.arm_numbers(scenario.arm)
    numbers["mechanics"] = scenario.mechanics.numbers(scenario.arm)
    numbers["motor"] = motor_numbers(scenario.drives, scenario.arm.rated_torque_Nm)
    numbers["encoder"] = encoder_numbers(scenario.sensors)
    numbers["transducer"] = transducer_numbers(scenario.sensors, scenario.torque_offset_Nm)
    return vector


class Body:
    """One emulated arm, from power-on. After construction it compiles no code and allocates no large array."""

    def __init__(self, scenario: Scenario) -> None:
        """Put the arm at the scenario's start pose, at rest."""
        self.scenario = scenario
        things = touch_table(scenario)
        touch_state = initial_touch_state(things)
        touch_rad_s = largest_rate_rad_s(things) + fade_rate_rad_s(scenario)
        seed, quiet = scenario.seed, (0.0, 0.0)
        self._noise = TorqueNoise(seed, scenario.sensors.torque_noise_Nm if scenario.noise else quiet)
        self._walk = TorqueNoise(
            np.random.SeedSequence(seed, spawn_key=_WALK_STREAM), scenario.sensors.offset_walk_Nm_rs
        )
        self._encoder_noise = EncoderNoise(
            np.random.SeedSequence(seed, spawn_key=_ENCODER_STREAM),
            scenario.sensors.encoder_noise_counts if scenario.noise else quiet,
        )
        self.parts = BodyParts(
            state=np.zeros(BODY_STATE.itemsize // 8),
            numbers=_pack_numbers(scenario),
            contacts=contact_table(scenario.contacts),
            things=things,
            touch_state=touch_state,
            payloads=payload_table(scenario.payloads),
            work=work_space(touch_state.size),
            encoder_noise=self._encoder_noise.table,
            substeps=scenario.mechanics.substeps(scenario.arm, scenario.payload_bodies, touch_rad_s),
        )
        """Arguments of the compiled functions, also for a caller that plays many cycles at once."""
        self._touch_truth = np.zeros(TOUCH_TRUTH.itemsize // 8)
        self._counts = np.zeros(6, dtype=np.int64)
        numbers: np.void = self.parts.numbers.view(BODY_NUMBERS)[0]
        motor = numbers["motor"]
        self._gain: Vector = motor["gain"]
        self._offset_Nm: Vector = motor["torque_offset_Nm"]
        self._can_overload = float(motor["can_overload"])
        self.has_ideal_motors = not motor["has_limits"] and np.array_equal(
            motor["peak_Nm"], scenario.arm.rated_torque_Nm
        )
        """Whether no motor ever has less torque than its drive wants, or calls for a fault."""
        state: np.void = self.parts.state.view(BODY_STATE)[0]
        self._arm: np.void = state["arm"]
        self._course: np.void = state["course"]
        self._is_limited: Vector = state["motor"]["is_limited"]
        self._is_overheated: Vector = state["motor"]["is_overheated"]
        self._is_spent: Vector = state["motor"]["is_spent"]
        self._tau_m: Vector = self._arm["tau_m"]
        self._temperature_C: Vector = self._arm["temperature_C"]
        self._velocity_rad_s: Vector = self._course["velocity_rad_s"]
        self._put_at_start(state, numbers)
        self._compile()

    def _put_at_start(self, state: np.void, numbers: np.void) -> None:
        """Set the state at power-on: the start pose at rest, the payload, motors at their preheat, settled sensors."""
        for name in ("q", "q_m", "q_encoder"):
            self._arm[name] = self.scenario.start_rad
        state["motor"] = motor_state(self.scenario.drives)
        state["transducer"] = transducer_state(numbers["transducer"])
        self._course["start_tick"] = -1.0
        self._arm["temperature_C"] = self.scenario.mechanics.ambient_C
        fit_payload(self._arm, numbers["arm"], self.scenario.payload_kg)
        encoder_rad = [read_angle(numbers["encoder"], i, self._arm["q_encoder"][i], 0.0) for i in range(2)]
        self._course["encoder_rad"] = self._course["estimate_rad"] = encoder_rad

    def _compile(self) -> None:
        """Call every compiled function once, on a copy of the state, so that none is compiled during a run."""
        parts = self.parts._replace(state=self.parts.state.copy(), touch_state=self.parts.touch_state.copy())
        advance_body(*parts, 0.0, 0.0, 0, 0, 1)
        sample_body(parts.state, parts.numbers, np.zeros(2), np.zeros(2), self._counts)
        fill_truth(*parts[:7], self._touch_truth, np.zeros(TRUTH_LAYOUT.size))

    def start_scenario(self) -> None:
        """Set scenario time 0 to now; call it once both drives are enabled. Later calls have no effect."""
        if self._course["start_tick"] < 0.0:
            self._course["start_tick"] = self._course["tick"]

    @property
    def motor_torque_Nm(self) -> tuple[float, float]:
        """Torque that the drives believe, by joint, Nm: the present motor torque, with the errors of the drive; 0x6077.

        It is the torque over the torque constant's factor, less the zero error of the current sensor; a motor without
        torque shows minus that error.
        """
        first_Nm, second_Nm = (self._tau_m / self._gain - self._offset_Nm).tolist()
        return first_Nm, second_Nm

    @property
    def is_torque_limited(self) -> tuple[bool, bool]:
        """Whether each drive wanted more torque in the last tick than peak current, I²t or temperature allow.

        By joint; a cause of statusword bit 11.
        """
        if self.has_ideal_motors:
            return False, False
        first, second = self._is_limited.tolist()
        return first != 0.0, second != 0.0

    @property
    def motor_error_code(self) -> tuple[int, int]:
        """Error code 0x603F by joint, as `error_code`: too hot, or I²t is spent and that is a fault; else 0.

        A code stays until the winding has cooled below the derating start, or a part of I²t's effort has gone.
        """
        if self.has_ideal_motors:
            return 0, 0
        heat1, heat2 = self._is_overheated.tolist()
        spent1, spent2 = self._is_spent.tolist()
        return error_code(heat1, spent1 * self._can_overload), error_code(heat2, spent2 * self._can_overload)

    @property
    def joint_temperature_C(self) -> tuple[float, float]:
        """True temperature of each joint's lubricant, °C, which warms with friction."""
        first, second = self._temperature_C.tolist()
        return first, second

    @property
    def drive_velocity_rad_s(self) -> tuple[float, float]:
        """Velocity by joint that each drive estimates from its encoder, rad/s along +q, before rounding to counts.

        By it drives see standstill. It is that of the last tick, without the scenario's faults of values.
        """
        first, second = self._velocity_rad_s.tolist()
        return first, second

    def advance(
        self, torque_setpoint_Nm: Sequence[float] | Vector, drive_mode: Sequence[int], tick_count: int = PERIOD_TICKS
    ) -> None:
        """Advance the arm by `tick_count` ticks of 100 µs with constant set-points (2,), Nm, and `DriveMode`s (2,).

        Both are by joint. Also applies the scenario's changes of payload and touches that are due in each tick.
        """
        while tick_count > 0:
            count = tick_count
            if self._encoder_noise.is_on:
                count = min(tick_count, NOISE_TICKS)
                self._encoder_noise.draw(int(self._course["tick"]) + count - 1)
            tick_count -= count
            (first_Nm, second_Nm), (mode1, mode2) = torque_setpoint_Nm, drive_mode
            advance_body(*self.parts, float(first_Nm), float(second_Nm), int(mode1), int(mode2), count)

    def sample(self) -> Measurement:
        """Return the values that the devices measure now, in counts, by joint.

        Call it once per SYNC: each call draws new noise, and moves the torque sensors' wandering zeros.
        """
        sample_body(self.parts.state, self.parts.numbers, self._noise.draw(), self._walk.draw(), self._counts)
        q1, q2, dq1, dq2, tau1, tau2 = self._counts.tolist()
        return Measurement((q1, q2), (dq1, dq2), (tau1, tau2))

    def truth(self, out: Vector) -> None:
        """Fill a block laid out by TRUTH_LAYOUT with the present true values.

        First applies the payload and touch changes that are due. Measurements stay the same. The field `faults` is 0:
        the bench fills it.
        """
        fill_truth(*self.parts[:7], self._touch_truth, out)
