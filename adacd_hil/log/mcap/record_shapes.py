"""The shapes of MCAP's records: which of them can be told from damage by their length alone.

A record repeats its length: what its strings, maps and arrays say they hold must fill it exactly. In random bytes that
happens once in 2^72 and more, so that it says where records go on after damage. A message record has no such shape.
"""

from collections.abc import Callable

from mcap.opcode import Opcode

_TEXT = _TABLE = -4  # a length of 4 bytes, then so many bytes
_DATA = -8  # a length of 8 bytes, then so many bytes

_SHAPES: dict[int, tuple[int, ...]] = {
    Opcode.HEADER: (_TEXT, _TEXT),
    Opcode.FOOTER: (20,),
    Opcode.SCHEMA: (2, _TEXT, _TEXT, _TABLE),
    Opcode.CHANNEL: (4, _TEXT, _TEXT, _TABLE),
    Opcode.CHUNK: (28, _TEXT, _DATA),
    Opcode.MESSAGE_INDEX: (2, _TABLE),
    Opcode.CHUNK_INDEX: (32, _TABLE, 8, _TEXT, 16),
    Opcode.ATTACHMENT: (16, _TEXT, _TEXT, _DATA, 4),
    Opcode.ATTACHMENT_INDEX: (40, _TEXT, _TEXT),
    Opcode.STATISTICS: (42, _TABLE),
    Opcode.METADATA: (_TEXT, _TABLE),
    Opcode.METADATA_INDEX: (16, _TEXT),
    Opcode.SUMMARY_OFFSET: (17,),
    Opcode.DATA_END: (4,),
}
LEAST_MESSAGE = 22
"""Bytes of a message record without payload, without opcode and length."""


def has_shape(opcode: int) -> bool:
    """Say whether records of this kind repeat their length."""
    return opcode in _SHAPES


def fits(opcode: int, length: int, read: Callable[[int, int], bytes]) -> bool:
    """Say whether a record of this kind can be `length` bytes long; `read` gives bytes of it, by place and count."""
    if opcode not in _SHAPES:
        return opcode == Opcode.MESSAGE and length >= LEAST_MESSAGE
    position = 0
    for part in _SHAPES[opcode]:
        if part > 0:
            position += part
            continue
        prefix = read(position, -part)
        position += -part + int.from_bytes(prefix, "little")
        if position > length or len(prefix) < -part:
            return False
    return position == length
