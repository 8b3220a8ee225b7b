"""The CANopen side of one emulated device: object dictionary, SDO server, NMT slave, heartbeats, EMCY.

The only door to `canopen` on the device side. `canopen` reads the EDS, keeps the written values and speaks SDO; it
starts no thread here, because heartbeats and every other timer run on the bench's time, which comes in as `t_ns`.

What a master may configure is what the device then does: a PDO can be switched off and on, its event and inhibit
times changed, its mapping written again; another identifier, transmission type or mapping is refused, not stored.
Source: CiA 301, 7.2 (services), 7.3 (NMT) and 7.5 (objects).
"""

from collections import deque
from collections.abc import Callable
from enum import IntEnum
from pathlib import Path
from typing import NoReturn, Protocol

import canopen
from canopen.network import PeriodicMessageTask

Send = Callable[[int, bytes], None]

NEVER_NS = 1 << 62
"""Later than any time: nothing is due."""
EMCY_COMMUNICATION = 0x8100
EMCY_HEARTBEAT = 0x8130
EMCY_PDO_LENGTH = 0x8210
EMCY_RPDO_TIMEOUT = 0x8250

_REGISTER_COMMUNICATION = 0x11  # 0x1001: generic and communication error
_HISTORY_LENGTH = 4  # 0x1003 in the EDS
_NOT_VALID = 1 << 31  # of a COB-ID entry
_RTR_NOT_ALLOWED = 1 << 30
_SYNCHRONOUS, _EVENT_DRIVEN = (1,), (254, 255)


class Abort(IntEnum):
    """SDO abort codes, CiA 301 table 22, besides those that `canopen` gives by itself."""

    NO_OBJECT = 0x06020000
    NO_SUBINDEX = 0x06090011
    NOT_MAPPABLE = 0x06040041
    INCOMPATIBLE = 0x06040043
    VALUE_RANGE = 0x06090030
    CANNOT_STORE = 0x08000020
    DEVICE_STATE = 0x08000022
    NO_DATA = 0x08000024


def refuse(code: Abort) -> NoReturn:
    """Answer the SDO request in progress with an abort."""
    raise canopen.SdoAbortedError(code)


class NmtState(IntEnum):
    """NMT states, CiA 301 figure 46. Every state but the first ends by an NMT command."""

    INITIALISING = 0  # by itself: boot-up message, then Pre-operational
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


_COMMANDED_STATES = {1: NmtState.OPERATIONAL, 2: NmtState.STOPPED, 128: NmtState.PRE_OPERATIONAL}
RESET_NODE, RESET_COMMUNICATION = 129, 130


class Application(Protocol):
    """What a device does besides communicating."""

    def leave_operational(self, t_ns: int) -> None:
        """Act on leaving Operational; EMCY messages can still be sent."""

    def lose_heartbeat(self, t_ns: int) -> None:
        """Report and act on the loss of the master's heartbeat, before the device leaves Operational."""

    def find_heartbeat(self, t_ns: int) -> None:
        """Act on the return of the master's heartbeat."""

    def refresh(self) -> None:
        """Take over a new NMT state or PDO configuration."""

    def restart(self, is_node_reset: bool) -> None:
        """Begin anew: communication only, or all of the device."""


class _Network(canopen.Network):
    """A network without bus and threads: what a node sends goes to a function."""

    def __init__(self, send: Send) -> None:
        super().__init__()
        self._send = send

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:  # noqa: ARG002 (canopen's signature)
        self._send(can_id, bytes(data))

    def send_periodic(
        self,
        can_id: int,
        data: bytes,  # noqa: ARG002
        period: float,  # noqa: ARG002
        remote: bool = False,  # noqa: ARG002
    ) -> PeriodicMessageTask:
        raise RuntimeError(f"periodic frame {can_id:#x}: timers belong to the bench")


class _Node(canopen.LocalNode):
    """canopen's local node with strict sub-indices and without its own heartbeat."""

    def __init__(self, node_id: int, eds_path: Path) -> None:
        super().__init__(node_id, str(eds_path))
        self._write_callbacks.clear()  # NmtSlave.on_write would start a periodic task
        # An abort before the first transfer needs an index to name.
        self.sdo._index = self.sdo._subindex = 0
        self.sdo._buffer = bytearray()

    def _find_object(self, index: int, subindex: int) -> canopen.objectdictionary.ODVariable:
        """Find an object; unlike canopen's own, arrays and variables have no sub-indices that the EDS lacks."""
        if index not in self.object_dictionary:
            refuse(Abort.NO_OBJECT)
        entry = self.object_dictionary[index]
        variables = {0: entry} if isinstance(entry, canopen.objectdictionary.ODVariable) else entry.subindices
        if subindex not in variables:
            refuse(Abort.NO_SUBINDEX)
        return variables[subindex]


class _Pdo:
    """One PDO's records, 0x14xx/0x16xx or 0x18xx/0x1Axx: what may be written, and whether the PDO is usable."""

    def __init__(self, device: "Device", index: int) -> None:
        self._device = device
        self._index = index
        self._mapping_index = index + 0x200
        self._cob_id = device.value(index, 1) & ~(_NOT_VALID | _RTR_NOT_ALLOWED)
        count = device.value(self._mapping_index, 0)
        self._mapping = tuple(device.value(self._mapping_index, sub) for sub in range(1, count + 1))
        is_synchronous = device.value(index, 2) in _SYNCHRONOUS
        self._types = _SYNCHRONOUS if is_synchronous else _EVENT_DRIVEN
        self._is_valid = self._is_mapped = True
        device.watch(index, 1, self._validate, self._check_cob_id)
        device.watch(index, 2, check=self._check_type)
        device.watch(self._mapping_index, 0, self._map, self._check_count)
        for sub in range(1, 9):
            device.watch(self._mapping_index, sub, check=self._check_entry)

    @property
    def is_usable(self) -> bool:
        return self._is_valid and self._is_mapped

    def _check_cob_id(self, value: int) -> None:
        if value & ~(_NOT_VALID | _RTR_NOT_ALLOWED) != self._cob_id:
            refuse(Abort.VALUE_RANGE)

    def _validate(self, value: int) -> None:
        self._is_valid = not value & _NOT_VALID
        self._device.refresh()

    def _check_type(self, value: int) -> None:
        if value not in self._types:
            refuse(Abort.VALUE_RANGE)

    def _check_entry(self, value: int) -> None:
        if value not in (0, *self._mapping):
            refuse(Abort.NOT_MAPPABLE)

    def _check_count(self, value: int) -> None:
        written = tuple(self._device.value(self._mapping_index, sub) for sub in range(1, min(value, 8) + 1))
        if value != 0 and (value > 8 or written != self._mapping):
            refuse(Abort.INCOMPATIBLE)

    def _map(self, value: int) -> None:
        self._is_mapped = value != 0
        self._device.refresh()


class Device:
    """A CANopen device: everything but what its application does."""

    def __init__(self, node_id: int, eds_path: Path, send: Send) -> None:
        """Read the EDS; nothing is sent before `boot`. Raises OSError when the EDS can't be read."""
        self.node_id = node_id
        self.state = NmtState.INITIALISING
        self.is_operational = False
        self.error_register = 0
        self.now_ns = 0
        """Time of the last SDO request, for what its writes start."""
        self._send = send
        self._application: Application | None = None
        self._readers: dict[tuple[int, int], Callable[[], int]] = {}
        self._checks: dict[tuple[int, int], list[Callable[[int], None]]] = {}
        self._appliers: dict[tuple[int, int], list[Callable[[int], None]]] = {}
        self._node = _Node(node_id, eds_path)
        self._node.associate_network(_Network(send))
        self._node.add_read_callback(self._read)  # type: ignore[no-untyped-call]
        self._node.add_write_callback(self._write)  # type: ignore[no-untyped-call]
        self._pdos = {index: _Pdo(self, index) for index in (0x1400, 0x1800, 0x1801) if index in self.objects}
        self._producer = _HeartbeatProducer(self, send)
        self._consumer = _HeartbeatConsumer(self)
        self._errors = _ErrorReporter(self, send)

    @property
    def objects(self) -> canopen.ObjectDictionary:
        """The objects that the EDS lists."""
        return self._node.object_dictionary

    def attach(self, application: Application) -> None:
        """Connect what the device does."""
        self._application = application

    def serve(self, index: int, subindex: int, read: Callable[[], int]) -> None:
        """Answer reads of an object with a live value."""
        self._readers[index, subindex] = read

    def watch(
        self,
        index: int,
        subindex: int,
        apply: Callable[[int], None] | None = None,
        check: Callable[[int], None] | None = None,
    ) -> None:
        """Act on writes of an object: `check` may `refuse`, then `apply` takes the value over.

        `apply` also gets the default when a reset restores it.
        """
        if check is not None:
            self._checks.setdefault((index, subindex), []).append(check)
        if apply is not None:
            self._appliers.setdefault((index, subindex), []).append(apply)

    def value(self, index: int, subindex: int = 0) -> int:
        """Return the present value of a numeric object."""
        variable = self._node._find_object(index, subindex)
        return int(variable.decode_raw(self._node.get_data(index, subindex)))

    def is_pdo_active(self, index: int) -> bool:
        """Whether the PDO with this communication record (0x1400, 0x1800, 0x1801) is exchanged now."""
        return self.is_operational and self._pdos[index].is_usable

    def refresh(self) -> None:
        """Let the application take over a new NMT state or PDO configuration."""
        if self._application is not None:
            self._application.refresh()

    def boot(self, t_ns: int) -> None:
        """Announce the device and enter Pre-operational."""
        self._send(0x700 + self.node_id, bytes([NmtState.INITIALISING]))
        self._producer.restart(t_ns)
        self._enter(NmtState.PRE_OPERATIONAL, t_ns)

    def on_nmt(self, data: bytes, t_ns: int) -> None:
        """Obey an NMT command, if it is for this device."""
        if len(data) != 2 or data[1] not in (0, self.node_id):
            return
        command = data[0]
        if command in _COMMANDED_STATES:
            self._enter(_COMMANDED_STATES[command], t_ns)
        elif command in (RESET_NODE, RESET_COMMUNICATION):
            self._enter(NmtState.INITIALISING, t_ns)
            self._reset(command == RESET_NODE)
            self.boot(t_ns)

    def on_sdo(self, data: bytes, t_ns: int) -> None:
        """Answer an SDO request."""
        self.now_ns = t_ns
        if len(data) == 8 and self.state != NmtState.STOPPED:
            self._node.sdo.on_request(0x600 + self.node_id, data, t_ns)  # type: ignore[no-untyped-call]

    def on_heartbeat(self, node_id: int, t_ns: int) -> None:
        """Take note of another node's heartbeat."""
        self._consumer.on_heartbeat(node_id, t_ns)

    @property
    def is_heartbeat_lost(self) -> bool:
        """Whether the master's heartbeat is monitored and missing."""
        return self._consumer.is_lost

    def lose_heartbeat(self, t_ns: int) -> None:
        """React to the master's silence: the application, then Pre-operational (CiA 301, default of 0x1029)."""
        if self._application is not None:
            self._application.lose_heartbeat(t_ns)
        if self.is_operational:
            self._enter(NmtState.PRE_OPERATIONAL, t_ns)

    def find_heartbeat(self, t_ns: int) -> None:
        """Let the application know that the master is back."""
        if self._application is not None:
            self._application.find_heartbeat(t_ns)

    def report_error(self, code: int, t_ns: int) -> None:
        """Enter an error in 0x1001 and 0x1003 and send it as EMCY. All errors here are communication errors."""
        self.error_register = _REGISTER_COMMUNICATION
        self._errors.report(code, t_ns)

    def clear_error(self, t_ns: int) -> None:
        """Clear 0x1001 and say so by an EMCY with code 0."""
        self.error_register = 0
        self._errors.report(0, t_ns)

    def poll(self, t_ns: int) -> int:
        """Do what is due; return when something is due next."""
        return min(self._producer.poll(t_ns), self._consumer.poll(t_ns), self._errors.poll(t_ns))

    def _enter(self, state: NmtState, t_ns: int) -> None:
        if self.is_operational and state != NmtState.OPERATIONAL and self._application is not None:
            self._application.leave_operational(t_ns)
        self.state = state
        self.is_operational = state == NmtState.OPERATIONAL
        self.refresh()

    def _reset(self, is_node_reset: bool) -> None:
        """Restore the EDS values: the communication profile's, or all."""
        last = 0xFFFF if is_node_reset else 0x1FFF
        for index in [index for index in self._node.data_store if index <= last]:
            del self._node.data_store[index]
        for (index, subindex), appliers in self._appliers.items():
            if index <= last:
                _call_all(appliers, self.value(index, subindex))
        if is_node_reset:
            self.error_register = 0
        if self._application is not None:
            self._application.restart(is_node_reset)

    def _read(self, index: int, subindex: int, od: object) -> int | None:  # noqa: ARG002 (canopen passes it by name)
        read = self._readers.get((index, subindex))
        return None if read is None else read()

    def _write(self, index: int, subindex: int, od: canopen.objectdictionary.ODVariable, data: bytes) -> None:
        key = (index, subindex)
        if key in self._checks or key in self._appliers:
            value = int(od.decode_raw(bytes(data)))
            _call_all(self._checks.get(key, []), value)
            _call_all(self._appliers.get(key, []), value)


def _call_all(functions: list[Callable[[int], None]], value: int) -> None:
    for function in functions:
        function(value)


class _HeartbeatProducer:
    """0x1017: sends the NMT state every so many ms; the boot-up message is the first heartbeat."""

    def __init__(self, device: Device, send: Send) -> None:
        self._device = device
        self._send = send
        self._period_ns = 0
        self._due_ns = NEVER_NS
        device.watch(0x1017, 0, self._set_period)

    def restart(self, t_ns: int) -> None:
        self._due_ns = t_ns + self._period_ns if self._period_ns else NEVER_NS

    def poll(self, t_ns: int) -> int:
        if t_ns >= self._due_ns:
            self._due_ns = max(self._due_ns, t_ns - self._period_ns) + self._period_ns
            self._send(0x700 + self._device.node_id, bytes([self._device.state]))
        return self._due_ns

    def _set_period(self, period_ms: int) -> None:
        self._period_ns = period_ms * 1_000_000
        self.restart(self._device.now_ns)


class _HeartbeatConsumer:
    """0x1016:1: monitors one node from its first heartbeat on. A lost heartbeat is found again when one arrives."""

    def __init__(self, device: Device) -> None:
        self.is_lost = False
        self._device = device
        self._node_id = 0
        self._timeout_ns = 0
        self._due_ns = NEVER_NS
        device.watch(0x1016, 1, self._configure)

    def on_heartbeat(self, node_id: int, t_ns: int) -> None:
        if self._timeout_ns == 0 or node_id != self._node_id:
            return
        self._due_ns = t_ns + self._timeout_ns
        if self.is_lost:
            self.is_lost = False
            self._device.find_heartbeat(t_ns)

    def poll(self, t_ns: int) -> int:
        if t_ns >= self._due_ns:
            self._due_ns = NEVER_NS
            self.is_lost = True
            self._device.lose_heartbeat(t_ns)
        return self._due_ns

    def _configure(self, value: int) -> None:
        self._node_id = (value >> 16) & 0x7F
        self._timeout_ns = (value & 0xFFFF) * 1_000_000
        self._due_ns = NEVER_NS
        self.is_lost = False


class _ErrorReporter:
    """EMCY producer with inhibit time (0x1014, 0x1015) and the error history (0x1003, newest first)."""

    def __init__(self, device: Device, send: Send) -> None:
        self._device = device
        self._send = send
        self._waiting: deque[bytes] = deque()
        self._inhibit_ns = 0
        self._allowed_ns = 0
        self._is_valid = True
        self._cob_id = 0x80 + device.node_id
        self._history: deque[int] = deque(maxlen=_HISTORY_LENGTH)
        device.serve(0x1001, 0, lambda: device.error_register)
        device.serve(0x1003, 0, lambda: len(self._history))
        for sub in range(1, _HISTORY_LENGTH + 1):
            device.serve(0x1003, sub, lambda sub=sub: self._past_error(sub))  # type: ignore[misc]
        device.watch(0x1003, 0, self._clear_history, self._check_zero)
        device.watch(0x1014, 0, self._validate, self._check_cob_id)
        device.watch(0x1015, 0, self._set_inhibit)

    def report(self, code: int, t_ns: int) -> None:
        if code != 0:
            self._history.appendleft(code)
        if self._is_valid and self._device.state in (NmtState.OPERATIONAL, NmtState.PRE_OPERATIONAL):
            self._waiting.append(code.to_bytes(2, "little") + bytes([self._device.error_register, 0, 0, 0, 0, 0]))
            self.poll(t_ns)

    def poll(self, t_ns: int) -> int:
        while self._waiting and t_ns >= self._allowed_ns:
            self._allowed_ns = t_ns + self._inhibit_ns
            self._send(self._cob_id, self._waiting.popleft())
        return self._allowed_ns if self._waiting else NEVER_NS

    def _past_error(self, sub: int) -> int:
        if sub > len(self._history):
            refuse(Abort.NO_DATA)
        return self._history[sub - 1]

    def _check_zero(self, value: int) -> None:
        if value != 0:
            refuse(Abort.VALUE_RANGE)

    def _clear_history(self, _value: int) -> None:
        self._history.clear()

    def _check_cob_id(self, value: int) -> None:
        if value & ~_NOT_VALID != self._cob_id:
            refuse(Abort.VALUE_RANGE)

    def _validate(self, value: int) -> None:
        self._is_valid = not value & _NOT_VALID

    def _set_inhibit(self, tenths_ms: int) -> None:
        self._inhibit_ns = tenths_ms * 100_000
