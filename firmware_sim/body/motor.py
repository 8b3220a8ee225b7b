"""An imperfect motor and its drive: torque loop, torque constant, current limits, temperature.

The drive believes in the torque m = current × nominal torque constant; with the error ε of the torque constant and the
zero error o of the current sensor, both of the scenario, the motor gives

    τ = (1 + ε)(m + o)          0x6077 is m

    torque loop  τ' = ω (target − τ), ω = 2π · bandwidth
    I²t          E' = i² − i_c² within 0 … (i_p² − i_c²) t_p, i = m + o. At the upper end only i_c is left, until a
                 tenth of E has gone (Copley lets go at once)
    temperature  T = ambient + w + h, w' = (w_r (i/i_r)² − w) / t_w, h' = (h_r (i/i_r)² − h) / t_h
    derating     the limit falls from the whole at derating start to 0 at derating end
    fault        T at or above the overheating temperature, until T is below derating start: 0x4310.
                 I²t, if it is a fault, at the upper end of E until a tenth has gone: 0x2310

i_p peak, i_c continuous, i_r rated, t_p peak time; w and h: winding over housing and housing over ambient, whose steady
rises at rated torque are w_r and h_r. The winding's resistance and the torque constant don't change with temperature.

Source: I²t as in Copley Controls, CME 2 User Guide, appendix "I²T time limit algorithm"; temperature as the two thermal
resistances and time constants of motor data sheets; error codes of CiA 402-2 (IEC 61800-7-201).
"""

import math
from typing import Final

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.structured import float_fields
from firmware_sim.arm.arms import pack_fields
from firmware_sim.arm.hardware_settings import DriveSettings
from firmware_sim.arm.plant import CURRENT_LOOP_HZ
from firmware_sim.arm.touch_settings import PAIR, TICK_S

CONTINUOUS_OVER_CURRENT: Final = 0x2310
EXCESS_TEMPERATURE: Final = 0x4310
_RELEASE: Final = 0.9
"""Share of I²t's budget at which it lets go: a drive that holds its continuous current must not go to and fro."""

MOTOR_NUMBERS: Final = float_fields(
    {
        "haste": PAIR,  # way of this torque loop in a tick over that of the plant's
        "gain": PAIR,
        "torque_offset_Nm": PAIR,
        "peak_Nm": PAIR,
        "continuous_Nm": PAIR,  # Nm; 0: no I²t
        "budget_Nm2_s": PAIR,
        "winding_rise_K_Nm2": PAIR,  # K per Nm²
        "winding_share": PAIR,  # of the way to the steady rise, in a tick
        "housing_rise_K_Nm2": PAIR,
        "housing_share": PAIR,
        "ambient_C": PAIR,  # °C, as the next three
        "derating_start_C": PAIR,
        "derating_end_C": PAIR,
        "overheat_C": PAIR,
        "tracking_rad_s": PAIR,
        "can_overload": (),  # one: whether I²t is a fault
        "has_limits": (),  # one: whether I²t or temperature count
    }
)

MOTOR_STATE: Final = float_fields(
    {
        "winding_K": PAIR,  # w above, K
        "housing_K": PAIR,  # h above, K
        "effort_Nm2_s": PAIR,  # E above, Nm² s
        "is_spent": PAIR,  # whether I²t leaves the continuous current only
        "is_overheated": PAIR,
        "is_limited": PAIR,  # whether the drive wants more than it may
    }
)


def motor_numbers(settings: DriveSettings, rated_torque_Nm: tuple[float, float]) -> np.void:
    """Return both drives' loops, torque constant, current and temperature limits as one record of dtype MOTOR_NUMBERS.

    A peak torque of 0 or above rated torque becomes rated torque; a continuous torque not below the peak means no I²t.
    """
    numbers = pack_fields(settings, MOTOR_NUMBERS)
    plant_way = math.expm1(-2.0 * math.pi * CURRENT_LOOP_HZ * TICK_S)
    for joint in range(2):
        rated_Nm = rated_torque_Nm[joint]
        peak_Nm = min(settings.peak_torque_Nm[joint] or rated_Nm, rated_Nm)
        continuous_Nm = settings.continuous_torque_Nm[joint]
        if continuous_Nm >= peak_Nm:
            continuous_Nm = 0.0  # never less than all that there is
        way = math.expm1(-2.0 * math.pi * settings.current_loop_Hz[joint] * TICK_S)
        numbers["haste"][joint] = way / plant_way
        numbers["gain"][joint] = 1.0 + settings.torque_constant_error[joint]
        numbers["peak_Nm"][joint] = peak_Nm
        numbers["continuous_Nm"][joint] = continuous_Nm
        numbers["budget_Nm2_s"][joint] = (peak_Nm**2 - continuous_Nm**2) * settings.peak_time_s[joint]
        numbers["winding_rise_K_Nm2"][joint] = settings.winding_rise_K[joint] / rated_Nm**2
        numbers["winding_share"][joint] = -math.expm1(-TICK_S / settings.winding_time_s[joint])
        numbers["housing_rise_K_Nm2"][joint] = settings.housing_rise_K[joint] / rated_Nm**2
        numbers["housing_share"][joint] = -math.expm1(-TICK_S / settings.housing_time_s[joint])
        numbers["tracking_rad_s"][joint] = 2.0 * math.pi * settings.velocity_loop_Hz[joint]
    numbers["can_overload"] = 1.0 if settings.i2t_reaction == "fault" else 0.0
    heats = (*settings.winding_rise_K, *settings.housing_rise_K)
    is_warm = any(settings.preheat_K) or np.any(numbers["ambient_C"] > numbers["derating_start_C"])
    numbers["has_limits"] = 1.0 if any(settings.continuous_torque_Nm) or any(heats) or is_warm else 0.0
    return numbers


def motor_state(settings: DriveSettings) -> np.void:
    """Return the state of both motors at power-on, dtype MOTOR_STATE: cold windings, preheated housings."""
    state: np.void = np.zeros(1, MOTOR_STATE)[0]
    state["housing_K"][:] = settings.preheat_K
    return state


@compiled
def winding_temperature(numbers: np.void, state: np.void, joint: int) -> float:
    """Return the winding's temperature, °C: ambient, plus housing over ambient, plus winding over housing."""
    return float(numbers["ambient_C"][joint] + state["winding_K"][joint] + state["housing_K"][joint])


@compiled
def available_torque(numbers: np.void, state: np.void, joint: int) -> float:
    """Return the largest torque that the drive may ask for now, Nm: its peak, less by I²t and by derating."""
    limit_Nm = numbers["peak_Nm"][joint]
    if numbers["has_limits"] == 0.0:
        return float(limit_Nm)
    if state["is_spent"][joint] != 0.0:
        limit_Nm = numbers["continuous_Nm"][joint]
    start_C, end_C = numbers["derating_start_C"][joint], numbers["derating_end_C"][joint]
    left = (end_C - winding_temperature(numbers, state, joint)) / (end_C - start_C)
    return float(limit_Nm * min(max(left, 0.0), 1.0))


@compiled
def command_torque(
    numbers: np.void, state: np.void, joint: int, wanted_Nm: float, tau_Nm: float, is_powered: bool
) -> float:
    """Return the target, Nm, with which the plant's 1 kHz torque loop gives the motor's torque after this tick.

    Sets `is_limited` in the state to 1 if the drive wants more than it may, else to 0. wanted: the drive's set-point,
    within rated torque. tau: the motor's torque now. is_powered: errors of torque constant and current sensor act only
    then. The result is exact at the ends of the ticks. Within a tick a loop slower than 1 kHz is off by a hundredth of
    the way to the target at most, one of 2 kHz by a twentieth, one of 5 kHz by a quarter.
    """
    limit_Nm = available_torque(numbers, state, joint)
    target_Nm = min(max(wanted_Nm, -limit_Nm), limit_Nm)
    state["is_limited"][joint] = 1.0 if abs(wanted_Nm) > limit_Nm else 0.0
    if is_powered:
        target_Nm = numbers["gain"][joint] * (target_Nm + numbers["torque_offset_Nm"][joint])
    if numbers["haste"][joint] == 1.0:
        return float(target_Nm)
    return float(tau_Nm + (target_Nm - tau_Nm) * numbers["haste"][joint])


@compiled
def heat_motor(numbers: np.void, state: np.void, joint: int, tau_Nm: float) -> None:
    """Advance a motor's I²t and temperatures by a tick at whose end it gives `tau_Nm`, and set the flags for both.

    Call it only if `has_limits` is set in the numbers. Flags: `is_spent` and `is_overheated`.
    """
    current_Nm = tau_Nm / numbers["gain"][joint]
    square = current_Nm * current_Nm
    winding_away_K = numbers["winding_rise_K_Nm2"][joint] * square - state["winding_K"][joint]
    state["winding_K"][joint] += winding_away_K * numbers["winding_share"][joint]
    housing_away_K = numbers["housing_rise_K_Nm2"][joint] * square - state["housing_K"][joint]
    state["housing_K"][joint] += housing_away_K * numbers["housing_share"][joint]
    temperature_C = winding_temperature(numbers, state, joint)
    if temperature_C >= numbers["overheat_C"][joint]:
        state["is_overheated"][joint] = 1.0
    elif temperature_C < numbers["derating_start_C"][joint]:
        state["is_overheated"][joint] = 0.0
    continuous_Nm = numbers["continuous_Nm"][joint]
    if continuous_Nm > 0.0:
        budget = numbers["budget_Nm2_s"][joint]
        effort = state["effort_Nm2_s"][joint] + (square - continuous_Nm * continuous_Nm) * TICK_S
        state["effort_Nm2_s"][joint] = min(max(effort, 0.0), budget)
        if effort >= budget:
            state["is_spent"][joint] = 1.0
        elif effort < _RELEASE * budget:
            state["is_spent"][joint] = 0.0


def error_code(is_overheated: float, is_overloaded: float) -> int:
    """Return 0x603F of a motor: EXCESS_TEMPERATURE if overheated, else CONTINUOUS_OVER_CURRENT if overloaded, or 0.

    is_overloaded: I²t is spent, and the drive's reaction to that is a fault.
    """
    if is_overheated:
        return EXCESS_TEMPERATURE
    return CONTINUOUS_OVER_CURRENT if is_overloaded else 0
