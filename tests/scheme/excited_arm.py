"""The small 2R arm of `planar_arm` on the excitation, recorded and played through the certified scheme's step."""

from typing import NamedTuple

import numpy as np
from planar_arm import ENCODER_LSB_RAD, TORQUE_LSB_NM, TORQUE_NOISE_NM, VELOCITY_LSB_RAD_S, advance

from adacd_hil.compiled import compiled
from adacd_hil.config import Settings, load_settings
from adacd_hil.control.excitation import Excitation
from adacd_hil.records import SchemeState
from adacd_hil.scheme import certified_kernel

PERIOD_S = 1e-3
SETTINGS = load_settings("certified", "P")
NAMES = certified_kernel.parameter_names(SETTINGS)


class Record(NamedTuple):
    """What was measured (n, 2)."""

    q: np.ndarray
    dq: np.ndarray
    tau_J: np.ndarray


class Played(NamedTuple):
    """What `certified_kernel.step_record` has made of a record."""

    state: np.ndarray
    observation: np.ndarray
    y: np.ndarray
    h: np.ndarray
    theta: np.ndarray
    constants: np.ndarray
    memory: np.ndarray
    block: np.ndarray

    def begin_of(self, state: SchemeState, after: int = 0) -> int:
        """Return the first sample from `after` on in this state."""
        places = np.flatnonzero(self.state[after:] == state)
        assert places.size, f"never in {state.name}"
        return after + int(places[0])


@compiled
def follow(theta, q_d, dq_d, Kp, Kd, tau_ext, noise, q, dq, tau_J):
    """Let the arm with parameters theta (n, 7) follow q_d under PD control; fill the measured q, dq, tau_J (n, 2)."""
    at, speed = q_d[0].copy(), dq_d[0].copy()
    tracked_q, tracked_dq = at.copy(), speed.copy()
    tau, tau_next = np.zeros(2), np.zeros(2)
    for k in range(q.shape[0]):
        q[k] = np.round(at / ENCODER_LSB_RAD) * ENCODER_LSB_RAD
        dq[k] = np.round(tracked_dq / VELOCITY_LSB_RAD_S) * VELOCITY_LSB_RAD_S
        tau_J[k] = np.round((tau + noise[k]) / TORQUE_LSB_NM) * TORQUE_LSB_NM
        tau[:] = tau_next
        tau_next[:] = Kp * (q_d[k] - q[k]) + Kd * (dq_d[k] - dq[k])
        advance(at, speed, tracked_q, tracked_dq, tau + tau_ext[k], theta[k], PERIOD_S)


def excitation_of(settings: Settings, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Return q_d, dq_d (n, 2) of the excitation."""
    excitation = Excitation(settings)
    q_d, dq_d, ddq_d = (np.zeros((round(seconds / PERIOD_S), 2)) for _ in range(3))
    for k in range(len(q_d)):
        excitation.evaluate(k * PERIOD_S, q_d[k], dq_d[k], ddq_d[k])
    return q_d, dq_d


def record(theta, seconds, tau_ext=None, added=None, added_at_s=0.0, motion=None, seed=1) -> Record:
    """Record the arm; added (7,): what a payload adds to its parameters from added_at_s on."""
    q_d, dq_d = excitation_of(SETTINGS, seconds) if motion is None else motion
    count = len(q_d)
    thetas = np.tile(theta, (count, 1))
    if added is not None:
        thetas[round(added_at_s / PERIOD_S) :] += added
    noise = TORQUE_NOISE_NM * np.random.default_rng(seed).standard_normal((count, 2))
    q, dq, tau_J = (np.zeros((count, 2)) for _ in range(3))
    Kp, Kd = np.array(SETTINGS.controller.Kp), np.array(SETTINGS.controller.Kd)
    follow(thetas, q_d, dq_d, Kp, Kd, np.zeros((count, 2)) if tau_ext is None else tau_ext, noise, q, dq, tau_J)
    return Record(q, dq, tau_J)


def play(measured: Record, payload_at: int = -1, settings: Settings = SETTINGS) -> Played:
    """Play a record through the compiled step."""
    count = len(measured.q)
    constants, memory = certified_kernel.constants_of(settings), certified_kernel.new_memory(settings)
    block = certified_kernel.new_block(settings)
    state, observation, theta = np.zeros(count), np.zeros(count), np.zeros((count, len(NAMES)))
    y, h = (np.zeros((count, *memory[0]["y"].shape)) for _ in range(2))
    certified_kernel.step_record(constants, memory, block, *measured, payload_at, state, observation, y, h, theta)
    return Played(state, observation, y, h, theta, constants, memory, block)
