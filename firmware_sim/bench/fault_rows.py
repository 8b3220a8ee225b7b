"""Rows of a scenario's faults: times, random draws, and effects on frames and values.

Each row draws from a stream of its own, which follows from the seed, the row's kind, node and frame or signal, and the
number of earlier rows that are alike in these. So rows that are added or removed, and changed numbers within a row,
leave the draws of the others unchanged. A row draws for each frame that it selects, whatever other rows do to that
frame.
"""

import random
from collections.abc import Callable, Sequence

from adacd_hil.settings.schema import ConfigError
from adacd_hil.wire.codec import Codec, CodecError, MessageCodec
from adacd_hil.wire.frame_lengths import CLASSIC_BYTES, FRAME_LENGTHS
from adacd_hil.wire.time_marks import NEVER_NS
from firmware_sim.arm.sensing import POSITION_LSB_RAD, TORQUE_COUNTS, VELOCITY_LSB_RAD_S
from firmware_sim.canopen.object_dictionary import ObjectDictionary
from firmware_sim.scenario.faults import BROADCAST, HOST, NODES, FaultSettings

EVERYBODY = -1
"""For `receive`: a frame that comes to all devices at once."""
ANY_FRAME = -1  # in place of an identifier
SIGNALS: dict[str, tuple[int, float | None]] = {
    "position": (0, POSITION_LSB_RAD),
    "velocity": (1, VELOCITY_LSB_RAD_S),
    "torque": (2, None),
}
"""Place of each signal among the measured values, and its count; a torque's is the sensor's."""
_INSTANT_KINDS = ("reboot", "drive_fault")
_INSTANT_NS = 1_000_000
"""How long a fault without length, such as a reboot, is active."""

Sent = list[tuple[int, bytes]]
Place = tuple[int, int]
"""Node and identifier."""


class FaultRow:
    """One of a scenario's faults, and its progress.

    hits_left: frames or values that it may still hit. sent: frames of its flood so far; of a drive fault 1 once the
    drive's failure is queued, 2 once its time is over. held: by identifier, frames to be overtaken. kept: stuck counts
    by node, or frozen counters by identifier.
    """

    def __init__(self, index: int, settings: FaultSettings, seed: str) -> None:
        self.index = index
        self.settings = settings
        self.draws = random.Random(seed)
        self.begin_ns = settings.onset_ns
        duration_ns = settings.duration_ns
        if settings.kind in _INSTANT_KINDS and not duration_ns:
            duration_ns = _INSTANT_NS
        self.end_ns = NEVER_NS if duration_ns is None else self.begin_ns + duration_ns
        self.is_active = self.is_over = False
        self.hits_left = NEVER_NS if settings.count is None else settings.count
        self.sent = 0
        self.held: dict[int, Sent] = {}
        self.kept: dict[int, int] = {}

    @property
    def next_ns(self) -> int:
        """Time at which the fault next begins or ends, ns on the clock of `begin_ns`; NEVER_NS once it is over."""
        return NEVER_NS if self.is_over else self.end_ns if self.is_active else self.begin_ns

    @property
    def flood_ns(self) -> int:
        """Time at which the next frame of a flood (`babble`, `emcy_storm`) is due, ns on the clock of `begin_ns`.

        NEVER_NS for other kinds, and once the fault has used up its count. It doesn't depend on `is_active`.
        """
        rate_Hz = self.settings.rate_Hz or 0.0
        return self.begin_ns + round(self.sent * 1e9 / rate_Hz) if rate_Hz and self.hits_left > 0 else NEVER_NS

    @property
    def due_ns(self) -> int:
        """Time at which the fault next begins, ends or, in a storm of EMCYs, sends one, ns on the clock of `begin_ns`.

        NEVER_NS once it is over.
        """
        is_storming = self.is_active and self.settings.kind == "emcy_storm"
        return min(self.next_ns, self.flood_ns) if is_storming else self.next_ns

    def hit(self) -> bool:
        """Return whether the fault hits the next frame or value, by its random chance.

        A hit uses up one of `hits_left`. False while inactive, and once `hits_left` is 0.
        """
        if self.hits_left <= 0 or not self.is_active:
            return False
        chance = self.settings.chance
        if chance < 1.0 and self.draws.random() >= chance:
            return False
        self.hits_left -= 1
        return True

    def late_ns(self) -> int:
        """Return by how much the fault delays a frame, ns: its delay plus a uniform jitter, drawn anew at each call."""
        settings = self.settings
        jitter_us = settings.jitter_us * self.draws.random() if settings.jitter_us else 0.0
        return round(((settings.delay_us or 0.0) + jitter_us) * 1e3)


def distort_value(row: FaultRow, node: int, counts: int, lsb: float) -> int:
    """Return a measured value in counts as a fault of kind stick, jump or saturate changes it, or as it is if not hit.

    stick: the first value hit of each node is kept, and each later hit returns it. jump: the step is added. saturate:
    the value is limited to ± the bound; without a bound a torque goes to the end of TORQUE_COUNTS on its side. A torque
    that jumps stays within TORQUE_COUNTS. A hit uses up one of the fault's count. node: index in NODES. lsb: one count
    in the unit of the signal.
    """
    settings = row.settings
    if not row.hit():
        return counts
    is_torque = settings.signal == "torque"
    if settings.kind == "stick":
        return row.kept.setdefault(node, counts)
    if settings.kind == "jump":
        moved = counts + round((settings.step or 0.0) / lsb)
        return min(max(moved, TORQUE_COUNTS[0]), TORQUE_COUNTS[1]) if is_torque else moved
    if settings.value is None:
        return TORQUE_COUNTS[counts >= 0]
    bound = round(settings.value / lsb)
    return min(max(counts, -bound), bound)


def _delay(row: FaultRow, _message: MessageCodec | None, frames: Sent) -> Sent:
    late_ns = row.late_ns()
    return [(delay_ns + late_ns, data) for delay_ns, data in frames]


def _flip(row: FaultRow, data: bytes) -> bytes:
    """Return data with the bits of the fault's mask flipped, as far as the mask and the data reach.

    Without a mask, flip its number of random bits, 1 if it has none and all at most.
    """
    settings = row.settings
    bits = int.from_bytes(data, "little")
    if settings.mask is not None:
        bits ^= int.from_bytes(bytes.fromhex(settings.mask)[: len(data)], "little")
    else:
        size = 8 * len(data)
        for bit in row.draws.sample(range(size), min(settings.bits or 1, size)):
            bits ^= 1 << bit
    return bits.to_bytes(len(data), "little")


def _freeze_counter(row: FaultRow, message: MessageCodec | None, frames: Sent) -> Sent:
    """Return protected frames with the counter of the first frame that was hit, and a CRC that fits.

    Frames of wrong length or without protection stay.
    """
    if message is None or message.profile is None:
        return frames
    changed = []
    for delay_ns, data in frames:
        frame = bytearray(data)
        if len(data) == message.length:
            counter = row.kept.setdefault(message.can_id, message.profile.counter_of(data))
            message.profile.sign(frame, counter, message.data_ids)
        changed.append((delay_ns, bytes(frame)))
    return changed


FRAME_CHANGES: dict[str, Callable[[FaultRow, MessageCodec | None, Sent], Sent]] = {
    "lose": lambda _row, _message, _frames: [],
    "duplicate": lambda _row, _message, frames: [frame for frame in frames for _ in range(2)],
    "delay": _delay,
    "corrupt": lambda row, _message, frames: [(delay_ns, _flip(row, data)) for delay_ns, data in frames],
    "freeze_counter": _freeze_counter,
}


def stream_seeds(rows: Sequence[FaultSettings], seed: int) -> list[str]:
    """Return the seed text of each fault's random numbers.

    Faults of the same kind, node, frame and signal get different seeds, by their order.
    """
    names = [f"{row.kind} {row.node} {row.frame} {row.signal}" for row in rows]
    return [f"{seed} {name} {names[: place + 1].count(name)}" for place, name in enumerate(names)]


def find_frames(codec: Codec, index: int, row: FaultSettings) -> frozenset[Place]:
    """Return (node, identifier) of the frames that a fault changes; no frame if it changes none.

    EVERYBODY is the node of a broadcast, ANY_FRAME the identifier of frame "any".

    Raises ConfigError if the contract lacks a frame, if a frame has no counter to freeze or ends before the bits of the
    mask, if no frame has the length of a flood's data, or if a wrong node id is the right one.
    """
    _check_flood(codec, index, row)
    if row.node_id is not None and row.node_id == codec.node_id(f"{(row.node or '').capitalize()}Heartbeat"):
        raise ConfigError(f"faults[{index}]: node_id = {row.node_id} is {row.node}'s own, without effect")
    if row.frame is None:
        return frozenset()
    if row.frame == "any":
        return frozenset((node, ANY_FRAME) for node in row.nodes)
    try:
        nodes = (EVERYBODY,) if row.is_broadcast else row.nodes
        found = [(node, codec.message(_message_name(row, node))) for node in nodes]
    except CodecError as error:
        raise ConfigError(f"faults[{index}]: frame {row.frame!r} is not in {codec.path.name}: {error}") from None
    for _, message in found:
        if row.kind == "freeze_counter" and not message.is_protected:
            raise ConfigError(f"faults[{index}]: {message.name} has no counter to freeze in {codec.path.name}")
        if row.mask is not None and not any(bytes.fromhex(row.mask)[: message.length]):
            place = f"the {message.length} bytes of {message.name}"
            raise ConfigError(f"faults[{index}]: mask = {row.mask!r} has no bit in {place}")
    return frozenset((node, message.can_id) for node, message in found)


def _check_flood(codec: Codec, index: int, row: FaultSettings) -> None:
    size = 0 if row.data is None else len(bytes.fromhex(row.data))
    lengths = FRAME_LENGTHS if codec.is_fd else FRAME_LENGTHS[: CLASSIC_BYTES + 1]
    if size not in lengths:
        expected = ", ".join(map(str, lengths[1:]))
        raise ConfigError(f"faults[{index}]: data has {size} bytes; frames of {codec.path.name} have {expected}")


def check_objects(rows: Sequence[FaultSettings], devices: Sequence[ObjectDictionary]) -> None:
    """Raise ConfigError if a fault's object is not in its device, or can't have the fault's value.

    devices: in the order of NODES.
    """
    for index, row in enumerate(rows):
        for place in row.nodes if row.kind == "object_value" else ():
            if problem := devices[place].describe_misfit(*row.object_key, row.raw or 0):
                raise ConfigError(f"faults[{index}]: {row.node}: {problem}")


def _message_name(row: FaultSettings, node: int) -> str:
    """Return the DBC's name of a fault's frame: from `sdo_request` of drive 1, for example, `Drive1SdoRequest`.

    Frames of BROADCAST have no sender in their name: `Sync`. node: place in NODES, not used for those and the host's.
    """
    sender = HOST if row.node == HOST else NODES[node]
    name = (row.frame or "").title().replace("_", "")
    return name if row.frame in BROADCAST else f"{sender.capitalize()}{name}"
