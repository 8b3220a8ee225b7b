"""Setup of the live view: address, admitted viewers, the arm to draw."""

from dataclasses import dataclass

from adacd_hil.log.log_files import MOST_VIEWERS


@dataclass(frozen=True)
class LiveSetup:
    """Address of the live view (port 0: any free one), and the arm that it draws.

    robot_description: a URDF. tilt_rad: of the plane of motion. level_rad: the q1 at which link 1 is level. origins,
    names: of web pages that may watch, and of this machine, besides those of lab/live/admission.py. most_viewers: at
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
