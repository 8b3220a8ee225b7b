"""The torque that a drive asks of its motor in cyclic synchronous torque, per mille of rated torque.

    demand 0x6074 = target 0x6071 + offset 0x60B2, within −min(0x6072, 0x60E1) … +min(0x6072, 0x60E0)

Source: CiA 402-2 (IEC 61800-7-201), cyclic synchronous torque mode.
"""

from firmware_sim.canopen.object_dictionary import ObjectDictionary
from firmware_sim.canopen.pdo import Pdos

_UNLIMITED = 0xFFFF  # where the EDS lacks a limit


class TorqueLimits:
    """Target, offset and limits, as written by SDO or PDO."""

    def __init__(self, dictionary: ObjectDictionary, pdos: Pdos) -> None:
        self.target = 0
        self._offset = self._max = self._positive = self._negative = 0
        self._low = self._high = 0
        dictionary.serve(0x6071, 0, lambda: self.target)
        dictionary.serve(0x60B2, 0, lambda: self._offset)
        dictionary.serve(0x6072, 0, lambda: self._max)
        dictionary.serve(0x60E0, 0, lambda: self._positive)
        dictionary.serve(0x60E1, 0, lambda: self._negative)
        for index, take, default in (
            (0x6071, self._set_target, 0),
            (0x60B2, self._set_offset, 0),
            (0x6072, self._set_max, _UNLIMITED),
            (0x60E0, self._set_positive, _UNLIMITED),
            (0x60E1, self._set_negative, _UNLIMITED),
        ):
            pdos.accept(index, 0, take)
            dictionary.watch(index, 0, take)
            take(dictionary.default_or(default, index))

    def demand(self) -> int:
        """Return 0x6074 of an enabled drive."""
        wanted = self.target + self._offset
        if self._low <= wanted <= self._high:
            return wanted
        return self._high if wanted > self._high else self._low

    @property
    def is_limiting(self) -> bool:
        """Whether a limit is in force, statusword bit 11."""
        return not self._low <= self.target + self._offset <= self._high

    def _set_target(self, permille: int) -> None:
        self.target = permille

    def _set_offset(self, permille: int) -> None:
        self._offset = permille

    def _set_max(self, permille: int) -> None:
        self._max = permille
        self._combine()

    def _set_positive(self, permille: int) -> None:
        self._positive = permille
        self._combine()

    def _set_negative(self, permille: int) -> None:
        self._negative = permille
        self._combine()

    def _combine(self) -> None:
        """Of several limits the smallest counts."""
        self._high = min(self._max, self._positive)
        self._low = -min(self._max, self._negative)
