"""A run out of its logs: what the report and the metrics need of them."""

import hashlib
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from adacd_hil.analysis.run import CertifiedStream, Motion, PaperStream, Run, Truth
from adacd_hil.analysis.timing import Cycles, columns_of_series
from adacd_hil.config import Settings, parse, renewed
from adacd_hil.device.arm import SYNC_OVERFLOW
from adacd_hil.log.errors import LogError
from adacd_hil.log.reader import RunLog, Series, read_log
from adacd_hil.records import JOINTS, Request, SchemeState

RUN_TOPICS: Final = ("/scheme", "/cycle", "/contact", "/events")
"""Of a run's log, what a report reads."""
_BEGINNING: Final = (SchemeState.INIT, SchemeState.COMMISSION)


class Source(NamedTuple):
    """The log that a run was read from; `is_complete`: it is whole and nothing was dropped on the way to it."""

    log_name: str
    problem: str = ""  # what is missing, one line
    is_complete: bool = True


def read_run(log_path: Path, truth_path: Path | None) -> tuple[Run, Source]:
    """Read a log, and the emulator's truth if there is one. Raises LogError."""
    log = read_log(log_path, RUN_TOPICS)
    truth_log = None if truth_path is None else read_log(truth_path, ("/truth",))
    logs = [log] if truth_log is None else [log, truth_log]
    source = Source(
        log_path.name,
        problem="; ".join(entry.problem for entry in logs if entry.problem),
        is_complete=all(entry.is_complete for entry in logs),
    )
    return run_from_log(log, truth_log), source


def run_from_log(log: RunLog, truth_log: RunLog | None) -> Run:
    """Take what the metrics need out of a log and the emulator's own log. Raises LogError."""
    scheme, settings = log.scheme, _settings(log)
    metadata = dict(log.metadata)
    if "arm.dbc" in log.attachments:
        metadata["dbc_sha256"] = hashlib.sha256(log.attachments["arm.dbc"]).hexdigest()
    if truth_log is not None:
        metadata |= {f"emulator_{key}": value for key, value in truth_log.metadata.items() if key not in metadata}
    return Run(
        cycle=scheme["cycle"].astype(np.int64),
        t_ns=scheme.t_ns,
        state=scheme["state"],
        fault=scheme["fault"],
        tau_ext_hat=scheme["tau_ext_hat"],
        tau_ext_hat_cad=scheme["tau_ext_hat_cad"],
        theta_hat=scheme["theta_hat"],
        threshold=scheme["threshold"],
        reports=tuple(entry.report for entry in log.contacts),
        timing=columns_of_series(log.cycle),
        finish_cycle=_finish_cycle(scheme),
        contact_joints=scheme["contact_joints"],
        truth=_truth(truth_log, scheme),
        settings=settings,
        metadata=metadata,
        frames=_count(log.summary, "frames"),
        dropped=_count(log.summary, "dropped"),
        certified=_certified_stream(scheme, settings),
        beside=_paper_stream(scheme),
        motion=Motion(scheme["q"], scheme["dq"], scheme["tau_J"]),
        events=tuple(log.events),
    )


def _certified_stream(scheme: Series, settings: Settings) -> CertifiedStream | None:
    """Take out what only the certified scheme records; None of a log without it."""
    if "tau_ext_bank" not in scheme.fields:
        return None
    shape = (-1, settings.channel_count, JOINTS)
    return CertifiedStream(
        tau_ext=scheme["tau_ext_bank"].reshape(shape),
        threshold=scheme["threshold_bank"].reshape(shape),
        theta_further=scheme["theta_further"],
        theta_std=scheme["theta_std"],
        promotions=scheme["promotions"],
    )


def _paper_stream(scheme: Series) -> PaperStream | None:
    """Take out what the paper's scheme beside records; None of a log without it."""
    if "paper_is_armed" not in scheme.fields:
        return None
    return PaperStream(
        is_armed=scheme["paper_is_armed"] > 0.5,
        tau_ext_hat=scheme["paper_tau_ext_hat"],
        threshold=scheme["paper_threshold"],
        theta_hat=scheme["paper_theta_hat"],
    )


def _finish_cycle(scheme: Series) -> int | None:
    """Find the cycle in which the user asked to finish."""
    asked = np.flatnonzero(scheme["request"] == Request.FINISH)
    return int(scheme["cycle"][asked[0]]) if asked.size else None


def _truth(log: RunLog | None, scheme: Series) -> Truth | None:
    if log is None or len(log.truth) == 0:
        return None
    truth = log.truth
    return Truth(
        cycle=_host_cycles(truth["cycle"].astype(np.int64), scheme),
        tau_ext=truth["tau_ext"],
        contact_link=truth["contact_link"],
        contact_index=truth["contact_index"],
        payload_kg=truth["payload"],
        theta=truth["theta"],
        force_N=truth["contact_force"] if "contact_force" in truth.fields else None,
    )


def _host_cycles(cycle: Cycles, scheme: Series) -> Cycles:
    """Turn the emulator's cycles into the host's.

    The emulator counts by the counter of SYNC, anew in each attempt of the run: its cycles lack all whole rounds of the
    counter that the host had counted before.
    """
    is_beginning = np.isin(scheme["state"], _BEGINNING)
    first = np.flatnonzero(is_beginning & ~np.concatenate(([False], is_beginning[:-1])))
    begins = scheme["cycle"][first].astype(np.int64) if first.size else np.zeros(1, np.int64)
    attempt = np.cumsum(np.diff(cycle, prepend=cycle[0]) < 0)
    shift = begins - begins % SYNC_OVERFLOW
    return np.asarray(cycle + shift[np.minimum(attempt, len(shift) - 1)])


def _settings(log: RunLog) -> Settings:
    text = log.attachments.get("config.toml")
    if text is None:
        raise LogError(f"log {log.path} has no attachment config.toml")
    try:
        return parse(Settings, renewed(tomllib.loads(text.decode("utf-8"))))
    except ValueError as error:  # what is wrong with the text, the TOML or a setting is a ValueError each
        raise LogError(f"log {log.path}, attachment config.toml: {error}") from None


def _count(summary: Mapping[str, str], key: str) -> int | None:
    """Give a number of the log's summary; a cut file has none."""
    return int(summary[key]) if key in summary else None
