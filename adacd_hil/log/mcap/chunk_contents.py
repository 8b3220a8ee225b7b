"""What a chunk holds, opened: definitions, and where its messages are.

Only to find where each record begins takes a step per message; everything else is done for all of them at once.
"""

import struct
from typing import Any, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from adacd_hil.log.chunked_file import INDEX_ENTRY
from adacd_hil.log.mcap.records import HEAD, MESSAGE_HEAD, RawRecord

_DEFINITIONS = (Opcode.SCHEMA, Opcode.CHANNEL)
_START = struct.Struct("<BQ")
_MESSAGE = np.dtype(
    {
        "names": ["channel", "log_time", "publish_time"],
        "formats": ["<u2", "<u8", "<u8"],
        "offsets": [9, 15, 23],
        "itemsize": MESSAGE_HEAD,
    }
)


class Contents(NamedTuple):
    """The records of a chunk. Messages as columns (n,): their numbers of channels, times, and where they are."""

    data: bytes
    definitions: list[RawRecord]  # schemas and channels
    strangers: list[int]  # opcodes of what has no place in a chunk
    rest: int  # bytes at the end that are no record
    starts: NDArray[np.int64]
    ends: NDArray[np.int64]
    channels: NDArray[np.uint16]
    log_times: NDArray[np.uint64]
    publish_times: NDArray[np.uint64]

    @property
    def entries(self) -> NDArray[Any]:
        """What the message indexes must say of the messages."""
        entries = np.empty(len(self.starts), INDEX_ENTRY)
        entries["log_time"] = self.log_times
        entries["offset"] = self.starts
        return entries


def read_contents(data: bytes) -> Contents:
    """Find the records of an opened chunk."""
    definitions, strangers = [], []
    starts: list[int] = []
    unpack, add = _START.unpack_from, starts.append
    message, head, least = int(Opcode.MESSAGE), HEAD.size, MESSAGE_HEAD - HEAD.size
    position, size = 0, len(data)
    while position + head <= size:
        opcode, length = unpack(data, position)
        end = position + head + length
        if end > size or (opcode == message and length < least):
            break
        if opcode == message:
            add(position)
        elif opcode in _DEFINITIONS:
            definitions.append(RawRecord(position, opcode, data[position + head : end]))
        else:
            strangers.append(opcode)
        position = end
    return _contents(data, definitions, strangers, size - position, np.array(starts, np.int64))


def message_contents(record: RawRecord) -> Contents:
    """Take a message outside of chunks as a chunk of its own."""
    data = HEAD.pack(record.opcode, len(record.body)) + record.body
    return _contents(data, [], [], 0, np.zeros(1, np.int64))


def _contents(
    data: bytes, definitions: list[RawRecord], strangers: list[int], rest: int, starts: NDArray[np.int64]
) -> Contents:
    rows = np.empty(0, _MESSAGE)
    lengths = np.empty(0, np.uint64)
    if len(starts):
        windows = np.lib.stride_tricks.sliding_window_view(np.frombuffer(data, np.uint8), MESSAGE_HEAD)[starts]
        rows = windows.view(_MESSAGE)[:, 0]
        lengths = np.ascontiguousarray(windows[:, 1:9]).view(np.uint64)[:, 0]
    ends = starts + lengths.astype(np.int64) + HEAD.size
    channels, log_times, publish_times = (rows[name].copy() for name in ("channel", "log_time", "publish_time"))
    return Contents(data, definitions, strangers, rest, starts, ends, channels, log_times, publish_times)
