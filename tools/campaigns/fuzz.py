"""Sends random and damaged frames to everything that takes frames, and stops at the first violation.

    python tools/campaigns/fuzz.py --frames 1000000 --seed 1  every frame into host and devices
    python tools/campaigns/fuzz.py --cangen 60  a real bus: runs for 60 s under cangen at full rate, on vcan

What is promised, and what can't be: tests/fuzz/fuzz_receivers.py and tests/vcan/test_cangen_fuzz.py.
Exit status: 0 nothing was violated; 1 something was; the frame is printed.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Iterable, Sequence
from itertools import islice
from pathlib import Path
from typing import Protocol

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "tests" / "fuzz")]

from fuzz_frames import CanFrame, damaged, fuzz, record_legal_traffic  # noqa: E402 (they are the tests')
from fuzz_receivers import HOST_SERVICES, BenchReceiver, HostReceiver  # noqa: E402

PORTION = 10_000


class Receiver(Protocol):
    """Something that frames are thrown at."""

    def take(self, frame: CanFrame) -> None:
        """Take a frame; any exception is a violation."""


def main() -> int:
    """Run what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--cangen", type=float, metavar="SECONDS", help="on vcan instead, for so long")
    options = parser.parse_args()
    if options.cangen is not None:
        return fuzz_on_vcan(options.cangen)
    return fuzz_in_process(options.frames, options.seed)


def fuzz_in_process(count: int, seed: int) -> int:
    """Pass every frame to every receiver; the devices get them with the host's services, and damaged ones without."""
    with tempfile.TemporaryDirectory() as folder:
        legal = record_legal_traffic(Path(folder))
    print(f"{len(legal)} legal frames to begin with, seed {seed}", file=sys.stderr)
    lanes = (
        (fuzz(legal, seed), (HostReceiver(), BenchReceiver())),
        (damaged(legal, seed), (BenchReceiver(without=HOST_SERVICES),)),
    )
    start_s = time.perf_counter()
    done = 0
    while done < count:
        portion = min(PORTION, count - done)
        if not all(survive(islice(frames, portion), receivers) for frames, receivers in lanes):
            return 1
        done += portion
        rate = done / (time.perf_counter() - start_s)
        print(f"\r{done}/{count} frames, {rate:.0f} per s ", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    (_, receivers), (_, (without_services,)) = lanes
    for receiver in receivers:
        print(receiver.summary)
    print(f"without the host's services and whole frames: {without_services.summary}")
    print(f"{count} frames, {count / (time.perf_counter() - start_s):.0f} per s, nothing violated")
    return 0


def survive(frames: Iterable[CanFrame], receivers: Sequence[Receiver]) -> bool:
    """Pass frames to receivers; return False after a violation, which is printed."""
    for frame in frames:
        for receiver in receivers:
            try:
                receiver.take(frame)
            except Exception:  # every kind is a violation
                traceback.print_exc()
                print(f"{type(receiver).__name__}: frame 0x{frame[0]:03X} {frame[1].hex() or 'without data'}")
                return False
    return True


def fuzz_on_vcan(duration_s: float) -> int:
    """Run the campaign of tests/vcan/test_cangen_fuzz.py for so long."""
    limit_s = round(duration_s * 3 + 300)
    command = [ROOT / "tools/with-vcan", "--mem", "2G", "--can", "vcan0", "--timeout", str(limit_s), "--"]
    test = [sys.executable, "-m", "pytest", "-q", "-s", str(ROOT / "tests/vcan/test_cangen_fuzz.py")]
    timeout = ["-o", f"timeout={limit_s}"]
    environment = os.environ | {"ADACD_HIL_FUZZ_S": f"{duration_s:g}"}
    return subprocess.run([*command, *test, *timeout], env=environment, cwd=ROOT, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
