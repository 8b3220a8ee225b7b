"""Communication test: cycles at zero torque for a while, and a verdict on the connection."""

from contextlib import suppress
from pathlib import Path
from typing import Any

from adacd_hil.cli.connection import Connection
from adacd_hil.cli.output import CommandError, ExitCode, tell
from adacd_hil.clock import REALTIME, MonotonicClock, wall_ns
from adacd_hil.control.pacing import prepare_spin
from adacd_hil.device.arm import Arm
from adacd_hil.device.canopen_bus import DeviceError
from adacd_hil.device.network import Master
from adacd_hil.device.strangers import refuse_company
from adacd_hil.file_replacement import replace_files
from adacd_hil.lab.commission.communication_test import (
    CommunicationTest,
    Verdict,
    ZeroTorqueCycle,
    ZeroTorqueLoop,
)
from adacd_hil.lab.score.evaluation import collect_evidence
from adacd_hil.lab.score.histogram import bar_chart, doubling_bins
from adacd_hil.lab.score.metrics import TimingEvidence
from adacd_hil.lab.score.run_arrays import QUANTITIES
from adacd_hil.lab.stated_bounds import GOOD_SHARE
from adacd_hil.log.log_files import CONFIG_NAME, DBC_NAME, LAYOUT_NAME, SUFFIX, failing_as
from adacd_hil.log.recording.recorder import Recorder
from adacd_hil.log.recording.run_folder import check_free
from adacd_hil.log.types.topics import CYCLE
from adacd_hil.log.viewer_layout import viewer_layout
from adacd_hil.plain_values import plain_values
from adacd_hil.records import FaultReason
from adacd_hil.scheduling import freeze_garbage, request_realtime
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.toml_text import to_toml
from adacd_hil.terminal import on_interrupt
from adacd_hil.wire.bus import BusError, Tap
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.contract_attributes import read_bitrates

LOG_NAME = f"commtest{SUFFIX}"
HTML_NAME = "commtest.html"
_FIRST_BIN_US = 10.0
_BINS = 12


def run_commtest(
    connection: Connection, seconds: float, is_enabling: bool, out: Path | None
) -> tuple[dict[str, Any], ExitCode]:
    """Boot the arm, run cycles at zero torque, and judge the connection; return the result for JSON, and exit status.

    The status is SAFETY_STOP after a fault, INTERRUPTED by the user, FAILURE if the connection is not sufficient,
    PARTIAL if the log lacks data, else OK. is_enabling: enable the drives. out: folder for log and commtest.html, None:
    neither. Raises ConfigError, CodecError if configuration or contract can't be used, LogExistsError if `out` has a
    log, LogError if a file can't be written, OSError if `out` can't be made, BusMissingError if the bus can't be
    opened, CommandError if the arm isn't found or the bus fails.
    """
    settings, codec, devices = connection.load()
    clock = MonotonicClock()
    if out is not None:
        check_free(out / LOG_NAME)
    with connection.bus(clock, codec.is_fd) as bus:
        tap = Tap(bus, clock)
        arm, master = Arm(settings, codec, devices, tap), Master(settings, codec, devices, tap)
        tell(f"looking for the arm on {bus.channel}")
        try:
            refuse_company(tap, clock, settings, codec, devices)
            master.reset()
            master.identify()
            master.configure()
        except DeviceError as error:
            raise CommandError(error.line, ExitCode.BUS_MISSING) from None
        boot_frames = tap.take_passed()
        grant = request_realtime(settings.realtime_request)
        for line in grant.missing:
            tell(f"not granted: {line}")
        loop = ZeroTorqueLoop(settings, tap, clock, arm, master, is_enabling)
        achieved = {**grant.describe(), **prepare_spin(loop.pacer, settings, clock, grant)}
        with grant.unpinned():
            recorder = None if out is None else open_log(out, settings, codec, connection, achieved)
        log_error = ""
        try:
            if recorder is not None:
                recorder.cycle(clock.now_ns(), [], boot_frames)
            test = CommunicationTest(settings, arm, *read_bitrates(codec), is_enabling)
            tell(f"testing for {seconds:g} s, drives {'enabled, torque zero' if is_enabling else 'not enabled'}")
            fault = _run(loop, master, test, recorder, seconds)
        finally:
            if recorder is not None:
                summary = recorder.close()
                log_error = "" if summary.is_complete else summary.error or f"log lacks {summary.dropped} packets"
    described = describe(test, settings, grant.scheduler)
    described |= {
        "fault": fault.name,
        "is_interrupted": loop.is_interrupted,
        "device_faults": loop.device_faults,
    }
    described |= {"events": [f"{event.name}: {event.message}" for event in master.take_events()]}
    if recorder is not None:
        described |= {"log": str(recorder.path), "log_error": log_error}
        described |= {"pictures": [str(path) for path in write_page(recorder.path.parent, test, described)]}
    return described, _exit_code(test, fault, loop.is_interrupted, bool(log_error))


def _run(
    loop: ZeroTorqueLoop, master: Master, test: CommunicationTest, recorder: Recorder | None, seconds: float
) -> FaultReason:
    """Start the nodes, run the cycles of the test and log them; return the fault that ended them, NONE without one.

    Stops the nodes at the end. Raises CommandError if the bus fails.
    """
    freeze_garbage()

    def observe(cycle: ZeroTorqueCycle) -> None:
        record = test.observe_cycle(cycle, 0 if recorder is None else recorder.waiting_bytes)
        if recorder is not None:
            recorder.cycle(cycle.state.t_ns, [(CYCLE.id, CYCLE.pack(*record))], cycle.frames)

    with on_interrupt(loop.interrupt):
        try:
            master.start()
            return loop.run(seconds, observe)
        except BusError as error:
            raise CommandError(str(error), ExitCode.SAFETY_STOP) from None
        finally:
            with suppress(BusError):  # the first error is the cause
                master.stop()


def _exit_code(test: CommunicationTest, fault: FaultReason, is_interrupted: bool, has_lost_log: bool) -> ExitCode:
    """Return SAFETY_STOP after a fault, else INTERRUPTED, else FAILURE for NOT_SUFFICIENT, else PARTIAL or OK.

    PARTIAL if `has_lost_log`: the log lacks data or has no end.
    """
    if fault is not FaultReason.NONE:
        return ExitCode.SAFETY_STOP
    if is_interrupted:
        return ExitCode.INTERRUPTED
    if test.verdict is Verdict.NOT_SUFFICIENT:
        return ExitCode.FAILURE
    return ExitCode.PARTIAL if has_lost_log else ExitCode.OK


def open_log(out: Path, settings: Settings, codec: Codec, connection: Connection, achieved: dict[str, str]) -> Recorder:
    """Create the log of a test in the folder `out`, and the folder; return its recorder.

    Attach contract, settings and the viewers' layout. achieved: metadata on the host. Raises LogExistsError if a log is
    there, LogError if it can't be created, OSError if the folder can't be.
    """
    out.mkdir(parents=True, exist_ok=True)
    return Recorder(
        out / LOG_NAME,
        messages=codec.messages.values(),
        attachments={
            DBC_NAME: codec.text,
            CONFIG_NAME: to_toml(settings).encode(),
            LAYOUT_NAME: viewer_layout(),
        },
        metadata={
            "command": "commtest",
            "config": settings.name,
            "interface": connection.interface,
            "channel": connection.channel,
            "clock": REALTIME,
            **achieved,
            "period_us": str(settings.bus.period_us),
        },
        epoch_ns=wall_ns() - MonotonicClock().now_ns(),
        settings=settings.log,
    )


def write_page(out: Path, test: CommunicationTest, described: dict[str, Any]) -> list[Path]:
    """Write commtest.html into a folder, with tables and curves of the cycle's times as in the report of a run.

    described: the result of `run_commtest`. Return the files that were written, [] if no cycle was run. Raises LogError
    if they can't be written.
    """
    # Here and not above: they take a second to import, and memory that the test itself has no use for.
    from adacd_hil.lab.report.page import render_page
    from adacd_hil.lab.report.report_tables import timing_tables
    from adacd_hil.lab.report.traces import pack_tracks, timing_track

    if not len(test.columns):
        return []
    period_us = described["period_us"]
    evidence = _evidence(test, period_us)
    track = timing_track(test.columns, period_us, int(test.columns.t_ns[0]), has_grid=True)
    findings = [line for line in _findings(described) if not line.startswith(("log: ", "pictures: "))]
    page = render_page(
        "communication_test_page.html.j2",
        "communication test",
        over="adacd-hil commtest",
        headline=findings[-1],
        is_good=test.verdict is Verdict.GOOD,
        problems=findings[:-1],
        traces=pack_tracks([track], period_us * 1e-6),
        timing=timing_tables(evidence),
    )
    with failing_as(f"pictures in {out} can't be written"):
        return [*replace_files(out, {HTML_NAME: page})]


def describe(test: CommunicationTest, settings: Settings, scheduler: str) -> dict[str, Any]:
    """Return a finished test as a dictionary for JSON: verdict, counts, load, warnings, devices, times with histograms.

    Times are in µs. scheduler: name of that granted to this process.
    """
    evidence = _evidence(test, settings.bus.period_us)
    return {
        "verdict": test.verdict.value,
        "share": round(test.share, 6),
        "cycles": test.cycles,
        "complete": test.complete,
        "overruns": test.overruns,
        "period_us": settings.bus.period_us,
        "scheduler": scheduler,
        "load_percent": round(test.load_percent(), 2),
        "warnings": _warnings(test, scheduler),
        "devices": test.devices(),
        "timing": plain_values(evidence.by_key()),
        "bins_us": {
            quantity.name: [
                {"below": None if bound == float("inf") else bound, "count": count}
                for bound, count in doubling_bins(test.columns.times_us(quantity), _FIRST_BIN_US, _BINS)
            ]
            for quantity in QUANTITIES
        },
    }


def _evidence(test: CommunicationTest, period_us: float) -> TimingEvidence:
    return collect_evidence(test.columns, period_us)


def _warnings(test: CommunicationTest, scheduler: str) -> list[str]:
    """Return the warnings of a test, a line each.

    They are: no real-time priority, silent devices, drives never enabled, skipped periods.
    """
    warnings = []
    if not scheduler.startswith(("SCHED_FIFO", "SCHED_DEADLINE")):
        warnings.append(f"without real-time priority ({scheduler}) the times are those of a busy desktop")
    silent = [name for name, device in test.devices().items() if not any(device["ages"])]
    if silent:
        warnings.append(f"never a cyclic frame from {', '.join(silent)}")
    if test.is_enabling and not test.enabled:
        warnings.append("the drives were never enabled: the data are those of a disabled arm")
    if test.overruns:
        warnings.append(f"{test.overruns} of {test.periods} periods were skipped: this host was late")
    return warnings


def as_text(described: dict[str, Any]) -> str:
    """Return the result of `run_commtest` as text: counts, devices, histograms, warnings, faults, last the verdict."""
    lines = [
        f"cycles {described['cycles']}, complete {described['complete']}, overruns {described['overruns']}, "
        f"period {described['period_us']} µs, {described['scheduler']}, bus load {described['load_percent']:.1f} %"
    ]
    for name, device in described["devices"].items():
        checks = ", ".join(f"{count} {status}" for status, count in device["checks"].items() if count) or "no frame"
        if not device["is_protected"]:
            checks = f"unprotected, {device['checks'].get('IMPLAUSIBLE', 0)} implausible"
        lines.append(f"{name}: fresh in {100.0 * device['share']:.2f} % of the periods; {checks}")
    for name, device in described["devices"].items():
        ages = device["ages"]
        oldest = max((age for age, count in enumerate(ages) if count), default=0)
        labels = [f"{age}" if age < len(ages) - 1 else f">= {age}" for age in range(oldest + 1)]
        lines += ["", f"age of {name}, cycles"]
        lines += bar_chart([*labels, "never"], [*ages[: oldest + 1], device["never"]])
    lines += _timing_lines(described)
    lines += ["", *_findings(described)]
    return "\n".join(lines)


def _timing_lines(described: dict[str, Any]) -> list[str]:
    """Return lines of text: percentiles and bars of each time, percentiles of queues, and counts of losses."""
    timing, lines = described["timing"], []
    for quantity in QUANTITIES:
        found = _percentile_text(timing["times_us"][quantity.name])
        lines += ["", f"{quantity.title}, µs ({quantity.meaning}): {found}"]
        previous = 0.0
        rows: list[tuple[str, int]] = []
        for entry in described["bins_us"][quantity.name]:
            label = f">= {previous:g}" if entry["below"] is None else f"< {entry['below']:g}"
            previous = entry["below"] or previous
            if rows or entry["count"]:  # skip empty bins before the first value
                rows.append((label, entry["count"]))
        lines += bar_chart([label for label, _ in rows], [count for _, count in rows])
    queues = "; ".join(f"{name} {_percentile_text(found)}" for name, found in timing["queues_bytes"].items())
    counts = ", ".join(f"{name.replace('_', ' ')} {count['total']}" for name, count in timing["counts"].items())
    return [*lines, "", f"queues, bytes: {queues}", f"{counts}, in {timing['cycles']} cycles"]


def _percentile_text(found: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.0f}" for name, value in found.items()) or "no value"


def _findings(described: dict[str, Any]) -> list[str]:
    lines = [f"warning: {line}" for line in described["warnings"]]
    lines += [f"event: {line}" for line in described["events"]]
    lines += [f"device: {line}" for line in described["device_faults"]]
    if described["fault"] != FaultReason.NONE.name:
        lines.append(f"stopped: {described['fault']}")
    if described.get("log"):
        lines.append(f"log: {described['log']}" + (f" ({described['log_error']})" if described["log_error"] else ""))
    lines += [f"pictures: {path}" for path in described.get("pictures", ())[:1]]
    verdict, share = described["verdict"], 100.0 * described["share"]
    lines.append(
        f"{verdict}: {share:.2f} % of the periods brought complete fresh data (good from {100.0 * GOOD_SHARE:g} %)"
    )
    return lines
