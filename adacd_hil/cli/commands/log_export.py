"""`adacd-hil log export`: tables and frames of a recording for other programs."""

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from adacd_hil.cli.completion import complete_run
from adacd_hil.cli.options import json_option
from adacd_hil.cli.output import CommandError, ExitCode, explained
from adacd_hil.given_path import GivenPath, WrittenPath
from adacd_hil.terminal import in_line

if TYPE_CHECKING:
    from adacd_hil.wire.codec import Codec

TABLES = ("parquet", "csv")
FRAMES = ("blf", "asc", "candump")
_SUFFIXES = {"candump": ".log"}
_TOLD_EACH = 1_000_000
"""Rows or frames between two lines of progress."""


class HexId(click.ParamType[int]):
    """A CAN identifier in hexadecimal."""

    name = "hex"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Read it."""
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
    help="Whose frames: by the contract, else by their direction.",
)
dbc_option = click.option(
    "--dbc", type=GivenPath(dir_okay=False), help="The contract; default: the log's, else the arm's."
)


@click.command(
    "export",
    epilog="Exit status: 0 done; 1 the recording can't be read or lacks a topic, or a file is in the way; 2 wrong "
    "usage or contract; 3 the recording is damaged, or a disk is full; 130 interrupted.",
)
@click.argument("log", type=GivenPath(dir_okay=False), shell_complete=complete_run)
@click.option("--format", "kind", type=click.Choice([*TABLES, *FRAMES]), required=True, help="Of the output.")
@click.option("--out", type=WrittenPath(), help="Folder of the tables, or file of the frames.")
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
    """Write what a recording holds as tables (Parquet, CSV) or its frames as BLF, ASC or candump log.

    Reads MCAP, candump .log, BLF, ASC, MF4, TRC and CSV. What the target can't hold is counted on stderr. Tables
    replace tables; a file of frames replaces none but the same.
    """
    if kind in TABLES and (can_ids or only != "both"):
        raise CommandError(f"--only and --id choose frames, {kind} holds tables; use --topic", ExitCode.USAGE)
    if kind in FRAMES and topics:
        raise CommandError(f"--topic chooses tables, {kind} holds frames; use --only or --id", ExitCode.USAGE)
    if has_direction and kind != "candump":
        raise CommandError(f"--direction is candump's; {kind} needs none", ExitCode.USAGE)
    codec = contract_of(log, dbc)
    if kind in TABLES:
        described, problem = _export_tables(log, out or log.with_name(f"{log.stem}-tables"), kind, topics, codec)
    else:
        out = out or log.with_suffix(_SUFFIXES.get(kind, f".{kind}"))
        described, problem = _export_frames(log, out, kind, only, can_ids, codec, has_direction)
    if problem:
        print(in_line(f"warning: {problem}"), file=sys.stderr)
    print(json.dumps(described | {"problem": problem}, indent=2) if as_json else described["text"])
    return ExitCode.PARTIAL if problem else ExitCode.OK


def contract_of(log: Path, dbc: Path | None) -> "Codec":
    """Load the contract: the given one, else the one that is attached to the log, else the arm's."""
    from adacd_hil.log.editing.log_info import attachment
    from adacd_hil.wire.codec import load_codec, parse_codec

    if dbc is not None:
        return load_codec(dbc)
    text = attachment(log, "arm.dbc") if log.suffix.lower() == ".mcap" else None
    return load_codec() if text is None else parse_codec(text, log / "arm.dbc")


def _export_tables(
    log: Path, out: Path, kind: str, topics: tuple[str, ...], codec: "Codec"
) -> tuple[dict[str, Any], str]:
    from adacd_hil.log.formats.signal_tables import export_tables

    summary = export_tables(log, out, kind, topics, codec, _Teller("rows"))
    lines = [in_line(f"{path}: {rows} rows") for path, rows in summary.rows.items()]
    described = {
        "files": {str(path): rows for path, rows in summary.rows.items()},
        "text": "\n".join(lines) or "nothing to export",
    }
    return described, summary.problem


def _export_frames(
    log: Path, out: Path, kind: str, only: Any, can_ids: tuple[int, ...], codec: "Codec", has_direction: bool
) -> tuple[dict[str, Any], str]:
    from adacd_hil.log.formats.frame_export import FrameChoice, export_frames, sides
    from adacd_hil.log.formats.frame_log import open_frames

    if out.exists() and log.exists() and out.samefile(log):
        raise CommandError(f"{out} is the recording itself; name another file with --out", ExitCode.USAGE)
    host_ids, device_ids = sides(codec)
    choice = FrameChoice(only, host_ids, device_ids, frozenset(can_ids))
    source = open_frames(log)
    summary = export_frames(source, choice.pieces(source), out, kind, _Teller("frames"), has_direction)
    for loss in summary.losses:
        print(in_line(f"{kind}: {loss}"), file=sys.stderr)
    described = {
        "file": str(out),
        "frames": summary.frames,
        "losses": list(summary.losses),
        "text": in_line(f"{out}: {summary.frames} frames"),
    }
    return described, source.problem


class _Teller:
    """Prints how far the work is."""

    def __init__(self, what: str) -> None:
        self._what = what
        self._told = 0

    def __call__(self, count: int) -> None:
        """Print a line for every so many."""
        if count - self._told >= _TOLD_EACH:
            self._told = count
            print(f"{count} {self._what}", file=sys.stderr, flush=True)
