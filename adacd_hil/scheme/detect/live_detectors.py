"""Live detectors: those that the settings choose watch in the cycle, beside the scheme's own thresholds.

They get the stream of `detectors`, of the parameters in use, so that thresholds found offline hold live. They are armed
where the model is one to be believed, and reset whenever that begins. They add alarms and take none away.

A detector that raises, or that gives anything but one finite statistic per joint, has failed for good: that is a fault.
A cycle without a fresh sample leaves the alarms as they are; the sample after it follows a gap, so z is 0.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.records import DETECTOR_EVENT, JOINTS, Event, Vector
from adacd_hil.remedies import nearest_name
from adacd_hil.scheme.detect import detector_registry, detectors
from adacd_hil.scheme.detect.detector_registry import LiveDetector, Maker, describe_error
from adacd_hil.scheme.model import regressor
from adacd_hil.scheme.supervisor.transitions import ANY_CONTACT, CONTACT, CONTACT_SHIFT, DETECTOR_FAILED
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.schema import DetectorError
from adacd_hil.settings.scheme_settings import LiveDetectorSettings

_SHORTEST_SHARE, _LONGEST_SHARE = 0.5, 1.5
"""Of the nominal period: the shortest and the longest interval of samples that follow each other."""
_OWN = "the scheme's own thresholds"
_TRIALS = 200
"""Samples of a measurement of how long a detector takes."""


class LiveSample(NamedTuple):
    """What a cycle's numbers say: q, dq, tau_J (n,), theta (p,) in use, period_s since the cycle before."""

    cycle: int
    q: Vector
    dq: Vector
    tau_J: Vector
    theta: Vector
    period_s: float


class LiveStream:
    """The stream of `detectors`, sample by sample."""

    def __init__(self, settings: Settings) -> None:
        self._period_s, self._lag_s = settings.bus.period_s, settings.detector.live_lag_s
        self._standstill_rad_s = detectors.DetectorBankSettings().standstill_rad_s
        self._q, self._dq, self._tau_J, self._z, self._held_Nm = (np.zeros((2, JOINTS)) for _ in range(5))
        self._theta = np.zeros((2, len(settings.estimator.parameter_names)))
        self._interval_s = np.zeros(2)
        self._cycle: int | None = None

    def begin(self) -> None:
        """Forget the sample before."""
        self._cycle = None

    def take(self, sample: LiveSample) -> tuple[Vector, Vector]:
        """Take in a fresh sample; return its z and the friction that may hold (1, n), Nm, good until the next one."""
        for rows, new in ((self._q, sample.q), (self._dq, sample.dq), (self._tau_J, sample.tau_J)):
            rows[0] = rows[1]
            rows[1] = new
        self._theta[:] = sample.theta
        follows = self._cycle is not None and sample.cycle == self._cycle + 1
        is_near = _SHORTEST_SHARE * self._period_s <= sample.period_s <= _LONGEST_SHARE * self._period_s
        self._interval_s[1] = sample.period_s if follows and is_near else 0.0
        self._cycle = sample.cycle
        arm = self._q, self._dq, self._tau_J, self._theta, self._interval_s
        limits = self._lag_s, self._standstill_rad_s, regressor.F_C1
        detectors.stream(*arm, *limits, self._z, self._held_Nm)
        return self._z[1:], self._held_Nm[1:]


@dataclass
class RunningDetector:
    """A detector in the cycle. joints: bits of those over their threshold; slowest_ns: its longest call, if timed."""

    wish: LiveDetectorSettings
    detector: LiveDetector
    first: dict[str, NDArray[Any]] = field(init=False)
    threshold: Vector = field(init=False)
    statistic: Vector = field(default_factory=lambda: np.zeros(JOINTS))
    joints: int = 0
    took_ns: int = 0
    slowest_ns: int = 0

    def __post_init__(self) -> None:
        self.first = detector_registry.first_values(self.detector)
        self.threshold = np.array(self.wish.threshold)

    def reset(self) -> None:
        """Begin anew."""
        detector_registry.reset(self.detector, self.first)
        self.statistic[:] = 0.0
        self.joints = 0

    def take(self, z: Vector, held_Nm: Vector) -> None:
        """Take in a sample (1, n). Raises what the detector raises, ValueError for what is no statistic."""
        given = np.asarray(self.detector.take(z.copy(), held_Nm.copy()), np.float64)
        if given.shape != (1, JOINTS):
            raise ValueError(f"a statistic {given.shape} for a sample {(1, JOINTS)}")
        self.statistic[:] = given[0]
        if not np.isfinite(self.statistic).all():
            raise ValueError(f"statistics {', '.join(map(str, self.statistic.tolist()))} are not finite")
        self.joints = sum(1 << i for i in range(JOINTS) if self.statistic[i] > self.threshold[i])

    def describe(self) -> str:
        """Say what it is over."""
        over = [i for i in range(JOINTS) if self.joints >> i & 1]
        each = (f"joint {i + 1}: {self.statistic[i]:.4g} over {self.threshold[i]:.4g}" for i in over)
        return f"{self.wish.name} ({'; '.join(each)})"


class LiveDetectors:
    """All live detectors of a run, armed and told of by the pipeline."""

    def __init__(self, settings: Settings) -> None:
        """Make those of the settings, one at least. Raises DetectorError."""
        self.running = [_begin(wish, settings.bus.period_s) for wish in settings.detector.live]
        self.failure = ""
        """What has failed, in a line; empty while all is well."""
        self.stopwatch: Callable[[], int] | None = None
        """Gives ns; with it calls are timed. No decision depends on it."""
        self._current = self.running[0]
        self._is_paper = settings.scheme == "paper"
        self._stream = LiveStream(settings)
        self._is_armed = False
        self._told: set[str] = set()

    def compile(self) -> None:
        """Call everything once, so that nothing compiles later, and reset it. Raises DetectorError."""
        zeros = np.zeros(JOINTS)
        z, held_Nm = self._stream.take(LiveSample(0, zeros, zeros, zeros, self._stream._theta[0].copy(), 0.0))
        for each in self.running:
            try:
                each.take(z, held_Nm)
                each.reset()
            except Exception as error:
                raise DetectorError(f"detector {each.wish.name}: {describe_error(error)}") from error
        self._stream.begin()

    def measure(self, now_ns: Callable[[], int]) -> dict[str, int]:
        """Return the median time of a sample of each, ns, and reset them. Before the first cycle. Raises DetectorError.

        now_ns: a clock that goes on by itself.
        """
        times_ns = {}
        z = np.random.default_rng(0).standard_normal((_TRIALS, 1, JOINTS))
        for each in self.running:
            stamps = [now_ns()]
            for sample in z:
                try:
                    each.take(sample, np.zeros((1, JOINTS)))
                except Exception as error:
                    raise DetectorError(f"detector {each.wish.name}: {describe_error(error)}") from error
                stamps.append(now_ns())
            each.reset()
            times_ns[each.wish.name] = int(np.median(np.diff(stamps)))
        return times_ns

    def step(self, sample: LiveSample, is_fresh: bool, is_armed: bool) -> int:
        """Take in a cycle; return bits of `Observation`: alarms with their joints, and whether one has failed."""
        if self.failure:
            return DETECTOR_FAILED
        if not is_armed:
            self._is_armed = False
            return 0
        try:
            if not self._is_armed:
                self._arm()
            if is_fresh:
                self._take(sample)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # SystemExit, too: no detector ends the process of an arm that moves
            self.failure = self._failed(sample.cycle, error)
            return DETECTOR_FAILED
        observation = 0
        for each in self.running:
            if each.joints:
                is_collision = self._is_paper or each.wish.level == "collision"
                observation |= (ANY_CONTACT if is_collision else CONTACT) | each.joints << CONTACT_SHIFT
        return observation

    def _arm(self) -> None:
        self._stream.begin()
        for each in self.running:
            self._current = each
            each.reset()
        self._is_armed = True

    def _take(self, sample: LiveSample) -> None:
        z, held_Nm = self._stream.take(sample)
        for each in self.running:
            self._current = each
            if self.stopwatch is None:
                each.take(z, held_Nm)
                continue
            begin_ns = self.stopwatch()
            each.take(z, held_Nm)
            each.took_ns = self.stopwatch() - begin_ns
            each.slowest_ns = max(each.slowest_ns, each.took_ns)

    def _failed(self, cycle: int, error: BaseException) -> str:
        return f"detector {self._current.wish.name} failed in cycle {cycle}: {describe_error(error)}"

    def tell(self, is_reacting: bool, own_joints: int) -> list[Event]:
        """Say who has found the contact of REACT and STOPPED, each finder once a contact.

        own_joints: bits of those over the scheme's own thresholds.
        """
        if not is_reacting:
            self._told.clear()
            return []
        found = {each.wish.name: each.describe() for each in self.running if each.joints}
        if own_joints:
            joints = " and ".join(str(i + 1) for i in range(JOINTS) if own_joints >> i & 1)
            found[_OWN] = f"{_OWN} (joint {joints})"
        new = [text for name, text in found.items() if name not in self._told]
        if not new:
            return []
        verb = "found, too," if self._told else "found"
        self._told |= found.keys()
        return [Event("warning", DETECTOR_EVENT, f"contact {verb} by {' and '.join(new)}")]


def _begin(wish: LiveDetectorSettings, period_s: float) -> RunningDetector:
    """Begin a detector of the settings, once it has kept the contract at this period. Raises DetectorError."""
    make = _maker(wish.name)
    try:
        detector_registry.check_contract(wish.name, make, period_s)
        detector = make(period_s)
    except Exception as error:
        said = str(error) if isinstance(error, ValueError) else f"detector {wish.name}: {describe_error(error)}"
        raise DetectorError(f"`detector.live`: {said}") from error
    if not isinstance(detector, LiveDetector):
        raise DetectorError(f"`detector.live`: detector {wish.name} can't run live: it has no `state`")
    return RunningDetector(wish, detector)


def _maker(name: str) -> Maker:
    settings = detectors.DetectorBankSettings()
    makers = detectors.live_makers()
    if name in makers:
        return makers[name]
    if name in settings.registered:
        raise DetectorError(f"`detector.live`: detector {name} can't run live: it has no `state`")
    channels = settings.own_detectors.get(name, ())
    names = [settings.own_channels[place] for place in channels]
    if name.startswith(detectors.LIKELIHOOD):
        raise DetectorError(f"`detector.live`: {name} can't run live: its weights come from recorded motion")
    if names:
        raise DetectorError(f"`detector.live`: {name} has {len(names)} channels, name each: {', '.join(names)}")
    nearest = nearest_name(name, makers)
    hint = f"did you mean {nearest}?" if nearest else f"known: {', '.join(makers)}"
    raise DetectorError(f"`detector.live`: no detector {name} is registered here; {hint}")


def live_problems(settings: Settings) -> list[str]:
    """Say which detectors of `detector.live` can't run, a line each."""
    problems = []
    for name in dict.fromkeys(wish.name for wish in settings.detector.live):
        try:
            _maker(name)
        except DetectorError as error:
            problems.append(str(error))
    return problems


def describe_code(settings: Settings) -> str:
    """Name each live detector with the digest of its code, as a log's metadata say it; empty without any."""
    told = []
    for name in dict.fromkeys(wish.name for wish in settings.detector.live):
        make = _maker(name)
        digest = (
            "built in"
            if isinstance(make, partial) and make.func is detectors.BankChannel
            else (f"sha256 {detector_registry.source_digest(make)}")
        )
        told.append(f"{name}: {digest}")
    return "; ".join(told)
