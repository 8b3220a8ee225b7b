"""CAN network interfaces of this machine: state, fill of the transmit queue, taking one down and up.

The state comes from iproute2 (rtnetlink, IFLA_CAN_*) or, without it, from sysfs.

Sources: Linux netdevice(7) for the flags, rtnetlink(7) for the queueing discipline, linux/can/raw.h; Linux,
Documentation/networking/can.rst, "CAN network device driver interface".
"""

import contextlib
import errno
import fcntl
import json
import os
import shutil
import socket
import struct
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from adacd_hil.remedies import nearest_name
from adacd_hil.wire.bus import BusError, InterfaceDownError

CANFD_MTU = 72
"""sizeof(struct canfd_frame), bytes; a classic-only interface has 16."""

_INTERFACES = Path("/sys/class/net")
_ARPHRD_CAN = "280"
_IFF_UP = 0x1
_SIOCGIFFLAGS, _SIOCSIFFLAGS = 0x8913, 0x8914
_FLAGS_REQUEST = struct.Struct("16sH22x")

_RTM_NEWQDISC, _RTM_GETQDISC = 36, 38
_NLM_F_REQUEST_DUMP = 0x301
_NLMSG_ERROR, _NLMSG_DONE = 2, 3
_NETLINK_HEAD = struct.Struct("=IHHII")  # length, type, flags, sequence, port
_TRAFFIC_HEAD = struct.Struct("=B3xiIII")  # family, interface, handle, parent, info
_ATTRIBUTE = struct.Struct("=HH")  # length, type
_TC_H_ROOT = 0xFFFFFFFF
_TCA_STATS2, _TCA_STATS_QUEUE = 7, 3


class CanInterface:
    """A CAN interface by name, present or not."""

    def __init__(self, name: str) -> None:
        self.name = name

    @property
    def is_virtual(self) -> bool:
        """Whether the interface certainly has no controller, which could hold frames: it is vcan or vxcan."""
        return is_virtual("socketcan", self.name)

    def problem(self, is_fd: bool) -> str:
        """Return the reason why the interface can't be used, with the remedy, in one line; "" if it can be used.

        It is absent or down, or carries classic frames only although `is_fd`.
        """
        present = can_interfaces()
        if self.name not in present:
            known = f"present: {', '.join(present)}" if present else "no CAN interface is present"
            nearest = nearest_name(self.name, present)
            hint = f"; did you mean {nearest!r}?" if nearest else ""
            return f"CAN interface {self.name} does not exist; {known}{hint}"
        state = read_sysfs_link(_INTERFACES / self.name)
        if state is None or not state.is_up:
            return f"CAN interface {self.name} is down; bring it up: ip link set {self.name} up"
        if is_fd and state.mtu < CANFD_MTU:
            bit_rates = f"mtu {CANFD_MTU}" if self.is_virtual else "type can bitrate 1000000 dbitrate 5000000 fd on"
            return (
                f"CAN interface {self.name} carries classic frames only (MTU {state.mtu}, CAN FD needs {CANFD_MTU}): "
                f"ip link set {self.name} down && ip link set {self.name} {bit_rates} && ip link set {self.name} up"
            )
        return ""

    def take_down_and_up(self) -> None:
        """Take the interface down and up, which drops every frame in its queue and in its controller.

        Raises InterfaceDownError when it can't be taken down or doesn't come up again, BusError with the command when
        taking it down isn't permitted.
        """
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as control:
            try:
                flags = self._flags(control)
                self._set_flags(control, flags & ~_IFF_UP)
            except PermissionError:
                raise BusError(
                    f"old frames may wait in the transmit queue of {self.name}, and dropping them needs CAP_NET_ADMIN; "
                    f"run: sudo ip link set {self.name} down && sudo ip link set {self.name} up"
                ) from None
            except OSError as error:
                raise InterfaceDownError(f"CAN interface {self.name} can't be taken down: {error.strerror}") from None
            try:
                self._set_flags(control, flags | _IFF_UP)
            except OSError as error:
                raise InterfaceDownError(f"CAN interface {self.name} can't be brought up: {error.strerror}") from None

    def _flags(self, control: socket.socket) -> int:
        answer = fcntl.ioctl(control, _SIOCGIFFLAGS, _FLAGS_REQUEST.pack(self.name.encode(), 0))
        flags: int = _FLAGS_REQUEST.unpack(answer)[1]
        return flags

    def _set_flags(self, control: socket.socket, flags: int) -> None:
        fcntl.ioctl(control, _SIOCSIFFLAGS, _FLAGS_REQUEST.pack(self.name.encode(), flags))

    def waiting_frames(self) -> int:
        """Return the number of frames in the queueing discipline, of all processes; needs no permission.

        Frames that the controller has already fetched are not counted. Raises InterfaceDownError if the interface is
        absent, BusError if the kernel refuses.
        """
        try:
            index = socket.if_nametoindex(self.name)
        except OSError:
            raise InterfaceDownError(self.problem(is_fd=False)) from None
        return sum(length for interface, parent, length in _queues() if (interface, parent) == (index, _TC_H_ROOT))


def _queues() -> Iterator[tuple[int, int, int]]:
    """Yield (interface, parent, frames waiting) of all queueing disciplines; a root's count includes the others'.

    interface: its index; parent: handle, _TC_H_ROOT for a root. Raises BusError if the kernel refuses.
    """
    size = _NETLINK_HEAD.size + _TRAFFIC_HEAD.size
    request = _NETLINK_HEAD.pack(size, _RTM_GETQDISC, _NLM_F_REQUEST_DUMP, 1, 0) + _TRAFFIC_HEAD.pack(0, 0, 0, 0, 0)
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as netlink:
        netlink.send(request)
        while True:
            for kind, body in _netlink_messages(netlink.recv(65536)):
                if kind == _NLMSG_DONE:
                    return
                if kind == _NLMSG_ERROR:
                    code = -int.from_bytes(body[:4], "little", signed=True)
                    raise BusError(f"reading the transmit queues: {errno.errorcode.get(code, code)}")
                if kind == _RTM_NEWQDISC:
                    _, interface, _, parent, _ = _TRAFFIC_HEAD.unpack_from(body)
                    statistics = _attributes(body[_TRAFFIC_HEAD.size :]).get(_TCA_STATS2, b"")
                    queue = _attributes(statistics).get(_TCA_STATS_QUEUE, bytes(4))
                    yield interface, parent, struct.unpack_from("=I", queue)[0]


def _netlink_messages(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield type and body of each netlink message in an answer of the kernel."""
    position = 0
    while position < len(data):
        length, kind, _, _, _ = _NETLINK_HEAD.unpack_from(data, position)
        yield kind, data[position + _NETLINK_HEAD.size : position + length]
        position += length + -length % 4


def _attributes(data: bytes) -> dict[int, bytes]:
    """Return the contents of the netlink attributes in `data`, by their type; of one type the last counts."""
    found = {}
    position = 0
    while position < len(data):
        length, kind = _ATTRIBUTE.unpack_from(data, position)
        found[kind] = data[position + _ATTRIBUTE.size : position + length]
        position += length + -length % 4
    return found


def can_interfaces() -> list[str]:
    """Return the names of the CAN interfaces of this machine, up or down."""
    names = []
    for folder in sorted(_INTERFACES.glob("*")):
        with contextlib.suppress(OSError):
            if (folder / "type").read_text().strip() == _ARPHRD_CAN:
                names.append(folder.name)
    return names


def is_virtual(interface: str, channel: str) -> bool:
    """Return whether a channel certainly has no wire: vcan, vxcan, python-can's own virtual bus.

    False for a missing SocketCAN interface, and for a serial adapter (slcan), although it has no device of its own.
    Without iproute2, the interface's name decides.
    """
    if interface != "socketcan":
        return interface == "virtual"
    if (_INTERFACES / channel / "device").exists():
        return False
    link = read_link(channel)
    return link is not None and link.is_virtual


_IP_TIMEOUT_S = 5.0


@dataclass(frozen=True)
class InterfaceState:
    """State of a CAN interface. Fields that the source doesn't report are None.

    kind: the driver's rtnetlink kind, `vcan`, `can`, `vxcan`, `slcan`; "" unknown. state: CAN controller state, such
    as ERROR-ACTIVE. sample_point: share of the bit time. restart_ms: 0 is off. rx/tx: the controller's error counters.
    """

    name: str
    is_up: bool
    kind: str
    mtu: int
    txqueuelen: int
    qdisc: str | None = None
    bitrate: int | None = None
    data_bitrate: int | None = None
    sample_point: float | None = None
    restart_ms: int | None = None
    state: str | None = None
    rx_errors: int | None = None
    tx_errors: int | None = None

    @property
    def is_virtual(self) -> bool:
        """Whether the interface has no wire: its kind is vcan or vxcan."""
        return self.kind in ("vcan", "vxcan")


def read_link(name: str) -> InterfaceState | None:
    """Return the state of a CAN interface; None if there is no such interface or it is not CAN.

    By `ip` of iproute2; if that is missing or fails, by sysfs, with fewer fields.
    """
    ip = shutil.which("ip", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin")
    if ip is not None:
        with contextlib.suppress(OSError, subprocess.SubprocessError, ValueError, LookupError):
            command = [ip, "-details", "-statistics", "-json", "link", "show", "dev", name]
            shown = subprocess.run(command, capture_output=True, text=True, check=True, timeout=_IP_TIMEOUT_S)
            return parse_ip_link(json.loads(shown.stdout)[0])
    return read_sysfs_link(_INTERFACES / name)


def parse_ip_link(link: dict[str, Any]) -> InterfaceState | None:
    """Return the state in one entry of `ip -details -json link`; None if it is not CAN.

    Raises KeyError if name, flags or MTU are missing.
    """
    if link.get("link_type") != "can":
        return None
    info = link.get("linkinfo", {})
    data = info.get("info_data", {})
    timing = data.get("bittiming", {})
    counters = data.get("berr_counter", {})
    point = timing.get("sample_point")
    return InterfaceState(
        name=link["ifname"],
        is_up="UP" in link["flags"],
        kind=info.get("info_kind", ""),
        mtu=int(link["mtu"]),
        txqueuelen=int(link.get("txqlen", 0)),
        qdisc=link.get("qdisc"),
        bitrate=timing.get("bitrate"),
        data_bitrate=data.get("data_bittiming", {}).get("bitrate"),
        sample_point=None if point is None else float(point),
        restart_ms=data.get("restart_ms", 0) if data else None,
        state=data.get("state"),
        rx_errors=counters.get("rx"),
        tx_errors=counters.get("tx"),
    )


def read_sysfs_link(folder: Path) -> InterfaceState | None:
    """Return the state of an interface by sysfs, without queue discipline and controller; None if absent or not CAN."""
    try:
        if (folder / "type").read_text().strip() != _ARPHRD_CAN:
            return None
        return InterfaceState(
            name=folder.name,
            is_up=bool(int((folder / "flags").read_text(), 16) & _IFF_UP),
            kind=_kind_of(folder),
            mtu=int((folder / "mtu").read_text()),
            txqueuelen=int((folder / "tx_queue_len").read_text()),
        )
    except (OSError, ValueError):
        return None


def _kind_of(folder: Path) -> str:
    """Return the kind of an interface without a device by its name, since sysfs doesn't report it; "" if unknown."""
    if (folder / "device").exists():
        return ""
    return next((kind for kind in ("vcan", "vxcan", "slcan") if folder.name.startswith(kind)), "")


def carried_frames(name: str) -> int | None:
    """Return the number of frames that an interface has carried, both ways; None if the kernel doesn't report it.

    Of an interface without a device (vcan, vxcan, slcan) only the received ones are counted. Only those of vcan include
    the sent ones.
    """
    folder = _INTERFACES / name / "statistics"
    try:
        received, sent = (int((folder / f"{way}_packets").read_text()) for way in ("rx", "tx"))
    except (OSError, ValueError):
        return None
    return received + sent if (_INTERFACES / name / "device").exists() else received
