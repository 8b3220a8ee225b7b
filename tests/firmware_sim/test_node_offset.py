"""Two emulated arms on one bus: each watches its own host."""

from bench_host import CODEC, PERIOD_NS, Nmt, quiet_scenario

from adacd_hil.wire.bus import Frame
from adacd_hil.wire.moved_contract import move_contract
from firmware_sim.bench.bench import Bench
from firmware_sim.canopen.object_dictionary import CONTRACTS

HOSTS = (127, 126)


class SharedBus:
    """Both arms at one end."""

    def __init__(self) -> None:
        moved = [move_contract(CODEC, offset, host) for offset, host in zip((0, 4), HOSTS, strict=True)]
        contract = CONTRACTS["arm"]
        self.benches = [Bench(quiet_scenario(), one, lambda *_: None, contract=contract) for one in moved]
        for bench in self.benches:
            bench.boot()
        self.put(0x000, Nmt.START, 0)

    def put(self, can_id: int, *data: int) -> None:
        """Send a frame to all."""
        for bench in self.benches:
            bench.on_frame(Frame(can_id, bytes(data), 0))

    def pass_periods(self, count: int) -> None:
        for bench in self.benches:
            bench.advance_to(bench.now_ns + count * PERIOD_NS)


def test_each_arm_watches_its_own_host() -> None:
    bus = SharedBus()
    for node, host in zip((1, 5), HOSTS, strict=True):
        bus.put(0x600 + node, 0x23, 0x16, 0x10, 1, 100, 0, host, 0)
        bus.put(0x700 + host, 5)
    bus.pass_periods(50)
    bus.put(0x700 + HOSTS[1], 5)
    bus.pass_periods(60)
    assert [bench.devices[0].is_operational for bench in bus.benches] == [False, True]
    bus.pass_periods(60)
    assert not bus.benches[1].devices[0].is_operational
