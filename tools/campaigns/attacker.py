"""Plays one attack of attacks.py on a SocketCAN interface, with a raw socket of its own.

    python tools/campaigns/attacker.py command-both vcan0 --seconds 1.5

Prints "ready", then waits for a line on stdin and begins; at the end prints JSON: wall-clock time of the beginning and
of the first forged frame in ns, and how many frames were forged. Exit status: 0 done, 2 wrong usage, 5 no such bus.
"""

import argparse
import heapq
import json
import select
import socket
import struct
import sys
import time
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from attacks import ATTACKS, Attack, Forged, Forger, find_attack  # noqa: E402

from adacd_hil.wire.dbc_contract import contract_folder  # noqa: E402

FRAME = struct.Struct("=IB3x8s")
RECEIVE_BUFFER = 1 << 22
BUS_MISSING = 5


class Attacker:
    """An attack on a socket."""

    def __init__(self, attack: Attack, can: socket.socket) -> None:
        self.attack, self.can = attack, can
        self.forged = 0
        self.first_ns: int | None = None
        self._held: list[tuple[int, int, Forged]] = []
        self._begin_ns = time.monotonic_ns()
        self._tick_ns = self._begin_ns

    def run(self, seconds: float) -> None:
        """Attack for so long."""
        end_ns = self._begin_ns + round(seconds * 1e9)
        while (now_ns := time.monotonic_ns()) < end_ns:
            while self._held and self._held[0][0] <= now_ns:
                self._send(heapq.heappop(self._held)[2])
            if self.attack.every_ns and now_ns >= self._tick_ns:
                self._tick_ns += self.attack.every_ns
                self._send_all(self.attack.tick(now_ns - self._begin_ns))
                continue
            due_ns = min(end_ns, self._tick_ns if self.attack.every_ns else end_ns)
            if self._held:
                due_ns = min(due_ns, self._held[0][0])
            readable, _, _ = select.select([self.can], [], [], max(due_ns - now_ns, 0) * 1e-9)
            if readable:
                can_id, length, data = FRAME.unpack(self.can.recv(FRAME.size))
                if can_id <= 0x7FF:
                    self._send_all(self.attack.hears(can_id, data[:length], time.monotonic_ns() - self._begin_ns))

    def _send_all(self, frames: list[Forged]) -> None:
        for forged in frames:
            if forged.after_ns:
                due_ns = time.monotonic_ns() + forged.after_ns
                heapq.heappush(self._held, (due_ns, self.forged + len(self._held), forged))
            else:
                self._send(forged)

    def _send(self, forged: Forged) -> None:
        if self.first_ns is None:
            self.first_ns = time.time_ns()
        try:
            self.can.send(FRAME.pack(forged.can_id, len(forged.data), forged.data))
        except OSError:  # the queue is full, or the kernel does not take such a frame: an attacker does not mind
            return
        self.forged += 1


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(prog="attacker", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("attack", choices=[case.name for case in ATTACKS])
    parser.add_argument("channel")
    parser.add_argument("--seconds", type=float, default=1.5)
    chosen = parser.parse_args(argv)
    attack = find_attack(chosen.attack).make(Forger((contract_folder() / "arm.dbc").read_bytes()))
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as can:
        can.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        try:
            can.bind((chosen.channel,))
        except OSError as error:
            print(f"attacker: {chosen.channel}: {error.strerror}", file=sys.stderr)
            return BUS_MISSING
        print("ready", flush=True)
        sys.stdin.readline()
        can.setblocking(False)
        try:
            while True:
                can.recv(FRAME.size)  # what came before says nothing of now
        except BlockingIOError:
            can.setblocking(True)
        begin_ns = time.time_ns()
        attacker = Attacker(attack, can)
        attacker.run(chosen.seconds)
    print(json.dumps({"begin_ns": begin_ns, "first_ns": attacker.first_ns, "forged": attacker.forged}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
