"""What opened chunks hold: definitions, and where the messages are.

Only to find where each record begins takes a step per message; everything else is done for all of them at once.
"""

import struct
from collections.abc import Sequence
from itertools import accumulate, pairwise
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from adacd_hil.log.chunked_file import INDEX_ENTRY
from adacd_hil.log.mcap.mcap_records import HEAD, MESSAGE_HEAD, RawRecord

_DEFINITIONS = (Opcode.SCHEMA, Opcode.CHANNEL)
_START = struct.Struct("<BQ")
_LEAST_LENGTH = MESSAGE_HEAD - HEAD.size
_MESSAGE = np.dtype(
    {
        "names": ["opcode", "length", "channel", "log_time", "publish_time"],
        "formats": ["u1", "<i8", "<u2", "<u8", "<u8"],
        "offsets": [0, 1, 9, 15, 23],
        "itemsize": MESSAGE_HEAD,
    }
)
_PADDING = 128
"""Behind chunks: a record whose size varies is taken as if it were the longest, which has 64 bytes of data."""


Data: TypeAlias = bytes | bytearray


class Contents(NamedTuple):
    """The records of chunks. Messages as columns (n,): their numbers of channels, times, and where they are."""

    data: Data
    definitions: list[RawRecord]  # schemas and channels; `offset`: where they are in the data
    strangers: list[int]  # opcodes of what has no place in a chunk; Message: one that is too short to be one
    breaks: list[int]  # where what follows is no record, up to the end of the chunk
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

    def payload(self, message: int) -> bytes:
        """Copy the payload of a message."""
        return bytes(self.data[self.starts[message] + MESSAGE_HEAD : self.ends[message]])

    def rows(self, starts: NDArray[np.int64], size: int) -> NDArray[np.uint8]:
        """Copy the `size` bytes from each of `starts` on, (n, size)."""
        return _windows(self.data, size)[starts].view(np.uint8).reshape(len(starts), size)


def read_contents(data: bytes) -> Contents:
    """Find the records of an opened chunk."""
    return _walk_through(data, (len(data),))


def read_chunks(chunks: Sequence[bytes], indexes: Sequence[bytes], memory: bytearray) -> Contents:
    """Find the records of opened chunks, one after the other; bytes of no meaning follow the last.

    indexes: the entries of all message indexes of each chunk; without them, and where they are wrong, each record
    takes a step. memory: holds the chunks from now on, unless it is too small.
    """
    ends = list(accumulate(map(len, chunks)))
    size = (ends[-1] if ends else 0) + _PADDING
    if len(memory) < size:
        memory = bytearray(size)
    for end, chunk in zip(ends, chunks, strict=True):
        memory[end - len(chunk) : end] = chunk
    indexed = _indexed(memory, ends, indexes)
    return _walk_through(memory, ends) if indexed is None else indexed


def _indexed(data: Data, ends: Sequence[int], indexes: Sequence[bytes]) -> Contents | None:
    """Take where messages begin from the indexes; None where these leave out anything that chunks hold."""
    if not indexes or not all(index and len(index) % INDEX_ENTRY.itemsize == 0 for index in indexes):
        return None
    pairs = zip(indexes, (0, *ends[:-1]), strict=True)
    offsets = [np.frombuffer(index, INDEX_ENTRY)["offset"] + first for index, first in pairs]
    starts = np.sort(np.concatenate(offsets).view(np.int64), kind="stable")
    if starts[0] != 0 or starts[-1] > ends[-1] - MESSAGE_HEAD:
        return None
    heads = _windows(data, MESSAGE_HEAD)[starts].view(_MESSAGE)
    contents = _contents(data, [], [], [], starts, heads)
    is_message = (heads["opcode"] == Opcode.MESSAGE) & (heads["length"] >= _LEAST_LENGTH)
    is_filled = np.array_equal(contents.ends[:-1], starts[1:]) and contents.ends[-1] == ends[-1]
    if not is_filled or not is_message.all():
        return None
    lasts = contents.ends[np.searchsorted(contents.ends, ends)]
    return contents if np.array_equal(lasts, ends) else None


def _walk_through(data: Data, ends: Sequence[int]) -> Contents:
    """Find the records of chunks step by step."""
    definitions: list[RawRecord] = []
    strangers: list[int] = []
    breaks: list[int] = []
    starts: list[int] = []
    unpack, add = _START.unpack_from, starts.append
    message, head, least = int(Opcode.MESSAGE), HEAD.size, _LEAST_LENGTH
    for first, size in pairwise((0, *ends)):
        position = first
        while position + head <= size:
            opcode, length = unpack(data, position)
            end = position + head + length
            if end > size:
                break
            if opcode == message and length >= least:
                add(position)
            elif opcode in _DEFINITIONS:
                definitions.append(RawRecord(position, opcode, bytes(data[position + head : end])))
            else:
                strangers.append(opcode)
            position = end
        if position < size:
            breaks.append(position)
    return _found(data, definitions, strangers, breaks, np.array(starts, np.int64))


def message_contents(record: RawRecord) -> Contents:
    """Take a message outside of chunks as a chunk of its own."""
    data = HEAD.pack(record.opcode, len(record.body)) + record.body
    return _found(data, [], [], [], np.zeros(1, np.int64))


def _found(
    data: Data,
    definitions: list[RawRecord],
    strangers: list[int],
    breaks: list[int],
    starts: NDArray[np.int64],
) -> Contents:
    heads = _windows(data, MESSAGE_HEAD)[starts].view(_MESSAGE) if len(starts) else np.empty(0, _MESSAGE)
    return _contents(data, definitions, strangers, breaks, starts, heads)


def _contents(
    data: Data,
    definitions: list[RawRecord],
    strangers: list[int],
    breaks: list[int],
    starts: NDArray[np.int64],
    heads: NDArray[Any],
) -> Contents:
    ends = starts + heads["length"] + HEAD.size
    channels, log_times, publish_times = (heads[name].copy() for name in ("channel", "log_time", "publish_time"))
    return Contents(data, definitions, strangers, breaks, starts, ends, channels, log_times, publish_times)


def _windows(data: Data, size: int) -> NDArray[Any]:
    """View the `size` bytes that begin at each byte as one item."""
    windows: NDArray[Any] = np.ndarray((max(0, len(data) - size + 1),), f"V{size}", data, strides=(1,))
    return windows
