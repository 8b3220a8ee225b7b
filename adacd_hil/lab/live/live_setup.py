"""Where the live view of a run is served, and to whom."""

from dataclasses import dataclass
from typing import NamedTuple

from adacd_hil.lab.live.admission import normal_origin
from adacd_hil.log.log_files import MOST_VIEWERS
from adacd_hil.log.recording.processes import LiveFeed, WriterSetup
from adacd_hil.settings.configuration import Settings


@dataclass(frozen=True)
class LiveSetup:
    """Where the live view is served (port 0: any that is free), and the arm that it draws.

    robot_description: a URDF. tilt_rad: of the plane of motion. level_rad: the q1 at which link 1 is level. origins,
    names: of web pages that may watch, and of this machine, beside those of lab/live/admission.py. most_viewers: at
    a time.
    """

    host: str
    port: int
    robot_description: str
    link_length_m: tuple[float, float]
    tilt_rad: float = 0.0
    level_rad: float = 0.0
    origins: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    most_viewers: int = MOST_VIEWERS

    def open(self, setup: WriterSetup, ids: dict[int, int], start_ns: int) -> LiveFeed:
        """Start the process that serves it. Raises LogError."""
        from adacd_hil.lab.live.feed import LiveFeed

        return LiveFeed(setup, ids, start_ns)


class LiveAddress(NamedTuple):
    """Where the live view is served, and to whom; port 0: any that is free. The rest as in LiveSetup."""

    host: str
    port: int
    origins: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    most_viewers: int = MOST_VIEWERS

    def server(self, settings: Settings, robot: str) -> LiveSetup:
        """Return the live view of an arm; robot: its URDF."""
        host, port, origins, names, most_viewers = self
        tilt_rad, level_rad, length_m = settings.tilt_rad, settings.level_rad, settings.arm.link_length_m
        return LiveSetup(host, port, robot, length_m, tilt_rad, level_rad, origins, names, most_viewers)


def live_address(
    host: str, port: int, origins: tuple[str, ...], names: tuple[str, ...], most_viewers: int
) -> LiveAddress:
    """Return the place of a live view. Raises ValueError where one of the origins is none."""
    return LiveAddress(host, port, tuple(map(normal_origin, origins)), names, most_viewers)
