"""Measures the cycle with and without a viewer, by turns in one run: the ratio of the percentiles.

    python tools/live_bench.py --blocks 10 --block-s 3

The emulated arm in real time on the embedded bus, with the live view on; a client in a process of its own on the same
machine subscribes to everything in every other block. What it costs to be watched is then in the log's own /cycle. On
few processors emulator, host, writer, server and client share them: a client elsewhere costs less.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from live_client import watch
from numpy.typing import NDArray
from side_by_side import patient_config

from adacd_hil.cli.embedded_run import Cast, resolve, run_embedded
from adacd_hil.cli.options import HOST
from adacd_hil.lab.live.live_view import LiveView
from adacd_hil.log.reader import Series, read_log
from adacd_hil.log.types.topics import CYCLE, SCHEME
from adacd_hil.settings.run_settings import RequestSettings

FIELDS = ("lateness_ns", "compute_ns")
PERCENTILES = (50.0, 99.0, 99.9)
SETTLE_NS = 200_000_000
"""Left out at the beginning of a block, while the client comes or goes."""
START_S = 3.0
"""From the first cycle to the first block."""

END_S = 10.0
"""From the last block to the end of the run, at least: what a busy machine may take longer."""


class BenchError(Exception):
    """A run that did not get to its end."""


def view(url: str, blocks: int, block_s: float) -> dict[str, Any]:
    """Watch every other block, the second first; say when each began and ended, and what came."""
    found: dict[str, Any] = {"idle": [], "watched": [], "received": []}
    due_s = time.monotonic()
    for block in range(blocks):
        due_s += block_s  # a client that was late doesn't move the other blocks
        begin_ns = time.time_ns()
        left_s = max(0.0, due_s - time.monotonic())
        if block % 2:
            found["received"].append(watch(url, left_s))
        else:
            time.sleep(left_s)  # nobody watches for as long
        found["watched" if block % 2 else "idle"].append((begin_ns, time.time_ns()))
    return found


def run(blocks: int, block_s: float, folder: Path) -> dict[str, Any]:
    """Run and compare. Raises BenchError."""
    cast = _cast(START_S + 1.1 * blocks * block_s + END_S, folder)
    viewers: list[subprocess.Popen[bytes]] = []
    words = [sys.executable, __file__, "--blocks", str(blocks), "--block-s", str(block_s), "--view"]

    def on_progress(line: str) -> None:
        if line.startswith("live view: "):  # its imports are over before the first block
            url = line.removeprefix("live view: ").split(",")[0]
            viewers.append(subprocess.Popen([*words, url], stdout=subprocess.PIPE))

    summary, _ = run_embedded(cast, "realtime", folder, on_progress, LiveView(HOST, 0))
    viewed, _ = viewers[0].communicate(timeout=60.0) if viewers else (b"", b"")
    if summary.error or summary.result is None or not viewers or viewers[0].returncode:
        ended = "" if summary.result is None else f" after {summary.result.cycles} cycles, {summary.result.fault.name}"
        raise BenchError(summary.error or f"the run ended before the viewer was done{ended}")
    log = read_log(summary.log.path, (CYCLE.name,))
    blocks_of = json.loads(viewed)
    return {
        "scheduler": summary.grant.scheduler,
        "dropped": summary.log.dropped,
        **_compare(log.cycle, log.epoch_ns, blocks_of),
        "received": _rates(blocks_of["received"]),
        "age_ms": _ages(blocks_of["received"]),
    }


def _cast(seconds: float, folder: Path) -> Cast:
    config = patient_config(folder, base="certified")
    settings, scenario = resolve(str(config), "idle", None, None)
    script = (RequestSettings(at_s=seconds, request="finish"),)
    return Cast(replace(settings, operator=replace(settings.operator, script=script)), scenario)


def _compare(cycle: Series, epoch_ns: int, blocks: dict[str, Any]) -> dict[str, Any]:
    """Return percentiles in µs of both kinds of blocks and their ratio; beside it, that of two halves of the idle ones.

    The latter is what the machine does by itself: a ratio within it shows nothing.
    """
    wall_ns = cycle.t_ns + epoch_ns
    parts = {"idle": blocks["idle"], "watched": blocks["watched"]}
    parts |= {"idle_even": blocks["idle"][::2], "idle_odd": blocks["idle"][1::2]}
    places = {kind: _within(wall_ns, part) for kind, part in parts.items()}
    compared: dict[str, Any] = {"cycles": {kind: int(places[kind].sum()) for kind in ("idle", "watched")}}
    for field in FIELDS:
        values = cycle[field] * 1e-3
        found = {kind: np.percentile(values[place], PERCENTILES) for kind, place in places.items()}
        compared[field.replace("_ns", "_us")] = {
            f"p{percentile:g}": {
                "idle": round(float(found["idle"][index]), 1),
                "watched": round(float(found["watched"][index]), 1),
                "ratio": round(float(found["watched"][index] / found["idle"][index]), 3),
                "ratio_of_idle_halves": round(float(found["idle_odd"][index] / found["idle_even"][index]), 3),
            }
            for index, percentile in enumerate(PERCENTILES)
        }
    return compared


def _within(wall_ns: NDArray[np.int64], blocks: list[tuple[int, int]]) -> NDArray[np.bool_]:
    is_in = np.zeros(len(wall_ns), np.bool_)
    for begin_ns, end_ns in blocks:
        is_in |= (wall_ns >= begin_ns + SETTLE_NS) & (wall_ns < end_ns)
    return is_in


def _rates(received: list[dict[str, Any]]) -> dict[str, str]:
    """Return received / expected slots of the topics that have a rate, all blocks together."""
    rates = {}
    for name in received[0]:
        blocks = [block[name] for block in received if "expected" in block[name]]
        if blocks:
            rates[name] = f"{sum(block['slots'] for block in blocks)}/{sum(block['expected'] for block in blocks)}"
    return rates


def _ages(received: list[dict[str, Any]]) -> dict[str, float]:
    """Return the ages of /scheme when it arrived, ms: medians over the blocks."""
    names = {"p50": "age_p50_ms", "p99": "age_p99_ms"}
    schemes = [block[SCHEME.name] for block in received]
    return {
        short: round(float(np.median([each[name] for each in schemes if name in each])), 1)
        for short, name in names.items()
    }


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--blocks", type=int, default=12, help="at least 4")
    parser.add_argument("--block-s", type=float, default=3.0)
    parser.add_argument("--view", metavar="URL", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.view:
        time.sleep(START_S)  # the run settles first
        print(json.dumps(view(options.view, options.blocks, options.block_s)))
        return
    with tempfile.TemporaryDirectory() as folder:
        try:
            print(json.dumps(run(options.blocks, options.block_s, Path(folder)), indent=2))
        except BenchError as error:
            sys.exit(f"live_bench: {error}")


if __name__ == "__main__":
    main()
