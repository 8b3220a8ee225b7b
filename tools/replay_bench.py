"""Prints what reading a log costs, and its whole replay where there is the command: time, processor time, memory.

    python tools/replay_bench.py                              four lengths, made of one run by repetition; reading
    python tools/replay_bench.py --run runs/demo/run.mcap     the same of a run that is there
    python tools/replay_bench.py --played --seconds 60 300    the emulated arm plays each length; reading and replay

A repeated run is the same records with later times: for reading as good as a long run, but nothing to replay, as the
arm jumps at each seam. Each figure is the best of some fresh processes, compiled code in the cache; the first to fill
it doesn't count. Absolute figures are this machine's; what grows with the length must be time alone, in proportion.
"""

import argparse
import json
import os
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel as ChannelRecord
from mcap.records import Chunk, Schema
from mcap.stream_reader import StreamReader, get_chunk_data_stream

from adacd_hil.log.cdr import MessageType
from adacd_hil.log.channels import Channel
from adacd_hil.log.mcap_file import CONTINUED, ENDING_KEY, FIELDS_KEY, PART_KEY, McapFile
from adacd_hil.log.parts import find_parts, part_path
from adacd_hil.log.sink import Sink
from adacd_hil.log.stream import LogStream

ROOT = Path(__file__).resolve().parent.parent
SECONDS = (60, 300, 900, 3600)
PART_BYTES = 512 << 20
REPLAYED = ("/scheme", "/control", "/cycle", "/contact", "/events")
FRAMES = ("/to_can_bus", "/from_can_bus", "/to_can_bus_fd", "/from_can_bus_fd")
HOUR_S = 3600.0
RECORD = struct.Struct("<BQH")
LOG_TIME, PUBLISH_TIME, STAMP = 15, 23, 35
"""Where a message record has its times."""
CLI = "from adacd_hil.cli.main import main; main()"
LAUNCH = """
import json, resource, subprocess, sys, time
start_s = time.perf_counter()
status = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL).returncode
wall_s = time.perf_counter() - start_s
usage = resource.getrusage(resource.RUSAGE_CHILDREN)
cpu_s = usage.ru_utime + usage.ru_stime
print(json.dumps({"wall_s": wall_s, "cpu_s": cpu_s, "peak_MB": usage.ru_maxrss / 1e3, "status": status}))
"""
"""A small process between: a child's most memory is at least what its parent had when it was made."""
READ = """
import json, sys
sys.path.insert(0, sys.argv[1])
from replay_bench import read
print(json.dumps(read(sys.argv[2])))
"""


def read(path: str) -> dict[str, Any]:
    """Read what a replay needs of a log."""
    stream = LogStream(Path(path), (*REPLAYED, *FRAMES))
    cycles = frames = 0
    for piece in stream:
        cycles += len(piece.series["/cycle"])
        frames += len(piece.frames)
    return {"cycles": cycles, "frames": frames, "problem": stream.problem}


class Repeated:
    """A log of any length that repeats a run."""

    def __init__(self, run: Path) -> None:
        self.chunks: list[tuple[bytes, np.ndarray, np.ndarray]] = []  # records, where each begins, their channels
        self.channels: list[Channel] = []
        stream = LogStream(run, ())
        self.metadata, self.attachments = stream.metadata, stream.attachments
        schemas: dict[int, Schema] = {}
        with run.open("rb") as file:
            for record in StreamReader(file, emit_chunks=True).records:
                if isinstance(record, Chunk):
                    self._add(record)
                elif isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, ChannelRecord) and len(self.channels) < record.id:
                    schema = schemas[record.schema_id]
                    fields = tuple(record.metadata.get(FIELDS_KEY, "").split())
                    message_type = MessageType(schema.name, schema.data.decode(), fields)
                    self.channels.append(Channel(record.id, record.topic, message_type))
        times = [time for chunk in self.chunks for time in self._times_ns(chunk, PUBLISH_TIME)]
        self.lasts_s = -(-(max(times) - min(times)) // 1_000_000_000) + 1

    def _add(self, chunk: Chunk) -> None:
        stream, size = get_chunk_data_stream(chunk)
        data = stream.read(size)
        starts, channels = [], []
        place, first = 0, 0
        while place < len(data):
            opcode, length, channel = RECORD.unpack_from(data, place)
            if opcode == 5:
                starts.append(place)
                channels.append(channel)
            elif not starts:
                first = place + 9 + length  # definitions come first
            place += 9 + length
        self.chunks.append((data[first:], np.array(starts) - first, np.array(channels, np.uint16)))

    @staticmethod
    def _times_ns(chunk: tuple[bytes, np.ndarray, np.ndarray], place: int) -> list[int]:
        data, starts, _ = chunk
        return [struct.unpack_from("<q", data, start + place)[0] for start in starts.tolist()]

    def write(self, path: Path, seconds: float) -> None:
        """Write a log of about that length in parts, the whole run so many times."""
        rounds = max(1, round(seconds / self.lasts_s))
        number = 0
        file = self._begin(path, number)
        for repetition in range(rounds):
            for chunk in self.chunks:
                self._put(file, chunk, repetition * self.lasts_s)
                if file.record_bytes > PART_BYTES:
                    self._end(file, CONTINUED)
                    number += 1
                    file = self._begin(path, number)
        self._end(file, "closed")

    def _begin(self, path: Path, number: int) -> McapFile:
        descriptor = os.open(part_path(path, number), os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        self._sink = Sink(descriptor)
        metadata = {**self.metadata, PART_KEY: str(number)}
        return McapFile(self._sink, tuple(self.channels), self.attachments, metadata)

    def _end(self, file: McapFile, ending: str) -> None:
        file.finish({ENDING_KEY: ending, "dropped": "0"})
        self._sink.close()

    @staticmethod
    def _put(file: McapFile, chunk: tuple[bytes, np.ndarray, np.ndarray], later_s: int) -> None:
        data, starts, channels = chunk
        records = np.frombuffer(data, np.uint8).copy()
        words = np.ndarray((len(records) - 7,), np.int64, records, strides=(1,))
        for place in (LOG_TIME, PUBLISH_TIME):
            words[starts + place] += later_s * 1_000_000_000
        words[starts + STAMP] += later_s  # the lower half are the seconds
        ends = np.append(starts[1:], len(records))
        log_times_ns = words[starts + LOG_TIME]
        file.add(records, channels, log_times_ns, ends, np.array([len(ends)]))
        file.flush()


def play(folder: Path, seconds: float) -> Path:
    """Let the emulated arm play a run of that length in which nothing happens."""
    scenario = folder / f"idle_{seconds:g}.toml"
    text = (ROOT / "firmware_sim" / "scenarios" / "idle.toml").read_text()
    lines = [f"lasts_s = {seconds:.1f}" if line.startswith("lasts_s") else line for line in text.splitlines()]
    scenario.write_text("\n".join(lines) + "\n")
    out = folder / f"played_{seconds:g}"
    subprocess.run(
        [sys.executable, "-c", CLI, "demo", "--scenario", str(scenario), "--out", str(out), "--json"],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    return out / "run.mcap"


def measure(command: list[str]) -> dict[str, float]:
    """Run a command; return its time, its processors' time, the most memory it had and its exit status."""
    launched = subprocess.run([sys.executable, "-c", LAUNCH, *command], capture_output=True, text=True, check=True)
    figures: dict[str, float] = json.loads(launched.stdout)
    return figures


def best(command: list[str], repeats: int) -> dict[str, float]:
    """Measure a command some times; return the quickest."""
    return min((measure(command) for _ in range(repeats)), key=lambda figures: figures["wall_s"])


def has_replay() -> bool:
    """Say whether there is the command `replay`."""
    command = [sys.executable, "-c", CLI, "replay", "--help"]
    return subprocess.run(command, check=False, capture_output=True).returncode == 0


def rows(chosen: argparse.Namespace, folder: Path) -> Iterator[str]:
    """Make the logs, measure, and describe each in a line; the last is of the shortest and the longest log."""
    if not chosen.played:
        repeated = Repeated(chosen.run or play(folder, min(chosen.seconds)))
    does_replay = chosen.played and has_replay()
    found: dict[str, list[tuple[float, float]]] = {}
    for seconds in sorted(chosen.seconds):
        if chosen.played:
            path = play(folder, seconds)
        else:
            path = folder / f"repeated_{seconds:g}.mcap"
            repeated.write(path, seconds)
        parts = find_parts(path)
        cycles = read(str(path))["cycles"]
        lasts_s = cycles / 1000.0
        size_MB = sum(part.stat().st_size for part in parts.values()) / 1e6
        commands = {"read": [sys.executable, "-c", READ, str(Path(__file__).parent), str(path)]}
        if does_replay:
            commands["replay"] = [sys.executable, "-c", CLI, "replay", str(path), "--json"]
        for name, command in commands.items():
            figures = best(command, chosen.repeats)
            found.setdefault(name, []).append((lasts_s, figures["wall_s"]))
            yield (
                f"{name:7} {lasts_s:8.0f} {size_MB:8.0f} {len(parts):5d} {figures['wall_s']:8.2f} "
                f"{figures['cpu_s']:8.2f} {figures['peak_MB']:8.0f} {lasts_s / figures['wall_s']:8.0f} "
                f"{figures['status']:6.0f}"
            )
        for part in parts.values():
            part.unlink()
    for name, points in found.items():
        (first_s, first), (last_s, last) = points[0], points[-1]
        if last_s > first_s:
            rate = (last - first) / (last_s - first_s)
            yield f"{name}: {rate * HOUR_S:.2f} s for each hour and {first - rate * first_s:.2f} s besides"


def main() -> int:
    """Measure what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, help="the run to repeat; default: one in which nothing happens")
    parser.add_argument("--played", action="store_true", help="play each length with the emulated arm")
    parser.add_argument("--seconds", type=float, nargs="+", default=SECONDS, help="lengths of the logs")
    parser.add_argument("--repeats", type=int, default=3, help="processes of which the quickest counts")
    parser.add_argument("--folder", type=Path, help="for the logs, 0.9 MB per second; default: a temporary one")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=chosen.folder) as folder:
        print(
            f"{'':7} {'log s':>8} {'MB':>8} {'parts':>5} {'time s':>8} {'proc. s':>8} {'peak MB':>8} "
            f"{'x real':>8} {'status':>6}"
        )
        for line in rows(chosen, Path(folder)):
            print(line, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
