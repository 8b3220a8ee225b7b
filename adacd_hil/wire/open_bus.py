"""Opens a bus of any kind: SocketCAN, python-can."""

from collections.abc import Iterable

from adacd_hil.clock import Clock
from adacd_hil.wire.bus import Bus
from adacd_hil.wire.python_can import PythonCanBus
from adacd_hil.wire.socketcan import SocketCanBus


def open_bus(
    interface: str,
    channel: str,
    clock: Clock,
    can_ids: Iterable[int] | None = None,
    bitrate: int | None = None,
    is_fd: bool = False,
    is_shared: bool = False,
) -> Bus:
    """Open one end of a real or virtual bus. Raises BusMissingError if the interface is absent, down or unusable.

    `can_ids`: identifiers to receive, None: all; SocketCAN filters them in the kernel, other interfaces receive all.
    `bitrate` in bit/s is for interfaces that python-can configures; a SocketCAN interface has its own from `ip link`.
    Frames of more than 8 bytes need `is_fd`. `is_shared`: other programs use the interface, too; it isn't taken down
    while the bus carries frames. Identifiers beyond 0x7FF are 29-bit ones. Remote frames, and 29-bit identifiers that
    fit into 11 bits, are never received.
    """
    if interface == "socketcan":
        return SocketCanBus(channel, clock, can_ids, is_fd, is_shared)
    return PythonCanBus(interface, channel, clock, bitrate, is_fd)
