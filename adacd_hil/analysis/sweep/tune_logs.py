"""What tuning takes from a log, or a stretch of it: motion that nobody touched, true contacts, and which half it is.

Thresholds are chosen on one half and checked on the other: of several logs, on every other log; of one log, on every
other tenth of its time, and its contacts alternate.
"""

import dataclasses
import hashlib
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.analysis.host_cycles import AttemptBegins, host_span
from adacd_hil.analysis.motion import APART_S, LoggedMotion, Progress, read_motion, schemes
from adacd_hil.analysis.recorded_thresholds import BLOCK_S
from adacd_hil.analysis.replay.source import LogSource
from adacd_hil.analysis.replay.what_if import changed_keys, keep_facts
from adacd_hil.analysis.score.judge import Times, TouchWindow, explained_until
from adacd_hil.analysis.score.truth_contacts import HostCycles, TrueContact, contacts_beside, windows_of
from adacd_hil.input_files import open_input
from adacd_hil.log.log_files import LogError
from adacd_hil.log.reader import Series
from adacd_hil.log.time_window import EVER_NS, WHOLE, TimeWindow
from adacd_hil.records import JOINTS
from adacd_hil.settings.configuration import Settings, load_settings

_TENTHS = 10


class Window(NamedTuple):
    """The rows [first, last] of a log in which a true contact explains an alarm, see `score.judge`."""

    number: int
    link: int
    first: int
    last: int
    is_armed: bool  # in MONITOR at its onset
    is_chosen_on: bool


@dataclass(frozen=True)
class TunedLog:
    """A log of N cycles, or N of them. windows: of the true contacts that begin in those, None where nobody knows.

    is_chosen_on (B,): of its blocks of 0.1 s.
    """

    path: Path
    digest: str
    settings: Settings
    motion: LoggedMotion
    t_ns: NDArray[np.int64]  # (N,)
    windows: tuple[Window, ...] | None
    is_chosen_on: NDArray[np.bool_]
    stretch: TimeWindow = WHOLE

    @property
    def block(self) -> int:
        """Cycles of a block."""
        return round(BLOCK_S / self.motion.period_s)


def read_logs(
    paths: Sequence[Path],
    config: str | None = None,
    stretch: TimeWindow = WHOLE,
    progress: Progress = lambda _: None,
) -> list[TunedLog]:
    """Read logs, or a stretch of each. config: name or file of the settings to start from, in place of the logs' own.

    Raises LogError, ConfigError, CodecError; LogError also when their settings are not the same.
    """
    logs = [_read(path, place, len(paths), config, stretch, progress) for place, path in enumerate(paths)]
    first = logs[0]
    for other in logs[1:]:
        differing = changed_keys(_tunable(first.settings), _tunable(other.settings))
        if differing:
            raise LogError(
                f"logs {first.path} and {other.path} have different settings, such as {next(iter(differing))}: tune "
                "them apart, or say with --config what to start from"
            )
    return logs


def _tunable(settings: Settings) -> Settings:
    """Return the settings with only those that the scheme's numbers depend on."""
    names = ("scheme", "filter", "estimator", "termination", "detector", "certified")
    return dataclasses.replace(Settings(), **{name: getattr(settings, name) for name in names})


def _read(path: Path, place: int, count: int, config: str | None, stretch: TimeWindow, progress: Progress) -> TunedLog:
    own = LogSource(path).settings
    parts = _Index()
    motion = read_motion(path, stretch, progress, parts.add)
    index = parts.joined()
    truth = contacts_beside(path, progress)
    blocks = -(-len(index.t_ns) // round(BLOCK_S / motion.period_s))
    tenths = np.arange(blocks) * _TENTHS // blocks
    is_chosen_on = np.full(blocks, place % 2 == 0) if count > 1 else tenths % 2 == 0
    windows = None
    if truth is not None:
        begins = _begins(motion, parts)
        contacts = [
            contact
            for contact in _on_cycles(truth.contacts, begins)
            if stretch.is_whole or index.cycle[0] <= contact.onset
        ]
        windows = _windows(windows_of(contacts, index, own), index.t_ns, None if count == 1 else place)
        is_free = motion.is_free & host_span(truth.span, np.array(begins)).covers(index.cycle)
        apart = round(APART_S / motion.period_s)
        for window in windows:
            is_free[max(window.first - apart, 0) : window.last + apart] = False
        motion = dataclasses.replace(motion, is_free=is_free)
    with open_input(path) as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    settings = own if config is None else keep_facts(own, load_settings(config, own.arm.profile))
    return TunedLog(path, digest, settings, motion, index.t_ns, windows, is_chosen_on, stretch)


class _Index:
    """Gathers the cycles of a log, in arrays that grow where they are: joined in the end, they would be there twice."""

    def __init__(self) -> None:
        self.attempts = AttemptBegins()
        self._cycle, self._t_ns, self._before, self._threshold = array("q"), array("q"), array("B"), array("d")

    def add(self, scheme: Series) -> None:
        """Take in the next piece of /scheme."""
        self.attempts.add(scheme["cycle"].reshape(-1), scheme["state"].reshape(-1))
        self._cycle.frombytes(scheme["cycle"].astype(np.int64).tobytes())
        self._t_ns.frombytes(scheme.t_ns.tobytes())
        self._before.frombytes(scheme["previous_state"].astype(np.uint8).tobytes())
        self._threshold.frombytes(scheme["threshold"].astype(np.float64).tobytes())

    def joined(self) -> HostCycles:
        """Give all of them; nothing can be added after that."""
        return HostCycles(
            np.frombuffer(self._cycle, np.int64),
            np.frombuffer(self._t_ns, np.int64),
            np.frombuffer(self._before, np.uint8),
            np.frombuffer(self._threshold).reshape(-1, JOINTS),
        )


def _begins(motion: LoggedMotion, parts: _Index) -> list[int]:
    """List the first cycle of each attempt, those before the stretch included."""
    attempts = parts.attempts
    if motion.bounds_ns is not None:
        attempts = AttemptBegins()
        for scheme in schemes(motion.path, (EVER_NS[0], motion.bounds_ns[1])):
            attempts.add(scheme["cycle"].reshape(-1), scheme["state"].reshape(-1))
    begins: list[int] = attempts.begins.tolist()
    return begins


def _on_cycles(contacts: Sequence[TrueContact], begins: Sequence[int]) -> Iterator[TrueContact]:
    """Give the contacts on the host's cycles, but for those of attempts that the log lacks."""
    for contact in contacts:
        if contact.attempt < len(begins):
            yield contact.counted_from(begins[contact.attempt])


def _windows(touches: Sequence[TouchWindow], t_ns: Times, place: int | None) -> tuple[Window, ...]:
    """Give the rows of contacts. place: of the log; None where there is one log only."""
    onsets_ns = np.array([touch.onset_ns for touch in touches], np.int64)
    until_ns = explained_until(onsets_ns, np.array([touch.forgotten_ns for touch in touches], np.int64))
    firsts = np.searchsorted(t_ns, onsets_ns).tolist()
    lasts = (np.searchsorted(t_ns, until_ns, side="right") - 1).tolist()
    return tuple(
        Window(
            number=touch.number,
            link=touch.link,
            first=first,
            last=max(last, first),
            is_armed=touch.is_armed,
            is_chosen_on=(touch.number if place is None else place) % 2 == (1 if place is None else 0),
        )
        for touch, first, last in zip(touches, firsts, lasts, strict=True)
    )
