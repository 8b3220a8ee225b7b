"""What tuning takes from a log: its motion that nobody touched, its true contacts, and which half it belongs to.

Thresholds are chosen on one half and checked on the other: of several logs, on every other log; of one log, on every
other tenth of its time, and its contacts alternate.
"""

import dataclasses
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.analysis.replay.replay import contacts_beside
from adacd_hil.analysis.replay.source import LogSource
from adacd_hil.analysis.replay.truth_contacts import TrueContact
from adacd_hil.analysis.replay.what_if import changed_keys, keep_facts
from adacd_hil.analysis.thresholds import APART_S, BLOCK_S, TOPICS, Motion, motion_from_log
from adacd_hil.config import Settings, load_settings
from adacd_hil.input_files import open_input
from adacd_hil.log.errors import LogError
from adacd_hil.log.reader import read_log
from adacd_hil.records import SchemeState

_TENTHS = 10


class Window(NamedTuple):
    """The rows [first, last] of a log in which a true contact can be detected, from its onset until it is forgotten."""

    number: int
    link: int
    first: int
    last: int
    is_armed: bool  # in MONITOR at its onset
    is_chosen_on: bool


@dataclass(frozen=True)
class TunedLog:
    """A log of N cycles. windows: None where the truth is not known. is_chosen_on (B,): of its blocks of 0.1 s."""

    path: Path
    digest: str
    settings: Settings
    motion: Motion
    t_ns: NDArray[np.int64]  # (N,)
    windows: tuple[Window, ...] | None
    is_chosen_on: NDArray[np.bool_]

    @property
    def block(self) -> int:
        """Cycles of a block."""
        return round(BLOCK_S / self.motion.period_s)


def read_logs(paths: Sequence[Path], config: str | None = None) -> list[TunedLog]:
    """Read logs. config: name or file of the settings to start from, in place of the logs' own.

    Raises LogError, ConfigError, CodecError; LogError also when their settings are not the same.
    """
    logs = [_read(path, place, len(paths), config) for place, path in enumerate(paths)]
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


def _read(path: Path, place: int, count: int, config: str | None) -> TunedLog:
    own = LogSource(path).settings
    log = read_log(path, TOPICS)
    motion = motion_from_log(log)
    contacts = contacts_beside(path)
    blocks = -(-len(motion.q) // round(BLOCK_S / motion.period_s))
    tenths = np.arange(blocks) * _TENTHS // blocks
    is_chosen_on = np.full(blocks, place % 2 == 0) if count > 1 else tenths % 2 == 0
    windows = None
    if contacts is not None:
        windows = tuple(
            _window(number, contact, log.scheme, own, None if count == 1 else place)
            for number, contact in enumerate(contacts, start=1)
        )
        is_free = motion.is_free.copy()
        apart = round(APART_S / motion.period_s)
        for window in windows:
            is_free[max(window.first - apart, 0) : window.last + apart] = False
        motion = dataclasses.replace(motion, is_free=is_free)
    with open_input(path) as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    settings = own if config is None else keep_facts(own, load_settings(config, own.arm.profile))
    return TunedLog(path, digest, settings, motion, log.scheme.t_ns, windows, is_chosen_on)


def _window(number: int, contact: TrueContact, scheme: Any, settings: Settings, place: int | None) -> Window:
    cycle = scheme["cycle"].reshape(-1)
    period_s = settings.bus.period_s
    is_certified = settings.scheme == "certified"
    slowest_rad_s = settings.certified.cutoffs_rad_s[0] if is_certified else settings.filter.a_rad_s
    forgotten_s = contact.forgotten_after_s(period_s, slowest_rad_s, np.array(settings.detector.threshold_Nm))
    first = min(int(np.searchsorted(cycle, contact.onset)), len(cycle) - 1)
    last = int(np.searchsorted(cycle, contact.end + forgotten_s / period_s, side="right")) - 1
    state = scheme["state"].reshape(-1)
    return Window(
        number=number,
        link=contact.link,
        first=first,
        last=max(last, first),
        is_armed=bool(first > 0 and state[first - 1] == SchemeState.MONITOR),
        is_chosen_on=(number if place is None else place) % 2 == (1 if place is None else 0),
    )
