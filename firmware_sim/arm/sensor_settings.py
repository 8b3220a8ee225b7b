"""Errors of the torque sensors and encoders, section `[sensors]` of a scenario; pairs are (joint 1, joint 2).

The defaults are a linear 16-bit sensor of ±50 Nm with 0.02 Nm of noise that samples at SYNC, and a perfect 20-bit
encoder. The equations are in `firmware_sim.body.torque_transducer` and `firmware_sim.body.encoder`.
"""

from dataclasses import dataclass

from adacd_hil.settings.schema import ConfigError, setting
from firmware_sim.arm.sensing import TORQUE_NOISE_NM, TORQUE_RANGE_NM

_STEEPEST_LOOP = 0.5
"""Hysteresis width over reach: keeps a fifth of the sensitivity right after a reversal."""

Pair = tuple[float, float]


@dataclass(frozen=True)
class SensorSettings:
    """What the torque sensors and the encoders get wrong."""

    offset_drift_Nm_s: Pair = setting(
        (0.0, 0.0), unit="Nm/s", low=-10.0, high=10.0, meaning="steady drift of the torque zero since power-on"
    )
    offset_walk_Nm_rs: Pair = setting(
        (0.0, 0.0), unit="Nm/√s", low=0.0, high=10.0, meaning="random walk of the torque zero, rms after one second"
    )
    offset_drift_Nm_K: Pair = setting(
        (0.0, 0.0), unit="Nm/K", low=-1.0, high=1.0, meaning="drift of the torque zero with the joint's temperature"
    )
    gain_error: Pair = setting(
        (0.0, 0.0), low=-0.9, high=1.0, meaning="relative error of the torque sensor's sensitivity"
    )
    gain_drift_1_K: Pair = setting(
        (0.0, 0.0), unit="1/K", low=-0.01, high=0.01, meaning="its drift with the joint's temperature, from 25 °C"
    )
    cross_talk: Pair = setting(
        (0.0, 0.0), low=-0.5, high=0.5, meaning="share of the other joint's torque that this joint's sensor sees"
    )
    hysteresis_Nm: Pair = setting(
        (0.0, 0.0), unit="Nm", low=0.0, high=10.0, meaning="between the falling and the rising branch; 0: none"
    )
    hysteresis_reach_Nm: Pair = setting(
        (10.0, 10.0), unit="Nm", low=0.01, high=100.0, meaning="way from one branch to the other after a reversal"
    )
    torque_bandwidth_Hz: Pair = setting(
        (0.0, 0.0), unit="Hz", low=0.0, high=1e5, meaning="-3 dB of the amplifier's first-order low-pass; 0: none"
    )
    torque_noise_Nm: Pair = setting(
        (TORQUE_NOISE_NM, TORQUE_NOISE_NM), unit="Nm", low=0.0, high=10.0, meaning="white noise of a sample, rms"
    )
    torque_range_Nm: Pair = setting(
        (TORQUE_RANGE_NM, TORQUE_RANGE_NM),
        unit="Nm",
        low=0.1,
        high=TORQUE_RANGE_NM,
        meaning="the converter saturates beyond it",
    )
    torque_bits: tuple[int, int] = setting((16, 16), low=4, high=24, meaning="of the converter, over its whole range")
    sample_rate_Hz: Pair = setting(
        (0.0, 0.0), unit="Hz", low=0.0, high=1e5, meaning="of the torque sensor's own clock; 0: it samples at SYNC"
    )
    clock_error_ppm: Pair = setting(
        (0.0, 0.0), unit="ppm", low=-1e4, high=1e4, meaning="how much the sensor's own clock is fast"
    )
    clock_phase: Pair = setting(
        (0.0, 0.0), low=0.0, high=1.0, meaning="when it first samples after power-on, in sample periods"
    )
    encoder_bits: tuple[int, int] = setting((20, 20), low=8, high=24, meaning="encoder counts per revolution, log2")
    encoder_noise_counts: Pair = setting(
        (0.0, 0.0), low=0.0, high=1000.0, meaning="white noise of the angle, rms, in the encoder's own counts"
    )
    index_error_rad: Pair = setting(
        (0.0, 0.0), unit="rad", low=-4.0, high=4.0, meaning="error of the encoder's zero since power-on"
    )
    eccentricity_rad: Pair = setting(
        (0.0, 0.0), unit="rad", low=0.0, high=0.1, meaning="amplitude of the error once per revolution"
    )
    eccentricity_phase_rad: Pair = setting(
        (0.0, 0.0), unit="rad", low=-7.0, high=7.0, meaning="its phase at the true zero"
    )
    ellipticity_rad: Pair = setting(
        (0.0, 0.0), unit="rad", low=0.0, high=0.1, meaning="amplitude of the error twice per revolution"
    )
    ellipticity_phase_rad: Pair = setting(
        (0.0, 0.0), unit="rad", low=-7.0, high=7.0, meaning="its phase at the true zero"
    )

    def __post_init__(self) -> None:
        for joint in range(2):
            width_Nm, reach_Nm = self.hysteresis_Nm[joint], self.hysteresis_reach_Nm[joint]
            if width_Nm > _STEEPEST_LOOP * reach_Nm:
                raise ConfigError(
                    f"`sensors.hysteresis_Nm[{joint}]` = {width_Nm} Nm is above half of its reach, "
                    f"{_STEEPEST_LOOP * reach_Nm:g} Nm"
                )
            needs_clock = self.clock_error_ppm[joint] != 0.0 or self.clock_phase[joint] != 0.0
            if needs_clock and self.sample_rate_Hz[joint] == 0.0:
                raise ConfigError(
                    f"`sensors.sample_rate_Hz[{joint}]` = 0.0 Hz leaves `clock_error_ppm` and `clock_phase` no clock"
                )
