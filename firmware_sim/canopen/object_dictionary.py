"""The object dictionary of one emulated device, its SDO server for other nodes, and the contracts with their EDS files.

The device side uses `canopen` only here. `canopen` reads the EDS and stores the written values. A live value, where
there is one, answers a read; the dictionary checks a write before it stores it. Source: CiA 301, 7.2.4 (SDO), 7.4
(dictionary).
"""

import contextlib
import copy
import io
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cache
from pathlib import Path
from typing import NamedTuple, NoReturn

import canopen
from canopen.objectdictionary import ODVariable, datatypes
from canopen.sdo.server import SdoServer

from adacd_hil.records import JOINTS
from adacd_hil.settings.schema import ConfigError
from adacd_hil.wire.codec import Codec, CodecError
from adacd_hil.wire.dbc_contract import contract_folder, load_codec
from adacd_hil.wire.eds_text import readable_eds
from adacd_hil.wire.frame_lengths import CLASSIC_BYTES, FD_LENGTHS
from adacd_hil.wire.moved_contract import move_contract

Send = Callable[[int, bytes], None]
Values = Mapping[tuple[int, int], int]
"""Values of objects by index and sub-index."""

_FIRST_INDEX = 0x1000  # below are data types: dummy mapping entries, no objects
FORMATS = {
    datatypes.BOOLEAN: "B",
    datatypes.INTEGER8: "b",
    datatypes.INTEGER16: "h",
    datatypes.INTEGER32: "i",
    datatypes.INTEGER64: "q",
    datatypes.UNSIGNED8: "B",
    datatypes.UNSIGNED16: "H",
    datatypes.UNSIGNED32: "I",
    datatypes.UNSIGNED64: "Q",
}
"""Formats of `struct` by data type, for numbers."""
_EXPEDITED, _IS_SIZE_GIVEN, _IS_LAST = 0x02, 0x01, 0x01  # bits of command specifiers
_RESPONSE_DOWNLOAD = 0x60


class Abort(IntEnum):
    """SDO abort codes that the devices choose, of CiA 301 table 22."""

    UNKNOWN_COMMAND = 0x05040001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    PDO_TOO_LONG = 0x06040042
    INCOMPATIBLE = 0x06040043
    LENGTH = 0x06070010
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUBINDEX = 0x06090011
    VALUE_RANGE = 0x06090030
    TOO_HIGH = 0x06090031
    TOO_LOW = 0x06090032
    CANNOT_STORE = 0x08000020
    DEVICE_STATE = 0x08000022
    NO_DATA = 0x08000024


Refusal = canopen.SdoAbortedError
"""Raised by `refuse`."""


def refuse(code: Abort) -> NoReturn:
    """Raise `Refusal` with an abort code, which the SDO server sends as the answer to the request in progress."""
    raise canopen.SdoAbortedError(code)


def one_of(*allowed: int) -> Callable[[int], None]:
    """Return a check of a written value: it refuses, by VALUE_RANGE, every value except `allowed`."""

    def check(value: int) -> None:
        if value not in allowed:
            refuse(Abort.VALUE_RANGE)

    return check


class _SilentNetwork(canopen.Network):
    """A network without bus and threads: a node's frames go to a function."""

    def __init__(self, send: Send) -> None:
        super().__init__()
        self._send = send

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:  # noqa: ARG002 (canopen's signature)
        self._send(can_id, bytes(data))


class _Server(SdoServer):
    """canopen's SDO server, one transfer at a time.

    It aborts segments outside a transfer, wrong lengths, and block upload.
    """

    def __init__(self, node: "_DictionaryNode") -> None:
        node_id = int(node.id or 0)
        super().__init__(0x600 + node_id, 0x580 + node_id, node)  # type: ignore[no-untyped-call]
        self._local = node
        self._announced: int | None = None
        self._longest: int | None = None
        self._end()

    def on_request(self, can_id: int, data: bytes, timestamp: int) -> None:
        is_segment = data[0] & 0xE0 in (0x00, 0x60)
        if not is_segment:  # an abort names the object of the request that it answers
            self._index, self._subindex = struct.unpack_from("<HB", data, 1)
        super().on_request(can_id, data, timestamp)  # type: ignore[no-untyped-call]

    def init_upload(self, request: bytes) -> None:
        self._end()
        super().init_upload(request)  # type: ignore[no-untyped-call]
        self._is_uploading = bool(self._buffer)

    def segmented_upload(self, command: int) -> None:
        if not self._is_uploading:
            refuse(Abort.UNKNOWN_COMMAND)
        super().segmented_upload(command)  # type: ignore[no-untyped-call]
        if not self._buffer:
            self._end()

    def init_download(self, request: bytes) -> None:
        self._end()
        command, index, subindex = struct.unpack_from("<BHB", request)
        variable = self._local._find_object(index, subindex)
        if not variable.writable:
            refuse(Abort.READ_ONLY)
        size = len(variable) // 8 if variable.data_type in datatypes.NUMBER_TYPES else None
        if command & _EXPEDITED:
            length = 4 - (command >> 2 & 3) if command & _IS_SIZE_GIVEN else min(size or 4, 4)
            self._local.set_data(index, subindex, bytes(request[4 : 4 + length]), check_writable=True)
        else:
            self._announced = struct.unpack_from("<L", request, 4)[0] if command & _IS_SIZE_GIVEN else None
            if size is not None and self._announced is not None:
                _compare_lengths(self._announced, size)
            self._longest = size if size is not None else self._announced
            self._is_downloading = True
        self.send_response(  # type: ignore[no-untyped-call]
            struct.pack("<BHB4x", _RESPONSE_DOWNLOAD, index, subindex)
        )

    def segmented_download(self, command: int, request: bytes) -> None:
        if not self._is_downloading:
            refuse(Abort.UNKNOWN_COMMAND)
        length = len(self._buffer or b"") + 7 - (command >> 1 & 7)
        if self._longest is not None and length > self._longest:
            refuse(Abort.TOO_LONG)
        is_last = bool(command & _IS_LAST)
        if is_last and self._announced is not None:
            _compare_lengths(length, self._announced)
        super().segmented_download(command, request)  # type: ignore[no-untyped-call]
        if is_last:
            self._end()

    def block_upload(self, data: bytes) -> None:  # noqa: ARG002 (canopen's signature)
        refuse(Abort.UNKNOWN_COMMAND)

    def request_aborted(self, data: bytes) -> None:
        super().request_aborted(data)  # type: ignore[no-untyped-call]
        self._end()

    def abort(self, abort_code: int = 0x08000000) -> None:
        self._end()
        super().abort(abort_code)  # type: ignore[no-untyped-call]

    def _end(self) -> None:
        self._buffer = bytearray()
        self._toggle = 0
        self._is_uploading = self._is_downloading = False
        self._announced = self._longest = None


def _compare_lengths(length: int, expected: int) -> None:
    if length != expected:
        refuse(Abort.TOO_LONG if length > expected else Abort.TOO_SHORT)


def read_eds(path: Path, node_id: int) -> canopen.ObjectDictionary:
    """Return the objects of an EDS or DCF file; `node_id` replaces $NODEID.

    Bytes that aren't UTF-8 are replaced. The result is cached by content and node id: don't change it. Raises OSError
    if the file can't be read.
    """
    return _parse_eds(path.read_bytes().decode("utf-8", "replace").removeprefix("\ufeff"), node_id)


@cache
def _parse_eds(text: str, node_id: int) -> canopen.ObjectDictionary:
    stream = io.StringIO(readable_eds(text))
    stream.name = "object dictionary.eds"
    return canopen.import_od(stream, node_id)


class LiveValue(NamedTuple):
    """The present value of another object (index, sub-index), times `ratio`."""

    key: tuple[int, int]
    ratio: float = 1.0


class MadeUp(NamedTuple):
    """An object that a real device has and its EDS omits: its name, its type, and its value at power-on."""

    name: str
    data_type: int
    value: int


@dataclass(frozen=True)
class DeviceDescription:
    """One device: its EDS, and further values of its objects at power-on.

    defaults: values in place of the EDS's. fallbacks: values for objects to which the EDS gives none. made_up: objects
    that the EDS omits, by index. aliases: objects that hold the live value of another.
    """

    eds: Path
    defaults: Values = field(default_factory=dict)
    fallbacks: Values = field(default_factory=dict)
    made_up: Mapping[int, MadeUp] = field(default_factory=dict)
    aliases: Mapping[tuple[int, int], LiveValue] = field(default_factory=dict)


def _read_objects(node_id: int, description: DeviceDescription) -> canopen.ObjectDictionary:
    """Return the objects of a device with their values at power-on.

    If the description adds values or objects to the EDS, a number without a value is 0.
    """
    objects = read_eds(description.eds, node_id)
    if not (description.defaults or description.fallbacks or description.made_up):
        return objects
    objects = copy.deepcopy(objects)
    for index, made in description.made_up.items():
        added = ODVariable(made.name, index)
        added.data_type, added.access_type, added.default = made.data_type, "rw", made.value
        objects.add_object(added)
    for index, entry in objects.items():
        for subindex, variable in {0: entry}.items() if isinstance(entry, ODVariable) else entry.subindices.items():
            key = (index, subindex)
            if key in description.defaults:
                variable.default = variable.value = description.defaults[key]
            elif variable.default is None and variable.value is None and variable.data_type in datatypes.NUMBER_TYPES:
                variable.default = description.fallbacks.get(key, 0)
    return objects


class _DictionaryNode(canopen.LocalNode):
    """canopen's local node with strict sub-indices and without its own heartbeat."""

    def __init__(self, node_id: int, description: DeviceDescription) -> None:
        super().__init__(node_id, _read_objects(node_id, description))
        self._write_callbacks.clear()  # NmtSlave.on_write would start a periodic task
        self.sdo = _Server(self)
        self.sdo._index = self.sdo._subindex = 0  # an abort before the first transfer needs an index to name

    def _find_object(self, index: int, subindex: int) -> ODVariable:
        """Return an object.

        Raise `Refusal` if the device lacks its index or sub-index, also for those that canopen would add.
        """
        if index < _FIRST_INDEX or index not in self.object_dictionary:
            refuse(Abort.NO_OBJECT)
        entry = self.object_dictionary[index]
        variables = {0: entry} if isinstance(entry, ODVariable) else entry.subindices
        if subindex not in variables:
            refuse(Abort.NO_SUBINDEX)
        return variables[subindex]


class ObjectDictionary:
    """The objects of one device: values from the EDS, live values, checked writes, and an SDO server."""

    def __init__(self, node_id: int, description: DeviceDescription, send: Send) -> None:
        """Read the EDS. Raises OSError if it can't be read. send: called with identifier and data of SDO answers."""
        self.node_id = node_id
        self._readers: dict[tuple[int, int], Callable[[], int]] = {}
        self._replaced: dict[tuple[int, int], Callable[[], int]] = {}
        self._checks: dict[tuple[int, int], list[Callable[[int], None]]] = {}
        self._appliers: dict[tuple[int, int], list[Callable[[int], None]]] = {}
        self.is_locked: Callable[[int, int], bool] = lambda _index, _subindex: False
        """Whether the state of the device forbids SDO to write an object now."""
        self._is_requested = False  # an SDO request is in progress
        self._node = _DictionaryNode(node_id, description)
        self._node.associate_network(_SilentNetwork(send))
        self._node.add_read_callback(self._read)  # type: ignore[no-untyped-call]
        self._node.add_write_callback(self._write)  # type: ignore[no-untyped-call]

    @property
    def objects(self) -> canopen.ObjectDictionary:
        """The objects that the device has: those of the EDS, and those that its description adds."""
        return self._node.object_dictionary

    def has(self, index: int, subindex: int = 0) -> bool:
        """Return whether the device has this object: the EDS lists it, or the description adds it."""
        try:
            self.find(index, subindex)
        except canopen.SdoAbortedError:
            return False
        return True

    def dummy_bits(self, index: int) -> int:
        """Return the size, bits, of a data type that the EDS lists for mapping as a dummy.

        It is 0 for other types and for objects.
        """
        if index >= _FIRST_INDEX or index not in self.objects:
            return 0
        return len(self.objects[index])

    def find(self, index: int, subindex: int) -> ODVariable:
        """Return an object's description; raise `Refusal` if the device lacks it."""
        return self._node._find_object(index, subindex)

    def serve(self, index: int, subindex: int, read: Callable[[], int]) -> None:
        """Read an object's value by `read()` from now on.

        A value set by `replace_value` has priority. A function that `reader` returned earlier keeps the source that it
        had, if any. An object that the device lacks stays absent.
        """
        self._readers[index, subindex] = read

    def reader(self, index: int, subindex: int) -> Callable[[], int]:
        """Return a function that reads a numeric object: its replaced value, its live value by `serve`, or as written.

        It keeps a replaced or live value's source of now. Without one it reads by `value`: a later `serve` or
        `replace_value` reaches it, and it raises `Refusal` for an object that the device lacks.
        """
        key = index, subindex
        return self._replaced.get(key) or self._readers.get(key) or (lambda: self.value(index, subindex))

    def replace_value(self, index: int, subindex: int, value: int | None) -> None:
        """Give a numeric object a value in place of its own; None: its own again.

        Reads by SDO and by `value` return it from now on; a function that `reader` returned before keeps the source
        that it had, if any. Writes go to the object's own value. An object that the device lacks stays absent.
        """
        if value is None:
            self._replaced.pop((index, subindex), None)
        else:
            self._replaced[index, subindex] = lambda: value

    def range_of(self, index: int, subindex: int) -> tuple[int, int]:
        """Return the least and the greatest value of an object's integer type, not of its limits in the EDS.

        Raise `Refusal` if the device lacks the object.
        """
        variable = self.find(index, subindex)
        bits, is_signed = len(variable), variable.data_type in datatypes.SIGNED_TYPES
        return (-(1 << bits - 1), (1 << bits - 1) - 1) if is_signed else (0, (1 << bits) - 1)

    def describe_misfit(self, index: int, subindex: int, value: int) -> str:
        """Return in a line why an object can't have this value: it is missing, no integer, or of a type too small.

        Empty if it can.
        """
        name = f"object 0x{index:04X}:{subindex}"
        if not self.has(index, subindex):
            return f"has no {name}"
        if self.find(index, subindex).data_type not in datatypes.INTEGER_TYPES:
            return f"{name} is no integer"
        low, high = self.range_of(index, subindex)
        return "" if low <= value <= high else f"{name} can't be {value}, {low} to {high} allowed"

    def watch(
        self,
        index: int,
        subindex: int,
        apply: Callable[[int], None] | None = None,
        check: Callable[[int], None] | None = None,
    ) -> None:
        """Register functions for writes of an object: `check` may `refuse` the value, then `apply` gets it.

        `apply` also gets the default when a reset restores it. Several functions of an object are called in the
        order of their registration. An object that the device lacks is never written, and nothing is registered.
        """
        if not self.has(index, subindex):
            return
        if check is not None:
            self._checks.setdefault((index, subindex), []).append(check)
        if apply is not None:
            self._appliers.setdefault((index, subindex), []).append(apply)

    def value(self, index: int, subindex: int = 0) -> int:
        """Return the present value of a numeric object: replaced, live, as written, or the EDS's.

        Raise `Refusal` if the device lacks the object, or if it has none of these.
        """
        variable = self.find(index, subindex)
        return int(variable.decode_raw(self._node.get_data(index, subindex)))

    def value_or(self, default: int, index: int, subindex: int = 0) -> int:
        """Return the present value of a numeric object; `default` if the device lacks the object.

        Raise `Refusal` if the object has no value.
        """
        return self.value(index, subindex) if self.has(index, subindex) else default

    def default_or(self, default: int, index: int, subindex: int = 0) -> int:
        """Return a numeric object's default by EDS and description, by a DCF its ParameterValue, whatever was written.

        It is `default` if the device lacks the object, or if none of them gives it one.
        """
        if not self.has(index, subindex):
            return default
        variable = self.find(index, subindex)
        value = variable.default if variable.value is None else variable.value
        return default if value is None else int(value)

    def take_over(self, index: int, subindex: int, value: int) -> bool:
        """Write an object with the checks of an SDO request except `is_locked`, and call the functions that watch it.

        Return False, with the object unchanged, if a check refuses it, or if it is read-only or absent. Raises
        ValueError for a value outside the object's type.
        """
        try:
            data = self.find(index, subindex).encode_raw(value)
            self._node.set_data(index, subindex, data, check_writable=True)
        except canopen.SdoAbortedError:
            return False
        return True

    def on_request(self, data: bytes, t_ns: int) -> None:
        """Answer an SDO request of 8 bytes through the `send` of the constructor."""
        self._is_requested = True
        try:
            self._node.sdo.on_request(0x600 + self.node_id, data, t_ns)  # type: ignore[no-untyped-call]
        finally:
            self._is_requested = False

    def restore(self, last: int) -> None:
        """Restore the defaults of all objects up to index `last`.

        Functions that watch them get the defaults, 0 without one; checks and `is_locked` don't count. Values of `serve`
        and `replace_value` stay.
        """
        for index in [index for index in self._node.data_store if index <= last]:
            del self._node.data_store[index]
        for (index, subindex), appliers in self._appliers.items():
            if index <= last:
                _call_all(appliers, self.default_or(0, index, subindex))

    def _read(self, index: int, subindex: int, od: object) -> int | None:  # noqa: ARG002 (canopen passes it by name)
        read = self._replaced.get((index, subindex)) or self._readers.get((index, subindex))
        return None if read is None else read()

    def _write(self, index: int, subindex: int, od: ODVariable, data: bytes) -> None:
        """Refuse a write that lock, the EDS's limits or a check forbid.

        Else pass the value to the functions that watch it. Values that aren't numbers are only checked for the lock.
        """
        if self._is_requested and self.is_locked(index, subindex):
            refuse(Abort.DEVICE_STATE)
        if od.data_type not in datatypes.NUMBER_TYPES:
            return
        value = int(od.decode_raw(bytes(data)))
        if od.max is not None and value > od.max:
            refuse(Abort.TOO_HIGH)
        if od.min is not None and value < od.min:
            refuse(Abort.TOO_LOW)
        key = (index, subindex)
        _call_all(self._checks.get(key, []), value)
        _call_all(self._appliers.get(key, []), value)


def _call_all(functions: list[Callable[[int], None]], value: int) -> None:
    for function in functions:
        function(value)


@dataclass(frozen=True)
class EmulatedContract:
    """A contract that the emulator plays: its DBC and its EDS, as file names within `contract_folder`.

    devices: the devices of an arm of one's own, in the order of `describe_device`; empty: those of the two EDS.
    period_us: time of a SYNC where no master can write 0x1006; 0: 1 ms.
    """

    dbc: str
    drive_eds: str
    sensor_eds: str
    devices: tuple[DeviceDescription, ...] = ()
    period_us: int = 0

    def describe_device(self, place: int) -> DeviceDescription:
        """Return the description of a device; place: 0 drive 1, 1 drive 2, 2 sensor 1, 3 sensor 2."""
        if self.devices:
            return self.devices[place]
        return DeviceDescription(contract_folder() / (self.drive_eds if place < JOINTS else self.sensor_eds))

    @property
    def path(self) -> Path:
        """Path of the DBC."""
        return contract_folder() / self.dbc


CONTRACTS = {
    "arm": EmulatedContract("arm.dbc", "drive.eds", "torque_sensor.eds"),
    "arm_fd": EmulatedContract("arm_fd.dbc", "drive_fd.eds", "torque_sensor_fd.eds"),
    "arm_fd_500us": EmulatedContract("arm_fd_500us.dbc", "drive_fd.eds", "torque_sensor_fd.eds"),
    "arm_stock": EmulatedContract("arm_stock.dbc", "stock_drive.eds", "int32_sensor.eds"),
}
"""By the name of the DBC file."""


def contract_of(codec: Codec) -> EmulatedContract:
    """Return the emulated contract with a DBC's file name.

    For other names return `arm`, or `arm_fd` if a frame is longer than `CLASSIC_BYTES`.
    """
    return CONTRACTS.get(codec.path.stem, CONTRACTS["arm_fd" if codec.is_fd else "arm"])


def playable_contract(codec: Codec) -> EmulatedContract:
    """Return the emulated contract with the frame layout of a DBC, even if its node ids are moved.

    Raises ConfigError if no contract has this layout.
    """
    for contract in CONTRACTS.values():
        if codec.path == contract.path:
            return contract
    offset = codec.node_id("Drive1Heartbeat") - load_codec().node_id("Drive1Heartbeat")
    for contract in CONTRACTS.values():
        with contextlib.suppress(CodecError):  # a node id that this contract can't have
            moved = move_contract(load_codec(contract.path), offset, codec.node_id("HostHeartbeat"))
            if moved.layout_digest == codec.layout_digest:
                return contract
    raise ConfigError(
        f"no emulated device has the frames of {codec.path.name}, layout digest 0x{codec.layout_digest:08X}; "
        f"the emulator plays {', '.join(CONTRACTS)}; `adacd-hil run` runs on the arm itself"
    )


def longest_pdo(codec: Codec) -> int:
    """Return the longest PDO of this contract's bus, bytes: `CLASSIC_BYTES`, with CAN FD the last of `FD_LENGTHS`."""
    return FD_LENGTHS[-1] if codec.is_fd else CLASSIC_BYTES
