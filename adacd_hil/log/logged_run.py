"""Common parts of replays and reports of a run: its settings, its attempts, the emulator's truth, mismatches.

Torques in Nm, joint arrays (2,), histories time-first (n, 2).

**Attempts.** The emulator counts cycles by the counter of SYNC, anew after each reset: in every attempt of a run it
begins with the first cycle's number less all whole rounds of the counter. The host counts on.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.log.log_files import CONFIG_NAME, LogError
from adacd_hil.records import REACTING, SchemeState, Vector
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import with_todays_keys
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.toml_files import parse_toml
from adacd_hil.wire.contract_frames import SYNC_OVERFLOW

Cycles = NDArray[np.int64]


_NEVER: Final = 1 << 62

PROGRESS_CYCLES: Final = 1_000_000
"""Between two lines of progress."""
Progress = Callable[[str], None]
"""Prints a line about work in progress."""


class Milestones:
    """Calls `tell` with a count whenever the count has grown by `step`; a step of 0 is PROGRESS_CYCLES."""

    def __init__(self, tell: Callable[[int], None], step: int = 0) -> None:
        self._tell, self._step, self._told = tell, step or PROGRESS_CYCLES, 0

    def reach(self, count: int) -> None:
        """Call `tell` with the count if it has grown by a step since the last call of `tell`."""
        if count - self._told >= self._step:
            self._told = count
            self._tell(count)


EmulatorSpan = tuple[tuple[int, int], tuple[int, int]]
"""Attempt and cycle, as the emulator counts, of the first and the last one that it recorded."""


class Span(NamedTuple):
    """The first and the last cycle of the host that the emulator recorded."""

    first: int
    last: int

    def covers(self, cycle: Cycles) -> NDArray[np.bool_]:
        """Return for each cycle (n,) of the host whether the emulator recorded it."""
        return np.asarray((cycle >= self.first) & (cycle <= self.last))


def host_cycles(cycle: Cycles, attempt: Cycles, begins: Cycles) -> Cycles:
    """Return the host's numbers (m,) of the emulator's cycles (m,).

    attempt: of each cycle (m,), from 0; one that `begins` lacks is counted as the last of them. begins: the host's
    number of the first cycle of each attempt (k,).
    """
    return np.asarray(cycle + cycle_offsets(begins)[np.minimum(attempt, len(begins) - 1)])


def host_span(span: EmulatorSpan, begins: Cycles) -> Span:
    """Return the emulator's first and last cycle in the host's numbers.

    begins: the host's number of the first cycle of each attempt (k,). The last cycle is unbounded if the emulator's
    last attempt is not in the log.
    """
    attempts, cycles = (np.array(column) for column in zip(*span, strict=True))
    first, last = host_cycles(cycles, attempts, begins).tolist()
    return Span(first, last if attempts[1] < len(begins) else _NEVER)


def cycle_offsets(begins: Cycles) -> Cycles:
    """Return per attempt the host's cycle numbers minus the emulator's (k,): whole rounds of the counter of SYNC.

    begins: the host's number of the first cycle of each attempt (k,).
    """
    return np.asarray(begins - begins % SYNC_OVERFLOW)


Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Truth:
    """The emulator's truth in some of its cycles (m,): external torque (m, 2), Nm, and the contact.

    contact_link, contact_index: of the contact in a cycle, force_N: its size; attempt: of each cycle, from 0; time_s: s
    since motion start, 0 until the truth is on the host's cycles. Of a long run it has the cycles of contacts and the
    one after each. payload_kg (k,), theta (k, 7): with the cycles from which on they hold. span: cycles that the
    emulator recorded, whichever are kept.
    """

    cycle: Cycles
    tau_ext: Vector
    contact_link: Vector
    contact_index: Vector
    payload_kg: Vector
    theta: Vector
    attempt: Cycles
    model_cycle: Cycles
    model_attempt: Cycles
    force_N: Vector
    time_s: Vector
    span: Span = Span(0, _NEVER)

    def covers(self, cycle: int) -> bool:
        """Return whether the emulator recorded a cycle of the host."""
        return bool(self.span.covers(np.array(cycle)))

    def with_host_models(self, begins: Cycles) -> "Truth":
        """Return the truth with the host's numbers of the cycles from which on its payloads and parameters hold.

        begins: first cycle of each attempt of the run so far; payloads and parameters of later attempts are left out.
        """
        known = self.model_attempt < len(begins)
        return replace(
            self,
            payload_kg=self.payload_kg[known],
            theta=self.theta[known],
            model_cycle=host_cycles(self.model_cycle, self.model_attempt, begins)[known],
            model_attempt=self.model_attempt[known],
        )

    def model_row(self, cycle: int) -> int | None:
        """Return the index, in `payload_kg` and `theta`, of the values that hold in a cycle, in the truth's own count.

        None if the truth has no such values. 0 for a cycle before the first.
        """
        cycles = self.model_cycle
        return max(int(np.searchsorted(cycles, cycle, side="right")) - 1, 0) if cycles.size else None


def is_armed_in(state: NDArray[np.uint8]) -> Mask:
    """Return for each state (n,) whether it is MONITOR, in which detection counts as armed."""
    return np.asarray(state == SchemeState.MONITOR)


def last_armed(cycle: Cycles, state: NDArray[np.uint8], before: int = -1) -> Cycles:
    """Return for each cycle (n,), and the one after them, the last cycle in MONITOR before it (n + 1,).

    before: that of the first cycle; -1: there is none.
    """
    return np.maximum.accumulate(np.concatenate(([before], np.where(is_armed_in(state), cycle, before))))


def is_interrupted(state: NDArray[np.uint8]) -> Mask:
    """Return for each cycle (n,) whether its state is REACT or STOPPED."""
    return np.isin(state, REACTING)


_KINDS: Final = {
    SchemeState.ADAPT: "adaptation",
    SchemeState.CERTIFY: "adaptation",
    SchemeState.MONITOR: "detection",
    SchemeState.PAYLOAD: "payload",
    SchemeState.FAULT: "fault",
}


class SectionRows(NamedTuple):
    """A section among the states of a run: its kind, its first row, and the next section's, or the run's last row.

    is_complete: False if the run ended, or failed, in it.
    """

    kind: str
    first: int
    end: int
    is_complete: bool


def sections_in(state: NDArray[np.uint8]) -> Iterator[SectionRows]:
    """Yield the sections among the states (n,) of cycles, or of changes of state, in the order of time.

    A section is a stay in the states of one kind: adaptation (ADAPT, CERTIFY), detection (MONITOR), payload or fault.
    INIT, COMMISSION and ENABLE belong to no section. REACT and STOPPED belong to the section that they interrupt, to a
    detection if that is before the first state.
    """
    if not state.size:
        return
    own = np.maximum.accumulate(np.where(is_interrupted(state), -1, np.arange(state.size)))
    origins = np.where(own < 0, np.uint8(SchemeState.MONITOR), state[np.maximum(own, 0)])
    kinds = np.array([_KINDS.get(value, "") for value in SchemeState])[origins]
    starts = (np.flatnonzero(kinds[1:] != kinds[:-1]) + 1).tolist()
    for first, end in pairwise((0, *starts, state.size)):
        kind, following = str(kinds[first]), "" if end == state.size else str(kinds[end])
        is_complete = following == "detection" if kind == "adaptation" else following not in ("", "fault")
        if kind:
            yield SectionRows(kind, first, min(end, state.size - 1), is_complete)


def settings_of(path: Path, attachments: Mapping[str, bytes]) -> Settings:
    """Return the settings of a run from the attachment config.toml of its log.

    Raises LogError, which names the log's `path`, if the attachment is missing or has no valid settings.
    """
    if CONFIG_NAME not in attachments:
        raise LogError(f"log {path} has no attachment {CONFIG_NAME}: its settings are not known")
    try:
        return parse(Settings, with_todays_keys(parse_toml(attachments[CONFIG_NAME])))
    except ValueError as error:  # errors of the text, the TOML and a setting are ValueErrors
        raise LogError(f"log {path}, attachment {CONFIG_NAME}: {error}") from None


def enters_react(previous: NDArray[np.uint8], state: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return for each cycle (n,) whether a reaction begins: REACT, after a state that is neither REACT nor STOPPED."""
    return np.asarray((state == SchemeState.REACT) & ~is_interrupted(previous))


def begins_alarm(
    previous: NDArray[np.uint8], state: NDArray[np.uint8], is_over: Mask, is_reported: Mask
) -> NDArray[np.bool_]:
    """Return for each cycle (n,) whether an alarm begins: a reaction to a contact, not to a host that is late.

    previous, state (n,): before and after the cycle. is_over (n,): a joint is over its threshold. is_reported (n,): a
    report of a contact that began in this cycle.
    """
    return enters_react(previous, state) & np.asarray(is_over | is_reported)


class Mismatch(NamedTuple):
    """A replayed value that isn't the logged one.

    `place`: joint, parameter or channel in the field, "" for a plain field.
    """

    topic: str
    field: str
    place: str
    cycle: int
    t_ns: int
    logged: str
    replayed: str

    @property
    def name(self) -> str:
        """Topic, field and place of the value, such as /scheme.q[joint 1]."""
        return f"{self.topic}.{self.field}" + (f"[{self.place}]" if self.place else "")

    def line(self, zero_ns: int = 0) -> str:
        """Return the mismatch as one line, with the time in s since `zero_ns`."""
        time_s = (self.t_ns - zero_ns) * 1e-9
        return f"cycle {self.cycle}, {time_s:.6f} s: {self.name} = {self.logged} logged, {self.replayed} here"
