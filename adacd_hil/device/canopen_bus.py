"""canopen over our own bus: NMT, SDO, EMCY and heartbeats of any node.

No threads: a request is sent, then the bus is read until its answer is in. Other frames that arrive meanwhile are
handed to their consumers. Source: CiA 301 (4.2), clauses 7.2.4 (SDO) and 7.2.8 (NMT).
"""

import functools
import logging
import math
import struct
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import resources
from typing import Any, NamedTuple

import canopen
from canopen.emcy import EmcyError
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError, SdoError

from adacd_hil.wire.bus import Bus, BusError, Frame
from adacd_hil.wire.contract_frames import FUNCTION_MASK, NMT_ID, SDO_REQUEST_ID

ANSWER_TIMEOUT_S = 0.5
"""Longest wait for an answer. CiA 301 gives no value; drives answer within 100 ms."""
_MAX_UNRELATED_FRAMES = 10_000
SDO_ABORT = 0x80
UNFORESEEN = (
    canopen.ObjectDictionaryError,
    struct.error,
    LookupError,
    ValueError,
    TypeError,
    ArithmeticError,
    RuntimeError,
    AssertionError,
)
"""Exceptions of canopen on an unexpected answer: canopen trusts lengths, toggle bits and types."""
_ABSENT = (0x06020000, 0x06090011)  # no such object, no such sub-index: CiA 301, table 22


# canopen logs each error that it raises; the host prints the raised form only.
logging.getLogger("canopen").addHandler(logging.NullHandler())
logging.getLogger("canopen").propagate = False


class DeviceError(RuntimeError):
    """A device is missing, not the expected one, or refuses its set-up; one line. `remedy`: the cure; "": unknown."""

    def __init__(self, text: str, remedy: str = "") -> None:
        super().__init__(text)
        self.remedy = remedy

    @property
    def line(self) -> str:
        """The error and its remedy in one line."""
        return f"{self}; {self.remedy}" if self.remedy else str(self)


class RefusedError(DeviceError):
    """A device has answered a request with an abort."""


_REFUSED = (
    "the device refuses this request, perhaps only in this state: see the object in its manual; `setup` of its profile "
    "writes objects that must come first"
)
_SILENT = (
    "see that it has power and that nobody else asks it; a slow device needs `patience.answer_s` or "
    "`patience.pause_ms` in its profile"
)


class EdsVariable(NamedTuple):
    """One object of an EDS. bits: its size in a PDO, 0 if it is no number. default: None without an integer one.

    is_writable, is_readable: over SDO. is_mappable: whether a PDO may carry it. low, high: bounds of its number.
    """

    name: str
    bits: int
    is_signed: bool
    default: int | None
    is_writable: bool
    is_float: bool = False
    is_mappable: bool = True
    is_readable: bool = True
    low: float = -math.inf
    high: float = math.inf


def find_variable(objects: Any, index: int, sub: int) -> EdsVariable | None:
    """Return an object of canopen's object dictionary `objects`; None if index or sub-index isn't listed.

    None, too, for a sub-index other than 0 of an object without sub-indices.
    """
    entry = objects.get(index)
    if entry is None:
        return None
    if not isinstance(entry, canopen.objectdictionary.ODVariable):
        entry = entry.subindices.get(sub)
    elif sub:
        return None
    if entry is None:
        return None
    parent = entry.parent
    name = entry.name if entry.parent is objects or not sub else f"{parent.name}, {entry.name}"
    default = entry.value if entry.value is not None else entry.default
    is_number = entry.data_type in canopen.objectdictionary.NUMBER_TYPES
    is_signed = entry.data_type in canopen.objectdictionary.SIGNED_TYPES
    bits, number = len(entry) if is_number else 0, default if isinstance(default, int) else None
    is_float = entry.data_type in canopen.objectdictionary.FLOAT_TYPES
    low, high = _bounds(entry, is_signed, is_float)
    can_write, can_read = (letter in entry.access_type for letter in "wr")
    return EdsVariable(
        name, bits, is_signed, number, can_write, is_float, bool(entry.pdo_mappable), can_read, low, high
    )


def _bounds(entry: Any, is_signed: bool, is_float: bool) -> tuple[float, float]:
    """Return the bounds of an object by its data type, and by LowLimit and HighLimit if they leave more than one value.

    (0, -1) for an object that is no number.
    """
    if not entry.fixed_size:
        return 0, -1
    bits = 1 if entry.data_type == canopen.objectdictionary.BOOLEAN else len(entry)
    least = -math.inf if is_float else -(1 << bits - 1) if is_signed else 0
    most = math.inf if is_float else (1 << bits - is_signed) - 1
    low, high = (
        max(least, least if entry.min is None else entry.min),
        min(most, most if entry.max is None else entry.max),
    )
    return (low, high) if low < high else (least, most)


class _BusNetwork(canopen.Network):
    """canopen's network over our bus, without its receiving thread."""

    def __init__(self, send: Callable[[int, bytes], None]) -> None:
        super().__init__()
        self._send = send

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:  # noqa: ARG002
        self._send(can_id, bytes(data))


class CanopenBus:
    """Speaks CANopen over one end of a bus, as master."""

    def __init__(self, bus: Bus) -> None:
        self.channel = bus.channel
        self.bystander: Callable[[Frame], object] = lambda _: None
        """Gets every frame that arrives while an answer is awaited, besides canopen."""
        self._bus = bus
        self._network = _BusNetwork(self._send)
        self._patience: dict[int, tuple[float, float]] = {}
        self.malformed_frames = 0
        """Frames so far whose length or content doesn't fit the service of their identifier."""

    def add_node(
        self,
        node_id: int,
        objects: Any,
        on_emergency: Callable[[EmcyError], None] | None = None,
        answer_s: float = ANSWER_TIMEOUT_S,
        pause_s: float = 0.0,
    ) -> Any:
        """Add a node; return canopen's object of it. `objects`: of `read_eds`; None: `node.sdo.upload` is its only SDO.

        `on_emergency`: called with each EMCY of the node. `answer_s`: longest wait for an SDO answer. `pause_s`: wait
        before each request, for a device that loses a request soon after its answer.
        """
        node = canopen.RemoteNode(node_id, canopen.ObjectDictionary() if objects is None else objects)  # type: ignore[no-untyped-call]
        self._network.add_node(node)
        self._patience[node_id] = answer_s, pause_s
        node.sdo.RESPONSE_TIMEOUT = 0.0005  # the answer is in the queue when `_send` returns, or never comes
        if on_emergency is not None:
            node.emcy.add_callback(on_emergency)
        return node

    def command(self, nmt_command: int, node_id: int = 0) -> None:
        """Send an NMT command to one node; node_id 0: to all. Raises BusError if the bus refuses it."""
        self._bus.send(NMT_ID, bytes((nmt_command, node_id)))

    def _send(self, can_id: int, data: bytes) -> None:
        """Send a frame for canopen; after an SDO request, read the bus until its answer is in or overdue.

        Before a request, wait for the node's pause. Raises BusError if the bus fails.
        """
        is_request = can_id & FUNCTION_MASK == SDO_REQUEST_ID and data[0] != SDO_ABORT
        answer_s, pause_s = self._patience.get(can_id & 0x7F, (ANSWER_TIMEOUT_S, 0.0))
        if is_request and pause_s:
            self.pump(lambda _: False, pause_s)
        self._bus.send(can_id, data)
        if is_request:
            self.pump(lambda frame: frame.can_id == can_id - 0x80, answer_s)

    def pump(self, is_answer: Callable[[Frame], bool], timeout_s: float) -> bool:
        """Read the bus until a frame is the answer; return whether it came. Each frame goes to canopen and `bystander`.

        False after a silence of `timeout_s`, `timeout_s` after the first of other frames, or after 10,000 of them.
        Raises BusError if the bus fails.
        """
        remaining_s = timeout_s
        first_ns: int | None = None
        for _ in range(_MAX_UNRELATED_FRAMES):
            frame = self._bus.receive(remaining_s)
            if frame is None:
                return False
            self.accept(frame)
            self.bystander(frame)
            if is_answer(frame):
                return True
            first_ns = frame.t_ns if first_ns is None else first_ns
            remaining_s = timeout_s - (frame.t_ns - first_ns) * 1e-9
            if remaining_s <= 0.0:
                return False
        return False

    def accept(self, frame: Frame) -> None:
        """Give canopen an SDO answer, heartbeat or EMCY; ignore error frames.

        A frame that doesn't fit its service is dropped, and counted in `malformed_frames`.
        """
        if frame.is_error:
            return
        try:
            self._network.notify(frame.can_id, bytearray(frame.data), frame.t_ns * 1e-9)
        except (struct.error, KeyError):  # canopen trusts lengths and NMT states
            self.malformed_frames += 1


@contextmanager
def as_device_error(name: str, node_id: int, what: str, answer_s: float = ANSWER_TIMEOUT_S) -> Iterator[None]:
    """Turn exceptions of canopen into a DeviceError of one line, an abort into RefusedError.

    BusError and DeviceError pass. `name`, `node_id`: of the device, `what`: the request in words, for the line.
    `answer_s`: the wait that the error of a missing answer names.
    """
    try:
        yield
    except (BusError, DeviceError):
        raise
    except SdoAbortedError as error:
        raise RefusedError(f"{name} (node {node_id}): {what} refused: {error}", _REFUSED) from None
    except SdoCommunicationError:
        raise DeviceError(f"{name} (node {node_id}): no SDO answer within {answer_s:g} s ({what})", _SILENT) from None
    except (SdoError, *UNFORESEEN) as error:
        raise DeviceError(f"{name} (node {node_id}): {what}: {' '.join(str(error).split()) or repr(error)}") from None


def read_object(node: Any, index: int, subindex: int = 0) -> bytes | None:
    """Read an object over SDO; return its bytes as the node sends them, None if it answers that it has no such object.

    `node`: canopen's. Raises DeviceError if the node refuses or doesn't answer, BusError if the bus fails.
    """
    with as_device_error("node", node.id, f"object 0x{index:04X}:{subindex}"):
        try:
            return bytes(node.sdo.upload(index, subindex))
        except SdoAbortedError as error:
            if error.code not in _ABSENT:
                raise
            return None


@functools.cache
def _emergency_names() -> dict[str, dict[int, str]]:
    """Return the names of error codes by code (`codes`), and those of their classes by the high byte (`classes`)."""
    text = resources.files("adacd_hil.device").joinpath("emergency_codes.toml").read_text(encoding="utf-8")
    return {kind: {int(key, 16): name for key, name in names.items()} for kind, names in tomllib.loads(text).items()}


WATCHDOGS = {
    1: "SYNC",
    2: "command",
    3: "host heartbeat",
    4: "left Operational",
    5: "PDO length",
    6: "SYNC order",
    7: "SYNC length",
    8: "no RPDO brings commands",
}
"""Byte 3 of an EMCY of devices with the feature `watchdog_in_emcy`; bytes 4 to 7 are the device's time in ms."""


def name_error(code: int) -> str:
    """Return the name of an EMCY error code; that of its class if the code isn't listed; "unknown" without a class."""
    names = _emergency_names()
    codes, classes = names["codes"], names["classes"]
    return codes.get(code) or classes.get(code >> 8) or classes.get((code >> 8) & 0xF0, "unknown")


def describe_emergency(code: int, manufacturer: bytes, has_watchdog: bool) -> str:
    """Return an EMCY message in words, in one line. `code`: its error code; `manufacturer`: its bytes 3 to 7.

    If these bytes are all 0 they are left out. `has_watchdog`: they are the watchdog's number and the device's time; an
    unknown number is shown as bytes.
    """
    text = f"EMCY 0x{code:04X}: {name_error(code) if code else 'error reset'}"
    if not any(manufacturer):
        return text
    watchdog = manufacturer[0]
    if not has_watchdog or watchdog not in WATCHDOGS:
        return f"{text}, manufacturer bytes {manufacturer.hex(' ')}"
    time_ms = int.from_bytes(manufacturer[1:5], "little")
    return f"{text}, watchdog {watchdog} ({WATCHDOGS[watchdog]}) at device time {time_ms} ms"
