"""`adacd-hil run`: opens the bus, runs a session, prints its result."""

import dataclasses
import functools
import signal
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from adacd_hil import __version__
from adacd_hil.cli.connection import (
    Connection,
    check_autonomy,
    check_clock,
    check_rehearsal,
    check_shared,
    make_clock,
    may_be_hardware,
    never_stopped,
)
from adacd_hil.cli.console_operator import ConsoleOperator
from adacd_hil.cli.output import CommandError, ExitCode, exit_code, is_terminal, quoted, run_folder, text_of
from adacd_hil.clock import REALTIME, wall_ns
from adacd_hil.control.configuration_check import guesses_in_brief
from adacd_hil.control.history_file import Origin, UsedHistory, use_history
from adacd_hil.control.operator import Operator, ScriptedOperator
from adacd_hil.control.session import LiveView, Session, SessionSummary
from adacd_hil.control.tare_file import TARED, UsedTare, use_tare
from adacd_hil.dates import format_date
from adacd_hil.device.contract import load_contract
from adacd_hil.device.device_files import place_devices
from adacd_hil.error_texts import error_text
from adacd_hil.log.log_files import LOG_NAME
from adacd_hil.log.viewer_layout import viewer_files
from adacd_hil.printable import in_line, number_of, one_line
from adacd_hil.progress_lines import Progress
from adacd_hil.records import FaultReason
from adacd_hil.scheme.identify.anchor import unanchored_joints
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.schema import ConfigError
from adacd_hil.terminal import on_interrupt
from adacd_hil.wire.budget import describe_excess
from adacd_hil.wire.bus import Bus
from adacd_hil.wire.can_interface import CanInterface


def rehearsed_settings(connection: Connection, scenario: str) -> Settings:
    """Return the settings of a connection with the user of a scenario, as `demo` does; the arm is emulated.

    As by `resolve`, a built-in arm has the scenario's profile unless one is given, and its motors' holding torque.
    Raises CommandError if the channel may be hardware, ConfigError or CodecError for invalid settings or scenario.
    """
    from adacd_hil.cli.embedded_run import resolve

    check_rehearsal(scenario, connection.interface, connection.channel)
    return connection.with_contract(resolve(connection.config, scenario, connection.profile, None).settings)


def drop_old_frames(bus: Bus, interface: str) -> None:
    """Recover a SocketCAN bus if frames of an earlier process wait to be sent, so that they are dropped.

    Do nothing on other interfaces. On a shared bus that carries frames, they leave by themselves. Raises BusError if
    the bus can't be recovered.
    """
    if interface == "socketcan" and CanInterface(bus.channel).waiting_frames():
        bus.recover()


def run_on_bus(
    connection: Connection,
    clock: str,
    out: Path | None,
    tare: Path | None,
    live: LiveView | None,
    history: Path | None,
    scenario: str | None,
    without_anchor: bool,
) -> tuple[dict[str, Any], ExitCode]:
    """Run the scheme on a bus until its end; return the result, see `summarise`, and the exit status.

    clock: "lockstep" or "realtime". out: folder of the log; None: a new one by date. tare, history: files with the
    offsets of a tare, and with the arm's certificates, to which those of this run are added at its end. If that fails,
    the error is printed and in the result, and OK becomes PARTIAL. live: serves the log to viewers. scenario: name of
    an emulated arm's scenario, whose user makes the requests. without_anchor: the user accepts that no anchor bounds
    the torque offsets.

    Raises CommandError for options that don't fit the bus, or if the user declines; ConfigError or CodecError for
    settings or files that can't be used, BusMissingError for the bus, LogError or OSError for the folder and log.
    """
    interface, channel = connection.interface, connection.channel
    check_clock(clock, interface, channel)
    settings = connection.settings() if scenario is None else rehearsed_settings(connection, scenario)
    check_shared(clock, settings)
    check_autonomy(settings, interface, channel)
    files: list[UsedTare | UsedHistory] = []
    if tare is not None:
        files.append(use_tare(tare, settings, wall_ns()))
        settings = files[-1].apply(settings)
    known = None
    if history is not None:
        if settings.scheme != "certified":
            raise CommandError(f"--history: scheme {settings.scheme!r} has no certificates", ExitCode.USAGE)
        known = use_history(history, wall_ns())
        settings = known.apply(settings)
        ask_first_run(known)
        files.append(known)
    if settings.scheme == "certified" and not without_anchor and may_be_hardware(interface, channel):
        ask_without_anchor(unanchored_joints(settings), connection.arguments)
    devices = place_devices(settings)
    codec = load_contract(settings, devices)
    if clock == REALTIME and (excess := describe_excess(codec, settings)):
        raise ConfigError(excess)
    timer = make_clock(clock)
    with run_folder(out, (LOG_NAME,), "run") as folder, ExitStack() as stack, never_stopped():
        bus = connection.open(timer, codec, settings, devices)
        stack.callback(bus.close)
        check_autonomy(settings, interface, channel)  # the channel may have come since
        drop_old_frames(bus, interface)
        operator: Operator = ScriptedOperator(settings.operator)
        progress = stack.enter_context(Progress())
        if is_terminal():
            operator = ConsoleOperator(ScriptedOperator(settings.operator), tell=progress)
        session = Session(
            settings,
            codec,
            devices,
            bus,
            timer,
            operator,
            folder.path,
            interface,
            progress=progress,
            files=files,
            viewer_files=viewer_files(settings),
            live=live,
            on_started=functools.partial(folder.link, progress),
        )
        if guesses := guesses_in_brief(settings, () if tare is None else TARED):
            progress(f"warning: {guesses}")
        for file in files:
            for line in file.warnings:
                progress(f"warning: {line}")
        with on_interrupt(session.interrupt, signal.SIGTSTP):  # Ctrl-Z parks: a stopped process would send no commands
            summary = session.run()
    code, described = exit_code(summary), summarise(summary)
    if known is not None and summary.certificates:
        origin = Origin(format_date(wall_ns()), str(summary.log.path), settings.arm.profile, __version__)
        try:
            described["history"] = known.add_certificates(summary.certificates, summary.identities, origin)
        except (OSError, ConfigError) as error:
            described["history_error"] = error_text(error)
            print(in_line(f"adacd-hil: the certificate is not in the history: {error_text(error)}"), file=sys.stderr)
            code = ExitCode.PARTIAL if code is ExitCode.OK else code
    return described, code


def ask_first_run(history: UsedHistory) -> None:
    """Ask on the terminal whether an arm without history is free, and raise CommandError if the user says no.

    Do nothing if the arm has a history, or without a terminal.
    """
    if not history.is_first_run or not is_terminal():
        return
    print(
        f"{history.path} does not exist: this is the arm's first run.\nA touch while it learns would be learnt as "
        "friction, and a single run can't detect that. Keep off the arm until it monitors.",
        file=sys.stderr,
    )
    if not click.confirm("Is the arm free?", err=True):
        raise CommandError("not started: the arm is touched")


def ask_without_anchor(joints: list[int], arguments: str) -> None:
    """Ask on the terminal whether the arm may learn its torque offsets without an anchor.

    joints: those without an anchor, from 0; for none, do nothing. arguments: options of the command that name bus and
    arm. Raises CommandError if the user declines or there is no terminal.
    """
    if not joints:
        return
    named = " and ".join(f"joint {i + 1}" for i in joints)
    unknown = (
        f"the torque offset of {named} has no bound: neither a tare nor a history is given, and "
        "`arm.holding_torque_Nm` is unknown or large"
    )
    remedy = f"`adacd-hil tare {arguments}` first, then `run --tare tare.toml`"
    if not is_terminal():
        raise CommandError(f"{unknown}; {remedy}, or `run --without-anchor`", ExitCode.USAGE)
    print(
        in_line(
            f"{unknown}. A push that begins before the first motion would be learnt as the sensors' zero, and a single "
            f"run can't detect that. Better: {remedy}."
        ),
        file=sys.stderr,
    )
    if not click.confirm("Run without?", err=True):
        raise CommandError(f"not started: {remedy}")


def summarise(summary: SessionSummary) -> dict[str, Any]:
    """Return the result of a session by name, for JSON and `as_text`; print its error, if any, on standard error.

    A run that broke off has `broke_off` in place of the entries from `cycles` to `data`; one that didn't start has
    none of these.
    """
    described: dict[str, Any] = {"log": str(summary.log.path), "scheduler": summary.grant.scheduler}
    if summary.error:
        described["error"] = summary.error
        print(f"adacd-hil: {one_line(summary.error)}", file=sys.stderr)
    if summary.result is not None:
        described |= {
            "cycles": summary.result.cycles,
            "overruns": summary.result.overruns,
            "state": summary.result.state.name,
            "fault": summary.result.fault.name,
            "recoveries": summary.recoveries,
            "enabled": summary.result.enabled,
            "data": dataclasses.asdict(summary.result.data),
        }
    elif summary.has_started:
        cycles, state = summary.reached
        described["broke_off"] = f"in {state.name}, after {cycles} cycles"
    log = summary.log
    return described | {
        "certificates": [certificate.text for certificate in summary.certificates],
        "frames": log.frames,
        "messages": log.messages,
        "dropped": log.dropped,
        "log_error": log.error,
        "log_parts": log.parts,
        "log_queue_peak_bytes": log.queue_peak_bytes,
    }


def next_of_run(result: dict[str, Any]) -> tuple[str, ...]:
    """Return the commands to suggest after a run; () if it didn't start: its error has a remedy."""
    if not {"cycles", "broke_off"} & set(result):
        return ()
    return (
        f"adacd-hil report {quoted(Path(result['log']))}",
        f"adacd-hil replay {quoted(Path(result['log']))}   # the same decisions, bit for bit?",
    )


def _verdict(result: dict[str, Any]) -> str:
    """Return a sentence on how a run ended: not started, broken off, by a fault, or without one."""
    if "broke_off" in result:
        certified = len(result["certificates"])
        known = f" and {number_of(certified, 'certificate')}" if certified else ""
        return f"The run broke off {result['broke_off']}{known}. The drives are disabled as far as the bus carried it."
    if "cycles" not in result:
        return "The run did not start."
    if result["fault"] != FaultReason.NONE.name:
        enabled = " and ".join(result["enabled"])
        drives = (
            f"{enabled} last reported Operation enabled: cut the power first" if enabled else "The drives are disabled"
        )
        return f"The run ended by a fault: {result['fault']}. {drives}."
    lost = "" if not result["dropped"] and not result["log_error"] else "; the log is not whole"
    return f"The run ended without a fault, in {result['state']}, after {result['cycles']} cycles{lost}."


_FOR_MACHINES = ("data", "certificates", "broke_off", "enabled")
"""Keys of `summarise` that `as_text` prints in other words, or that the run has printed already."""


def as_text(result: dict[str, Any]) -> str:
    """Return the result of `summarise` as lines of text for people."""
    data = result.get("data")
    lines = [_verdict(result), *(f"{key}: {value}" for key, value in result.items() if key not in _FOR_MACHINES)]
    if data is not None:
        lines.append(f"incomplete cycles: {data['incomplete']:.2%}; samples used late: {data['late']:.2%}")
        for what, shares in (("no frame in time", data["no_new_data"]), ("repeated frames", data["repeated"])):
            lines += [f"{name}: {what} in {share:.2%} of the cycles" for name, share in shares.items() if share]
        lines += [f"over its limit: {line}" for line in data["excesses"]]
    return text_of(lines)
