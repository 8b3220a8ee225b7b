"""Error frames of SocketCAN: reports of a CAN controller's driver. Source: linux/can/error.h.

One frame may report several errors: the kind is the gravest of them, the text names all.
"""

from enum import Enum

from adacd_hil.wire.bus import Frame

ERROR_CLASS_MASK = 0x1FFFFFFF
"""Mask that subscribes to every error class."""

_TX_TIMEOUT, _ARBITRATION, _CONTROLLER, _PROTOCOL, _TRANSCEIVER = 0x001, 0x002, 0x004, 0x008, 0x010
_ACKNOWLEDGE, _BUS_OFF, _BUS_ERROR, _RESTARTED, _COUNTERS = 0x020, 0x040, 0x080, 0x100, 0x200
_DATA_BYTES = 8
_ACKNOWLEDGE_SLOT = 0x19


class TroubleKind(Enum):
    """Kinds of CAN errors, gravest first."""

    BUS_OFF = "bus-off"  # ends by a restart: restart-ms, or the interface down and up
    RESTARTED = "controller restarted"
    ERROR_PASSIVE = "error passive"  # an error counter over 127
    ERROR_WARNING = "error warning"  # an error counter over 95
    TRANSMIT_TIMEOUT = "transmit timeout"
    RECEIVE_OVERFLOW = "receive buffer overflow"
    TRANSMIT_OVERFLOW = "transmit buffer overflow"
    NO_ACKNOWLEDGE = "no acknowledgement"
    PROTOCOL = "protocol error"
    ARBITRATION_LOST = "arbitration lost"
    ERROR_ACTIVE = "error active again"
    OTHER = "unspecified error"


_GRAVITY = {kind: place for place, kind in enumerate(TroubleKind)}

_CONTROLLER_BITS = (
    (0x01, TroubleKind.RECEIVE_OVERFLOW, ""),
    (0x02, TroubleKind.TRANSMIT_OVERFLOW, ""),
    (0x04, TroubleKind.ERROR_WARNING, " (receiving)"),
    (0x08, TroubleKind.ERROR_WARNING, " (sending)"),
    (0x10, TroubleKind.ERROR_PASSIVE, " (receiving)"),
    (0x20, TroubleKind.ERROR_PASSIVE, " (sending)"),
    (0x40, TroubleKind.ERROR_ACTIVE, ""),
)
_PROTOCOL_TYPES = {
    0x01: "single bit",
    0x02: "form",
    0x04: "bit stuffing",
    0x08: "unable to send dominant bit",
    0x10: "unable to send recessive bit",
    0x20: "bus overload",
    0x40: "active error announcement",
    0x80: "while sending",
}
_PROTOCOL_PLACES = {
    0x02: "identifier bits 10-3",
    0x03: "start of frame",
    0x04: "remote request bit",
    0x05: "identifier extension bit",
    0x06: "identifier bits 2-0",
    0x07: "identifier bits 17-13",
    0x08: "CRC sequence",
    0x09: "reserved bit 0",
    0x0A: "data",
    0x0B: "data length code",
    0x0C: "remote request bit",
    0x0D: "reserved bit 1",
    0x0E: "identifier bits 4-0",
    0x0F: "identifier bits 12-5",
    0x12: "intermission",
    0x18: "CRC delimiter",
    _ACKNOWLEDGE_SLOT: "acknowledge slot",
    0x1A: "end of frame",
    0x1B: "acknowledge delimiter",
}
_WIRES = {
    0x04: "CAN-H no wire",
    0x05: "CAN-H short to battery",
    0x06: "CAN-H short to VCC",
    0x07: "CAN-H short to ground",
    0x40: "CAN-L no wire",
    0x50: "CAN-L short to battery",
    0x60: "CAN-L short to VCC",
    0x70: "CAN-L short to ground",
    0x80: "CAN-L short to CAN-H",
}


def is_bus_off(frame: Frame) -> bool:
    """Return whether an error frame reports bus-off. Call it with error frames only: others have data in that bit."""
    return bool(frame.can_id & _BUS_OFF)


def decode_error(frame: Frame) -> tuple[TroubleKind, str]:
    """Return the gravest kind in an error frame, and a text with all; missing data bytes count as zero.

    The error counters follow in the text if the frame has them. A frame without a known error is of kind OTHER. Raises
    ValueError for other frames.
    """
    if not frame.is_error:
        raise ValueError(f"frame 0x{frame.can_id:X} is not an error frame")
    data = frame.data.ljust(_DATA_BYTES, b"\0")
    found = [*_of_controller(frame.can_id, data), *_of_bus(frame.can_id, data)]
    if not found:
        found.append((TroubleKind.OTHER, TroubleKind.OTHER.value))
    text = ", ".join(dict.fromkeys(text for _, text in found))
    kind = min((kind for kind, _ in found), key=_GRAVITY.__getitem__)
    # Drivers older than the flag fill in the counters without it.
    if not frame.can_id & _COUNTERS and not any(data[6:8]):
        return kind, text
    return kind, f"{text}; error counters: sending {data[6]}, receiving {data[7]}"


def _of_controller(classes: int, data: bytes) -> list[tuple[TroubleKind, str]]:
    """Return (kind, text) of each error of controller, driver or transceiver in an error frame; [] without any.

    classes: the frame's identifier, whose bits are error classes. data: its eight bytes.
    """
    found = [
        (kind, kind.value)
        for bit, kind in (
            (_BUS_OFF, TroubleKind.BUS_OFF),
            (_RESTARTED, TroubleKind.RESTARTED),
            (_TX_TIMEOUT, TroubleKind.TRANSMIT_TIMEOUT),
        )
        if classes & bit
    ]
    if classes & _CONTROLLER:
        states = [(kind, kind.value + side) for bit, kind, side in _CONTROLLER_BITS if data[1] & bit]
        found += states or [(TroubleKind.OTHER, "unspecified controller error")]
    if classes & _TRANSCEIVER:
        wires = [_WIRES[part] for part in (data[4] & 0x0F, data[4] & 0xF0) if part in _WIRES]
        found.append((TroubleKind.OTHER, f"transceiver: {', '.join(wires) or 'unspecified'}"))
    return found


def _of_bus(classes: int, data: bytes) -> list[tuple[TroubleKind, str]]:
    """Return (kind, text) of each bus error in an error frame: acknowledgement, protocol, arbitration; [] without any.

    A bus error of none of these kinds counts as a protocol error. classes, data: as of `_of_controller`.
    """
    found = []
    is_slot_empty = bool(classes & _PROTOCOL) and data[3] == _ACKNOWLEDGE_SLOT
    if classes & _ACKNOWLEDGE or is_slot_empty:
        found.append((TroubleKind.NO_ACKNOWLEDGE, TroubleKind.NO_ACKNOWLEDGE.value))
    if classes & _PROTOCOL:
        types = ", ".join(text for bit, text in _PROTOCOL_TYPES.items() if data[2] & bit)
        place = _PROTOCOL_PLACES.get(data[3])
        details = " at ".join(filter(None, (types, place)))
        found.append((TroubleKind.PROTOCOL, f"protocol error ({details or 'unspecified'})"))
    if classes & _ARBITRATION:
        bit = f" in bit {data[0]}" if data[0] else ""
        found.append((TroubleKind.ARBITRATION_LOST, f"arbitration lost{bit}"))
    if classes & _BUS_ERROR and not found:
        found.append((TroubleKind.PROTOCOL, "bus error"))
    return found
