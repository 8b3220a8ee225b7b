"""Init: writes the configuration of the user's arm from bus, URDF, log and answers, and marks guesses."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import click

from adacd_hil.cli.completion import complete_run
from adacd_hil.cli.options import channel_option, interface_option, json_option
from adacd_hil.cli.output import EPILOG, CommandError, ExitCode, explained, quoted, show, suggest, text_of
from adacd_hil.clock import LOCKSTEP
from adacd_hil.given_path import GIVEN_FILE, WRITTEN_FILE, GivenPath
from adacd_hil.lab.cli.interview import Interview
from adacd_hil.log.log_files import TARE_NAME
from adacd_hil.plain_values import json_text
from adacd_hil.settings.stated import BITRATES

if TYPE_CHECKING:
    from adacd_hil.cli.connection import Connection


def _pair(name: str, help_text: str, kind: Any = float) -> Callable[..., Any]:
    return click.option(name, nargs=2, type=kind, default=None, help=help_text)


@click.command("init", epilog=EPILOG)
@click.argument("out", metavar="[FILE]", type=WRITTEN_FILE, default=Path("my-arm.toml"))
@interface_option(help="python-can interface; default: socketcan.")
@channel_option()
@click.option("-b", "--bitrate", type=click.IntRange(*BITRATES), help="bit/s of the bus.")
@click.option("--no-bus", "is_busless", is_flag=True, help="Without hardware: an arm to rehearse.")
@click.option("--from", "log", type=GivenPath(), help="Take all from the log of a run.", shell_complete=complete_run)
@click.option("--urdf", type=GIVEN_FILE, help="A URDF with two moving joints.")
@click.option("--lock", "locked", multiple=True, metavar="JOINT", help="A joint of the URDF that doesn't move.")
@_pair("--length-m", "Joint to joint, joint to tip.")
@_pair("--mass-kg", "Masses of the links; they are taken to be uniform rods.")
@click.option("--upright/--flat", "is_upright", default=None, help="The same as --mounting wall, and --mounting flat.")
@click.option(
    "--mounting", metavar="WORD|DEG", help="Base on floor, wall or ceiling, flat, or the tilt of the plane of motion."
)
@click.option("--at-zero", metavar="WORD|DEG", help="Link 1 at q1 = 0: down, up, level, or the q1 where it is down.")
@_pair("--rated-torque-nm", "Rated torque of each drive at its joint.")
@_pair("--torque-limit-nm", "Largest commanded torque.")
@_pair("--position-limit-deg", "Largest |q|.")
@_pair("--velocity-limit-deg-s", "Largest |dq|.")
@_pair("--drive", "Device profiles of the drives: built-in names or files.", str)
@_pair("--sensor", "Device profiles of the sensors: built-in names or files.", str)
@_pair("--drive-node", "Node ids of the drives of joint 1 and 2.", int)
@_pair("--sensor-node", "Node ids of the sensors of joint 1 and 2.", int)
@click.option("--eds", multiple=True, type=GIVEN_FILE, help="EDS of a device without a profile; repeatable.")
@click.option("--drive-eds", multiple=True, type=GIVEN_FILE, help="EDS of a drive whose 0x1000 names no profile.")
@click.option("--sensor-eds", multiple=True, type=GIVEN_FILE, help="EDS of a sensor whose 0x1000 names no profile.")
@_pair("--gear", "Motor revolutions per revolution of joint 1 and 2.")
@_pair("--gear-efficiency", "Part of the motor's torque that leaves the gear.")
@_pair("--increments", "Position increments per revolution of joint 1 and 2.")
@click.option("--velocity-unit", help="Unit of the drives' 0x606C: increment/s, rpm, 0.1rpm, mrpm, deg/s, rad/s.")
@click.option("--rated-torque-unit", help="Unit of the drives' 0x6076: mNm, µNm, Nm, 0.01Nm.")
@_pair("--torque-count-nm", "One count of the torque sensors, Nm.")
@click.option("--yes", "takes_proposals", is_flag=True, help="Take all proposals, guesses included, without questions.")
@click.option("--force", "is_forced", is_flag=True, help="Replace files that are there.")
@click.option("--rehearse/--no-rehearse", default=None, help="Play the experiment with this file and an emulated arm.")
@click.option("--doctor/--no-doctor", default=None, help="Check host, bus and arm with this file.")
@json_option
@explained
def init(
    out: Path,
    log: Path | None,
    takes_proposals: bool,
    is_forced: bool,
    rehearse: bool | None,
    doctor: bool | None,
    as_json: bool,
    **given: Any,
) -> ExitCode:
    """Write the configuration of your own arm, FILE (default: my-arm.toml), and the profiles of its devices beside it.

    On a terminal, asks for values without an option. Scans the bus by SDO uploads only; never enables a drive. Unknown
    values are guesses, listed in the file as `assumed`; `doctor` asks for each.
    """
    from adacd_hil.cli.connection import Connection
    from adacd_hil.lab.cli.arm_drafting import DraftFiles, Drafting
    from adacd_hil.lab.cli.logged_arm import draft_from_log

    interview = Interview(takes_proposals)
    writing = DraftFiles(out, is_forced)
    writing.require_free(out)
    options = SimpleNamespace(**given)
    if log is None:
        text, summary = Drafting(options, interview, writing).draft()
    else:
        text, summary = draft_from_log(log, options, writing)
    bus, code = summary.pop("bus", None), ExitCode.OK
    if doctor and bus is None:
        raise CommandError("--doctor needs a bus: run `adacd-hil doctor` where the arm is", ExitCode.USAGE)
    writing.write_files(text)
    summary |= {"file": str(out), "written": [str(path) for path in writing.contents]}
    if not as_json:
        show(as_text(summary))
    if interview.confirm(rehearse, "Rehearse with an emulated arm now?"):
        from adacd_hil.lab.cli.demo_command import play

        report, code = play(str(out), "paper", None, None, LOCKSTEP, None)
        summary["rehearsal"] = report.content
        if not as_json:
            show(report.as_text())
    if bus is not None and interview.confirm(doctor, "Check host, bus and arm now (`doctor`)?"):
        from adacd_hil.lab.cli import doctor_command

        findings, doctor_code = doctor_command.examine(bus, False)
        code = code or doctor_code
        summary["doctor"] = doctor_command.as_json(findings)
        if not as_json:
            show(doctor_command.as_text(findings))
    if as_json:
        print(json_text(summary))
    else:
        suggest(*_next(bus or Connection("socketcan", "can0", None, str(out), None, None)))
    return code


def as_text(summary: dict[str, Any]) -> str:
    """Return a draft's summary as text: a line of written files, one per warning, and one of all guesses, if any."""
    lines = [f"written: {', '.join(summary['written'])}"]
    lines += [f"warning: {line}" for line in summary["warnings"]]
    if summary["assumed"]:
        lines.append(f"guesses, which `adacd-hil doctor` asks for: {', '.join(summary['assumed'])}")
    return text_of(lines)


def _next(arm: "Connection") -> tuple[str, ...]:
    """Return the commands to suggest after a draft of an arm, from rehearsal to the first run."""
    file = Path(arm.config)
    tare = quoted(file.with_name(TARE_NAME))
    return (
        f"adacd-hil demo --config {quoted(file)}   # rehearse",
        f"adacd-hil doctor {arm.arguments}",
        f"adacd-hil tare {arm.arguments} --out {tare}   # the zero of the torque sensors; don't touch the arm",
        f"adacd-hil run {arm.arguments} --tare {tare}   # moves the arm",
    )
