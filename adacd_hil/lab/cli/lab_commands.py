"""Commands of the lab that are one function each: each parses its options, calls one function, prints the result."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from adacd_hil.cli.completion import complete_scenario, complete_truth
from adacd_hil.cli.options import (
    HOST,
    PORT,
    FiniteRange,
    clock_option,
    config_option,
    json_option,
    live_options,
    logs_argument,
    on_bus,
    on_bus_or_url,
    profile_option,
    require_live,
    run_folder_option,
    stretch_options,
)
from adacd_hil.cli.output import (
    EPILOG,
    CommandError,
    ExitCode,
    answer,
    complain_of,
    epilog,
    explain_statuses,
    explained,
    print_and_write,
    quoted,
    writable_folder,
)
from adacd_hil.clock import LOCKSTEP, REALTIME
from adacd_hil.given_path import WRITTEN_FILE, WRITTEN_FOLDER
from adacd_hil.lab.cli.compare_command import compare
from adacd_hil.lab.cli.history_command import history
from adacd_hil.lab.cli.identify_command import identify
from adacd_hil.lab.cli.init_command import init
from adacd_hil.lab.cli.log_command import log
from adacd_hil.lab.cli.play_command import play
from adacd_hil.lab.cli.runs_command import runs, trend
from adacd_hil.lab.cli.sweep_command import sweep
from adacd_hil.lab.cli.tune_command import rate_option, tune
from adacd_hil.lab.stated_bounds import GOOD_SHARE, LISTEN_S, PLAIN_S, SUFFICIENT_SHARE
from adacd_hil.log.log_files import TARE_NAME
from adacd_hil.settings.stated import BITRATES
from adacd_hil.settings.toml_text import to_toml

if TYPE_CHECKING:
    from adacd_hil.cli.connection import Connection
    from adacd_hil.log.time_window import TimeWindow


@click.command(epilog=EPILOG)
@config_option
@click.option(
    "--scenario",
    default="paper",
    show_default=True,
    metavar="NAME|FILE",
    help="Scenario: a name that `firmware-sim list` prints, or a TOML file.",
    shell_complete=complete_scenario,
)
@click.option(
    "--truth",
    metavar="NAME|FILE",
    help="Differences of the real arm from the configuration: a name or a TOML file.",
    shell_complete=complete_truth,
)
@run_folder_option("demo")
@click.option("--seed", type=click.IntRange(min=0), help="Noise of the emulated sensors.")
@clock_option(default=LOCKSTEP)
@profile_option
@json_option
@explained
@live_options
def demo(as_json: bool, **options: Any) -> ExitCode:
    """Play the paper's experiment, or another scenario, with an emulated arm in this process, and report it.

    The arm is that of the configuration: a file of your own arm is rehearsed; missing values are assumed, and listed.

    The configuration's script plays the user of the paper's experiment, without one that of `demo`. In any other
    scenario this user acknowledges stops, and asks to finish at the scenario's `lasts_s`.
    """
    from adacd_hil.lab.cli.demo_command import play

    report, code = play(**options)
    answer(as_json, report.content, report.as_text(), f"xdg-open {quoted(report.html_path)}")
    return code


@click.command(epilog=epilog(FAILURE="refused for the reason given, or failure, and the file is as it was"))
@on_bus
@click.option("--poses", type=int, help="Poses to measure in; default: tare.poses.")
@click.option("--seconds", type=float, help="Measured time per pose; default: tare.window_s.")
@click.option("--auto-zero", is_flag=True, help="Let the sensors set their own zero (0x6125) before.")
@click.option("--out", type=WRITTEN_FILE, default=Path(TARE_NAME), show_default=True)
@clock_option(default=REALTIME)
@json_option
def tare(connection: "Connection", out: Path, as_json: bool, **options: Any) -> ExitCode:
    """Measure the offsets of the joint torque sensors at rest, with the drives disabled, and store them.

    With more than one pose, the arm is moved by hand in between. `adacd-hil run --tare FILE` uses the offsets.
    """
    from adacd_hil.lab.cli.tare_command import as_text, tare_on_bus

    found, backup = tare_on_bus(connection, out, **options)
    answer(as_json, {"file": out, "backup": backup, **vars(found)}, as_text(found, out, backup))
    return ExitCode.OK


@click.command(epilog=EPILOG)
@logs_argument
@click.option("--out", type=WRITTEN_FOLDER, help="Folder; default: beside each log.")
@json_option
@explained
@stretch_options
def report(logs: tuple[Path, ...], out: Path | None, as_json: bool, stretch: "TimeWindow") -> ExitCode:
    """Report logs: HTML, CSV and JSON. The emulator's truth.mcap beside a log is joined to it.

    A folder stands for the run.mcap in it, or without one for all runs in its folders: then index.html leads to their
    reports.

    A stretch from --from until --until is widened so that it cuts no contact and no adaptation.
    """
    from adacd_hil.lab.cli.report_command import as_json as in_json
    from adacd_hil.lab.cli.report_command import report_logs

    reports, refused, code = report_logs(logs, out, stretch)
    if reports:
        answer(as_json, in_json(reports), "\n\n".join(entry.as_text() for entry in reports))
    return complain_of(refused) or code


@click.command(epilog=EPILOG)
@logs_argument
@rate_option
@click.option("--out", type=WRITTEN_FILE, help="Write the thresholds here, as TOML.")
@click.option(
    "--report",
    type=WRITTEN_FOLDER,
    help="Compare the detectors; JSON, PNG and SVG go here.",
)
@json_option
@explained
@stretch_options
def thresholds(out: Path | None, report: Path | None, as_json: bool, **options: Any) -> ExitCode:
    """Find every detector's thresholds for a rate of false alarms, from contact-free motion in these logs.

    Each comes with the cause that limits it, and with the rate that half of the motion predicts for the other half.
    --from and --until choose a stretch of each log.
    """
    from adacd_hil.lab.cli import thresholds_command as command
    from adacd_hil.lab.thresholds.detector_comparison import write_comparison

    with writable_folder(out):
        found, comparison = command.find(is_compared=report is not None, **options)
        text = command.as_json(found, comparison) if as_json else command.as_text(found, comparison)
        print_and_write(text, out, to_toml(found), as_json)
    if report is not None and comparison is not None:
        write_comparison(comparison, report)
    return ExitCode.OK


@click.command(epilog=EPILOG)
@config_option
@profile_option
@click.option(
    "--seconds",
    type=FiniteRange(0.0, 86_400.0),
    default=60.0,
    show_default=True,
    help="How long to begin new climbs; the one under way is ended.",
)
@click.option(
    "--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of the climbs' starting points."
)
@click.option("--out", type=WRITTEN_FILE, help="Write a configuration with it here.")
@json_option
@explained
def excitation(config: str, out: Path | None, as_json: bool, **options: Any) -> ExitCode:
    """Search the motion that identifies a model soonest, within the limits of the arm and its trajectory.

    Prints the figures of the configuration's excitation beside those of the one found.
    """
    from adacd_hil.lab.cli import excitation_command as command
    from adacd_hil.plain_values import json_text

    with writable_folder(out, config):
        found = command.search(config, **options)
        text = json_text(found) if as_json else command.as_text(found)
        print_and_write(text, out, command.as_toml(config, found["excitation"]), as_json)
    return ExitCode.OK


@click.command(
    epilog=explain_statuses(OK="the contract fits", FAILURE="it doesn't", USAGE="wrong usage, configuration or DBC")
)
@click.option(
    "--dbc", metavar="NAME|FILE", help="The contract: the package's, or a file; default: the configuration's devices'."
)
@config_option
@click.option(
    "--period-us",
    type=click.IntRange(min=100, max=1_000_000),
    help="SYNC period; default: BusPeriod_us of the DBC, else bus.period_us of the configuration.",
)
@click.option("-b", "--bitrate", type=click.IntRange(*BITRATES), help="bit/s; default: the DBC's.")
@click.option(
    "--data-bitrate", type=click.IntRange(min=10_000, max=8_000_000), help="bit/s of CAN FD; default: the DBC's."
)
@click.option(
    "--arms", type=click.IntRange(1, 7), help="Arms of this contract on the bus; default: the configuration's."
)
@json_option
@explained
def budget(as_json: bool, **options: Any) -> ExitCode:
    """Check whether the frames of a contract meet their deadlines: bits, response times, time left for the host."""
    from adacd_hil.lab.cli import budget_command as budgets

    found = budgets.judge(**options)
    answer(as_json, budgets.as_json(*found), budgets.as_text(*found))
    return ExitCode.OK if found[1].is_fit else ExitCode.FAILURE


@click.command(epilog=epilog(BUS_MISSING="the bus or a node is missing, or a node is not the expected one"))
@on_bus
@click.option(
    "--seconds", type=FiniteRange(0.1, 600.0), default=LISTEN_S, show_default=True, help="How long to listen."
)
@json_option
def scan(connection: "Connection", seconds: float, as_json: bool) -> ExitCode:
    """Find the nodes on a bus, their frames, and whether they are the configured arm.

    Sends SDO uploads only and changes no node's state.
    """
    from adacd_hil.lab.cli.scan_command import as_text, scan_bus

    result, code = scan_bus(connection, seconds)
    answer(as_json, result, as_text(result))
    return code


@click.command(
    epilog=f"Below a share of {SUFFICIENT_SHARE:.2f} the connection is not sufficient, below {GOOD_SHARE:.2f} there is "
    f"a warning. {epilog(FAILURE='not sufficient, or failure')}"
)
@on_bus
@click.option("--seconds", type=FiniteRange(0.1, 3600.0), default=10.0, show_default=True, help="How long to test.")
@click.option("--enable", "is_enabling", is_flag=True, help="Enable the drives, with zero torque: the arm isn't held.")
@click.option("--out", type=WRITTEN_FOLDER, help="Folder for a log; default: none.")
@json_option
def commtest(connection: "Connection", as_json: bool, **options: Any) -> ExitCode:
    """Test the connection: cycles at zero torque, and the share of them that brings complete fresh data.

    The drives are not enabled unless asked for.
    """
    from adacd_hil.lab.cli.commtest_command import as_text, run_commtest

    result, code = run_commtest(connection, **options)
    answer(as_json, result, as_text(result))
    return code


@click.command(epilog=epilog(FAILURE="a check failed"))
@on_bus
@click.option("--move", "is_moving", is_flag=True, help="Ask for each joint to be moved by hand, to check its signs.")
@json_option
def doctor(connection: "Connection", is_moving: bool, as_json: bool) -> ExitCode:
    """Check host, bus and arm one by one, with a remedy for each failure. The drives are never enabled.

    Resets the nodes' communication and leaves them pre-operational; does neither when it hears another master.
    """
    from adacd_hil.lab.cli import doctor_command as command

    findings, code = command.examine(connection, is_moving)
    answer(as_json, command.as_json(findings), command.as_text(findings))
    return code


@click.command(epilog=EPILOG)
@click.option("--url", help=f"Watch the live view of a run instead, such as ws://{HOST}:{PORT}.")
@on_bus_or_url
@click.option("--node", "node_id", type=click.IntRange(1, 127), help="Show this node only.")
@click.option("--once", is_flag=True, help=f"Listen for {PLAIN_S:g} s, print one table, end.")
@click.option("--seconds", type=FiniteRange(0.1, 86_400.0), help="Listen for so long, print one table, end.")
@json_option
def monitor(
    place: "Connection | str", node_id: int | None, once: bool, seconds: float | None, as_json: bool
) -> ExitCode:
    """Watch a bus: nodes, messages with rate, age, checks and values, load. Sends nothing.

    With --url: watch a run that was started with --live: state, residuals against their thresholds, parameters,
    contacts, events. Redraws a terminal in place until Ctrl-C, which ends it with exit status 0.
    """
    from adacd_hil.lab.cli.monitor_command import watch

    listened_s = seconds if seconds is not None else PLAIN_S if once or as_json else None
    if not isinstance(place, str):
        return watch(place, node_id, listened_s, as_json)
    if node_id is not None:
        raise CommandError("--node has no effect with --url", ExitCode.USAGE)
    require_live("--url")
    from adacd_hil.lab.cli.live_monitor import watch_live

    return watch_live(place, listened_s, as_json)


COMMANDS: Final[Sequence[click.Command]] = (
    budget, commtest, compare, demo, doctor, excitation, history, identify, init, log, monitor, play, report, runs,
    scan, sweep, tare, thresholds, trend, tune,
)  # fmt: skip
"""Sequence for the entry point `adacd_hil.commands`."""
