"""Small runs made by hand: 1 kHz, a = 10 rad/s, threshold 0.15 Nm, zeros wherever a test doesn't say otherwise."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adacd_hil.lab.score.evaluation import RunGatherer, evaluate
from adacd_hil.lab.score.metrics import Metrics
from adacd_hil.lab.score.run_arrays import (
    CertifiedStream,
    CycleColumns,
    MeasuredMotion,
    PaperStream,
    Run,
    columns_of_records,
    is_realtime,
)
from adacd_hil.log.logged_run import Truth
from adacd_hil.log.recording.recorder import Recorder
from adacd_hil.log.types.topics import CYCLE, ChannelId, pack_contact, pack_scheme
from adacd_hil.log.types.truth_topic import TRUTH, TRUTH_LAYOUT, truth_channels
from adacd_hil.records import ContactReport, CycleRecord, FaultReason, Request, SchemeOutput, SchemeState
from adacd_hil.scheme.pipeline.pipeline import layout_of
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.toml_text import to_toml

CAD_THETA = (0.1786065, 0.036855, 0.0189645, 0.0, 0.0, 0.0, 0.0)
THETA = (0.2, 0.04, 0.02, 0.03, 0.015, 0.0375, 0.025)

FIRST_CYCLE = 100
EPOCH_NS = 5_000_000_000_000
"""Neither cycles nor times begin at zero, so that a row taken for a cycle or a time shows."""

A, M, R, S, P = SchemeState.ADAPT, SchemeState.MONITOR, SchemeState.REACT, SchemeState.STOPPED, SchemeState.PAYLOAD

PAPER_LIKE = ((SchemeState.ENABLE, 50), (A, 1000), (M, 4000), (P, 500), (A, 800), (M, 3000))
"""Sections A to E. Row 50 is motion start, row 1050 enters MONITOR, 5050 PAYLOAD, 5550 ADAPT, 6350 MONITOR."""
ZERO_ROW = 50


def make_run(
    *stays: tuple[SchemeState, int],
    has_truth: bool = True,
    clock: str = "lockstep",
    reason: FaultReason = FaultReason.DRIVE,
    **changes: Any,
) -> Run:
    """Make a run that stays in the given states for the given numbers of cycles, both joints at 0.25 rad.

    reason: of all of its faults.
    """
    states = [state for state, cycles in stays or PAPER_LIKE for _ in range(cycles)]
    count = len(states)
    cycle = FIRST_CYCLE + np.arange(count, dtype=np.int64)
    threshold = np.full((count, 2), np.inf)
    threshold[np.isin(states, (M, R, S))] = 0.15
    zeros = np.zeros(count, dtype=np.int64)
    t_ns = EPOCH_NS + cycle * 1_000_000
    zero_ns = int(t_ns[states.index(A) if A in states else 0])
    q = np.full((count, 2), 0.25)
    truth = Truth(
        cycle=cycle.copy(),
        tau_ext=np.zeros((count, 2)),
        contact_link=np.zeros(count),
        contact_index=np.full(count, -1.0),
        payload_kg=np.zeros(count),
        theta=np.tile(THETA, (count, 1)),
        attempt=zeros,
        model_cycle=cycle,
        model_attempt=zeros,
        force_N=np.zeros(count),
        time_s=(t_ns - zero_ns) * 1e-9,
    )
    run = Run(
        cycle=cycle,
        t_ns=t_ns,
        state=np.array(states, dtype=np.uint8),
        fault=np.where(np.array(states) == SchemeState.FAULT, reason, FaultReason.NONE).astype(np.uint8),
        tau_ext_hat=np.zeros((count, 2)),
        tau_ext_hat_cad=np.zeros((count, 2)),
        theta_hat=np.zeros((count, 7)),
        threshold=threshold,
        reports=(),
        timing=CycleColumns(t_ns, {**dict.fromkeys(CycleRecord._fields, zeros), "cycle": cycle}),
        truth=truth if has_truth else None,
        settings=parse(Settings, {"name": "hand-made", "arm": {"cad_theta": list(CAD_THETA)}}),
        metadata={
            "clock": clock,
            "scheduler": "SCHED_FIFO 80",
            "config": "hand-made",
            "profile": "P",
            "seed": "7",
            "scenario": "paper",
        },
        frames=12,
        dropped=0,
        contact_joints=np.ones(count, np.uint8),
        motion=MeasuredMotion(q, 0.0 * q, 0.0 * q),
        zero_ns=zero_ns,
    )
    return replace(run, **changes)


C = SchemeState.CERTIFY
CERTIFIED_LIKE = (
    (SchemeState.ENABLE, 50), (A, 600), (C, 400), (M, 4000), (P, 500), (A, 300), (C, 200), (M, 3000),
)  # fmt: skip
"""Row 50 is motion start, row 1050 enters MONITOR, 5050 PAYLOAD, 5550 ADAPT, 6050 MONITOR. The paper's scheme beside is
armed from row 2050 and from row 7550 on."""


def make_certified_run(*stays: tuple[SchemeState, int], **changes: Any) -> Run:
    """Make a run of the certified scheme: thresholds 0.1 Nm in all channels, residuals of zero."""
    run = make_run(*(stays or CERTIFIED_LIKE), **changes)
    settings = parse(Settings, {"name": "hand-made", "scheme": "certified", "arm": {"cad_theta": list(CAD_THETA)}})
    count, further = len(run.cycle), settings.further_count
    rows = np.arange(count)
    is_armed = (rows >= 2050) & ~((rows > 5550) & (rows < 7550))
    return replace(
        run,
        settings=settings,
        threshold=np.full((count, 2), 0.1),
        certified=CertifiedStream(
            tau_ext=np.zeros((count, settings.channel_count, 2)),
            threshold=np.full((count, settings.channel_count, 2), 0.1),
            theta_further=np.full((count, further), 0.001),
            theta_std=np.full((count, 7 + further), 0.01),
            promotions=np.zeros(count),
        ),
        beside=PaperStream(
            is_armed=is_armed,
            tau_ext_hat=np.zeros((count, 2)),
            threshold=np.where(is_armed, 0.15, np.inf)[:, None].repeat(2, axis=1),
        ),
    )


def touch(run: Run, row: int, cycles: int, tau_ext: tuple[float, float], link: int = 1, index: int = 0) -> None:
    """Let a person push for some cycles, from a row on."""
    assert run.truth is not None
    rows = slice(row, row + cycles)
    run.truth.tau_ext[rows] = tau_ext
    run.truth.contact_link[rows] = link
    run.truth.contact_index[rows] = index


def react(run: Run, row: int, cycles: int = 100, **report: Any) -> Run:
    """Let the scheme detect in a row and stay in REACT for some cycles, with a final report if one is given."""
    run.state[row : row + cycles] = R
    if not report:
        return run
    made = [contact_report(int(run.cycle[row]), is_final=is_final, **report) for is_final in (False, True)]
    return replace(run, reports=(*run.reports, *made))


def contact_report(cycle: int, **changes: Any) -> ContactReport:
    """Make a report of a push on link 1 toward +q."""
    values: dict[str, Any] = {
        "cycle": cycle,
        "link": 1,
        "direction": (1, 0),
        "tau_ext_peak": (5.0, 0.0),
        "impulse": (0.5, 0.0),
        "is_final": True,
    }
    return ContactReport(**{**values, **changes})


def touched_run() -> Run:
    """Make the paper's sections with two detected contacts, a missed one, a false alarm, moving parameters."""
    run = make_run(clock="realtime")
    assert run.truth is not None
    rows = np.arange(len(run.cycle))
    run.theta_hat[:] = np.minimum(1.0, np.maximum(0, rows - ZERO_ROW) / 800.0)[:, None] * np.array(THETA)
    run.tau_ext_hat[:] = 0.02 * np.sin(rows / 200.0)[:, None]
    run.tau_ext_hat_cad[:] = 0.4 * np.sin(rows / 300.0)[:, None]
    run.truth.payload_kg[5300:] = 1.0
    touch(run, 2000, 250, (5.0, 0.0), index=0)
    touch(run, 4000, 250, (-6.0, -3.0), link=2, index=1)
    touch(run, 7000, 250, (0.1, 0.0), index=2)
    run = react(run, 2005, tau_ext_peak=(5.2, 0.0))
    run = react(run, 4004, link=2, direction=(-1, -1), tau_ext_peak=(-6.1, -3.0))
    run = react(run, 9000)
    spread = np.arange(len(run.cycle), dtype=np.int64)
    return with_columns(
        run,
        feedback_ns=400_000 + spread,
        command_ns=600_000 + spread,
        lateness_ns=spread,
        compute_ns=200_000 + spread,
        slack_ns=400_000 - 50 * spread,
        overruns=np.maximum(0, spread - 9000),
        log_queue_bytes=2 * spread,
    )


def gathered_of(run: Run) -> RunGatherer:
    """Sum up a run that has all of its cycles."""
    gathered = RunGatherer(run.settings, not is_realtime(run))
    gathered.add_times(run.timing, run.cycle, run.state)
    gathered.untouched.add_untouched(run, run)
    return gathered


def evaluated(run: Run) -> Metrics:
    """Evaluate a run that has all of its cycles."""
    return evaluate(run, gathered_of(run))


def with_columns(run: Run, **columns: NDArray[np.int64]) -> Run:
    """Give the run other columns of /cycle."""
    return replace(run, timing=replace(run.timing, columns={**run.timing.columns, **columns}))


def without_cycles(run: Run) -> Run:
    """Give a log that ended before its first cycle."""
    names = (
        "cycle", "t_ns", "state", "fault", "tau_ext_hat", "tau_ext_hat_cad", "theta_hat", "threshold", "contact_joints",
    )  # fmt: skip
    nothing = {name: getattr(run, name)[:0] for name in names}
    return replace(run, timing=columns_of_records([], []), zero_ns=0, **nothing)


def record(path: Path, run: Run, attachments: dict[str, bytes] | None = None, clock: str = "lockstep") -> None:
    """Write a log with the scheme's topic of a hand-made run. attachments: instead of its configuration."""
    slices = layout_of(run.settings).slices
    blocks = np.zeros((len(run.cycle), layout_of(run.settings).size))
    columns = {name: getattr(run, name) for name in ("tau_ext_hat", "theta_hat", "threshold")}
    if run.certified is not None and run.beside is not None:
        columns |= {
            "tau_ext_hat_cad": run.tau_ext_hat_cad,
            "tau_ext_bank": run.certified.tau_ext,
            "threshold_bank": run.certified.threshold,
            **{name: getattr(run.certified, name) for name in ("theta_further", "theta_std", "promotions")},
            **{f"paper_{name}": getattr(run.beside, name) for name in ("is_armed", "tau_ext_hat", "threshold")},
        }
    for name, column in columns.items():
        blocks[:, slices[name]] = column.reshape(len(blocks), -1)
    with Recorder(
        path,
        attachments={"config.toml": to_toml(run.settings).encode()} if attachments is None else attachments,
        metadata={"clock": clock, "scenario": "paper"},
        further_count=0 if run.certified is None else run.settings.further_count,
        channel_count=0 if run.certified is None else run.settings.channel_count,
        blocking=True,
    ) as recorder:
        for row, cycle in enumerate(run.cycle.tolist()):
            state = SchemeState(run.state[row])
            joints = int(state is SchemeState.REACT)
            output = SchemeOutput(
                cycle, state, state, FaultReason.NONE, joints, False, run.theta_hat[row],
                run.tau_ext_hat[row], None, blocks[row],
            )  # fmt: skip
            times = CycleRecord(*(int(run.timing[name][row]) for name in CycleRecord._fields))
            messages = [
                (ChannelId.SCHEME, pack_scheme(output, Request.NONE)),
                (ChannelId.CYCLE, CYCLE.pack(*times)),
            ]
            messages += [(ChannelId.CONTACT, pack_contact(report)) for report in run.reports if report.cycle == cycle]
            recorder.cycle(int(run.t_ns[row]), messages)


def record_truth(path: Path, run: Run) -> None:
    """Write the emulator's log of a hand-made run."""
    assert run.truth is not None
    with Recorder(path, metadata={"seed": "7"}, blocking=True, messages=(), channels=truth_channels()) as recorder:
        for row, cycle in enumerate(run.truth.cycle.tolist()):
            block = np.zeros(TRUTH_LAYOUT.size)
            block[TRUTH_LAYOUT.slices["tau_ext"]] = run.truth.tau_ext[row]
            block[TRUTH_LAYOUT.slices["contact_link"]] = run.truth.contact_link[row]
            block[TRUTH_LAYOUT.slices["contact_index"]] = run.truth.contact_index[row]
            block[TRUTH_LAYOUT.slices["payload"]] = run.truth.payload_kg[row]
            block[TRUTH_LAYOUT.slices["theta"]] = run.truth.theta[row]
            recorder.cycle(int(run.t_ns[row]), [(ChannelId.TRUTH, TRUTH.pack(cycle, block=block))])
