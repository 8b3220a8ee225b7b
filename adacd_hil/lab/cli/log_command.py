"""`adacd-hil log`: logs at a glance, checked, recovered, cut and exported, with the text printed of them."""

from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from adacd_hil.cli.options import FiniteRange, json_option, log_argument, logs_argument, stretch_options
from adacd_hil.cli.output import (
    CommandError,
    ExitCode,
    answer,
    complain_of,
    explain_statuses,
    explained,
    format_table,
    one_by_one,
    tell,
    text_of,
)
from adacd_hil.given_path import GIVEN_FILE, WRITTEN_FILE, CommandGroup, WrittenPath
from adacd_hil.log.log_files import SUFFIX
from adacd_hil.printable import in_line

if TYPE_CHECKING:
    from adacd_hil.lab.logs.check.log_check import LogCheck
    from adacd_hil.lab.logs.log_info import LogInfo
    from adacd_hil.lab.logs.recover import LogRecovery
    from adacd_hil.log.time_window import TimeWindow

_TOLD_FAULTS = 5
_AROUND_S = 1.0
_out_option = click.option("--out", type=WRITTEN_FILE, metavar="FILE")


@click.group("log", cls=CommandGroup)
def log() -> None:
    """Look at logs, check, recover, cut and export them. A log is named by its first part."""


@log.command(
    epilog=explain_statuses(
        OK="done", FAILURE="a log can't be read", USAGE="wrong usage", PARTIAL="a log is cut or lacks a part"
    )
)
@logs_argument
@json_option
@explained
def info(logs: tuple[Path, ...], as_json: bool) -> ExitCode:
    """Show the contents of logs: topics, rates, attachments, the run, its contacts and faults.

    A folder stands for the logs in it.
    """
    from adacd_hil.lab.logs.check.log_check import find_logs
    from adacd_hil.lab.logs.log_info import read_info

    places, empty = one_by_one(logs, find_logs)
    found, refused = one_by_one(chain.from_iterable(places), read_info)
    described = [{**vars(entry), "duration_s": entry.duration_s} for entry in found]
    if found:
        answer(as_json, described, "\n\n".join(map(info_as_text, found)))
    code = complain_of([*empty, *refused])
    return code or (ExitCode.PARTIAL if any(entry.problems for entry in found) else ExitCode.OK)


@log.command(
    epilog=explain_statuses(
        OK="clean", FAILURE="an error, or a log can't be read", USAGE="wrong usage", PARTIAL="warnings only"
    )
)
@logs_argument
@json_option
@explained
def check(logs: tuple[Path, ...], as_json: bool) -> ExitCode:
    """Check logs: the rules of `mcap doctor`, all CRCs, indexes against records, and the rules of our own logs.

    A folder stands for the logs in it.
    """
    from adacd_hil.lab.logs.check.log_check import check_log, find_logs

    places, empty = one_by_one(logs, find_logs)
    checked, refused = one_by_one(chain.from_iterable(places), lambda path: check_log(path, tell))
    if checked:
        answer(as_json, checked, "\n".join(map(check_as_text, checked)))
    if (code := complain_of([*empty, *refused])) or any(entry.errors for entry in checked):
        return code or ExitCode.FAILURE
    return ExitCode.PARTIAL if any(entry.warnings for entry in checked) else ExitCode.OK


@log.command(
    epilog=explain_statuses(
        OK="without loss", FAILURE="no data to save, or the log can't be read", USAGE="wrong usage", PARTIAL="with loss"
    )
)
@log_argument
@_out_option
@json_option
@explained
def recover(log: Path, out: Path | None, as_json: bool) -> ExitCode:
    """Save everything intact of a cut or damaged log, before and after the damage, to one whole file.

    --out: default NAME.recovered.mcap. The log itself stays as it is. A message of a log with CRCs is saved only if a
    CRC covers it; of a log without, all readable messages are saved, and counted.
    """
    from adacd_hil.lab.logs.recover import recover as recover_log

    recovery = recover_log(log, out, tell)
    answer(as_json, _recovery(recovery), recovery_as_text(recovery))
    return ExitCode.PARTIAL if recovery.losses.is_any else ExitCode.OK


@log.command(epilog=explain_statuses(OK="done", FAILURE="no data there, or the log is damaged", USAGE="wrong usage"))
@log_argument
@click.option("--contact", type=click.IntRange(min=1), help="Cut around this detected contact, from 1.")
@click.option(
    "--around",
    "around_s",
    type=FiniteRange(min=0.0, min_open=True),
    show_default=str(_AROUND_S),
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
    around_s: float | None,
    topics: tuple[str, ...],
    out: Path | None,
    as_json: bool,
    stretch: "TimeWindow",
) -> ExitCode:
    """Cut a stretch out of a log, whole cycles, with attachments and metadata. --out: default NAME.cut.mcap."""
    from adacd_hil.lab.logs.cut import cut as cut_log
    from adacd_hil.lab.logs.cut import default_out, find_contact

    if contact is not None:
        if not stretch.is_whole:
            raise CommandError("--contact excludes --from and --until", ExitCode.USAGE)
        stretch = find_contact(log, contact, around_s or _AROUND_S)
    elif around_s is not None:
        raise CommandError("--around has no effect without --contact", ExitCode.USAGE)
    out = out or default_out(log)
    messages = cut_log(log, out, stretch, topics, tell)
    answer(as_json, {"out": out, **stretch.named_bounds, "messages": messages}, in_line(f"{out}: {messages} messages"))
    return ExitCode.OK


@log.command(hidden=True, context_settings={"ignore_unknown_options": True})
@click.argument("logs", nargs=-1, type=click.UNPROCESSED)
@explained
def merge(logs: tuple[str, ...]) -> ExitCode:  # noqa: ARG001
    """Left the package: a viewer opens several logs at once, and `mcap merge` makes one file of them."""
    raise CommandError(
        "`log merge` has left: open the logs together in Foxglove, Lichtblick or PlotJuggler; `mcap merge -o OUT LOG "
        "LOG` of the MCAP command line makes one file of them, `adacd-hil log cut LOG` one file of a log's parts",
        ExitCode.USAGE,
    )


def info_as_text(info: "LogInfo") -> str:
    """Return the contents of a log as text: main facts, errors and problems, then topics, attachments and metadata.

    Of the errors it has the first `_TOLD_FAULTS`, and the number of the others. Topics without messages are left out.
    """
    from adacd_hil.log.types.topics import CONTACT, EVENTS

    ending = f", {info.ending}" if info.ending else ", without an end" if info.problems else ""
    parts = f"{info.files} parts, " if info.files > 1 else ""
    topics = {topic.topic for topic in info.topics}
    said = {
        CONTACT.name: f"{info.contacts} contacts, {info.collisions} of them collisions",
        EVENTS.name: f"{len(info.faults)} errors, {info.events['warning']} warnings",
    }
    lines = [
        f"{info.path}: {parts}{_size(info.size_bytes)}, {info.duration_s:.3f} s, {info.cycles} cycles{ending}",
        f"{info.frames} frames, {info.messages} messages, {info.dropped} packets dropped",
        "; ".join(line if topic in topics else f"no {topic}" for topic, line in said.items()),
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


def check_as_text(check: "LogCheck") -> str:
    """Return the findings on a log as text, a line each, the number of unlisted ones, and a line with the verdict."""
    lines = []
    for finding in check.findings:
        where = f"{finding.file}, byte {finding.offset}" if finding.offset >= 0 else finding.file
        lines.append(f"{finding.severity}: {where}: {finding.text} ({finding.rule})")
    left_out = check.errors + check.warnings + check.notes - len(check.findings)
    if left_out:
        lines.append(f"and {left_out} more of these")
    verdict = "clean" if not check.errors + check.warnings else f"{check.errors} errors, {check.warnings} warnings"
    lines.append(f"{check.path}: {verdict}; {check.messages} messages in {check.files} files")
    return text_of(lines)


def _recovery(recovery: "LogRecovery") -> dict[str, Any]:
    losses = recovery.losses
    return {
        "path": recovery.path,
        "out": recovery.out,
        "messages": recovery.messages,
        "attachments": recovery.attachments,
        "metadata": recovery.metadata,
        "is_lossy": losses.is_any,
        "lost": losses.describe(),
        "unvouched_messages": losses.unvouched,
        "lost_messages": losses.messages,
        "lost_chunks": losses.chunks,
        "lost_bytes": losses.bytes,
        "is_cut": losses.is_cut,
        "holes_s": losses.holes_s,
        "missing_parts": losses.missing_parts,
        "notes": losses.notes,
    }


def recovery_as_text(recovery: "LogRecovery") -> str:
    """Return a text on the data that were saved from a damaged log, and on those that were lost."""
    saved = f"{recovery.messages} messages, {recovery.attachments} attachments"
    lost = recovery.losses.describe()
    lines = [f"{recovery.out}: {saved}", *(f"  {note}" for note in recovery.losses.notes)]
    if recovery.losses.unvouched:
        lines.append(f"{recovery.losses.unvouched} messages are unchecked: {recovery.path.name} has no checksums")
    lines.append(f"lost: {lost}" if lost else "nothing was lost")
    return text_of(lines)


TABLES = ("parquet", "csv")
_FRAMES = ("blf", "asc", "candump")
_TOLD_EACH = 1_000_000
"""Rows between two lines of progress."""
_CONVERTED = (
    "`log export` makes tables; python-can makes BLF, ASC and candump logs of frames: `can_logconvert run.mcap "
    "run.blf`, or run.asc, run.log."
)


class TableFormat(click.Choice[str]):
    """The option's type for a format of tables; for a format of frames the error names the tool that makes it."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the format if it is one of the choices; else fail with a usage error.

        For a format of frames the error names the tool that makes it.
        """
        if str(value).lower() in _FRAMES:
            self.fail(_CONVERTED, param, ctx)
        return super().convert(value, param, ctx)


def _refuse(ctx: click.Context, _param: click.Parameter, value: object) -> None:
    """Fail if a value is given, of an option that only formats of frames had; the error names the tool for them."""
    if value:
        raise click.UsageError(_CONVERTED, ctx)


dbc_option = click.option("--dbc", type=GIVEN_FILE, help="A DBC; default: the log's contract, else the arm's.")


@log.command(
    "export",
    epilog=explain_statuses(
        OK="done",
        FAILURE="the recording can't be read or lacks a topic, or a file is in the way",
        USAGE="wrong usage or contract",
        PARTIAL="the recording is damaged, or a disk is full",
        INTERRUPTED="interrupted",
    ),
)
@log_argument
@click.option("--format", "kind", type=TableFormat(TABLES), required=True, help="Of the output.")
@click.option("--out", type=WrittenPath(), help="Folder of the tables; default: beside LOG.")
@click.option("--topic", "topics", multiple=True, metavar="TOPIC", help="A topic, or a pattern such as 'decoded/*'.")
@click.option("--direction", is_flag=True, hidden=True, expose_value=False, callback=_refuse)
@click.option("--only", hidden=True, expose_value=False, callback=_refuse)
@click.option("--id", multiple=True, hidden=True, expose_value=False, callback=_refuse)
@dbc_option
@json_option
@explained
def export(
    log: Path, kind: str, out: Path | None, topics: tuple[str, ...], dbc: Path | None, as_json: bool
) -> ExitCode:
    """Write the contents of a recording as tables, Parquet or CSV.

    Reads MCAP, candump .log, BLF, ASC, MF4, TRC and CSV. Tables replace tables, and no other file. For BLF, ASC and
    candump logs of the frames: can_logconvert.
    """
    from adacd_hil.lab.logs.signal_tables import export_tables
    from adacd_hil.log.logged_run import Milestones
    from adacd_hil.wire.dbc_decoder import DbcDecoder

    decoder = DbcDecoder(*find_dbc(log, dbc))
    told = Milestones(lambda rows: tell(f"{rows} rows"), _TOLD_EACH)
    summary = export_tables(log, out or log.with_name(f"{log.stem}-tables"), kind, topics, decoder, told.reach)
    for note in summary.notes:
        tell(f"{kind}: {note}")
    if summary.problem:
        tell(f"warning: {summary.problem}")
    lines = [in_line(f"{path}: {rows} rows") for path, rows in summary.rows.items()]
    text = "\n".join(lines) or in_line(f"nothing to export: {decoder.path.name} knows no frame of {log.name}")
    answer(as_json, {"files": summary.rows, "text": text, "problem": summary.problem}, text)
    return ExitCode.PARTIAL if summary.problem else ExitCode.OK


def find_dbc(log: Path, dbc: Path | None) -> tuple[bytes, Path]:
    """Return text and path of a recording's DBC: of `dbc` if given, else from an MCAP log, else the package's.

    An MCAP file, by its suffix, that lacks a DBC or can't be read gives the package's. Raises CodecError if a DBC file
    can't be read.
    """
    from adacd_hil.log.log_files import DBC_NAME
    from adacd_hil.log.log_walk import attachment
    from adacd_hil.wire.dbc_contract import read_dbc

    text = attachment(log, DBC_NAME) if dbc is None and log.suffix.lower() == SUFFIX else None
    return read_dbc(dbc) if text is None else (text, log / DBC_NAME)
