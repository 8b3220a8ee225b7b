"""PDOs as a device has them configured, read over SDO, and where they differ from the contract.

Source: CiA 301 (4.2), clauses 7.5.2.35 to 7.5.2.38: objects 0x1400, 0x1600, 0x1800, 0x1A00 and those that follow.
"""

from typing import Any, NamedTuple

from adacd_hil.device.canopen_bus import read_object
from adacd_hil.wire.codec import Codec, MessageCodec, SignalCodec

_RECEIVED, _SENT = 0x1400, 0x1800
_MOST_PDOS = 8
_NOT_VALID = 1 << 31
_PDO_FUNCTIONS = (0x180, 0x200, 0x280, 0x300, 0x380, 0x400, 0x480, 0x500)

SIGNAL_OBJECTS = {
    "position": 0x6064,
    "velocity": 0x606C,
    "statusword": 0x6041,
    "mode_display": 0x6061,
    "torque_actual": 0x6077,
    "torque_demand": 0x6074,
    "error_code": 0x603F,
    "error_register": 0x1001,
    "controlword": 0x6040,
    "target_torque": 0x6071,
    "torque_offset": 0x60B2,
    "max_torque": 0x6072,
    "torque": 0x9130,
    "status": 0x6150,
}
"""CiA 301, 402 and 404: the object behind a signal's name. Signals of other names are compared by their place."""


class MappedObject(NamedTuple):
    """One entry of a mapping."""

    object_index: int
    subindex: int
    bits: int


class Pdo(NamedTuple):
    """One PDO that is in use."""

    can_id: int
    objects: tuple[MappedObject, ...]


def read_pdos(node: Any) -> list[Pdo]:
    """Read all PDOs of a node that are valid, received ones first. Raises DeviceError, BusError."""
    return [
        pdo
        for first in (_RECEIVED, _SENT)
        for index in range(first, first + _MOST_PDOS)
        if (pdo := _read_pdo(node, index)) is not None
    ]


def _read_pdo(node: Any, index: int) -> Pdo | None:
    cob_id = _read_number(node, index, 1)
    if cob_id is None or cob_id & _NOT_VALID:
        return None
    count = _read_number(node, index + 0x200, 0) or 0
    entries = (_read_number(node, index + 0x200, subindex) or 0 for subindex in range(1, count + 1))
    objects = tuple(MappedObject(entry >> 16, entry >> 8 & 0xFF, entry & 0xFF) for entry in entries)
    return Pdo(cob_id & 0x7FF, objects)


def _read_number(node: Any, index: int, subindex: int) -> int | None:
    data = read_object(node, index, subindex)
    return None if data is None else int.from_bytes(data, "little")


def contract_differences(codec: Codec, node_id: int, pdos: list[Pdo]) -> list[str]:
    """Say where the PDOs of a node are not the contract's, one line each."""
    by_id = {pdo.can_id: pdo for pdo in pdos}
    lines = []
    for message in codec.messages.values():
        if message.can_id & 0x7F != node_id or message.can_id & 0x780 not in _PDO_FUNCTIONS:
            continue
        pdo = by_id.get(message.can_id)
        if pdo is None:
            lines.append(f"{message.name}: the device has no PDO with identifier 0x{message.can_id:03X}")
        else:
            lines.extend(_differences(message, pdo))
    return lines


def _differences(message: MessageCodec, pdo: Pdo) -> list[str]:
    total = sum(entry.bits for entry in pdo.objects)
    if total != 8 * message.length:
        return [f"{message.name}: {total} bits are mapped, the contract has {8 * message.length}"]
    places = {}
    bit = 0
    for entry in pdo.objects:
        places[bit] = entry
        bit += entry.bits
    lines = []
    bit = 0
    for signal in message.signals:
        wanted = SIGNAL_OBJECTS.get(signal.name)
        found = places.get(bit)
        width = _bits(signal)
        if wanted is not None and (found is None or found.object_index != wanted or found.bits != width):
            there = "no object" if found is None else f"0x{found.object_index:04X} with {found.bits} bits"
            lines.append(f"{message.name}.{signal.name}: {there} at bit {bit}, not 0x{wanted:04X} with {width}")
        bit += width
    return lines


def _bits(signal: SignalCodec) -> int:
    return (signal.raw_high - signal.raw_low).bit_length()
