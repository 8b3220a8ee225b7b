"""Faults of a scenario: one timed row each; its kind determines its keys.

A row acts from `at_s` for `duration_s`, or until it has acted `count` times, or, with neither, to the end. `fault_plan`
has the row's effect on frames, values and nodes. A reboot or drive fault without duration is active for 1 ms.

Nodes are named drive1, drive2, sensor1, sensor2; frames by their content, as in the contract's DBC.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

from adacd_hil.remedies import nearest_name
from adacd_hil.settings.schema import ConfigError, setting
from adacd_hil.wire.codec import MessageCodec

DRIVES = ("drive1", "drive2")
SENSORS = ("sensor1", "sensor2")
NODES = DRIVES + SENSORS
"""In the order of a bench's devices."""
ALL, HOST = "all", "host"
MOST_ROWS = 53
"""Bits that a float64 holds: the truth's field `faults` has one for each row."""

FRAME_NODES: Mapping[str, tuple[str, ...]] = {
    "feedback": (*DRIVES, ALL),
    "torque": (*SENSORS, ALL),
    "status": (*NODES, ALL),
    "command": (*DRIVES, ALL),
    "heartbeat": (*NODES, ALL, HOST),
    "emcy": (*NODES, ALL),
    "sync": (*NODES, ALL),
    "nmt": (*NODES, ALL),
    "sdo_request": (*NODES, ALL),
    "sdo_response": (*NODES, ALL),
    "any": (*NODES, ALL),
}
"""Nodes that can have each frame; `any` is every frame that the node sends. SYNC, NMT and the host's heartbeat come to
all devices at once, the other frames of the host to one node."""
BROADCAST = ("sync", "nmt")
_OF_HOST = ("command", "sdo_request", *BROADCAST)
SIGNAL_NODES = {"position": DRIVES, "velocity": DRIVES, "torque": SENSORS}
SINCE = ("enabled", "power_on")

_FRAMES = tuple(FRAME_NODES)
_TIMED = ("kind", "at_s", "since")
_END = ("duration_s", "count")
_LONGEST = 64  # bytes of a mask or of a flood's frame
_IDLE_AT_0 = ("probability", "delay_us", "step", "drift_ppm")
"""Keys with which a fault never acts if they are 0; of `delay_us` unless there is a `jitter_us`."""
_COUNTED = ("feedback", "torque", "command")


class _Kind(NamedTuple):
    """A kind of fault: its keys besides `kind`, `at_s` and `since`, and the nodes and frames that it can affect.

    is_timed: False: it lasts from power-on and has no `at_s`.
    """

    required: tuple[str, ...]
    optional: tuple[str, ...] = ()
    nodes: tuple[str, ...] = NODES
    frames: tuple[str, ...] = ()
    is_timed: bool = True

    @property
    def keys(self) -> tuple[str, ...]:
        return ((*_TIMED,) if self.is_timed else ("kind",)) + self.required + self.optional


_ONCE_SENT = tuple(frame for frame in _FRAMES if frame != "sync")  # a SYNC has its own kind
_IN_SEQUENCE = ("feedback", "torque", "status", "command", "heartbeat", "emcy")

KINDS: Mapping[str, _Kind] = {
    "lose": _Kind(("frame",), ("node", "probability", *_END), frames=_FRAMES),
    "duplicate": _Kind(("frame",), ("node", "probability", *_END), frames=_FRAMES),
    "delay": _Kind(("frame", "delay_us"), ("node", "jitter_us", "probability", *_END), frames=_ONCE_SENT),
    "reorder": _Kind(("frame",), ("node", "probability", *_END), frames=_IN_SEQUENCE),
    "corrupt": _Kind(("frame",), ("node", "bits", "mask", "probability", *_END), frames=_ONCE_SENT),
    "freeze_counter": _Kind(("node", "frame"), _END, frames=_COUNTED),
    "stick": _Kind(("node", "signal"), _END),
    "jump": _Kind(("node", "signal", "step"), ("probability", *_END)),
    "saturate": _Kind(("node", "signal"), ("value", *_END)),
    "reboot": _Kind(("node",), ("duration_s",)),
    "emcy_storm": _Kind(("node", "code", "rate_Hz"), _END),
    "babble": _Kind(("node", "can_id", "rate_Hz"), ("data", *_END)),
    "bus_off": _Kind(("node",), ("duration_s",)),
    "wrong_node_id": _Kind(("node", "node_id"), is_timed=False),
    "duplicate_node_id": _Kind(("node", "same_as"), is_timed=False),
    "late_sync": _Kind(("delay_us",), ("jitter_us", "probability", *_END)),
    "clock_drift": _Kind(("node", "drift_ppm"), ("duration_s",)),
    "power_loss": _Kind((), ("node", "duration_s"), (*NODES, ALL)),
    "silence": _Kind(("node",), ("duration_s",), (*NODES, ALL)),
    "drive_fault": _Kind(("node", "code"), ("duration_s",), DRIVES),
    "sensor_error": _Kind(("node",), ("status", "duration_s"), SENSORS),
    "object_value": _Kind(("node", "index", "raw"), ("sub", "duration_s")),
}
"""By the value of the key `kind`."""


@dataclass(frozen=True)
class FaultSettings:
    """One fault. Only the keys of its kind may be given; the others stay None."""

    kind: str = setting(choices=tuple(KINDS), meaning="what happens")
    node: str | None = setting(None, choices=(*NODES, ALL, HOST), meaning="whom it befalls")
    at_s: float | None = setting(None, unit="s", low=0.0, high=1e6, meaning="onset, since the moment of `since`")
    since: str | None = setting(
        None, choices=SINCE, meaning="what at_s counts from: drives enabled (default), power on"
    )
    duration_s: float | None = setting(None, unit="s", low=1e-6, high=1e6, meaning="from onset to end; absent: no end")
    count: int | None = setting(None, low=1, high=10**9, meaning="ends when so many frames or values were hit")
    probability: float | None = setting(None, low=0.0, high=1.0, meaning="of each frame or value to be hit; absent: 1")
    frame: str | None = setting(None, choices=_FRAMES, meaning="which frames; they imply the direction")
    signal: str | None = setting(None, choices=tuple(SIGNAL_NODES), meaning="which measured value")
    delay_us: float | None = setting(None, unit="µs", low=0.0, high=1e6, meaning="how late")
    jitter_us: float | None = setting(None, unit="µs", low=0.0, high=1e6, meaning="and up to so much later, uniform")
    bits: int | None = setting(None, low=1, high=512, meaning="how many random bits flip; absent, without mask: 1")
    mask: str | None = setting(None, meaning="hex bytes from byte 0 on: the bits that flip")
    value: float | None = setting(
        None, low=0.0, high=1e6, meaning="largest size, rad, rad/s or Nm; absent: torque at the end of its range"
    )
    step: float | None = setting(None, low=-1e6, high=1e6, meaning="added to the value, rad, rad/s or Nm")
    rate_Hz: float | None = setting(None, unit="Hz", low=1e-3, high=20_000.0, meaning="frames per second")
    can_id: int | None = setting(None, low=0, high=0x7FF, is_hex=True, meaning="identifier of the flood")
    data: str | None = setting(None, meaning="hex bytes of the flood's frames; absent: eight zero bytes")
    code: int | None = setting(None, low=1, high=0xFFFF, is_hex=True, meaning="error code of EMCY and 0x603F")
    status: int | None = setting(None, low=1, high=7, meaning="bits of 0x6150; absent: 1, not valid")
    index: int | None = setting(None, low=0x1000, high=0xFFFF, is_hex=True, meaning="object whose value is another")
    sub: int | None = setting(None, low=0, high=0xFF, meaning="its sub-index; absent: 0")
    raw: int | None = setting(None, low=-(2**63), high=2**64 - 1, meaning="value of the object, in its counts")
    node_id: int | None = setting(None, low=1, high=126, meaning="the node id that the node has from power-on")
    same_as: str | None = setting(None, choices=NODES, meaning="whose node id the node has from power-on")
    drift_ppm: float | None = setting(None, unit="ppm", low=-5e5, high=5e5, meaning="how much its clock runs fast")

    def __post_init__(self) -> None:
        kind = KINDS[self.kind]
        given = [field.name for field in fields(self) if getattr(self, field.name) is not None]
        _check_keys(self.kind, kind, given)
        if kind.is_timed and self.at_s is None:
            raise ValueError(f"kind {self.kind!r} lacks the key `at_s`")
        self._check_node(kind)
        if self.duration_s is not None and self.count is not None:
            raise ValueError("`duration_s` and `count` can't both end it")
        if self.bits is not None and self.mask is not None:
            raise ValueError("`bits` and `mask` can't both be flipped")
        _check_hex("mask", self.mask)
        _check_hex("data", self.data)
        for key in _IDLE_AT_0:
            if getattr(self, key) == 0.0 and not (key == "delay_us" and self.jitter_us):
                raise ValueError(f"{key} = 0 has no effect")
        if self.mask is not None and not any(bytes.fromhex(self.mask)):
            raise ValueError(f"mask = {self.mask!r} has no effect")
        if self.kind == "saturate" and self.value is None and self.signal != "torque":
            raise ValueError(f"saturate of {self.signal} lacks the key `value`: it has no end of range")
        if self.kind == "duplicate_node_id" and self.same_as == self.node:
            raise ValueError(f"same_as = {self.same_as!r} is the node itself")

    def _check_node(self, kind: _Kind) -> None:
        """Raise ValueError if this kind can't have the frame, or the node can't have such a frame, value or fault."""
        if self.frame is not None and self.frame not in kind.frames:
            raise ValueError(_refusal("frame", self.frame, kind.frames, f"kind {self.kind!r}"))
        allowed, what = kind.nodes, f"kind {self.kind!r}"
        if self.frame is not None:
            allowed, what = FRAME_NODES[self.frame], f"frame {self.frame!r}"
            if self.node is None and self.frame not in BROADCAST:
                raise ValueError(f"frame {self.frame!r} lacks the key `node`")
        if self.signal is not None:
            allowed, what = SIGNAL_NODES[self.signal], f"signal {self.signal!r}"
        if self.node is not None and self.node not in allowed:
            raise ValueError(_refusal("node", self.node, allowed, what))

    @property
    def is_from_power_on(self) -> bool:
        """Whether the fault's times count from power-on, or the fault exists from power-on."""
        return self.since == "power_on" or not KINDS[self.kind].is_timed

    @property
    def onset_ns(self) -> int:
        """Onset, ns since power-on or since the drives were enabled (`is_from_power_on`); 0 without `at_s`."""
        return round((self.at_s or 0.0) * 1e9)

    @property
    def duration_ns(self) -> int | None:
        """Time from onset to end, ns; None without `duration_s`."""
        return None if self.duration_s is None else round(self.duration_s * 1e9)

    @property
    def chance(self) -> float:
        """Probability that a frame or value is hit; 1 without `probability`."""
        return 1.0 if self.probability is None else self.probability

    @property
    def object_key(self) -> tuple[int, int]:
        """Index and sub-index of the object whose value the fault replaces; (0, 0) for other kinds of fault."""
        return self.index or 0, self.sub or 0

    @property
    def nodes(self) -> tuple[int, ...]:
        """Places in `NODES` of the devices that the fault affects; () for the host.

        Without a node, or with `all`, they are all devices that can have the fault's frame, or all devices without a
        frame.
        """
        names: tuple[str | None, ...] = (self.node,)
        if self.node in (None, ALL):
            names = FRAME_NODES[self.frame] if self.frame is not None else NODES
        return tuple(place for place, name in enumerate(NODES) if name in names)

    @property
    def is_broadcast(self) -> bool:
        """Whether the fault affects host frames that come to all devices at once, as one frame."""
        return (self.frame in BROADCAST and self.node in (None, ALL)) or self.node == HOST

    @property
    def is_received(self) -> bool:
        """Whether the fault affects frames of the host on their way to the devices."""
        return self.frame in _OF_HOST or self.node == HOST

    @property
    def text(self) -> str:
        """One line: kind, frame or signal, node, then the other keys but for onset."""
        whom = self.node or ALL
        what = self.frame or self.signal
        details = [
            f"{field.name} {_show(getattr(self, field.name), field.metadata['is_hex'])}"
            for field in fields(self)
            if field.name not in _IN_TEXT and getattr(self, field.name) is not None
        ]
        subject = f"{self.kind} {what} of {whom}" if what else f"{self.kind} of {whom}"
        return ", ".join((subject, *details))

    @property
    def timed_text(self) -> str:
        """One line: `text` and the onset."""
        if not KINDS[self.kind].is_timed:
            return f"{self.text}, from power on"
        return f"{self.text}, at {self.at_s:g} s since {(self.since or SINCE[0]).replace('_', ' ')}"


_IN_TEXT = ("kind", "node", "frame", "signal", "at_s", "since")


def _show(value: object, is_hex: bool) -> str:
    if is_hex:
        return f"0x{value:X}"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _check_keys(name: str, kind: _Kind, given: Iterable[str]) -> None:
    for key in given:
        if key not in kind.keys:
            nearest = nearest_name(key, kind.keys)
            hint = f"did you mean `{nearest}`?" if nearest else f"its keys: {', '.join(kind.keys[1:])}"
            raise ValueError(f"kind {name!r} has no key `{key}`; {hint}")
    for key in kind.required:
        if key not in given:
            raise ValueError(f"kind {name!r} lacks the key `{key}`")


def _refusal(key: str, value: str, allowed: Sequence[str], what: str) -> str:
    nearest = nearest_name(value, allowed)
    hint = f"; did you mean {nearest!r}?" if nearest else ""
    return f"{key} = {value!r} can't be with {what}, which takes {', '.join(allowed)}{hint}"


def _check_hex(key: str, text: str | None) -> None:
    if text is None:
        return
    try:
        size = len(bytes.fromhex(text))
    except ValueError:
        raise ValueError(f"{key} = {text!r} is not a row of hex bytes") from None
    if not 1 <= size <= _LONGEST:
        raise ValueError(f"{key} has {size} bytes, 1 to {_LONGEST} expected")


def check_rows(rows: Sequence[FaultSettings]) -> None:
    """Raise ConfigError if there are more than MOST_ROWS faults, or if two of them change the same node's id."""
    if len(rows) > MOST_ROWS:
        raise ConfigError(f"`faults` has {len(rows)} rows, {MOST_ROWS} at most")
    renamed: dict[str | None, int] = {}
    for index, row in enumerate(rows):
        if row.node_id is not None or row.same_as is not None:
            if row.node in renamed:
                raise ConfigError(
                    f"`faults[{index}]` gives {row.node} another node id, as `faults[{renamed[row.node]}]`"
                )
            renamed[row.node] = index


def device_ids(rows: Iterable[FaultSettings], right_ids: Sequence[int]) -> tuple[int, ...]:
    """Return the node ids of the devices, in the order of `NODES`: `right_ids`, changed by faults of node ids.

    A fault `same_as` takes the other node's right id, even if another fault changes that.
    """
    ids = list(right_ids)
    for row in rows:
        place = NODES.index(row.node) if row.node in NODES else -1
        if row.node_id is not None:
            ids[place] = row.node_id
        elif row.same_as is not None:
            ids[place] = right_ids[NODES.index(row.same_as)]
    return tuple(ids)


def own_messages(messages: Mapping[int, MessageCodec], right_id: int, node_id: int) -> Mapping[int, MessageCodec]:
    """Return the messages, by identifier, as a device with a wrong node id expects them.

    Its own frames are at the identifiers that follow from the wrong id, but keep their data ids; other messages at the
    wrong id are left out. If `node_id` is the right id, all are unchanged.
    """
    if node_id == right_id:
        return messages
    kept = {can_id: message for can_id, message in messages.items() if can_id & 0x7F not in (right_id, node_id)}
    own = {can_id & ~0x7F | node_id: message for can_id, message in messages.items() if can_id & 0x7F == right_id}
    return kept | own
