"""Sections `[mechanics]`, `[drives]` and `[sensors]` of a scenario: properties of arm and devices beyond ideal ones.

Pairs are (joint 1, joint 2).

**Mechanics**: beyond rigid links with viscous and Coulomb friction. Everything is off by default: the arm is
rigid then. Equations: `firmware_sim.arm.joint_forces`, `firmware_sim.arm.mechanics`.

**Devices**: errors and limits of drives, torque sensors and encoders. The defaults are a drive that gives its rated
torque for ever, with a torque loop of 1 kHz; a linear 16-bit torque sensor of ±50 Nm with 0.02 Nm of noise that
samples at SYNC; a perfect 20-bit encoder. A drive's torques are at the joint and stand for the motor's current times
its nominal torque constant. Equations: `firmware_sim.body.motor`, `firmware_sim.body.sensors`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from adacd_hil.settings.schema import ConfigError, setting
from firmware_sim.arm.arms import EmulatedArm, pack_fields
from firmware_sim.arm.joint_forces import MECHANICS_NUMBERS, REFERENCE_C
from firmware_sim.arm.plant import ARM_NUMBERS, CURRENT_LOOP_HZ, MECHANICAL_STATE, fit_payload, mass_matrix
from firmware_sim.arm.sensing import TORQUE_NOISE_NM, TORQUE_RANGE_NM, VELOCITY_LOOP_HZ
from firmware_sim.arm.touch_settings import TICK_S

STANDARD_GRAVITY_M_S2: Final = 9.80665
"""Standard gravity, CGPM 1901."""
ENCODER_SIDES: Final = ("motor", "link")

LARGEST_OSCILLATION: Final = 0.05
"""Largest ω h of the fastest oscillation. RK4 then damps it by (ω h)⁵/144 = 2e-9 of critical, far below any metal's."""
LARGEST_DECAY: Final = 0.5
"""Largest |λ| h of a damped mode; RK4 is stable up to 2.78 and at 0.5 follows a decay within 3e-4."""
LARGEST_SUBSTEPS: Final = 16
"""Bound on the cost of a tick. Up to 8000 rad/s oscillations meet the bound above; faster ones lose amplitude."""
LARGEST_RATE: Final = 1.0
"""Largest |λ| h with the most substeps: 160 000 rad/s. Beyond it a scenario is refused."""

Pair = tuple[float, float]
_ZERO: Final = (0.0, 0.0)
PayloadBody = tuple[float, Pair, float]
"""Mass kg, centre of mass from the tip m, inertia about it kg m²."""


@dataclass(frozen=True)
class MechanicsSettings:
    """Properties of the arm beyond rigid links, viscous and Coulomb friction."""

    static_Nm: Pair = setting(
        _ZERO, unit="Nm", low=0.0, high=1000.0, meaning="F_s, friction at standstill; 0: the profile's Coulomb"
    )
    stribeck_velocity_rad_s: Pair = setting(
        (0.05, 0.05), unit="rad/s", low=1e-4, high=100.0, meaning="v_s: how fast static falls to Coulomb friction"
    )
    sigma0_Nm_rad: Pair = setting(
        _ZERO, unit="Nm/rad", low=0.0, high=1e7, meaning="LuGre: stiffness of the bristles; 0: no bristles"
    )
    sigma1_Nm_s: Pair = setting(_ZERO, unit="Nm s/rad", low=0.0, high=1e4, meaning="LuGre: damping of the bristles")
    sigma2_Nm_s: Pair | None = setting(
        None, unit="Nm s/rad", low=0.0, high=1e4, meaning="LuGre: viscous friction; absent: the profile's"
    )
    load_friction: Pair = setting(
        _ZERO, low=0.0, high=0.9, meaning="growth of Coulomb friction per torque through the joint"
    )
    viscous_drop_per_K: Pair = setting(
        _ZERO,
        unit="1/K",
        low=0.0,
        high=0.5,
        meaning=f"viscous friction falls by this share per kelvin above {REFERENCE_C:g} °C",
    )
    coulomb_drop_per_K: Pair = setting(
        _ZERO, unit="1/K", low=0.0, high=0.5, meaning="Coulomb and static friction likewise"
    )
    heat_capacity_J_K: Pair = setting(
        _ZERO, unit="J/K", low=0.0, high=1e9, meaning="of the joint that its friction warms; 0: no warming"
    )
    cooling_s: Pair = setting(
        (600.0, 600.0), unit="s", low=0.01, high=1e6, meaning="time constant of the joint's way back to ambient"
    )
    ambient_C: float = setting(
        REFERENCE_C, unit="°C", low=-40.0, high=80.0, meaning="temperature around, and of the joints at power-on"
    )
    stiffness_Nm_rad: Pair = setting(
        _ZERO, unit="Nm/rad", low=0.0, high=1e7, meaning="of the joint, motor to sensor; 0: stiff"
    )
    damping_Nm_s: Pair = setting(_ZERO, unit="Nm s/rad", low=0.0, high=1e4, meaning="beside that stiffness")
    rotor_inertia_kg_m2: Pair = setting(
        _ZERO, unit="kg m²", low=0.0, high=100.0, meaning="of motor and gear, seen from the joint (times N²)"
    )
    backlash_rad: Pair = setting(_ZERO, unit="rad", low=0.0, high=0.5, meaning="whole width of the dead zone")
    ripple_Nm: Pair = setting(_ZERO, unit="Nm", low=0.0, high=100.0, meaning="amplitude of the torque ripple")
    ripple_share: Pair = setting(_ZERO, low=0.0, high=1.0, meaning="amplitude per motor torque, added to it")
    ripple_periods: Pair = setting(
        (100.0, 100.0), low=1.0, high=1e5, meaning="periods of the ripple per revolution of the joint"
    )
    ripple_phase_deg: Pair = setting(_ZERO, unit="deg", low=-360.0, high=360.0, meaning="of the ripple at q = 0")
    motor_viscous_Nm_s: Pair = setting(
        _ZERO, unit="Nm s/rad", low=0.0, high=1e4, meaning="friction before the sensor, which does not see it"
    )
    motor_coulomb_Nm: Pair = setting(_ZERO, unit="Nm", low=0.0, high=1000.0, meaning="likewise, Coulomb")
    holding_brake_Nm: Pair = setting(
        _ZERO, unit="Nm", low=0.0, high=1000.0, meaning="what the motor's brake holds while the drive is off"
    )
    encoder_side: str = setting("motor", choices=ENCODER_SIDES, meaning="which side of the spring the encoder reads")
    stop_low_deg: Pair | None = setting(
        None, unit="deg", low=-720.0, high=720.0, meaning="lower joint stops; absent: the profile's"
    )
    stop_high_deg: Pair | None = setting(
        None, unit="deg", low=-720.0, high=720.0, meaning="upper joint stops; absent: the profile's"
    )
    stop_stiffness_Nm_rad: Pair = setting((3000.0, 1000.0), unit="Nm/rad", low=1.0, high=1e7, meaning="of a joint stop")
    stop_damping_Nm_s: Pair = setting((10.0, 2.0), unit="Nm s/rad", low=0.0, high=1e4, meaning="of a joint stop")
    tilt_deg: float = setting(0.0, unit="deg", low=0.0, high=90.0, meaning="of the base; 90: the arm moves upright")
    tilt_direction_deg: float = setting(
        0.0, unit="deg", low=-360.0, high=360.0, meaning="downhill, from the base's x axis"
    )

    def __post_init__(self) -> None:
        if (self.stop_low_deg is None) != (self.stop_high_deg is None):
            raise ConfigError("`mechanics.stop_low_deg` and `mechanics.stop_high_deg` come together")
        for joint in range(2):
            if self.stiffness_Nm_rad[joint] == 0.0:
                for name in ("backlash_rad", "damping_Nm_s"):
                    value = getattr(self, name)[joint]
                    if value > 0.0:
                        raise ConfigError(f"`mechanics.{name}[{joint}]` = {value:g} needs a `stiffness_Nm_rad` above 0")
            elif self.rotor_inertia_kg_m2[joint] == 0.0:
                raise ConfigError(
                    f"`mechanics.stiffness_Nm_rad[{joint}]` = {self.stiffness_Nm_rad[joint]:g} Nm/rad "
                    "needs a `rotor_inertia_kg_m2` above 0 kg m²"
                )
            if self.stop_low_deg and self.stop_high_deg and self.stop_low_deg[joint] >= self.stop_high_deg[joint]:
                raise ConfigError(
                    f"`mechanics.stop_low_deg[{joint}]` = {self.stop_low_deg[joint]:g} deg is not below "
                    f"stop_high_deg = {self.stop_high_deg[joint]:g} deg"
                )

    @property
    def holding_torque_Nm(self) -> Pair:
        """Torque that each motor holds without power: motor-side Coulomb friction, holding brake and ripple, summed.

        The ripple counts by its constant amplitude, `ripple_Nm`.
        """
        first, second = zip(self.motor_coulomb_Nm, self.holding_brake_Nm, self.ripple_Nm, strict=True)
        return sum(first), sum(second)

    def check(self, arm: EmulatedArm, start_deg: Pair, payloads: Sequence[PayloadBody]) -> None:
        """Raise ConfigError when these mechanics do not go with the arm, its start pose or its payloads.

        Causes: static friction above 0 but below Coulomb friction; bristles in a joint without Coulomb
        friction; a start pose beyond the joint stops; an eigenvalue too fast to integrate with LARGEST_SUBSTEPS.
        """
        for joint in range(2):
            static_Nm, coulomb_Nm = self.static_Nm[joint], arm.coulomb_Nm[joint]
            if 0.0 < static_Nm < coulomb_Nm:
                raise ConfigError(
                    f"`mechanics.static_Nm[{joint}]` = {static_Nm:g} Nm is below the Coulomb friction of profile "
                    f"{arm.name}, {coulomb_Nm:g} Nm"
                )
            if self.sigma0_Nm_rad[joint] > 0.0 and coulomb_Nm == 0.0:  # static friction vanishes with speed
                raise ConfigError(f"`mechanics.sigma0_Nm_rad[{joint}]` needs Coulomb friction above 0 Nm")
            low_deg, high_deg = (stops[joint] for stops in self._stops_deg(arm))
            if not low_deg <= start_deg[joint] <= high_deg:
                raise ConfigError(
                    f"`start_deg[{joint}]` = {start_deg[joint]:g} deg is beyond the joint's stops at "
                    f"{low_deg:g} and {high_deg:g} deg"
                )
        fastest_rad_s = self.eigenvalues(arm, payloads)[1]
        bound_rad_s = LARGEST_RATE * LARGEST_SUBSTEPS / TICK_S
        if fastest_rad_s > bound_rad_s:
            raise ConfigError(
                f"`mechanics`: an eigenfrequency of {fastest_rad_s:.3g} rad/s is above {bound_rad_s:g} rad/s; "
                "less stiffness or damping, or more inertia"
            )

    def arm_numbers(self, arm: EmulatedArm) -> np.void:
        """Return an arm without payload as one record of dtype ARM_NUMBERS, with the joint stops of these settings.

        Stop angles that are absent here are the arm's own.
        """
        numbers = pack_fields(arm, ARM_NUMBERS)
        numbers["alpha"], numbers["beta"], numbers["gamma"] = arm.inertia()
        numbers["moment_kg_m"] = arm.mass_kg[0] * arm.center_m[0] + arm.mass_kg[1] * arm.link_length_m[0]
        low_deg, high_deg = self._stops_deg(arm)
        numbers["stop_low_rad"], numbers["stop_high_rad"] = np.radians(low_deg), np.radians(high_deg)
        numbers["stop_stiffness_Nm_rad"] = self.stop_stiffness_Nm_rad
        numbers["stop_damping_Nm_s"] = self.stop_damping_Nm_s
        return numbers

    def _stops_deg(self, arm: EmulatedArm) -> tuple[Pair, Pair]:
        if self.stop_low_deg is None or self.stop_high_deg is None:
            return (-arm.stop_deg[0], -arm.stop_deg[1]), arm.stop_deg
        return self.stop_low_deg, self.stop_high_deg

    def numbers(self, arm: EmulatedArm) -> np.void:
        """Return friction, gear, gravity and brakes of an arm as one record of dtype MECHANICS_NUMBERS.

        Static friction is given as its surplus over the arm's Coulomb friction, 0 if it is less. LuGre's viscous
        friction that is absent here is the arm's.
        """
        numbers = pack_fields(self, MECHANICS_NUMBERS)
        surplus = [max(0.0, self.static_Nm[joint] - arm.coulomb_Nm[joint]) for joint in range(2)]
        numbers["surplus_Nm"] = surplus
        numbers["sigma2_Nm_s"] = self._sigma2(arm)
        numbers["ripple_phase_rad"] = np.radians(self.ripple_phase_deg)
        numbers["is_encoder_on_link"] = self.encoder_side == "link"
        numbers["gravity_m_s2"] = STANDARD_GRAVITY_M_S2 * math.sin(math.radians(self.tilt_deg))
        numbers["downhill_rad"] = math.radians(self.tilt_direction_deg)
        for joint in range(2):
            is_dry = arm.coulomb_Nm[joint] + surplus[joint] + self.load_friction[joint] > 0.0
            is_stiff = self.stiffness_Nm_rad[joint] == 0.0
            on_link = is_dry and self.sigma0_Nm_rad[joint] == 0.0
            on_motor = is_stiff and self.motor_coulomb_Nm[joint] > 0.0
            numbers["is_free"][joint] = not (on_link or on_motor)
        return numbers

    def _sigma2(self, arm: EmulatedArm) -> Pair:
        return arm.viscous_Nm_s if self.sigma2_Nm_s is None else self.sigma2_Nm_s

    def eigenvalues(self, arm: EmulatedArm, payloads: Sequence[PayloadBody]) -> tuple[float, float]:
        """Return the largest |Im λ| and the largest |λ|, rad/s, of the arm linearised about rest.

        It is linearised with stuck bristles and touched stops. Each is the maximum over elbow angles from 0 to 180
        degrees in steps of 45, and over the payloads; 0 without payloads, so a list for the empty arm has one of 0 kg.
        """
        elastic = [joint for joint in range(2) if self.stiffness_Nm_rad[joint] > 0.0]
        size = 2 + len(elastic)
        stiffness, damping = np.zeros((size, size)), np.zeros((size, size))
        viscous = self._sigma2(arm)
        for joint in range(2):
            stiffness[joint, joint] += self.sigma0_Nm_rad[joint]
            damping[joint, joint] += self.sigma1_Nm_s[joint] + max(viscous[joint], arm.viscous_Nm_s[joint])
            stiffness[joint, joint] += self.stop_stiffness_Nm_rad[joint]
            damping[joint, joint] += self.stop_damping_Nm_s[joint]
            motor = 2 + elastic.index(joint) if joint in elastic else joint
            damping[motor, motor] += self.motor_viscous_Nm_s[joint]
            if joint in elastic:
                spring = np.zeros(size)
                spring[[joint, motor]] = 1.0, -1.0
                stiffness += self.stiffness_Nm_rad[joint] * np.outer(spring, spring)
                damping += self.damping_Nm_s[joint] * np.outer(spring, spring)
        numbers = self.arm_numbers(arm)
        oscillation, largest = 0.0, 0.0
        for mass_kg, center_m, inertia_kg_m2 in payloads:
            state = np.zeros(1, MECHANICAL_STATE)[0]
            fit_payload(state, numbers, mass_kg, center_m[0], center_m[1], inertia_kg_m2)
            for joint in range(2):
                state["rotor_kg_m2"][joint] = 0.0 if joint in elastic else self.rotor_inertia_kg_m2[joint]
            for elbow_rad in np.linspace(0.0, math.pi, 5):
                mass = np.zeros((size, size))
                m11, m12, m22 = mass_matrix(state, float(elbow_rad))
                mass[:2, :2] = [[m11, m12], [m12, m22]]
                for place, joint in enumerate(elastic, start=2):
                    mass[place, place] = self.rotor_inertia_kg_m2[joint]
                system = np.zeros((2 * size, 2 * size))
                system[:size, size:] = np.eye(size)
                system[size:, :size] = -np.linalg.solve(mass, stiffness)
                system[size:, size:] = -np.linalg.solve(mass, damping)
                eigenvalues = np.linalg.eigvals(system)
                oscillation = max(oscillation, float(np.abs(eigenvalues.imag).max()))
                largest = max(largest, float(np.abs(eigenvalues).max()))
        return oscillation, largest

    def substeps(self, arm: EmulatedArm, payloads: Sequence[PayloadBody], touch_rad_s: float = 0.0) -> int:
        """Return the integration steps per 100 µs tick that the fastest rates need, 1 to LARGEST_SUBSTEPS.

        payloads: all that the arm carries in turn. touch_rad_s: fastest rate of bodies, hands and walls, counted as an
        oscillation.
        """
        oscillation, largest = self.eigenvalues(arm, payloads)
        oscillation = max(oscillation, touch_rad_s)
        needed = max(oscillation / LARGEST_OSCILLATION, largest / LARGEST_DECAY) * TICK_S
        return min(max(1, math.ceil(needed)), LARGEST_SUBSTEPS)


@dataclass(frozen=True)
class HabitSettings:
    """Behaviour of a drive that CiA 402 leaves open, or that deviates from the standard."""

    shows_mode: str = setting(
        "always",
        choices=("always", "enabled"),
        meaning="whether 0x6061 follows 0x6060 always or once it is enabled only",
    )
    mode_s: float = setting(0.0, unit="s", low=0.0, high=60.0, meaning="how much later 0x6061 shows another mode")
    shows_change: bool = setting(False, meaning="0x6061 is -1 meanwhile, in place of the last mode")
    enable_s: float = setting(
        0.0, unit="s", low=0.0, high=60.0, meaning="from Enable operation to Operation enabled, as a brake opens"
    )
    pause_ms: float = setting(
        0.0, unit="ms", low=0.0, high=1000.0, meaning="after an SDO answer, in which the next request is lost"
    )
    is_halted: bool = setting(
        False, meaning="it begins with the halt bit of 0x6040, and takes no other mode as long as that is set"
    )


@dataclass(frozen=True)
class DriveSettings:
    """Errors of the drives, and limits of their load."""

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
        _ZERO, low=-0.5, high=0.5, meaning="delivered torque over the one that the drive believes, less one"
    )
    torque_offset_Nm: Pair = setting(
        _ZERO,
        unit="Nm",
        low=-10.0,
        high=10.0,
        meaning="zero error of the current sensor while the motor is powered",
    )
    peak_torque_Nm: Pair = setting(
        _ZERO, unit="Nm", low=0.0, high=1000.0, meaning="peak current; 0, or more than rated torque: rated torque"
    )
    continuous_torque_Nm: Pair = setting(
        _ZERO, unit="Nm", low=0.0, high=1000.0, meaning="current that I²t allows for ever; 0: no I²t"
    )
    peak_time_s: Pair = setting(
        (1.0, 1.0), unit="s", low=1e-3, high=1e4, meaning="how long I²t allows the peak current from rest"
    )
    i2t_reaction: str = setting(
        "limit", choices=("limit", "fault"), meaning="down to the continuous current, or 0x2310"
    )
    winding_rise_K: Pair = setting(
        _ZERO, unit="K", low=0.0, high=1000.0, meaning="winding over housing at rated torque, for ever; 0: none"
    )
    winding_time_s: Pair = setting((30.0, 30.0), unit="s", low=1e-2, high=1e5, meaning="its time constant")
    housing_rise_K: Pair = setting(
        _ZERO, unit="K", low=0.0, high=1000.0, meaning="housing over ambient at rated torque, for ever; 0: none"
    )
    housing_time_s: Pair = setting((900.0, 900.0), unit="s", low=1e-2, high=1e5, meaning="its time constant")
    ambient_C: Pair = setting((25.0, 25.0), unit="°C", low=-40.0, high=100.0, meaning="temperature around the motor")
    preheat_K: Pair = setting(_ZERO, unit="K", low=0.0, high=300.0, meaning="housing over ambient at power-on")
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
    """Errors of the torque sensors and the encoders."""

    offset_drift_Nm_s: Pair = setting(
        _ZERO, unit="Nm/s", low=-10.0, high=10.0, meaning="steady drift of the torque zero since power-on"
    )
    offset_walk_Nm_rs: Pair = setting(
        _ZERO, unit="Nm/√s", low=0.0, high=10.0, meaning="random walk of the torque zero, rms after one second"
    )
    offset_drift_Nm_K: Pair = setting(
        _ZERO, unit="Nm/K", low=-1.0, high=1.0, meaning="drift of the torque zero with the joint's temperature"
    )
    gain_error: Pair = setting(_ZERO, low=-0.9, high=1.0, meaning="relative error of the torque sensor's sensitivity")
    gain_drift_1_K: Pair = setting(
        _ZERO,
        unit="1/K",
        low=-0.01,
        high=0.01,
        meaning=f"its drift with the joint's temperature, from {REFERENCE_C:g} °C",
    )
    cross_talk: Pair = setting(
        _ZERO, low=-0.5, high=0.5, meaning="share of the other joint's torque that this joint's sensor sees"
    )
    hysteresis_Nm: Pair = setting(
        _ZERO, unit="Nm", low=0.0, high=10.0, meaning="between the falling and the rising branch; 0: none"
    )
    hysteresis_reach_Nm: Pair = setting(
        (10.0, 10.0), unit="Nm", low=0.01, high=100.0, meaning="way from one branch to the other after a reversal"
    )
    torque_bandwidth_Hz: Pair = setting(
        _ZERO, unit="Hz", low=0.0, high=1e5, meaning="-3 dB of the amplifier's first-order low-pass; 0: none"
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
        _ZERO, unit="Hz", low=0.0, high=1e5, meaning="of the torque sensor's own clock; 0: it samples at SYNC"
    )
    clock_error_ppm: Pair = setting(
        _ZERO, unit="ppm", low=-1e4, high=1e4, meaning="how much the sensor's own clock is fast"
    )
    clock_phase: Pair = setting(
        _ZERO, low=0.0, high=1.0, meaning="when it first samples after power-on, in sample periods"
    )
    encoder_bits: tuple[int, int] = setting((20, 20), low=8, high=24, meaning="encoder counts per revolution, log2")
    encoder_noise_counts: Pair = setting(
        _ZERO, low=0.0, high=1000.0, meaning="white noise of the angle, rms, in the encoder's own counts"
    )
    index_error_rad: Pair = setting(
        _ZERO, unit="rad", low=-4.0, high=4.0, meaning="error of the encoder's zero since power-on"
    )
    eccentricity_rad: Pair = setting(
        _ZERO, unit="rad", low=0.0, high=0.1, meaning="amplitude of the error once per revolution"
    )
    eccentricity_phase_rad: Pair = setting(_ZERO, unit="rad", low=-7.0, high=7.0, meaning="its phase at the true zero")
    ellipticity_rad: Pair = setting(
        _ZERO, unit="rad", low=0.0, high=0.1, meaning="amplitude of the error twice per revolution"
    )
    ellipticity_phase_rad: Pair = setting(_ZERO, unit="rad", low=-7.0, high=7.0, meaning="its phase at the true zero")

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
