"""An emulated arm at the other end of an embedded bus, in virtual time: what waits for a frame makes its time pass."""

from collections.abc import Callable

from adacd_hil.clock import VirtualClock
from adacd_hil.device.arm import Arm
from adacd_hil.device.network import Master
from adacd_hil.settings.configuration import Settings, load_settings
from adacd_hil.wire.bus import EmbeddedBus, Frame, Tap
from adacd_hil.wire.codec import load_codec
from firmware_sim.bench.bench import Bench
from firmware_sim.scenario.scenario import load_scenario

CODEC = load_codec()


PERIOD_NS = 1_000_000


class _BenchClock(VirtualClock):
    """Lets the bench live through the time that passes, in steps of at most a period."""

    def __init__(self) -> None:
        super().__init__()
        self.on_time: Callable[[int], None] = lambda t_ns: None
        self.oversleep_ns: Callable[[int], int] = lambda t_ns: 0

    def sleep_until_ns(self, t_ns: int) -> None:
        t_ns += self.oversleep_ns(t_ns)
        while self.now_ns() < t_ns:
            super().sleep_until_ns(min(t_ns, (self.now_ns() // PERIOD_NS + 1) * PERIOD_NS))
            self.on_time(self.now_ns())


class BenchBus:
    """`tamper` may change or drop what the devices send, `sent` is what the host sent, with its time."""

    def __init__(self, settings: Settings | None = None) -> None:
        self.settings = settings or load_settings("paper")
        self.clock = _BenchClock()
        self.bus = EmbeddedBus(self.clock)
        self.sent: list[Frame] = []
        self.tamper: Callable[[int, bytes], bytes | None] = lambda can_id, data: data
        self.bench = Bench(load_scenario("idle", "P"), CODEC, self._deliver, clock_mode="wall")
        self.bus.attach(self._on_frame)
        self.clock.on_time = self._on_time
        self._is_synchronised = False
        self.bench.boot()
        self.tap = Tap(self.bus, self.clock)
        self.arm = Arm(self.settings, CODEC, self.tap)
        self.master = Master(self.settings, CODEC, self.tap)

    def _deliver(self, can_id: int, data: bytes) -> None:
        kept = self.tamper(can_id, data)
        if kept is not None:
            self.bus.deliver(can_id, kept)

    def _on_frame(self, frame: Frame) -> None:
        self.sent.append(frame)
        self.bench.on_frame(frame)

    def silence(self, node_id: int) -> None:
        """Take a node off the bus, its boot-up too."""
        self.tamper = lambda can_id, data: None if can_id & 0x7F == node_id else data
        self.forget()

    def forget(self) -> None:
        """Drop what waits for the host."""
        while self.bus.receive(0.0) is not None:
            pass

    def start(self) -> None:
        """Bring the nodes into operation, as a host before this one may have done."""
        self.master.reset()
        self.master.configure()
        self.master.start()
        self.sent.clear()

    def add_host(self) -> None:
        """Let another host send SYNC at 1 kHz; this one hears it."""
        self._is_synchronised = True

    def _on_time(self, t_ns: int) -> None:
        self.bench.advance_to(t_ns)
        if self._is_synchronised and t_ns % PERIOD_NS == 0:
            sync = bytes((1 + t_ns // PERIOD_NS % 240,))
            self.bus.deliver(0x080, sync)
            self.bench.on_frame(Frame(0x080, sync, t_ns))
