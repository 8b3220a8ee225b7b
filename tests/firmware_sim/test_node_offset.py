"""Two emulated arms on one bus: each answers for its own nodes only."""

import pytest
from bench_host import PERIOD_NS, Nmt, quiet_scenario

from adacd_hil.wire.bus import Frame
from adacd_hil.wire.dbc_contract import load_codec
from adacd_hil.wire.moved_contract import move_contract
from firmware_sim.bench.bench import Bench
from firmware_sim.canopen.object_dictionary import CONTRACTS

OFFSETS = (0, 4)
NODES = ((1, 2, 3, 4), (5, 6, 7, 8))
HOSTS = (127, 126)


class SharedBus:
    """Both arms at one end; `frames` is what each has sent since the last look."""

    def __init__(self, contract: str = "arm") -> None:
        codec = load_codec(CONTRACTS[contract].path)
        self.codecs = [move_contract(codec, *place) for place in zip(OFFSETS, HOSTS, strict=True)]
        self.frames: tuple[list[tuple[int, bytes]], ...] = ([], [])
        self.benches = [
            Bench(quiet_scenario(), codec, self._send(arm), contract=CONTRACTS[contract])
            for arm, codec in enumerate(self.codecs)
        ]
        self.t_ns = 0
        for bench in self.benches:
            bench.boot()

    def _send(self, arm: int):
        return lambda can_id, data: self.frames[arm].append((can_id, bytes(data)))

    def put(self, can_id: int, *data: int) -> list[list[tuple[int, bytes]]]:
        """Send a frame to all and return what each arm answers."""
        for frames in self.frames:
            frames.clear()
        for bench in self.benches:
            bench.on_frame(Frame(can_id, bytes(data), self.t_ns))
        return [frames[:] for frames in self.frames]

    def ids(self, can_id: int, *data: int) -> list[list[int]]:
        return [[answer_id for answer_id, _ in frames] for frames in self.put(can_id, *data)]


@pytest.mark.parametrize("contract", ["arm", "arm_fd"])
def test_one_sync_is_answered_by_both_arms_at_their_own_identifiers(contract: str) -> None:
    bus = SharedBus(contract)
    bus.put(0x000, Nmt.START, 0)
    bus.ids(0x080, 1)
    first, second = bus.ids(0x080, 2)
    assert first == [0x181, 0x182, 0x183, 0x184]
    assert second == [0x185, 0x186, 0x187, 0x188]


def test_each_arm_watches_its_own_host() -> None:
    bus = SharedBus()
    bus.put(0x000, Nmt.START, 0)
    for node, host in ((1, 127), (5, 126)):
        bus.put(0x600 + node, 0x23, 0x16, 0x10, 1, 100, 0, host, 0)
    for can_id in (0x77F, 0x77E):
        bus.put(can_id, 5)
    bus.t_ns += 50 * PERIOD_NS
    for bench in bus.benches:
        bench.advance_to(bus.t_ns)
    bus.put(0x77E, 5)
    for bench in bus.benches:
        bench.advance_to(bus.t_ns + 60 * PERIOD_NS)
    assert [bench.devices[0].is_operational for bench in bus.benches] == [False, True]
    bus.benches[1].advance_to(bus.t_ns + 120 * PERIOD_NS)
    assert not bus.benches[1].devices[0].is_operational
