"""A run's log as named numpy arrays, one row per cycle, with its events, contacts and certificates."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.extras import install_command
from adacd_hil.lab.logs.log_info import read_info
from adacd_hil.lab.score.metrics import certificates_in
from adacd_hil.lab.score.report_wording import lacks_text
from adacd_hil.log.log_files import LogError
from adacd_hil.log.log_parts import log_in
from adacd_hil.log.logged_run import settings_of
from adacd_hil.log.reader import RunLog, each_once, read_log
from adacd_hil.log.types.topics import CONTACT, CONTROL, CYCLE, EVENTS, SCHEME
from adacd_hil.printable import number_of
from adacd_hil.records import MOTION_START, ContactReport, SchemeState, Vector
from adacd_hil.remedies import hint
from adacd_hil.settings.configuration import Settings

if TYPE_CHECKING:
    import pandas
    import polars

    from adacd_hil.scheme.identify.certificate import Certificate

_TOPICS: Final = (SCHEME.name, CONTROL.name, CYCLE.name)
"""Topics with a record per cycle."""
_READ: Final = (*_TOPICS, CONTACT.name, EVENTS.name)


class RunEvent(NamedTuple):
    """An event: time, s since motion start; level: "info", "warning" or "error"."""

    t_s: float
    level: str
    name: str
    message: str


class RunContact(NamedTuple):
    """A contact. t_s: time of detection, s since motion start. report: the last one of this contact."""

    t_s: float
    report: ContactReport

    def __repr__(self) -> str:
        report = self.report
        what = f"{report.kind.name.lower()} on link {report.link}, {report.level.name.lower()}"
        return f"<RunContact at {self.t_s:.3f} s: {what}>"


@dataclass(frozen=True)
class LoadedRun:
    """A run of n cycles; of a cut log, the cycles that all of its topics have.

    arrays: read-only, by the names of `adacd-hil log info` and `records.py`, each (n,) or (n, columns): `q`, `dq` (rad,
    rad/s), `tau_J`, `tau_ext_hat`, `threshold` (Nm), `theta_hat`, `tau_d`, `tau_c`, `state`, `lateness_ns` and so on,
    and `t_s`. Times are s since motion start, the first cycle in ADAPT, else since the first cycle. problem: defect of
    the log, "" for a whole one.
    """

    path: Path
    arrays: Mapping[str, NDArray[Any]]
    events: tuple[RunEvent, ...]
    contacts: tuple[RunContact, ...]
    metadata: Mapping[str, str]
    attachments: Mapping[str, bytes]
    problem: str

    def __repr__(self) -> str:
        seconds = float(self.t_s[-1] - self.t_s[0]) if len(self) else 0.0
        found = (number_of(len(self), "cycle"), f"{seconds:.1f} s", number_of(len(self.contacts), "contact"))
        certified = number_of(len(self.certificates), "certificate")
        return f"<LoadedRun {self.path}: {', '.join(found)}, {certified}{'; ' + self.problem if self.problem else ''}>"

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return an array by its name. Raises KeyError, with the nearest name, for an unknown one."""
        if name not in self.arrays:
            raise KeyError(f"no array {name!r}; {hint(name, self.arrays)}")
        return self.arrays[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.arrays)

    def __len__(self) -> int:
        return self.t_s.size

    @property
    def t_s(self) -> Vector:
        """Times of the cycles (n,), s since motion start: the first cycle in ADAPT, else the first cycle.

        Cycles before motion start have negative times.
        """
        return self.arrays["t_s"]

    @property
    def state(self) -> NDArray[np.uint8]:
        """States of the scheme (n,), numbers of `SchemeState`."""
        return self.arrays["state"]

    @property
    def motion(self) -> dict[str, Vector]:
        """Arrays for `detect`: `t` (n,), s since motion start, `q`, `dq`, `tau_J` (n, 2), rad, rad/s, Nm."""
        return {"t": self.t_s, **{name: self.arrays[name] for name in ("q", "dq", "tau_J")}}

    @cached_property
    def certificates(self) -> "tuple[Certificate, ...]":
        """Certificates that were not taken back, oldest first, read from the events once and kept.

        Unreadable ones, such as those of another version, are left out. () if there is none, or the log is cut before
        its end.
        """
        return tuple(certificates_in((event.name, event.message) for event in self.events))

    @property
    def certificate(self) -> "Certificate | None":
        """The last certificate that was not taken back; None without one."""
        return self.certificates[-1] if self.certificates else None

    @cached_property
    def settings(self) -> Settings:
        """Settings of the run, from the log. Raises LogError if the log lacks them or they can't be read."""
        return settings_of(self.path, self.attachments)

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return a column (n,) for each number of a cycle, such as `q_1` and `q_2`; `state` has the states' names.

        An array (n,) keeps its name.
        """
        found: dict[str, NDArray[Any]] = {}
        for name, values in self.arrays.items():
            if values.ndim == 1:
                found[name] = values
            else:
                found |= {f"{name}_{place + 1}": values[:, place] for place in range(values.shape[1])}
        found["state"] = np.array([state.name for state in SchemeState])[self.state]
        return found

    def to_pandas(self) -> "pandas.DataFrame":
        """Return `columns` as a data frame with the index `t_s`.

        Raises ImportError without pandas; it names the command that installs it.
        """
        frame: pandas.DataFrame = _extra("pandas").DataFrame(self.columns())
        return frame.set_index("t_s")

    def to_polars(self) -> "polars.DataFrame":
        """Return `columns` as a data frame, `t_s` as one of its columns.

        Raises ImportError without polars; it names the command that installs it.
        """
        frame: polars.DataFrame = _extra("polars").DataFrame(self.columns())
        return frame


def _extra(name: str) -> Any:
    """Import and return a library, "pandas" or "polars". Raises ImportError with the command that installs it."""
    try:
        return import_module(name)
    except ImportError:
        raise ImportError(f"to_{name} needs the extra `{name}`: {install_command(name)}") from None


def load(run: str | Path) -> LoadedRun:
    """Return the run in a log, all parts of the log as one. run: a folder with run.mcap, or the log's first part.

    Cycles that lack a record of /scheme, /control or /cycle are left out. If /control or /cycle has no record at all,
    no cycle is left out for it, and `arrays` lacks its fields. A cut or damaged log is read as far as it is intact.
    `problem` names the damage, else the cycles left out and a lacking /contact or /events. Raises LogError, in one
    line, if it can't be read, has no cycle, or its times don't grow.
    """
    path = log_in(run)
    log = read_log(path, _READ)
    arrays = _arrays(log)
    t_ns = arrays.pop("t_ns")
    left_out = max(len(log.topics[topic]) for topic in _TOPICS) - len(t_ns)
    there = {each.topic for each in read_info(path, is_brief=True).topics}
    lack = f"{number_of(left_out, 'cycle')} without a record of each topic left out" if left_out else ""
    is_moving = np.flatnonzero(arrays["state"] == MOTION_START)
    zero_ns = int(t_ns[is_moving[0] if is_moving.size else 0])
    arrays = {"t_s": (t_ns - zero_ns) * 1e-9, **arrays}
    for values in arrays.values():
        values.flags.writeable = False
    events = sorted(log.events, key=lambda event: event.t_ns)
    return LoadedRun(
        path=path,
        arrays=arrays,
        events=tuple(RunEvent((t_ns - zero_ns) * 1e-9, *event) for t_ns, event in events),
        contacts=tuple(RunContact((t_ns - zero_ns) * 1e-9, report) for t_ns, report in each_once(log.contacts)),
        metadata=log.metadata,
        attachments=log.attachments,
        problem=log.problem or "; ".join(filter(None, (lack, lacks_text((CONTACT.name, EVENTS.name), there)))),
    )


def _arrays(log: RunLog) -> dict[str, NDArray[Any]]:
    """Return the fields of /scheme, /control and /cycle, and `t_ns`, for the cycles that all three have.

    `t_ns`: times of the records of /scheme. A field of several topics is that of the first. A topic without any record
    is left out, with its fields. Raises LogError if /scheme has none, no cycle is common, or times don't grow.
    """
    if not len(log.scheme):
        raise LogError(f"log {log.path} has no cycle" + (f": {log.problem}" if log.problem else ""))
    names = [topic for topic in _TOPICS if len(log.topics[topic])]
    series = [log.topics[topic] for topic in names]
    stamps = [topic.records["publish_time"].astype(np.int64) for topic in series]
    common = stamps[0]
    for name, stamp in zip(names, stamps, strict=True):
        backward = np.flatnonzero(np.diff(stamp) <= 0) + 1
        if backward.size:
            at_s = (stamp[backward[0]] - stamp[0]) * 1e-9
            raise LogError(f"log {log.path}, {name}: a cycle at {at_s:.3f} s is not after the one before")
        common = np.intersect1d(common, stamp)
    if not len(common):
        raise LogError(f"log {log.path}: no cycle has a record of each of {', '.join(names)}")
    arrays: dict[str, NDArray[Any]] = {}
    for topic, stamp in zip(series, stamps, strict=True):
        rows = np.searchsorted(stamp, common)
        arrays |= {"t_ns": topic.t_ns[rows]} if not arrays else {}
        arrays |= {name: topic[name][rows] for name in topic.fields if name not in arrays}
    return arrays
