"""The true contacts of a run, read from the emulator's log in constant memory but for the contacts themselves."""

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.analysis.host_cycles import EmulatorSpan, whole_rounds
from adacd_hil.analysis.score.touches import filtered
from adacd_hil.analysis.timing import Cycles
from adacd_hil.log.stream import LogStream
from adacd_hil.records import Vector


@dataclass(frozen=True)
class TrueContact:
    """A true contact. onset, end: its first cycle and the first one without it. tau_ext (k, 2), cycle (k,): of both.

    Cycles are the emulator's, in the `attempt` of the run, from 0; `counted_from` makes them the host's.
    """

    attempt: int
    link: int
    onset: int
    end: int
    tau_ext: Vector
    cycle: Cycles

    def counted_from(self, first_cycle: int) -> "TrueContact":
        """Return it with the cycles of the host, for which the attempt begins with the given one."""
        shift = int(whole_rounds(np.array(first_cycle)))
        return replace(self, onset=self.onset + shift, end=self.end + shift, cycle=self.cycle + shift)

    def forgotten_after_s(self, period_s: float, a_rad_s: float, threshold: Vector) -> float:
        """Give how long after its end a detection may still stem from it, s; see `touches.forgotten_s`."""
        last = filtered(self.tau_ext, self.cycle, period_s, a_rad_s)[-1]
        excess = float(np.max(np.abs(last) / threshold))
        return (1.0 + float(np.log(max(1.0, excess)))) / a_rad_s


class TrueContacts(NamedTuple):
    """The true contacts of a run, in order, and of which cycles they are known."""

    contacts: tuple[TrueContact, ...]
    span: EmulatorSpan


def read_contacts(path: Path) -> TrueContacts | None:
    """Read the true contacts of a run from its truth.mcap; None where the emulator never cycled. Raises LogError."""
    contacts: list[TrueContact] = []
    first: tuple[int, int] | None = None
    held: NDArray[Any] | None = None  # records of the contact that the piece before ended in
    attempt, last = 0, -1
    for piece in LogStream(path, ("/truth",)):
        new = piece.series["/truth"].records
        if not len(new):
            continue
        records = new if held is None else np.concatenate((held, new))
        cycle = records["cycle"].astype(np.int64)
        is_anew = np.diff(cycle, prepend=last if held is None else cycle[0]) < 0
        index = records["contact_index"].reshape(-1)
        edges = np.flatnonzero((np.diff(index, prepend=index[0]) != 0) | is_anew).tolist()
        attempts = attempt + np.cumsum(is_anew)
        first = first or (int(attempts[0]), int(cycle[0]))
        held = None
        for start, end in pairwise(sorted({0, *edges, len(index)})):
            if index[start] >= 0 and end < len(index):
                is_same_attempt = attempts[end] == attempts[start]
                contacts.append(_contact(int(attempts[start]), records[start : end + int(is_same_attempt)]))
            elif index[start] >= 0:
                held = records[start:]
        attempt, last = int(attempts[-1]), int(cycle[-1])
    if first is None:
        return None
    last_contact = () if held is None else (_contact(attempt, held),)
    return TrueContacts((*contacts, *last_contact), (first, (attempt, last)))


def _contact(attempt: int, records: NDArray[Any]) -> TrueContact:
    cycle = records["cycle"].astype(np.int64)
    return TrueContact(
        attempt=attempt,
        link=int(records["contact_link"].reshape(-1)[0]),
        onset=int(cycle[0]),
        end=int(cycle[-1]),
        tau_ext=records["tau_ext"].astype(np.float64),
        cycle=cycle,
    )
