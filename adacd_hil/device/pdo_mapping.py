"""PDOs of a device: written by CiA 301's procedure and read back, or read and compared with the contract.

A PDO is made invalid before anything of it is changed, the mapping is emptied before its entries are, and it becomes
valid last. PDOs that the contract doesn't know are switched off: a stock device's defaults would take bus time.
Source: CiA 301 (4.2), clauses 7.5.2.35 to 7.5.2.38.
"""

from typing import Any, NamedTuple

from adacd_hil.device.canopen_bus import read_object
from adacd_hil.device.device_setup import Slave
from adacd_hil.device.profile import ObjectName, PdoSettings
from adacd_hil.wire.bus import MAX_STANDARD_ID
from adacd_hil.wire.codec import Codec, MessageCodec
from adacd_hil.wire.contract_frames import NOT_VALID

RTR_NOT_ALLOWED = 1 << 30
_COB_ID, _TYPE, _INHIBIT, _EVENT_TIMER = 1, 2, 3, 5
_RECORDS = (*range(0x1400, 0x1600), *range(0x1800, 0x1A00))


def set_up_pdos(slave: Slave, command_deadline_ms: int) -> None:
    """Bring all PDOs of a device into the form of its profile; a fixed mapping is only compared. Raises DeviceError.

    `command_deadline_ms`: event timer of the command PDO where the profile has the deadline there.
    """
    profile = slave.device.settings
    for pdo in profile.pdo:
        if not slave.has(pdo.communication_index, _COB_ID) or not slave.has(pdo.mapping_index, 0):
            slave.fail(
                f"{pdo.message}: 0x{pdo.communication_index:04X} and 0x{pdo.mapping_index:04X} are not in the EDS"
            )
    if profile.mapping == "writable":
        _switch_off_others(slave)
        for pdo in profile.pdo:
            _write_pdo(slave, pdo, _event_timer(slave, pdo, command_deadline_ms))
    for pdo in profile.pdo:
        _compare_pdo(slave, pdo, _event_timer(slave, pdo, command_deadline_ms))


def _event_timer(slave: Slave, pdo: PdoSettings, command_deadline_ms: int) -> int:
    has_deadline = pdo.is_received and slave.device.settings.command_watchdog == "0x1400:5"
    return command_deadline_ms if has_deadline else pdo.event_timer_ms


def _switch_off_others(slave: Slave) -> None:
    used = {pdo.communication_index for pdo in slave.device.settings.pdo}
    for index in _RECORDS:
        if index in used or not slave.has(index, _COB_ID):
            continue
        cob_id = slave.read(index, _COB_ID)
        if not cob_id & NOT_VALID:
            slave.write(index, _COB_ID, cob_id | NOT_VALID)


def _write_pdo(slave: Slave, pdo: PdoSettings, event_timer_ms: int) -> None:
    index, mapping_index = pdo.communication_index, pdo.mapping_index
    kept = slave.read(index, _COB_ID) & RTR_NOT_ALLOWED
    cob_id = slave.device.can_id(pdo) | kept
    slave.write(index, _COB_ID, cob_id | NOT_VALID)
    slave.write(mapping_index, 0, 0)
    entries = slave.device.mapping(pdo)
    for sub, entry in enumerate(entries, 1):
        slave.write(mapping_index, sub, entry)
    slave.write(mapping_index, 0, len(entries))
    slave.write(index, _TYPE, pdo.transmission)
    for sub, value in ((_INHIBIT, pdo.inhibit_100us), (_EVENT_TIMER, event_timer_ms)):
        if slave.has(index, sub):
            slave.write(index, sub, value)
        elif value:
            slave.fail(f"{ObjectName(index, sub)} is not in the EDS, {value} wanted")
    slave.write(index, _COB_ID, cob_id)


def _compare_pdo(slave: Slave, pdo: PdoSettings, event_timer_ms: int) -> None:
    index, mapping_index = pdo.communication_index, pdo.mapping_index
    found = slave.read(index, _COB_ID) & ~RTR_NOT_ALLOWED
    expected = slave.device.can_id(pdo)
    if found != expected:
        slave.fail(f"identifier {ObjectName(index, _COB_ID)} = 0x{found:X}, 0x{expected:X} expected")
    slave.expect(index, _TYPE, pdo.transmission, "transmission type")
    if slave.device.settings.mapping == "writable":
        for sub, value, quantity, unit in (
            (_INHIBIT, pdo.inhibit_100us, "inhibit time", "x 100 µs"),
            (_EVENT_TIMER, event_timer_ms, "event timer", "ms"),
        ):
            if slave.has(index, sub):
                slave.expect(index, sub, value, quantity, unit)
    entries = slave.device.mapping(pdo)
    slave.expect(mapping_index, 0, len(entries), "number of mapped objects")
    for sub, entry in enumerate(entries, 1):
        slave.expect(mapping_index, sub, entry, "mapped object", is_hex=True)


_RECEIVED, _SENT = 0x1400, 0x1800
_MOST_PDOS = 8
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
    if cob_id is None or cob_id & NOT_VALID:
        return None
    count = _read_number(node, index + 0x200, 0) or 0
    entries = (_read_number(node, index + 0x200, subindex) or 0 for subindex in range(1, count + 1))
    objects = tuple(MappedObject(entry >> 16, entry >> 8 & 0xFF, entry & 0xFF) for entry in entries)
    return Pdo(cob_id & MAX_STANDARD_ID, objects)


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
        width = signal.bits
        if wanted is not None and (found is None or found.object_index != wanted or found.bits != width):
            there = "no object" if found is None else f"0x{found.object_index:04X} with {found.bits} bits"
            lines.append(f"{message.name}.{signal.name}: {there} at bit {bit}, not 0x{wanted:04X} with {width}")
        bit += width
    return lines
