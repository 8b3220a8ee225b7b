"""The emulated arm as one thing: drives' inner loops, rigid body, the person, and the sensors.

Inside a period the body runs on the drives' 100 µs ticks; in each of them

    the person's and the payload's change of this tick → torque target of each drive → integrate → encoder → velocity

Per SYNC k the device nodes `sample` (and record the `truth` of the same instant), then `advance` to SYNC k + 1 with
the set-point that was latched at SYNC k. All state lies in one vector, so a body is its state, scenario and seed.
"""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.compiled import compiled
from adacd_hil.records import TRUTH_LAYOUT, Vector
from firmware_sim.arm.joint_mechanics import REFERENCE_C
from firmware_sim.arm.mechanics import HOLDING_BRAKE, integrate_mechanics, observe, work_space
from firmware_sim.arm.plant import (
    BRAKE,
    BRAKE_DAMPING,
    COULOMB,
    DQ,
    ENCODED,
    INERTIA,
    JOINT_TORQUE,
    LENGTH,
    MECHANICAL_STATE,
    PAYLOAD,
    SHAFT,
    TAU,
    TORQUE_LIMIT,
    VISCOUS,
    WARMTH,
    Q,
    accelerate,
    decide_slips,
    external_torque,
    fit_payload,
    integrate,
    mirror_stiff_joints,
)
from firmware_sim.arm.scripted_contact import (
    END_TICK,
    ONSET_TICK,
    TICK_S,
    contact_table,
    ticks,
)
from firmware_sim.arm.sensing import (
    POSITION_LSB_RAD,
    TORQUE_LSB_NM,
    VELOCITY_LSB_RAD_S,
    DriveMode,
    TorqueNoise,
    to_counts,
    track,
)
from firmware_sim.arm.touch_forces import (
    FORCE,
    POWER,
    STRONGEST_INDEX,
    STRONGEST_LINK,
    TOUCH_TRUTH,
    TRUE_ENERGY,
    add_prescribed_work,
    change_touch,
    describe_touch,
    initial_touch_state,
    largest_rate_rad_s,
    touch_table,
)
from firmware_sim.body.motor import (
    HAS_LIMITS,
    IS_LIMITED,
    MOTOR_STATE,
    PEAK,
    TRACKING,
    believed_torque,
    command_torque,
    error_code,
    heat_motor,
    motor_numbers,
    motor_state,
    winding_temperature,
)
from firmware_sim.body.sensors import (
    HAS_MEMORY,
    NOISE_TICKS,
    TRANSDUCER_STATE,
    EncoderNoise,
    converter_ends,
    encoder_numbers,
    read_angle,
    sample_torque,
    sense_torque,
    settle_transducer,
    transducer_numbers,
    walk_offset,
)
from firmware_sim.scenario.scenario import PayloadSettings, Scenario

SUBSTEPS: Final = 1
"""Integration steps per tick: RK4 at 10 kHz. Halving the step changes a period's velocity by less than 2e-10 rad/s, and
by up to 2e-8 rad/s where a joint brushes against standstill (profile M in the paper's experiment)."""

# Places in the state vector after the mechanical state.
_TICK: Final = MECHANICAL_STATE  # ticks since power-on
_START_TICK: Final = _TICK + 1  # tick of scenario time 0; -1 before
_CONTACT: Final = _TICK + 2  # index of the contact in force or the next one
_CHANGE: Final = _TICK + 3  # index of the next payload change
_ENCODER: Final = _TICK + 4  # 2: encoder position, rad
_ESTIMATE: Final = _TICK + 6  # 2: position of the tracking loop, rad
_VELOCITY: Final = _TICK + 8  # 2: velocity of the tracking loop, rad/s
_MOTOR: Final = _TICK + 10  # places of `firmware_sim.body.motor`
_TRANSDUCER: Final = _MOTOR + MOTOR_STATE  # places of `firmware_sim.body.sensors`
_STATE: Final = _TRANSDUCER + TRANSDUCER_STATE

_OFF: Final = int(DriveMode.OFF)
_TORQUE: Final = int(DriveMode.TORQUE)
_BRAKE: Final = int(DriveMode.BRAKE)
_BRAKE_SLOWLY: Final = int(DriveMode.BRAKE_SLOWLY)
_BRAKE_HARD: Final = int(DriveMode.BRAKE_HARD)
_SLOW_SHARE: Final = 0.5
_HARD_SHARE: Final = 1.5
"""Of BRAKE_DAMPING. The shortest time constant, 10 ms / 1.5, is four lags of the drive's velocity: no overshoot."""


# Each source of chance has a stream of its own beside the sensors' noise, which has the seed itself.
_WALK_STREAM: Final = (1,)
_ENCODER_STREAM: Final = (2,)

_PLACE: Final = {name: place.start for name, place in TRUTH_LAYOUT.slices.items()}
_TRUE_Q: Final = _PLACE["q"]
_TRUE_DQ: Final = _PLACE["dq"]
_TRUE_TAU_J: Final = _PLACE["tau_J"]
_TRUE_TAU_EXT: Final = _PLACE["tau_ext"]
_TRUE_FRICTION: Final = _PLACE["tau_friction"]
_TRUE_FORCE: Final = _PLACE["contact_force"]
_TRUE_LINK: Final = _PLACE["contact_link"]
_TRUE_INDEX: Final = _PLACE["contact_index"]
_TRUE_POWER: Final = _PLACE["contact_power"]
_TRUE_ENERGY: Final = _PLACE["contact_energy"]
_TRUE_PAYLOAD: Final = _PLACE["payload"]
_TRUE_THETA: Final = _PLACE["theta"]
_TRUE_Q_M: Final = _PLACE["q_m"]
_TRUE_TAU_M: Final = _PLACE["tau_m"]
_TRUE_GRAVITY: Final = _PLACE["tau_gravity"]
_TRUE_TEMPERATURE: Final = _PLACE["joint_temperature"]


@compiled
def _contact_in_force(state: Vector, contacts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Give the row of the contact in force at this tick, empty when there is none; steps over those that have ended."""
    tick = state[_TICK] - state[_START_TICK]
    index = int(state[_CONTACT])
    while index < contacts.shape[0] and contacts[index, END_TICK] <= tick:
        index += 1
    state[_CONTACT] = index
    if state[_START_TICK] >= 0.0 and index < contacts.shape[0] and contacts[index, ONSET_TICK] <= tick:
        row: NDArray[np.float64] = contacts[index]
        return row
    return state[:0]


@compiled
def _change_payload(state: Vector, arm: Vector, payloads: NDArray[np.float64]) -> None:
    """Fit or take off what the scenario says for this tick; payloads (n, 5): see `payload_table`."""
    if state[_START_TICK] < 0.0:
        return
    tick = state[_TICK] - state[_START_TICK]
    index = int(state[_CHANGE])
    while index < payloads.shape[0] and payloads[index, 0] <= tick:
        fit_payload(state, arm, payloads[index, 1], payloads[index, 2], payloads[index, 3], payloads[index, 4])
        index += 1
    state[_CHANGE] = index


@compiled
def _scenario_s(state: Vector) -> float:
    """Give the scenario time of this tick in s, -1 before the scenario starts."""
    return float((state[_TICK] - state[_START_TICK]) * TICK_S) if state[_START_TICK] >= 0.0 else -1.0


@compiled
def _torque_target(arm: Vector, joint: int, mode: int, setpoint_Nm: float, velocity_rad_s: float) -> float:
    """Say what a drive asks of its torque loop, Nm, within its rated torque."""
    limit_Nm = arm[TORQUE_LIMIT + joint]
    if mode == _TORQUE:
        return float(min(max(setpoint_Nm, -limit_Nm), limit_Nm))
    damping = arm[BRAKE_DAMPING + joint]
    if mode == _BRAKE_SLOWLY:
        damping *= _SLOW_SHARE
    elif mode == _BRAKE_HARD:
        damping *= _HARD_SHARE
    elif mode != _BRAKE:
        return 0.0
    return float(min(max(-damping * velocity_rad_s, -limit_Nm), limit_Nm))


@compiled
def _read_encoder(
    state: Vector, motor: Vector, encoder: Vector, joint: int, angle_rad: float, noise_counts: float
) -> None:
    """Take the encoder's position at the end of a tick and advance the drive's velocity. angle: that of its shaft."""
    now_rad = read_angle(encoder, joint, angle_rad, noise_counts)
    state[_ESTIMATE + joint], state[_VELOCITY + joint] = track(
        state[_ENCODER + joint],
        now_rad,
        state[_ESTIMATE + joint],
        state[_VELOCITY + joint],
        TICK_S,
        motor[TRACKING + joint],
    )
    state[_ENCODER + joint] = now_rad


@compiled
def _measure_tick(
    state: Vector, motor: Vector, encoder: Vector, transducer: Vector, encoder_noise: NDArray[np.float64]
) -> None:
    """Let motors, encoders and torque sensors see the end of a tick."""
    tick = state[_TICK]
    noise = encoder_noise[int(tick) % (2 * NOISE_TICKS)]
    _read_encoder(state, motor, encoder, 0, state[ENCODED], noise[0])
    _read_encoder(state, motor, encoder, 1, state[ENCODED + 1], noise[1])
    if motor[HAS_LIMITS] != 0.0:
        motors = state[_MOTOR:_TRANSDUCER]
        heat_motor(motor, motors, 0, state[TAU])
        heat_motor(motor, motors, 1, state[TAU + 1])
    if transducer[HAS_MEMORY] != 0.0:
        tau1, tau2 = state[JOINT_TORQUE], state[JOINT_TORQUE + 1]
        sense_torque(transducer, state[_TRANSDUCER:], tick, tau1, tau2, state[WARMTH], state[WARMTH + 1])


@compiled
def _advance(
    state: Vector,
    arm: Vector,
    mechanics: Vector | None,
    contacts: NDArray[np.float64],
    touch_numbers: NDArray[np.float64],
    touch_state: Vector,
    payloads: NDArray[np.float64],
    motor: Vector,
    encoder: Vector,
    transducer: Vector,
    encoder_noise: NDArray[np.float64],
    setpoint1_Nm: float,
    setpoint2_Nm: float,
    mode1: int,
    mode2: int,
    tick_count: int,
    substeps: int,
    work: Vector,
) -> None:
    """Advance the body by `tick_count` ticks; without mechanics the rigid arm, and numba then compiles nothing else."""
    step_s = TICK_S / substeps
    motors = state[_MOTOR:_TRANSDUCER]
    for _ in range(tick_count):
        _change_payload(state, arm, payloads)
        contact = _contact_in_force(state, contacts)
        elapsed_s = 0.0
        if contact.size != 0:
            elapsed_s = (state[_TICK] - state[_START_TICK] - contact[ONSET_TICK]) * TICK_S
        before1, before2 = state[Q], state[Q + 1]
        change_touch(touch_numbers, _scenario_s(state), before1, before2, touch_state, contact.size != 0)
        wanted1 = _torque_target(arm, 0, mode1, setpoint1_Nm, state[_VELOCITY])
        wanted2 = _torque_target(arm, 1, mode2, setpoint2_Nm, state[_VELOCITY + 1])
        target1 = command_torque(motor, motors, 0, wanted1, state[TAU], mode1 != _OFF)
        target2 = command_torque(motor, motors, 1, wanted2, state[TAU + 1], mode2 != _OFF)
        if mechanics is None:
            for substep in range(substeps):
                integrate(state, arm, contact, elapsed_s + substep * step_s, target1, target2, step_s)
            mirror_stiff_joints(state)
        else:
            state[BRAKE] = mechanics[HOLDING_BRAKE] if mode1 == _OFF else 0.0
            state[BRAKE + 1] = mechanics[HOLDING_BRAKE + 1] if mode2 == _OFF else 0.0
            integrate_mechanics(
                state, arm, mechanics, contact, touch_numbers, touch_state,
                _scenario_s(state), elapsed_s, target1, target2, TICK_S, substeps, work,
            )  # fmt: skip
        add_prescribed_work(
            contact, elapsed_s, TICK_S, arm[LENGTH], before1, before2, state[Q], state[Q + 1], touch_state
        )
        _measure_tick(state, motor, encoder, transducer, encoder_noise)
        state[_TICK] += 1.0


@compiled
def _sample(state: Vector, transducer: Vector, noise: Vector, walk: Vector, out: NDArray[np.int64]) -> None:
    """Quantise what the devices measure now: position, velocity, torque counts, two each (6,)."""
    tick = state[_TICK]
    transducers = state[_TRANSDUCER:]
    walk_offset(transducers, tick, walk)
    for joint in range(2):
        tau, other = state[JOINT_TORQUE + joint], state[JOINT_TORQUE + 1 - joint]
        out[joint] = to_counts(state[_ENCODER + joint], POSITION_LSB_RAD)
        out[2 + joint] = to_counts(state[_VELOCITY + joint], VELOCITY_LSB_RAD_S)
        out[4 + joint] = sample_torque(
            transducer, transducers, joint, tick, tau, other, state[WARMTH + joint], noise[joint]
        )


@compiled
def _fill_truth(
    state: Vector,
    arm: Vector,
    mechanics: Vector | None,
    contacts: NDArray[np.float64],
    touch_numbers: NDArray[np.float64],
    touch_state: Vector,
    payloads: NDArray[np.float64],
    work: Vector,
    touched: Vector,
    out: Vector,
) -> None:
    """Fill a block laid out by TRUTH_LAYOUT with what is true at this instant."""
    out[:] = 0.0
    _change_payload(state, arm, payloads)
    contact = _contact_in_force(state, contacts)
    elapsed_s = 0.0
    if contact.size != 0:
        elapsed_s = (state[_TICK] - state[_START_TICK] - contact[ONSET_TICK]) * TICK_S
    q1, q2, dq1, dq2 = state[Q], state[Q + 1], state[DQ], state[DQ + 1]
    time_s = _scenario_s(state)
    change_touch(touch_numbers, time_s, q1, q2, touch_state, contact.size != 0)
    describe_touch(
        touch_numbers, time_s, q1, q2, dq1, dq2, touch_state,
        contact, state[_CONTACT], elapsed_s, arm[LENGTH], touched,
    )  # fmt: skip
    if mechanics is None:
        ext1, ext2 = external_torque(arm, contact, elapsed_s, q1, q2, dq1, dq2)
        torque1 = state[TAU] + ext1
        torque2 = state[TAU + 1] + ext2
        slip1, slip2 = decide_slips(state, arm, torque1, torque2, q2, dq1, dq2)
        _, _, friction1, friction2 = accelerate(state, arm, slip1, slip2, torque1, torque2, q2, dq1, dq2)
        friction1 += arm[VISCOUS] * dq1
        friction2 += arm[VISCOUS + 1] * dq2
        held1, held2 = 0.0, 0.0
    else:
        ext1, ext2, friction1, friction2, held1, held2 = observe(
            state, arm, mechanics, contact, touch_numbers, touch_state, _scenario_s(state), elapsed_s, work
        )
    out[_TRUE_Q], out[_TRUE_Q + 1] = q1, q2
    out[_TRUE_DQ], out[_TRUE_DQ + 1] = dq1, dq2
    out[_TRUE_TAU_J], out[_TRUE_TAU_J + 1] = state[JOINT_TORQUE], state[JOINT_TORQUE + 1]
    out[_TRUE_TAU_EXT], out[_TRUE_TAU_EXT + 1] = ext1, ext2
    out[_TRUE_FRICTION], out[_TRUE_FRICTION + 1] = friction1, friction2
    out[_TRUE_GRAVITY], out[_TRUE_GRAVITY + 1] = held1, held2
    out[_TRUE_FORCE] = touched[FORCE]
    out[_TRUE_LINK] = touched[STRONGEST_LINK]
    out[_TRUE_INDEX] = touched[STRONGEST_INDEX]
    out[_TRUE_POWER] = touched[POWER]
    out[_TRUE_ENERGY] = touched[TRUE_ENERGY]
    out[_TRUE_PAYLOAD] = state[PAYLOAD]
    out[_TRUE_THETA] = state[INERTIA] + state[INERTIA + 2]
    out[_TRUE_THETA + 1] = state[INERTIA + 1]
    out[_TRUE_THETA + 2] = state[INERTIA + 2]
    for joint in range(2):
        out[_TRUE_THETA + 3 + joint] = arm[VISCOUS + joint]
        out[_TRUE_THETA + 5 + joint] = arm[COULOMB + joint]
        out[_TRUE_Q_M + joint] = state[SHAFT + joint]
        out[_TRUE_TAU_M + joint] = state[TAU + joint]
        out[_TRUE_TEMPERATURE + joint] = state[WARMTH + joint]


def payload_table(payloads: tuple[PayloadSettings, ...]) -> NDArray[np.float64]:
    """Pack payload changes (n, 5): tick, kg, centre of mass along and beside link 2 from the tip m, inertia kg m²."""
    rows = [(change.tick, change.mass_kg, *change.center_m, change.inertia_kg_m2) for change in payloads]
    return np.array(rows, dtype=np.float64).reshape(len(payloads), 5)


class Measurement(NamedTuple):
    """What the devices measure at one SYNC, as raw counts of the two joints; the properties give SI units."""

    position_counts: tuple[int, int]
    velocity_counts: tuple[int, int]
    torque_counts: tuple[int, int]

    @property
    def q(self) -> Vector:
        """Measured joint position, rad (2,)."""
        return np.array(self.position_counts) * POSITION_LSB_RAD

    @property
    def dq(self) -> Vector:
        """Measured joint velocity, rad/s (2,)."""
        return np.array(self.velocity_counts) * VELOCITY_LSB_RAD_S

    @property
    def tau_J(self) -> Vector:
        """Measured joint torque, Nm (2,)."""
        return np.array(self.torque_counts) * TORQUE_LSB_NM


class Body:
    """One emulated arm, from power-on. Nothing is compiled and nothing large allocated after construction."""

    def __init__(self, scenario: Scenario, period_s: float = 1e-3, seed: int | None = None) -> None:
        """Put the arm at the scenario's start pose, at rest.

        `seed` outweighs the scenario's. Raises ValueError when the period is no multiple of 100 µs.
        """
        self._ticks_per_period = ticks(period_s)
        if self._ticks_per_period < 1 or not math.isclose(self._ticks_per_period * TICK_S, period_s, rel_tol=1e-9):
            raise ValueError(f"period_s = {period_s} s is no multiple of {TICK_S} s")
        self.scenario = scenario
        self.period_s = period_s
        self._arm = scenario.mechanics.arm_numbers(scenario.arm)
        self._contacts = contact_table(scenario.contacts)
        self._payloads = payload_table(scenario.payloads)
        self._touch_numbers = touch_table(scenario)
        self._touch_state = initial_touch_state(self._touch_numbers)
        self._touched = np.zeros(TOUCH_TRUTH)
        is_rigid = scenario.mechanics.is_rigid and self._touch_numbers.size == 0
        self._mechanics = None if is_rigid else scenario.mechanics.numbers(scenario.arm)
        self._substeps = (
            SUBSTEPS
            if is_rigid
            else scenario.mechanics.substeps(
                scenario.arm, scenario.payload_bodies, largest_rate_rad_s(self._touch_numbers)
            )
        )
        self._work = work_space(self._touch_state.size)
        self._motor = motor_numbers(scenario.drives, scenario.arm.rated_torque_Nm)
        self._encoder = encoder_numbers(scenario.sensors)
        self._transducer = transducer_numbers(scenario.sensors, scenario.torque_offset_Nm)
        self._is_never_limited = not self._motor[HAS_LIMITS] and np.array_equal(
            self._motor[PEAK : PEAK + 2], scenario.arm.rated_torque_Nm
        )
        self.torque_ends = converter_ends(scenario.sensors, 0), converter_ends(scenario.sensors, 1)
        """Lowest and highest counts of each torque sensor; there its value is a bound only."""
        seed = scenario.seed if seed is None else seed
        quiet = (0.0, 0.0)
        self._noise = TorqueNoise(seed, scenario.sensors.torque_noise_Nm if scenario.noise else quiet)
        self._walk = TorqueNoise(
            np.random.SeedSequence(seed, spawn_key=_WALK_STREAM), scenario.sensors.offset_walk_Nm_rs
        )
        self._encoder_noise = EncoderNoise(
            np.random.SeedSequence(seed, spawn_key=_ENCODER_STREAM),
            scenario.sensors.encoder_noise_counts if scenario.noise else quiet,
        )
        self._counts = np.zeros(6, dtype=np.int64)
        self._state = np.zeros(_STATE)
        self._state[Q : Q + 2] = scenario.start_rad
        self._state[_MOTOR:_TRANSDUCER] = motor_state(scenario.drives)
        self._state[_START_TICK] = -1.0
        self._state[WARMTH : WARMTH + 2] = REFERENCE_C if is_rigid else scenario.mechanics.ambient_C
        fit_payload(self._state, self._arm, scenario.payload_kg)
        mirror_stiff_joints(self._state)
        encoder_rad = [read_angle(self._encoder, joint, self._state[ENCODED + joint], 0.0) for joint in range(2)]
        self._state[_ENCODER : _ENCODER + 2] = encoder_rad
        self._state[_ESTIMATE : _ESTIMATE + 2] = encoder_rad
        settle_transducer(
            self._transducer,
            self._state[_TRANSDUCER:],
            self._state[JOINT_TORQUE],
            self._state[JOINT_TORQUE + 1],
            self._state[WARMTH],
            self._state[WARMTH + 1],
        )
        self._compile()

    def _compile(self) -> None:
        """Run every compiled function once, on a copy of the state."""
        state = self._state.copy()
        motor, encoder, transducer, noise = self._motor, self._encoder, self._transducer, self._encoder_noise.table
        _advance(
            state, self._arm, self._mechanics, self._contacts, self._touch_numbers, self._touch_state.copy(),
            self._payloads, motor, encoder, transducer, noise, 0.0, 0.0, 0, 0, 1, self._substeps, self._work,
        )  # fmt: skip
        _sample(state, transducer, np.zeros(2), np.zeros(2), self._counts)
        _fill_truth(
            state, self._arm, self._mechanics, self._contacts, self._touch_numbers, self._touch_state.copy(),
            self._payloads, self._work, self._touched, np.zeros(TRUTH_LAYOUT.size),
        )  # fmt: skip

    def start_scenario(self) -> None:
        """Let scenario time start now: both drives are in Operation enabled. Later calls change nothing."""
        if not self.is_started:
            self._state[_START_TICK] = self._state[_TICK]

    @property
    def is_started(self) -> bool:
        """Whether scenario time runs."""
        return bool(self._state[_START_TICK] >= 0.0)

    @property
    def scenario_time_s(self) -> float:
        """Time since the scenario started, 0 before."""
        return float(self._state[_TICK] - self._state[_START_TICK]) * TICK_S if self.is_started else 0.0

    @property
    def motor_torque_Nm(self) -> tuple[float, float]:
        """Torque that the drives know from their motor currents, without the sensor's noise; 0x6077."""
        motor, state = self._motor, self._state
        return believed_torque(motor, 0, state[TAU]), believed_torque(motor, 1, state[TAU + 1])

    @property
    def is_torque_limited(self) -> tuple[bool, bool]:
        """Whether each drive wants more torque than current limit, I²t or temperature leave; statusword bit 11."""
        if self._is_never_limited:
            return False, False
        first = _MOTOR + IS_LIMITED
        return bool(self._state[first]), bool(self._state[first + 1])

    @property
    def motor_error_code(self) -> tuple[int, int]:
        """Error code that each motor's I²t or temperature calls for now, 0 for none; 0x603F."""
        if self._is_never_limited:
            return 0, 0
        motors = self._state[_MOTOR:_TRANSDUCER]
        return error_code(self._motor, motors, 0), error_code(self._motor, motors, 1)

    @property
    def joint_temperature_C(self) -> tuple[float, float]:
        """True temperature of each joint, °C."""
        return float(self._state[WARMTH]), float(self._state[WARMTH + 1])

    @property
    def winding_temperature_C(self) -> tuple[float, float]:
        """True temperature of each motor's winding, °C."""
        motors = self._state[_MOTOR:_TRANSDUCER]
        return winding_temperature(self._motor, motors, 0), winding_temperature(self._motor, motors, 1)

    @property
    def drive_velocity_rad_s(self) -> tuple[float, float]:
        """Velocity that the drives know, not quantised; by this they see standstill."""
        return float(self._state[_VELOCITY]), float(self._state[_VELOCITY + 1])

    def advance(
        self, torque_setpoint_Nm: Sequence[float] | Vector, drive_mode: Sequence[int], tick_count: int | None = None
    ) -> None:
        """Advance by one period, or by `tick_count` ticks of 100 µs.

        Set-points (2,) and `DriveMode` (2,) hold for the whole of it.
        """
        left = self._ticks_per_period if tick_count is None else tick_count
        while left > 0:
            count = left
            if self._encoder_noise.is_on:
                count = min(left, NOISE_TICKS)
                self._encoder_noise.draw(int(self._state[_TICK]) + count - 1)
            left -= count
            _advance(
                self._state,
                self._arm,
                self._mechanics,
                self._contacts,
                self._touch_numbers,
                self._touch_state,
                self._payloads,
                self._motor,
                self._encoder,
                self._transducer,
                self._encoder_noise.table,
                float(torque_setpoint_Nm[0]),
                float(torque_setpoint_Nm[1]),
                int(drive_mode[0]),
                int(drive_mode[1]),
                count,
                self._substeps,
                self._work,
            )

    def sample(self) -> Measurement:
        """Measure now. Call it once per SYNC: each call draws new noise."""
        _sample(self._state, self._transducer, self._noise.draw(), self._walk.draw(), self._counts)
        q1, q2, dq1, dq2, tau1, tau2 = self._counts.tolist()
        return Measurement((q1, q2), (dq1, dq2), (tau1, tau2))

    def truth(self, out: Vector) -> None:
        """Fill a block laid out by TRUTH_LAYOUT with what is true now; changes nothing that is measured."""
        _fill_truth(
            self._state,
            self._arm,
            self._mechanics,
            self._contacts,
            self._touch_numbers,
            self._touch_state,
            self._payloads,
            self._work,
            self._touched,
            out,
        )
