"""An imperfect motor and its drive: torque loop, torque constant, current limits, temperature.

The drive believes in the torque m = current × nominal torque constant; with the error ε of the torque constant and the
zero error o of the current sensor, both of the scenario, the motor gives

    τ = (1 + ε)(m + o)          0x6077 is m

    torque loop  τ' = ω (target − τ), ω = 2π · bandwidth
    I²t          E' = i² − i_c² within 0 … (i_p² − i_c²) t_p, i = m + o. At the upper end only i_c is left, until a
                 tenth of E has gone (Copley lets go at once)
    temperature  T = ambient + w + h, w' = (w_r (i/i_r)² − w) / t_w, h' = (h_r (i/i_r)² − h) / t_h
    derating     what is left falls from the whole at derating start to nothing at derating end
    fault        T at or above the overheating temperature, until T is below derating start: 0x4310.
                 Where I²t is to fault: at the upper end of E, until a tenth has gone: 0x2310

i_p peak, i_c continuous, i_r rated, t_p peak time; w and h: winding over housing and housing over ambient, whose steady
rises at rated torque are w_r and h_r. The winding's resistance and the torque constant don't change with temperature.

Source: I²t as in Copley Controls, CME 2 User Guide, appendix "I²T time limit algorithm"; temperature as the two thermal
resistances and time constants of motor data sheets; error codes of CiA 402-2 (IEC 61800-7-201).
"""

import math
from typing import Final

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import Vector
from firmware_sim.arm.device_settings import CURRENT_LOOP_HZ, DriveSettings
from firmware_sim.arm.scripted_contact import TICK_S

CONTINUOUS_OVER_CURRENT: Final = 0x2310
EXCESS_TEMPERATURE: Final = 0x4310
_RELEASE: Final = 0.9
"""Share of I²t's budget at which it lets go: a drive that holds its continuous current must not go to and fro."""

# Places in the vector of numbers; pairs are joint 1, joint 2.
HASTE: Final = 0  # way of this torque loop in a tick over that of the plant's
GAIN: Final = 2
OFFSET: Final = 4  # Nm
PEAK: Final = 6  # Nm
CONTINUOUS: Final = 8  # Nm; 0: no I²t
BUDGET: Final = 10  # Nm² s
WINDING_RISE: Final = 12  # K per Nm²
WINDING_SHARE: Final = 14  # of the way to the steady rise, in a tick
HOUSING_RISE: Final = 16
HOUSING_SHARE: Final = 18
AMBIENT: Final = 20  # °C, as the next three
DERATING_START: Final = 22
DERATING_END: Final = 24
OVERHEAT: Final = 26
TRACKING: Final = 28  # rad/s
CAN_OVERLOAD: Final = 30  # one: whether I²t is a fault
HAS_LIMITS: Final = 31  # one: whether I²t or temperature count
MOTOR_NUMBERS: Final = 32

# Places in the state; pairs are joint 1, joint 2.
WINDING: Final = 0  # w above, K
HOUSING: Final = 2  # h above, K
EFFORT: Final = 4  # E above, Nm² s
IS_SPENT: Final = 6  # whether I²t leaves the continuous current only
IS_OVERHEATED: Final = 8
IS_LIMITED: Final = 10  # whether the drive wants more than it may
MOTOR_STATE: Final = 12


def motor_numbers(settings: DriveSettings, rated_torque_Nm: tuple[float, float]) -> Vector:
    """Pack the drives' properties for compiled functions (MOTOR_NUMBERS,)."""
    numbers = np.zeros(MOTOR_NUMBERS)
    plant_way = math.expm1(-2.0 * math.pi * CURRENT_LOOP_HZ * TICK_S)
    for joint in range(2):
        rated_Nm = rated_torque_Nm[joint]
        peak_Nm = min(settings.peak_torque_Nm[joint] or rated_Nm, rated_Nm)
        continuous_Nm = settings.continuous_torque_Nm[joint]
        if continuous_Nm >= peak_Nm:
            continuous_Nm = 0.0  # never less than all that there is
        way = math.expm1(-2.0 * math.pi * settings.current_loop_Hz[joint] * TICK_S)
        numbers[HASTE + joint] = way / plant_way
        numbers[GAIN + joint] = 1.0 + settings.torque_constant_error[joint]
        numbers[OFFSET + joint] = settings.torque_offset_Nm[joint]
        numbers[PEAK + joint] = peak_Nm
        numbers[CONTINUOUS + joint] = continuous_Nm
        numbers[BUDGET + joint] = (peak_Nm**2 - continuous_Nm**2) * settings.peak_time_s[joint]
        numbers[WINDING_RISE + joint] = settings.winding_rise_K[joint] / rated_Nm**2
        numbers[WINDING_SHARE + joint] = -math.expm1(-TICK_S / settings.winding_time_s[joint])
        numbers[HOUSING_RISE + joint] = settings.housing_rise_K[joint] / rated_Nm**2
        numbers[HOUSING_SHARE + joint] = -math.expm1(-TICK_S / settings.housing_time_s[joint])
        numbers[AMBIENT + joint] = settings.ambient_C[joint]
        numbers[DERATING_START + joint] = settings.derating_start_C[joint]
        numbers[DERATING_END + joint] = settings.derating_end_C[joint]
        numbers[OVERHEAT + joint] = settings.overheat_C[joint]
        numbers[TRACKING + joint] = 2.0 * math.pi * settings.velocity_loop_Hz[joint]
    numbers[CAN_OVERLOAD] = 1.0 if settings.i2t_reaction == "fault" else 0.0
    heats = (*settings.winding_rise_K, *settings.housing_rise_K)
    is_warm = any(settings.preheat_K) or np.any(numbers[AMBIENT : AMBIENT + 2] > numbers[DERATING_START:DERATING_END])
    numbers[HAS_LIMITS] = 1.0 if any(settings.continuous_torque_Nm) or any(heats) or is_warm else 0.0
    return numbers


def motor_state(settings: DriveSettings) -> Vector:
    """Give the motors at power-on (MOTOR_STATE,)."""
    state = np.zeros(MOTOR_STATE)
    state[HOUSING : HOUSING + 2] = settings.preheat_K
    return state


@compiled
def winding_temperature(numbers: Vector, state: Vector, joint: int) -> float:
    """Give T above, °C."""
    return float(numbers[AMBIENT + joint] + state[WINDING + joint] + state[HOUSING + joint])


@compiled
def available_torque(numbers: Vector, state: Vector, joint: int) -> float:
    """Give the largest torque that the drive may ask for now, Nm."""
    limit_Nm = numbers[PEAK + joint]
    if numbers[HAS_LIMITS] == 0.0:
        return float(limit_Nm)
    if state[IS_SPENT + joint] != 0.0:
        limit_Nm = numbers[CONTINUOUS + joint]
    start_C, end_C = numbers[DERATING_START + joint], numbers[DERATING_END + joint]
    left = (end_C - winding_temperature(numbers, state, joint)) / (end_C - start_C)
    return float(limit_Nm * min(max(left, 0.0), 1.0))


@compiled
def command_torque(
    numbers: Vector, state: Vector, joint: int, wanted_Nm: float, tau_Nm: float, is_powered: bool
) -> float:
    """Give the target at which the plant's torque loop brings the motor to where it is after this tick, Nm.

    wanted: what the drive asks for, within rated torque. tau: the motor's torque now. The plant's loop has 1 kHz; one
    of another bandwidth is exact at the ends of the ticks. Within a tick a slower one is off by a hundredth of the way
    to the target at most, one of 2 kHz by a twentieth, one of 5 kHz by a quarter.
    """
    limit_Nm = available_torque(numbers, state, joint)
    target_Nm = min(max(wanted_Nm, -limit_Nm), limit_Nm)
    state[IS_LIMITED + joint] = 1.0 if abs(wanted_Nm) > limit_Nm else 0.0
    if is_powered:
        target_Nm = numbers[GAIN + joint] * (target_Nm + numbers[OFFSET + joint])
    if numbers[HASTE + joint] == 1.0:
        return float(target_Nm)
    return float(tau_Nm + (target_Nm - tau_Nm) * numbers[HASTE + joint])


@compiled
def heat_motor(numbers: Vector, state: Vector, joint: int, tau_Nm: float) -> None:
    """Carry I²t and temperature over a tick at whose end the motor gives `tau_Nm`. Only if HAS_LIMITS."""
    current_Nm = tau_Nm / numbers[GAIN + joint]
    square = current_Nm * current_Nm
    state[WINDING + joint] += (numbers[WINDING_RISE + joint] * square - state[WINDING + joint]) * numbers[
        WINDING_SHARE + joint
    ]
    state[HOUSING + joint] += (numbers[HOUSING_RISE + joint] * square - state[HOUSING + joint]) * numbers[
        HOUSING_SHARE + joint
    ]
    temperature_C = winding_temperature(numbers, state, joint)
    if temperature_C >= numbers[OVERHEAT + joint]:
        state[IS_OVERHEATED + joint] = 1.0
    elif temperature_C < numbers[DERATING_START + joint]:
        state[IS_OVERHEATED + joint] = 0.0
    continuous_Nm = numbers[CONTINUOUS + joint]
    if continuous_Nm > 0.0:
        budget = numbers[BUDGET + joint]
        effort = state[EFFORT + joint] + (square - continuous_Nm * continuous_Nm) * TICK_S
        state[EFFORT + joint] = min(max(effort, 0.0), budget)
        if effort >= budget:
            state[IS_SPENT + joint] = 1.0
        elif effort < _RELEASE * budget:
            state[IS_SPENT + joint] = 0.0


def believed_torque(numbers: Vector, joint: int, tau_Nm: float) -> float:
    """Give m above, Nm: what the drive makes of its current while the motor gives `tau_Nm`."""
    return float(tau_Nm / numbers[GAIN + joint] - numbers[OFFSET + joint])


def error_code(numbers: Vector, state: Vector, joint: int) -> int:
    """Give the error code that the motor's state calls for now, 0 for none."""
    if state[IS_OVERHEATED + joint]:
        return EXCESS_TEMPERATURE
    if state[IS_SPENT + joint] and numbers[CAN_OVERLOAD]:
        return CONTINUOUS_OVER_CURRENT
    return 0
