"""Communication and mapping record of one PDO: which writes are allowed when, and where objects lie in the frame.

A master writes a PDO while it is invalid (bit 31 of its COB-ID): number of entries to 0, entries, number of entries,
valid. A mapping that begins with the end-to-end header's objects makes protected frames. Dummy entries (data types
instead of objects) leave gaps in frames that are received. Source: CiA 301 (4.2), 7.5.2.35 to 7.5.2.38, and table 34
(restricted identifiers).
"""

import struct
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

from adacd_hil.wire.codec import MessageCodec
from adacd_hil.wire.contract_frames import NOT_VALID
from adacd_hil.wire.frame_lengths import CLASSIC_BYTES, FD_LENGTHS
from firmware_sim.canopen.object_dictionary import FORMATS, Abort, ObjectDictionary, Refusal, one_of, refuse

EVENT_DRIVEN = (254, 255)
"""Transmission types."""
_TYPES = (*range(241), *EVENT_DRIVEN)
_IS_EXTENDED = 1 << 29
_MAPPING = 0x200  # from a communication record to its mapping record

LAST_NODE = 32
LISTENED_IDS = frozenset(base + node for base in (0x200, 0x300, 0x400, 0x500) for node in range(1, LAST_NODE + 1))
"""Identifiers that an RPDO may have: those of RPDO1 to 4 of nodes 1 to 32. A real controller's acceptance filter is at
most as wide, and the emulator's kernel filter is this one."""


_RESTRICTED = (
    (0x000, 0x180),
    (0x581, 0x5FF),
    (0x601, 0x67F),
    (0x6E0, 0x6FF),
    (0x701, 0x7FF),
)


def _is_restricted(can_id: int) -> bool:
    """Return whether CiA 301, table 34, or SYNC, EMCY or TIME forbid an identifier to PDOs."""
    return any(low <= can_id <= high for low, high in _RESTRICTED)


class PdoRecord:
    """Communication and mapping record of one PDO: its objects, and its present configuration by them."""

    is_received: bool

    def __init__(
        self,
        dictionary: ObjectDictionary,
        index: int,
        messages: Mapping[int, MessageCodec],
        longest: int,
        refresh: Callable[[], None],
    ) -> None:
        """Read the defaults, and watch the record's objects.

        A default mapping that no master could write counts as empty. `messages`: the contract's, by identifier.
        `longest`: the longest frame, bytes. `refresh`: called after each write of the record except of inhibit time and
        mapping entries.
        """
        self._dictionary, self._longest, self._messages, self._refresh = dictionary, longest, messages, refresh
        self.layout = NOTHING
        self.can_id = dictionary.value(index, 1) & 0x7FF
        self.message = messages.get(self.can_id)
        """The contract's message with the PDO's default COB-ID; None without one."""
        self._is_valid = not dictionary.value(index, 1) & NOT_VALID
        self._can_be_invalid = dictionary.find(index, 1).writable
        self.type = dictionary.value_or(EVENT_DRIVEN[-1], index, 2)
        self.inhibit_ns = dictionary.value_or(0, index, 3) * 100_000
        self.timer_ns = dictionary.value_or(0, index, 5) * 1_000_000
        mapping = index + _MAPPING
        self._entries = [
            dictionary.value(mapping, sub) for sub in range(1, 65) if dictionary.has(mapping, sub)
        ]  # sub-indices without gaps
        self._set_count(dictionary.value(mapping, 0))
        dictionary.watch(index, 1, self._identify, self._check_cob_id)
        dictionary.watch(index, 2, self._set_type, one_of(*_TYPES))
        dictionary.watch(index, 3, self._set_inhibit, self._check_inhibit)
        dictionary.watch(index, 5, self._set_timer)
        # Entries before their number: a reset restores them in this order.
        for place in range(len(self._entries)):
            set_entry, check = partial(self._entries.__setitem__, place), partial(self._check_entry, place)
            dictionary.watch(mapping, place + 1, set_entry, check)
        dictionary.watch(mapping, 0, self._map, self._check_count)

    @property
    def is_active(self) -> bool:
        """Whether the PDO is exchanged in Operational: its COB-ID is valid and it maps an object."""
        return self._is_valid and self._count > 0

    @property
    def is_synchronous(self) -> bool:
        """Whether the transmission type is 0 to 240: the PDO is sent, or acts, on SYNC."""
        return self.type not in EVENT_DRIVEN

    def _check_cob_id(self, value: int) -> None:
        can_id = value & 0x7FF
        if value & _IS_EXTENDED or value & 0x1FFFF800 or _is_restricted(can_id):
            refuse(Abort.VALUE_RANGE)
        if self.is_received and can_id not in LISTENED_IDS and can_id not in self._messages:
            refuse(Abort.VALUE_RANGE)
        if self._is_valid and not value & NOT_VALID and can_id != self.can_id:
            refuse(Abort.DEVICE_STATE)

    def _identify(self, value: int) -> None:
        self.can_id = value & 0x7FF
        self._is_valid = not value & NOT_VALID
        self._refresh()

    def _set_type(self, value: int) -> None:
        self.type = value
        self._refresh()

    @property
    def _is_held(self) -> bool:
        """Whether a master must make the PDO invalid before changing it: it is valid, and its COB-ID is writable."""
        return self._is_valid and self._can_be_invalid

    def _check_inhibit(self, value: int) -> None:
        if self._is_held and value * 100_000 != self.inhibit_ns:
            refuse(Abort.DEVICE_STATE)

    def _set_inhibit(self, tenths_ms: int) -> None:
        self.inhibit_ns = tenths_ms * 100_000

    def _set_timer(self, period_ms: int) -> None:
        self.timer_ns = period_ms * 1_000_000
        self._refresh()

    def _check_entry(self, place: int, value: int) -> None:
        if value == self._entries[place]:
            return
        if self._is_held or self._count != 0:
            refuse(Abort.DEVICE_STATE)
        if value != 0:
            check_entry(self._dictionary, value, self.is_received)

    def _check_count(self, value: int) -> None:
        if value == self._count:
            return
        if self._is_held:
            refuse(Abort.DEVICE_STATE)
        if value > len(self._entries):
            refuse(Abort.PDO_TOO_LONG)
        self._lay_out(value)

    def _map(self, value: int) -> None:
        self._set_count(value)
        self._refresh()

    def _set_count(self, count: int) -> None:
        """Map the first `count` entries, or none if no master could write them, as the defaults of some EDS."""
        try:
            self._lay_out(count)
        except Refusal:
            self.layout, count = NOTHING, 0
        self._count = count

    def _lay_out(self, count: int) -> None:
        """Set `layout` by the first `count` entries. Raise `Refusal` and change nothing if they can't be mapped."""
        layout = lay_out(self._dictionary, self._entries[:count], self.is_received, self._longest)
        if layout.header_bytes and not self._has_data_ids(layout.header_bytes):
            refuse(Abort.INCOMPATIBLE)
        self.layout = layout

    def _has_data_ids(self, header_bytes: int) -> bool:
        message = self.message
        return message is not None and message.is_protected and message.header_bytes == header_bytes


_HEADERS = {
    2: ((0x2100, 1), (0x2100, 2)),  # AUTOSAR Profile 2: CRC; counter and status
    4: ((0x2101, 1), (0x2101, 2), (0x2101, 3)),  # Profile 5: CRC, counter, status
}
_HEADER_OBJECTS = {key for keys in _HEADERS.values() for key in keys}


class PdoLayout(NamedTuple):
    """Layout of a frame: `header_bytes` of the end-to-end header, the values of the objects `keys`, padding.

    packing: format of values and padding. length: of the whole frame, bytes.
    """

    keys: tuple[tuple[int, int], ...]
    packing: struct.Struct
    header_bytes: int
    length: int


NOTHING = PdoLayout((), struct.Struct("<"), 0, 0)


def check_entry(dictionary: ObjectDictionary, value: int, is_received: bool) -> str:
    """Return the `struct` format of a mapping entry; raise `Refusal` if it can't be mapped in this direction.

    An entry is index << 16 | sub-index << 8 | bits; the format of a dummy, for RPDOs only, is padding. is_received: it
    is of an RPDO, so the object must be writable; else readable. Causes: the object is missing, not mappable, without
    that access, of another size, or of a type that FORMATS lacks.
    """
    index, subindex, bits = value >> 16, value >> 8 & 0xFF, value & 0xFF
    dummy_bits = dictionary.dummy_bits(index)
    if dummy_bits:
        if not is_received or subindex != 0 or bits != dummy_bits:
            refuse(Abort.NOT_MAPPABLE)
        return f"{bits // 8}x"
    variable = dictionary.find(index, subindex)
    # rww is for receiving only
    access = variable.access_type
    is_reachable = access in ("rw", "rww", "wo") if is_received else access not in ("wo", "rww")
    size, kind = len(variable), FORMATS.get(variable.data_type or 0, "")
    if not (variable.pdo_mappable and is_reachable and kind and size % 8 == 0) or bits != size:
        refuse(Abort.NOT_MAPPABLE)
    return kind


def lay_out(dictionary: ObjectDictionary, values: Sequence[int], is_received: bool, longest: int) -> PdoLayout:
    """Return the layout of a frame with the mapped objects (`values`: entries as in `check_entry`), in their order.

    Raises `Refusal` for an invalid entry, more than `longest` bytes, or a header that is incomplete or doesn't lead.
    Frames of more than CLASSIC_BYTES are padded to one of CAN FD's lengths. is_received: of an RPDO.
    """
    formats = [check_entry(dictionary, value, is_received) for value in values]
    size = sum(value & 0xFF for value in values) // 8
    if size > longest:
        refuse(Abort.PDO_TOO_LONG)
    keys = [(value >> 16, value >> 8 & 0xFF) for value in values]
    header_bytes = next((n for n, header in _HEADERS.items() if tuple(keys[: len(header)]) == header), 0)
    skipped = len(_HEADERS[header_bytes]) if header_bytes else 0
    if any(key in _HEADER_OBJECTS for key in keys[skipped:]):
        refuse(Abort.INCOMPATIBLE)
    length = size if size <= CLASSIC_BYTES else next(n for n in FD_LENGTHS if n >= size)
    packing = struct.Struct("<" + "".join(formats[skipped:]) + f"{length - size}x")
    mapped = tuple(key for key in keys[skipped:] if not dictionary.dummy_bits(key[0]))
    return PdoLayout(mapped, packing, header_bytes, length)
