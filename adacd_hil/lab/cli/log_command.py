"""`adacd-hil log`: info, check, recover, cut, merge and export of logs, and their output for people."""

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from adacd_hil.cli.completion import complete_run
from adacd_hil.cli.options import json_option, stretch_options
from adacd_hil.cli.output import CommandError, ExitCode, answer, explained, format_table, show
from adacd_hil.given_path import CommandGroup, GivenPath, WrittenPath
from adacd_hil.terminal import in_line

if TYPE_CHECKING:
    from collections.abc import Callable

    from adacd_hil.lab.logs.check.log_check import LogCheck
    from adacd_hil.lab.logs.recover import LogRecovery
    from adacd_hil.log.log_files import TimeWindow
    from adacd_hil.log.log_info import LogInfo
    from adacd_hil.wire.dbc_decoder import DbcDecoder

_TOLD_FAULTS = 5
_log_argument = click.argument("log", type=GivenPath(dir_okay=False), shell_complete=complete_run)
_out_option = click.option("--out", type=WrittenPath(dir_okay=False), metavar="FILE")


def _tell(line: str) -> None:
    print(in_line(line), file=sys.stderr)


@click.group("log", cls=CommandGroup)
def log() -> None:
    """Look at logs, check, recover, cut and merge them. A log is named by its first part."""


@log.command(epilog="Exit status: 0 done; 1 a log can't be read; 2 wrong usage; 3 a log is cut or lacks a part.")
@click.argument("logs", nargs=-1, required=True, type=GivenPath(), shell_complete=complete_run)
@json_option
@explained
def info(logs: tuple[Path, ...], as_json: bool) -> ExitCode:
    """Show the contents of logs: topics, rates, attachments, the run, its contacts and faults.

    A folder stands for the logs in it.
    """
    from adacd_hil.lab.logs.check.log_check import find_logs
    from adacd_hil.log.log_info import read_info

    found = [read_info(path) for path in find_logs(logs)]
    if as_json:
        print(json.dumps([info_as_json(entry) for entry in found], indent=2))
    else:
        show("\n\n".join(info_as_text(entry) for entry in found))
    return ExitCode.PARTIAL if any(entry.problems for entry in found) else ExitCode.OK


@log.command(epilog="Exit status: 0 clean; 1 an error, or a log can't be read; 2 wrong usage; 3 warnings only.")
@click.argument("logs", nargs=-1, required=True, type=GivenPath(), shell_complete=complete_run)
@json_option
@explained
def check(logs: tuple[Path, ...], as_json: bool) -> ExitCode:
    """Check logs: the rules of `mcap doctor`, all CRCs, indexes against records, and the rules of our own logs.

    A folder stands for the logs in it.
    """
    from adacd_hil.lab.logs.check.log_check import check_log, find_logs

    checked = [check_log(path, _tell) for path in find_logs(logs)]
    if as_json:
        print(json.dumps([check_as_json(entry) for entry in checked], indent=2))
    else:
        show("\n".join(check_as_text(entry) for entry in checked))
    if any(entry.errors for entry in checked):
        return ExitCode.FAILURE
    return ExitCode.PARTIAL if any(entry.warnings for entry in checked) else ExitCode.OK


@log.command(
    epilog="Exit status: 0 without loss; 1 no data to save, or the log can't be read; 2 wrong usage; 3 with loss."
)
@_log_argument
@_out_option
@json_option
@explained
def recover(log: Path, out: Path | None, as_json: bool) -> ExitCode:
    """Save everything intact of a cut or damaged log, before and after the damage, to one whole file.

    --out: default NAME.recovered.mcap. The log itself stays as it is. A message of a log with CRCs is saved only if a
    CRC covers it; of a log without, all readable messages are saved, and counted.
    """
    from adacd_hil.lab.logs.recover import recover as recover_log

    recovery = recover_log(log, out, _tell)
    as_table = recovery_as_json(recovery)
    answer(as_json, as_table, recovery_as_text(recovery))
    return ExitCode.PARTIAL if recovery.is_lossy else ExitCode.OK


@log.command(epilog="Exit status: 0 done; 1 no data there, or the log is damaged; 2 wrong usage.")
@_log_argument
@click.option("--contact", type=click.IntRange(min=1), help="Cut around this contact, numbered from 1.")
@click.option(
    "--around",
    "around_s",
    type=click.FloatRange(min=0.0, min_open=True),
    default=1.0,
    show_default=True,
    help="s before and after the contact.",
)
@click.option("--topic", "topics", multiple=True, help="Take only this topic; can be given more than once.")
@_out_option
@json_option
@explained
@stretch_options
def cut(
    log: Path,
    contact: int | None,
    around_s: float,
    topics: tuple[str, ...],
    out: Path | None,
    as_json: bool,
    stretch: "TimeWindow",
) -> ExitCode:
    """Cut a stretch out of a log, whole cycles, with attachments and metadata. --out: default NAME.cut.mcap."""
    from adacd_hil.lab.logs.cut_and_merge import cut as cut_log
    from adacd_hil.lab.logs.cut_and_merge import default_out, find_contact

    if contact is not None:
        if not stretch.is_whole:
            raise CommandError("--contact excludes --from and --until", ExitCode.USAGE)
        stretch = find_contact(log, contact, around_s)
    done = cut_log(log, out or default_out(log), stretch, topics, _tell)
    result = {"out": str(done.out), **stretch.as_json(), "messages": done.messages}
    answer(as_json, result, in_line(f"{done.out}: {done.messages} messages"))
    return ExitCode.OK


@log.command(epilog="Exit status: 0 done; 1 a log is damaged or can't be read; 2 wrong usage.")
@click.argument("logs", nargs=-1, required=True, type=GivenPath(dir_okay=False), shell_complete=complete_run)
@click.option("--out", type=WrittenPath(dir_okay=False), default=Path("merged.mcap"), show_default=True)
@click.option("--prefix", "has_prefix", is_flag=True, help="Put each log's name before its topics, as /NAME/topic.")
@json_option
@explained
def merge(logs: tuple[Path, ...], out: Path, has_prefix: bool, as_json: bool) -> ExitCode:
    """Merge logs into one by their log times: of several hosts, of a run and the emulator, or of one log's parts."""
    from adacd_hil.lab.logs.cut_and_merge import merge as merge_logs

    done = merge_logs(logs, out, has_prefix, _tell)
    if done.shared and not has_prefix:
        _tell(f"topics of more than one log; only their channels distinguish them: {', '.join(done.shared)}")
    result = {"out": str(done.out), "logs": list(done.names), "messages": done.messages, "shared": list(done.shared)}
    answer(as_json, result, in_line(f"{done.out}: {done.messages} messages"))
    return ExitCode.OK


def info_as_json(info: "LogInfo") -> dict[str, Any]:
    """Return the information as a dictionary for JSON."""
    topics = [topic._asdict() for topic in info.topics]
    return {**vars(info), "path": str(info.path), "duration_s": info.duration_s, "topics": topics}


def info_as_text(info: "LogInfo") -> str:
    """Format the contents of a log for people, the main facts first."""
    ending = f", {info.ending}" if info.ending else ", without an end" if info.problems else ""
    parts = f"{info.files} parts, " if info.files > 1 else ""
    lines = [
        f"{info.path}: {parts}{_size(info.size_bytes)}, {info.duration_s:.3f} s, {info.cycles} cycles{ending}",
        f"{info.frames} frames, {info.messages} messages, {info.dropped} packets dropped",
        f"{info.contacts} contacts, {info.collisions} of them collisions; {len(info.faults)} errors, "
        f"{info.events['warning']} warnings",
    ]
    lines += [f"  error: {fault}" for fault in info.faults[:_TOLD_FAULTS]]
    if len(info.faults) > _TOLD_FAULTS:
        lines.append(f"  and {len(info.faults) - _TOLD_FAULTS} more")
    lines += [f"problem: {problem}" for problem in info.problems]
    lines = [in_line(line) for line in lines]
    rows = [
        (topic.topic, topic.type, str(topic.messages), f"{topic.rate_hz:.1f}", _bytes(topic.bytes))
        for topic in info.topics
        if topic.messages
    ]
    if rows:
        lines += ["", format_table(("topic", "type", "messages", "per s", "bytes"), rows, right=(2, 3, 4))]
    if info.attachments:
        names = ", ".join(f"{name} ({size})" for name, size in info.attachments.items())
        lines += ["", in_line(f"attached: {names}")]
    if info.metadata:
        lines += ["", format_table(("", ""), [(key, text) for key, text in info.metadata.items()])]
    return "\n".join(lines)


def _size(count: int) -> str:
    return f"{count / 1e6:.1f} MB" if count >= 1e6 else f"{count / 1e3:.1f} kB"


def _bytes(count: int | None) -> str:
    return "–" if count is None else str(count)


def check_as_json(check: "LogCheck") -> dict[str, Any]:
    """Return the findings as a dictionary for JSON."""
    findings = [finding._asdict() for finding in check.findings]
    return {**check._asdict(), "path": str(check.path), "findings": findings}


def check_as_text(check: "LogCheck") -> str:
    """Format the findings for people, and their number."""
    lines = []
    for finding in check.findings:
        where = f"{finding.file}, byte {finding.offset}" if finding.offset >= 0 else finding.file
        lines.append(f"{finding.severity}: {where}: {finding.text} ({finding.rule})")
    left_out = check.errors + check.warnings + check.notes - len(check.findings)
    if left_out:
        lines.append(f"and {left_out} more of these")
    verdict = "clean" if not check.errors + check.warnings else f"{check.errors} errors, {check.warnings} warnings"
    lines.append(f"{check.path}: {verdict}; {check.messages} messages in {check.files} files")
    return "\n".join(in_line(line) for line in lines)


def recovery_as_json(recovery: "LogRecovery") -> dict[str, Any]:
    """Return saved and lost data as a dictionary for JSON."""
    losses = recovery.losses
    return {
        "path": str(recovery.path),
        "out": str(recovery.out),
        "messages": recovery.messages,
        "attachments": recovery.attachments,
        "metadata": recovery.metadata,
        "is_lossy": recovery.is_lossy,
        "lost": recovery.describe_loss(),
        "unvouched_messages": losses.unvouched,
        "lost_messages": losses.messages,
        "lost_chunks": losses.chunks,
        "lost_bytes": losses.bytes,
        "is_cut": losses.is_cut,
        "holes_s": [hole.seconds for hole in losses.holes],
        "missing_parts": list(recovery.missing_parts),
        "notes": losses.notes,
    }


def recovery_as_text(recovery: "LogRecovery") -> str:
    """Format saved and lost data for people."""
    saved = f"{recovery.messages} messages, {recovery.attachments} attachments"
    lost = recovery.describe_loss()
    lines = [f"{recovery.out}: {saved}", *(f"  {note}" for note in recovery.losses.notes)]
    if recovery.losses.unvouched:
        lines.append(f"{recovery.losses.unvouched} messages are unchecked: {recovery.path.name} has no checksums")
    lines.append(f"lost: {lost}" if lost else "nothing was lost")
    return "\n".join(in_line(line) for line in lines)


TABLES = ("parquet", "csv")
FRAMES = ("blf", "asc", "candump")
_SUFFIXES = {"candump": ".log"}
_TOLD_EACH = 1_000_000
"""Rows or frames between two progress lines."""


class HexId(click.ParamType[int]):
    """A CAN identifier in hexadecimal."""

    name = "hex"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Parse the identifier."""
        try:
            number = int(str(value), 16)
        except ValueError:
            self.fail(f"{value} is not a hexadecimal identifier", param, ctx)
        if not 0 <= number < 1 << 29:
            self.fail(f"{value} has more than 29 bits", param, ctx)
        return number


id_option = click.option("--id", "can_ids", type=HexId(), multiple=True, metavar="HEX", help="Only these identifiers.")
only_option = click.option(
    "--only",
    type=click.Choice(["host", "devices", "both"]),
    default="both",
    show_default=True,
    help="Sender of the frames: by the contract, else by their direction.",
)
dbc_option = click.option(
    "--dbc", type=GivenPath(dir_okay=False), help="A DBC; default: the log's contract, else the arm's."
)


@log.command(
    "export",
    epilog="Exit status: 0 done; 1 the recording can't be read or lacks a topic, or a file is in the way; 2 wrong "
    "usage or contract; 3 the recording is damaged, or a disk is full; 130 interrupted.",
)
@click.argument("log", type=GivenPath(dir_okay=False), shell_complete=complete_run)
@click.option("--format", "kind", type=click.Choice([*TABLES, *FRAMES]), required=True, help="Format of the output.")
@click.option("--out", type=WrittenPath(), help="Folder of the tables, or file of the frames; default: beside LOG.")
@click.option(
    "--topic", "topics", multiple=True, metavar="TOPIC", help="For tables: a topic, or a pattern such as 'decoded/*'."
)
@click.option(
    "--direction",
    "has_direction",
    is_flag=True,
    help="candump: T or R behind each frame, sent or received. Wireshark opens no file that has them.",
)
@only_option
@id_option
@dbc_option
@json_option
@explained
def export(
    log: Path,
    kind: str,
    out: Path | None,
    topics: tuple[str, ...],
    has_direction: bool,
    only: str,
    can_ids: tuple[int, ...],
    dbc: Path | None,
    as_json: bool,
) -> ExitCode:
    """Write a recording as tables (Parquet, CSV), or its frames as BLF, ASC or candump log.

    Reads MCAP, candump .log, BLF, ASC, MF4, TRC and CSV. Frames that the target format can't hold are counted on
    stderr. Tables replace tables; a file of frames replaces only an identical one.
    """
    from adacd_hil.wire.dbc_decoder import DbcDecoder

    if kind in TABLES and (can_ids or only != "both"):
        raise CommandError(f"--only and --id choose frames, {kind} holds tables; use --topic", ExitCode.USAGE)
    if kind in FRAMES and topics:
        raise CommandError(f"--topic chooses tables, {kind} holds frames; use --only or --id", ExitCode.USAGE)
    if has_direction and kind != "candump":
        raise CommandError(f"--direction is candump's; {kind} needs none", ExitCode.USAGE)
    decoder = DbcDecoder(*find_dbc(log, dbc))
    if kind in TABLES:
        described, problem = _export_tables(log, out or log.with_name(f"{log.stem}-tables"), kind, topics, decoder)
    else:
        suffix = _SUFFIXES.get(kind, f".{kind}")
        out = out or log.with_suffix(suffix if log.suffix.lower() != suffix else f".exported{suffix}")
        described, problem = _export_frames(log, out, kind, only, can_ids, decoder, has_direction)
    if problem:
        print(in_line(f"warning: {problem}"), file=sys.stderr)
    answer(as_json, described | {"problem": problem}, described["text"])
    return ExitCode.PARTIAL if problem else ExitCode.OK


def find_dbc(log: Path, dbc: Path | None) -> tuple[bytes, Path]:
    """Return the DBC of a recording: the given one, else the one attached to the log, else the arm's."""
    from adacd_hil.log.log_info import attachment
    from adacd_hil.wire.codec import read_dbc

    text = attachment(log, "arm.dbc") if dbc is None and log.suffix.lower() == ".mcap" else None
    return read_dbc(dbc) if text is None else (text, log / "arm.dbc")


def _export_tables(
    log: Path, out: Path, kind: str, topics: tuple[str, ...], decoder: "DbcDecoder"
) -> tuple[dict[str, Any], str]:
    from adacd_hil.lab.logs.signal_tables import export_tables

    summary = export_tables(log, out, kind, topics, decoder, _progress_of("rows"))
    for note in summary.notes:
        _tell(f"{kind}: {note}")
    lines = [in_line(f"{path}: {rows} rows") for path, rows in summary.rows.items()]
    described = {
        "files": {str(path): rows for path, rows in summary.rows.items()},
        "text": "\n".join(lines) or in_line(f"nothing to export: {decoder.path.name} knows no frame of {log.name}"),
    }
    return described, summary.problem


def _export_frames(
    log: Path, out: Path, kind: str, only: Any, can_ids: tuple[int, ...], decoder: "DbcDecoder", has_direction: bool
) -> tuple[dict[str, Any], str]:
    from adacd_hil.lab.logs.frame_export import FrameChoice, export_frames, sides
    from adacd_hil.log.frames.frame_log import open_frames

    if out.exists() and log.exists() and out.samefile(log):
        raise CommandError(f"{out} is the recording itself; name another file with --out", ExitCode.USAGE)
    host_ids, device_ids = sides(decoder)
    choice = FrameChoice(only, host_ids, device_ids, frozenset(can_ids))
    source = open_frames(log)
    summary = export_frames(source, choice.pieces(source), out, kind, _progress_of("frames"), has_direction)
    for loss in summary.losses:
        print(in_line(f"{kind}: {loss}"), file=sys.stderr)
    described = {
        "file": str(out),
        "frames": summary.frames,
        "losses": list(summary.losses),
        "text": in_line(f"{out}: {summary.frames} frames"),
    }
    return described, source.problem


def _progress_of(noun: str) -> "Callable[[int], None]":
    """Return a function that prints a count of rows or frames every `_TOLD_EACH` of them."""
    from adacd_hil.log.logged_run import Milestones

    return Milestones(lambda count: _tell(f"{count} {noun}"), _TOLD_EACH).reach
