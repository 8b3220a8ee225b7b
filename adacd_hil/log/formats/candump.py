"""Lines of a candump log, `candump -L`: `(1436509052.249713) vcan0 044#2A366C2BBA`.

| after the identifier | is |
|---|---|
| #11223344 | data |
| #R, #R3 | remote frame, with its DLC |
| ##1 and data | CAN FD; flags BRS 1, ESI 2 |
| _9 behind the data | a raw DLC beyond 8, which has no meaning for us |

An identifier of 8 digits is a 29-bit one; with bit 0x20000000 it is an error frame and the rest its class. ` T` and
` R` at the end say sent and received, as python-can and `candump -x` write them; they are read, and written if asked
for, because Wireshark takes no file that has them. Source: can-utils, lib.h.
"""

import re
from typing import Any

from adacd_hil.log.formats.recorded_frames import MOST_NS, RECORDED_FRAME_DTYPE

ERROR_FLAG = 0x20000000
_LINE = re.compile(
    r"\((?P<s>\d{1,20})\.(?P<fraction>\d{1,9})\)\s+(?P<channel>\S{1,255})\s+(?P<id>[0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#"
    r"(?:(?P<remote>[Rr])(?P<dlc>[0-8]?)|#(?P<flags>[0-9A-Fa-f])(?P<fd>(?:[0-9A-Fa-f]{2}\.?)*)"
    r"|(?P<data>(?:[0-9A-Fa-f]{2}\.?)*))(?:_[0-9A-Fa-f])?(?:\s+(?P<way>[RrTt]))?"
)
_RATE_SWITCH = 1
_ERROR_STATE = 2


def parse(line: str) -> tuple[str, tuple[Any, ...]]:
    """Read a line: name of the channel, and a row of RECORDED_FRAME_DTYPE with channel 0. Raises ValueError."""
    match = _LINE.fullmatch(line.strip())
    if match is None:
        raise ValueError(f"no frame: {line.strip()[:60]}")
    t_ns = int(match["s"]) * 1_000_000_000 + int(match["fraction"].ljust(9, "0"))
    if t_ns > MOST_NS:
        raise ValueError(f"time {match['s']} s is beyond the year 2116")
    can_id = int(match["id"], 16)
    is_wide = len(match["id"]) == 8
    is_error = is_wide and bool(can_id & ERROR_FLAG)
    is_remote, is_fd = match["remote"] is not None, match["flags"] is not None
    data = bytes.fromhex((match["fd"] or match["data"] or "").replace(".", ""))
    if len(data) > (64 if is_fd else 8):
        raise ValueError(f"{len(data)} bytes of data in {line.strip()[:60]}")
    flags = int(match["flags"] or "0", 16)
    length = int(match["dlc"] or "0") if is_remote else len(data)
    row = (
        t_ns,
        t_ns,
        can_id & 0x1FFFFFFF,
        (match["way"] or "R") in "Tt",
        is_error,
        length,
        list(data.ljust(64, b"\0")),
        0,
        is_wide and not is_error,
        is_remote,
        is_fd,
        bool(flags & _RATE_SWITCH),
        bool(flags & _ERROR_STATE),
    )
    assert len(row) == len(RECORDED_FRAME_DTYPE.names or ())
    return match["channel"], row


def channel_name(name: str) -> str:
    """Spell a channel for a line; a number is that of an interface, as in python-can."""
    spelled = re.sub(r"\s+", "_", name)
    return f"can{spelled}" if spelled.isdecimal() or not spelled else spelled


def line(row: Any, channel: str, epoch_ns: int = 0, has_direction: bool = False) -> str:
    """Write a row of RECORDED_FRAME_DTYPE, its time cut to the µs that canplayer reads."""
    seconds, rest_ns = divmod(int(row["t_ns"]) + epoch_ns, 1_000_000_000)
    can_id, length = int(row["can_id"]), int(row["length"])
    if row["is_error"]:
        identifier = f"{ERROR_FLAG | can_id:08X}"
    else:
        identifier = f"{can_id:08X}" if row["is_extended"] else f"{can_id:03X}"
    if row["is_remote"]:
        content = f"R{length or ''}"
    else:
        content = row["data"][:length].tobytes().hex().upper()
        if row["is_fd"] and not row["is_error"]:
            flags = _RATE_SWITCH * bool(row["has_rate_switch"]) | _ERROR_STATE * bool(row["has_error_state"])
            content = f"#{flags:X}{content}"
    way = (" T" if row["is_tx"] else " R") if has_direction else ""
    return f"({seconds}.{rest_ns // 1000:06d}) {channel} {identifier}#{content}{way}\n"
