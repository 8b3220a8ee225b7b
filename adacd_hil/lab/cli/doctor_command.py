"""Doctor: checks host, bus and arm one by one, each with a reason and a remedy."""

from typing import Any

from adacd_hil.cli.connection import Connection, raise_interrupt
from adacd_hil.cli.output import ExitCode, format_table, is_terminal
from adacd_hil.clock import MonotonicClock
from adacd_hil.lab.commission.arm_checks import ARM_CHECKS, ArmExamination
from adacd_hil.lab.commission.host_checks import (
    HOST_CHECKS,
    Finding,
    Host,
    Status,
    configuration_checks,
    diagnose,
    summarise,
)
from adacd_hil.printable import in_line
from adacd_hil.progress_lines import Progress
from adacd_hil.scheduling import request_realtime
from adacd_hil.settings.configuration_files import configuration_layers
from adacd_hil.terminal import on_interrupt
from adacd_hil.wire.can_interface import InterfaceState, read_link
from adacd_hil.wire.contract_attributes import read_bitrates
from adacd_hil.wire.open_bus import open_bus

_MARKS = {Status.OK: "ok", Status.WARNING: "WARNING", Status.FAILED: "FAILED", Status.SKIPPED: "skipped"}


def examine(connection: Connection, is_moving: bool) -> tuple[list[Finding], ExitCode]:
    """Run the checks of configuration, host and arm; return their findings and the exit status.

    A check is skipped if one that it needs has failed. The status is FAILURE if a check failed, else OK. The drives
    stay disabled; nodes that were reset end pre-operational. Prints a line per finding meanwhile, and one at its end,
    even by an error, if the nodes could not be stopped. is_moving: ask the user to move joints by hand; without a
    terminal those checks are skipped. Raises ConfigError, CodecError if configuration or contract can't be used,
    KeyboardInterrupt if the user interrupts.
    """
    settings, codec, devices = connection.load()
    bitrate, data_bitrate = read_bitrates(codec)
    clock = MonotonicClock()

    def link() -> InterfaceState | None:
        return read_link(connection.channel) if connection.interface == "socketcan" else None

    host = Host(
        connection.interface,
        connection.channel,
        link(),
        bitrate,
        data_bitrate,
        lambda: request_realtime(settings.realtime_request),
        settings.realtime.cpu,
    )
    patient = ArmExamination(
        settings,
        codec,
        devices,
        clock,
        lambda: open_bus(connection.interface, connection.channel, clock, None, connection.bitrate, codec.is_fd),
        link,
        bitrate,
        data_bitrate,
    )
    with Progress() as progress:

        def report(finding: Finding) -> None:
            progress.passing(f"{finding.name}: {finding.status.value}")

        if is_moving and is_terminal():
            patient.ask = lambda line: progress(f">>> {line}")
        elif is_moving:
            patient.no_move_reason = "stdin is not a terminal"
        layers = configuration_layers(connection.config, connection.profile)
        findings = diagnose(configuration_checks(settings, layers), settings, report)
        findings += diagnose(HOST_CHECKS, host, report)
        try:
            with on_interrupt(raise_interrupt):
                findings += diagnose(ARM_CHECKS, patient, report, findings)
        finally:
            if trouble := patient.leave():
                end = Finding("end", Status.FAILED, f"nodes were not stopped: {trouble}", "cut the drives' power")
                findings.append(end)
                progress(f"{end.reason}; {end.remedy}")
    has_failed = any(finding.status is Status.FAILED for finding in findings)
    return findings, ExitCode.FAILURE if has_failed else ExitCode.OK


def as_json(findings: list[Finding]) -> dict[str, Any]:
    """Return the findings under "checks", and their summary, a line, under "summary", for JSON."""
    checks = [finding._asdict() | {"status": finding.status.value} for finding in findings]
    return {"checks": checks, "summary": summarise(findings)}


def as_text(findings: list[Finding]) -> str:
    """Return the findings as text, each with its remedy; then the line of `summarise`, and the failed ones again."""
    rows = []
    for finding in findings:
        rows.append((_MARKS[finding.status], finding.name, finding.reason))
        if finding.remedy:
            rows.append(("", "", f"-> {finding.remedy}"))
    failed = [finding for finding in findings if finding.status is Status.FAILED]
    last = [
        f"{_MARKS[Status.FAILED]}   {finding.name}: {in_line(finding.remedy or finding.reason)}" for finding in failed
    ]
    return "\n".join([format_table(("", "", ""), rows), "", summarise(findings), *last])
