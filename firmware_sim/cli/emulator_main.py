"""`firmware-sim`: plays the arm on a CAN interface until a signal ends it."""

import json
import logging
import sys
import tomllib
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NoReturn, get_args

import click

from adacd_hil.clock import MonotonicClock, wall_ns
from adacd_hil.error_texts import error_text
from adacd_hil.file_replacement import removing_empty_folders
from adacd_hil.given_path import CommandGroup, GivenName, GivenPath, WrittenPath
from adacd_hil.log.log_files import SUFFIX, TRUTH_NAME, LogError, LogExistsError
from adacd_hil.log.log_walk import run_metadata
from adacd_hil.log.recording.run_folder import check_free
from adacd_hil.printable import in_line, one_line
from adacd_hil.progress_lines import Progress
from adacd_hil.scheduling import freeze_garbage, request_realtime
from adacd_hil.settings.arm_settings import BusSettings
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.toml_text import to_short_toml, to_toml
from adacd_hil.start import ExitCode, explain_statuses
from adacd_hil.table_layout import fit_table
from adacd_hil.terminal import on_interrupt, open_terminals, terminal_columns, write_result
from adacd_hil.wire.bus import BusError, BusMissingError
from adacd_hil.wire.codec import Codec, CodecError
from adacd_hil.wire.dbc_contract import load_codec
from adacd_hil.wire.moved_contract import move_contract
from firmware_sim.arm.arms import ARMS
from firmware_sim.bench.bench import Bench, ClockMode
from firmware_sim.bench.bench_time import TruthLog
from firmware_sim.bench.injector import Departure
from firmware_sim.bench.recorded_bench import RecordedBench, RecordedCycles
from firmware_sim.canopen.object_dictionary import CONTRACTS, EmulatedContract
from firmware_sim.canopen.pdo_record import LAST_NODE
from firmware_sim.cli.own_devices import rehearse
from firmware_sim.cli.scenario_list import check, describe_all
from firmware_sim.cli.service import SILENCE_NS, Service, StopRequest, open_devices_end
from firmware_sim.scenario.scenario import Scenario, load_scenario, load_truth, truth_names

_ENDED = "ended by SIGINT, SIGTERM, SIGHUP or --once"
EPILOG = explain_statuses(
    OK=_ENDED,
    FAILURE="failure (the bus or the truth log failed)",
    USAGE="wrong usage or configuration",
    BUS_MISSING="bus missing",
)

_USAGE_ERRORS = (click.ClickException, ConfigError, CodecError, LogExistsError)
_FAILURES = (BusError, LogError, OSError)
_CONTEXT = {"auto_envvar_prefix": "FIRMWARE_SIM", "help_option_names": ["-h", "--help"]}


_DEVICES = 4
_OPTIONS = (  # last first: click lists them the other way round
    click.option(
        "--clock",
        "clock_mode",
        type=click.Choice(get_args(ClockMode)),
        default="sync",
        show_default=True,
        help="sync: the arm's time goes by SYNC. wall: by the clock, and the drives watch for SYNC.",
    ),
    click.option(
        "--host-node",
        type=click.IntRange(1, 127),
        default=BusSettings().host_node,
        show_default=True,
        help="Node id of the arm's host: bus.host_node of its configuration.",
    ),
    click.option(
        "--node-offset",
        type=click.IntRange(0, LAST_NODE - _DEVICES),
        default=0,
        show_default=True,
        help="Added to the devices' node ids: another arm on the bus.",
    ),
    click.option(
        "--contract",
        type=click.Choice(list(CONTRACTS)),
        default="arm",
        show_default=True,
        help="Which devices: DBC and EDS files of this name.",
    ),
    click.option("-c", "--channel", required=True, type=GivenName(), help="Channel of the interface, such as vcan0."),
    click.option("-i", "--interface", required=True, help="python-can interface, such as socketcan."),
)


def on_bus(command: Callable[..., Any]) -> Callable[..., Any]:
    """Return a click command with added options for the bus and the devices on it; a decorator."""
    for option in _OPTIONS:
        command = option(command)
    return command


@click.group(cls=CommandGroup, epilog=EPILOG, context_settings=_CONTEXT)
def cli() -> None:
    """Play the drives, the torque sensors, the arm and the person who touches it, on a CAN bus."""


@cli.command(epilog=EPILOG)
@on_bus
@click.option(
    "--config",
    metavar="NAME|FILE",
    help="Play the arm of this configuration, the one that the host reads; what it lacks is assumed and told.",
)
@click.option(
    "--truth",
    metavar="NAME|FILE",
    help="What the real arm is where --config says otherwise: one that `firmware-sim truths` names, or a TOML file.",
)
@click.option(
    "--scenario",
    default="paper",
    show_default=True,
    metavar="NAME|FILE",
    help="One that `firmware-sim list` names, or a TOML file.",
)
@click.option("--profile", type=click.Choice(list(ARMS)), help="Arm; default: the scenario's.")
@click.option("--seed", type=click.IntRange(0, 2**63 - 1), help="Of the sensor noise; default: the scenario's.")
@click.option("--out", type=WrittenPath(file_okay=False), help=f"Folder for {TRUTH_NAME}; default: no log.")
@click.option("--once", "is_once", is_flag=True, help="End with the first host that starts the nodes and goes.")
@click.option("--json", "as_json", is_flag=True, help="Print how it went as JSON on stdout.")
def run(
    interface: str,
    channel: str,
    contract: str,
    node_offset: int,
    host_node: int,
    clock_mode: ClockMode,
    config: str | None,
    truth: str | None,
    scenario: str,
    profile: str | None,
    seed: int | None,
    out: Path | None,
    is_once: bool,
    as_json: bool,
) -> int:
    """Run the emulated arm; prints "ready" on stderr once its nodes have announced themselves."""
    played: EmulatedContract | None = None
    if config is None:
        if truth is not None:
            raise ConfigError("--truth needs --config: the configuration that the host is told")
        resolved = load_scenario(scenario, profile, seed)
        codec = move_contract(load_codec(CONTRACTS[contract].path), node_offset, host_node)
    else:
        _refuse_beside_config()
        codec, played, resolved, assumed = rehearse(config, scenario, truth, profile, seed)
        for line in assumed:
            print(one_line(line), file=sys.stderr)
    clock = MonotonicClock()
    with ExitStack() as stack:
        if out is not None:
            check_free(out / TRUTH_NAME)
            stack.enter_context(removing_empty_folders(out))
        bus = open_devices_end(interface, channel, clock, codec)
        stack.callback(bus.close)
        stop = StopRequest()
        stack.enter_context(on_interrupt(stop.make))
        log: TruthLog | None = None
        if out is not None:
            metadata = {"scenario": resolved.name, "profile": resolved.arm.name, "seed": str(resolved.seed)}
            _make_folder(out)
            # By SYNC, time waits for the log; by wall clock it never waits.
            log = TruthLog(out / TRUTH_NAME, blocking=clock_mode == "sync", metadata=metadata, scenario=resolved)
            stack.enter_context(log)
        departure = Departure(bus)
        with Progress():
            bench = Bench(
                resolved,
                codec,
                departure.send,
                clock_mode=clock_mode,
                contract=played,
                on_answer=departure.send_waiting,
            )
        if log is not None:
            _log_truth(log, bench, wall_ns() - clock.now_ns())
        _serve(Service(bench, bus, departure, clock, clock_mode, stop, is_once))
        return _report(bench, resolved, clock_mode, log, as_json)


@cli.command(
    "play",
    epilog=explain_statuses(
        OK=_ENDED,
        FAILURE="failure (the bus failed, the recording is damaged or of another contract)",
        USAGE="wrong usage",
        BUS_MISSING="bus missing",
    ),
)
@click.argument("log", type=GivenPath(dir_okay=False))
@on_bus
@click.option(
    "--answers-only", is_flag=True, help="Leave the answers to SYNC to somebody else on the bus, such as canplayer."
)
@click.option("--once", "is_once", is_flag=True, help="End with the first host that starts the nodes and goes.")
@click.option("--json", "as_json", is_flag=True, help="Print how it went as JSON on stdout.")
def play(
    log: Path,
    interface: str,
    channel: str,
    contract: str,
    node_offset: int,
    host_node: int,
    clock_mode: ClockMode,
    answers_only: bool,
    is_once: bool,
    as_json: bool,
) -> int:
    """Play the devices of a recording: on each SYNC its recorded answers; all other requests are answered live.

    Reads MCAP, candump .log, BLF, ASC, MF4, TRC and CSV. Commands of the host move nothing. After the recording's
    last cycle SYNC is no longer answered. Prints "ready" on stderr once the nodes have announced themselves.
    """
    chosen = CONTRACTS[contract]
    codec = move_contract(load_codec(chosen.path), node_offset, host_node)
    _check_contract(log, codec)
    cycles = None if answers_only else RecordedCycles(log, codec)
    clock = MonotonicClock()
    with ExitStack() as stack:
        bus = open_devices_end(interface, channel, clock, codec)
        stack.callback(bus.close)
        stop = StopRequest()
        stack.enter_context(on_interrupt(stop.make))
        departure = Departure(bus)
        bench = RecordedBench(
            load_scenario("idle"),
            codec,
            departure.send,
            cycles,
            clock_mode=clock_mode,
            contract=chosen,
            on_answer=departure.send_waiting,
        )
        _serve(Service(bench, bus, departure, clock, clock_mode, stop, is_once))
        return _report_played(bench, cycles, as_json)


@cli.command("list", epilog=EPILOG)
@click.option("--json", "as_json", is_flag=True, help="Print the list as JSON.")
def list_scenarios(as_json: bool) -> int:
    """List the scenarios that come with the package: name, group, content."""
    described = describe_all()
    if as_json:
        print(json.dumps(described, indent=2, ensure_ascii=False))
    else:
        columns = ("name", "group", "about")
        table = fit_table([columns, *([row[name] for name in columns] for row in described)], width=terminal_columns())
        write_result("\n".join(table))
    return ExitCode.OK


@cli.command("truths", epilog=EPILOG)
@click.option("--json", "as_json", is_flag=True, help="Print the list as JSON.")
def list_truths(as_json: bool) -> int:
    """List the truths that come with the package: name, and the host's wrong assumption."""
    rows = [{"name": name, "about": load_truth(name)[0].about} for name in truth_names()]
    if as_json:
        print(json.dumps(rows, indent=2, ensure_ascii=False))
    else:
        write_result("\n".join(fit_table([(row["name"], row["about"]) for row in rows], width=terminal_columns())))
    return ExitCode.OK


@cli.command("show", epilog=EPILOG)
@click.argument("scenario", metavar="NAME|FILE")
@click.option("--all", "is_whole", is_flag=True, help="Everything, defaults included.")
@click.option("--profile", type=click.Choice(list(ARMS)), help="Arm; default: the scenario's.")
@click.option("--seed", type=click.IntRange(0, 2**63 - 1), help="Of the sensor noise; default: the scenario's.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON in place of TOML.")
def show_scenario(scenario: str, is_whole: bool, profile: str | None, seed: int | None, as_json: bool) -> int:
    """Print a scenario, resolved, as TOML that loads to the same: all differences from the defaults."""
    resolved = load_scenario(scenario, profile, seed)
    text = to_toml(resolved) if is_whole else to_short_toml(resolved)
    if as_json:
        print(json.dumps(tomllib.loads(text), indent=2, ensure_ascii=False))
    else:
        print(text, end="")
    return ExitCode.OK


@cli.command("check", epilog=explain_statuses(OK="every file can be played", USAGE="one can't"))
@click.argument("files", nargs=-1, required=True, metavar="FILE...")
@click.option(
    "--contract", type=click.Choice(list(CONTRACTS)), default="arm", show_default=True, help="Whose frames faults hit."
)
@click.option("--json", "as_json", is_flag=True, help="Print what was found as JSON.")
def check_files(files: tuple[str, ...], contract: str, as_json: bool) -> int:
    """Check scenario files, a line per problem: file, key, value, bound and unit, nearest name."""
    codec = load_codec(CONTRACTS[contract].path)
    findings = [check(file, codec) for file in files]
    if as_json:
        print(json.dumps([vars(finding) for finding in findings], indent=2, ensure_ascii=False))
    else:
        write_result("\n".join(in_line(line) for finding in findings for line in finding.lines))
    return ExitCode.USAGE if any(finding.problems for finding in findings) else ExitCode.OK


def _log_truth(truth: TruthLog, bench: Bench, epoch_ns: int) -> None:
    """Make a bench write its truth and faults to a log.

    Time stamps are the host's in lockstep, else wall time. epoch_ns: wall clock minus the bench's clock.
    """

    def stamp(t_ns: int) -> int:
        return t_ns if bench.is_paced else t_ns + epoch_ns

    bench.rows.on_truth = lambda cycle, t_ns, block: truth.write(cycle, stamp(t_ns), block)
    bench.injector.on_event = lambda t_ns, event: truth.event(stamp(t_ns), event)


def _serve(service: Service) -> None:
    """Request real-time priority, announce the nodes, print "ready" on stderr, and serve until the end.

    Print a line on stderr for each part of the priority that isn't granted, and, at the end, for a host that was lost.
    Raises BusError as `Service.run`.
    """
    # As a host does: with less, on a processor that both share and fill, the arm would never answer in time.
    for line in request_realtime().missing:
        _complain(f"not granted: {line}")
    freeze_garbage()
    service.boot()
    print("ready", file=sys.stderr, flush=True)
    service.run()
    if service.is_host_lost:
        _complain(f"the host was silent for {1e-9 * SILENCE_NS:g} s, with the drives in Operational")


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--out {path} can't be made a folder: {error.strerror}") from None


def _report(bench: Bench, scenario: Scenario, clock_mode: ClockMode, truth: TruthLog | None, as_json: bool) -> ExitCode:
    """Close the truth log, and delete it if no host came; return the exit status.

    It is FAILURE, with a line on stderr, if the log is incomplete. as_json: print counts and drive states on stdout.
    """
    described: dict[str, Any] = {
        "scenario": scenario.name,
        "profile": scenario.arm.name,
        "seed": scenario.seed,
        "clock": clock_mode,
        "cycles": bench.cycle + 1,
        "rejected_commands": [drive.rejected_commands for drive in bench.drives],
        "drive_states": [drive.state.value for drive in bench.drives],
        "error_codes": [drive.error_code for drive in bench.drives],
    }
    code = ExitCode.OK
    if truth is not None:
        summary = truth.close()
        is_empty = not summary.messages and summary.is_complete  # no host came
        if is_empty:
            truth.discard()
        described |= {
            "truth": None if is_empty else str(summary.path),
            "messages": summary.messages,
            "dropped": summary.dropped,
        }
        if not summary.is_complete:
            _complain(summary.error or f"{summary.path} lacks {summary.dropped} cycles: the disk was too slow")
            code = ExitCode.FAILURE
    if as_json:
        print(json.dumps(described))
    return code


def _check_contract(log: Path, codec: Codec) -> None:
    """Raise LogError if an MCAP log names a contract with another layout digest.

    Other formats, and logs without a digest, pass.
    """
    digest = run_metadata(log).get("layout_digest", "") if log.suffix.lower() == SUFFIX else ""
    own = f"0x{codec.layout_digest:08X}"
    if digest and digest.casefold() != own.casefold():
        raise LogError(
            f"{log} was recorded with another contract: layout digest {digest}, here {own}; "
            "see --contract, --node-offset and --host-node"
        )


def _report_played(bench: RecordedBench, cycles: RecordedCycles | None, as_json: bool) -> int:
    problem = "" if cycles is None else cycles.problem
    if problem:
        _complain(problem)
    if as_json:
        described = {
            "cycles": bench.cycle + 1,
            "answered": 0 if cycles is None else cycles.answered,
            "is_over": cycles is not None and cycles.is_over,
            "drive_states": [drive.state.value for drive in bench.drives],
            "rejected_commands": [drive.rejected_commands for drive in bench.drives],
            "problem": problem,
        }
        print(json.dumps(described))
    return ExitCode.FAILURE if problem else ExitCode.OK


def _refuse_beside_config() -> None:
    """Raise ConfigError if --contract, --node-offset or --host-node is given, which --config sets."""
    context = click.get_current_context()
    for name, option in (("contract", "--contract"), ("node_offset", "--node-offset"), ("host_node", "--host-node")):
        if context.get_parameter_source(name) is not click.core.ParameterSource.DEFAULT:
            raise ConfigError(f"{option} can't stand beside --config, which says it")


def _complain(line: str) -> None:
    print(f"firmware-sim: {one_line(line)}", file=sys.stderr)


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the command line, by default that of this process, and exit with a documented status."""
    if arguments is None:
        open_terminals()
    logging.getLogger("canopen").addHandler(logging.NullHandler())
    try:
        code = cli.main(arguments, prog_name="firmware-sim", standalone_mode=False)
    except click.exceptions.NoArgsIsHelpError as error:
        print(error.format_message(), file=sys.stderr)
        code = ExitCode.USAGE
    except (click.Abort, KeyboardInterrupt):
        code = ExitCode.OK
    except (*_USAGE_ERRORS, *_FAILURES) as error:
        _complain(error.format_message() if isinstance(error, click.ClickException) else error_text(error))
        code = ExitCode.USAGE if isinstance(error, _USAGE_ERRORS) else ExitCode.FAILURE
        if isinstance(error, BusMissingError):
            code = ExitCode.BUS_MISSING
    sys.exit(code)


if __name__ == "__main__":
    main()
