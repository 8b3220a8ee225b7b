"""Detectors by name, and their channels: the built-in ones, and registered ones with their common contract.

A detector is registered by `register`, or by an entry point of the group `adacd_hil.detectors` in a lab's own package:
the entry point's name is the detector's, its object a function that begins one, as for `register`. Entry points are
loaded when a detector is first looked up; a run never loads one.

**Contract** (`StreamDetector`): `take` returns one finite statistic per sample and joint, which depends on this sample
and on those before it. `check_contract` plays noise before a detector is taken: whole, and cut in three.
"""

import importlib.metadata
from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Final, Protocol

import numpy as np

from adacd_hil.records import JOINTS, Vector
from adacd_hil.settings.schema import DetectorError

ENTRY_POINTS: Final = "adacd_hil.detectors"
"""Group of the entry points by which a package registers detectors."""
_CHECK_SAMPLES = 400
_CHECK_CUTS = (136, 137)
_CHECK_ZEROS = [0, *range(200, 240)]  # the first sample of each stream is 0
_LONGEST_TEXT = 200


class StreamDetector(Protocol):
    """A detector on one stream, from the stream's beginning; it keeps its state from one `take` to the next."""

    def take(self, z: Vector, held_Nm: Vector) -> Vector:
        """Process N more samples of the stream; return the statistic of each sample and joint (N, n), finite.

        z (N, n): the stream, Nm. held_Nm (N, n): the friction that may hold a standing joint. Both stay as they are. An
        alarm is a statistic above its threshold. A statistic may depend on its sample and those before, but not on how
        the stream is cut into pieces.
        """


Maker = Callable[[float], StreamDetector]
"""Begins a detector on a stream of a period, s."""


CUTOFFS_RAD_S: Final = (10.0, 50.0, 200.0)
"""Of the first-order and smoothed channels."""
OBSERVERS_RAD_S: Final = (25.0, 100.0)
"""Gains of the momentum observers."""
ONSET_SAMPLES: Final = (4, 8, 16, 32, 64, 128)
"""Ages of the steps that the likelihood ratio knows."""
FIRST_ORDER: Final = tuple(f"first-order {a:g}" for a in CUTOFFS_RAD_S)
SMOOTHED: Final = tuple(f"smoothed {a:g}" for a in CUTOFFS_RAD_S)
_OBSERVERS: Final = tuple(f"observer {gain:g}" for gain in OBSERVERS_RAD_S)
_LIKELIHOODS: Final = tuple(f"likelihood {age}" for age in ONSET_SAMPLES)
OWN_CHANNELS: Final = (*FIRST_ORDER, *SMOOTHED, "band-pass", *_OBSERVERS, *_LIKELIHOODS, "cusum")
"""The built-in channels, in the order of the statistics."""
_OWN_DETECTORS: Final = {
    "paper": FIRST_ORDER[:1],
    "bank": FIRST_ORDER,
    "smoothed bank": (*FIRST_ORDER[1:], *SMOOTHED),
    "band-pass": ("band-pass",),
    **{name: (name,) for name in _OBSERVERS},
    "likelihood ratio": _LIKELIHOODS,
    "cusum": ("cusum",),
}
"""The built-in detectors with their channels."""
_REGISTERED: dict[str, Maker] = {}
_ORIGINS: dict[str, str] = {}
"""Packages of the detectors that entry points added."""
_LOADED: list[str] = []


def channels() -> tuple[str, ...]:
    """Return the names of all channels in the order of the statistics, those of registered detectors last.

    Raises DetectorError if one of these can't be used.
    """
    return (*OWN_CHANNELS, *registered())


def detectors() -> dict[str, list[int]]:
    """Return the indices in `channels` of each detector's channels, by its name, built-in ones first.

    A joint is over a detector's threshold if one of these channels is over its own. Raises DetectorError if a
    registered detector can't be used.
    """
    names = channels()
    members = _OWN_DETECTORS | {name: (name,) for name in registered()}
    return {name: [names.index(channel) for channel in members[name]] for name in members}


def registered() -> Mapping[str, Maker]:
    """Return all registered detectors by name; the first call loads the entry points.

    Raises DetectorError for an entry point that can't be loaded, breaks the contract, or has a name that is taken; then
    the next call loads them again.
    """
    if not _LOADED:
        _LOADED.append(ENTRY_POINTS)
        try:
            for entry in sorted(importlib.metadata.entry_points(group=ENTRY_POINTS), key=lambda entry: entry.name):
                _load(entry)
        except DetectorError:
            forget_loaded()
            raise
    return _REGISTERED


def _load(entry: importlib.metadata.EntryPoint) -> None:
    """Register the detector of an entry point.

    Raises DetectorError if it can't be loaded, breaks the contract, or its name is taken.
    """
    package = f"package {entry.dist.name} {entry.dist.version}" if entry.dist is not None else entry.value
    try:
        register(entry.name, entry.load())
    except Exception as error:
        raise DetectorError(f"detector {entry.name} of {package} can't be used: {describe_error(error)}") from error
    _ORIGINS[entry.name] = package


def forget_loaded() -> None:
    """Remove the detectors of entry points, so that the next look-up loads them again; those of `register` stay."""
    _LOADED.clear()
    for name in list(_ORIGINS):
        unregister(name)


def register(name: str, make: Maker) -> None:
    """Register a detector under a name, for this process. make: begins one on a stream of a period, s.

    Raises ValueError for a name that is taken, empty or can't be printed, and for a detector that breaks the contract.
    Errors of the detector are raised as they are.
    """
    if not name.strip() or not name.isprintable():
        raise ValueError(f"a detector needs a name that can be printed, not {name!r}")
    if name in (*_REGISTERED, *OWN_CHANNELS, *_OWN_DETECTORS):
        where = f", of {_ORIGINS[name]}" if name in _ORIGINS else ""
        raise ValueError(f"there is a detector or channel {name} already{where}")
    check_contract(name, make)
    _REGISTERED[name] = make


def unregister(name: str) -> None:
    """Remove a registered detector from this process by its name. Raises KeyError if there is none."""
    del _REGISTERED[name]
    _ORIGINS.pop(name, None)


def check_contract(name: str, make: Maker, period_s: float = 1e-3) -> None:
    """Run a detector on two joints' noise, with moments at zero as a standing arm has; whole, and cut in three.

    make: begins it on a stream of period_s. Raises ValueError if a statistic is no array of numbers, has another shape,
    isn't finite, or depends on the cut, or if the samples are changed. Errors of the detector are raised as they are.
    """
    z = np.random.default_rng(0).standard_normal((_CHECK_SAMPLES, JOINTS))
    z[_CHECK_ZEROS] = 0.0
    held_Nm = np.where(z > 1.0, 0.1, 0.0)
    given = z.copy(), held_Nm.copy()
    first, parts = make(period_s), make(period_s)
    whole = np.array(checked_statistics(name, first.take(*given), z), np.float64)
    if not all(map(np.array_equal, given, (z, held_Nm))):
        raise ValueError(f"detector {name} changes the samples that it is given, which others take after it")
    rows = [slice(*bounds) for bounds in pairwise((0, *_CHECK_CUTS, None))]
    cut = np.concatenate([parts.take(z[each], held_Nm[each]) for each in rows])
    if not np.array_equal(whole, cut):
        sample = int(np.argwhere(whole != cut)[0, 0])
        places = " and ".join(map(str, _CHECK_CUTS))
        raise ValueError(f"detector {name} gives sample {sample} another statistic where the stream is cut at {places}")


def checked_statistics(name: str, statistics: Vector, z: Vector) -> Vector:
    """Return the statistics that a detector gives for samples z (N, n).

    Raises ValueError if they are no array (N, n) of finite numbers.
    """
    kind = statistics.dtype if isinstance(statistics, np.ndarray) else type(statistics).__name__
    if not isinstance(statistics, np.ndarray) or statistics.dtype.kind not in "fiu":
        raise ValueError(f"detector {name} gives {kind}, an array of real numbers is expected")
    if statistics.shape != z.shape:
        raise ValueError(f"detector {name} gives statistics {statistics.shape} for samples {z.shape}")
    if not np.isfinite(statistics).all():
        sample, joint = np.argwhere(~np.isfinite(statistics))[0].tolist()
        raise ValueError(f"detector {name} gives {statistics[sample, joint]} for sample {sample} of joint {joint + 1}")
    return statistics


def statistics_of(name: str, detector: StreamDetector, z: Vector, held_Nm: Vector) -> Vector:
    """Return a detector's statistics (N, n) of N more samples of its stream, as of `StreamDetector.take`.

    Raises DetectorError, with the detector's name, if it raises an error or its statistics break the contract.
    """
    try:
        return checked_statistics(name, detector.take(z, held_Nm), z)
    except Exception as error:
        raise DetectorError(f"detector {name} can't be used: {describe_error(error)}") from error


def describe_error(error: BaseException) -> str:
    """Return an exception as one line, its type and at most `_LONGEST_TEXT` characters of its text."""
    text = " ".join(str(error).split())[:_LONGEST_TEXT]
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
