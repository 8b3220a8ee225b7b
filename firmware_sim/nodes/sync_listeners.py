"""The devices as listeners to SYNC: who takes one of which length, and what each is told of the odd and the lost."""

from collections.abc import Sequence

from firmware_sim.canopen.sync_order import SyncKind
from firmware_sim.nodes.device import Device

LONGEST_OVERFLOW = 240
"""Of 0x1019."""


class SyncListeners:
    """All devices of a bench. A SYNC in its place costs nothing here."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self._devices = devices
        self.everybody = (1,) * len(devices)
        """Every device, once each."""
        self._nobody = (0,) * len(devices)
        self._unheard = [0] * len(devices)
        self._takers: dict[int, tuple[int, ...]] = {}
        self.overflow = LONGEST_OVERFLOW
        """The last SYNC counter before 1."""
        self.is_remembering = False
        """Whether a device remembers a SYNC that was odd or lost, and wants to be told of right ones, too."""
        for device in devices:
            device.watch(0x1019, 0, lambda _: self._sort())
        self._sort()

    def restart(self) -> None:
        """Take the next SYNC for the first."""
        self._unheard = [0] * len(self._devices)

    def takers(self, data: bytes) -> tuple[int, ...]:
        """Give 1 for each device that takes SYNCs of this length, by its 0x1019; else 0."""
        return self._takers.get(len(data), self._nobody)

    def tell(self, heard: Sequence[int], takers: Sequence[int], kind: SyncKind, lost: int, t_ns: int) -> None:
        """Tell what a SYNC is and how many were lost before it. `heard`: how often each device hears it."""
        for place, device in enumerate(self._devices):
            self._unheard[place] += lost
            if heard[place] == 0:
                self._unheard[place] += 1
                continue
            device.note_sync(kind if takers[place] else SyncKind.WRONG_LENGTH, self._unheard[place], t_ns)
            self._unheard[place] = 0
            for _ in range(heard[place] - 1):
                device.note_sync(SyncKind.REPEATED, 0, t_ns)
        self._remember()

    def ignore(self, heard: Sequence[int], takers: Sequence[int], kind: SyncKind, t_ns: int) -> None:
        """Tell what a SYNC is that nobody answers."""
        for place, device in enumerate(self._devices):
            for _ in range(heard[place]):
                device.note_sync(kind if takers[place] else SyncKind.WRONG_LENGTH, 0, t_ns)
        self._remember()

    def miss(self, count: int) -> None:
        """Keep SYNCs from all devices."""
        self._unheard = [unheard + count for unheard in self._unheard]
        self._remember()

    def _remember(self) -> None:
        self.is_remembering = any(self._unheard) or any(device.is_sync_odd for device in self._devices)

    def _sort(self) -> None:
        overflows = [device.sync_overflow for device in self._devices]
        self._takers = {
            0: tuple(int(not overflow) for overflow in overflows),
            1: tuple(int(overflow != 0) for overflow in overflows),
        }
        self.overflow = next((overflow for overflow in overflows if overflow), LONGEST_OVERFLOW)
