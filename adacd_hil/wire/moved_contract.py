"""Contracts with moved node ids.

A device's identifiers follow from its node id, the low seven bits. So a contract serves another arm on the bus, or a
host other than node 127, once its node ids are moved. NMT, SYNC and other identifiers without a node id stay; layouts,
data ids and names stay, too. Source: CiA 301 clause 7.3.3 (predefined connection set).
"""

import re
from pathlib import Path

from adacd_hil.wire.codec import Codec, CodecError
from adacd_hil.wire.contract_frames import HEARTBEAT_ID, HOST_HEARTBEAT, NODE_MASK
from adacd_hil.wire.dbc_contract import decode_dbc, parse_codec
from adacd_hil.wire.frame_lengths import MAX_STANDARD_ID

_LAST_DEVICE = 126
_STATEMENT = re.compile(
    r"""^(?P<head>\s*(?:BO_|BO_TX_BU_|VAL_|SIG_VALTYPE_|SIG_GROUP_|SG_MUL_VAL_|CM_\s+(?:BO_|SG_)"""
    r"""|BA_\s+"\w+"\s+(?:BO_|SG_))\s+)(?P<id>\d+)\b""",
    re.MULTILINE,
)
"""Matches a DBC statement about one message, up to its identifier."""


def move_contract(codec: Codec, node_offset: int, host_node: int | None = None) -> Codec:
    """Return the contract with `node_offset` added to the devices' node ids, and the host at `host_node` if given.

    Its path is the file's name alone, since it has no file yet. Without a change the same object is returned. Raises
    CodecError without the host's heartbeat, for a device's 29-bit identifier, and for a device's node id outside 1 to
    126 or equal to the host's.
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
    """Return a device's CAN identifier with `node_offset` added to its node id; one without a node id stays.

    Raises CodecError, which begins with `name`, for a 29-bit identifier, a node id outside 1 to 126, and the host's.
    """
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
