"""Two emulated arms on one bus: each answers for its own nodes only."""

import pytest
from bench_host import PERIOD_NS, Nmt, quiet_scenario

from adacd_hil.wire.bus import Frame
from adacd_hil.wire.dbc_contract import load_codec
from adacd_hil.wire.moved_contract import move_contract
from firmware_sim.bench.bench import Bench
from firmware_sim.canopen.object_dictionary import CONTRACTS

HOSTS = (127, 126)


class SharedBus:
    """Both arms at one end."""

    def __init__(self, contract: str = "arm") -> None:
        self.sent: list[int] = []
        codec, played = load_codec(CONTRACTS[contract].path), CONTRACTS[contract]
        moved = [move_contract(codec, offset, host) for offset, host in zip((0, 4), HOSTS, strict=True)]
        self.benches = [Bench(quiet_scenario(), one, self._hear, contract=played) for one in moved]
        for bench in self.benches:
            bench.boot()
        self.put(0x000, Nmt.START, 0)

    def _hear(self, can_id: int, data: bytes) -> None:
        self.sent.append(can_id)

    def put(self, can_id: int, *data: int) -> list[int]:
        """Send a frame to all and return the identifiers of the answers."""
        self.sent.clear()
        for bench in self.benches:
            bench.on_frame(Frame(can_id, bytes(data), 0))
        return self.sent[:]

    def pass_periods(self, count: int) -> None:
        for bench in self.benches:
            bench.advance_to(bench.now_ns + count * PERIOD_NS)


@pytest.mark.parametrize("contract", ["arm", "arm_fd"])
def test_one_sync_is_answered_by_both_arms_at_their_own_identifiers(contract: str) -> None:
    bus = SharedBus(contract)
    bus.put(0x080, 1)
    assert bus.put(0x080, 2) == list(range(0x181, 0x189))


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
