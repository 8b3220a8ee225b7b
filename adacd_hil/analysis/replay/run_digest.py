"""What a comparison keeps of one run, gathered while its log is read in pieces."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.analysis.distribution import Distribution
from adacd_hil.analysis.replay.source import settings_of
from adacd_hil.log.log_files import LogError
from adacd_hil.log.reader import LogStream, Series
from adacd_hil.records import SchemeState
from adacd_hil.settings.configuration import Settings

_TOPICS: Final = ("/scheme", "/cycle", "/contact")
_TIMES: Final = ("lateness_ns", "feedback_ns", "command_ns", "compute_ns", "slack_ns")
_NOT_METADATA: Final = ("epoch_ns",)


class Detection(NamedTuple):
    """What a run reported of a contact in the end; time since motion start."""

    time_s: float
    link: int
    level: int
    kind: int
    tau_ext_peak: tuple[float, ...]
    force_N: float
    location: int = 0  # records.Location: what force_N is


@dataclass(frozen=True)
class RunDigest:
    """What is kept of one run."""

    path: Path
    settings: Settings
    metadata: dict[str, str]
    problem: str
    cycles: int
    states: list[tuple[float, str]]
    contacts: list[Detection]
    parameters: dict[str, list[float]]
    timing_us: dict[str, dict[str, float]]


class RunReader:
    """One of the logs: rows of /scheme with their cycle since motion start, and what is kept of it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._zero = _motion_start(path)
        self._stream = LogStream(path, _TOPICS)
        self.settings = settings_of(path, self._stream.attachments)
        self.cycles = 0
        self._states: list[tuple[float, str]] = []
        self._contacts: dict[int, Detection] = {}
        self._parameters: dict[str, list[float]] = {}
        self._times = {name: Distribution() for name in _TIMES}
        self._bounds: tuple[int, int] | None = None

    @property
    def zero_cycle(self) -> int:
        """Cycle at motion start."""
        return self._zero[0]

    @property
    def zero_ns(self) -> int:
        """Motion start, ns of the run's clock."""
        return self._zero[1]

    def only(self, first: int, end: int) -> None:
        """Read nothing but the cycles between two numbers since motion start."""
        self._bounds = first + self.zero_cycle, end + self.zero_cycle

    def _wanted(self, series: Series) -> Series:
        """Give the records of the cycles that are to be read."""
        if self._bounds is None or "cycle" not in series.fields:
            return series
        cycle = series.records["cycle"].astype(np.int64)
        return series.part((cycle >= self._bounds[0]) & (cycle < self._bounds[1]))

    def _is_over(self, series: Series) -> bool:
        """Tell whether all that is to be read has been."""
        return self._bounds is not None and bool(len(series)) and int(series.records["cycle"][0]) >= self._bounds[1]

    def __iter__(self) -> Iterator[NDArray[Any]]:
        """Give the records of /scheme, piece by piece."""
        zero_ns = self.zero_ns
        for piece in self._stream:
            if self._is_over(piece.series["/scheme"]):
                return
            scheme = self._wanted(piece.series["/scheme"])
            t_s = (scheme.t_ns - zero_ns) * 1e-9
            records = scheme.records
            self.cycles += len(records)
            for row in np.flatnonzero(records["state"] != records["previous_state"]).tolist():
                self._states.append((float(t_s[row]), _name_of(int(records["state"][row]))))
                if records["state"][row] == SchemeState.MONITOR:
                    self._keep_parameters(records[row])
            if len(records):
                self._last = records[-1].copy()
            contacts = self._wanted(piece.series["/contact"])
            for time_ns, record in zip(contacts.t_ns.tolist(), contacts.records, strict=True):
                self._take_contact((time_ns - zero_ns) * 1e-9, record)
            cycles = self._wanted(piece.series["/cycle"])
            for name in _TIMES:
                if name in cycles.fields:
                    self._times[name].add(cycles.records[name] / 1e3)
            yield records

    def _keep_parameters(self, record: Any) -> None:
        for name, value in zip(self.settings.estimator.parameter_names, record["theta_hat"].tolist(), strict=False):
            self._parameters.setdefault(name, []).append(value)

    def _take_contact(self, time_s: float, record: Any) -> None:
        """Keep the last report of each contact, with the time of its first one."""
        key = int(record["cycle"])
        before = self._contacts.get(key)
        names = record.dtype.names or ()
        told = ("level", "kind", "force_N", "location")
        level, kind, force, location = (record[name].item() if name in names else 0 for name in told)
        self._contacts[key] = Detection(
            time_s if before is None else before.time_s,
            int(record["link"]),
            int(level),
            int(kind),
            tuple(record["tau_ext_peak"].tolist()),
            float(force),
            int(location),
        )

    def digest(self) -> RunDigest:
        """Return what is kept, once everything has been read."""
        if not self._parameters and self.cycles:
            self._keep_parameters(self._last)
        timing = {}
        for name, times in self._times.items():
            found = times.low_percentiles() if name == "slack_ns" else times.percentiles()
            timing[name.removesuffix("_ns")] = found
        return RunDigest(
            self.path,
            self.settings,
            {key: value for key, value in self._stream.metadata.items() if key not in _NOT_METADATA},
            self._stream.problem,
            self.cycles,
            self._states,
            sorted(self._contacts.values()),
            self._parameters,
            timing,
        )


def _name_of(state: int) -> str:
    return SchemeState(state).name if state in SchemeState.__members__.values() else str(state)


def _motion_start(path: Path) -> tuple[int, int]:
    """Return cycle and time of the first ADAPT, else of the first cycle. Raises LogError."""
    first: tuple[int, int] | None = None
    for piece in LogStream(path, ("/scheme",)):
        scheme = piece.series["/scheme"]
        if not len(scheme):
            continue
        rows = np.flatnonzero(scheme.records["state"] == SchemeState.ADAPT)
        row = int(rows[0]) if rows.size else 0
        here = int(scheme.records["cycle"][row]), int(scheme.t_ns[row])
        first = first or here
        if rows.size:
            return here
    if first is None:
        raise LogError(f"log {path} has no /scheme")
    return first
