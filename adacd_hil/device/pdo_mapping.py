"""PDO communication and mapping parameters of a device, written by CiA 301's procedure and read back.

A PDO is made invalid before anything of it is changed, the mapping is emptied before its entries are, and it becomes
valid last. PDOs that the contract doesn't know are switched off: a stock device's defaults would take bus time.
Source: CiA 301 (4.2), clauses 7.5.2.35 to 7.5.2.38.
"""

from adacd_hil.device.profile import ObjectName, PdoSettings
from adacd_hil.device.slave import Slave

NOT_VALID = 1 << 31
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
            _write(slave, pdo, _event_timer(slave, pdo, command_deadline_ms))
    for pdo in profile.pdo:
        _compare(slave, pdo, _event_timer(slave, pdo, command_deadline_ms))


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


def _write(slave: Slave, pdo: PdoSettings, event_timer_ms: int) -> None:
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


def _compare(slave: Slave, pdo: PdoSettings, event_timer_ms: int) -> None:
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
