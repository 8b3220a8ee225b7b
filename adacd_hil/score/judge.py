"""The judge: the true contact of each alarm; contacts found, their delay, or missed; false alarms.

A scheme raises an *alarm* with a transition to REACT by a contact, in whatever state: the certified scheme detects
while it adapts and while it parks, too. While it is in REACT or STOPPED it is still about the contact before. REACT
without a joint over its threshold and without a report is an arm that is held for another reason, and no alarm.

A true contact explains alarms from its onset until it is forgotten: until one time constant after its true torque,
filtered, is back within the threshold (`forgotten_after_s`). An alarm is about the last contact that began
before it, as long as that contact, or one before it, is not forgotten; so an alarm is about one contact at most. The
first alarm about a contact finds it. An alarm about no contact is *false*, in whatever state it was raised, unless the
emulator did not record that time: such an alarm is not judged. Under gravity, an alarm in PAYLOAD
about a payload that is not that of the last MONITOR is about its weight, and not false.

A contact is *armed* if detection was armed in the logged cycle before its onset. It is *missed* if it is armed and
no alarm found it. A contact that began before the log did is not armed.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adacd_hil.log.logged_run import Truth, cycle_offsets
from adacd_hil.records import JOINTS, ContactReport, SchemeState, Vector
from adacd_hil.settings.configuration import Settings

Times = NDArray[np.int64]


@dataclass(frozen=True)
class Detection:
    """An alarm of a scheme. is_armed: raised by armed detection, in MONITOR.

    is_known: the truth covers that time, or there is no truth. row: index in the run's cycles, -1: unknown. first,
    last: its report at the alarm, and the newest one of the same contact; None without a report. is_weight: it is about
    the weight of a payload, see `is_about_weight`.
    """

    t_ns: int
    is_armed: bool
    is_known: bool = True
    row: int = -1
    first: ContactReport | None = None
    last: ContactReport | None = None
    is_weight: bool = False


def is_about_weight(truth: Truth, settings: Settings, cycle: int, before: int, armed: int) -> bool:
    """Return whether an alarm in a cycle is about the weight of a payload that the scheme has not learnt yet.

    It is, under gravity, if the state before is PAYLOAD, and the true payload differs from that in `armed`, the last
    cycle in MONITOR before. False without such a cycle (-1), or if the truth has no payload. Cycles are counted as
    those of the truth's payloads.
    """
    if armed < 0 or before != SchemeState.PAYLOAD or not settings.estimator.gravity:
        return False
    known, now = truth.model_row(armed), truth.model_row(cycle)
    return known is not None and now is not None and bool(truth.payload_kg[known] != truth.payload_kg[now])


def begins_of(at: NDArray[Any], pause: float, last: float | None = None) -> NDArray[np.bool_]:
    """Return which samples over a threshold, at ascending times (n,), begin an alarm: those after more than a pause.

    last: time of the sample before them, whose alarm they may continue; None: there is none, and the first sample
    begins an alarm. All times in one unit.
    """
    begins = np.diff(at, prepend=at[:1] if last is None else [last]) > pause
    if last is None:
        begins[:1] = True
    return np.asarray(begins)


@dataclass(frozen=True)
class TrueContact:
    """A true contact; then, on the clock of a run, when it explains alarms; then when it was detected.

    number: of the truth, from 1. cycle (k,), tau_ext (k, 2), force_N, time_s (k,): of the truth's rows, of which the
    first `rows` are of the contact; one more is the row after it, where the truth has that. Cycles are the
    emulator's, in the `attempt` of the run, from 0; `counted_from` makes them the host's.

    onset_ns, forgotten_ns: from when until when it explains alarms. is_armed: detection was armed at its onset;
    is_reacting: the scheme still reacted to something else then. detected_ns: None if no alarm found it.
    """

    number: int
    link: int
    onset_ns: int = 0
    forgotten_ns: int = 0
    is_armed: bool = False
    is_reacting: bool = False
    detected_ns: int | None = None
    attempt: int = 0
    rows: int = 0
    cycle: Times = field(default_factory=lambda: np.zeros(0, np.int64), compare=False, repr=False)
    tau_ext: Vector = field(default_factory=lambda: np.zeros((0, JOINTS)), compare=False, repr=False)
    force_N: Vector = field(default_factory=lambda: np.zeros(0), compare=False, repr=False)
    time_s: Vector = field(default_factory=lambda: np.zeros(0), compare=False, repr=False)

    @property
    def onset(self) -> int:
        """First cycle of the contact."""
        return int(self.cycle[0])

    @property
    def end(self) -> int:
        """First cycle after the contact; its last one where the truth or the attempt ends with it."""
        return int(self.cycle[-1])

    @property
    def delay_ms(self) -> float | None:
        """Time from onset to detection, ms; None if no alarm found the contact."""
        return None if self.detected_ns is None else (self.detected_ns - self.onset_ns) * 1e-6

    @property
    def is_missed(self) -> bool:
        """Whether detection was armed at the contact's onset and did not find it."""
        return self.is_armed and self.detected_ns is None

    def counted_from(self, first_cycle: int) -> "TrueContact":
        """Return the contact with cycles counted by the host, whose attempt begins with `first_cycle`."""
        return replace(self, cycle=self.cycle + int(cycle_offsets(np.array(first_cycle))))


@dataclass(frozen=True)
class Score:
    """True contacts, in the order of time, with their detections, and false alarms.

    unjudged: alarms at times that the truth doesn't cover.
    """

    contacts: tuple[TrueContact, ...]
    false_alarms: tuple[Detection, ...]
    unjudged: tuple[Detection, ...] = ()

    @property
    def armed(self) -> int:
        """Number of contacts that began while detection was armed."""
        return sum(contact.is_armed for contact in self.contacts)

    @property
    def missed(self) -> int:
        """Number of contacts that began while detection was armed and that no alarm found."""
        return sum(contact.is_missed for contact in self.contacts)

    @property
    def armed_false_alarms(self) -> int:
        """Number of false alarms that armed detection raised, to be compared with the time for which it was armed."""
        return sum(alarm.is_armed for alarm in self.false_alarms)

    @property
    def delays_ms(self) -> tuple[float, ...]:
        """Delays from onset to detection, ms, of all contacts that were found, armed or not."""
        return tuple(contact.delay_ms for contact in self.contacts if contact.delay_ms is not None)

    def since(self, first_ns: int) -> "Score":
        """Return the score without contacts and alarms that began before `first_ns`."""
        return Score(
            tuple(contact for contact in self.contacts if contact.onset_ns >= first_ns),
            tuple(alarm for alarm in self.false_alarms if alarm.t_ns >= first_ns),
            tuple(alarm for alarm in self.unjudged if alarm.t_ns >= first_ns),
        )


def explained_until(onsets: NDArray[Any], forgotten: NDArray[Any]) -> Times:
    """Return for each contact (k,) the last instant at which it explains an alarm.

    It is just before the next one begins, or when all contacts so far are forgotten, if that is earlier. onsets,
    forgotten (k,): when each begins and is forgotten, onsets ascending; integers in any one unit.
    """
    until: Times = np.maximum.accumulate(np.asarray(forgotten, np.int64))
    until[:-1] = np.minimum(until[:-1], np.asarray(onsets, np.int64)[1:] - 1)
    return until


def contacts_of_alarms(at: NDArray[Any], onsets: NDArray[Any], until: NDArray[Any]) -> Times:
    """Return for each alarm (n,) the index of the contact that it is about; -1: it is about none.

    at (n,): times of the alarms. onsets (k,): of the contacts, ascending. until (k,): of `explained_until`.
    """
    places = np.searchsorted(onsets, at, side="right") - 1
    if not len(onsets):
        return np.asarray(places)
    return np.asarray(np.where(at <= until[places], places, -1))


def judge(contacts: Sequence[TrueContact], alarms: Sequence[Detection], crossings_ns: Sequence[int] = ()) -> Score:
    """Return when each true contact was found, and which alarms are false or not judged; all in the order of time.

    Alarms about a payload's weight are left out. Those that the truth doesn't cover are not judged, even if they find a
    contact. crossings_ns: times at which a
    scheme, replayed on another scheme's motion, first exceeds a threshold. While it still reacts it can raise no alarm:
    then, if no alarm finds a contact that began meanwhile (`is_reacting`), a crossing does.
    """
    onsets, until = explained_times(contacts)
    alarms = [alarm for alarm in alarms if not alarm.is_weight]
    about = contacts_of_alarms(np.array([alarm.t_ns for alarm in alarms], np.int64), onsets, until).tolist()
    found = _first(about, [alarm.t_ns for alarm in alarms])
    crossed = _first(contacts_of_alarms(np.array(crossings_ns, np.int64), onsets, until).tolist(), crossings_ns)
    for place, contact in enumerate(contacts):
        if contact.is_reacting and place in crossed:
            found.setdefault(place, crossed[place])
    unexplained = [alarm for alarm, place in zip(alarms, about, strict=True) if place < 0]
    return Score(
        tuple(replace(contact, detected_ns=found.get(place)) for place, contact in enumerate(contacts)),
        tuple(alarm for alarm in unexplained if alarm.is_known),
        tuple(alarm for alarm in alarms if not alarm.is_known),
    )


class StreamJudge:
    """Judges a statistic that is compared with a threshold sample by sample but raises no alarm, piece by piece.

    The first sample over the threshold that is about a contact finds it. Samples about no contact are a false alarm;
    a sample no more than `pause_ns` after the one before belongs to the same false alarm.
    """

    def __init__(self, pause_ns: int) -> None:
        self._pause_ns = pause_ns
        self._found: dict[int, int] = {}  # by the contact's number
        self._false: list[Detection] = []
        self._last_ns: int | None = None  # of the last sample that no contact explains

    def add_samples(
        self, contacts: Sequence[TrueContact], t_ns: Times, is_over: NDArray[np.bool_], is_judged: NDArray[np.bool_]
    ) -> None:
        """Judge the next samples (n,), in the order of time; is_over: where the statistic is above its threshold.

        is_judged: where an alarm that no contact explains counts as false. contacts: in the order of time, those at
        least that begin before the last sample and aren't forgotten before the first.
        """
        rows = np.flatnonzero(is_over)
        about = contacts_of_alarms(t_ns[rows], *explained_times(contacts))
        first = _first(about.tolist(), t_ns[rows].tolist())
        self._found = {contacts[place].number: at_ns for place, at_ns in first.items()} | self._found
        false_ns = t_ns[rows[(about < 0) & is_judged[rows]]]
        begins = begins_of(false_ns, self._pause_ns, self._last_ns)
        self._false += [Detection(at_ns, True) for at_ns in false_ns[begins].tolist()]
        if len(false_ns):
            self._last_ns = int(false_ns[-1])

    def score(self, contacts: Sequence[TrueContact]) -> Score:
        """Return the score of all samples so far; contacts: all true contacts, whose `detected_ns` is set anew."""
        judged = (replace(contact, detected_ns=self._found.get(contact.number)) for contact in contacts)
        return Score(tuple(judged), tuple(self._false))


def explained_times(contacts: Sequence[TrueContact]) -> tuple[Times, Times]:
    """Return onsets of contacts (k,), and the last instants at which they explain an alarm (k,), ns.

    contacts: in the order of time.
    """
    onsets = np.array([contact.onset_ns for contact in contacts], np.int64)
    return onsets, explained_until(onsets, np.array([contact.forgotten_ns for contact in contacts], np.int64))


def _first(about: Sequence[int], times_ns: Sequence[int]) -> dict[int, int]:
    """Return the earliest of the times about each contact, by the contact's index.

    about: that index for each time, -1: none. times_ns: ascending.
    """
    first = dict(zip(reversed(about), reversed(times_ns), strict=True))
    first.pop(-1, None)
    return first


def contact_bounds(index: NDArray[Any], attempt: Times | None) -> list[tuple[int, int]]:
    """Return (first row, row after the last) of each contact of a truth; index, attempt (m,): of the truth's rows.

    A negative index is no contact. Another index is another contact, though the touch goes on. A contact that goes on
    as an attempt begins is another one, too: the scheme begins anew.
    """
    is_edge = index[1:] != index[:-1]
    if attempt is not None:
        is_edge |= attempt[1:] != attempt[:-1]
    bounds = [0, *(np.flatnonzero(is_edge) + 1).tolist(), len(index)]
    return [(start, end) for start, end in pairwise(bounds) if end > start and index[start] >= 0]


def filtered(tau_ext: Vector, cycle: Times, period_s: float, a_rad_s: float) -> Vector:
    """Return a true torque (n, 2) filtered as by an ideal detector: first order, at rest at the first sample.

    Each sample is held until the next one; cycle (n,): when they were taken, in periods. a_rad_s: cut-off.
    """
    response = np.zeros_like(tau_ext)
    decays = np.exp(-a_rad_s * period_s * np.diff(cycle).astype(np.float64)).tolist()
    for joint in range(tau_ext.shape[1]):
        value = 0.0
        for row, (sample, decay) in enumerate(zip(tau_ext[:-1, joint].tolist(), decays, strict=True), start=1):
            value = sample + (value - sample) * decay
            response[row, joint] = value
    return response


def forgotten_after_s(tau_ext: Vector, cycle: Times, period_s: float, a_rad_s: float, threshold: Vector) -> float:
    """Return how long after a contact's end an alarm may still stem from it, s.

    One time constant after its true torque (k, 2), filtered with `a_rad_s`, is back within the threshold (2,). cycle
    (k,): of the torque's samples, in periods, the last at the contact's end.
    """
    response = filtered(tau_ext, cycle, period_s, a_rad_s)[-1]
    excess = float(np.max(np.abs(response) / threshold))
    return (1.0 + math.log(max(1.0, excess))) / a_rad_s


def true_contacts(truth: Truth | None, first_number: int = 1) -> tuple[TrueContact, ...]:
    """Return the true contacts in a truth, numbered from `first_number`; () without a truth.

    Each has its own rows of the truth, and the one after them if that is of the same attempt. Their cycles are the
    emulator's; their times on a run's clock are still 0.
    """
    if truth is None:
        return ()
    found = []
    bounds = contact_bounds(truth.contact_index, truth.attempt)
    for number, (start, end) in enumerate(bounds, first_number):
        has_after = end < len(truth.cycle) and truth.attempt[end] == truth.attempt[start]
        rows = slice(start, end + int(has_after))
        found.append(
            TrueContact(
                number=number,
                link=int(truth.contact_link[start]),
                attempt=int(truth.attempt[start]),
                rows=end - start,
                cycle=truth.cycle[rows],
                tau_ext=truth.tau_ext[rows],
                force_N=truth.force_N[rows],
                time_s=truth.time_s[rows],
            )
        )
    return tuple(found)
