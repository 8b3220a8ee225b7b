"""Errors and limits of the drives, section `[drives]` of a scenario; pairs are (joint 1, joint 2).

The defaults are a drive that gives its rated torque for ever, with a torque loop of 1 kHz. The equations are in
`firmware_sim.body.motor`. Torques are at the joint and stand for the motor's current times its nominal torque constant.
"""

from dataclasses import dataclass

from adacd_hil.settings.schema import ConfigError, setting

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
