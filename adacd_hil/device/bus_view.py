"""What a listener sees of a bus: nodes with their NMT state, messages with rate, age, checks and values, load.

Sends nothing. Everything is counted frame by frame; values are decoded when a `Snapshot` is asked for.
"""

from collections import deque
from dataclasses import dataclass

from adacd_hil.device.survey import NMT_STATES, message_name
from adacd_hil.wire.bus import MAX_STANDARD_ID, Frame
from adacd_hil.wire.codec import Codec, MessageCodec
from adacd_hil.wire.contract_frames import HEARTBEAT_ID
from adacd_hil.wire.e2e import E2eStatus
from adacd_hil.wire.traffic import LoadMeter

_WINDOW_NS = 1_000_000_000
"""Rates are means over one to two of these."""


@dataclass(frozen=True)
class NodeView:
    """One node. state: as its last heartbeat says; age in s since then."""

    node_id: int
    name: str
    state: str
    age_s: float


@dataclass(frozen=True)
class MessageView:
    """One identifier. `values`: (signal, value, unit) of the last frame that passed its checks; empty if unknown.

    lost: frames that a counter shows to be missing, as occasions. errors: frames that failed a check. is_protected:
    whether there is a check at all.
    """

    can_id: int
    name: str
    is_known: bool
    is_protected: bool
    count: int
    rate_Hz: float
    age_s: float
    lost: int
    errors: int
    data: bytes
    values: tuple[tuple[str, float, str], ...]


@dataclass(frozen=True)
class Snapshot:
    """The bus as seen up to now. load: percent, since the snapshot before.

    strange_frames: of a length that the contract's bus can't carry; the load leaves them out.
    """

    frames: int
    error_frames: int
    strange_frames: int
    load_percent: float
    nodes: list[NodeView]
    messages: list[MessageView]


class _Entry:
    """One identifier's frames so far."""

    def __init__(self, message: MessageCodec | None) -> None:
        self.message = message
        self.receiver = message.receiver() if message is not None and message.is_protected else None
        self.count = 0
        self.last_ns = 0
        self.wrong_lengths = 0
        self.data = b""
        self.valid: bytes | None = None

    def accept(self, frame: Frame) -> None:
        self.count += 1
        self.last_ns = frame.t_ns
        self.data = frame.data
        if self.message is None:
            return
        if len(frame.data) != self.message.length:
            self.wrong_lengths += 1
        elif self.receiver is None or self.receiver.check(frame.data).is_valid:
            self.valid = frame.data

    @property
    def lost(self) -> int:
        return 0 if self.receiver is None else self.receiver.counts[E2eStatus.OK_SOME_LOST]

    @property
    def errors(self) -> int:
        if self.receiver is None:
            return self.wrong_lengths
        counts = dict(self.receiver.tally())
        return self.wrong_lengths + sum(count for status, count in counts.items() if not status.is_valid)


class BusView:
    """Takes in every frame of a bus."""

    def __init__(self, codec: Codec, bitrate: int, data_bitrate: int, t_ns: int) -> None:
        """Begin at `t_ns`; the bit rates in bit/s are for the load."""
        self.frames = 0
        self._codec = codec
        self._load = LoadMeter(bitrate, data_bitrate, t_ns)
        self._entries: dict[int, _Entry] = {}
        self._error_frames = 0
        self._marks: deque[tuple[int, dict[int, int]]] = deque([(t_ns, {})], maxlen=2)
        self._strange_frames = 0

    def accept(self, frame: Frame) -> None:
        """Take in one frame."""
        self.frames += 1
        if frame.is_error:
            self._error_frames += 1
            return
        try:
            self._load.add(frame)
        except ValueError:  # a length that the contract's bus can't carry
            self._strange_frames += 1
        entry = self._entries.get(frame.can_id)
        if entry is None:
            entry = self._entries[frame.can_id] = _Entry(self._codec.by_id.get(frame.can_id))
        entry.accept(frame)

    def skip_loss(self) -> None:
        """Note that this computer has lost frames: counters that jump now are no device's fault."""
        for entry in self._entries.values():
            if entry.receiver is not None:
                entry.receiver.restart()

    def snapshot(self, t_ns: int, node_id: int | None = None) -> Snapshot:
        """Sum up at `t_ns`; with `node_id`, only that node's part of it."""
        mark_ns, counts = self._marks[0]
        elapsed_s = (t_ns - mark_ns) * 1e-9
        wanted = {
            can_id: self._entries[can_id]
            for can_id in sorted(self._entries)
            if node_id is None or (can_id <= MAX_STANDARD_ID and can_id & 0x7F == node_id)
        }
        snapshot = Snapshot(
            frames=self.frames,
            error_frames=self._error_frames,
            strange_frames=self._strange_frames,
            load_percent=self._load.take(t_ns).percent,
            nodes=[
                self._node(can_id & 0x7F, entry, t_ns)
                for can_id, entry in wanted.items()
                if can_id & ~0x7F == HEARTBEAT_ID and can_id != HEARTBEAT_ID
            ],
            messages=[
                self._message(
                    can_id, entry, t_ns, (entry.count - counts.get(can_id, 0)) / elapsed_s if elapsed_s else 0
                )
                for can_id, entry in wanted.items()
            ],
        )
        if t_ns - self._marks[-1][0] >= _WINDOW_NS:
            self._marks.append((t_ns, {can_id: entry.count for can_id, entry in self._entries.items()}))
        return snapshot

    def _node(self, node_id: int, entry: _Entry, t_ns: int) -> NodeView:
        state = entry.data[0] & 0x7F if entry.data else -1
        name = message_name(self._codec, HEARTBEAT_ID + node_id).removesuffix("Heartbeat")
        name = "" if name.startswith("(") else name
        return NodeView(node_id, name, NMT_STATES.get(state, "unknown"), (t_ns - entry.last_ns) * 1e-9)

    def _message(self, can_id: int, entry: _Entry, t_ns: int, rate_Hz: float) -> MessageView:
        message = entry.message
        values: tuple[tuple[str, float, str], ...] = ()
        if message is not None and entry.valid is not None:
            decoded = message.decode_values(entry.valid)
            values = tuple(
                (signal.name, value, signal.unit) for signal, value in zip(message.values, decoded, strict=True)
            )
        return MessageView(
            can_id=can_id,
            name=message_name(self._codec, can_id),
            is_known=message is not None,
            is_protected=entry.receiver is not None,
            count=entry.count,
            rate_Hz=rate_Hz,
            age_s=(t_ns - entry.last_ns) * 1e-9,
            lost=entry.lost,
            errors=entry.errors,
            data=entry.data,
            values=values,
        )
