"""The watchdogs of one emulated device: each trips once, says so by EMCY, and clears by itself when its cause has gone.

An EMCY's byte 3 is the number of the watchdog, its bytes 4 to 7 the device's time in ms at which that happened. 0x2210
keeps the last one and counts them. A fault that a watchdog caused is the drive's business and stays latched.
Source: CiA 301 (4.2), table 27 (0x8100 … 0x8250); CiA 402-1, error codes 0x6320 "parameter error" and 0x8700 "sync
controller".
"""

from enum import IntEnum

from firmware_sim.canopen.emergency_objects import ErrorReporter
from firmware_sim.canopen.object_dictionary import ObjectDictionary

_COUNT_SUB = 2  # 0x2210: counts are at sub-index 2 + number


class Watchdog(IntEnum):
    """Numbers of the watchdogs. Each says how it clears."""

    SYNC = 1  # a SYNC comes
    COMMAND = 2  # a valid command acts
    HEARTBEAT = 3  # the master's heartbeat comes, or is no longer monitored
    OPERATIONAL = 4  # NMT start
    LENGTH = 5  # a command frame of the right length comes
    SYNC_ORDER = 6  # 100 SYNCs in a row are right
    SYNC_LENGTH = 7  # a SYNC of the right length comes
    COMMAND_PDO = 8  # Enable operation is no longer asked for, or can be obeyed


ERROR_CODES = {
    # CiA 301 has no code for a missing SYNC (0x8140 is recovery from bus-off, 0x8240 a SYNC of the wrong length).
    Watchdog.SYNC: 0x8700,
    Watchdog.COMMAND: 0x8250,
    Watchdog.HEARTBEAT: 0x8130,
    Watchdog.OPERATIONAL: 0x8100,
    Watchdog.LENGTH: 0x8210,
    Watchdog.SYNC_ORDER: 0x8200,
    Watchdog.SYNC_LENGTH: 0x8240,
    Watchdog.COMMAND_PDO: 0x6320,
}
"""EMCY error code and 0x603F by watchdog."""

WARNINGS = frozenset({Watchdog.LENGTH, Watchdog.SYNC_ORDER, Watchdog.SYNC_LENGTH, Watchdog.COMMAND_PDO})
"""Those that never cause a fault."""


class Watchdogs:
    """Which watchdogs are tripped now, and what was."""

    def __init__(self, dictionary: ObjectDictionary) -> None:
        self.tripped: set[Watchdog] = set()
        self._last = 0
        self._last_ms = 0
        self._counts = dict.fromkeys(Watchdog, 0)
        dictionary.serve(0x2210, 1, lambda: self._last)
        dictionary.serve(0x2210, 2, lambda: self._last_ms & 0xFFFFFFFF)
        for watchdog in Watchdog:
            dictionary.serve(0x2210, _COUNT_SUB + watchdog, lambda w=watchdog: self._counts[w] & 0xFFFF)  # type: ignore[misc]

    def trip(self, watchdog: Watchdog, reporter: ErrorReporter, t_ns: int, time_ms: int) -> None:
        """Note and report a watchdog that isn't tripped yet. `time_ms`: on the device's clock."""
        if watchdog in self.tripped:
            return
        self.tripped.add(watchdog)
        self._last, self._last_ms = watchdog, time_ms
        self._counts[watchdog] += 1
        reporter.report(ERROR_CODES[watchdog], t_ns, watchdog, time_ms)

    def clear(self, watchdog: Watchdog, reporter: ErrorReporter, t_ns: int, time_ms: int) -> None:
        """Report that the cause of a tripped watchdog has gone."""
        if watchdog in self.tripped:
            self.tripped.remove(watchdog)
            reporter.report(0, t_ns, watchdog, time_ms)

    def reset(self) -> None:
        """Forget everything, as at power-on."""
        self.tripped.clear()
        self._last = self._last_ms = 0
        self._counts = dict.fromkeys(Watchdog, 0)
