"""Timing and node ids of a contract's frames: triggers, cycle times, bit rates, moved node ids.

DBC attributes: of the network `Baudrate`, `BaudrateCANFD` (bit/s; 0: classic), `BusPeriod_us`; of a message `Trigger`,
`GenMsgCycleTime` (ms, period of an event frame), `GenMsgDelayTime` (ms, its inhibit time).

A device's identifiers follow from its node id, the low seven bits. So a contract serves another arm on the bus, or a
host other than node 127, once its node ids are moved. NMT, SYNC and other identifiers without a node id stay; layouts,
data ids and names stay, too. Source: CiA 301 clause 7.3.3 (predefined connection set).
"""

import re
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path

from cantools.database.can import Database, Message

from adacd_hil.wire.codec import Codec, CodecError, decode_dbc, parse_codec, parse_database
from adacd_hil.wire.dbc_decoder import DbcDecoder
from adacd_hil.wire.frame_lengths import MAX_STANDARD_ID

HOST_NODE = 127
"""Node id of the host by default."""
NODE_MASK = 0x7F
HOST_HEARTBEAT = "HostHeartbeat"
NMT_ID, SYNC_ID, EMERGENCY_ID, HEARTBEAT_ID = 0x000, 0x080, 0x080, 0x700
SDO_RESPONSE_ID, SDO_REQUEST_ID = 0x580, 0x600
"""Base identifiers of the predefined connection set; a node adds its id to all but the first two."""
SYNC_OVERFLOW = 240
"""0x1019: the SYNC counter runs 1…240, as long as CiA 301 lets it."""
NOT_VALID = 1 << 31
"""Bit 31 of a COB-ID, CiA 301 clause 7.5.2.35: the PDO or EMCY is switched off."""
DEFAULT_BITRATE = 1_000_000
"""Bit rate of a DBC without that attribute, bit/s."""
ASSUMED_INTERVAL_MS = 100
"""Interval of an event frame without a declared one: the usual heartbeat period."""
_LAST_DEVICE = 126
_STATEMENT = re.compile(
    r"""^(?P<head>\s*(?:BO_|BO_TX_BU_|VAL_|SIG_VALTYPE_|SIG_GROUP_|SG_MUL_VAL_|CM_\s+(?:BO_|SG_)"""
    r"""|BA_\s+"\w+"\s+(?:BO_|SG_))\s+)(?P<id>\d+)\b""",
    re.MULTILINE,
)
"""Matches a DBC statement about one message, up to its identifier."""


def move_contract(codec: Codec, node_offset: int, host_node: int | None = None) -> Codec:
    """Return the contract with all devices' node ids moved and the host at `host_node` (default: unchanged).

    Its path is the file's name alone, since it has no file yet. Without a change the same object is returned. Raises
    CodecError for a node id beyond 126, a node id equal to the host's, and a device's identifier without a node id.
    """
    host_id = codec.message(HOST_HEARTBEAT).can_id
    if host_node is None:
        host_node = host_id & NODE_MASK
    if not node_offset and host_node == host_id & NODE_MASK:
        return codec
    moved = {host_id: HEARTBEAT_ID + host_node}
    for message in codec.messages.values():
        if message.can_id != host_id:
            name = f"{codec.path.name}: {message.name}"
            moved[message.can_id] = move_id(message.can_id, node_offset, host_node, name)

    def move(found: re.Match[str]) -> str:
        return found["head"] + str(moved.get(int(found["id"]), found["id"]))

    text = _STATEMENT.sub(move, decode_dbc(codec.text))
    return parse_codec(text.encode(), Path(codec.path.name))


def move_id(can_id: int, node_offset: int, host_node: int, name: str) -> int:
    """Move an identifier of a device; one without a node id stays. Raises CodecError that begins with `name`."""
    node_id = can_id & NODE_MASK
    if can_id > MAX_STANDARD_ID:
        raise CodecError(f"{name}: identifier 0x{can_id:X} has no node id that could be moved")
    if not node_id:
        return can_id
    if not 1 <= node_id + node_offset <= _LAST_DEVICE:
        raise CodecError(f"{name}: node id {node_id + node_offset} is none of 1 to {_LAST_DEVICE}")
    if node_id + node_offset == host_node:
        raise CodecError(f"{name}: node id {host_node} is the host's")
    return can_id + node_offset


def read_bitrates(codec: Codec | DbcDecoder) -> tuple[int, int]:
    """Return the nominal and the data bit rate; the data bit rate of a classic bus is 0."""
    nominal, data = (str(_attribute(codec.database, name)) for name in ("Baudrate", "BaudrateCANFD"))
    return int(nominal) if nominal.strip("0").isdecimal() else DEFAULT_BITRATE, int(data) if data.isdecimal() else 0


class Trigger(Enum):
    """When a frame is sent; the DBC's `Trigger`."""

    SYNC = "sync"
    COMMAND = "command"
    EVENT = "event"
    REQUEST = "request"


@dataclass(frozen=True)
class ContractFrame:
    """Frame of a contract: identifier, length, trigger, times."""

    name: str
    can_id: int
    is_extended: bool
    length: int
    trigger: Trigger
    cycle_ms: int
    inhibit_ms: int

    @property
    def priority(self) -> tuple[int, int]:
        """Arbitration order; lower wins. A base frame wins over an extended one with the same first 11 bits."""
        return (self.can_id >> 18, 1 + (self.can_id & 0x3FFFF)) if self.is_extended else (self.can_id, 0)

    @property
    def is_cyclic(self) -> bool:
        """Whether it is sent on every SYNC."""
        return self.trigger in (Trigger.SYNC, Trigger.COMMAND)

    @property
    def is_emergency(self) -> bool:
        """Whether it is a CiA 301 EMCY."""
        is_emcy_id = self._function == EMERGENCY_ID and self.can_id != SYNC_ID
        return is_emcy_id and self.trigger is Trigger.EVENT

    @property
    def _function(self) -> int:
        """Function code of the predefined connection set; -1 for an extended frame."""
        return -1 if self.is_extended else self.can_id & ~NODE_MASK

    @property
    def has_interval(self) -> bool:
        """Whether an inhibit or cycle time bounds its rate; heartbeats always have one."""
        return self.trigger is not Trigger.EVENT or self.inhibit_ms > 0 or self._function == HEARTBEAT_ID

    def interval_ns(self, period_ns: int) -> int:
        """Smallest interval between two of them that the budget assumes."""
        if self.trigger is Trigger.EVENT:
            return (self.inhibit_ms or self.cycle_ms or ASSUMED_INTERVAL_MS) * 1_000_000
        return period_ns

    def deadline_ns(self, period_ns: int) -> int | None:
        """Time within which it must be transmitted; None: no deadline."""
        if self.is_cyclic:
            return period_ns
        return self.cycle_ms * 1_000_000 if self.trigger is Trigger.EVENT and self.cycle_ms else None


@dataclass(frozen=True)
class ContractTiming:
    """Frames of a DBC in arbitration order; rates in bit/s; period 0: not given.

    `arms`: number of arms on the bus, each with its host.
    """

    name: str
    bitrate: int
    data_bitrate: int
    period_us: int
    frames: tuple[ContractFrame, ...]
    arms: int = 1


def read_contract(text: bytes, name: str) -> ContractTiming:
    """Read the timing of a DBC that `load_codec` has accepted. Raises CodecError."""
    database = parse_database(text, Path(name))
    definitions = database.dbc.attribute_definitions if database.dbc else {}
    if "Trigger" not in definitions:
        raise CodecError(f"DBC {name} has no attribute Trigger, which tells when messages are sent")
    frames = [_read_frame(message, name) for message in database.messages]
    return ContractTiming(
        name,
        int(_attribute(database, "Baudrate")),
        int(_attribute(database, "BaudrateCANFD")),
        int(_attribute(database, "BusPeriod_us")),
        tuple(sorted(frames, key=lambda frame: frame.priority)),
    )


def _read_frame(message: Message, contract: str) -> ContractFrame:
    choices = list(message.dbc.attribute_definitions["Trigger"].choices or ()) if message.dbc else []
    value = _attribute(message, "Trigger")
    chosen = choices[value] if isinstance(value, int) and 0 <= value < len(choices) else value
    try:
        trigger = Trigger(chosen)
    except ValueError:
        known = ", ".join(trigger.value for trigger in Trigger)
        raise CodecError(f"DBC {contract}: {message.name}: Trigger = {chosen!r}; known: {known}") from None
    cycle_ms, inhibit_ms = int(_attribute(message, "GenMsgCycleTime")), int(_attribute(message, "GenMsgDelayTime"))
    return ContractFrame(
        message.name, message.frame_id, message.is_extended_frame, message.length, trigger, cycle_ms, inhibit_ms
    )


def _attribute(owner: Database | Message, name: str) -> int | str:
    """Return the value of an attribute, its default, or 0 if the DBC doesn't define it."""
    if owner.dbc is None or name not in owner.dbc.attribute_definitions:
        return 0
    attribute = owner.dbc.attributes.get(name)
    value = owner.dbc.attribute_definitions[name].default_value if attribute is None else attribute.value
    return value if isinstance(value, str) else int(value or 0)


def share_bus(contract: ContractTiming, arms: int) -> ContractTiming:
    """Return the frames of several arms of one contract on a bus, for any order of the arms.

    The devices' node ids follow each other from 1, the hosts' go down from the contract's. Raises CodecError for an
    identifier without node id.
    """
    if arms == 1:
        return contract
    nodes = {f.can_id & NODE_MASK for f in contract.frames if f.name != HOST_HEARTBEAT and f.can_id & NODE_MASK}
    first, step = min(nodes, default=1), max(nodes, default=1) - min(nodes, default=1) + 1
    frames = [frame for frame in contract.frames if not (frame.is_extended or frame.can_id & NODE_MASK)]
    for arm in range(arms):
        for frame in contract.frames:
            if frame in frames:
                continue
            if frame.name == HOST_HEARTBEAT:
                can_id = frame.can_id - arm
            else:
                can_id = move_id(frame.can_id, 1 - first + arm * step, 0, f"DBC {contract.name}: {frame.name}")
            frames.append(replace(frame, name=f"Arm{arm + 1}.{frame.name}", can_id=can_id))
    frames.sort(key=lambda frame: frame.priority)
    return replace(contract, name=f"{arms} × {contract.name}", frames=tuple(frames), arms=arms)
