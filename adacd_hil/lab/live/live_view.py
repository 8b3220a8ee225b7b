"""The live view of a run, as commands ask for it, the session completes it and the log's writer opens it."""

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

from adacd_hil.lab.live.scene import Shape
from adacd_hil.log.log_files import MOST_VIEWERS

if TYPE_CHECKING:
    from adacd_hil.lab.live.feed import LiveFeed
    from adacd_hil.log.recording.processes import WriterSetup
    from adacd_hil.settings.configuration import Settings


@dataclass(frozen=True)
class LiveView:
    """Address of a live view (port 0: any free one), admitted viewers, and the arm that it draws.

    origins, names: of web pages that may watch, and of this machine, besides those of lab/live/admission.py.
    most_viewers: admitted at a time. robot_description: a URDF, "" until `server`.
    """

    host: str
    port: int
    origins: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    most_viewers: int = MOST_VIEWERS
    robot_description: str = ""
    shape: Shape = Shape((0.0, 0.0))

    def server(self, settings: "Settings") -> "LiveView":
        """Return a copy of this live view with the arm of the settings: its URDF and its shape."""
        from adacd_hil.log.robot_description import robot_description

        shape = Shape(settings.arm.link_length_m, settings.tilt_rad, settings.level_rad)
        return dataclasses.replace(self, robot_description=robot_description(settings), shape=shape)

    def __call__(self, setup: "WriterSetup", ids: dict[int, int], start_ns: int) -> "LiveFeed":
        """Start the process that serves the live view, and return its feed.

        setup: of the log. ids: the file's number of each channel. start_ns: log time before the first record. Raises
        LogError if the process can't start or listen.
        """
        from adacd_hil.lab.live.feed import LiveFeed

        return LiveFeed(self, setup, ids, start_ns)


def live_address(host: str, port: int, origins: tuple[str, ...], names: tuple[str, ...], most_viewers: int) -> LiveView:
    """Return a live view on an address, without an arm, its origins in lower case and without a slash at the end.

    Raises ValueError for an invalid origin.
    """
    from adacd_hil.lab.live.admission import normal_origin

    return LiveView(host, port, tuple(map(normal_origin, origins)), names, most_viewers)
