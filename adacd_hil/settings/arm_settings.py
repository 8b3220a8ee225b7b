"""Settings of the arm and of its devices: sections `arm` and `devices`.

Angles in degrees exist only in settings, in fields labelled `_deg`; the properties beside them give radians.
"""

from dataclasses import dataclass

import numpy as np

from adacd_hil.records import Vector
from adacd_hil.settings.schema import setting


@dataclass(frozen=True)
class ArmSettings:
    """The arm: what the host may know of it."""

    profile: str = setting("P", choices=("P", "S", "M"), meaning="emulated arm that this configuration is for")
    link_length_m: tuple[float, float] = setting((0.35, 0.30), unit="m", low=0.01, high=5.0, meaning="joint to joint")
    rated_torque_Nm: tuple[float, float] = setting(
        (12.0, 6.0), unit="Nm", low=0.1, high=1000.0, meaning="rated torque of each drive, 0x6076"
    )
    sign: tuple[int, int] = setting((1, 1), low=-1, high=1, meaning="+1 or -1: device direction to joint direction")
    torque_offset_Nm: tuple[float, float] = setting(
        (0.0, 0.0), unit="Nm", low=-50.0, high=50.0, meaning="zero of each torque sensor, subtracted after the sign"
    )
    torque_offset_std_Nm: tuple[float, float] | None = setting(
        None, unit="Nm", low=1e-6, high=100.0, meaning="standard deviation of that zero; `--tare` sets it"
    )
    holding_torque_Nm: tuple[float, float] | None = setting(
        None,
        unit="Nm",
        low=0.0,
        high=1000.0,
        meaning="largest torque that brake, friction and cogging hold without power; 0: free; absent: unknown",
    )
    position_torque_Nm: float = setting(
        0.0,
        unit="Nm",
        low=0.0,
        high=10.0,
        meaning="`certified`: largest torque that depends on the arm's place, as of a cable or a tilted base; 0: none",
    )
    torque_limit_Nm: tuple[float, float] = setting(
        (12.0, 6.0), unit="Nm", low=0.0, high=1000.0, meaning="largest commanded torque"
    )
    torque_error_share: float = setting(
        0.3, low=0.01, high=10.0, meaning="largest difference of commanded and actual torque, part of rated torque"
    )
    torque_rate_limit_Nm_s: tuple[float, float] = setting(
        (2000.0, 1000.0), unit="Nm/s", low=1.0, high=1e6, meaning="largest rate of the commanded torque"
    )
    position_limit_deg: tuple[float, float] = setting(
        (75.0, 120.0), unit="deg", low=1.0, high=720.0, meaning="largest |q|; beyond it the run faults"
    )
    velocity_limit_deg_s: tuple[float, float] = setting(
        (250.0, 300.0), unit="deg/s", low=1.0, high=3600.0, meaning="largest |dq|; beyond it the run faults"
    )
    cad_theta: tuple[float, ...] = setting((), low=0.0, meaning="the CAD model's parameters; empty: no model")

    def __post_init__(self) -> None:
        if any(sign == 0 for sign in self.sign):
            raise ValueError(f"sign = {self.sign} must be +1 or -1 for each joint")

    @property
    def position_limit_rad(self) -> Vector:
        """Largest |q|, rad (2,)."""
        return _radians(self.position_limit_deg)

    @property
    def velocity_limit_rad_s(self) -> Vector:
        """Largest |dq|, rad/s (2,)."""
        return _radians(self.velocity_limit_deg_s)


@dataclass(frozen=True)
class DevicesSettings:
    """Which devices are on the bus, by joint, and the contract that describes their frames."""

    drive: tuple[str, str] = setting(
        ("adacd-drive", "adacd-drive"), meaning="device profile: a built-in name or a file"
    )
    sensor: tuple[str, str] = setting(
        ("adacd-sensor", "adacd-sensor"), meaning="device profile: a built-in name or a file"
    )
    drive_node: tuple[int, int] = setting((1, 2), low=1, high=126, meaning="CANopen node ids")
    sensor_node: tuple[int, int] = setting((3, 4), low=1, high=126, meaning="CANopen node ids")
    contract: str = setting("arm", meaning="a DBC in dbc/ by name, or a file; empty: composed from the profiles")
    boot_timeout_s: float = setting(
        2.0, unit="s", low=0.1, high=60.0, meaning="longest wait for the nodes to boot after a reset of communication"
    )
    start: str = setting("sensors_first", choices=("sensors_first", "all"), meaning="order of the NMT start commands")
    reread_ms: int = setting(
        100, unit="ms", low=0, high=60_000, meaning="how often one object of the set-up is read again; 0: never"
    )
    quick_stop_option: int | None = setting(None, low=0, high=8, meaning="0x605A of the drives; unset: the profile's")
    fault_reaction_option: int | None = setting(
        None, low=0, high=4, meaning="0x605E of the drives; unset: the profile's"
    )
    bitrate: int = setting(1_000_000, unit="bit/s", low=10_000, high=1_000_000, meaning="of a composed contract")
    data_bitrate: int = setting(
        5_000_000, unit="bit/s", low=0, high=8_000_000, meaning="bit rate of its CAN FD data phase; 0: classic CAN"
    )

    def __post_init__(self) -> None:
        nodes = (*self.drive_node, *self.sensor_node)
        if len(set(nodes)) != len(nodes):
            raise ValueError(f"node ids {', '.join(map(str, nodes))} of drives and sensors must differ")


def _radians(degrees: tuple[float, float]) -> Vector:
    return np.radians(np.array(degrees, dtype=np.float64))
