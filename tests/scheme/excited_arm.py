"""The small 2R arm of `planar_arm` on the excitation: recorded and played, or in closed loop with the pipeline."""

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
from planar_arm import ENCODER_LSB_RAD, THETA, TORQUE_LSB_NM, TORQUE_NOISE_NM, VELOCITY_LSB_RAD_S, advance
from played_record import PlayedRecord, play_record

from adacd_hil.compiled import compiled
from adacd_hil.control.motions import Excitation
from adacd_hil.records import FRICTION_SPEEDS_RAD_S, ArmState, Event, FaultReason, Request, SchemeOutput, SchemeState
from adacd_hil.scheme.kernel import certified_kernel, certified_memory
from adacd_hil.scheme.pipeline.new_pipeline import new_pipeline
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings

PERIOD_S = 1e-3
SETTINGS = load_settings("certified", "P")
SETTINGS = replace(SETTINGS, safety=replace(SETTINGS.safety, commission_s=0.01))
NAMES = certified_memory.parameter_names(SETTINGS)
OFFSETS = [NAMES.index("offset1"), NAMES.index("offset2")]
FREE = replace(
    SETTINGS, arm=replace(SETTINGS.arm, holding_torque_Nm=(0.0, 0.0)), safety=replace(SETTINGS.safety, commission_s=0.1)
)
"""Of an arm without brakes: its reading at rest anchors the sensors' offsets."""


DATE = "2026-11-22T10:00:00Z"


def friction_of(theta):
    return [theta[5 + i] + v * theta[3 + i] for i in range(2) for v in FRICTION_SPEEDS_RAD_S]


def known(theta, settings=FREE, offset_Nm=(0.0, 0.0)):
    """Return settings with a last certificate that says this of the arm and of its sensors' zeros."""
    history = replace(
        settings.history,
        date_utc=DATE,
        friction_Nm=tuple(friction_of(theta)),
        friction_std_Nm=(0.005,) * 6,
        inertia_kgm2=tuple(theta[:3]),
        inertia_std_kgm2=(0.001,) * 3,
        offset_Nm=offset_Nm,
        offset_std_Nm=(0.01, 0.01),
    )
    return replace(settings, history=history)


class Record(NamedTuple):
    """What was measured (n, 2)."""

    q: np.ndarray
    dq: np.ndarray
    tau_J: np.ndarray


@compiled
def quantise(q, dq, tau_J):
    """Round to what the encoder, the drive and the sensor can say, in place."""
    for i in range(2):
        q[i] = np.round(q[i] / ENCODER_LSB_RAD) * ENCODER_LSB_RAD
        dq[i] = np.round(dq[i] / VELOCITY_LSB_RAD_S) * VELOCITY_LSB_RAD_S
        tau_J[i] = np.round(tau_J[i] / TORQUE_LSB_NM) * TORQUE_LSB_NM


@compiled
def follow(theta, q_d, dq_d, Kp, Kd, noise, q, dq, tau_J):
    """Let the arm with parameters theta (7,) follow q_d under PD control; fill the measured q, dq, tau_J (n, 2)."""
    at, speed = q_d[0].copy(), dq_d[0].copy()
    tracked_q, tracked_dq = at.copy(), speed.copy()
    tau, tau_next = np.zeros(2), np.zeros(2)
    for k in range(q.shape[0]):
        q[k], dq[k], tau_J[k] = at, tracked_dq, tau + noise[k]
        quantise(q[k], dq[k], tau_J[k])
        tau[:] = tau_next
        tau_next[:] = Kp * (q_d[k] - q[k]) + Kd * (dq_d[k] - dq[k])
        advance(at, speed, tracked_q, tracked_dq, tau, theta, PERIOD_S)


def added(**parameters) -> np.ndarray:
    """Return what a hand that drags, or moves like a mass, adds to the arm's parameters (7,)."""
    theta = np.zeros(7)
    for name, value in parameters.items():
        theta[NAMES.index(name)] = value
    return theta


def record(theta, seconds, seed=1) -> Record:
    """Record the arm on the excitation."""
    motion = motion_of(SETTINGS.trajectory, SETTINGS.excitation)
    q_d, dq_d, _ = np.array([motion.at(k) for k in range(round(seconds / PERIOD_S))]).transpose(1, 0, 2).copy()
    noise = TORQUE_NOISE_NM * np.random.default_rng(seed).standard_normal(q_d.shape)
    measured = Record(*(np.zeros(q_d.shape) for _ in range(3)))
    follow(theta, q_d, dq_d, np.array(SETTINGS.controller.Kp), np.array(SETTINGS.controller.Kd), noise, *measured)
    return measured


def play(measured: Record) -> PlayedRecord:
    """Play a record through the compiled step."""
    return play_record(SETTINGS, *measured)


class Motion:
    """The excitation by cycles, evaluated once for all loops."""

    def __init__(self, settings: Settings):
        self._excitation = Excitation(settings)
        self._rows: list[np.ndarray] = []

    def at(self, cycle: int) -> np.ndarray:
        """Return q_d, dq_d, ddq_d (3, 2)."""
        while len(self._rows) <= cycle:
            row = np.zeros((3, 2))
            self._excitation.evaluate(len(self._rows) * PERIOD_S, *row)
            self._rows.append(row)
        return self._rows[cycle]


@cache
def motion_of(trajectory, excitation) -> Motion:
    return Motion(replace(SETTINGS, trajectory=trajectory, excitation=excitation))


@compiled
def lead(x, lead_s, away, q_d, dq_d):
    """Add the way back from where the motion was left, at the share x of its time."""
    for i in range(2):
        q_d[i] += away[i] * (1.0 - x**3 * (10.0 - 15.0 * x + 6.0 * x**2))
        dq_d[i] -= away[i] * 30.0 * x**2 * (1.0 - x) ** 2 / lead_s


LEAD_S = 1.5
BRAKE_RAD_S2 = 12.0
MOVING = (SchemeState.ADAPT, SchemeState.CERTIFY, SchemeState.MONITOR)


class ExcitedLoop:
    """The arm under PD control, and the certified pipeline that watches it; one call of `step` is one period.

    It moves on the excitation wherever the arm moves, brakes where it reacts, and is led back from there. Its sensors
    are off by `offset_Nm`; `events`: the pipeline's.
    """

    def __init__(
        self,
        settings: Settings = SETTINGS,
        offset_Nm=(0.0, 0.0),
        theta=THETA["P"],
        seed=1,
        motion: Motion | None = None,
    ):
        self.settings = settings
        self.pipeline = new_pipeline(settings)
        self.motion = motion_of(settings.trajectory, settings.excitation) if motion is None else motion
        self.theta = theta.copy()
        self.random = np.random.default_rng(seed)
        self.desired = self.motion.at(0).copy()
        self.corner = self.desired[0].copy()
        self.q, self.dq = self.corner.copy(), np.zeros(2)
        self.tracked_q, self.tracked_dq = self.q.copy(), np.zeros(2)
        self.tau, self.tau_next, self.tau_ext = np.zeros(2), np.zeros(2), np.zeros(2)
        self.away, self.offset_Nm = np.zeros(2), np.array(offset_Nm)
        self.cycle = self.motion_cycles = 0
        self.request = Request.NONE
        self.advance = advance
        self.events: list[Event] = []

    def measure(self) -> ArmState:
        q, dq = self.q.copy(), self.tracked_dq.copy()
        tau_J = self.tau + TORQUE_NOISE_NM * self.random.standard_normal(2)
        quantise(q, dq, tau_J)
        return arm_state(self.cycle, q, dq, tau_J + self.offset_Nm)

    def move(self, output: SchemeOutput) -> None:
        """Go on with the desired motion."""
        if output.state not in MOVING:
            q_d, dq_d, _ = self.desired
            dq_d -= np.clip(dq_d, -BRAKE_RAD_S2 * PERIOD_S, BRAKE_RAD_S2 * PERIOD_S)
            q_d += PERIOD_S * dq_d
            return
        if output.previous_state not in MOVING:
            self.away = self.desired[0] - self.corner
            self.motion_cycles = 0
        at_s = self.motion_cycles * PERIOD_S
        self.desired[:] = self.motion.at(self.motion_cycles)
        if at_s < LEAD_S:
            lead(at_s / LEAD_S, LEAD_S, self.away, self.desired[0], self.desired[1])
        self.motion_cycles += 1

    def control(self, arm: ArmState, output: SchemeOutput) -> np.ndarray:
        """Return the torque that is commanded (2,)."""
        self.move(output)
        controller = self.settings.controller
        return controller.Kp * (self.desired[0] - arm.q) + controller.Kd * (self.desired[1] - arm.dq)

    def step(self) -> SchemeOutput:
        arm = self.measure()
        output = self.pipeline.step(arm, self.request)
        self.events += self.pipeline.take_events()
        self.request = Request.NONE
        self.tau = self.tau_next
        self.tau_next = self.control(arm, output)
        push = self.tau + self.tau_ext
        self.advance(self.q, self.dq, self.tracked_q, self.tracked_dq, push, self.theta, PERIOD_S)
        self.cycle += 1
        return output

    def run(self, cycles: int) -> list[SchemeOutput]:
        return [self.step() for _ in range(cycles)]

    def run_until(self, state: SchemeState, most_cycles: int = 5000) -> list[SchemeOutput]:
        outputs = []
        for _ in range(most_cycles):
            outputs.append(self.step())
            if outputs[-1].state is state:
                return outputs
        raise AssertionError(f"still in {outputs[-1].state.name} after {most_cycles} cycles")


class TouchedLoop(ExcitedLoop):
    """The arm on the excitation, whom people touch and speak to."""

    def lean(self, joint, torque_Nm, seconds):
        self.tau_ext[joint] = torque_Nm
        outputs = self.run(round(seconds / PERIOD_S))
        self.tau_ext[joint] = 0.0
        return outputs

    def hold(self, hand, seconds):
        """Let a hand hold the arm whose torque is a change of parameters."""
        free = self.theta
        self.theta = free + hand
        outputs = self.run(round(seconds / PERIOD_S))
        self.theta = free
        return outputs

    def learn(self, seconds):
        self.run_until(SchemeState.ADAPT)
        return self.run(round(seconds / PERIOD_S))

    def error_of(self, name):
        place = NAMES.index(name)
        return abs(self.model_theta[place] - self.theta[place])

    @property
    def kernel(self):
        """The kernel's constants and memory, as its functions take them."""
        return self.pipeline.numbers[:2]

    @property
    def m(self):
        """The memory's one record."""
        return self.pipeline.numbers.memory[0]

    @property
    def model_theta(self):
        """The parameters of the model in use (p,)."""
        return self.m.models.theta

    @property
    def offset_error_Nm(self):
        """Of the model in use: how far its offsets are off (2,)."""
        return self.model_theta[OFFSETS] - self.offset_Nm

    def recover(self, within_s=9.0):
        """Run until it monitors; the user acknowledges a release that was a collision."""
        for _ in range(round(within_s / PERIOD_S)):
            state = self.step().state
            if state is SchemeState.MONITOR:
                return
            if state is SchemeState.STOPPED:
                self.request = Request.ACKNOWLEDGE
        raise AssertionError(f"still in {state.name}")

    def said(self, name):
        return [event.message for event in self.events if event.name == name]

    def told(self, name):
        return [event.operator_text for event in self.events if event.name == name]

    def levels(self, name):
        return [event.level for event in self.events if event.name == name]


def arm_state(cycle, q=(0.0, 0.0), dq=(0.0, 0.0), tau_J=(0.0, 0.0), **changes) -> ArmState:
    """Return what an enabled, healthy arm reports."""
    state = ArmState(
        cycle, cycle * 1_000_000, 1, np.array(q), np.array(dq), np.array(tau_J), (0, 0), (0, 0), is_enabled=True,
        is_complete=True, fault=FaultReason.NONE,
    )  # fmt: skip
    return state._replace(**changes)


def states(outputs) -> set[SchemeState]:
    return {output.state for output in outputs}


def learnt_s(outputs) -> float:
    """Return how long the arm has learnt and been tested."""
    return PERIOD_S * sum(output.state in (SchemeState.ADAPT, SchemeState.CERTIFY) for output in outputs)


def kernel_of(settings: Settings = SETTINGS):
    """Return the certified kernel's constants and a new memory, as its functions take them."""
    return certified_memory.constants_of(settings)[0], certified_memory.new_memory(settings)[0]


class Kernel:
    """The compiled step with its constants, memory and block, sample by sample."""

    def __init__(self, settings=SETTINGS, theta=None, P=None):
        self.constants = certified_memory.constants_of(settings)
        self.memory, self.block = certified_memory.new_memory(settings), certified_memory.new_block(settings)
        certified_kernel.begin_adaptation(self.constants, self.memory, False, True)
        self.m, self.out = self.memory[0], self.block[0]
        if theta is not None:
            self.m.models.theta[: len(theta)] = theta
            self.m.models.theta[len(theta) :] = 0.0
        if P is not None:
            self.m.models.P[:] = P

    def step(self, q, dq, tau_J, mode=0, is_complete=1, periods=1, period_s=0.0):
        self.out.q, self.out.dq, self.out.tau_J, self.out.period_s = q, dq, tau_J, period_s
        return certified_kernel.step(self.constants, self.memory, self.block, is_complete, periods, mode)

    def run(self, q, dq, tau_J, mode=0, period_s=None):
        """Return observations (n,) and bare residuals (n, C, 2)."""
        observations, residuals = [], []
        for k in range(len(q)):
            each_s = 0.0 if period_s is None else period_s[k]
            observations.append(self.step(q[k], dq[k], tau_J[k], mode, period_s=each_s))
            residuals.append(self.m.filters.r.copy())
        return np.array(observations), np.array(residuals)
