"""The true contacts of a run, read from the emulator's log in constant memory but for the contacts themselves."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from adacd_hil.analysis.timing import Cycles
from adacd_hil.analysis.touches import filtered
from adacd_hil.log.stream import LogStream
from adacd_hil.records import Vector


@dataclass(frozen=True)
class TrueContact:
    """A true contact. onset, end: its first cycle and the first one without it. tau_ext (k, 2), cycle (k,): of both."""

    link: int
    onset: int
    end: int
    tau_ext: Vector
    cycle: Cycles

    def forgotten_after_s(self, period_s: float, a_rad_s: float, threshold: Vector) -> float:
        """Give how long after its end a detection may still stem from it, s; see `touches.forgotten_s`."""
        last = filtered(self.tau_ext, self.cycle, period_s, a_rad_s)[-1]
        excess = float(np.max(np.abs(last) / threshold))
        return (1.0 + float(np.log(max(1.0, excess)))) / a_rad_s


def read_contacts(path: Path) -> tuple[TrueContact, ...]:
    """Read the true contacts of a run from its truth.mcap. Raises LogError."""
    contacts: list[TrueContact] = []
    held: list[Any] = []  # records of the contact that the piece before ended in
    for piece in LogStream(path, ("/truth",)):
        records = piece.series["/truth"].records
        if not len(records):
            continue
        if held:
            records = np.concatenate((*held, records))
            held = []
        index = records["contact_index"].reshape(-1)
        edges = np.flatnonzero(index[1:] != index[:-1]) + 1
        starts = np.concatenate(([0], edges)).tolist()
        ends = [*edges.tolist(), len(index)]
        for start, end in zip(starts, ends, strict=True):
            if index[start] >= 0 and end < len(index):
                contacts.append(_contact(records[start : end + 1]))
            elif index[start] >= 0:
                held = [records[start:]]
    return (*contacts, *(_contact(records) for records in held))


def _contact(records: Any) -> TrueContact:
    cycle = records["cycle"].astype(np.int64)
    return TrueContact(
        link=int(records["contact_link"].reshape(-1)[0]),
        onset=int(cycle[0]),
        end=int(cycle[-1]),
        tau_ext=records["tau_ext"].astype(np.float64),
        cycle=cycle,
    )
