"""Message types of others: can_msgs/Frame, ros2_socketcan_msgs/FdFrame, sensor_msgs/JointState, foxglove_msgs/Log.

Each is packed here to its whole payload. Strings and counts that could vary are constant (no frame_id, two joints),
so that the sizes of classic frames and joint states are constant too. An FD frame is as long as its data, as
ros2_socketcan publishes it.
"""

import struct

import numpy as np

from adacd_hil.log.cdr import ENCAPSULATION, SEPARATOR, TIME_TEXT, MessageType
from adacd_hil.records import JOINT_NAMES, JOINTS, Event
from adacd_hil.wire.bus import MAX_STANDARD_ID

_HEADER_TEXT = f"""{SEPARATOR}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{TIME_TEXT}"""

CAN_FRAME = MessageType(
    "can_msgs/msg/Frame",
    f"""std_msgs/Header header
uint32 id
bool is_rtr
bool is_extended
bool is_error
uint8 dlc
uint8[8] data
{_HEADER_TEXT}""",
)
FD_FRAME = MessageType(
    "ros2_socketcan_msgs/msg/FdFrame",
    f"""std_msgs/Header header
uint32 id
bool is_extended
bool is_error
uint8 len
uint8[<=64] data
{_HEADER_TEXT}""",
)
JOINT_STATE = MessageType(
    "sensor_msgs/msg/JointState",
    f"""std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
{_HEADER_TEXT}""",
)
LOG = MessageType(
    "foxglove_msgs/msg/Log",
    f"""builtin_interfaces/Time timestamp
uint8 UNKNOWN=0
uint8 DEBUG=1
uint8 INFO=2
uint8 WARNING=3
uint8 ERROR=4
uint8 FATAL=5
uint8 level
string message
string name
string file
uint32 line
{TIME_TEXT}""",
)

_EMPTY_STRING = struct.pack("<I", 1) + b"\0"
_FRAME_ID = _EMPTY_STRING + b"\0\0\0"  # padded to the uint32 that follows
_CAN_FRAME_BODY = struct.Struct("<I???B8s")
CAN_FRAME_DTYPE = np.dtype(
    {
        "names": ["sec", "nanosec", "can_id", "is_extended", "is_error", "dlc", "data"],
        "formats": ["<u4", "<u4", "<u4", "?", "?", "u1", ("u1", (8,))],
        "offsets": [4, 8, 20, 25, 26, 27, 28],
        "itemsize": 36,
    }
)
MAX_DATA = 64
_FD_FRAME_BODY = struct.Struct("<I??BxI")
FD_FRAME_DTYPE = np.dtype(
    {
        "names": ["sec", "nanosec", "can_id", "is_extended", "is_error", "len", "count", "data"],
        "formats": ["<u4", "<u4", "<u4", "?", "?", "u1", "<u4", ("u1", (MAX_DATA,))],
        "offsets": [4, 8, 20, 24, 25, 26, 28, 32],
        "itemsize": 32 + MAX_DATA,
    }
)
"""The longest payload; others end after `count` bytes of data."""

_LEVELS = {"info": 2, "warning": 3, "error": 4}
_LEVEL_NAMES = {number: name for name, number in _LEVELS.items()} | {0: "info", 1: "info", 5: "error"}


def pack_can_frame(
    stamp: bytes,
    can_id: int,
    data: bytes,
    dlc: int,
    is_error: bool,
    is_remote: bool = False,
    is_extended: bool | None = None,
) -> bytes:
    """Pack a frame; `stamp` is a packed builtin_interfaces/Time, `data` up to 8 bytes of which `dlc` count.

    Without `is_extended` identifiers beyond 0x7FF are 29-bit ones.
    """
    is_extended = can_id > MAX_STANDARD_ID if is_extended is None else is_extended
    body = _CAN_FRAME_BODY.pack(can_id, is_remote, is_extended, is_error, dlc, data)
    return ENCAPSULATION + stamp + _FRAME_ID + body


def pack_fd_frame(stamp: bytes, can_id: int, data: bytes, is_error: bool, is_extended: bool | None = None) -> bytes:
    """Pack an FD frame; `stamp` is a packed builtin_interfaces/Time, `data` up to 64 bytes."""
    length = len(data)
    is_extended = can_id > MAX_STANDARD_ID if is_extended is None else is_extended
    return ENCAPSULATION + stamp + _FRAME_ID + _FD_FRAME_BODY.pack(can_id, is_extended, is_error, length, length) + data


def _joint_state_parts() -> tuple[bytes, bytes]:
    """Return what lies between stamp and position, and what lies before velocity and before effort."""
    names = struct.pack("<I", JOINTS)
    for name in JOINT_NAMES:
        text = name.encode() + b"\0"
        names += bytes(-len(names) % 4) + struct.pack("<I", len(text)) + text
    head = _FRAME_ID + names
    stamp_size = 8
    head += bytes(-(stamp_size + len(head)) % 4) + struct.pack("<I", JOINTS)
    head += bytes(-(stamp_size + len(head)) % 8)
    return head, struct.pack("<II", JOINTS, 0)


_JOINT_STATE_HEAD, _COUNT = _joint_state_parts()
_POSITION = len(ENCAPSULATION) + 8 + len(_JOINT_STATE_HEAD)
_STEP = 8 * JOINTS + len(_COUNT)
JOINT_STATE_DTYPE = np.dtype(
    {
        "names": ["sec", "nanosec", "q", "dq", "tau_J"],
        "formats": ["<u4", "<u4", *[("<f8", (JOINTS,))] * 3],
        "offsets": [4, 8, _POSITION, _POSITION + _STEP, _POSITION + 2 * _STEP],
        "itemsize": _POSITION + 2 * _STEP + 8 * JOINTS,
    }
)


def pack_joint_state(stamp: bytes, q: bytes, dq: bytes, tau_J: bytes) -> bytes:
    """Pack a joint state; `q`, `dq`, `tau_J` are the bytes of float64 (2,)."""
    return b"".join((ENCAPSULATION, stamp, _JOINT_STATE_HEAD, q, _COUNT, dq, _COUNT, tau_J))


def pack_log(stamp: bytes, event: Event) -> bytes:
    """Pack an event; an unknown level counts as an error."""
    payload = ENCAPSULATION + stamp + bytes((_LEVELS.get(event.level, _LEVELS["error"]),))
    for text in (event.message, event.name, ""):
        encoded = text.encode("utf-8", "replace") + b"\0"
        payload += bytes(-len(payload) % 4) + struct.pack("<I", len(encoded)) + encoded
    return payload + bytes(-len(payload) % 4) + struct.pack("<I", 0)


def is_log(payload: bytes) -> bool:
    """Tell whether `unpack_log` can unpack a payload."""
    try:
        unpack_log(payload)
    except (struct.error, IndexError):
        return False
    return True


def unpack_log(payload: bytes) -> Event:
    """Unpack an event. Raises struct.error or IndexError when the payload is cut."""
    level = _LEVEL_NAMES.get(payload[12], "error")
    position = 13
    texts = []
    for _ in range(2):
        position += -position % 4
        (size,) = struct.unpack_from("<I", payload, position)
        position += 4
        texts.append(payload[position : position + size].rstrip(b"\0").decode("utf-8", "replace"))
        position += size
    return Event(level, texts[1], texts[0])
