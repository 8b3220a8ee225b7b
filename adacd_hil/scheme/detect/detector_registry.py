"""Registered detectors: where they come from, and the contract that each of them keeps.

A detector is registered by `register`, or by an entry point of the group `adacd_hil.detectors` in a lab's own package:
the entry point's name is the detector's, its object what begins one, as for `register`. Entry points are loaded when a
detector is first looked up; a run without live detectors loads none.

**Contract of every detector** (`StreamDetector`): `take` returns one finite statistic per sample and joint, which
depends on this sample and on those before it.

**Contract of a live one** (`LiveDetector`): all that it remembers is in `state`, arrays of a fixed size by name, which
it changes in place. So it is reset by writing their first values back, in a cycle, and a log replays to the same
decisions. A detector without `state` runs offline only.

What of this can be found out is found out before a detector is taken: the stream whole, cut, and sample by sample in
arrays that are used again; two detectors beside each other; one again after a reset.
"""

import hashlib
import importlib.metadata
import inspect
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from adacd_hil.records import JOINTS, Vector
from adacd_hil.settings.schema import DetectorError

ENTRY_POINTS: Final = "adacd_hil.detectors"
"""Group of the entry points by which a package registers detectors."""
_CHECK_SAMPLES, _CHECK_CUT, _CHECK_AGAIN = 400, 137, 100
_DIGITS = 16
_LONGEST_TEXT = 200


class StreamDetector(Protocol):
    """One detector on one stream, from its beginning."""

    def take(self, z: Vector, held_Nm: Vector) -> Vector:
        """Take in N more samples of z and of the friction that may hold (N, n); return the statistic of each (N, n).

        An alarm is a statistic above its threshold. A sample's depends on it and on those before it, not on how the
        stream is cut into pieces.
        """


@runtime_checkable
class LiveDetector(Protocol):
    """A `StreamDetector` that also runs in the cycle. state: all that it remembers, changed in place."""

    state: Mapping[str, NDArray[Any]]

    def take(self, z: Vector, held_Nm: Vector) -> Vector:
        """Take in samples, in a cycle one; as for `StreamDetector`."""


Maker = Callable[[float], StreamDetector]
"""Begins a detector on a stream of a period, s."""


class Registered(NamedTuple):
    """A detector that was registered. origin: where it is from, in words; is_live: it may run in the cycle."""

    make: Maker
    origin: str
    is_live: bool


_REGISTERED: dict[str, Registered] = {}
_LOADED: list[str] = []


def registered(reserved: Collection[str]) -> Mapping[str, Registered]:
    """Return all registered detectors by name, those of entry points included. reserved: names of the built-in ones.

    Raises DetectorError for an entry point that can't be loaded, breaks the contract, or has a name that is taken.
    """
    if not _LOADED:
        _LOADED.append(ENTRY_POINTS)
        try:
            for entry in sorted(importlib.metadata.entry_points(group=ENTRY_POINTS), key=lambda entry: entry.name):
                _load(entry, reserved)
        except DetectorError:
            _LOADED.clear()
            _remove_loaded()
            raise
    return _REGISTERED


def _load(entry: importlib.metadata.EntryPoint, reserved: Collection[str]) -> None:
    package = f"package {entry.dist.name} {entry.dist.version}" if entry.dist is not None else entry.value
    try:
        add(entry.name, entry.load(), reserved, package)
    except Exception as error:
        raise DetectorError(f"detector {entry.name} of {package} can't be used: {describe_error(error)}") from error


def _remove_loaded() -> None:
    """Take out what an entry point has registered, so that the next look-up says again what is wrong."""
    for name in [name for name, found in _REGISTERED.items() if found.origin]:
        del _REGISTERED[name]


def add(name: str, make: Maker, reserved: Collection[str], origin: str = "") -> None:
    """Register a detector. origin: of an entry point, its package.

    Raises ValueError for a name that is taken, and for a detector that doesn't keep the contract.
    """
    if name in _REGISTERED or name in reserved:
        known = _REGISTERED.get(name)
        where = f", of {known.origin}" if known is not None and known.origin else ""
        raise ValueError(f"there is a detector or channel {name} already{where}")
    _REGISTERED[name] = Registered(make, origin, check_contract(name, make))


def remove(name: str) -> None:
    """Take out a detector. Raises KeyError for one that was not registered."""
    del _REGISTERED[name]


def check_contract(name: str, make: Maker, period_s: float = 1e-3) -> bool:
    """Return whether a detector may run live. Raises ValueError if it breaks the contract, saying in what."""
    z = np.random.default_rng(0).standard_normal((_CHECK_SAMPLES, JOINTS))
    held_Nm = np.where(z > 1.0, 0.1, 0.0)
    first, parts = make(period_s), make(period_s)
    whole = first.take(z.copy(), held_Nm.copy())
    if whole.shape != z.shape:
        raise ValueError(f"detector {name} gives statistics {whole.shape} for samples {z.shape}")
    if not np.isfinite(whole).all():
        sample, joint = np.argwhere(~np.isfinite(whole))[0].tolist()
        raise ValueError(f"detector {name} gives {whole[sample, joint]} for sample {sample} of joint {joint + 1}")
    whole = np.array(whole, np.float64)
    cut = np.concatenate([parts.take(z[rows], held_Nm[rows]) for rows in (slice(_CHECK_CUT), slice(_CHECK_CUT, None))])
    if not np.array_equal(whole, cut):
        sample = int(np.argwhere(whole != cut)[0, 0])
        raise ValueError(
            f"detector {name} gives sample {sample} another statistic where the stream is cut at {_CHECK_CUT}"
        )
    if not hasattr(first, "state"):
        return False
    _check_live(name, make(period_s), z, held_Nm, whole)
    return True


def _check_live(name: str, detector: Any, z: Vector, held_Nm: Vector, whole: Vector) -> None:
    """Play the stream as the cycle does, reset the detector and play again. Raises ValueError."""
    state = detector.state
    if not (isinstance(state, Mapping) and all(isinstance(each, np.ndarray) for each in state.values())):
        raise ValueError(f"detector {name}: state must be numpy arrays by name")
    arrays, first = dict(state), first_values(detector)
    half = _CHECK_SAMPLES // 2
    _compare_singly(name, detector, z[:half], held_Nm[:half], whole, "fed sample by sample")
    sizes = _sizes(detector)
    _compare_singly(name, detector, z[half:], held_Nm[half:], whole[half:], "fed sample by sample", half)
    for what, size in _sizes(detector).items():
        if sizes.get(what) != size:
            raise ValueError(
                f"detector {name} grows: {what} has {sizes.get(what, 'no size')}, {half} samples on {size}"
            )
    for key, values in arrays.items():
        if detector.state.get(key) is not values:
            raise ValueError(f"detector {name} replaces its state {key}: it must be changed in place")
    reset(detector, first)
    again = slice(_CHECK_AGAIN)
    _compare_singly(name, detector, z[again], held_Nm[again], whole, "reset: it keeps something beside its state")


def _compare_singly(
    name: str, detector: StreamDetector, z: Vector, held_Nm: Vector, whole: Vector, how: str, first: int = 0
) -> None:
    sample, held = np.empty((1, JOINTS)), np.empty((1, JOINTS))
    for k in range(len(z)):
        sample[0], held[0] = z[k], held_Nm[k]
        statistic = np.array(detector.take(sample, held))
        if statistic.shape != (1, JOINTS) or not np.array_equal(statistic[0], whole[k]):
            raise ValueError(f"detector {name} gives sample {first + k} another statistic when it is {how}")


def _sizes(detector: StreamDetector) -> dict[str, int]:
    """Return the size of each array of the state, and of all else that has a length."""
    held = {f"state {name}": values.size for name, values in getattr(detector, "state", {}).items()}
    others = {name: value for name, value in getattr(detector, "__dict__", {}).items() if hasattr(value, "__len__")}
    return held | {name: len(value) for name, value in others.items() if not isinstance(value, np.ndarray)}


def first_values(detector: LiveDetector) -> dict[str, NDArray[Any]]:
    """Copy the state of a detector that has just begun."""
    return {name: values.copy() for name, values in detector.state.items()}


def reset(detector: LiveDetector, first: Mapping[str, NDArray[Any]]) -> None:
    """Begin anew: write the first values into the state, in place."""
    for name, values in first.items():
        detector.state[name][...] = values


def source_digest(make: Maker) -> str:
    """Digest the file that a detector's class is written in; "unknown" where it is in none. Its imports don't count."""
    try:
        file = inspect.getsourcefile(inspect.unwrap(make))
        return "unknown" if file is None else hashlib.sha256(Path(file).read_bytes()).hexdigest()[:_DIGITS]
    except (TypeError, OSError):
        return "unknown"


def describe_error(error: BaseException) -> str:
    """Say in one line what was raised."""
    text = " ".join(str(error).split())[:_LONGEST_TEXT]
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
