"""A laboratory without a bus: recordings of an emulated arm in closed loop, at some 4 µs per simulated millisecond.

    from lab import Push, profile_arm, random_arm, paper_motion, random_motion, join, record
    r = record(profile_arm("M", payload_kg=1.0), paper_motion(60.0), seed=1)          # joint PD alone
    r = record(arm, motion, seed=2, feedforward=((6.0, theta),), payloads=((30.0, 1.0),),
               contacts=(ContactSettings(at_s=20, link=2, point_m=.2, force_N=30, duration_s=.05, shape="half_sine"),),
               pushes=(Push(25.0, 0.5, (0.3, 0.0)),))
    r.q, r.dq, r.tau_J (n, 2) as on the wire; r.tau_ext (n, 2), r.theta (n, 7) true; r.tau_c commanded; r.motion.q_d ...

It is `firmware_sim.body.body` itself in a compiled loop with the joint controller and the cycle of delay of the wire,
so a record equals, bit for bit, what the emulator measures under the same commands. Deterministic per seed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from lab_arm import LabArm, profile_arm, random_arm, theta_of
from lab_motion import PERIOD_S, Motion, cut, join, multisine, paper_motion, random_motion, random_moves, still
from numpy.typing import NDArray

from adacd_hil.compiled import compiled
from adacd_hil.control.controller import HANDOVER_S, fill_torque
from adacd_hil.records import JOINTS, PARAMETER_NAMES, Vector
from adacd_hil.settings.arm_settings import ArmSettings
from adacd_hil.structured import Structured
from firmware_sim.arm.plant import external_torque
from firmware_sim.arm.sensing import POSITION_LSB_RAD, TORQUE_LSB_NM, VELOCITY_LSB_RAD_S, DriveMode
from firmware_sim.arm.touch_settings import TICK_S, ContactSettings, ticks
from firmware_sim.body.body import Body
from firmware_sim.body.body_ticks import BODY_NUMBERS, BODY_STATE, advance_body, find_contact, sample_body
from firmware_sim.scenario.scenario import PayloadSettings, Scenario

__all__ = [
    "PERIOD_S", "ContactSettings", "LabArm", "Motion", "Push", "Recording", "cut", "join", "multisine", "paper_motion",
    "profile_arm", "random_arm", "random_motion", "random_moves", "record", "still",
]  # fmt: skip

TICKS = ticks(PERIOD_S)
_POWERED = int(DriveMode.TORQUE)
_UNLIMITED_NM = 1e9
_PUSH_COLUMNS = 5


@dataclass(frozen=True)
class Push:
    """An external torque on the joints themselves, as of no force on a link: for steps of one joint's torque.

    shape: "step", "half_sine".
    """

    at_s: float
    duration_s: float
    tau_ext_Nm: tuple[float, float]
    shape: str = "step"


@dataclass(frozen=True)
class Recording:
    """What was measured, asked for and true at each of n samples; arrays (n, 2) but theta (n, 7)."""

    arm: LabArm
    motion: Motion
    contacts: tuple[ContactSettings, ...]
    pushes: tuple[Push, ...]
    seed: int
    q: NDArray[np.float64]
    dq: NDArray[np.float64]
    tau_J: NDArray[np.float64]
    tau_c: NDArray[np.float64]
    tau_ext: NDArray[np.float64]
    theta: NDArray[np.float64]


@compiled
def _push_torque(pushes: NDArray[np.float64], tick: float) -> tuple[float, float]:
    """Add up the pushes in force during a tick; rows: first tick, end tick, torques, whether a half-sine."""
    tau1, tau2 = 0.0, 0.0
    for row in pushes:
        if row[0] <= tick < row[1]:
            share = np.sin(np.pi * (tick + 0.5 - row[0]) / (row[1] - row[0])) if row[4] != 0.0 else 1.0
            tau1 += share * row[2]
            tau2 += share * row[3]
    return tau1, tau2


@compiled
def _lead_over(theta_ff: NDArray[np.float64], cycles: NDArray[np.int64], k: int, handover: int, theta: Vector) -> None:
    """Fill the parameters (7,) that the feedforward has at cycle k, as `control.controller` leads them over."""
    theta[:] = 0.0
    for row in range(theta_ff.shape[0]):
        share = min(max((k - cycles[row] + 1) / handover, 0.0), 1.0)
        theta[:] = (1.0 - share) * theta + share * theta_ff[row]


@compiled
def _limit(tau_d: Vector, limit_Nm: Vector, step_Nm: Vector, quantum_Nm: Vector, tau_c: Vector) -> None:
    """Fill what is commanded: within torque and rate limit, as `control.gate`, in per mille of the rated torque."""
    for i in range(JOINTS):
        wanted = min(max(tau_d[i], -limit_Nm[i]), limit_Nm[i])
        wanted = min(max(wanted, tau_c[i] - step_Nm[i]), tau_c[i] + step_Nm[i])
        tau_c[i] = np.rint(wanted / quantum_Nm[i]) * quantum_Nm[i]


@compiled
def play_loop(
    state_vector: Vector,
    number_vector: Vector,
    contacts: Structured,
    things: Structured,
    touch_state: Vector,
    payloads: Structured,
    work: Vector,
    encoder_noise: NDArray[np.float64],
    substeps: int,
    pushes: NDArray[np.float64],
    drift: NDArray[np.float64],
    asymmetry: float,
    torque_noise: NDArray[np.float64],
    q_d: NDArray[np.float64],
    dq_d: NDArray[np.float64],
    ddq_d: NDArray[np.float64],
    Kp: Vector,
    Kd: Vector,
    limits: NDArray[np.float64],
    theta_ff: NDArray[np.float64],
    theta_cycles: NDArray[np.int64],
    handover: int,
    q: NDArray[np.float64],
    dq: NDArray[np.float64],
    tau_J: NDArray[np.float64],
    tau_c: NDArray[np.float64],
    tau_ext: NDArray[np.float64],
) -> None:
    """Play n cycles: sample, control, and let the command of the cycle before act until the next sample."""
    counts = np.zeros(3 * JOINTS, np.int64)
    none, tau_d, command, latched = np.zeros(JOINTS), np.zeros(JOINTS), np.zeros(JOINTS), np.zeros(JOINTS)
    theta = np.zeros(theta_ff.shape[1])
    state, arm = state_vector.view(BODY_STATE)[0], number_vector.view(BODY_NUMBERS)[0]["arm"]
    now, course = state["arm"], state["course"]
    viscous, coulomb = arm["viscous_Nm_s"].copy(), arm["coulomb_Nm"].copy()
    for k in range(q.shape[0]):
        tick = float(k * TICKS)
        contact = find_contact(course, contacts)
        elapsed_s = (tick - contact[0]["onset_tick"]) * TICK_S if contact.size != 0 else 0.0
        ext1, ext2 = external_torque(arm, contact, elapsed_s, now["q"][0], now["q"][1], now["dq"][0], now["dq"][1])
        push1, push2 = _push_torque(pushes, tick)
        tau_ext[k, 0], tau_ext[k, 1] = ext1 + push1, ext2 + push2
        sample_body(state_vector, number_vector, torque_noise[k], none, counts)
        for i in range(JOINTS):
            q[k, i] = counts[i] * POSITION_LSB_RAD
            dq[k, i] = counts[JOINTS + i] * VELOCITY_LSB_RAD_S
            tau_J[k, i] = np.rint(counts[2 * JOINTS + i] * TORQUE_LSB_NM * 1e6) * 1e-6
            arm["viscous_Nm_s"][i] = viscous[i] * drift[k, 0]
            arm["coulomb_Nm"][i] = coulomb[i] * drift[k, 1]
        _lead_over(theta_ff, theta_cycles, k, handover, theta)
        fill_torque(q[k], dq[k], q_d[k], dq_d[k], ddq_d[k], theta, Kp, Kd, 0.0, tau_d)
        latched[:] = command
        _limit(tau_d, limits[0], limits[1], limits[2], command)
        tau_c[k] = command
        is_pushed = False
        for row in pushes:
            is_pushed = is_pushed or (row[0] < tick + TICKS and row[1] > tick)
        is_fine = is_pushed or asymmetry != 0.0
        for index in range(TICKS if is_fine else 1):
            # The joint's balance knows the sum of motor and external torque only: the one may stand for the other. But
            # in variant "load" friction then grows with a push as well.
            push1, push2 = _push_torque(pushes, tick + index) if is_pushed else (0.0, 0.0)
            if asymmetry != 0.0:
                for i in range(JOINTS):
                    arm["coulomb_Nm"][i] = coulomb[i] * drift[k, 1] * (1.0 + asymmetry * np.sign(now["dq"][i]))
            now["tau_m"][0] += push1
            now["tau_m"][1] += push2
            advance_body(
                state_vector, number_vector, contacts, things, touch_state, payloads, work, encoder_noise, substeps,
                latched[0] + push1, latched[1] + push2, _POWERED, _POWERED, 1 if is_fine else TICKS,
            )  # fmt: skip
            now["tau_m"][0] -= push1
            now["tau_m"][1] -= push2
            now["tau_J"][0] -= push1
            now["tau_J"][1] -= push2


def record(
    arm: LabArm,
    motion: Motion,
    seed: int = 0,
    contacts: Sequence[ContactSettings] = (),
    pushes: Sequence[Push] = (),
    feedforward: Sequence[tuple[float, NDArray[np.float64]]] = (),
    payloads: Sequence[tuple[float, float]] = (),
) -> Recording:
    """Record an arm that begins at rest where the motion does, its drives already enabled.

    feedforward: from when on which parameters (7,) are fed forward, s. payloads: when the payload becomes how much, s
    and kg. Raises ConfigError for contacts that overlap or lie beyond the link.
    """
    count = len(motion.q_d)
    degrees = np.degrees(motion.q_d[0])
    scenario = Scenario(
        own_arm=arm.arm,
        seed=seed,
        start_deg=(float(degrees[0]), float(degrees[1])),
        payload_kg=arm.payload_kg,
        torque_offset_Nm=arm.torque_offset_Nm,
        sensors=arm.sensors,
        drives=arm.drives,
        mechanics=arm.mechanics,
        contacts=tuple(contacts),
        payloads=tuple(PayloadSettings(at_s, mass_kg) for at_s, mass_kg in payloads),
    )
    if any(arm.sensors.encoder_noise_counts) or any(arm.sensors.offset_walk_Nm_rs):
        raise ValueError("encoder noise and a walk of the torque offset are drawn outside the compiled loop")
    body = Body(scenario)
    body.start_scenario()
    parts = body.parts
    numbers = parts.numbers.view(BODY_NUMBERS)[0]
    numbers["arm"]["rated_torque_Nm"][:] = numbers["motor"]["peak_Nm"][:] = _UNLIMITED_NM
    rated_Nm = np.array(arm.arm.rated_torque_Nm)
    rate_share = np.array(ArmSettings().torque_rate_limit_Nm_s) / ArmSettings().rated_torque_Nm
    noise = np.random.default_rng(seed).standard_normal((count, JOINTS)) * arm.sensors.torque_noise_Nm
    drift = arm.drift(seed, count)
    q, dq, tau_J, tau_c, tau_ext = (np.zeros((count, JOINTS)) for _ in range(5))
    play_loop(
        *parts, _push_table(pushes), drift, arm.asymmetry, noise, motion.q_d, motion.dq_d, motion.ddq_d,
        np.array(arm.Kp), np.array(arm.Kd),
        np.stack((rated_Nm, rate_share * rated_Nm * PERIOD_S, 1e-3 * rated_Nm)),
        np.array([theta for _, theta in feedforward], np.float64).reshape(-1, len(PARAMETER_NAMES)),
        np.array([round(at_s / PERIOD_S) for at_s, _ in feedforward], np.int64), round(HANDOVER_S / PERIOD_S),
        q, dq, tau_J, tau_c, tau_ext,
    )  # fmt: skip
    theta = np.tile(arm.theta, (count, 1))
    for at_s, mass_kg in payloads:
        theta[round(at_s / PERIOD_S) :] = theta_of(arm.arm, mass_kg)
    theta[:, 3:5] *= drift[:, :1]
    theta[:, 5:7] *= drift[:, 1:]
    return Recording(arm, motion, tuple(contacts), tuple(pushes), seed, q, dq, tau_J, tau_c, tau_ext, theta)


def _push_table(pushes: Sequence[Push]) -> NDArray[np.float64]:
    rows = [
        (ticks(push.at_s), ticks(push.at_s + push.duration_s), *push.tau_ext_Nm, float(push.shape == "half_sine"))
        for push in pushes
    ]
    return np.array(rows, np.float64).reshape(len(rows), _PUSH_COLUMNS)
