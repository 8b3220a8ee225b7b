"""What passed at the host's end of a bus, and what it means by the DBC: a witness that shares no code with the host.

Messages are read from the DBC by cantools; signals and both AUTOSAR CRCs are computed here, column by column. Bits
count from bit 0 of byte 0, little-endian, as docs/protocol.md says.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any, NamedTuple

import cantools
import numpy as np
from numpy.typing import NDArray

from adacd_hil.clock import Clock
from adacd_hil.wire.bus import Bus, Frame, Tap

Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

SYNC, NMT = 0x080, 0x000
LONGEST = 64


class Passed(NamedTuple):
    """One frame at the host's end; `is_sent`: by the host, at the time when it was handed over."""

    t_ns: int
    is_sent: bool
    can_id: int
    data: bytes


class OverdueError(Exception):
    """A run that should have ended long ago."""


class WitnessBus(Tap):
    """Passes everything on and remembers it, in the order in which the host sent and read it.

    `limit_ns`: when the clock is past it, the next frame to send raises OverdueError.
    """

    def __init__(self, bus: Bus, clock: Clock) -> None:
        super().__init__(bus, clock)
        self.passed: list[Passed] = []
        self.limit_ns = 1 << 62
        self.syncs = 0
        """How many SYNCs the host has sent."""

    def send(self, can_id: int, data: bytes) -> None:
        """Remember and send a frame. Raises BusError, OverdueError."""
        self._remember(can_id, data)
        self._bus.send(can_id, data)

    def send_all(self, frames: Sequence[tuple[int, bytes]]) -> None:
        """Remember and send some frames. Raises BusError, OverdueError."""
        for can_id, data in frames:
            self._remember(can_id, data)
        self._bus.send_all(frames)

    def receive(self, timeout_s: float) -> Frame | None:
        """Receive and remember a frame. Raises BusError."""
        frame = self._bus.receive(timeout_s)
        if frame is not None and not frame.is_error:
            self.passed.append(Passed(frame.t_ns, False, frame.can_id, frame.data))
        return frame

    def _remember(self, can_id: int, data: bytes) -> None:
        t_ns = self._clock.now_ns()
        if t_ns > self.limit_ns:
            raise OverdueError(f"still running at {t_ns * 1e-9:.1f} s, {self.limit_ns * 1e-9:.1f} s allowed")
        self.passed.append(Passed(t_ns, True, can_id, data))
        self.syncs += can_id == SYNC


@dataclass(frozen=True)
class Sight:
    """All frames of one message, by the order of the record: column arrays of the same length n."""

    place: Ints  # index among all frames of the record
    t_ns: Ints
    cycle: Ints  # SYNCs that the host had sent before, less one; -1 before the first
    length: Ints  # bytes
    is_right: Bools  # length, and CRC where the message has one
    is_fresh: Bools  # right, and with another counter than the one before, where it has one
    signals: dict[str, NDArray[np.float64]]  # raw value × scale; NaN where the frame is too short

    def __len__(self) -> int:
        return len(self.place)

    def last_before(self, places: Ints, among: Bools | None = None) -> Ints:
        """Return, for each place in the record, the index here of the last frame before it; -1 for none."""
        chosen = np.arange(len(self)) if among is None else np.flatnonzero(among)
        found = np.searchsorted(self.place[chosen], places) - 1
        return np.where(found >= 0, chosen[np.maximum(found, 0)], -1) if len(chosen) else np.full(len(places), -1)


@cache
def _database(text: bytes) -> Any:
    return cantools.database.load_string(text.decode("cp1252"), "dbc", strict=False)


class WireRecord:
    """A run on the wire."""

    def __init__(self, dbc: Path | bytes, passed: Sequence[Passed]) -> None:
        """Read the contract and sort the frames."""
        self.database = _database(dbc if isinstance(dbc, bytes) else dbc.read_bytes())
        self.passed = passed
        self.t_ns = np.array([frame.t_ns for frame in passed], np.int64)
        self.can_id = np.array([frame.can_id for frame in passed], np.int64)
        self.is_sent = np.array([frame.is_sent for frame in passed], np.bool_)
        is_sync = self.is_sent & (self.can_id == SYNC)
        self.cycle = np.cumsum(is_sync) - 1
        """Of each frame: which SYNC of the host it follows, counted over the whole record from 0."""
        self.sync_place = np.flatnonzero(is_sync)
        self.sync_t_ns = self.t_ns[is_sync]
        self._sights: dict[str, Sight] = {}

    def __getitem__(self, name: str) -> Sight:
        """Return all frames of a DBC message; empty where the contract hasn't got it."""
        if name not in self._sights:
            self._sights[name] = self._sight(name)
        return self._sights[name]

    def has(self, name: str) -> bool:
        """Whether the contract has a message."""
        return any(message.name == name for message in self.database.messages)

    def has_signal(self, name: str, signal: str) -> bool:
        """Whether the contract has a signal."""
        if not self.has(name):
            return False
        return any(known.name == signal for known in self.database.get_message_by_name(name).signals)

    @cached_property
    def boots(self) -> Ints:
        """Places at which the host resets nodes (NMT reset node, reset communication), the first of each burst.

        A shared bus has one reset per node; those that follow each other without SYNC in between are one boot.
        """
        resets = [
            place
            for place in np.flatnonzero(self.is_sent & (self.can_id == NMT)).tolist()
            if self.passed[place].data[:1] in (b"\x81", b"\x82")
        ]
        kept: list[int] = []
        for place in resets:
            if not kept or self.cycle[place] != self.cycle[kept[-1]]:
                kept.append(place)
        return np.array(kept, np.int64)

    def attempt(self, places: Ints) -> Ints:
        """Return which boot each place follows; -1 before the first."""
        return np.asarray(np.searchsorted(self.boots, places, side="right") - 1, np.int64)

    def _sight(self, name: str) -> Sight:
        if not self.has(name):
            none = np.zeros(0, np.int64)
            return Sight(none, none, none, none, none.astype(bool), none.astype(bool), {})
        message = self.database.get_message_by_name(name)
        is_sent = "HOST" in message.senders
        place = np.flatnonzero((self.can_id == message.frame_id) & (self.is_sent == is_sent))
        frames = [self.passed[index].data for index in place.tolist()]
        length = np.array([len(data) for data in frames], np.int64)
        padded = b"".join(data.ljust(LONGEST, b"\0")[:LONGEST] for data in frames)
        columns = np.frombuffer(padded, np.uint8).reshape(len(frames), LONGEST)
        is_right = length == message.length
        is_fresh = is_right.copy()
        ids = data_ids(message)
        if ids:
            is_right &= crc_of(columns[:, : message.length], ids) == received_crc(columns, ids)
            counters = columns[:, 1] & 0x0F if len(ids) == PROFILE_2_IDS else columns[:, 2]
            is_fresh = is_right & _differs_from_last(counters, is_right)
        signals = {signal.name: extract(columns, signal, length) for signal in message.signals}
        return Sight(place, self.t_ns[place], self.cycle[place], length, is_right, is_fresh, signals)


def _differs_from_last(counters: NDArray[np.uint8], is_right: Bools) -> Bools:
    """Tell of each right frame whether its counter is another than that of the right frame before it."""
    differs = np.ones(len(counters), np.bool_)
    right = np.flatnonzero(is_right)
    differs[right[1:]] = counters[right[1:]] != counters[right[:-1]]
    return differs


def extract(columns: NDArray[np.uint8], signal: Any, length: Ints) -> NDArray[np.float64]:
    """Read one little-endian signal of all frames; `columns` (n, bytes)."""
    if signal.byte_order != "little_endian":
        raise ValueError(f"signal {signal.name} is big-endian, which no contract of ours has")
    first, last = signal.start // 8, (signal.start + signal.length - 1) // 8
    raw = np.zeros(len(columns), np.uint64)
    for offset, byte in enumerate(range(first, last + 1)):
        raw |= columns[:, byte].astype(np.uint64) << np.uint64(8 * offset)
    raw = (raw >> np.uint64(signal.start % 8)) & np.uint64((1 << signal.length) - 1)
    value = raw.astype(np.int64)
    if signal.is_signed:
        value = np.where(value >= 1 << (signal.length - 1), value - (1 << signal.length), value)
    scaled = value * float(signal.scale) + float(signal.offset)
    return np.where(length > last, scaled, np.nan)


PROFILE_2_IDS = 16
"""Data ids of a message by AUTOSAR Profile 2, one byte for each counter; Profile 5 has one of two bytes."""


def data_ids(message: Any) -> bytes:
    """Return the data ids of a DBC message: 16 bytes (Profile 2), 2 bytes, low one first (Profile 5), or none."""
    attributes = message.dbc.attributes if message.dbc is not None else {}
    if "E2EDataIdList" in attributes:
        return bytes.fromhex(str(attributes["E2EDataIdList"].value))
    if "E2EDataId" in attributes:
        return int(attributes["E2EDataId"].value).to_bytes(2, "little")
    return b""


def received_crc(columns: NDArray[np.uint8], ids: bytes) -> Ints:
    """Return the CRC that each frame carries."""
    if len(ids) == PROFILE_2_IDS:
        return columns[:, 0].astype(np.int64)
    return columns[:, 0].astype(np.int64) | columns[:, 1].astype(np.int64) << 8


def crc_of(columns: NDArray[np.uint8], ids: bytes) -> Ints:
    """Compute the CRC that each frame should carry; `columns` (n, bytes of the message)."""
    count = len(columns)
    if len(ids) == PROFILE_2_IDS:
        crc = np.full(count, 0xFF, np.int64)
        chosen = np.frombuffer(ids, np.uint8)[columns[:, 1] & 0x0F]
        for byte in [*columns[:, 1:].T, chosen]:
            crc = _CRC8[crc ^ byte]
        return crc ^ 0xFF
    crc = np.full(count, 0xFFFF, np.int64)
    for byte in [*columns[:, 2:].T, *(np.full(count, value, np.uint8) for value in ids)]:
        crc = ((crc << 8) & 0xFFFF) ^ _CRC16[(crc >> 8) ^ byte]
    return crc


def _table(polynomial: int, bits: int) -> Ints:
    """Make the table of a CRC that shifts left."""
    top, mask = 1 << (bits - 1), (1 << bits) - 1
    table = []
    for byte in range(256):
        crc = byte << (bits - 8)
        for _ in range(8):
            crc = ((crc << 1) ^ polynomial if crc & top else crc << 1) & mask
        table.append(crc)
    return np.array(table, np.int64)


_CRC8 = _table(0x2F, 8)
_CRC16 = _table(0x1021, 16)


def write_candump(path: Path, passed: Sequence[Passed]) -> None:
    """Write a record as candump would, the host's frames as sent (T), the devices' as received (R)."""
    lines = []
    for t_ns, is_sent, can_id, data in passed:
        mark = "##5" if len(data) > 8 else "#"
        way = "T" if is_sent else "R"
        lines.append(
            f"({t_ns // 1_000_000_000}.{t_ns // 1000 % 1_000_000:06d}) wire {can_id:03X}{mark}{data.hex()} {way}"
        )
    path.write_text("\n".join(lines) + "\n")
