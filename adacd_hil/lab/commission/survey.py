"""A survey of the bus: CANopen nodes found by asking and by listening, every identifier received, a listener's view.

A survey sends SDO uploads only and changes no node's state, so it works beside a running master. Source: CiA 301 (4.2),
clauses 7.2.4 (SDO), 7.2.8 (NMT, boot-up, heartbeat), 7.3.3 (predefined connection set), objects 0x1000, 0x1001, 0x1008,
0x1018. It also reads 0x2000, wire version and layout digest, of nodes whose profile has it.

The listener's view sends no frame: nodes with their NMT state, messages with rate, age, checks and values, load.
Everything is counted frame by frame; values are decoded by `BusView.describe`.
"""

import struct
from collections import Counter, deque
from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from adacd_hil.clock import Clock
from adacd_hil.device.arm_watch import STATES
from adacd_hil.device.canopen_bus import CanopenBus, DeviceError, read_object
from adacd_hil.device.device_setup import Slave
from adacd_hil.device.network import Identity, identity_difference
from adacd_hil.lab.commission.traffic import Talk, Traffic, listen
from adacd_hil.lab.stated_bounds import LISTEN_S
from adacd_hil.wire.bus import Bus, Frame, Tap
from adacd_hil.wire.codec import Codec, MessageCodec
from adacd_hil.wire.contract_frames import (
    EMERGENCY_ID,
    FUNCTION_MASK,
    HEARTBEAT_ID,
    NMT_ID,
    NODE_MASK,
    RPDO_IDS,
    SDO_REQUEST_ID,
    SDO_RESPONSE_ID,
    SYNC_ID,
    TPDO_IDS,
)
from adacd_hil.wire.dbc_decoder import DbcDecoder
from adacd_hil.wire.e2e import E2eStatus
from adacd_hil.wire.frame_lengths import MAX_STANDARD_ID

_NODE_IDS = range(1, 128)
_BETWEEN_REQUESTS_S = 0.002
"""Request and answer are 270 bits at worst, 0.27 ms at 1 Mbit/s: the rest is for the bus's own traffic."""
BETWEEN_READS_S = 0.02
"""Pause between an answer and the next request to an unknown device: an EPOS loses requests within 15 ms."""
_ANSWER_S = 0.1
_UPLOAD_DEVICE_TYPE = bytes.fromhex("4000100000000000")
_IDENTITY = ("vendor", "product", "revision", "serial")

NMT_STATES = {number: name.lower() for number, name in STATES.items()}
_PROFILES = {401: "I/O", 402: "drive", 404: "measuring device", 405: "PLC", 406: "encoder", 408: "hydraulic drive"}

# Predefined connection set, CiA 301 table 38: function code to the service that a node sends with it.
_PRODUCED = {
    EMERGENCY_ID: "EMCY",
    **{function: f"TPDO{number}" for number, function in enumerate(TPDO_IDS, 1)},
    SDO_RESPONSE_ID: "SDO response",
    HEARTBEAT_ID: "heartbeat",
}
_CONSUMED = {function: f"RPDO{number}" for number, function in enumerate(RPDO_IDS, 1)} | {SDO_REQUEST_ID: "SDO request"}
_BROADCAST = {NMT_ID: "NMT", SYNC_ID: "SYNC", 0x100: "TIME"}


def function_name(can_id: int) -> str:
    """Return the service of an identifier in CiA 301's predefined connection set, such as "TPDO1"; "" outside it."""
    if can_id > MAX_STANDARD_ID:
        return ""
    function, node_id = can_id & FUNCTION_MASK, can_id & NODE_MASK
    if can_id in _BROADCAST:
        return _BROADCAST[can_id]
    return {**_PRODUCED, **_CONSUMED}.get(function, "") if node_id else ""


@dataclass
class Node:
    """One CANopen node. None: unknown, since it didn't answer or has no such object.

    nmt_state: of its last heartbeat or boot-up, by CiA 301 one of 0, 4, 5 and 127. has_pdos: it sent TPDOs. answers: it
    answered every SDO request. emergencies: (error code, error register), oldest first. produces: identifiers that it
    sent, but SDO responses.
    """

    node_id: int
    device_type: int | None = None
    name: str | None = None
    vendor: int | None = None
    product: int | None = None
    revision: int | None = None
    serial: int | None = None
    error_register: int | None = None
    nmt_state: int | None = None
    has_pdos: bool = False
    answers: bool = False
    wire_version: int | None = None
    layout_digest: int | None = None
    emergencies: list[tuple[int, int]] = field(default_factory=list)
    produces: list[Talk] = field(default_factory=list)

    @property
    def device_text(self) -> str:
        """0x1000 as text, such as "CiA 402 drive"; "no profile", or "?" if it is unknown."""
        if self.device_type is None:
            return "?"
        profile = self.device_type & 0xFFFF
        if profile == 0:
            return "no profile"
        return f"CiA {profile} {_PROFILES.get(profile, '')}".strip()

    @property
    def state_text(self) -> str:
        """The NMT state as text, by the last heartbeat; without one by PDOs, which only an operational node sends.

        PDOs count more than a boot-up, a boot-up more than nothing. "? (no heartbeat)" if none of these came.
        """
        if self.has_pdos and self.nmt_state in (None, 0):
            return "operational (sends PDOs)"
        if self.nmt_state is None:
            return "? (no heartbeat)"
        return NMT_STATES.get(self.nmt_state, f"unknown ({self.nmt_state})")


@dataclass(frozen=True)
class Survey:
    """Nodes found, ascending by node id. `others`: identifiers that none of them sends.

    `duration_s`: length of the listening, without the reading of identities.
    """

    nodes: list[Node]
    others: list[Talk]
    error_frames: int
    duration_s: float


def survey(
    bus: Bus,
    clock: Clock,
    duration_s: float = LISTEN_S,
    progress: Callable[[str], None] = lambda _: None,
    contract_ids: Container[int] = (),
) -> Survey:
    """Ask all 127 node ids for 0x1000, listen, and read the identity of each node that answers.

    duration_s: from the first request to the end of the listening, which lasts at least `_ANSWER_S` after the last one.
    contract_ids: ids of the nodes of which 0x2000, wire version and layout digest, is read, too. progress: called with
    a line before each step. Nodes that don't answer are found by heartbeat or EMCY. Raises BusError if the bus fails.
    """
    tap = Tap(bus, clock)
    traffic = Traffic()
    begin_ns = clock.now_ns()
    progress(f"asking nodes {_NODE_IDS[0]} to {_NODE_IDS[-1]} on {bus.channel}")
    for node_id in _NODE_IDS:
        tap.send(SDO_REQUEST_ID + node_id, _UPLOAD_DEVICE_TYPE)
        listen(tap, clock, _BETWEEN_REQUESTS_S, traffic)
    listen(tap, clock, max(_ANSWER_S, duration_s - (clock.now_ns() - begin_ns) * 1e-9), traffic)
    elapsed_s = (clock.now_ns() - begin_ns) * 1e-9
    nodes = _collect(tap, traffic)
    canopen = CanopenBus(tap)
    for node in nodes.values():
        if node.answers:
            progress(f"reading node {node.node_id}")
            _identify(canopen, node, node.node_id in contract_ids)
    others = _assign(nodes, traffic)
    return Survey(list(nodes.values()), others, traffic.error_frames, elapsed_s)


def _collect(tap: Tap, traffic: Traffic) -> dict[int, Node]:
    """Return the nodes that answered SDO, or sent a heartbeat or an EMCY, by node id, ascending.

    Takes the frames that have passed the tap.
    """
    found: dict[int, Node] = {}
    for is_sent, frame in tap.take_passed():
        function, node_id = frame.can_id & FUNCTION_MASK, frame.can_id & NODE_MASK
        if is_sent or frame.is_error or frame.can_id > MAX_STANDARD_ID or node_id == 0:
            continue
        node = found.get(node_id) or Node(node_id)
        if function == SDO_RESPONSE_ID and len(frame.data) == 8 and frame.data[1:4] == _UPLOAD_DEVICE_TYPE[1:4]:
            node.answers = True
            if frame.data[0] & 0xE2 == 0x42:  # expedited upload response
                node.device_type = struct.unpack_from("<I", frame.data, 4)[0]
        elif function == HEARTBEAT_ID and len(frame.data) == 1:
            node.nmt_state = frame.data[0] & 0x7F
        elif function == EMERGENCY_ID and len(frame.data) == 8:
            node.emergencies.append((frame.data[0] | frame.data[1] << 8, frame.data[2]))
        else:
            continue
        found[node_id] = node
    for node in found.values():
        node.has_pdos = any(function + node.node_id in traffic.talks for function in TPDO_IDS)
    return dict(sorted(found.items()))


def _identify(canopen: CanopenBus, node: Node, has_contract: bool) -> None:
    """Read a node's identity into `node`; an object that the node lacks stays None. has_contract: read 0x2000, too.

    If the node falls silent or refuses, `answers` becomes False, and values read before stay.
    """
    remote = canopen.add_node(node.node_id, None, pause_s=BETWEEN_READS_S)
    try:
        name = read_object(remote, 0x1008)
        node.name = None if name is None else name.rstrip(b"\0").decode("ascii", "replace").strip()
        node.error_register = _read_number(remote, 0x1001)
        for subindex, what in enumerate(_IDENTITY, start=1):
            setattr(node, what, _read_number(remote, 0x1018, subindex))
        if has_contract:
            node.wire_version = _read_number(remote, 0x2000, 1)
            node.layout_digest = _read_number(remote, 0x2000, 2)
    except DeviceError:
        node.answers = False  # it fell silent or refuses: values read so far stay


def _read_number(remote: Any, index: int, sub: int = 0) -> int | None:
    """Read an object of a node as an unsigned number, None if it is missing. Raises DeviceError as `read_object`."""
    data = read_object(remote, index, sub)
    return None if data is None else int.from_bytes(data, "little")


def _assign(nodes: Mapping[int, Node], traffic: Traffic) -> list[Talk]:
    """Add each identifier that a node sends by the predefined connection set to its `produces`; return the others.

    SDO responses of these nodes, which are answers to us, are in neither. RPDOs and SDO requests are among the others.
    """
    others = []
    for talk in traffic.sorted():
        node = nodes.get(talk.can_id & NODE_MASK) if talk.can_id <= MAX_STANDARD_ID else None
        if node is not None and talk.can_id & FUNCTION_MASK in _PRODUCED and talk.can_id not in _BROADCAST:
            if talk.can_id & FUNCTION_MASK != SDO_RESPONSE_ID:  # answers to us
                node.produces.append(talk)
        else:
            others.append(talk)
    return others


def compare(found: Survey, slaves: Iterable[Slave], codec: Codec | None = None) -> dict[int, str]:
    """Return, by node id, how each node differs from the arm's slaves, or "" if it fits.

    Texts are such as "unexpected" or "missing: NAME expected". codec: nodes whose profile has the object 0x2000 must
    have its wire version and layout digest; None: these aren't compared.
    """
    wanted = {slave.node_id: slave for slave in slaves}
    present = {node.node_id: node for node in found.nodes}
    verdicts = {}
    for node_id in sorted({*wanted, *present}):
        if node_id not in present:
            verdicts[node_id] = f"missing: {wanted[node_id].name} expected"
        elif node_id not in wanted:
            verdicts[node_id] = "unexpected"
        else:
            verdicts[node_id] = _difference(present[node_id], wanted[node_id], codec)
    return verdicts


def _difference(node: Node, slave: Slave, codec: Codec | None) -> str:
    """Return the first difference of a node from its slave as text, "" without one. codec: as of `compare`.

    A node that doesn't answer SDO differs, and so does one whose identity `run` would refuse.
    """
    if not node.answers:
        return f"{slave.name} expected; does not answer SDO"
    told = {
        "device type": node.device_type,
        "vendor": node.vendor,
        "product code": node.product,
        "revision": node.revision,
        "serial number": node.serial,
        "wire version": node.wire_version,
        "layout digest": node.layout_digest,
    }
    device_type, *identity = (number or 0 for number in list(told.values())[:5])
    found = Identity(slave.name, node.node_id, *identity)
    quantity, difference, _ = identity_difference(slave, device_type, found)
    if codec is not None and slave.device.settings.contract_object and not difference:
        for quantity, expected in (("wire version", codec.wire_version), ("layout digest", codec.layout_digest)):
            if told[quantity] != expected:
                difference = f"0x{told[quantity] or 0:08X}, the contract has 0x{expected:08X}"
                break
    if not difference:
        return ""
    text = f"tells no {quantity}" if told[quantity] is None else f"{quantity} {difference}"
    return f"{slave.name} expected; {text}"


def message_name(codec: Codec | DbcDecoder, can_id: int) -> str:
    """Return an identifier's name: the contract's message, else CiA 301's service such as "(TPDO1)", else "unknown"."""
    message = codec.by_id.get(can_id)
    if message is not None:
        return message.name
    function = function_name(can_id)
    return f"({function})" if function else "unknown"


_WINDOW_NS = 1_000_000_000
"""Rates are means over one to two of these."""


class BusView:
    """Counts, checks and decodes the frames of a bus for a listener; `describe` returns the results."""

    def __init__(self, codec: Codec | DbcDecoder, bitrate: int, data_bitrate: int, t_ns: int) -> None:
        """Begin at `t_ns` without frames; the bit rates, in bit/s, are for the load, data_bitrate 0 without CAN FD.

        Raises ValueError if `bitrate` is 0 or less.
        """
        from adacd_hil.lab.commission.load_meter import LoadMeter

        self.frames = 0
        self._codec = codec
        self._load = LoadMeter(bitrate, data_bitrate, t_ns)
        self._traffic = Traffic()
        self._marks: deque[tuple[int, dict[int, int]]] = deque([(t_ns, {})], maxlen=2)
        self._strange_frames = 0
        self._wrong_lengths: Counter[int] = Counter()
        self._valid: dict[int, bytes] = {}  # of the last frame that passed its checks, by identifier
        self._receivers = {
            can_id: message.receiver()
            for can_id, message in codec.by_id.items()
            if isinstance(message, MessageCodec) and message.is_protected
        }

    def accept(self, frame: Frame) -> None:
        """Add a frame to the counts, the bus load, and the statistics and checks of its identifier.

        An error frame is only counted.
        """
        self.frames += 1
        self._traffic.count_frame(frame)
        if frame.is_error:
            return
        try:
            self._load.count_frame(frame)
        except ValueError:  # a length that the contract's bus can't carry
            self._strange_frames += 1
        message, receiver = self._codec.by_id.get(frame.can_id), self._receivers.get(frame.can_id)
        if message is None:
            return
        if not message.takes(len(frame.data)):
            self._wrong_lengths[frame.can_id] += 1
        elif receiver is None or receiver.check(frame.data).is_valid:
            self._valid[frame.can_id] = frame.data

    def restart_counters(self) -> None:
        """Let the counter of each protected message jump once without being counted as lost frames.

        For frames that this computer has lost, not the bus.
        """
        for receiver in self._receivers.values():
            receiver.restart_sequence()

    def describe(self, t_ns: int, node_id: int | None = None) -> dict[str, Any]:
        """Return counts, nodes and messages as of `t_ns` for JSON, and the bus load since the call before, percent.

        node_id: return only nodes and messages of this node; counts and load are still of the whole bus.
        strange_frames: of a length that the contract's bus can't carry; the load leaves them out. A node's state: by
        its last heartbeat, age_s since then. Of a message: rate_Hz: over the last one or two `_WINDOW_NS`, less at
        first, more if calls are farther apart; lost: frames that a counter shows to be missing, as occasions; errors:
        frames of a wrong length, or that failed the end-to-end check; values: of the last frame that passed its checks,
        empty before.
        """
        mark_ns, counts = self._marks[0]
        elapsed_s = (t_ns - mark_ns) * 1e-9
        wanted = [
            talk
            for talk in self._traffic.sorted()
            if node_id is None or (talk.can_id <= MAX_STANDARD_ID and talk.can_id & NODE_MASK == node_id)
        ]
        described = {
            "frames": self.frames,
            "error_frames": self._traffic.error_frames,
            "strange_frames": self._strange_frames,
            "load_percent": round(self._load.take_percent(t_ns), 2),
            "nodes": [
                self._node(talk, t_ns)
                for talk in wanted
                if talk.can_id & ~0x7F == HEARTBEAT_ID and talk.can_id != HEARTBEAT_ID
            ],
            "messages": [
                self._message(talk, t_ns, (talk.count - counts.get(talk.can_id, 0)) / elapsed_s if elapsed_s else 0)
                for talk in wanted
            ],
        }
        if t_ns - self._marks[-1][0] >= _WINDOW_NS:
            self._marks.append((t_ns, {talk.can_id: talk.count for talk in self._traffic.sorted()}))
        return described

    def _node(self, talk: Talk, t_ns: int) -> dict[str, Any]:
        state = talk.data[0] & 0x7F if talk.data else -1
        name = message_name(self._codec, talk.can_id).removesuffix("Heartbeat")
        return {
            "node_id": talk.can_id & NODE_MASK,
            "name": "" if name.startswith("(") else name,
            "state": NMT_STATES.get(state, "unknown"),
            "age_s": round((t_ns - talk.last_ns) * 1e-9, 3),
        }

    def _message(self, talk: Talk, t_ns: int, rate_Hz: float) -> dict[str, Any]:
        can_id = talk.can_id
        message, valid, receiver = self._codec.by_id.get(can_id), self._valid.get(can_id), self._receivers.get(can_id)
        values = () if message is None or valid is None else message.decode_named(valid)
        checks = {} if receiver is None else dict(receiver.tally())
        invalid = sum(count for status, count in checks.items() if not status.is_valid)
        return {
            "id": can_id,
            "message": message_name(self._codec, can_id),
            "is_known": message is not None,
            "is_protected": receiver is not None,
            "count": talk.count,
            "rate_Hz": round(rate_Hz, 1),
            "age_s": round((t_ns - talk.last_ns) * 1e-9, 4),
            "lost": checks.get(E2eStatus.OK_SOME_LOST, 0),
            "errors": self._wrong_lengths[can_id] + invalid,
            "data": talk.data.hex(),
            "values": {name: value for name, value, _ in values},
            "units": {name: unit for name, _, unit in values},
        }
