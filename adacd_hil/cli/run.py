"""Runs on a bus: opens it, lets a session run, says how it ended."""

import dataclasses
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from adacd_hil.cli.exit_codes import CommandError, ExitCode, exit_code
from adacd_hil.cli.progress import Progress
from adacd_hil.clock import Clock, MonotonicClock, VirtualClock, wall_ns
from adacd_hil.config import ConfigError, Settings, load_settings
from adacd_hil.control.operator import ConsoleOperator, Operator, ScriptedOperator
from adacd_hil.control.session import Session, SessionSummary
from adacd_hil.control.tare_file import use_tare
from adacd_hil.device.contract import load_contract, write_contract
from adacd_hil.wire.budget import check_budget
from adacd_hil.wire.bus import Bus, is_hardware, open_bus
from adacd_hil.wire.can_interface import CanInterface
from adacd_hil.wire.codec import Codec


def make_clock(name: str) -> Clock:
    """Make the clock of a run: `lockstep` or `realtime`."""
    return VirtualClock() if name == "lockstep" else MonotonicClock()


def check_clock(name: str, interface: str, channel: str) -> None:
    """Raise CommandError for lockstep on hardware, which has no time for it."""
    if name == "lockstep" and is_hardware(interface, channel):
        raise CommandError(
            f"--clock lockstep is for emulated arms; {interface} {channel} is hardware and needs --clock realtime",
            ExitCode.USAGE,
        )


def received_ids(codec: Codec) -> list[int]:
    """List the identifiers that the host receives."""
    return [message.can_id for message in codec.messages.values() if "HOST" not in message.senders]


def with_dbc(settings: Settings, dbc: Path | None) -> Settings:
    """Let the option --dbc outweigh the configuration's contract."""
    if dbc is None:
        return settings
    return dataclasses.replace(settings, devices=dataclasses.replace(settings.devices, contract=str(dbc)))


def contract_of(settings: Settings, out: Path) -> Codec:
    """Load the contract of the configured devices; one that is composed from their profiles is written to `out`.

    Raises ConfigError, CodecError, OSError.
    """
    codec = load_contract(settings)
    if not codec.path.is_file():
        out.mkdir(parents=True, exist_ok=True)
    return write_contract(codec, out)


def check_budget_of(codec: Codec, settings: Settings) -> None:
    """Refuse a contract whose frames don't get through in the configured period. Raises ConfigError, CodecError."""
    budget = check_budget(codec, settings.bus.period_us)
    if not budget.is_fit:
        raise ConfigError(f"contract {codec.path.stem}: {budget.line}")


def drop_old_frames(bus: Bus, interface: str) -> None:
    """Empty the transmit queue if a process before this one has left frames in it. Raises BusError."""
    if interface == "socketcan" and CanInterface(bus.channel).waiting_frames():
        bus.recover()


class Interruptible(Protocol):
    """What a signal can end in good order."""

    def interrupt(self) -> None:
        """Ask for the end; safe in a signal handler."""


@contextmanager
def interruptible(session: Interruptible) -> Iterator[None]:
    """Let SIGINT and SIGTERM end the session instead of the process."""
    previous = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number in previous:
        signal.signal(number, lambda *_: session.interrupt())
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def run_on_bus(
    interface: str,
    channel: str,
    bitrate: int | None,
    config: str,
    profile: str | None,
    dbc: Path | None,
    clock_name: str,
    out: Path,
    tare_path: Path | None = None,
) -> tuple[dict[str, Any], ExitCode]:
    """Run the scheme on a bus, with the offsets of a tare when one is given.

    Raises ConfigError, CodecError, BusMissingError, LogError, CommandError.
    """
    check_clock(clock_name, interface, channel)
    settings = with_dbc(load_settings(config, profile), dbc)
    tare = None
    if tare_path is not None:
        tare = use_tare(tare_path, settings, wall_ns())
        settings = tare.apply(settings)
    codec = contract_of(settings, out)
    if clock_name == "realtime":
        check_budget_of(codec, settings)
    clock = make_clock(clock_name)
    bus = open_bus(interface, channel, clock, received_ids(codec), bitrate, codec.is_fd)
    drop_old_frames(bus, interface)
    operator: Operator = ScriptedOperator(settings.operator)
    if sys.stdin is not None and sys.stdin.isatty():
        operator = ConsoleOperator(ScriptedOperator(settings.operator))
    progress = Progress()
    session = Session(settings, codec, bus, clock, operator, out, interface, progress=progress, tare=tare)
    for line in () if tare is None else tare.warnings:
        progress(f"warning: {line}")
    try:
        with interruptible(session):
            summary = session.run()
    finally:
        bus.close()
        progress.close()
    return summarise(summary), exit_code(summary)


def summarise(summary: SessionSummary) -> dict[str, Any]:
    """Describe how a session ended, for people and machines."""
    described: dict[str, Any] = {"log": str(summary.log.path), "scheduler": summary.grant.scheduler}
    if summary.error:
        described["error"] = summary.error
        print(f"adacd-hil: {summary.error}", file=sys.stderr)
    if summary.result is not None:
        described |= {
            "cycles": summary.result.cycles,
            "overruns": summary.result.overruns,
            "state": summary.result.state.name,
            "fault": summary.result.fault.name,
            "recoveries": summary.recoveries,
        }
    log = summary.log
    return described | {"frames": log.frames, "messages": log.messages, "dropped": log.dropped, "log_error": log.error}
