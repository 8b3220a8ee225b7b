"""A replay's decisions against the log's: every field of /scheme, every contact report, events, the user's requests.

States of the arm that were decoded from the frames once more must equal those of /arm to the bit, on every machine.

Two values are the same if they have the same bits. Between machines whose arithmetic differs (`different_arithmetic`) a
real value may be off by `TOLERANCE` of the largest one that its field has had so far, and by as much of one unit; then,
too, counts, names, switches, and values that are infinite or not a number have to be the same.

If the user could not type, the configuration's script made the requests. The script depends on the time since the
drives were enabled and on the state; the caller hands in its player, `control.operator` live.
"""

import itertools
import math
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from adacd_hil.device.recorded_arm import Ticks
from adacd_hil.log.log_files import SHOWN, LogError, arithmetic
from adacd_hil.log.logged_run import Mismatch
from adacd_hil.log.reader import LoggedEvent, Series
from adacd_hil.log.types.topics import ARM, CONTACT, EVENTS, SCHEME
from adacd_hil.records import JOINTS, ArmBatch, ContactReport, Event, Layout, Request, SchemeState, Vector
from adacd_hil.scheme.pipeline.pipeline import SchemeBatch, layout_of
from adacd_hil.scheme.supervisor.kept_request import KeptRequest
from adacd_hil.scheme.supervisor.supervisor import POWERED, among
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.run_settings import OperatorSettings

TOLERANCE: Final = 1e-9
"""Least squares over a minute amplify a rounding error of 1e-16 by the condition number, up to 1e6."""
_JOINTS: Final = tuple(f"joint {joint + 1}" for joint in range(JOINTS))
_HEAD: Final = ("cycle", "state", "previous_state", "fault", "contact_joints", "is_model_valid")


def different_arithmetic(metadata: Mapping[str, str]) -> list[str]:
    """Return, as texts, which of architecture, Python, numpy and numba differ between a log's metadata and here.

    [] if all bits must be equal. An item that the log doesn't name counts as equal.
    """
    different = []
    for key, here in arithmetic().items():
        there = metadata.get(key, "")
        if there and there.split()[-1:] != here.split()[-1:]:
            different.append(f"{key} {there}, {here} here")
    return different


class SchemeComparison:
    """Compares a replay with its log, stretch by stretch.

    tolerance: as a share, 0: bit by bit. `count`: number of all mismatches; `fields`: number in each field;
    `mismatches`: the kept ones, `shown` after `first`.
    """

    def __init__(self, settings: Settings, tolerance: float = 0.0, shown: int = SHOWN) -> None:
        self.mismatches: list[Mismatch] = []
        self.count = 0
        self.fields: Counter[str] = Counter()
        self.cycles = self.arms = 0  # cycles whose decisions, and whose arms, were compared
        self.missing_fields: list[str] = []
        """Fields that the log's format lacks."""
        self.unexplained: list[tuple[int, int, int, int]] = []
        """Requests that the script doesn't make, or that the log lacks: cycle, time, logged, of the script."""
        self._interrupt: tuple[int, int] | None = None  # cycle and time of a FINISH that isn't in the script
        self._shown = shown
        self._tolerance = tolerance
        self._layout: Layout = layout_of(settings)
        parameters, further = settings.estimator.parameter_names, settings.further_names
        self._names = {  # of the values of fields that aren't by joint
            "theta_hat": parameters,
            "paper_theta_hat": parameters,
            "theta_further": further,
            "theta_std": (*parameters, *further),
        }
        self._scales: dict[str, Vector] = {}

    def compare(self, scheme: Series, ticks: Ticks, batch: SchemeBatch) -> None:
        """Compare the decisions of n cycles with the records of /scheme (n,); count and keep the mismatches.

        Fields of the block that the records lack are named in `missing_fields`. Raises LogError if a field has another
        number of values.
        """
        records = scheme.records
        self.cycles += len(records)
        self._note(SCHEME.name, "stamp_ns", scheme.t_ns != ticks.t_ns, scheme.t_ns, ticks.t_ns, ticks)
        for name in _HEAD:
            logged, replayed = records[name], getattr(batch, name)
            self._note(SCHEME.name, name, logged != replayed, logged, replayed, ticks)
        known = scheme.fields
        self.missing_fields = [name for name in self._layout.slices if name not in known]
        if not self.missing_fields and _same_bits(scheme.block, batch.block):
            return
        for name, place in self._layout.slices.items():
            if name in known:
                logged = np.ascontiguousarray(records[name], np.float64).reshape(len(records), -1)
                self._compare_reals(name, logged, np.ascontiguousarray(batch.block[:, place]), ticks)

    def _compare_reals(self, name: str, logged: Vector, replayed: Vector, ticks: Ticks) -> None:
        """Compare a float field, logged and replayed (n, k) each, and note the cycles in which it differs.

        Without a tolerance, every bit counts. Raises LogError if the field has another number of values.
        """
        if logged.shape != replayed.shape:
            raise LogError(f"{SCHEME.name}.{name} has {logged.shape[1]} values in the log, {replayed.shape[1]} here")
        is_other = np.asarray(logged.view(np.uint64) != replayed.view(np.uint64))
        if self._tolerance:
            is_other &= ~self._is_near(name, logged, replayed)
        self._note(SCHEME.name, name, is_other, logged, replayed, ticks)

    def _is_near(self, name: str, logged: Vector, replayed: Vector) -> NDArray[np.bool_]:
        """Return where a field's values (n, k) are equal, or differ by no more than the tolerance; two NaN are equal.

        The tolerance is a share of the largest finite size that the column's logged values have had so far, at least
        of 1.
        """
        finite = np.where(np.isfinite(logged), np.abs(logged), 0.0)
        scale = np.maximum(self._scales.get(name, np.ones(logged.shape[1])), finite.max(axis=0, initial=0.0))
        self._scales[name] = scale
        with np.errstate(invalid="ignore"):
            is_near = np.abs(logged - replayed) <= self._tolerance * scale
        return np.asarray(is_near | (logged == replayed) | (np.isnan(logged) & np.isnan(replayed)))

    def compare_arms(self, logged: ArmBatch, decoded: ArmBatch, ticks: Ticks) -> None:
        """Compare the logged states of n cycles, to the bit, with those decoded from frames.

        Count and keep the mismatches.
        """
        self.arms += len(ticks.cycle)
        for name in ArmBatch._fields:
            theirs: NDArray[Any] = getattr(logged, name)
            ours: NDArray[Any] = getattr(decoded, name)
            bits = np.uint64 if theirs.dtype == np.float64 else theirs.dtype
            self._note(ARM.name, name, theirs.view(bits) != ours.view(bits), theirs, ours, ticks)

    def _note(
        self,
        topic: str,
        name: str,
        is_other: NDArray[np.bool_],
        logged: NDArray[Any],
        replayed: NDArray[Any],
        ticks: Ticks,
    ) -> None:
        """Count the values of (n,) or (n, k) that differ, where is_other is True; keep the first `shown` of them."""
        if not is_other.any():
            return
        is_other, logged, replayed = (each.reshape(len(each), -1) for each in (is_other, logged, replayed))
        rows, columns = np.nonzero(is_other)
        self.count += len(rows)
        self.fields[f"{topic}.{name}"] += len(rows)
        for row, column in zip(rows[: self._shown].tolist(), columns[: self._shown].tolist(), strict=True):
            names = self._names.get(name) or _places(logged.shape[1])
            values = (repr(side[row, column].item()) for side in (logged, replayed))
            self._keep(Mismatch(topic, name, names[column], int(ticks.cycle[row]), int(ticks.t_ns[row]), *values))

    def add_mismatch(self, mismatch: Mismatch) -> None:
        """Count and keep a mismatch that was found elsewhere."""
        self.count += 1
        self.fields[f"{mismatch.topic}.{mismatch.field}"] += 1
        self._keep(mismatch)

    def _keep(self, mismatch: Mismatch) -> None:
        """Keep a mismatch; of more than twice `shown`, only the `shown` earliest stay."""
        self.mismatches.append(mismatch)
        if len(self.mismatches) > 2 * self._shown:
            self.first()

    def first(self) -> tuple[Mismatch, ...]:
        """Return those mismatches with the lowest cycle numbers, `shown` at most, in their order; drop the rest."""
        self.mismatches = sorted(self.mismatches, key=lambda mismatch: mismatch.cycle)[: self._shown]
        return tuple(self.mismatches)

    def compare_contacts(self, logged: Mapping[int, Mapping[str, Any]], ticks: Ticks, batch: SchemeBatch) -> None:
        """Compare the contact reports of a stretch, each by the time at which it was made.

        Count and keep the mismatches; a report without a counterpart is one. logged: fields by time, ns.
        """
        replayed = dict(zip(ticks.t_ns[batch.contact_places].tolist(), batch.contacts, strict=True))
        for t_ns in sorted({*logged, *replayed}):
            where = (int(ticks.cycle[_row_at(ticks, t_ns)]), t_ns)
            theirs, ours = logged.get(t_ns), replayed.get(t_ns)
            if theirs is None or ours is None:
                said = [("no report" if side is None else "a report") for side in (theirs, ours)]
                self.add_mismatch(Mismatch(CONTACT.name, "report", "", *where, *said))
                continue
            for field, place, there, here in _contact_values(theirs, ours):
                if not self._is_same(there, here):
                    self.add_mismatch(Mismatch(CONTACT.name, field, place, *where, repr(there), repr(here)))

    def _is_same(self, logged: float, replayed: float) -> bool:
        """Return whether two values have the same bits, or are finite reals within the tolerance of each other.

        The tolerance is a share of the logged value, at least of 1.
        """
        if struct.pack("<d", logged) == struct.pack("<d", replayed):
            return True
        is_real = isinstance(logged, float) and math.isfinite(logged) and math.isfinite(replayed)
        return is_real and abs(logged - replayed) <= self._tolerance * max(1.0, abs(logged))

    def compare_events(self, logged: Sequence[LoggedEvent], replayed: Sequence[Event], ticks: Ticks) -> None:
        """Compare the scheme's own events of a stretch, logged and replayed, pair by pair in the order of time.

        Count and keep the mismatches; an event without a counterpart is one. ticks: of the stretch. A mismatch has the
        cycle of the logged event; without one the stretch's first, as a replayed event has no time.
        """
        for theirs, ours in itertools.zip_longest(logged, replayed):
            if theirs is not None and theirs.event == ours:
                continue
            name = ours.name if theirs is None else theirs.event.name
            row = 0 if theirs is None else _row_at(ticks, theirs.t_ns)
            cycle, t_ns = int(ticks.cycle[row]), int(ticks.t_ns[row])
            logged_text, replayed_text = _event_text(theirs and theirs.event), _event_text(ours)
            self.add_mismatch(Mismatch(EVENTS.name, name, "", cycle, t_ns, logged_text, replayed_text))

    def compare_requests(self, ticks: Ticks, logged: NDArray[np.uint8], asked: NDArray[np.uint8]) -> None:
        """Compare logged requests of a stretch (n,) with the script's (n,); keep the differences in `unexplained`.

        The first FINISH that isn't in the script may be an interrupt; if the script asks for FINISH in a cycle of this
        or a later stretch where the log doesn't, it was none. Faults that the host's own checks requested are no
        difference.
        """
        for row in np.flatnonzero(logged != asked).tolist():
            cycle, t_ns = int(ticks.cycle[row]), int(ticks.t_ns[row])
            if logged[row] in _OWN_CHECKS:
                continue
            if logged[row] == Request.FINISH and self._interrupt is None:
                self._interrupt = cycle, t_ns
            else:
                self.unexplained.append((cycle, t_ns, int(logged[row]), int(asked[row])))
        if self._interrupt is not None and ((asked == Request.FINISH) & (logged != Request.FINISH)).any():
            self.unexplained.append((*self._interrupt, int(Request.FINISH), int(Request.NONE)))
            self._interrupt = None


def _row_at(ticks: Ticks, t_ns: int) -> int:
    """Return the index of the last cycle up to a time that is not before the first."""
    return int(np.searchsorted(ticks.t_ns, t_ns, "right")) - 1


def _event_text(event: Event | None) -> str:
    return repr("no event" if event is None else f"{event.level}: {event.message}")


def _same_bits(first: Vector, second: Vector) -> bool:
    return first.shape == second.shape and bool(np.array_equal(first.view(np.uint64), second.view(np.uint64)))


def _contact_values(logged: Mapping[str, Any], replayed: ContactReport) -> Iterator[tuple[str, str, float, float]]:
    """Yield field, joint ("" for one value), logged and replayed value of each field that the logged report has."""
    for field, theirs in logged.items():
        ours = getattr(replayed, field)
        if isinstance(theirs, list):
            for joint, (there, here) in enumerate(zip(theirs, ours, strict=True)):
                yield field, f"joint {joint + 1}", there, type(there)(here)
        else:
            yield field, "", theirs, type(theirs)(ours)


def _places(size: int) -> tuple[str, ...]:
    """Return the places of a field's values (size): "" for one value, the joints, or the joints of each channel."""
    if size == 1:
        return ("",)
    if size == JOINTS:
        return _JOINTS
    return tuple(f"channel {index // JOINTS + 1}, joint {index % JOINTS + 1}" for index in range(size))


class Script(Protocol):
    """The user that the configuration plays."""

    def request(self, elapsed_s: float | None, state: SchemeState) -> Request:
        """Return the script's request in a cycle, or NONE.

        `elapsed_s`: since the drives were enabled, None before. state: that of the cycle before.
        """


_OWN_CHECKS = (
    Request.FAULT_TORQUE,
    Request.FAULT_FOLLOWING,
    Request.FAULT_TAMPERED,
    Request.FAULT_MISCONFIGURED,
)
"""Requests that the host made in place of the user; a script makes none of them."""

ScriptOf = Callable[[OperatorSettings], Script]


class Asking:
    """Plays the script along a replay: cycle by cycle (`ask`, `note_request`), or a stretch at a time (`requests`)."""

    def __init__(self, settings: Settings, script_of: ScriptOf) -> None:
        operator = settings.operator
        self._script = script_of(operator)
        self._times_s = sorted(entry.at_s for entry in operator.script)
        self._acknowledges = operator.acknowledge_after_s > 0.0
        self._period_s = settings.bus.period_s
        self._enabled: int | None = None
        self._was_stopped = False
        self._kept = KeptRequest()

    def begin_attempt(self) -> None:
        """Begin another attempt: the drives are not enabled yet; a kept request not served yet will be made again."""
        self._enabled = None
        self._was_stopped = False
        self._kept = KeptRequest(self._kept.request)

    def ask(self, cycle: int, state: SchemeState) -> Request:
        """Return the user's request in a cycle: one left open by the attempt before, else the script's, or NONE.

        state: that of the cycle before.
        """
        elapsed_s = None if self._enabled is None else (cycle - self._enabled) * self._period_s
        carried = Request.NONE if elapsed_s is None else self._kept.take_carried()
        return carried or self._script.request(elapsed_s, state)

    def note_request(self, cycle: int, request: Request, previous: SchemeState, state: SchemeState) -> None:
        """Keep a request to finish or to change the payload; store the cycle in which the drives were enabled.

        A request to change the payload is dropped once it is served; other requests are not kept. Call it after each
        `ask`. previous, state: states before and after the cycle.
        """
        self._kept.ask(request, previous)
        self._kept.serve((state,))
        if state in POWERED and self._enabled is None:
            self._enabled = cycle

    def requests(self, ticks: Ticks, batch: SchemeBatch, logged: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the user's requests in a stretch (n,), as `ask` does, given the scheme's states in it.

        NONE until the drives are enabled, and where a logged request (n,) is of the host's own checks: it asks no user
        then. Keep a request to finish or to change the payload for the next attempt if the scheme hasn't served it.
        Call it for all stretches of an attempt, in the order of time.
        """
        asked = np.zeros(len(ticks.cycle), np.uint8)
        if self._enabled is None:
            enabled = np.flatnonzero(among(POWERED)[batch.state])
            if enabled.size == 0:
                return asked
            self._enabled = int(ticks.cycle[enabled[0]])
            first = int(enabled[0]) + 1
        else:
            first = 0
        served = 0
        for row in self._rows(ticks, batch, np.isin(logged, _OWN_CHECKS), first):
            self._kept.serve(batch.state[served:row])
            served = row
            previous = SchemeState(batch.previous_state[row])
            asked[row] = request = self.ask(int(ticks.cycle[row]), previous)
            self._kept.ask(request, previous)
        self._kept.serve(batch.state[served:])
        return asked

    def _rows(self, ticks: Ticks, batch: SchemeBatch, is_own: NDArray[np.bool_], first: int) -> list[int]:
        """Return the indices of the cycles from `first` on in which the script could make a request.

        Also those in which its wait begins anew, and `first`: a request left by the attempt before may be made in it.
        In place of a cycle in which the host's own checks request (is_own) the one after it.
        """
        assert self._enabled is not None
        is_due = np.zeros(len(ticks.cycle), np.bool_)
        is_due[first : first + 1] = True  # a request left by the attempt before, in the first cycle of an enabled arm
        if self._acknowledges:
            is_stopped = batch.previous_state == SchemeState.STOPPED
            is_due |= is_stopped | np.concatenate(([self._was_stopped], is_stopped[:-1]))
            self._was_stopped = bool(is_stopped[-1])
        elapsed_s = (ticks.cycle - self._enabled) * self._period_s
        is_alive = ~is_own & (batch.previous_state != SchemeState.FAULT)
        for at_s in self._times_s:  # as many cycles as others may be due before it, one each
            is_due[np.flatnonzero((elapsed_s >= at_s) & is_alive)[: len(self._times_s) + 1]] = True
        is_due[1:] |= is_own[:-1]
        return [row for row in np.flatnonzero(is_due & ~is_own).tolist() if row >= first]
