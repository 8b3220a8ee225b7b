"""What the writer tells the process of the live view: once at its start, then batch by batch."""

import json
import struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.log.setup import Setup

_HEAD = struct.Struct("<Q")


class Batch(NamedTuple):
    """Message records that follow each other, as the writer lays them down for the file.

    records: their bytes (b,) uint8; channels: the file's numbers (n,) uint16; log_ns: log times (n,) int64; ends: where
    each record ends (n,) int64.
    """

    records: NDArray[np.uint8]
    channels: NDArray[np.uint16]
    log_ns: NDArray[np.int64]
    ends: NDArray[np.int64]


class Told(NamedTuple):
    """ids: the file's number of each channel, by ours; start_ns: log time before the first record."""

    setup: Setup
    ids: dict[int, int]
    start_ns: int

    def to_json(self) -> bytes:
        """Write it."""
        table = {"setup": self.setup.to_json().decode(), "ids": self.ids, "start_ns": self.start_ns}
        return json.dumps(table).encode()

    @staticmethod
    def from_json(text: bytes) -> "Told":
        """Read it."""
        table = json.loads(text)
        ids = {int(ours): number for ours, number in table["ids"].items()}
        return Told(Setup.from_json(table["setup"].encode()), ids, table["start_ns"])


def pack_batch(batch: Batch) -> bytes:
    """Write a batch: the number of its records, their times, ends and channels, then their bytes."""
    columns = (batch.log_ns, batch.ends, batch.channels, batch.records)
    return _HEAD.pack(len(batch.ends)) + b"".join(column.tobytes() for column in columns)


def unpack_batch(data: bytes) -> Batch:
    """Read it; no bytes are copied."""
    (count,) = _HEAD.unpack_from(data)
    place = _HEAD.size
    log_ns = np.frombuffer(data, np.int64, count, place)
    ends = np.frombuffer(data, np.int64, count, place + 8 * count)
    channels = np.frombuffer(data, np.uint16, count, place + 16 * count)
    records = np.frombuffer(data, np.uint8, -1, place + 18 * count)
    return Batch(records, channels, log_ns, ends)
