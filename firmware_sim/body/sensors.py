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
from firmware_sim.arm.device_settings import SensorSettings
from firmware_sim.arm.joint_mechanics import REFERENCE_C
from firmware_sim.arm.scripted_contact import TICK_S
from firmware_sim.arm.sensing import torque_counts

# Places in the vector of numbers; pairs are joint 1, joint 2.
INDEX_ERROR: Final = 0  # rad
ONCE: Final = 2  # e₁, rad
ONCE_PHASE: Final = 4  # p₁, rad
TWICE: Final = 6  # e₂, rad
TWICE_PHASE: Final = 8  # p₂, rad
ENCODER_LSB: Final = 10  # rad
ENCODER_NUMBERS: Final = 12

NOISE_TICKS: Final = 64
"""Ticks whose noise is drawn at once, in a few µs; a call that advances the arm by more is divided."""


def encoder_numbers(settings: SensorSettings) -> Vector:
    """Pack the encoders' properties for compiled functions (ENCODER_NUMBERS,)."""
    numbers = np.zeros(ENCODER_NUMBERS)
    numbers[INDEX_ERROR : INDEX_ERROR + 2] = settings.index_error_rad
    numbers[ONCE : ONCE + 2] = settings.eccentricity_rad
    numbers[ONCE_PHASE : ONCE_PHASE + 2] = settings.eccentricity_phase_rad
    numbers[TWICE : TWICE + 2] = settings.ellipticity_rad
    numbers[TWICE_PHASE : TWICE_PHASE + 2] = settings.ellipticity_phase_rad
    numbers[ENCODER_LSB : ENCODER_LSB + 2] = [2.0 * math.pi / (1 << bits) for bits in settings.encoder_bits]
    return numbers


@compiled
def read_angle(numbers: Vector, joint: int, angle_rad: float, noise_counts: float) -> float:
    """Give the angle that the drive reads, rad."""
    disc_rad = angle_rad + numbers[INDEX_ERROR + joint]
    if numbers[ONCE + joint] != 0.0:
        disc_rad += numbers[ONCE + joint] * math.sin(angle_rad + numbers[ONCE_PHASE + joint])
    if numbers[TWICE + joint] != 0.0:
        disc_rad += numbers[TWICE + joint] * math.sin(2.0 * angle_rad + numbers[TWICE_PHASE + joint])
    lsb_rad = numbers[ENCODER_LSB + joint]
    return float(math.floor(disc_rad / lsb_rad + noise_counts + 0.5) * lsb_rad)


class EncoderNoise:
    """The noise of both encoders at every tick, so that a run doesn't depend on how its ticks were asked for."""

    def __init__(self, seed: np.random.SeedSequence, rms_counts: tuple[float, float]) -> None:
        self.is_on = any(rms_counts)
        self.table = np.zeros((2 * NOISE_TICKS, 2))
        """Row `tick % (2 · NOISE_TICKS)`: noise of that tick, counts. Zero when it is off."""
        self._generator = np.random.default_rng(seed)
        self._rms_counts = np.array(rms_counts)
        self._drawn = 0  # ticks

    def draw(self, last_tick: int) -> None:
        """Provide the ticks up to `last_tick`, at most NOISE_TICKS after the one before them."""
        while self._drawn <= last_tick:
            first = self._drawn % (2 * NOISE_TICKS)
            rows = self.table[first : first + NOISE_TICKS]
            self._generator.standard_normal(out=rows)
            rows *= self._rms_counts
            self._drawn += NOISE_TICKS


STOPS: Final = 4
"""Stop operators per sensor: each branch of the loop has as many bends after a reversal."""

# Places in the vector of numbers; pairs are joint 1, joint 2.
GAIN: Final = 0
GAIN_DRIFT: Final = 2  # 1/K
CROSS_TALK: Final = 4
OFFSET: Final = 6  # Nm
OFFSET_RAMP: Final = 8  # Nm/s
OFFSET_DRIFT: Final = 10  # Nm/K
LOOP_WEIGHT: Final = 12  # w above
LOOP_RADIUS: Final = 14  # r above, Nm
BANDWIDTH: Final = 16  # rad/s; 0: no filter
RATE: Final = 18  # Hz of the own clock, error included; 0: at SYNC
PHASE: Final = 20  # sample periods
LSB: Final = 22  # of the converter, Nm
HIGHEST: Final = 24  # code of the converter; the lowest is −1 − HIGHEST
HAS_MEMORY: Final = 26  # whether what happens within a tick matters: hysteresis, filter, own clock
TRANSDUCER_NUMBERS: Final = 27

# Places in the state; pairs are joint 1, joint 2.
BRIDGE: Final = 0  # x above at the last tick, Nm
SHAPED: Final = 2  # y above
AMPLIFIED: Final = 4  # z above
INDEX: Final = 6  # n of the latest sample of the own clock
HELD: Final = 8  # that sample, Nm
SENT_INDEX: Final = 10  # n of the sample in the last frame
SENT: Final = 12  # its counts
WALK: Final = 14  # Nm
WALK_TICK: Final = 16  # tick of the walk's last step
STOP: Final = 17  # e above: 4 of joint 1, 4 of joint 2, Nm
TRANSDUCER_STATE: Final = STOP + 2 * STOPS


def transducer_numbers(settings: SensorSettings, offset_Nm: tuple[float, float]) -> Vector:
    """Pack the sensors' properties for compiled functions (TRANSDUCER_NUMBERS,)."""
    numbers = np.zeros(TRANSDUCER_NUMBERS)
    reach_Nm = np.array(settings.hysteresis_reach_Nm)
    numbers[GAIN : GAIN + 2] = 1.0 + np.array(settings.gain_error)
    numbers[GAIN_DRIFT : GAIN_DRIFT + 2] = settings.gain_drift_1_K
    numbers[CROSS_TALK : CROSS_TALK + 2] = settings.cross_talk
    numbers[OFFSET : OFFSET + 2] = offset_Nm
    numbers[OFFSET_RAMP : OFFSET_RAMP + 2] = settings.offset_drift_Nm_s
    numbers[OFFSET_DRIFT : OFFSET_DRIFT + 2] = settings.offset_drift_Nm_K
    numbers[LOOP_WEIGHT : LOOP_WEIGHT + 2] = np.array(settings.hysteresis_Nm) / (2.5 * reach_Nm)
    numbers[LOOP_RADIUS : LOOP_RADIUS + 2] = 0.5 * reach_Nm
    numbers[BANDWIDTH : BANDWIDTH + 2] = 2.0 * math.pi * np.array(settings.torque_bandwidth_Hz)
    numbers[RATE : RATE + 2] = np.array(settings.sample_rate_Hz) * (1.0 + 1e-6 * np.array(settings.clock_error_ppm))
    numbers[PHASE : PHASE + 2] = settings.clock_phase
    numbers[LSB : LSB + 2] = 2.0 * np.array(settings.torque_range_Nm) / 2.0 ** np.array(settings.torque_bits)
    numbers[HIGHEST : HIGHEST + 2] = 2.0 ** (np.array(settings.torque_bits) - 1.0) - 1.0
    memory = (*settings.hysteresis_Nm, *settings.torque_bandwidth_Hz, *settings.sample_rate_Hz)
    numbers[HAS_MEMORY] = 1.0 if any(memory) else 0.0
    return numbers


def converter_ends(settings: SensorSettings, joint: int) -> tuple[int, int]:
    """Give the lowest and the highest value that a sensor can send, in counts of the wire."""
    numbers = transducer_numbers(settings, (0.0, 0.0))
    return _convert(numbers, joint, -1e6), _convert(numbers, joint, 1e6)


@compiled
def _convert(numbers: Vector, joint: int, torque_Nm: float) -> int:
    """Convert as the sensor's converter does, then to counts of the wire; saturates."""
    lsb_Nm = numbers[LSB + joint]
    highest = numbers[HIGHEST + joint]
    code = min(max(math.floor(torque_Nm / lsb_Nm + 0.5), -1.0 - highest), highest)
    return torque_counts(code * lsb_Nm)


@compiled
def _bridge(numbers: Vector, joint: int, tau_Nm: float, other_Nm: float, temperature_C: float) -> float:
    """Give x above, Nm."""
    gain = numbers[GAIN + joint] + numbers[GAIN_DRIFT + joint] * (temperature_C - REFERENCE_C)
    return float(gain * tau_Nm + numbers[CROSS_TALK + joint] * other_Nm)


@compiled
def settle_transducer(
    numbers: Vector, state: Vector, tau1_Nm: float, tau2_Nm: float, temperature1_C: float, temperature2_C: float
) -> None:
    """Power on under a steady load: the amplifier has settled, and the spring has no memory yet."""
    state[:] = 0.0
    state[BRIDGE] = _bridge(numbers, 0, tau1_Nm, tau2_Nm, temperature1_C)
    state[BRIDGE + 1] = _bridge(numbers, 1, tau2_Nm, tau1_Nm, temperature2_C)
    for joint in range(2):
        state[SHAPED + joint] = state[BRIDGE + joint]
        state[AMPLIFIED + joint] = state[BRIDGE + joint]
        state[HELD + joint] = state[BRIDGE + joint]
        state[INDEX + joint] = math.floor(-numbers[PHASE + joint])
        state[SENT_INDEX + joint] = state[INDEX + joint] - 1.0


@compiled
def _sense_joint(numbers: Vector, state: Vector, joint: int, tick: float, bridge_Nm: float) -> None:
    """Carry one sensor over the tick that began at `tick` and ended with `bridge_Nm`."""
    shaped_Nm = bridge_Nm
    weight = numbers[LOOP_WEIGHT + joint]
    if weight > 0.0:
        change_Nm = bridge_Nm - state[BRIDGE + joint]
        for k in range(STOPS):
            radius_Nm = numbers[LOOP_RADIUS + joint] * (k + 1) / STOPS
            place = STOP + STOPS * joint + k
            state[place] = min(max(state[place] + change_Nm, -radius_Nm), radius_Nm)
            shaped_Nm -= weight * state[place]
    before_Nm = state[AMPLIFIED + joint]
    amplified_Nm = shaped_Nm
    if numbers[BANDWIDTH + joint] > 0.0:
        turn = numbers[BANDWIDTH + joint] * TICK_S
        lag_Nm = (shaped_Nm - state[SHAPED + joint]) / turn  # behind a ramp
        amplified_Nm = shaped_Nm - lag_Nm + (before_Nm - state[SHAPED + joint] + lag_Nm) * math.exp(-turn)
    rate_Hz = numbers[RATE + joint]
    if rate_Hz > 0.0:
        index = math.floor((tick + 1.0) * TICK_S * rate_Hz - numbers[PHASE + joint])
        if index > state[INDEX + joint]:
            share = (index + numbers[PHASE + joint]) / (rate_Hz * TICK_S) - tick  # of the tick, when it was sampled
            share = min(max(share, 0.0), 1.0)
            state[INDEX + joint] = index
            state[HELD + joint] = before_Nm + share * (amplified_Nm - before_Nm)
    state[BRIDGE + joint] = bridge_Nm
    state[SHAPED + joint] = shaped_Nm
    state[AMPLIFIED + joint] = amplified_Nm


@compiled
def sense_torque(
    numbers: Vector,
    state: Vector,
    tick: float,
    tau1_Nm: float,
    tau2_Nm: float,
    temperature1_C: float,
    temperature2_C: float,
) -> None:
    """Carry both sensors over the tick that began at `tick`; the rest is how it ended. Only if HAS_MEMORY."""
    _sense_joint(numbers, state, 0, tick, _bridge(numbers, 0, tau1_Nm, tau2_Nm, temperature1_C))
    _sense_joint(numbers, state, 1, tick, _bridge(numbers, 1, tau2_Nm, tau1_Nm, temperature2_C))


@compiled
def walk_offset(state: Vector, tick: float, step_Nm: Vector) -> None:
    """Let the zeros walk up to `tick`. step_Nm (2,): normal numbers times the walk's rms after one second."""
    root_s = math.sqrt((tick - state[WALK_TICK]) * TICK_S)
    state[WALK] += step_Nm[0] * root_s
    state[WALK + 1] += step_Nm[1] * root_s
    state[WALK_TICK] = tick


@compiled
def sample_torque(
    numbers: Vector,
    state: Vector,
    joint: int,
    tick: float,
    tau_Nm: float,
    other_Nm: float,
    temperature_C: float,
    noise_Nm: float,
) -> int:
    """Give the counts that the sensor of a joint sends at the SYNC at `tick`.

    tau, other: torque in the spring of this joint and of the other one, now.
    """
    if numbers[HAS_MEMORY] == 0.0:
        torque_Nm = _bridge(numbers, joint, tau_Nm, other_Nm, temperature_C)
    elif numbers[RATE + joint] == 0.0:
        torque_Nm = state[AMPLIFIED + joint]
    else:
        if state[INDEX + joint] == state[SENT_INDEX + joint]:
            return int(state[SENT + joint])
        state[SENT_INDEX + joint] = state[INDEX + joint]
        torque_Nm = state[HELD + joint]
    offset_Nm = numbers[OFFSET + joint] + numbers[OFFSET_RAMP + joint] * (tick * TICK_S) + state[WALK + joint]
    offset_Nm += numbers[OFFSET_DRIFT + joint] * (temperature_C - REFERENCE_C)
    counts = _convert(numbers, joint, torque_Nm + offset_Nm + noise_Nm)
    state[SENT + joint] = counts
    return counts
