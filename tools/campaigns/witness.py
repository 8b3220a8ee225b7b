"""What the bus saw: the kernel's stamps of every frame, from a process beside the ones that are measured.

It shares nothing with the host: neither its clock readings nor its log, which some tests take away.
"""

import json
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yardstick
from numpy.typing import NDArray

SOURCE = Path(__file__).resolve().parent / "witness.c"
RECORD = np.dtype([("wall_ns", "<i8"), ("can_id", "<u4"), ("length", "<u4"), ("data", "<u8")])


@dataclass(frozen=True)
class Seen:
    """Frames in the order of the bus (n,) of `RECORD`: CLOCK_REALTIME ns, identifier, the first 8 data bytes."""

    frames: NDArray[Any]

    @property
    def wall_ns(self) -> NDArray[np.int64]:
        """When each frame was on the bus."""
        return np.asarray(self.frames["wall_ns"], np.int64)

    @property
    def data(self) -> NDArray[np.uint64]:
        """The first 8 data bytes as a number, little-endian."""
        return np.asarray(self.frames["data"], np.uint64)

    def of(self, can_id: int) -> "Seen":
        """Return the frames of one identifier."""
        return Seen(self.frames[self.frames["can_id"] == can_id])

    def between(self, begin_ns: int, end_ns: int) -> "Seen":
        """Return the frames of a span of time."""
        return Seen(self.frames[(self.wall_ns >= begin_ns) & (self.wall_ns < end_ns)])


@contextmanager
def witness(channel: str, can_ids: Sequence[int], path: Path, build_folder: Path) -> Iterator[dict[str, int]]:
    """Write what passes on an interface to a file while the block lasts; then fills in `frames` and `lost`.

    Raises RuntimeError where there is no C compiler or the interface can't be watched.
    """
    program, reason = yardstick.build(build_folder, SOURCE)
    if program is None:
        raise RuntimeError(reason)
    command = [program, channel, path, *(f"{can_id:03X}" for can_id in can_ids)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    counts: dict[str, int] = {}
    try:
        assert process.stderr is not None
        if (said := process.stderr.readline()) != "ready\n":
            raise RuntimeError(said.strip())
        yield counts
    finally:
        process.terminate()
        told, _ = process.communicate(timeout=10.0)
        if process.returncode == 0:
            counts.update(json.loads(told))


def read_witness(path: Path) -> Seen:
    """Read what a witness wrote; a cut last record is left out."""
    whole = path.stat().st_size // RECORD.itemsize
    return Seen(np.fromfile(path, RECORD, whole))


def times_after(begin_ns: NDArray[np.int64], end_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return, for each of `end_ns`, the time since the latest of `begin_ns`; those before the first are left out."""
    place = np.searchsorted(begin_ns, end_ns, side="right") - 1
    known = place >= 0
    return np.asarray(end_ns[known] - begin_ns[place[known]], np.int64)
