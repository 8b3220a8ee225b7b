"""The true contacts of a run, from the emulator's log, on the emulator's cycles, for those who have no arrays of a run.

Memory is bounded as that of `truth_reading` is.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.analysis.host_cycles import EmulatorSpan, whole_rounds
from adacd_hil.analysis.score.foreign_truth import foreign_truth
from adacd_hil.analysis.score.judge import TouchWindow
from adacd_hil.analysis.score.touches import contact_rows, forgotten_after_s
from adacd_hil.analysis.score.truth_reading import TruthRows, read_truth
from adacd_hil.analysis.sections import is_interrupted
from adacd_hil.analysis.timing import Cycles
from adacd_hil.log.log_files import TRUTH_NAME
from adacd_hil.records import SchemeState, Vector
from adacd_hil.settings.configuration import Settings


@dataclass(frozen=True)
class TrueContact:
    """A true contact. onset, end: its first cycle and the first one without it. tau_ext (k, 2), cycle (k,): of both.

    number: of the truth, from 1. Cycles are the emulator's, in the `attempt` of the run, from 0; `counted_from` makes
    them the host's.
    """

    number: int
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


class TrueContacts(NamedTuple):
    """The true contacts of a run, in order, and of which cycles they are known."""

    contacts: tuple[TrueContact, ...]
    span: EmulatorSpan


class HostCycles(NamedTuple):
    """Cycles of the host (k,): number, time, state of the cycle before, and threshold (k, 2)."""

    cycle: Cycles
    t_ns: Cycles
    before: NDArray[np.uint8]
    threshold: Vector


def windows_of(contacts: Sequence[TrueContact], host: HostCycles, settings: Settings) -> list[TouchWindow]:
    """Give those contacts, on the host's cycles, that begin before these end, as they are judged.

    host: has the cycles that each onset and each end lies between.
    """
    contacts = [contact for contact in contacts if len(host.cycle) and contact.onset <= host.cycle[-1]]
    if not contacts:
        return []
    is_certified = settings.scheme == "certified"
    a_rad_s = settings.certified.cutoffs_rad_s[0] if is_certified else settings.filter.a_rad_s
    instants = [(contact.onset, contact.end) for contact in contacts]
    since_ns = np.rint(np.interp(instants, host.cycle, host.t_ns - host.t_ns[0])).astype(np.int64)
    rows = np.searchsorted(host.cycle, [contact.onset for contact in contacts]).tolist()
    windows = []
    for contact, row, (onset_ns, end_ns) in zip(contacts, rows, (since_ns + host.t_ns[0]).tolist(), strict=True):
        threshold = np.where(np.isfinite(host.threshold[row]), host.threshold[row], settings.detector.threshold_Nm)
        after_s = forgotten_after_s(contact.tau_ext, contact.cycle, settings.bus.period_s, a_rad_s, threshold)
        before = host.before[row]
        windows.append(
            TouchWindow(
                number=contact.number,
                link=contact.link,
                onset_ns=onset_ns,
                forgotten_ns=end_ns + round(after_s * 1e9),
                is_armed=bool(before == SchemeState.MONITOR),
                is_reacting=bool(is_interrupted(before)),
            )
        )
    return windows


def contacts_beside(path: Path, progress: Callable[[str], None] = lambda _: None) -> TrueContacts | None:
    """Read the true contacts from the emulator's log in the same folder; None where there is none. Raises LogError.

    That of another run is left out, and `progress` is told why.
    """
    truth = path.with_name(TRUTH_NAME)
    if not truth.exists():
        return None
    if problem := foreign_truth(path, truth):
        progress(f"{problem}; it is left out")
        return None
    rows = read_truth(truth, 0)
    return None if rows.span is None else TrueContacts(_contacts(rows), rows.span)


def _contacts(rows: TruthRows) -> tuple[TrueContact, ...]:
    found = []
    for number, (start, end) in enumerate(contact_rows(rows.contact_index, rows.attempt), start=1):
        stop = end + int(end < len(rows.cycle) and rows.attempt[end] == rows.attempt[start])  # the row after it
        cycle = rows.cycle[start:stop]
        link, tau_ext = int(rows.contact_link[start]), rows.tau_ext[start:stop]
        found.append(TrueContact(number, int(rows.attempt[start]), link, int(cycle[0]), int(cycle[-1]), tau_ext, cycle))
    return tuple(found)
