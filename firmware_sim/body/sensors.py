"""Imperfect sensors of a joint: the encoder, and the torque sensor from the torque in its spring to its counts.

Encoder. Of the true angle θ, rad:

    disc     φ = θ + index error + e₁ sin(θ + p₁) + e₂ sin(2θ + p₂)
    reading  φ plus noise, rounded to 2^bits counts per revolution

e₁ is the eccentricity of the disc over its radius, e₂ that of an elliptic or tilted disc. The drive's velocity
follows from the reading, and the wire carries it in its own counts of 2^20 per revolution: a coarser encoder steps.

Torque sensor. Of joint i with the torque τᵢ in its spring, the other joint's τⱼ, and ΔT = joint temperature − 25 °C:

    bridge      x = (1 + gain error + gain drift · ΔT) τᵢ + cross-talk · τⱼ
    hysteresis  y = x − w Σₖ eₖ, eₖ the stop operators of half-widths rₖ = k r / 4, k = 1 … 4
    amplifier   ż = ω (y − z), ω = 2π · bandwidth
    sample      z, at SYNC or at the latest instant (n + phase) / (rate · (1 + ppm · 1e-6)) of the sensor's own clock
    converter   sample + offset + drift · t + walk + offset drift · ΔT + noise, rounded to its bits, held at its ends

A stop operator follows its input's changes, e ← clip(e + Δx, −r, r): a Prandtl-Ishlinskii model, independent of rate,
with return-point memory. w = width / 5r makes the branches lie half a width to both sides of x; 2r is the reach.

The amplifier takes y between ticks as a straight line, and so does the own clock with z, so a sample lies where it
belongs within the tick. While the own clock has no new sample the frame repeats the last one, noise included.

Source: P. Krejčí, "Hysteresis, convexity and dissipation in hyperbolic equations", 1996 (stop operators).
"""

import math
from typing import Final

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import Vector
from adacd_hil.structured import float_fields
from firmware_sim.arm.arms import pack_fields
from firmware_sim.arm.hardware_settings import SensorSettings
from firmware_sim.arm.joint_forces import REFERENCE_C
from firmware_sim.arm.sensing import TORQUE_LSB_NM, TORQUE_RANGE_NM, torque_counts
from firmware_sim.arm.touch_settings import PAIR, TICK_S

ENCODER_NUMBERS: Final = float_fields(
    {
        "index_error_rad": PAIR,
        "eccentricity_rad": PAIR,  # e₁, rad
        "eccentricity_phase_rad": PAIR,  # p₁, rad
        "ellipticity_rad": PAIR,  # e₂, rad
        "ellipticity_phase_rad": PAIR,  # p₂, rad
        "lsb_rad": PAIR,
    }
)

NOISE_TICKS: Final = 64
"""Ticks whose noise is drawn at once, in a few µs; a call that advances the arm by more is divided."""


def encoder_numbers(settings: SensorSettings) -> np.void:
    """Return both encoders' errors and resolution as one record of dtype ENCODER_NUMBERS, for compiled functions."""
    numbers = pack_fields(settings, ENCODER_NUMBERS)
    numbers["lsb_rad"][:] = [2.0 * math.pi / (1 << bits) for bits in settings.encoder_bits]
    return numbers


@compiled
def read_angle(numbers: np.void, joint: int, angle_rad: float, noise_counts: float) -> float:
    """Return the angle that an encoder measures at a true angle, rad: with its disc's errors, in whole encoder counts.

    noise_counts is added before rounding.
    """
    disc_rad = angle_rad + numbers["index_error_rad"][joint]
    if numbers["eccentricity_rad"][joint] != 0.0:
        disc_rad += numbers["eccentricity_rad"][joint] * math.sin(angle_rad + numbers["eccentricity_phase_rad"][joint])
    if numbers["ellipticity_rad"][joint] != 0.0:
        disc_rad += numbers["ellipticity_rad"][joint] * math.sin(
            2.0 * angle_rad + numbers["ellipticity_phase_rad"][joint]
        )
    lsb_rad = numbers["lsb_rad"][joint]
    return float(math.floor(disc_rad / lsb_rad + noise_counts + 0.5) * lsb_rad)


class EncoderNoise:
    """The noise of both encoders at every tick. It is the same however many ticks each call advances."""

    def __init__(self, seed: np.random.SeedSequence, rms_counts: tuple[float, float]) -> None:
        self.is_on = any(rms_counts)
        self.table = np.zeros((2 * NOISE_TICKS, 2))
        """Row `tick % (2 · NOISE_TICKS)`: noise of that tick, counts. Zero when it is off."""
        self._generator = np.random.default_rng(seed)
        self._rms_counts = np.array(rms_counts)
        self._drawn = 0  # ticks

    def draw(self, last_tick: int) -> None:
        """Fill `table` with the noise of the ticks up to `last_tick`; draws NOISE_TICKS ticks at once, and none twice.

        Call it every NOISE_TICKS ticks at least: the table keeps the noise of twice as many.
        """
        while self._drawn <= last_tick:
            first = self._drawn % (2 * NOISE_TICKS)
            rows = self.table[first : first + NOISE_TICKS]
            self._generator.standard_normal(out=rows)
            rows *= self._rms_counts
            self._drawn += NOISE_TICKS


STOPS: Final = 4
"""Stop operators per sensor: each branch of the loop has as many bends after a reversal."""

TRANSDUCER_NUMBERS: Final = float_fields(
    {
        "gain": PAIR,
        "gain_drift_1_K": PAIR,
        "cross_talk": PAIR,
        "offset_Nm": PAIR,
        "offset_drift_Nm_s": PAIR,  # Nm/s
        "offset_drift_Nm_K": PAIR,  # Nm/K
        "loop_weight": PAIR,  # w above
        "loop_radius_Nm": PAIR,  # r above, Nm
        "bandwidth_rad_s": PAIR,  # rad/s; 0: no filter
        "rate_Hz": PAIR,  # Hz of the own clock, error included; 0: at SYNC
        "clock_phase": PAIR,  # sample periods
        "lsb_Nm": PAIR,  # of the converter, Nm
        "count_Nm": PAIR,  # of the wire, Nm
        "highest": PAIR,  # code of the converter; the lowest is −1 − highest
        "has_memory": (),  # whether the course within a tick matters: hysteresis, filter, own clock
    }
)

TRANSDUCER_STATE: Final = float_fields(
    {
        "bridge_Nm": PAIR,  # x above at the last tick, Nm
        "shaped_Nm": PAIR,  # y above
        "amplified_Nm": PAIR,  # z above
        "index": PAIR,  # n of the latest sample of the own clock
        "held_Nm": PAIR,  # that sample, Nm
        "sent_index": PAIR,  # n of the sample in the last frame
        "sent": PAIR,  # its counts
        "walk_Nm": PAIR,
        "walk_tick": (),  # tick of the walk's last step
        "stop_Nm": (2, STOPS),  # e above
    }
)


def transducer_numbers(settings: SensorSettings, offset_Nm: tuple[float, float]) -> np.void:
    """Return both torque sensors' properties as one record of dtype TRANSDUCER_NUMBERS, for compiled functions.

    offset_Nm: their constant zero errors.
    """
    numbers = pack_fields(settings, TRANSDUCER_NUMBERS)
    reach_Nm = np.array(settings.hysteresis_reach_Nm)
    numbers["gain"][:] = 1.0 + np.array(settings.gain_error)
    numbers["offset_Nm"][:] = offset_Nm
    numbers["loop_weight"][:] = np.array(settings.hysteresis_Nm) / (2.5 * reach_Nm)
    numbers["loop_radius_Nm"][:] = 0.5 * reach_Nm
    numbers["bandwidth_rad_s"][:] = 2.0 * math.pi * np.array(settings.torque_bandwidth_Hz)
    numbers["rate_Hz"][:] = np.array(settings.sample_rate_Hz) * (1.0 + 1e-6 * np.array(settings.clock_error_ppm))
    numbers["lsb_Nm"][:] = 2.0 * np.array(settings.torque_range_Nm) / 2.0 ** np.array(settings.torque_bits)
    numbers["count_Nm"][:] = [count_Nm(settings, joint) for joint in range(2)]
    numbers["highest"][:] = 2.0 ** (np.array(settings.torque_bits) - 1.0) - 1.0
    memory = (*settings.hysteresis_Nm, *settings.torque_bandwidth_Hz, *settings.sample_rate_Hz)
    numbers["has_memory"] = 1.0 if any(memory) else 0.0
    return numbers


def transducer_state(numbers: np.void) -> np.void:
    """Return both sensors' state at power-on, without a load, as one record of dtype TRANSDUCER_STATE.

    Hysteresis begins at its middle. numbers: of `transducer_numbers`.
    """
    state: np.void = np.zeros(1, TRANSDUCER_STATE)[0]
    state["index"] = np.floor(-numbers["clock_phase"])
    state["sent_index"] = state["index"] - 1.0
    return state


def count_Nm(settings: SensorSettings, joint: int) -> float:
    """Return the torque of one count on the wire, Nm: 1/2^16 of ±50 Nm, or of the sensor's range if that is wider."""
    return TORQUE_LSB_NM * max(1.0, settings.torque_range_Nm[joint] / TORQUE_RANGE_NM)


def converter_ends(settings: SensorSettings, joint: int) -> tuple[int, int]:
    """Return the lowest and the highest counts on the wire that a joint's sensor can send; they mean saturation."""
    numbers = transducer_numbers(settings, (0.0, 0.0))
    return _convert(numbers, joint, -1e6), _convert(numbers, joint, 1e6)


@compiled
def _convert(numbers: np.void, joint: int, torque_Nm: float) -> int:
    """Return a torque in counts of the wire, after rounding to the converter's bits and limiting to its range."""
    lsb_Nm = numbers["lsb_Nm"][joint]
    highest = numbers["highest"][joint]
    code = min(max(math.floor(torque_Nm / lsb_Nm + 0.5), -1.0 - highest), highest)
    return torque_counts(code * lsb_Nm, numbers["count_Nm"][joint])


@compiled
def _bridge(numbers: np.void, joint: int, tau_Nm: float, other_Nm: float, temperature_C: float) -> float:
    """Return the torque that a sensor's bridge senses, Nm: with gain error, drift by temperature, and cross-talk.

    other_Nm: torque in the spring of the other joint.
    """
    gain = numbers["gain"][joint] + numbers["gain_drift_1_K"][joint] * (temperature_C - REFERENCE_C)
    return float(gain * tau_Nm + numbers["cross_talk"][joint] * other_Nm)


@compiled
def sense_torque(
    numbers: np.void, state: np.void, joint: int, tick: float, tau_Nm: float, other_Nm: float, temperature_C: float
) -> None:
    """Advance one sensor's `state` by the tick that began at `tick`: hysteresis, amplifier, sample of its own clock.

    Call it only if `has_memory` is set. tau, other: torque in the spring of this joint and of the other one; both and
    the joint's temperature are at the end of the tick.
    """
    bridge_Nm = _bridge(numbers, joint, tau_Nm, other_Nm, temperature_C)
    shaped_Nm = bridge_Nm
    weight = numbers["loop_weight"][joint]
    if weight > 0.0:
        change_Nm = bridge_Nm - state["bridge_Nm"][joint]
        for k in range(STOPS):
            radius_Nm = numbers["loop_radius_Nm"][joint] * (k + 1) / STOPS
            stop_Nm = min(max(state["stop_Nm"][joint, k] + change_Nm, -radius_Nm), radius_Nm)
            state["stop_Nm"][joint, k] = stop_Nm
            shaped_Nm -= weight * stop_Nm
    before_Nm = state["amplified_Nm"][joint]
    amplified_Nm = shaped_Nm
    if numbers["bandwidth_rad_s"][joint] > 0.0:
        turn = numbers["bandwidth_rad_s"][joint] * TICK_S
        lag_Nm = (shaped_Nm - state["shaped_Nm"][joint]) / turn  # behind a ramp
        amplified_Nm = shaped_Nm - lag_Nm + (before_Nm - state["shaped_Nm"][joint] + lag_Nm) * math.exp(-turn)
    rate_Hz = numbers["rate_Hz"][joint]
    if rate_Hz > 0.0:
        index = math.floor((tick + 1.0) * TICK_S * rate_Hz - numbers["clock_phase"][joint])
        if index > state["index"][joint]:
            share = (index + numbers["clock_phase"][joint]) / (
                rate_Hz * TICK_S
            ) - tick  # of the tick, when it was sampled
            share = min(max(share, 0.0), 1.0)
            state["index"][joint] = index
            state["held_Nm"][joint] = before_Nm + share * (amplified_Nm - before_Nm)
    state["bridge_Nm"][joint] = bridge_Nm
    state["shaped_Nm"][joint] = shaped_Nm
    state["amplified_Nm"][joint] = amplified_Nm


@compiled
def walk_offset(state: np.void, tick: float, step_Nm: Vector) -> None:
    """Add a random step to the wandering zeros of both sensors, scaled by the root of the time since the last step.

    step_Nm (2,): normal numbers times the walk's rms after one second. Stores `tick` as the time of this step.
    """
    root_s = math.sqrt((tick - state["walk_tick"]) * TICK_S)
    state["walk_Nm"][0] += step_Nm[0] * root_s
    state["walk_Nm"][1] += step_Nm[1] * root_s
    state["walk_tick"] = tick


@compiled
def sample_torque(
    numbers: np.void,
    state: np.void,
    joint: int,
    tick: float,
    tau_Nm: float,
    other_Nm: float,
    temperature_C: float,
    noise_Nm: float,
) -> int:
    """Return the counts that the sensor of a joint sends at the SYNC at `tick`, and store them.

    To the sensed torque it adds zero error, drift, walk and `noise_Nm`; the sum is rounded to the converter's bits and
    limited to its range. A sensor with its own clock repeats the last counts until that clock has a new sample. tau,
    other: torque in the spring of this joint and of the other one, now; a sensor with memory uses those of
    `sense_torque`.
    """
    if numbers["has_memory"] == 0.0:
        torque_Nm = _bridge(numbers, joint, tau_Nm, other_Nm, temperature_C)
    elif numbers["rate_Hz"][joint] == 0.0:
        torque_Nm = state["amplified_Nm"][joint]
    else:
        if state["index"][joint] == state["sent_index"][joint]:
            return int(state["sent"][joint])
        state["sent_index"][joint] = state["index"][joint]
        torque_Nm = state["held_Nm"][joint]
    offset_Nm = (
        numbers["offset_Nm"][joint] + numbers["offset_drift_Nm_s"][joint] * (tick * TICK_S) + state["walk_Nm"][joint]
    )
    offset_Nm += numbers["offset_drift_Nm_K"][joint] * (temperature_C - REFERENCE_C)
    counts = _convert(numbers, joint, torque_Nm + offset_Nm + noise_Nm)
    state["sent"][joint] = counts
    return counts
