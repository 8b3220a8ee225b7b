"""The admission of viewers to a run: decided by the request that opens a connection, before any data is sent.

A browser sends with every WebSocket the origin of the page that opens it, and lets any page open one to this machine:
so a page that is not a viewer's must be refused, or a stranger's page could read the run (cross-site WebSocket
hijacking). A page that reaches this machine by a name of its own (DNS rebinding) also shows itself by the Host that it
asks for. Other programs send no origin: admission does not keep out a person who can start one on this
network.
"""

import ipaddress
import re
import socket
import struct
from collections.abc import Sequence
from http import HTTPStatus
from typing import NamedTuple

from adacd_hil.lab.live.live_view import LiveView

SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
"""Two names of one protocol on the wire: of viewers since 2025, and of earlier ones."""
OPEN_TIMEOUT_S = 5.0
SHOWN_DATA, SHOWN_HEAD = 1, struct.Struct("<BIQ")
"""Head of a message to a viewer: SHOWN_DATA, number of its subscription, log time in ns."""
VIEWER_ORIGINS = ("https://app.foxglove.dev", "https://studio.foxglove.dev", "file://")
"""Foxglove's pages, and `file://`, which the desktop applications of Foxglove and Lichtblick send."""
_OWN_PAGE = re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d{1,5})?")
"""A page that the viewer's own machine serves, such as Lichtblick's container at http://localhost:8080."""
_OWN_NAMES = ("localhost", "localhost.localdomain")


class ViewerRefusal(NamedTuple):
    """A refusal of a viewer, with the HTTP status and the reason that the viewer gets.

    `notice`: the line for the run's terminal, in which no word is the viewer's.
    """

    status: HTTPStatus
    reason: str
    notice: str


_ORIGIN = ViewerRefusal(
    HTTPStatus.FORBIDDEN,
    "this web page may not watch the run: allow its origin with --live-origin",
    "live view: a web page was refused, its origin is none of --live-origin",
)
_HOST = ViewerRefusal(
    HTTPStatus.FORBIDDEN,
    "this machine has no such name: ask for it by address, or allow the name with --live-name",
    "live view: a request for another host name was refused; --live-name allows one",
)
_PROTOCOL = ViewerRefusal(
    HTTPStatus.BAD_REQUEST,
    f"this is a WebSocket server for viewers that speak {' or '.join(SUBPROTOCOLS)}",
    f"live view: a client was refused that speaks neither {' nor '.join(SUBPROTOCOLS)}",
)
FULL = ViewerRefusal(
    HTTPStatus.SERVICE_UNAVAILABLE,
    "as many viewers as --live-viewers allows are watching",
    "live view: a viewer was refused, there are as many as --live-viewers allows",
)


def normal_origin(origin: str) -> str:
    """Return an origin in lower case, without a slash at its end.

    Raises ValueError if it isn't scheme and "://", mostly with host and port after it, or has a path, a space or an
    "@".
    """
    found = re.fullmatch(r"([a-z][a-z0-9+.-]*://[^/\s@]*)/?", origin.lower())
    if not found:
        raise ValueError(f"{origin!r} is no origin: scheme, host and port, such as https://view.lab.example")
    return found[1]


class Admission:
    """Decides by origins and host names which viewers the live view of a run admits."""

    def __init__(self, setup: LiveView) -> None:
        """Allow the origins and names of `setup`, besides the viewers' own pages and this machine's own names.

        Raises ValueError for an invalid origin.
        """
        self._origins = {*VIEWER_ORIGINS, *map(normal_origin, setup.origins)}
        own = socket.gethostname().lower()
        short = own.partition(".")[0]
        self._names = {*_OWN_NAMES, own, short, f"{short}.local", *(name.lower() for name in setup.names)}

    def refuse(
        self, origins: Sequence[str], hosts: Sequence[str], subprotocols: Sequence[str] | None
    ) -> ViewerRefusal | None:
        """Return why a request is refused; None if it is admitted.

        It needs exactly one host, an IP address or an allowed name; no origin, or one that is allowed; and one of
        `SUBPROTOCOLS`. origins, hosts, subprotocols: all values of its headers Origin, Host and Sec-WebSocket-Protocol;
        subprotocols: None for a browser that asks for a page, which needs none.
        """
        if len(hosts) != 1 or not self._is_own_host(hosts[0]):
            return _HOST
        if len(origins) > 1 or not all(map(self._is_viewer, origins)):
            return _ORIGIN
        if subprotocols is None:
            return None
        offered = {name.strip() for line in subprotocols for name in line.split(",")}
        return None if offered.intersection(SUBPROTOCOLS) else _PROTOCOL

    def _is_viewer(self, origin: str) -> bool:
        return origin.lower() in self._origins or _OWN_PAGE.fullmatch(origin.lower()) is not None

    def _is_own_host(self, host: str) -> bool:
        """Return whether a Host header, `name:port` or `[::1]:port`, has an IP address or an allowed name.

        The port may be missing. Upper and lower case are equal. False for a header of another form.
        """
        found = re.fullmatch(r"(?:\[([^\]]+)\]|([^:\[\]]+))(?::\d{1,5})?", host)
        if not found:
            return False
        name = (found[1] or found[2]).lower().rstrip(".")
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return name in self._names
        return True
