"""The judge: which alarm is about which true contact, what was found, how late, what was missed, what was false.

A scheme raises an *alarm* with a transition to REACT by a contact, in whatever state: the certified scheme detects
while it adapts and while it parks, too. While it is in REACT or STOPPED it is still about the contact before. REACT
without a joint over its threshold and without a report is an arm that is held for another reason, and no alarm.

A true contact explains alarms from its onset until it is forgotten: until one time constant after its true torque,
filtered, is back within the threshold (`contacts.forgotten_after_s`). An alarm is about the last contact that began
before it, as long as that contact, or one before it, is not forgotten; so an alarm is about one contact at most. The
first alarm about a contact finds it. An alarm about none is *false*, in whatever state it was raised, unless the
emulator did not record what was true then: nobody knows about such an alarm.

A contact is *armed* if detection was armed in the logged cycle before its onset. It is *missed* if it is armed and
nothing found it. A contact that began before the log did is not armed.

Bounds of shares and rates are exact. Sources: Clopper and Pearson, "The use of confidence or fiducial limits
illustrated in the case of the binomial", Biometrika 26 (1934); Garwood, "Fiducial limits for the Poisson
distribution", Biometrika 28 (1936).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv, gammaincinv

from adacd_hil.analysis.logged_run import Mask, Run, is_interrupted
from adacd_hil.records import ContactReport, SchemeState


class Alarm(NamedTuple):
    """An alarm. is_armed: raised by armed detection, which is in MONITOR; is_known: the truth covers that time."""

    t_ns: int
    is_armed: bool
    is_known: bool = True


def enters_react(previous: NDArray[np.uint8], state: NDArray[np.uint8]) -> Mask:
    """Mark the cycles (n,) that begin to react, from the states before them and their own."""
    return np.asarray((state == SchemeState.REACT) & ~is_interrupted(previous))


def begins_of(at: NDArray[Any], pause: float, last: float | None = None) -> Mask:
    """Mark of samples over a threshold, at ascending times (n,), those that begin an alarm: after more than a pause.

    last: the sample before them, of which they may go on; None: there was none.
    """
    begins = np.diff(at, prepend=at[:1] if last is None else [last]) > pause
    if last is None:
        begins[:1] = True
    return np.asarray(begins)


class Detection(NamedTuple):
    """An alarm of a run: its row, its time, and the report at the alarm and at the end of the window."""

    row: int
    detected_s: float
    raised: Alarm
    alarm: ContactReport | None
    final: ContactReport | None


def find_detections(run: Run) -> tuple[Detection, ...]:
    """Find the alarms of a run and the reports that belong to them by their cycle."""
    rows = np.flatnonzero(enters_react(run.state[:-1], run.state[1:])) + 1
    alarms = {report.cycle: report for report in reversed(run.reports) if not report.is_final}
    finals = {report.cycle: report for report in run.reports if report.is_final}
    time_s = run.time_s()
    detections = []
    for row in rows.tolist():
        cycle = int(run.cycle[row])
        final = finals.get(cycle)
        alarm = alarms.get(cycle, final)
        if alarm is None and run.contact_joints is not None and not run.contact_joints[row]:
            continue
        raised = Alarm(
            int(run.t_ns[row]),
            bool(run.state[row - 1] == SchemeState.MONITOR),
            run.truth is None or run.truth.covers(cycle),
        )
        detections.append(Detection(row, float(time_s[row]), raised, alarm, final))
    return tuple(detections)


CONFIDENCE: Final = 0.95


def share_bounds(found: int, count: int) -> tuple[float, float]:
    """Give the 95 % interval of a share of which `found` of `count` were seen; (0, 1) of none."""
    rest = 0.5 * (1.0 - CONFIDENCE)
    low = float(betaincinv(found, count - found + 1, rest)) if found > 0 else 0.0
    high = float(betaincinv(found + 1, count - found, 1.0 - rest)) if found < count else 1.0
    return low, high


Times = NDArray[np.int64]


class TouchWindow(NamedTuple):
    """A true contact as it is judged; is_reacting: the scheme still reacted to something else at its onset."""

    number: int
    link: int
    onset_ns: int
    forgotten_ns: int
    is_armed: bool
    is_reacting: bool = False


class JudgedContact(NamedTuple):
    """What became of a true contact; detected_ns: None if nothing found it."""

    number: int
    link: int
    onset_ns: int
    is_armed: bool
    detected_ns: int | None

    @property
    def delay_ms(self) -> float | None:
        """Time from onset to detection."""
        return None if self.detected_ns is None else (self.detected_ns - self.onset_ns) * 1e-6

    @property
    def is_missed(self) -> bool:
        """Whether detection was armed and did not find it."""
        return self.is_armed and self.detected_ns is None


@dataclass(frozen=True)
class Score:
    """What became of true contacts, in order, and which alarms were false; unjudged: those the truth does not cover."""

    contacts: tuple[JudgedContact, ...]
    false_alarms: tuple[Alarm, ...]
    unjudged: tuple[Alarm, ...] = ()

    @property
    def armed(self) -> int:
        """How many contacts began while detection was armed."""
        return sum(contact.is_armed for contact in self.contacts)

    @property
    def missed(self) -> int:
        """How many of those were not found."""
        return sum(contact.is_missed for contact in self.contacts)

    @property
    def armed_false_alarms(self) -> int:
        """How many false alarms armed detection raised: those that the time it was armed for can be set against."""
        return sum(alarm.is_armed for alarm in self.false_alarms)

    @property
    def delays_ms(self) -> tuple[float, ...]:
        """Delays of all contacts that were found, armed or not."""
        return tuple(contact.delay_ms for contact in self.contacts if contact.delay_ms is not None)

    def since(self, first_ns: int) -> "Score":
        """Leave out what began before a time."""
        return Score(
            tuple(contact for contact in self.contacts if contact.onset_ns >= first_ns),
            tuple(alarm for alarm in self.false_alarms if alarm.t_ns >= first_ns),
            tuple(alarm for alarm in self.unjudged if alarm.t_ns >= first_ns),
        )


def explained_until(onsets: NDArray[Any], forgotten: NDArray[Any]) -> Times:
    """Give the last instant at which each of k contacts, in order, explains an alarm; integers in any one unit (k,)."""
    until: Times = np.maximum.accumulate(np.asarray(forgotten, np.int64))
    until[:-1] = np.minimum(until[:-1], np.asarray(onsets, np.int64)[1:] - 1)
    return until


def owners(at: NDArray[Any], onsets: NDArray[Any], until: NDArray[Any]) -> Times:
    """Give the place of the contact that each of n alarms is about (n,), -1 for none; until: of `explained_until`."""
    places = np.searchsorted(onsets, at, side="right") - 1
    if not len(onsets):
        return np.asarray(places)
    return np.asarray(np.where(at <= until[places], places, -1))


def judge(touches: Sequence[TouchWindow], alarms: Sequence[Alarm], crossings_ns: Sequence[int] = ()) -> Score:
    """Judge alarms by true contacts, both in order.

    crossings_ns: when some threshold is first exceeded, of a scheme replayed on a motion that is not its own: while it
    still reacts, it can raise no alarm, and a crossing finds the contacts that begin meanwhile.
    """
    onsets, until = _bounds(touches)
    about = owners(np.array([alarm.t_ns for alarm in alarms], np.int64), onsets, until).tolist()
    found = _first(about, [alarm.t_ns for alarm in alarms])
    crossed = _first(owners(np.array(crossings_ns, np.int64), onsets, until).tolist(), crossings_ns)
    for place, touch in enumerate(touches):
        if touch.is_reacting and place in crossed:
            found.setdefault(place, crossed[place])
    unexplained = [alarm for alarm, place in zip(alarms, about, strict=True) if place < 0]
    return Score(
        _judged(touches, found),
        tuple(alarm for alarm in unexplained if alarm.is_known),
        tuple(alarm for alarm in alarms if not alarm.is_known),
    )


class StreamJudge:
    """Judges a statistic that is compared with a threshold sample by sample and decides nothing, piece by piece.

    The first sample over the threshold that is about a contact finds it. Samples about none are a false alarm; those
    that follow the one before by no more than `pause_ns` belong to the same one.
    """

    def __init__(self, touches: Sequence[TouchWindow], pause_ns: int) -> None:
        self._touches = touches
        self._onsets, self._until = _bounds(touches)
        self._pause_ns = pause_ns
        self._found: dict[int, int] = {}
        self._false: list[Alarm] = []
        self._last_ns: int | None = None  # of what no contact explains

    def add(self, t_ns: Times, is_over: NDArray[np.bool_], is_judged: NDArray[np.bool_]) -> None:
        """Take in the next samples (n,). is_judged: where an alarm that no contact explains counts as false."""
        rows = np.flatnonzero(is_over)
        about = owners(t_ns[rows], self._onsets, self._until)
        self._found = _first(about.tolist(), t_ns[rows].tolist()) | self._found
        false_ns = t_ns[rows[(about < 0) & is_judged[rows]]]
        self._false += [Alarm(at, True) for at in false_ns[begins_of(false_ns, self._pause_ns, self._last_ns)].tolist()]
        if len(false_ns):
            self._last_ns = int(false_ns[-1])

    def score(self) -> Score:
        """Judge what has been taken in."""
        return Score(_judged(self._touches, self._found), tuple(self._false))


def _bounds(touches: Sequence[TouchWindow]) -> tuple[Times, Times]:
    onsets = np.array([touch.onset_ns for touch in touches], np.int64)
    return onsets, explained_until(onsets, np.array([touch.forgotten_ns for touch in touches], np.int64))


def _first(about: Sequence[int], times_ns: Sequence[int]) -> dict[int, int]:
    """Give the first time about each contact, by its place."""
    first = dict(zip(reversed(about), reversed(times_ns), strict=True))
    first.pop(-1, None)
    return first


def _judged(touches: Sequence[TouchWindow], found: dict[int, int]) -> tuple[JudgedContact, ...]:
    return tuple(
        JudgedContact(touch.number, touch.link, touch.onset_ns, touch.is_armed, found.get(place))
        for place, touch in enumerate(touches)
    )


def rate_bound_per_h(alarms: int, hours: float) -> float:
    """Give the upper 95 % bound of a rate, one-sided: 3 / T after T hours without an alarm; infinite without time."""
    return float(gammaincinv(alarms + 1, CONFIDENCE)) / hours if hours > 0.0 else math.inf


def least_rate_per_h(alarms: int, hours: float) -> float:
    """Give the lower 95 % bound of a rate, one-sided; 0 after no alarm."""
    return float(gammaincinv(alarms, 1.0 - CONFIDENCE)) / hours if alarms > 0 and hours > 0.0 else 0.0


def why_not_found(is_armed: bool) -> str:
    """Say why nothing found a contact."""
    return "missed" if is_armed else "not armed"


def found_text(found: int, contacts: int) -> str:
    """Say how many contacts were found."""
    return f"{found} of {contacts}"


def number_of(count: int, noun: str) -> str:
    """Write a count with its noun."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def score_sentence(score: Score) -> str:
    """Say what was found within what time, what was missed, and how many alarms were false."""
    armed = [contact for contact in score.contacts if contact.is_armed]
    delays_ms = [contact.delay_ms for contact in armed if contact.delay_ms is not None]
    within = f" within {max(delays_ms):.0f} ms" if delays_ms else ""
    if not armed:
        found = "no contact while detection was armed"
    elif score.missed:
        found = f"{len(delays_ms)} of {number_of(len(armed), 'contact')} detected{within}, {score.missed} missed"
    else:
        found = f"{'the one contact' if len(armed) == 1 else f'all {len(armed)} contacts'} detected{within}"
    false = number_of(len(score.false_alarms), "false alarm") if score.false_alarms else "none false"
    if not armed and not score.false_alarms:
        false = "no false alarm"
    disarmed = [contact for contact in score.contacts if not contact.is_armed]
    outside = f", {len(disarmed)} more while it was not armed" if disarmed else ""
    early = sum(contact.detected_ns is not None for contact in disarmed)
    outside += f" ({early} of them detected)" if early else ""
    return f"{found}{outside}, {false}"


def unjudged_sentence(count: int) -> str:
    """Say in one line how many alarms the truth does not cover; "" if none."""
    return f"the truth doesn't cover {number_of(count, 'detection')}, not judged" if count else ""


def rate_sentence(false_alarms: int, bound_per_h: float) -> str:
    """Say what false alarms there were, and which rate the counting leaves possible."""
    count = number_of(false_alarms, "false alarm") if false_alarms else "No false alarms"
    return f"{count} in that time: by counting alone, at most {bound_per_h:.3g} per hour at 95 %"


def delay_figures(delays_ms: Sequence[float]) -> tuple[float | None, float | None, float | None]:
    """Give median, 90th percentile and largest."""
    if not delays_ms:
        return None, None, None
    median, p90, largest = np.quantile(delays_ms, (0.5, 0.9, 1.0)).tolist()
    return median, p90, largest


def delays_phrase(delays_ms: Sequence[float]) -> str:
    """Say how delays are distributed; nothing of none."""
    if not delays_ms:
        return ""
    return ", after {:.1f} ms (median), {:.1f} (p90), {:.1f} (largest)".format(*delay_figures(delays_ms))


def share_phrase(delays_ms: Sequence[float], contacts: int, bounds: tuple[float, float]) -> str:
    """Say how many contacts were found, the bounds of their share, and after what time."""
    found = found_text(len(delays_ms), contacts)
    return f"{found} contacts found ({100 * bounds[0]:.0f} to {100 * bounds[1]:.0f} %){delays_phrase(delays_ms)}"


def rate_phrase(alarms: int, hours: float, bound_per_h: float) -> str:
    """Say how many false alarms came in how many hours."""
    return f"{alarms} false alarms in {hours:.4f} h, 95 % bound {bound_per_h:.3g} per hour"
