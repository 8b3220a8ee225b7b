"""A run as plain arrays: what the host recorded, what the emulator knows, and the streams of the certified scheme.

Torques in Nm, joint arrays (2,), histories time-first (n, 2). Times in s count from *motion start*: the first cycle in
ADAPT.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.analysis.host_cycles import Span
from adacd_hil.analysis.timing import CycleColumns, Cycles
from adacd_hil.log.reader import LoggedEvent
from adacd_hil.log.time_window import TimeWindow
from adacd_hil.records import ContactReport, SchemeState, Vector
from adacd_hil.settings.configuration import Settings

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Truth:
    """What the emulator knows, on its own cycles (m,): external torque (m, 2), contact, payload, parameters (m, 7).

    Of a long run it has the cycles of contacts and the one after each. Payload and parameters then have cycles of their
    own, `model_cycle` (k,): those from which on they are as they are.
    """

    cycle: Cycles
    tau_ext: Vector
    contact_link: Vector
    contact_index: Vector
    payload_kg: Vector
    theta: Vector
    force_N: Vector | None = None  # size of the contact force (m,)
    time_s: Vector | None = None  # of its cycles (m,), since motion start; None: between those of the run
    model_cycle: Cycles | None = None
    attempt: Cycles | None = None  # of its cycles (m,), from 0; None: all are of one
    span: Span | None = None
    """What the emulator recorded, whichever cycles are kept; None: all."""

    def covers(self, cycle: int) -> bool:
        """Whether the emulator recorded what was true in a cycle."""
        return self.span is None or bool(self.span.covers(np.array(cycle)))

    def model_row(self, cycle: int) -> int | None:
        """Give the row of payload and parameters in a cycle; None without any."""
        cycles = self.cycle if self.model_cycle is None else self.model_cycle
        return max(int(np.searchsorted(cycles, cycle, side="right")) - 1, 0) if cycles.size else None


@dataclass(frozen=True)
class CertifiedStream:
    """What the block of the certified scheme has beyond the paper's, over n cycles.

    tau_ext, threshold: of the bank (n, channels, 2): each filter smoothed, then all but the slowest bare. theta_further
    (n, k): offsets, lags and friction terms; theta_std (n, p + k); promotions (n,).
    """

    tau_ext: Vector
    threshold: Vector
    theta_further: Vector
    theta_std: Vector
    promotions: Vector


@dataclass(frozen=True)
class PaperStream:
    """The paper's scheme beside, over n cycles: is_armed (n,), its residual and threshold (n, 2)."""

    is_armed: Mask
    tau_ext_hat: Vector
    threshold: Vector


@dataclass(frozen=True)
class Motion:
    """What was measured over n cycles: q rad, dq rad/s, tau_J Nm, each (n, 2)."""

    q: Vector
    dq: Vector
    tau_J: Vector


@dataclass(frozen=True)
class CheckCounts:
    """What the checks of the cyclic frames had counted when it was logged (k,): counts (k, devices, statuses)."""

    devices: tuple[str, ...]
    cycle: Cycles
    counts: Cycles


class StretchOfRun(NamedTuple):
    """A stretch of a log: as asked for, as found, widened so that it cuts nothing, and the contacts before it.

    motion_start_s: s since the beginning of the log.
    """

    asked: TimeWindow
    found: TimeWindow
    contacts_before: int
    motion_start_s: float


@dataclass(frozen=True)
class Run:
    """A run as plain arrays over n of its cycles: over all, or of a long one over those that `long_run` keeps.

    `truth` is None on a real arm.
    """

    cycle: Cycles
    t_ns: Cycles
    state: NDArray[np.uint8]
    fault: NDArray[np.uint8]
    tau_ext_hat: Vector
    tau_ext_hat_cad: Vector
    theta_hat: Vector
    threshold: Vector
    reports: tuple[ContactReport, ...]
    timing: CycleColumns
    truth: Truth | None
    settings: Settings
    metadata: Mapping[str, str]
    frames: int | None
    dropped: int | None
    finish_cycle: int | None = None  # in which the user asked to finish; None if nobody did
    contact_joints: NDArray[np.uint8] | None = None  # bit i: joint i is over its threshold
    certified: CertifiedStream | None = None  # None of the paper's scheme
    beside: PaperStream | None = None
    motion: Motion | None = None
    events: tuple[LoggedEvent, ...] = ()
    motion_start_ns: int | None = None  # None: the first cycle in ADAPT, else the first cycle
    all_cycles: int | None = None  # of a long run: how many there are, of which the n are kept
    bucket: int = 1  # of a long run: of so many cycles those with extremes are kept
    log_start_ns: int | None = None  # the beginning of its log
    stretch: StretchOfRun | None = None  # None: the whole log
    checks: CheckCounts | None = None  # None: not in the log
    broken_off: str = ""  # what ended the log, where that was not meant to

    @property
    def first_contact(self) -> int:
        """Number of the first contact: they are numbered over the whole log."""
        return 1 if self.stretch is None else 1 + self.stretch.contacts_before

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the columns of `theta_hat`."""
        return self.settings.estimator.parameter_names

    @property
    def has_cad(self) -> bool:
        """Whether the configuration gives a CAD model."""
        return len(self.settings.arm.cad_theta) > 0

    @property
    def a_rad_s(self) -> float:
        """Cut-off of the filter of `tau_ext_hat`: the bank's slowest, or the paper's."""
        is_certified = self.certified is not None
        return self.settings.certified.cutoffs_rad_s[0] if is_certified else self.settings.filter.a_rad_s

    @property
    def zero_ns(self) -> int:
        """Motion start, ns."""
        if self.motion_start_ns is not None:
            return self.motion_start_ns
        if self.t_ns.size == 0:
            return 0
        adapting = self.state == SchemeState.ADAPT
        return int(self.t_ns[int(np.argmax(adapting)) if adapting.any() else 0])

    def time_s(self) -> Vector:
        """Give the time of every cycle since motion start, s (n,)."""
        # Subtracted as integers: float64 resolves only 256 ns of an absolute time.
        return np.asarray((self.t_ns - self.zero_ns) * 1e-9, dtype=np.float64)

    def time_of_s(self, cycle: NDArray[Any]) -> Vector:
        """Give the time of any cycle numbers since motion start, s; between logged cycles by interpolation."""
        if self.cycle.size == 0:
            return np.zeros(len(cycle))
        return np.asarray(np.interp(cycle, self.cycle, self.time_s()), dtype=np.float64)

    def truth_time_s(self, rows: slice = slice(None)) -> Vector:
        """Give the time of the cycles of the truth, or of some rows of it, since motion start, s (k,)."""
        if self.truth is None:
            return np.zeros(0)
        time_s = self.truth.time_s
        return self.time_of_s(self.truth.cycle[rows]) if time_s is None else time_s[rows]
