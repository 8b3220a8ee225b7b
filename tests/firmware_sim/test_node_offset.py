"""Two emulated arms on one bus: each answers for its own nodes only."""

import canopen
import pytest
from bench_host import PERIOD_NS, Nmt, quiet_scenario

from adacd_hil.wire.bus import Frame
from adacd_hil.wire.dbc_contract import contract_folder, load_codec
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

    def answers(self, can_id: int, *data: int) -> list[tuple[int, bytes]]:
        first, second = self.put(can_id, *data)
        return first + second

    def states(self) -> list[list[bool]]:
        return [[device.is_operational for device in bench.devices] for bench in self.benches]


def test_nmt_to_one_node_addresses_no_other_arm() -> None:
    bus = SharedBus()
    announced = [[can_id for can_id, _ in frames] for frames in bus.frames]
    assert announced == [[0x700 + node for node in nodes] for nodes in NODES]
    bus.put(0x000, Nmt.START, 6)
    assert bus.states() == [[False] * 4, [False, True, False, False]]
    assert bus.ids(0x000, Nmt.RESET_COMMUNICATION, 7) == [[], [0x707]]


@pytest.mark.parametrize("contract", ["arm", "arm_fd"])
def test_one_sync_is_answered_by_both_arms_at_their_own_identifiers(contract: str) -> None:
    bus = SharedBus(contract)
    bus.put(0x000, Nmt.START, 0)
    bus.ids(0x080, 1)
    first, second = bus.ids(0x080, 2)
    assert first == [0x181, 0x182, 0x183, 0x184]
    assert second == [0x185, 0x186, 0x187, 0x188]


def test_a_request_is_answered_by_its_own_node_only() -> None:
    bus = SharedBus()
    assert bus.ids(0x603, 0x40, 0x00, 0x10, 0, 0, 0, 0, 0) == [[0x583], []]
    assert bus.ids(0x607, 0x40, 0x00, 0x10, 0, 0, 0, 0, 0) == [[], [0x587]]


def test_the_defaults_of_the_object_dictionary_follow_the_node_id() -> None:
    bus = SharedBus()
    objects = canopen.import_od(str(contract_folder() / "drive.eds"), 5)
    for index, sub in ((0x1014, 0), (0x1400, 1), (0x1800, 1), (0x1801, 1)):
        ((_, answer),) = bus.answers(0x605, 0x40, index & 0xFF, index >> 8, sub, 0, 0, 0, 0)
        default = objects.get_variable(index, sub).default
        assert default & 0x7F == 5
        assert int.from_bytes(answer[4:], "little") == default


def test_a_command_reaches_its_own_arm_only() -> None:
    bus = SharedBus()
    bus.put(0x000, Nmt.START, 0)
    bus.put(0x080, 1)
    message = bus.codecs[1].message("Drive1Command")
    sender = message.sender()
    before = [bench.drives[0].state for bench in bus.benches]
    for counter in (2, 3, 4):
        bus.put(message.can_id, *sender.protect(message.encode(6, 0)))
        bus.put(0x080, counter)
    after = [bench.drives[0].state for bench in bus.benches]
    assert after[0] is before[0]
    assert after[1] is not before[1]


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
