"""Two arms on one bus in virtual time: the first host sends SYNC and pushes its arm a little, the second follows it."""

import dataclasses
from collections import deque
from collections.abc import Callable

import numpy as np
from loaded import loaded_contract

from adacd_hil.clock import VirtualClock
from adacd_hil.control.exchange import Exchange
from adacd_hil.control.pacing import GridPacer, Tick
from adacd_hil.device.arm import Arm
from adacd_hil.device.device_files import place_devices
from adacd_hil.device.network import Master
from adacd_hil.records import ArmCommand
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.bus import Bus, Frame, Tap
from firmware_sim.bench.bench import Bench
from firmware_sim.scenario.scenario import Scenario, load_scenario

FIRST, SECOND = 0, 1
FIRST_HOST_NODE = 127
PUSH_NM = np.array([0.2, 0.05])


def first_beside(second: Settings) -> Settings:
    """Configure the arm that shares a bus with another one: at nodes 1 to 4, its host sends SYNC."""
    return dataclasses.replace(
        second,
        bus=dataclasses.replace(second.bus, sync="produce", host_node=FIRST_HOST_NODE),
        devices=dataclasses.replace(second.devices, drive_node=(1, 2), sensor_node=(3, 4)),
    )


class End(Bus):
    """One host's end of the bus. `on_wait`: lets time pass until something may have come, False at the limit."""

    waiting_frames = ()

    def __init__(self, wire: "Wire") -> None:
        self.channel = "shared"
        self.sent: list[tuple[int, bytes]] = []
        self.received: deque[Frame] = deque()
        self.on_wait: Callable[[int], bool] = lambda limit_ns: False
        self._wire = wire

    def send(self, can_id: int, data: bytes) -> None:
        self.sent.append((can_id, bytes(data)))
        self._wire.carry(Frame(can_id, bytes(data), self._wire.clock.now_ns()), self)

    def receive(self, timeout_s: float) -> Frame | None:
        limit_ns = self._wire.clock.now_ns() + round(max(timeout_s, 0.0) * 1e9)
        while not self.received:
            if timeout_s <= 0.0 or not self.on_wait(limit_ns):
                return None
        return self.received.popleft()

    def recover(self) -> None:
        self.received.clear()

    def close(self) -> None:
        pass


class Wire:
    """Everybody hears every frame, in the order in which they are sent."""

    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.ends = (End(self), End(self))
        self.benches: list[Bench] = []

    def carry(self, frame: Frame, sender: object) -> None:
        for end in self.ends:
            if end is not sender:
                end.received.append(frame)
        for bench in self.benches:
            if bench is not sender:
                bench.on_frame(frame)

    def add_arm(self, settings: Settings, scenario: Scenario) -> None:
        bench = Bench(scenario, loaded_contract(settings), lambda *frame: self._answer(bench, *frame))
        self.benches.append(bench)
        bench.boot()

    def _answer(self, bench: Bench, can_id: int, data: bytes) -> None:
        self.carry(Frame(can_id, bytes(data), self.clock.now_ns()), bench)


class FirstHost:
    """Pushes its arm a little, once per period; sends SYNC."""

    def __init__(self, wire: Wire, settings: Settings) -> None:
        codec = loaded_contract(settings)
        self.tap = Tap(wire.ends[FIRST], wire.clock)
        self.arm = Arm(settings, codec, place_devices(settings), self.tap)
        self.master = Master(settings, codec, place_devices(settings), self.tap)
        pacer = GridPacer(wire.clock, settings.bus.period_ns)
        self._exchange = Exchange(settings, self.tap, self.arm, self.master, pacer, wire.clock)
        self.cycle = -1
        self._clock = wire.clock
        self.states = []

    def boot(self) -> None:
        self.master.reset()
        self.master.identify()
        self.master.configure()
        self.master.start()

    def step(self) -> None:
        self.cycle += 1
        state = self._exchange.read(Tick(self.cycle, self._clock.now_ns(), 1, 0))
        self.states.append(state)
        self.arm.send_command(ArmCommand(PUSH_NM if state.is_enabled else np.zeros(2), True, False))
        if self.cycle % 50 == 0:
            self.master.send_heartbeat()


class TwoArms:
    """Both arms, and the first host, which is in operation. `end`: the second host's end of the bus.

    second: that host's settings. scenario: of its arm. dies_ns: when the first host falls silent.
    """

    def __init__(self, second: Settings, scenario: Scenario | None = None, dies_ns: int = 1 << 62) -> None:
        idle = load_scenario("idle", "P")
        first = first_beside(second)
        self.wire = Wire()
        self.wire.add_arm(first, idle)
        self.wire.add_arm(second, scenario or idle)
        self.clock = self.wire.clock
        self.first = FirstHost(self.wire, first)
        self.first.boot()
        self.end = self.wire.ends[SECOND]
        self.end.on_wait = self._let_pass
        self._period_ns = second.bus.period_ns
        self._dies_ns = dies_ns
        for _ in range(5):  # SYNC is there before the second host is
            self.first.step()

    def _let_pass(self, limit_ns: int) -> bool:
        """Let time pass to the first host's next period, or to the limit."""
        clock = self.clock
        due_ns = (clock.now_ns() // self._period_ns + 1) * self._period_ns
        if due_ns > limit_ns or due_ns >= self._dies_ns:
            clock.sleep_until_ns(limit_ns)
            return False
        clock.sleep_until_ns(due_ns)
        self.first.step()
        return True
