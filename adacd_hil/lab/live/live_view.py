"""The live view of a run, as commands ask for it and as the log's writer opens it."""

from dataclasses import dataclass
from typing import NamedTuple

from adacd_hil.lab.live.admission import normal_origin
from adacd_hil.lab.live.feed import LiveFeed
from adacd_hil.lab.live.live_setup import LiveSetup
from adacd_hil.log.log_files import MOST_VIEWERS
from adacd_hil.log.recording.processes import WriterSetup
from adacd_hil.settings.configuration import Settings


@dataclass(frozen=True)
class LiveView(LiveSetup):
    """A live view that the writer opens in its process."""

    def open(self, setup: WriterSetup, ids: dict[int, int], start_ns: int) -> LiveFeed:
        """Start the process that serves it. Raises LogError."""
        return LiveFeed(self, setup, ids, start_ns)


class LiveAddress(NamedTuple):
    """Address and admitted viewers of the live view; port 0: any free one. The rest as in LiveSetup."""

    host: str
    port: int
    origins: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    most_viewers: int = MOST_VIEWERS

    def server(self, settings: Settings, robot: str) -> LiveView:
        """Return the live view of an arm; robot: its URDF."""
        host, port, origins, names, most_viewers = self
        tilt_rad, level_rad, length_m = settings.tilt_rad, settings.level_rad, settings.arm.link_length_m
        return LiveView(host, port, robot, length_m, tilt_rad, level_rad, origins, names, most_viewers)


def live_address(
    host: str, port: int, origins: tuple[str, ...], names: tuple[str, ...], most_viewers: int
) -> LiveAddress:
    """Return the place of a live view. Raises ValueError for an invalid origin."""
    return LiveAddress(host, port, tuple(map(normal_origin, origins)), names, most_viewers)
