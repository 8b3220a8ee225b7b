"""The failures of a run, by its log: faults and their logged causes, and cyclic data that did not come in time.

Cyclic data is counted while the drives are to have torque. *Incomplete*: a cyclic frame was missing, late or wrong.
*Aged*: the oldest value used was older than the cycle. Windows are the host's own, of one second,
and the limits those of the configuration's `[data]`. By device, the checks' running counts tell how many cycles had no
new frame or a repeated one; they are logged once a second, so the counts of the last second, which a fault may have
ended, are missing.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.lab.score.metrics import CyclicData, DeviceShares, Fault
from adacd_hil.lab.score.report_wording import percent_text
from adacd_hil.lab.score.run_arrays import CheckCounts, CycleColumns, Run, stays_of
from adacd_hil.log.logged_run import Cycles
from adacd_hil.printable import one_line
from adacd_hil.records import FaultReason, SchemeState
from adacd_hil.scheme.supervisor.supervisor import POWERED
from adacd_hil.settings.arm_settings import DATA_WINDOW_S, SHORTEST_DATA_WINDOW, DataSettings
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.e2e import E2eStatus

_RUN = "run"
"""Name of the events that end an attempt without a fault: no boot-up, a bus that failed."""
_SUPERVISOR = "supervisor"
_NEAR_NS = 2_000_000
"""Largest time between a fault's event and its cycle."""
_MOST_LETTERS = 300


def find_faults(run: Run) -> tuple[Fault, ...]:
    """Return the faults of a run, the earliest first; () without one.

    The run must have the cycles in which the state changes.
    """
    stays = stays_of(run)
    return tuple(
        Fault(FaultReason(int(run.fault[row])).name, start_s, _cause(run, int(run.t_ns[row])), row == stays[-1].row)
        for state, start_s, _, row in stays
        if state is SchemeState.FAULT
    )


def _cause(run: Run, t_ns: int) -> str:
    """Return the supervisor's words for the fault at `t_ns`, without state and reason, cut at `_MOST_LETTERS`.

    "" if the log has no event of it within `_NEAR_NS`.
    """
    for logged in run.events:
        event = logged.event
        if event.name == _SUPERVISOR and event.level == "error" and abs(logged.t_ns - t_ns) <= _NEAR_NS:
            return _shortened(event.message.partition("; ")[2])
    return ""


class Break(NamedTuple):
    """A logged cause that ended an attempt, or the log, without a fault.

    is_last: the run ended by it; False: it began anew.
    """

    cause: str
    is_last: bool


def find_breaks(run: Run) -> tuple[Break, ...]:
    """Return the breaks of a run, each once: logged errors of the run, interruptions, and `broken_off` as the last.

    An interruption by the user counts only if a scenario played: the rest of its script is missing. () without any.
    """
    last_ns = int(run.t_ns[-1]) if run.t_ns.size else 0
    is_scripted = "scenario" in run.metadata
    found = []
    for t_ns, event in run.events:
        if event.name == _RUN and event.level == "error":
            found.append(Break(_shortened(event.message), last_ns <= t_ns))
        elif event.name == "interrupted" and is_scripted:
            found.append(Break(_shortened(event.message), True))
    if run.broken_off:
        found.append(Break(_shortened(run.broken_off), True))
    return tuple(dict.fromkeys(found))


def _shortened(text: str) -> str:
    line = one_line(text)
    return line if len(line) <= _MOST_LETTERS else f"{line[:_MOST_LETTERS]} …"


_POWERED: Final = tuple(int(state) for state in POWERED)


class CyclicDataGatherer:
    """Sums over the cyclic data of a run, gathered piece by piece in constant memory."""

    def __init__(self, settings: Settings) -> None:
        self._window = max(1, round(DATA_WINDOW_S / settings.bus.period_s))
        self._counted = {"frames_missing": 0, "data_age": 0}
        self._cycles = 0  # with powered drives
        self._logged = 0  # with a record in /cycle
        self._worst = 0.0
        self._present = np.empty((2, 0), np.int64)  # of the window under way: each cycle's number, and if incomplete

    def add_columns(self, columns: CycleColumns, cycle: Cycles, state: NDArray[np.uint8]) -> None:
        """Count incomplete and aged data in the next cycles with powered drives, in the order of the run.

        The second under way is kept for the next call. cycle, state: those of /scheme (k,).
        """
        is_powered = np.isin(state, _POWERED)
        self._cycles += int(np.count_nonzero(is_powered))
        powered = columns.rows(np.flatnonzero(np.isin(columns["cycle"], cycle[is_powered])))
        if not len(powered):
            return
        self._logged += len(powered)
        for name in self._counted:
            self._counted[name] += int(np.count_nonzero(powered[name]))
        self._add_windows(np.array([powered["cycle"], powered["frames_missing"] > 0]))

    def _add_windows(self, cycles: Cycles) -> None:
        """Store the worst share so far of incomplete cycles in one second; a gap in the cycle numbers ends a second.

        The last second, which may go on, is kept for the next call. cycles (2, k), k > 0: numbers, and whether
        incomplete.
        """
        cycles = np.concatenate((self._present, cycles), axis=1)
        begins = np.flatnonzero(np.diff(cycles[0], prepend=-2) != 1)
        place = np.arange(cycles.shape[1])
        place -= np.repeat(begins, np.diff(begins, append=cycles.shape[1]))
        firsts = np.flatnonzero(place % self._window == 0)
        self._judge_windows(cycles[1, : firsts[-1]], firsts[:-1])
        self._present = cycles[:, firsts[-1] :]

    def _judge_windows(self, is_incomplete: Cycles, firsts: Cycles) -> None:
        """Store the worst share so far of incomplete cycles in a window; firsts: index at which each window begins.

        Windows of less than SHORTEST_DATA_WINDOW of a whole one don't count.
        """
        sizes = np.diff(firsts, append=is_incomplete.size)
        is_long = sizes >= SHORTEST_DATA_WINDOW * self._window
        if is_long.any():
            shares = np.add.reduceat(is_incomplete, firsts) / sizes
            self._worst = max(self._worst, float(shares[is_long].max()))

    def data(self, run: Run) -> CyclicData:
        """Return the shares of incomplete and aged data so far, those of each device, and a line for each excess.

        run: has the cycles in which the state changes, and the checks' counts. Call it after the last piece.
        """
        self._judge_windows(self._present[1], np.zeros(1, np.int64))
        limits = run.settings.data
        shares = {name: count / self._logged for name, count in self._counted.items()} if self._logged else {}
        incomplete = shares.get("frames_missing")
        worst = None if incomplete is None else self._worst
        devices = _device_shares(run.checks, run)
        return CyclicData(
            cycles=self._cycles,
            incomplete=incomplete,
            worst_incomplete=worst,
            aged=shares.get("data_age"),
            devices=devices,
            excesses=tuple(_excesses(worst, devices, limits)),
        )


def _device_shares(checks: CheckCounts | None, run: Run) -> dict[str, DeviceShares]:
    """Return each device's shares by its name, over the times between two loggings of its counts.

    A time counts if the drives are powered at its end. Times in which a count went down are left out. {} without counts
    in the log, or without such a time.
    """
    if checks is None or len(checks.cycle) < 2 or not run.cycle.size:
        return {}
    cycles = np.diff(checks.cycle)
    added = np.diff(checks.counts.astype(np.int64), axis=0)
    row = np.searchsorted(run.cycle, checks.cycle[1:], side="right") - 1
    is_told = (cycles > 0) & (added >= 0).all(axis=(1, 2)) & (row >= 0) & np.isin(run.state[row], _POWERED)
    if not is_told.any():
        return {}
    cycles, added = cycles[is_told], added[is_told]
    found = {}
    for place, name in enumerate(checks.devices):
        missed, repeated = added[:, place, E2eStatus.NO_NEW_DATA], added[:, place, E2eStatus.REPEATED]
        found[name] = DeviceShares(
            cycles=int(cycles.sum()),
            no_new_data=float(missed.sum() / cycles.sum()),
            repeated=float(repeated.sum() / cycles.sum()),
            worst_no_new_data=float((missed / cycles).max()),
            worst_repeated=float((repeated / cycles).max()),
        )
    return found


def _excesses(worst: float | None, devices: dict[str, DeviceShares], limits: DataSettings) -> list[str]:
    """Return a line for each share that was over its limit in some second.

    worst: share of incomplete cycles, None if unknown.
    """
    judged = [("incomplete cycles", worst, limits.incomplete_share)]
    for name, shares in devices.items():
        judged.append((f"no new data of {name}", shares.worst_no_new_data, limits.no_new_data_share))
        judged.append((f"repeated frames of {name}", shares.worst_repeated, limits.repeated_share))
    return [
        f"{name}: {percent_text(share)} of the cycles of a second, {percent_text(limit)} allowed"
        for name, share, limit in judged
        if share is not None and share > limit
    ]
