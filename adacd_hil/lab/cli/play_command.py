"""`adacd-hil play`: sends the frames of a recording on a bus at their times."""

import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from adacd_hil.cli.options import (
    FiniteRange,
    bitrate_option,
    channel_option,
    interface_option,
    json_option,
    log_argument,
)
from adacd_hil.cli.output import EPILOG, CommandError, ExitCode, answer, explained, text_of
from adacd_hil.clock import MonotonicClock
from adacd_hil.lab.cli.log_command import dbc_option, find_dbc
from adacd_hil.scheduling import freeze_garbage, request_realtime
from adacd_hil.terminal import on_interrupt
from adacd_hil.wire.bus import Bus, BusError
from adacd_hil.wire.can_interface import is_virtual

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from adacd_hil.lab.logs.frame_choice import FrameChoice
    from adacd_hil.wire.bus import Frame

_SHARES = 0.5, 0.99
"""Quantiles of the lateness that are printed, beside the largest."""
_BLOCK = 256
"""Most frames that are prepared between two sends."""
_SWITCH_S = 50e-6
"""Thread switch interval of Python: longest delay of the sending thread by the one that reads ahead."""


def hex_id(text: str) -> int:
    """Return a CAN identifier written in hexadecimal. Raises BadParameter if it is none, or has more than 29 bits."""
    try:
        number = int(text, 16)
    except ValueError:
        raise click.BadParameter(f"{text} is not a hexadecimal identifier") from None
    if not 0 <= number < 1 << 29:
        raise click.BadParameter(f"{text} has more than 29 bits")
    return number


@click.command("play", epilog=EPILOG)
@log_argument
@interface_option(required=True)
@channel_option(required=True, help="Channel of that interface, such as vcan0.")
@bitrate_option
@click.option("--fd", "is_fd", is_flag=True, help="Open the bus for CAN FD; default: as the contract is.")
@click.option(
    "--speed",
    type=FiniteRange(0.001, 1000.0),
    default=1.0,
    show_default=True,
    help="Factor on the speed of the recording.",
)
@click.option("--start", "start_s", type=FiniteRange(0.0), help="Begin so many s after the first frame.")
@click.option("--end", "end_s", type=FiniteRange(0.0), help="End so many s after the first frame.")
@click.option(
    "--loop", "times", type=click.IntRange(0), default=1, show_default=True, help="How often; 0: until interrupted."
)
@click.option("--skip", "longest_pause_s", type=FiniteRange(0.0), help="Cut longer pauses to so many s.")
@click.option(
    "--commands", is_flag=True, help="On a real bus, send frames of others than devices, too: they can move a real arm."
)
@click.option(
    "--only",
    type=click.Choice(["host", "devices", "both"]),
    default="both",
    show_default=True,
    help="Whose frames: by the contract, else by their direction.",
)
@click.option("--id", "can_ids", type=hex_id, multiple=True, metavar="HEX", help="Only these identifiers.")
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
    """Send the frames of a recording at their times, and print how late they were.

    Reads MCAP, candump .log, BLF, ASC, MF4, TRC and CSV. On a real bus only frames that the contract assigns to devices
    are sent, unless --commands asks for the others: NMT, SDO and torque commands can move an arm.
    """
    from adacd_hil.lab.logs.frame_choice import FrameChoice, sides
    from adacd_hil.log.frames.frame_log import open_frames
    from adacd_hil.wire.dbc_contract import parse_codec

    if start_s is not None and end_s is not None and start_s >= end_s:
        raise CommandError(f"--start {start_s:g} s is not before --end {end_s:g} s", ExitCode.USAGE)
    codec = parse_codec(*find_dbc(log, dbc))
    choice = FrameChoice(
        only,
        *sides(codec),
        can_ids=frozenset(can_ids),
        start_ns=None if start_s is None else round(start_s * 1e9),
        end_ns=None if end_s is None else round(end_s * 1e9),
    )
    playback = Playback(log, choice, is_harmless=not (commands or is_virtual(interface, channel)))
    open_frames(log)  # errors of the recording come before errors of the bus
    clock = MonotonicClock()
    from adacd_hil.wire.open_bus import open_bus

    bus = open_bus(interface, channel, clock, (), bitrate, is_fd or codec.is_fd)
    described, code = _run(playback, bus, clock, speed, times, longest_pause_s)
    answer(as_json, described, _as_text(described))
    return code


@dataclass
class Playback:
    """A recording to be played, the choice of its frames, and counts of frames left out.

    unsendable: of kinds that can't be sent. withheld: left out as is_harmless is set. problem: defect of the recording,
    "" until it was read to its end.
    """

    log: Path
    choice: "FrameChoice"
    is_harmless: bool
    """Whether only frames of the contract's devices are sent."""
    unsendable: int = 0
    withheld: int = 0
    problem: str = ""

    def frames(self) -> "Iterator[Frame]":
        """Yield the chosen frames, read ahead by a thread; add those left out to `unsendable` and `withheld`.

        Raises LogError if the recording can't be read.
        """
        from adacd_hil.wire.bus import Frame

        for piece in _ahead(self._pieces()):
            for start in range(0, len(piece), _BLOCK):
                block = piece[start : start + _BLOCK]
                names = ("t_ns", "can_id", "length")
                for t_ns, can_id, length, data in zip(*(block[n].tolist() for n in names), block["data"], strict=True):
                    yield Frame(can_id, data[:length].tobytes(), t_ns)

    def _pieces(self) -> "Iterator[NDArray[Any]]":
        """Yield arrays of the chosen frames that are sent; count the other chosen ones, `unsendable` and `withheld`.

        At the end, store the recording's `problem`.
        """
        import numpy as np

        from adacd_hil.log.frames.frame_log import of_one_channel, open_frames
        from adacd_hil.log.types.record_arrays import is_sendable

        source = open_frames(self.log)
        for frames in of_one_channel(self.choice.pieces(source), source.channels, self.log):
            can_go = is_sendable(frames)
            self.unsendable += int(np.count_nonzero(~can_go))
            if self.is_harmless:
                is_devices = np.isin(frames["can_id"], list(self.choice.device_ids))
                self.withheld += int(np.count_nonzero(can_go & ~is_devices))
                can_go &= is_devices
            yield frames[can_go]
        self.problem = source.problem


def _run(
    playback: Playback, bus: Bus, clock: MonotonicClock, speed: float, times: int, longest_pause_s: float | None
) -> tuple[dict[str, Any], ExitCode]:
    """Play a recording onto a bus, `times` times (0: until interrupted), and close the bus.

    Requests real-time scheduling for this process, and prints refusals. speed: factor on the recording's.
    longest_pause_s: to which pauses are cut; None: they stay. Return counts and lateness of the frames for JSON, and
    the exit status: INTERRUPTED, PARTIAL for a damaged recording, FAILURE if no frame was sent, else OK. Raises
    LogError if the recording can't be read, CommandError if the bus fails.
    """
    from adacd_hil.lab.logs.playback import LATE_MS, repeat
    from adacd_hil.lab.logs.playback import play as play_frames

    interrupted = threading.Event()
    for refusal in request_realtime().missing:
        print(f"not granted: {refusal}", file=sys.stderr)
    freeze_garbage()
    switch_s = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)
    try:
        with on_interrupt(interrupted.set):
            lateness = play_frames(
                bus,
                clock,
                repeat(playback.frames, times),
                speed=speed,
                longest_pause_ns=None if longest_pause_s is None else round(longest_pause_s * 1e9),
                is_stopped=interrupted.is_set,
            )
    except BusError as error:
        raise CommandError(str(error), ExitCode.BUS_MISSING) from None
    finally:
        sys.setswitchinterval(switch_s)
        bus.close()
    described = {
        "frames": lateness.frames,
        "lateness_us": {
            **{f"p{100 * share:g}": lateness.quantile_us(share) for share in _SHARES},
            "max": -(-lateness.worst_ns // 1000),
        },
        f"late_by_{LATE_MS:g}_ms": lateness.late_frames,
        "unsendable": playback.unsendable,
        "withheld": playback.withheld,
        "problem": playback.problem,
    }
    if interrupted.is_set():
        return described, ExitCode.INTERRUPTED
    if playback.problem:
        return described, ExitCode.PARTIAL
    return described, ExitCode.OK if lateness.frames else ExitCode.FAILURE


def _as_text(described: dict[str, Any]) -> str:
    """Return the result of `_run` as text for people: frames sent, withheld, not sendable, lateness, and a problem."""
    from adacd_hil.lab.logs.playback import LATE_MS

    late = ", ".join(f"{name} {value} µs" for name, value in described["lateness_us"].items())
    lines = [
        f"{described['frames']} frames sent, late by {late}; "
        f"{described[f'late_by_{LATE_MS:g}_ms']} by more than {LATE_MS:g} ms"
        if described["frames"]
        else "no frame sent: the recording has none that was asked for and can be sent"
    ]
    if described["withheld"]:
        lines.append(
            f"{described['withheld']} frames withheld: they could move an arm on this bus; --commands sends them, too"
        )
    if described["unsendable"]:
        lines.append(f"{described['unsendable']} frames can't be sent: remote, error or short FD frames")
    if described["problem"]:
        lines.append(f"warning: {described['problem']}")
    return text_of(lines)


def _ahead(pieces: "Iterator[NDArray[Any]]") -> "Iterator[NDArray[Any]]":
    """Yield the pieces, unchanged, while a thread reads the next one; an error of reading is raised in its place."""
    with ThreadPoolExecutor(1) as reader:
        following = reader.submit(next, pieces, None)
        while (piece := following.result()) is not None:
            following = reader.submit(next, pieces, None)
            yield piece
