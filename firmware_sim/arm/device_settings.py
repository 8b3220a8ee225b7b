"""Errors and limits of drives, torque sensors and encoders: sections `[drives]` and `[sensors]` of a scenario.

Pairs are (joint 1, joint 2). The defaults are a drive that gives its rated torque for ever, with a torque loop of 1
kHz; a linear 16-bit torque sensor of ±50 Nm with 0.02 Nm of noise that samples at SYNC; a perfect 20-bit encoder. A
drive's torques are at the joint and stand for the motor's current times its nominal torque constant. The equations are
in `firmware_sim.body.motor` and `firmware_sim.body.sensors`.
"""

from dataclasses import dataclass

from adacd_hil.settings.schema import ConfigError, setting
from firmware_sim.arm.sensing import TORQUE_NOISE_NM, TORQUE_RANGE_NM

Pair = tuple[float, float]
CURRENT_LOOP_HZ = 1000.0
VELOCITY_LOOP_HZ = 200.0


@dataclass(frozen=True)
class DriveSettings:
    """What the drives get wrong and how long they bear it."""

    current_loop_Hz: Pair = setting(
        (CURRENT_LOOP_HZ, CURRENT_LOOP_HZ), unit="Hz", low=1.0, high=5e3, meaning="-3 dB of the torque loop"
    )
    velocity_loop_Hz: Pair = setting(
        (VELOCITY_LOOP_HZ, VELOCITY_LOOP_HZ),
        unit="Hz",
        low=1.0,
        high=5e3,
        meaning="natural frequency of the tracking loop",
    )
    torque_constant_error: Pair = setting(
        (0.0, 0.0), low=-0.5, high=0.5, meaning="delivered torque over the one that the drive believes, less one"
    )
    torque_offset_Nm: Pair = setting(
        (0.0, 0.0),
        unit="Nm",
        low=-10.0,
        high=10.0,
        meaning="zero error of the current sensor while the motor is powered",
    )
    peak_torque_Nm: Pair = setting(
        (0.0, 0.0), unit="Nm", low=0.0, high=1000.0, meaning="peak current; 0, or more than rated torque: rated torque"
    )
    continuous_torque_Nm: Pair = setting(
        (0.0, 0.0), unit="Nm", low=0.0, high=1000.0, meaning="current that I²t allows for ever; 0: no I²t"
    )
    peak_time_s: Pair = setting(
        (1.0, 1.0), unit="s", low=1e-3, high=1e4, meaning="how long I²t allows the peak current from rest"
    )
    i2t_reaction: str = setting(
        "limit", choices=("limit", "fault"), meaning="down to the continuous current, or 0x2310"
    )
    winding_rise_K: Pair = setting(
        (0.0, 0.0), unit="K", low=0.0, high=1000.0, meaning="winding over housing at rated torque, for ever; 0: none"
    )
    winding_time_s: Pair = setting((30.0, 30.0), unit="s", low=1e-2, high=1e5, meaning="its time constant")
    housing_rise_K: Pair = setting(
        (0.0, 0.0), unit="K", low=0.0, high=1000.0, meaning="housing over ambient at rated torque, for ever; 0: none"
    )
    housing_time_s: Pair = setting((900.0, 900.0), unit="s", low=1e-2, high=1e5, meaning="its time constant")
    ambient_C: Pair = setting((25.0, 25.0), unit="°C", low=-40.0, high=100.0, meaning="temperature around the motor")
    preheat_K: Pair = setting((0.0, 0.0), unit="K", low=0.0, high=300.0, meaning="housing over ambient at power-on")
    derating_start_C: Pair = setting(
        (110.0, 110.0), unit="°C", low=0.0, high=300.0, meaning="winding from which the torque falls; a fault's reset"
    )
    derating_end_C: Pair = setting((140.0, 140.0), unit="°C", low=0.0, high=300.0, meaning="where it is zero")
    overheat_C: Pair = setting(
        (130.0, 130.0), unit="°C", low=0.0, high=400.0, meaning="winding that is a fault, 0x4310"
    )

    def __post_init__(self) -> None:
        for joint in range(2):
            start_C = self.derating_start_C[joint]
            for name in ("derating_end_C", "overheat_C"):
                value_C = getattr(self, name)[joint]
                if value_C <= start_C:
                    raise ConfigError(
                        f"`drives.{name}[{joint}]` = {value_C} °C is not above `derating_start_C` = {start_C} °C"
                    )
            peak_Nm, continuous_Nm = self.peak_torque_Nm[joint], self.continuous_torque_Nm[joint]
            if peak_Nm > 0.0 and continuous_Nm >= peak_Nm:
                raise ConfigError(
                    f"`drives.continuous_torque_Nm[{joint}]` = {continuous_Nm} Nm is not below "
                    f"`peak_torque_Nm` = {peak_Nm} Nm"
                )


_STEEPEST_LOOP = 0.5
"""Hysteresis width over reach: keeps a fifth of the sensitivity right after a reversal."""


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
        high=10_000.0,
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
