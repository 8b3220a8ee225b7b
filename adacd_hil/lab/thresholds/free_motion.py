"""Contact-free motion in logs: which samples are free of contact, read piece by piece, in bounded memory.

Samples count if they lie in MONITOR, at least `APART_S` after its beginning, after a gap and after a contact, and at
least as long before its end, a gap and a contact.

With truth.mcap beside the log, contacts are the true ones. Then a false alarm counts, with the `BLOCK_S` after it,
though the arm reacts. Without, each alarm stands for a contact, and a touch that no detector found counts as free
motion.

Per sample one byte is kept: whether it is free; with the truth also its time, state and thresholds. All other data are
read from the log again when needed.
"""

from array import array
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from adacd_hil.lab.detectors.detectors import make_stream
from adacd_hil.lab.score.run_arrays import AttemptBegins, last_cycle
from adacd_hil.lab.thresholds.false_alarms import BLOCK_S
from adacd_hil.log.log_files import CONFIG_NAME, LogError
from adacd_hil.log.log_walk import attachment
from adacd_hil.log.logged_run import (
    Cycles,
    Milestones,
    Progress,
    begins_alarm,
    host_span,
    is_armed_in,
    settings_of,
)
from adacd_hil.log.reader import LogStream, Series, begin_of_log
from adacd_hil.log.time_window import EVER_NS, WHOLE, TimeWindow
from adacd_hil.log.types.topics import SCHEME
from adacd_hil.records import JOINTS, PARAMETER_NAMES, Vector
from adacd_hil.scheme.kernel.kernel_samples import LONGEST_SHARE, SHORTEST_SHARE
from adacd_hil.score.emulator_truth import HostCycles, KnownTruth, contacts_beside, placed_contacts
from adacd_hil.score.judge import Detection, TrueContact, explained_times, judge
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.setting_keys import changed_keys

APART_S: Final = 0.6
"""Distance from contacts and gaps: six time constants of the slowest filter."""
MOST_SAMPLES: Final = 1_000_000
"""Most samples that are processed together, and a piece of a log; of more motion, some pieces are taken."""
TOPICS: Final = (SCHEME.name,)
_PERIODS: Final = 1_000_000
"""Number of intervals whose median is the period."""
_OTHER_PERIOD: Final = 0.02
"""Share of a period from which two logs are of two periods."""
_ARM_KEYS: Final = tuple(
    f"arm.{name}"
    for name in (
        *("profile", "link_length_m", "rated_torque_Nm", "mounting_deg"),
        *("mass_kg", "center_m", "inertia_kg_m2", "viscous_Nm_s", "coulomb_Nm"),
    )
)
"""Settings that another arm has otherwise; limits, signs and zeros may differ between the runs of one arm."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Motion:
    """Consecutive samples of a recording. `is_free` (n,): the arm was not touched and the model was frozen.

    q, dq, tau_J (n, 2).
    """

    q: Vector  # q1 from the level
    dq: Vector
    tau_J: Vector
    theta: Vector  # (n, p)
    interval_s: Vector  # (n,), 0 after a gap
    is_free: Mask
    period_s: float


_COLUMNS: Final = ("q", "dq", "tau_J", "theta", "interval_s")


@dataclass(frozen=True)
class LoggedMotion:
    """Motion in a log, or in a stretch of it; `pieces` reads it anew at each call.

    is_free (N,): samples without contact. parameters: number of columns of theta. bounds_ns: the stretch; None: all of
    the log.

    level_rad: q1 at which link 1 is level; 0 without gravity. t_ns (N,): times; empty if neither wanted nor needed.
    contacts: the true ones that begin in the motion, None if unknown. alarms, false_alarms: number of those of MONITOR,
    and of the false ones of them, 0 if the contacts are unknown.
    """

    path: Path
    period_s: float
    parameters: int
    is_free: Mask
    bounds_ns: tuple[int, int] | None
    level_rad: float
    t_ns: Cycles = field(default_factory=lambda: np.zeros(0, np.int64))
    contacts: tuple[TrueContact, ...] | None = None
    alarms: int = 0
    false_alarms: int = 0

    def pieces(self) -> Iterator[Motion]:
        """Yield the samples piece by piece, in the order of time, q1 less `level_rad`.

        Raises LogError if the log can't be read.
        """
        place, before = 0, None
        for scheme in schemes(self.path, self.bounds_ns):
            end = place + len(scheme)
            cycle = scheme["cycle"].astype(np.int64).reshape(-1)
            yield Motion(
                q=scheme["q"] - np.array((self.level_rad, 0.0)),
                dq=scheme["dq"],
                tau_J=scheme["tau_J"],
                theta=scheme["theta_hat"],
                interval_s=_intervals(scheme, cycle, before, self.period_s),
                is_free=self.is_free[place:end],
                period_s=self.period_s,
            )
            place, before = end, int(cycle[-1])


def schemes(path: Path, bounds_ns: tuple[int, int] | None) -> Iterator[Series]:
    """Yield /scheme of a log, or its part between two times, in pieces that are not empty.

    Raises LogError if the log can't be read, or as `last_cycle`.
    """
    last = (-1, -1)
    for piece in LogStream(path, TOPICS):
        scheme = piece.series[SCHEME.name]
        last = last_cycle(path, scheme, last)
        if bounds_ns is not None and len(scheme):
            if scheme.t_ns[0] >= bounds_ns[1]:
                return
            scheme = scheme.between(*bounds_ns)
        if len(scheme):
            yield scheme


def read_motion(
    path: Path, stretch: TimeWindow = WHOLE, progress: Progress = lambda _: None, with_times: bool = False
) -> LoggedMotion:
    """Return the motion in a log, or in a stretch of it, with its contact-free samples marked; reads it twice or more.

    A sample is free if it and all within APART_S are armed, without a contact, a gap or NaN. With the truth beside the
    log, the `BLOCK_S` after a false alarm are free, too, and samples that the truth does not cover are not. progress:
    called with a line on the cycles read. with_times: whether `t_ns` is wanted. Raises LogError if the log can't be
    read, has no /scheme or no measured period, or no sample is free of contact.
    """
    bounds_ns, where = None, ""
    if not stretch.is_whole:
        bounds_ns, where = stretch.bounds_ns(begin_of_log(path)), f" {stretch.text}"
    period_s = _period(path, bounds_ns, where)
    truth = contacts_beside(path, progress)
    index = _Index()
    armed: list[Mask] = []
    sound: list[Mask] = []
    alarms: list[int] = []  # rows
    before: int | None = None
    parameters = count = 0
    milestones = Milestones(lambda at: progress(f"{path}: looking for contact-free motion, {at} cycles"))
    for scheme in schemes(path, bounds_ns):
        if with_times or truth is not None:
            index.add_scheme(scheme)
        cycle = scheme["cycle"].astype(np.int64).reshape(-1)
        state, previous = (scheme[name].astype(np.uint8).reshape(-1) for name in ("state", "previous_state"))
        is_over = scheme["contact_joints"].reshape(-1) != 0
        is_alarm = begins_alarm(previous, state, is_over, np.zeros_like(is_over)) & is_armed_in(previous)
        alarms += (np.flatnonzero(is_alarm) + count).tolist()
        armed.append(is_armed_in(state) if truth is not None else is_armed_in(state) & ~is_over)
        is_sound = _intervals(scheme, cycle, before, period_s) > 0.0
        for name in ("q", "tau_J", "dq", "theta_hat"):
            is_sound &= np.isfinite(scheme[name]).all(axis=1)
        sound.append(is_sound)
        before, parameters, count = int(cycle[-1]), scheme["theta_hat"].shape[1], count + len(cycle)
        milestones.reach(count)
    settings = logged_settings(path) if parameters > len(PARAMETER_NAMES) or truth is not None else None
    is_armed, is_sound, cycles = np.concatenate(armed), np.concatenate(sound), index.joined()
    motion = LoggedMotion(
        path=path,
        period_s=period_s,
        parameters=parameters,
        is_free=_apart(is_armed & is_sound, period_s),
        bounds_ns=bounds_ns,
        level_rad=0.0 if settings is None or parameters == len(PARAMETER_NAMES) else settings.level_rad,
        t_ns=cycles.t_ns,
        alarms=len(alarms),
    )
    if truth is not None and settings is not None:
        motion = _judged(motion, is_armed, is_sound, cycles, alarms, truth, _begins(motion, index), settings)
    if not motion.is_free.any():
        raise LogError(f"log {path} has no motion in MONITOR that is free of contact{where}")
    return motion


def _judged(
    motion: LoggedMotion,
    is_armed: Mask,
    is_sound: Mask,
    cycles: HostCycles,
    alarms: Sequence[int],
    truth: KnownTruth,
    begins: Sequence[int],
    settings: Settings,
) -> LoggedMotion:
    """Return a motion with its true contacts, and free of these alone; its alarms are judged by them.

    is_armed, is_sound (N,): samples in MONITOR, and without gap or NaN. alarms: their rows. begins: first cycle of each
    attempt. A false alarm's samples are free for `BLOCK_S`, so that the block with its peak is. Samples that the truth
    does not cover are not free.
    """
    counted = [each.counted_from(begins[each.attempt]) for each in truth.contacts if each.attempt < len(begins)]
    contacts = placed_contacts([each for each in counted if cycles.cycle[0] <= each.end], cycles, settings)
    is_known = host_span(truth.span, np.array(begins)).covers(cycles.cycle)
    raised = [Detection(int(cycles.t_ns[row]), True, bool(is_known[row]), row) for row in alarms]
    false_alarms = judge(contacts, raised).false_alarms
    is_good, counted_s = is_armed.copy(), BLOCK_S + APART_S
    for alarm in false_alarms:
        is_good[alarm.row : alarm.row + round(counted_s / motion.period_s) + 1] = True
    is_good &= is_sound
    for first, last in zip(
        *(np.searchsorted(cycles.t_ns, at).tolist() for at in explained_times(contacts)), strict=True
    ):
        is_good[first : last + 1] = False
    return replace(
        motion,
        is_free=_apart(is_good, motion.period_s) & is_known,
        contacts=tuple(each for each in contacts if motion.bounds_ns is None or cycles.cycle[0] <= each.onset),
        false_alarms=len(false_alarms),
    )


def _apart(is_good: Mask, period_s: float) -> Mask:
    """Return the mask (n,) of the samples with only good ones within `APART_S`."""
    return ~_spread(~is_good, round(APART_S / period_s))


class _Index:
    """Gathers the cycles of a log in growing arrays; joining pieces at the end would need twice the memory."""

    def __init__(self) -> None:
        self.attempts = AttemptBegins()
        self._cycle, self._t_ns, self._before, self._threshold = array("q"), array("q"), array("B"), array("d")

    def add_scheme(self, scheme: Series) -> None:
        """Add the next piece of /scheme, in the order of time. Not after `joined`."""
        self.attempts.add_cycles(scheme["cycle"].reshape(-1), scheme["state"].reshape(-1))
        self._cycle.frombytes(scheme["cycle"].astype(np.int64).tobytes())
        self._t_ns.frombytes(scheme.t_ns.tobytes())
        self._before.frombytes(scheme["previous_state"].astype(np.uint8).tobytes())
        self._threshold.frombytes(scheme["threshold"].astype(np.float64).tobytes())

    def joined(self) -> HostCycles:
        """Return all cycles that were added, without a copy; no cycle can be added after that."""
        return HostCycles(
            np.frombuffer(self._cycle, np.int64),
            np.frombuffer(self._t_ns, np.int64),
            np.frombuffer(self._before, np.uint8),
            np.frombuffer(self._threshold).reshape(-1, JOINTS),
        )


def _begins(motion: LoggedMotion, index: _Index) -> list[int]:
    """Return the first cycle of each attempt of a log, attempts before its stretch included.

    index: to which the stretch's /scheme was added. Raises LogError if the log can't be read.
    """
    attempts = index.attempts
    if motion.bounds_ns is not None:
        attempts = AttemptBegins()
        for scheme in schemes(motion.path, (EVER_NS[0], motion.bounds_ns[1])):
            attempts.add_cycles(scheme["cycle"].reshape(-1), scheme["state"].reshape(-1))
    begins: list[int] = attempts.begins.tolist()
    return begins


def logged_settings(path: Path) -> Settings | None:
    """Return the settings in a log; None if it has none, or its head can't be read.

    Raises LogError if the settings can't be read.
    """
    text = attachment(path, CONFIG_NAME)
    return None if text is None else settings_of(path, {CONFIG_NAME: text})


def _period(path: Path, bounds_ns: tuple[int, int] | None, where: str) -> float:
    """Return the median of the measured periods, s; of a long log the median at its beginning.

    where: text for errors. Raises LogError if there is no /scheme, or no period in it.
    """
    measured: list[Vector] = []
    rows = 0
    for scheme in schemes(path, bounds_ns):
        interval_s = scheme["period_s"].reshape(-1)
        measured.append(interval_s[interval_s > 0.0])
        rows += len(interval_s)
        if sum(map(len, measured)) >= _PERIODS:
            break
    if not rows:
        raise LogError(f"log {path} has no /scheme{where}")
    if not any(map(len, measured)):
        raise LogError(f"log {path} has no measured period{where}")
    return float(np.median(np.concatenate(measured)[:_PERIODS]))


def _intervals(scheme: Any, cycle: NDArray[np.int64], before: int | None, period_s: float) -> Vector:
    """Return the time since the previous sample (n,), s; 0 after a missing cycle, or if it is far from `period_s`.

    before: cycle of the last sample before these; None: they are the first, which gets 0.
    """
    interval_s: Vector = scheme["period_s"].reshape(-1).copy()
    is_near = (interval_s >= SHORTEST_SHARE * period_s) & (interval_s <= LONGEST_SHARE * period_s)
    interval_s[~is_near | (np.diff(cycle, prepend=cycle[0] - 2 if before is None else before) != 1)] = 0.0
    return interval_s


def _spread(is_bad: Mask, samples: int) -> Mask:
    """Return the mask (n,) of the samples that are bad, or at most `samples` away from a bad one."""
    spread = maximum_filter1d(is_bad.view(np.uint8), 2 * samples + 1, mode="constant", cval=0)
    return np.asarray(spread.view(np.bool_))


def arm_differences(first: Settings | None, second: Settings | None) -> dict[str, tuple[str, str]]:
    """Return the settings, both values by key, by which two runs are of two arms; {} for one arm, and for None."""
    if first is None or second is None:
        return {}
    differing = changed_keys(first, second)
    return {key: differing[key] for key in _ARM_KEYS if key in differing}


def check_together(logs: Sequence[LoggedMotion]) -> None:
    """Raise LogError unless all logs have the same number of parameters, and periods within `_OTHER_PERIOD`.

    Also if a log has other values of `_ARM_KEYS` than the first log with settings; one without isn't checked for them.
    """
    first = logs[0]
    for other in logs[1:]:
        if abs(other.period_s - first.period_s) > _OTHER_PERIOD * first.period_s:
            raise LogError(f"periods of {1e3 * first.period_s:.3f} and {1e3 * other.period_s:.3f} ms don't go together")
        if other.parameters != first.parameters:
            raise LogError(f"{first.parameters} and {other.parameters} parameters don't go together")
    known = [(log.path, settings) for log in logs if (settings := logged_settings(log.path)) is not None]
    for path, settings in known[1:]:
        for key, pair in arm_differences(known[0][1], settings).items():
            raise LogError(
                f"logs {known[0][0]} and {path} are of two arms: {key} is {' and '.join(pair)}; use them apart"
            )


def sample_of(logs: Sequence[LoggedMotion]) -> Motion:
    """Return all motion of the logs, one after the other; of more than `MOST_SAMPLES` samples only some pieces.

    They have free motion and are spread evenly over all such pieces. The first sample of each log, and of each piece
    without the piece before, counts as after a gap and as not free. Raises LogError if a log can't be read, or as
    `check_together`.
    """
    check_together(logs)
    total = sum(len(log.is_free) for log in logs)
    seen = taken = 0  # samples of pieces with free motion, and those taken of them
    parts: list[Motion] = []
    for log in logs:
        was_taken = False
        for motion in log.pieces():
            count = len(motion.q) if motion.is_free.any() else 0
            is_taken = total <= MOST_SAMPLES or (count > 0 and taken * total <= seen * MOST_SAMPLES)
            if is_taken:
                parts.append(motion if was_taken else _begun_anew(motion))
                taken += count
            seen += count
            was_taken = is_taken
    columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in (*_COLUMNS, "is_free")}
    return Motion(**columns, period_s=logs[0].period_s)


def _begun_anew(motion: Motion) -> Motion:
    """Return a copy of a motion whose first sample counts as after a gap and as not free."""
    interval_s, is_free = motion.interval_s.copy(), motion.is_free.copy()
    interval_s[0], is_free[0] = 0.0, False
    return replace(motion, interval_s=interval_s, is_free=is_free)


def torque_streams(pieces: Iterable[Motion], lag_s: float) -> Iterator[tuple[Motion, tuple[Vector, Vector]]]:
    """Yield each piece of a motion, and its stream for the detectors: z, and the torque that friction may hold.

    Both (n, 2), Nm. The stream goes on from piece to piece. lag_s: by which dq is older than tau_J.
    """
    last: list[Vector] | None = None  # last sample of the previous piece
    for motion in pieces:
        columns = [getattr(motion, name) for name in _COLUMNS]
        before, last = last, [column[-1:].copy() for column in columns]
        if before is not None:
            columns = [np.concatenate(pair) for pair in zip(before, columns, strict=True)]
        q, dq, tau_J, theta, interval_s = columns
        z, held_Nm = make_stream(q, dq, tau_J, theta, interval_s, lag_s)
        skipped = int(before is not None)
        yield motion, (z[skipped:], held_Nm[skipped:])
