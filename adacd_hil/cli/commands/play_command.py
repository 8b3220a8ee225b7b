"""`adacd-hil play`: the frames of a recording on a bus, at their times."""

import json
from pathlib import Path
from typing import Any

import click

from adacd_hil.cli.commands.log_export import contract_of, dbc_option, id_option, only_option
from adacd_hil.cli.exit_codes import EPILOG, ExitCode
from adacd_hil.cli.options import explained, json_option
from adacd_hil.given_path import GivenPath


@click.command("play", epilog=EPILOG)
@click.argument("log", type=GivenPath(dir_okay=False))
@click.option("-i", "--interface", required=True, help="python-can interface, such as socketcan.")
@click.option("-c", "--channel", required=True, help="Channel of that interface, such as vcan0.")
@click.option("-b", "--bitrate", type=click.IntRange(min=10_000), help="bit/s, where python-can sets it.")
@click.option("--fd", "is_fd", is_flag=True, help="Open the bus for CAN FD; default: as the contract is.")
@click.option("--speed", type=click.FloatRange(0.001, 1000.0), default=1.0, show_default=True, help="Of the times.")
@click.option("--start", "start_s", type=click.FloatRange(0.0), help="Begin so many s after the first frame.")
@click.option("--end", "end_s", type=click.FloatRange(0.0), help="End so many s after the first frame.")
@click.option(
    "--loop", "times", type=click.IntRange(0), default=1, show_default=True, help="How often; 0: until interrupted."
)
@click.option("--skip", "longest_pause_s", type=click.FloatRange(0.0), help="Cut longer pauses to so many s.")
@click.option(
    "--commands", is_flag=True, help="Also on a real bus, send what isn't the devices': it can move a real arm."
)
@only_option
@id_option
@dbc_option
@json_option
@explained
def play(
    log: Path,
    interface: str,
    channel: str,
    bitrate: int | None,
    is_fd: bool,
    speed: float,
    start_s: float | None,
    end_s: float | None,
    times: int,
    longest_pause_s: float | None,
    commands: bool,
    only: Any,
    can_ids: tuple[int, ...],
    dbc: Path | None,
    as_json: bool,
) -> ExitCode:
    """Send the frames of a recording at their times, and say how late they were.

    Reads MCAP, candump .log, BLF, ASC, MF4, TRC and CSV. On a real bus only frames that the contract says the devices
    send are sent, unless --commands asks for the others: NMT, SDO and torque commands can move an arm.
    """
    from adacd_hil.cli.commands.play import Playback, as_text, may_move_an_arm, run_playback
    from adacd_hil.log.formats.frame_export import FrameChoice, sides

    codec = contract_of(log, dbc)
    choice = FrameChoice(
        only,
        *sides(codec),
        can_ids=frozenset(can_ids),
        start_ns=None if start_s is None else round(start_s * 1e9),
        end_ns=None if end_s is None else round(end_s * 1e9),
    )
    playback = Playback(log, choice, is_harmless=may_move_an_arm(interface, channel) and not commands)
    described, code = run_playback(
        playback,
        interface,
        channel,
        bitrate,
        is_fd or codec.is_fd,
        speed=speed,
        times=times,
        longest_pause_s=longest_pause_s,
    )
    print(json.dumps(described, indent=2) if as_json else as_text(described))
    return code
