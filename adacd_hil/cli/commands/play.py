"""Plays the frames of a recording onto a bus."""

import queue
import sys
import threading
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adacd_hil.cli.connection import on_interrupt
from adacd_hil.cli.exit_codes import CommandError, ExitCode
from adacd_hil.clock import MonotonicClock
from adacd_hil.log.formats.frame_export import FrameChoice
from adacd_hil.log.formats.frame_log import open_frames
from adacd_hil.log.log_files import LogError
from adacd_hil.log.types.record_arrays import is_sendable
from adacd_hil.scheduling import freeze_garbage, request_realtime
from adacd_hil.terminal import in_line
from adacd_hil.wire.bus import Bus, BusError, open_bus
from adacd_hil.wire.can_interface import is_virtual
from adacd_hil.wire.playback import PlayedFrame, play, repeat

_PIECES_AHEAD = 4
_BLOCK = 256
"""Frames that are made ready between two sends at most."""
_SWITCH_S = 50e-6
"""How long the thread that reads ahead may keep the one that sends waiting."""


@dataclass
class Playback:
    """What is played, and what was left out of it."""

    log: Path
    choice: FrameChoice
    is_harmless: bool
    """Only what the contract's devices send goes out."""
    unsendable: int = 0
    withheld: int = 0
    problem: str = ""

    def frames(self) -> Iterator[PlayedFrame]:
        """Give the frames, read ahead by a thread. Raises LogError."""
        for piece in _ahead(self._pieces()):
            for start in range(0, len(piece), _BLOCK):
                block = piece[start : start + _BLOCK]
                names = ("t_ns", "can_id", "length")
                for t_ns, can_id, length, data in zip(*(block[n].tolist() for n in names), block["data"], strict=True):
                    yield PlayedFrame(t_ns, can_id, data[:length].tobytes())

    def _pieces(self) -> Iterator[NDArray[Any]]:
        source = open_frames(self.log)
        for frames in self.choice.pieces(source):
            can_go = is_sendable(frames)
            self.unsendable += int(np.count_nonzero(~can_go))
            if self.is_harmless:
                is_devices = np.isin(frames["can_id"], list(self.choice.device_ids))
                self.withheld += int(np.count_nonzero(can_go & ~is_devices))
                can_go &= is_devices
            yield frames[can_go]
        self.problem = source.problem


def run_playback(
    playback: Playback,
    interface: str,
    channel: str,
    bitrate: int | None,
    is_fd: bool,
    *,
    speed: float,
    times: int,
    longest_pause_s: float | None,
) -> tuple[dict[str, Any], ExitCode]:
    """Play onto a bus until the recording ends or the user interrupts.

    Raises LogError, BusMissingError, CommandError.
    """
    open_frames(playback.log)  # what is wrong with the recording comes before what is wrong with the bus
    clock = MonotonicClock()
    bus: Bus = open_bus(interface, channel, clock, (), bitrate, is_fd)
    interrupted = threading.Event()
    for refusal in request_realtime().missing:
        print(f"not granted: {refusal}", file=sys.stderr)
    freeze_garbage()
    switch_s = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)
    try:
        with on_interrupt(interrupted.set):
            lateness = play(
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
            "p50": lateness.quantile_us(0.5),
            "p99": lateness.quantile_us(0.99),
            "max": -(-lateness.worst_ns // 1000),
        },
        "late_by_1_ms": lateness.late_frames,
        "unsendable": playback.unsendable,
        "withheld": playback.withheld,
        "problem": playback.problem,
    }
    if interrupted.is_set():
        return described, ExitCode.INTERRUPTED
    return described, ExitCode.PARTIAL if playback.problem else ExitCode.OK


def as_text(described: dict[str, Any]) -> str:
    """Describe it for people."""
    late = described["lateness_us"]
    lines = [
        f"{described['frames']} frames sent, late by p50 {late['p50']} µs, p99 {late['p99']} µs, max {late['max']} µs; "
        f"{described['late_by_1_ms']} by more than 1 ms"
    ]
    if described["withheld"]:
        lines.append(
            f"{described['withheld']} frames withheld: they could move an arm on this bus; --commands sends them, too"
        )
    if described["unsendable"]:
        lines.append(f"{described['unsendable']} frames can't be sent: remote, error or short FD frames")
    if described["problem"]:
        lines.append(f"warning: {described['problem']}")
    return "\n".join(in_line(line) for line in lines)


def may_move_an_arm(interface: str, channel: str) -> bool:
    """Tell whether real drives may hear what is sent."""
    return not is_virtual(interface, channel)


def _ahead(pieces: Iterable[NDArray[Any]]) -> Iterator[NDArray[Any]]:
    """Give what a thread takes from an iterator some pieces ahead. Raises what that raises."""
    waiting: queue.Queue[NDArray[Any] | LogError | None] = queue.Queue(_PIECES_AHEAD)
    is_over = threading.Event()

    def put(item: NDArray[Any] | LogError | None) -> bool:
        while not is_over.is_set():
            try:
                waiting.put(item, timeout=0.1)
            except queue.Full:
                continue
            return True
        return False

    def read() -> None:
        try:
            for piece in pieces:
                if not put(piece):
                    return
        except LogError as error:
            put(error)
        else:
            put(None)

    thread = threading.Thread(target=read, name="playback reader", daemon=True)
    thread.start()
    try:
        while (item := waiting.get()) is not None:
            if isinstance(item, LogError):
                raise item
            yield item
    finally:
        is_over.set()
        thread.join()
