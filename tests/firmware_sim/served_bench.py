"""The emulator's service on a scripted bus: what a host sends at which time, until it dies or the script ends."""

from collections import deque
from collections.abc import Callable, Sequence

import pytest
from bench_host import CODEC, BenchHost, Nmt, quiet_scenario

from adacd_hil.clock import VirtualClock
from adacd_hil.wire.bus import Bus, Frame
from firmware_sim.bench.bench import Bench
from firmware_sim.bench.bench_time import OnTruth
from firmware_sim.bench.injector import Departure
from firmware_sim.cli.emulator_main import main
from firmware_sim.cli.service import Service, StopRequest

MS = 1_000_000
START_ALL = (0x000, bytes([Nmt.START, 0]))
HOST_BEAT = (0x77F, b"\x05")
Script = Sequence[tuple[int, int, bytes]]
"""Time in ms, identifier, data."""


def run_main(*arguments: str) -> int:
    """Call `firmware-sim` in this process; return its exit status."""
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    return int(ended.value.code)


class ScriptedBus(Bus):
    """A bus whose frames come at scripted times of a virtual clock; the end of the script stops the service."""

    channel = "scripted"

    def __init__(self, clock: VirtualClock, stop: StopRequest, end_ns: int) -> None:
        self.sent: list[tuple[int, int, bytes]] = []
        self.script: deque[tuple[int, int, bytes]] = deque()
        self.stall_at_ns = -1  # the process is held up for 5 ms when it takes the frame of this time
        self._clock = clock
        self._stop = stop
        self._end_ns = end_ns

    def send(self, can_id: int, data: bytes) -> None:
        self.sent.append((self._clock.now_ns(), can_id, data))

    def receive(self, timeout_s: float) -> Frame | None:
        until_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        if self.script and self.script[0][0] <= until_ns:
            t_ns, can_id, data = self.script.popleft()
            self._clock.sleep_until_ns(t_ns)
            if t_ns == self.stall_at_ns:
                self._clock.sleep_until_ns(t_ns + 5 * MS)
            return Frame(can_id, data, self._clock.now_ns())
        self._clock.sleep_until_ns(until_ns)
        if self._clock.now_ns() >= self._end_ns:
            self._stop.make()
        return None

    def close(self) -> None:
        pass


def serve(
    script: Script,
    end_ms: int,
    clock_mode: str = "sync",
    is_once: bool = False,
    stall_at_ms: int = -1,
    on_truth: OnTruth | None = None,
    send_all: Callable[[list[tuple[int, bytes]]], None] | None = None,
    waiting: Script = (),
) -> tuple[ScriptedBus, Bench, VirtualClock]:
    """Play a script to a bench and let the service run until `end_ms`. `waiting`: what was sent before power-on."""
    clock, stop = VirtualClock(), StopRequest()
    bus = ScriptedBus(clock, stop, end_ms * MS)
    if send_all is not None:
        bus.send_all = send_all
    departure = Departure(bus)
    bench = Bench(
        quiet_scenario(),
        CODEC,
        departure.send,
        clock_mode=clock_mode,
        on_answer=departure.send_waiting,
        on_truth=on_truth,
    )
    service = Service(bench, bus, departure, clock, clock_mode, stop, is_once)
    bus.script.extend((t_ms * MS, can_id, data) for t_ms, can_id, data in waiting)
    service.boot()
    bus.stall_at_ns = stall_at_ms * MS
    bus.script.extend((t_ms * MS, can_id, data) for t_ms, can_id, data in script)
    service.run()
    return bus, bench, clock


def enabling_script(cycles: int, torque: int = 0, set_up: tuple[bytes, ...] = (), is_beating: bool = False) -> Script:
    """Make what a host sends to enable the drives and keep them so: a cycle every ms from 1 ms on.

    `torque`: commanded from 4 ms on, per mille. `set_up`: SDO requests to both drives. `is_beating`: heartbeats.
    """
    host = BenchHost()  # for its frames only
    script = [(0, *START_ALL)]
    for joint in (1, 2):
        for request in (bytes([0x2F, 0x60, 0x60, 0, 10, 0, 0, 0]), *set_up):
            script.append((0, 0x600 + joint, request))
    for k in range(cycles):
        controlword = (0x06, 0x07, 0x0F)[min(k, 2)]
        asked = torque if k > 2 else 0
        script.extend((k + 1, 0x200 + joint, host.command_frame(joint, controlword, asked)) for joint in (1, 2))
        script.append((k + 1, 0x080, bytes([1 + k])))
        if is_beating:
            script.append((k + 1, *HOST_BEAT))
    return script
