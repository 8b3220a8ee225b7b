"""The state of a CAN interface as the kernel reports it: by iproute2 (rtnetlink, IFLA_CAN_*) or, without it, by sysfs.

Source: Linux, Documentation/networking/can.rst, "CAN network device driver interface".
"""

import contextlib
import json
import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_SYSFS = Path("/sys/class/net")
_ARPHRD_CAN = "280"
_IFF_UP = 1
_IP_TIMEOUT_S = 5.0
MTU_FD = 72
"""CANFD_MTU: sizeof(struct canfd_frame); a classic-only interface has 16."""


@dataclass(frozen=True)
class Link:
    """One CAN interface. What the source doesn't say is None.

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
    bus_offs: int | None = None

    @property
    def is_virtual(self) -> bool:
        """Whether no wire is behind it."""
        return self.kind in ("vcan", "vxcan")


def read_link(name: str) -> Link | None:
    """Read the state of a CAN interface; None when there is no such interface or it is not CAN."""
    ip = shutil.which("ip", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin")
    if ip is not None:
        with contextlib.suppress(OSError, subprocess.SubprocessError, ValueError, LookupError):
            command = [ip, "-details", "-statistics", "-json", "link", "show", "dev", name]
            shown = subprocess.run(command, capture_output=True, text=True, check=True, timeout=_IP_TIMEOUT_S)
            return parse_ip_link(json.loads(shown.stdout)[0])
    return read_sysfs_link(_SYSFS / name)


def parse_ip_link(link: dict[str, Any]) -> Link | None:
    """Read one entry of `ip -details -json link`; None when it is not CAN."""
    if link.get("link_type") != "can":
        return None
    info = link.get("linkinfo", {})
    data = info.get("info_data", {})
    timing = data.get("bittiming", {})
    counters = data.get("berr_counter", {})
    point = timing.get("sample_point")
    return Link(
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
        bus_offs=info.get("info_xstats", {}).get("bus_off"),
    )


def read_sysfs_link(folder: Path) -> Link | None:
    """Read what sysfs says of an interface, without bit timing; None when it is not there or not CAN."""
    try:
        if (folder / "type").read_text().strip() != _ARPHRD_CAN:
            return None
        return Link(
            name=folder.name,
            is_up=bool(int((folder / "flags").read_text(), 16) & _IFF_UP),
            kind=_kind_of(folder),
            mtu=int((folder / "mtu").read_text()),
            txqueuelen=int((folder / "tx_queue_len").read_text()),
        )
    except (OSError, ValueError):
        return None


def _kind_of(folder: Path) -> str:
    """Guess by its name what kind an interface without a device is: sysfs doesn't say. "" where it may be any."""
    if (folder / "device").exists():
        return ""
    return next((kind for kind in ("vcan", "vxcan", "slcan") if folder.name.startswith(kind)), "")


def carried_frames(name: str) -> int | None:
    """Count the frames that an interface has carried so far, both ways; None where the kernel doesn't say.

    A virtual interface counts what it sends as received, too.
    """
    folder = _SYSFS / name / "statistics"
    try:
        received, sent = (int((folder / f"{way}_packets").read_text()) for way in ("rx", "tx"))
    except (OSError, ValueError):
        return None
    return received + sent if (_SYSFS / name / "device").exists() else received
