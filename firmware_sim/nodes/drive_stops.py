"""How a drive stops its motor: option codes 0x605A, 0x605B, 0x605C, 0x605E, and when it stands still.

In cyclic synchronous torque the drive leaves the set-point and brakes by itself: on the slow-down ramp, on the
quick-stop ramp, or up to its current limit. Ramps by voltage limit don't exist here: codes 4 and 8 are refused.
Source: CiA 402-2 (IEC 61800-7-201), objects 0x605A to 0x605E.
"""

from typing import NamedTuple

from firmware_sim.body.body import DriveMode

_REST_RAD_S = 0.02  # standstill: a hundredth of the slowest motion that the arm makes
_REST_NS = 10_000_000  # standstill lasts; passing through zero does not
_LONGEST_BRAKING_NS = 1_000_000_000  # an arm that someone keeps pushing never stands still


class Stop(NamedTuple):
    """One option code. `mode` OFF: the drive function is disabled at once, without braking."""

    mode: DriveMode
    stays: bool = False  # in Quick stop active


DISABLE = Stop(DriveMode.OFF)
QUICK_STOPS = {
    0: DISABLE,
    1: Stop(DriveMode.BRAKE_SLOWLY),
    2: Stop(DriveMode.BRAKE),
    3: Stop(DriveMode.BRAKE_HARD),
    5: Stop(DriveMode.BRAKE_SLOWLY, stays=True),
    6: Stop(DriveMode.BRAKE, stays=True),
    7: Stop(DriveMode.BRAKE_HARD, stays=True),
}
"""0x605A."""
RAMPS = {0: DISABLE, 1: Stop(DriveMode.BRAKE_SLOWLY)}
"""0x605B shutdown, 0x605C disable operation."""
FAULT_REACTIONS = {code: QUICK_STOPS[code] for code in (0, 1, 2, 3)}
"""0x605E."""


class Standstill:
    """Watches a braking motor."""

    def __init__(self) -> None:
        self._since_ns = self._moving_ns = 0

    def begin(self, t_ns: int) -> None:
        """Braking begins."""
        self._since_ns = self._moving_ns = t_ns

    def is_reached(self, velocity_rad_s: float, t_ns: int) -> bool:
        """Whether the motor stands still, or has braked for the longest time."""
        if abs(velocity_rad_s) > _REST_RAD_S:
            self._moving_ns = t_ns
        return t_ns - self._moving_ns >= _REST_NS or t_ns - self._since_ns >= _LONGEST_BRAKING_NS
