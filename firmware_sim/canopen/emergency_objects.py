"""EMCY producer and error history of one emulated device.

Source: CiA 301 (4.2), 7.2.7, objects 0x1001, 0x1003, 0x1014, 0x1015.
"""

import struct
from collections import deque
from collections.abc import Callable

from firmware_sim.canopen.object_dictionary import NEVER_NS, Abort, ObjectDictionary, Send, refuse

HISTORY_LENGTH = 4
"""Entries of 0x1003 in the EDS files."""
_NOT_VALID = 1 << 31  # of a COB-ID entry
_EMERGENCY = struct.Struct("<HBBI")


class ErrorReporter:
    """Sends EMCY messages with inhibit time and remembers their codes, newest first."""

    def __init__(
        self, dictionary: ObjectDictionary, send: Send, register: Callable[[], int], is_allowed: Callable[[], bool]
    ) -> None:
        """`register`: present 0x1001. `is_allowed`: whether the NMT state lets EMCY be sent."""
        self._send = send
        self._register = register
        self._is_allowed = is_allowed
        self._waiting: deque[bytes] = deque()
        self._inhibit_ns = 0
        self._allowed_ns = 0
        self._is_valid = True
        self._cob_id = 0x80 + dictionary.node_id
        self._history: deque[int] = deque(maxlen=HISTORY_LENGTH)
        dictionary.serve(0x1001, 0, register)
        dictionary.serve(0x1003, 0, lambda: len(self._history))
        for sub in range(1, HISTORY_LENGTH + 1):
            dictionary.serve(0x1003, sub, lambda sub=sub: self._past_error(sub))  # type: ignore[misc]
        dictionary.watch(0x1003, 0, self._clear_history, _check_zero)
        dictionary.watch(0x1014, 0, self._validate, self._check_cob_id)
        dictionary.watch(0x1015, 0, self._set_inhibit)

    def report(self, code: int, t_ns: int, number: int = 0, time_ms: int = 0) -> None:
        """Send an EMCY. `number`, `time_ms`: the manufacturer's part, which watchdog and when on the device's clock."""
        if code != 0:
            self._history.appendleft(code)
        if self._is_valid and self._is_allowed():
            self._waiting.append(_EMERGENCY.pack(code, self._register(), number, time_ms & 0xFFFFFFFF))
            self.poll(t_ns)

    def report_at_once(self, code: int, t_ns: int) -> None:
        """Send an EMCY without regard to the inhibit time and to those that wait."""
        self._history.appendleft(code)
        if self._is_valid and self._is_allowed():
            self._allowed_ns = t_ns + self._inhibit_ns
            self._send(self._cob_id, _EMERGENCY.pack(code, self._register(), 0, 0))

    def reset(self) -> None:
        """Forget everything, as at power-on."""
        self._waiting.clear()
        self._history.clear()
        self._allowed_ns = 0

    def poll(self, t_ns: int) -> int:
        """Send what the inhibit time held back; return when to look again."""
        while self._waiting and t_ns >= self._allowed_ns:
            self._allowed_ns = t_ns + self._inhibit_ns
            self._send(self._cob_id, self._waiting.popleft())
        return self._allowed_ns if self._waiting else NEVER_NS

    def _past_error(self, sub: int) -> int:
        if sub > len(self._history):
            refuse(Abort.NO_DATA)
        return self._history[sub - 1]

    def _clear_history(self, _value: int) -> None:
        self._history.clear()

    def _check_cob_id(self, value: int) -> None:
        if value & ~_NOT_VALID != self._cob_id:
            refuse(Abort.VALUE_RANGE)

    def _validate(self, value: int) -> None:
        self._is_valid = not value & _NOT_VALID

    def _set_inhibit(self, tenths_ms: int) -> None:
        self._inhibit_ns = tenths_ms * 100_000


def _check_zero(value: int) -> None:
    if value != 0:
        refuse(Abort.VALUE_RANGE)
