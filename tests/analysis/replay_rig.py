"""A short run with all that a replay has to get right: a contact, a stop, a fault and an attempt after it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from adacd_hil.cli.embedded_run import Cast, run_embedded
from adacd_hil.log.frames.frame_log import read_frames
from adacd_hil.log.reader import Piece, Series
from adacd_hil.replay.log_source import LogSource
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.run_settings import RequestSettings
from firmware_sim.scenario.scenario import load_scenario

FIRST_S = 2.0


def settings_of_run(config: str = "paper") -> Settings:
    settings = load_settings(config)
    operator = replace(
        settings.operator,
        script=(RequestSettings(at_s=1.9, request="finish"),),
        acknowledge_after_s=0.2,
        acknowledge_faults=1,
        acknowledge_fault_after_s=0.1,
    )
    termination = replace(settings.termination, hold_s=0.4, travel_deg=1.0, velocity_deg_s=0.0, excitation_Nm2s=0.0)
    return replace(settings, operator=operator, termination=termination)


def record(folder: Path, settings: Settings | None = None) -> Path:
    """Play it, with the emulator's truth beside."""
    pushed, faulty = load_scenario("push-link1"), load_scenario("drive-fault-and-recovery")
    scenario = replace(
        pushed,
        contacts=(replace(pushed.contacts[0], at_s=FIRST_S, duration_s=0.1),),
        faults=(replace(faulty.faults[0], at_s=0.3, duration_s=0.1),),
    )
    run_embedded(Cast(settings or settings_of_run(), scenario), "lockstep", folder)
    return folder / "run.mcap"


Change = Callable[[Piece], Piece]


class ChangedLog(LogSource):
    """A log of which something was changed after it was written. is_old: as if it had no /arm."""

    def __init__(self, path: Path, change: Change, cycles_per_piece: int = 20_000, is_old: bool = False) -> None:
        super().__init__(path, cycles_per_piece)
        self._change = change
        if is_old:
            self.has_arms, self._partner = False, "/cycle"

    def _piece(self, piece: Piece) -> Piece:
        return self._change(piece)


def flip(records: np.ndarray, row: int, field: str, element: int = 0, bit: int = 0) -> None:
    """Flip a bit of a field of a record, in place; element of an array."""
    kind, offset = records.dtype.fields[field][:2]
    place = offset + element * kind.base.itemsize + bit // 8
    rows = records.view(np.uint8).reshape(len(records), records.dtype.itemsize)
    rows[row, place] ^= 1 << bit % 8


def flipping(topic: str, *flips: tuple[Any, ...]) -> Change:
    """Flip bits of a topic: row, field, and element and bit if not the first."""

    def change(piece: Piece) -> Piece:
        records = writable(piece.series[topic])
        for each in flips:
            flip(records, *each)
        return with_records(piece, topic, records)

    return change


def with_records(piece: Piece, topic: str, records: np.ndarray, epoch_ns: int = 0) -> Piece:
    series: dict[str, Any] = dict(piece.series)
    series[topic] = Series(records, epoch_ns)
    return piece._replace(series=series)


def writable(series: Series) -> np.ndarray:
    """Return a copy of the records, all their bytes included."""
    records = np.zeros(len(series), series.records.dtype)
    size = records.dtype.itemsize
    rows = np.ascontiguousarray(series.records).view(np.uint8).reshape(len(records), size)
    records.view(np.uint8).reshape(len(records), size)[:] = rows
    return records


def without_cycles(first: int, last: int) -> Change:
    """Drop the cycles from one number up to another, frames and all."""

    def change(piece: Piece) -> Piece:
        partner = "/arm" if "/arm" in piece.series else "/cycle"
        cycles = piece.series[partner]
        number = cycles["cycle"].astype(np.int64)
        lost = (number >= first) & (number < last)
        gone = cycles.records["publish_time"][lost]
        for topic in ("/scheme", partner, "/contact"):
            records = piece.series[topic].records
            piece = with_records(piece, topic, records[~np.isin(records["publish_time"], gone)])
        frames = piece.frames
        return piece._replace(frames=frames[~np.isin(frames["cycle_t_ns"].astype(np.uint64), gone)])

    return change


def write_candump(log: Path, path: Path, pace: float = 1.0, start_s: float = 0.0, first: int = 0) -> None:
    """Write the frames of a log as `candump -L` would, on a clock of its own, from frame `first` on."""
    frames = read_frames(log).frames[first:]
    with path.open("w") as file:
        for frame in frames:
            t_us = round(start_s * 1e6 + frame["t_ns"] * 1e-3 * pace)
            data = frame["data"][: frame["length"]].tobytes().hex().upper()
            file.write(f"({t_us // 1_000_000}.{t_us % 1_000_000:06d}) can0 {frame['can_id']:03X}#{data}\n")
