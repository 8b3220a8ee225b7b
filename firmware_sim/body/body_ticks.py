"""The emulated arm from tick to tick, compiled: drives' inner loops, mechanics, the person, and the sensors.

In each tick of 100 µs

    the person's and the payload's change of this tick → torque target of each drive → integrate → encoder → velocity

Callers hold state and numbers as plain vectors, which cost less to hand over; BODY_STATE and BODY_NUMBERS name their
fields.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from adacd_hil.compiled import compiled
from adacd_hil.log.types.truth_topic import TRUTH_LAYOUT
from adacd_hil.records import Vector
from adacd_hil.structured import Structured, float_fields
from firmware_sim.arm.joint_forces import MECHANICS_NUMBERS, Surroundings
from firmware_sim.arm.mechanics import integrate_mechanics, observe
from firmware_sim.arm.plant import (
    ARM_NUMBERS,
    MECHANICAL_STATE,
    fit_payload,
)
from firmware_sim.arm.sensing import POSITION_LSB_RAD, VELOCITY_LSB_RAD_S, DriveMode, to_counts, track
from firmware_sim.arm.touch_forces import TOUCH_TRUTH, add_prescribed_work, change_touch, describe_touch
from firmware_sim.arm.touch_settings import PAIR, TICK_S
from firmware_sim.body.motor import MOTOR_NUMBERS, MOTOR_STATE, command_torque, heat_motor
from firmware_sim.body.sensors import (
    ENCODER_NUMBERS,
    NOISE_TICKS,
    TRANSDUCER_NUMBERS,
    TRANSDUCER_STATE,
    read_angle,
    sample_torque,
    sense_torque,
    walk_offset,
)

_COURSE: Final = float_fields(
    {
        "tick": (),  # since power-on
        "start_tick": (),  # tick of scenario time 0; −1 before
        "contact": (),  # index of the contact in force or the next one
        "change": (),  # index of the next payload change
        "encoder_rad": PAIR,
        "estimate_rad": PAIR,  # position of the tracking loop
        "velocity_rad_s": PAIR,  # velocity of the tracking loop
    }
)
BODY_STATE: Final = np.dtype(
    [("arm", MECHANICAL_STATE), ("course", _COURSE), ("motor", MOTOR_STATE), ("transducer", TRANSDUCER_STATE)]
)
BODY_NUMBERS: Final = np.dtype(
    [
        ("arm", ARM_NUMBERS),
        ("mechanics", MECHANICS_NUMBERS),
        ("motor", MOTOR_NUMBERS),
        ("encoder", ENCODER_NUMBERS),
        ("transducer", TRANSDUCER_NUMBERS),
    ]
)
PAYLOAD_CHANGE: Final = float_fields(
    {
        "tick": (),
        "mass_kg": (),
        "along_m": (),
        "beside_m": (),
        "inertia_kg_m2": (),
    }  # from the tip; along, beside link 2
)
_TRUTH: Final = float_fields({field.name: (field.size,) for field in TRUTH_LAYOUT.fields})

_SLOW_SHARE: Final = 0.5
_HARD_SHARE: Final = 1.5
"""Of the brake's damping. The shortest time constant, 10 ms / 1.5, is four lags of the drive's velocity: no
overshoot."""


@compiled
def find_contact(course: np.void, contacts: Structured) -> Structured:
    """Return the row of the scripted contact that acts at this tick (1,), or an empty array.

    Sets `course["contact"]` to the index of that contact or of the next one. Contacts that have ended are skipped for
    good. course: that part of the body's state.
    """
    if course["start_tick"] < 0.0:
        return contacts[:0]
    tick = course["tick"] - course["start_tick"]
    index = int(course["contact"])
    while index < contacts.size and contacts[index]["end_tick"] <= tick:
        index += 1
    course["contact"] = index
    if index < contacts.size and contacts[index]["onset_tick"] <= tick:
        return contacts[index : index + 1]
    return contacts[:0]


@compiled
def _elapsed_s(course: np.void, contact: Structured) -> float:
    """Return the time since the onset of the contact in row `contact` (1,), s; 0 for an empty array."""
    if contact.size == 0:
        return 0.0
    return float((course["tick"] - course["start_tick"] - contact[0]["onset_tick"]) * TICK_S)


@compiled
def _change_payload(state: np.void, arm: np.void, payloads: Structured) -> None:
    """Apply the payload changes that are due by this tick, each once; none before the scenario starts.

    payloads: rows of PAYLOAD_CHANGE.
    """
    course = state["course"]
    if course["start_tick"] < 0.0:
        return
    tick = course["tick"] - course["start_tick"]
    index = int(course["change"])
    while index < payloads.size and payloads[index]["tick"] <= tick:
        change = payloads[index]
        fit_payload(
            state["arm"], arm, change["mass_kg"], change["along_m"], change["beside_m"], change["inertia_kg_m2"]
        )
        index += 1
    course["change"] = index


@compiled
def _scenario_s(course: np.void) -> float:
    """Return the scenario time of this tick in s, −1 before the scenario starts."""
    return float((course["tick"] - course["start_tick"]) * TICK_S) if course["start_tick"] >= 0.0 else -1.0


@compiled
def _torque_target(arm: np.void, joint: int, mode: int, setpoint_Nm: float, velocity_rad_s: float) -> float:
    """Return the torque that a drive wants in a `DriveMode`, Nm: set-point or braking, limited to its rated torque.

    0 while it is off.
    """
    limit_Nm = arm["rated_torque_Nm"][joint]
    if mode == DriveMode.TORQUE:
        return float(min(max(setpoint_Nm, -limit_Nm), limit_Nm))
    damping = arm["brake_damping_Nm_s"][joint]
    if mode == DriveMode.BRAKE_SLOWLY:
        damping *= _SLOW_SHARE
    elif mode == DriveMode.BRAKE_HARD:
        damping *= _HARD_SHARE
    elif mode != DriveMode.BRAKE:
        return 0.0
    return float(min(max(-damping * velocity_rad_s, -limit_Nm), limit_Nm))


@compiled
def _read_encoder(course: np.void, numbers: np.void, joint: int, angle_rad: float, noise_counts: float) -> None:
    """Store the angle that the encoder measures at a tick's end, where its shaft is at `angle_rad`.

    Update the drive's position and velocity estimates by it.
    """
    now_rad = read_angle(numbers["encoder"], joint, angle_rad, noise_counts)
    course["estimate_rad"][joint], course["velocity_rad_s"][joint] = track(
        course["encoder_rad"][joint],
        now_rad,
        course["estimate_rad"][joint],
        course["velocity_rad_s"][joint],
        TICK_S,
        numbers["motor"]["tracking_rad_s"][joint],
    )
    course["encoder_rad"][joint] = now_rad


@compiled
def _measure_tick(state: np.void, numbers: np.void, encoder_noise: NDArray[np.float64]) -> None:
    """Update the encoders by the arm's state at the end of a tick.

    Update motor temperatures if the motors have limits, and the torque sensors if they have memory. encoder_noise:
    `EncoderNoise.table`, counts, filled for this tick.
    """
    arm, course, motor = state["arm"], state["course"], numbers["motor"]
    tick = course["tick"]
    noise = encoder_noise[int(tick) % (2 * NOISE_TICKS)]
    for joint in range(2):
        _read_encoder(course, numbers, joint, arm["q_encoder"][joint], noise[joint])
    if motor["has_limits"] != 0.0:
        for joint in range(2):
            heat_motor(motor, state["motor"], joint, arm["tau_m"][joint])
    if numbers["transducer"]["has_memory"] != 0.0:
        for joint in range(2):
            tau_Nm, other_Nm = arm["tau_J"][joint], arm["tau_J"][1 - joint]
            sense_torque(
                numbers["transducer"], state["transducer"], joint, tick, tau_Nm, other_Nm, arm["temperature_C"][joint]
            )


@compiled
def advance_body(
    state_vector: Vector,
    number_vector: Vector,
    contacts: Structured,
    things: Structured,
    touch_state: Vector,
    payloads: Structured,
    work: Vector,
    encoder_noise: NDArray[np.float64],
    substeps: int,
    setpoint1_Nm: float,
    setpoint2_Nm: float,
    mode1: int,
    mode2: int,
    tick_count: int,
) -> None:
    """Advance the body's state, touch state included, by `tick_count` ticks of 100 µs, in place.

    State and numbers: laid out by BODY_STATE and BODY_NUMBERS. contacts, things, payloads: tables of CONTACT, THING and
    PAYLOAD_CHANGE. work: from `work_space`, overwritten. encoder_noise: table of `EncoderNoise`. substeps: integration
    steps per tick. mode1, mode2: `DriveMode`.
    """
    state, numbers = state_vector.view(BODY_STATE)[0], number_vector.view(BODY_NUMBERS)[0]
    now, course, motors = state["arm"], state["course"], state["motor"]
    arm, mechanics, motor = numbers["arm"], numbers["mechanics"], numbers["motor"]
    for _ in range(tick_count):
        _change_payload(state, arm, payloads)
        contact = find_contact(course, contacts)
        elapsed_s = _elapsed_s(course, contact)
        before1, before2 = now["q"][0], now["q"][1]
        change_touch(things, _scenario_s(course), before1, before2, touch_state, contact.size != 0)
        wanted1 = _torque_target(arm, 0, mode1, setpoint1_Nm, course["velocity_rad_s"][0])
        wanted2 = _torque_target(arm, 1, mode2, setpoint2_Nm, course["velocity_rad_s"][1])
        target1 = command_torque(motor, motors, 0, wanted1, now["tau_m"][0], mode1 != DriveMode.OFF)
        target2 = command_torque(motor, motors, 1, wanted2, now["tau_m"][1], mode2 != DriveMode.OFF)
        now["brake_Nm"][0] = mechanics["holding_brake_Nm"][0] if mode1 == DriveMode.OFF else 0.0
        now["brake_Nm"][1] = mechanics["holding_brake_Nm"][1] if mode2 == DriveMode.OFF else 0.0
        around = Surroundings(now, arm, mechanics, contact, things)
        integrate_mechanics(
            around, touch_state, _scenario_s(course), elapsed_s, target1, target2, TICK_S, substeps, work
        )
        add_prescribed_work(
            contact, elapsed_s, TICK_S, arm["link_length_m"][0], before1, before2, now["q"][0], now["q"][1], touch_state
        )
        _measure_tick(state, numbers, encoder_noise)
        course["tick"] += 1.0


@compiled
def sample_body(
    state_vector: Vector, number_vector: Vector, noise: Vector, walk: Vector, out: NDArray[np.int64]
) -> None:
    """Write the measured values to `out` (6,): counts of position, velocity and torque, two each, by joint.

    noise (2,): noise of the torque sensors, Nm. walk (2,): normal numbers times the rms after one second of their
    zeros' walk, which each call advances.
    """
    state, numbers = state_vector.view(BODY_STATE)[0], number_vector.view(BODY_NUMBERS)[0]
    arm, course, transducers = state["arm"], state["course"], state["transducer"]
    tick = course["tick"]
    walk_offset(transducers, tick, walk)
    for joint in range(2):
        tau, other = arm["tau_J"][joint], arm["tau_J"][1 - joint]
        out[joint] = to_counts(course["encoder_rad"][joint], POSITION_LSB_RAD)
        out[2 + joint] = to_counts(course["velocity_rad_s"][joint], VELOCITY_LSB_RAD_S)
        out[4 + joint] = sample_torque(
            numbers["transducer"], transducers, joint, tick, tau, other, arm["temperature_C"][joint], noise[joint]
        )


@compiled
def fill_truth(
    state_vector: Vector,
    number_vector: Vector,
    contacts: Structured,
    things: Structured,
    touch_state: Vector,
    payloads: Structured,
    work: Vector,
    touch_truth: Vector,
    block: Vector,
) -> None:
    """Fill a block laid out by TRUTH_LAYOUT with the true values of this instant.

    First applies the payload and touch changes that are due. Tables are as of `advance_body`.
    touch_truth: room for TOUCH_TRUTH, overwritten. work: from `work_space`, overwritten.
    """
    state, numbers = state_vector.view(BODY_STATE)[0], number_vector.view(BODY_NUMBERS)[0]
    now, course, arm = state["arm"], state["course"], numbers["arm"]
    touched, out = touch_truth.view(TOUCH_TRUTH)[0], block.view(_TRUTH)[0]
    block[:] = 0.0
    _change_payload(state, arm, payloads)
    contact = find_contact(course, contacts)
    elapsed_s = _elapsed_s(course, contact)
    q1, q2, dq1, dq2 = now["q"][0], now["q"][1], now["dq"][0], now["dq"][1]
    time_s = _scenario_s(course)
    change_touch(things, time_s, q1, q2, touch_state, contact.size != 0)
    describe_touch(
        things, time_s, q1, q2, dq1, dq2, touch_state,
        contact, course["contact"], elapsed_s, arm["link_length_m"][0], touched,
    )  # fmt: skip
    around = Surroundings(now, arm, numbers["mechanics"], contact, things)
    ext1, ext2, friction1, friction2, held1, held2 = observe(around, touch_state, time_s, elapsed_s, work)
    out["tau_ext"][0], out["tau_ext"][1] = ext1, ext2
    out["tau_friction"][0], out["tau_friction"][1] = friction1, friction2
    out["tau_gravity"][0], out["tau_gravity"][1] = held1, held2
    out["contact_force"][0] = touched["force_N"]
    out["contact_link"][0] = touched["link"]
    out["contact_index"][0] = touched["index"]
    out["contact_power"][0] = touched["power_W"]
    out["contact_energy"][0] = touched["energy_J"]
    out["payload"][0] = now["payload_kg"]
    theta = out["theta"]
    theta[0], theta[1], theta[2] = now["alpha"] + now["gamma"], now["beta"], now["gamma"]
    for joint in range(2):
        theta[3 + joint], theta[5 + joint] = arm["viscous_Nm_s"][joint], arm["coulomb_Nm"][joint]
        out["q"][joint], out["dq"][joint] = now["q"][joint], now["dq"][joint]
        out["tau_J"][joint] = now["tau_J"][joint]
        out["q_m"][joint], out["tau_m"][joint] = now["q_m"][joint], now["tau_m"][joint]
        out["joint_temperature"][joint] = now["temperature_C"][joint]
