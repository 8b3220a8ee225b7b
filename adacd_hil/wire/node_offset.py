"""A contract at other node ids: the same frames for another arm on the bus, or for a host that isn't node 127.

What a node sends and receives follows its node id, the low seven bits of an identifier. NMT, SYNC and everything else
without a node stay. Layouts, data ids and names stay too. Source: CiA 301 clause 7.3.3 (predefined connection set).
"""

import re
from pathlib import Path

from adacd_hil.wire.codec import Codec, CodecError, parse_codec

HOST_NODE = 127
"""Node id of the host unless said otherwise."""
NODE_MASK = 0x7F
_HOST_HEARTBEAT = "HostHeartbeat"
_LAST_DEVICE = 126
_LAST_STANDARD_ID = 0x7FF
_HEARTBEAT = 0x700
_STATEMENT = re.compile(
    r"""^(?P<head>\s*(?:BO_|BO_TX_BU_|VAL_|SIG_VALTYPE_|SIG_GROUP_|SG_MUL_VAL_|CM_\s+(?:BO_|SG_)"""
    r"""|BA_\s+"\w+"\s+(?:BO_|SG_))\s+)(?P<id>\d+)\b""",
    re.MULTILINE,
)
"""A statement of a DBC that is about one message, up to its identifier."""


def move_contract(codec: Codec, node_offset: int, host_node: int | None = None) -> Codec:
    """Return the contract with all devices' node ids moved and the host at `host_node` (default: where it is).

    Its path is the file's name alone: it has no file yet. Without a change it is the contract itself. Raises CodecError
    for a node id beyond 126, one that the host has, and an identifier that holds no node id.
    """
    host_id = codec.message(_HOST_HEARTBEAT).can_id
    if host_node is None:
        host_node = host_id & NODE_MASK
    if not node_offset and host_node == host_id & NODE_MASK:
        return codec
    moved = {host_id: _HEARTBEAT + host_node}
    for message in codec.messages.values():
        if message.can_id != host_id:
            name = f"{codec.path.name}: {message.name}"
            moved[message.can_id] = move_id(message.can_id, node_offset, host_node, name)

    def move(found: re.Match[str]) -> str:
        return found["head"] + str(moved.get(int(found["id"]), found["id"]))

    text = _STATEMENT.sub(move, codec.text.decode())
    return parse_codec(text.encode(), Path(codec.path.name))


def move_id(can_id: int, node_offset: int, host_node: int, name: str) -> int:
    """Move an identifier of a device; one without a node id stays. Raises CodecError that begins with `name`."""
    node_id = can_id & NODE_MASK
    if can_id > _LAST_STANDARD_ID:
        raise CodecError(f"{name}: identifier 0x{can_id:X} has no node id that could be moved")
    if not node_id:
        return can_id
    if not 1 <= node_id + node_offset <= _LAST_DEVICE:
        raise CodecError(f"{name}: node id {node_id + node_offset} is none of 1 to {_LAST_DEVICE}")
    if node_id + node_offset == host_node:
        raise CodecError(f"{name}: node id {host_node} is the host's")
    return can_id + node_offset
