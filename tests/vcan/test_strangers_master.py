"""A master that we did not write, the `canopen` package untouched, runs the emulated arm over real SocketCAN.

The drives' states, stops and faults, as bare frames and canopen's client see them, are tested in tests/firmware_sim.
"""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import canopen
import pytest
from canopen.profiles.p402 import BaseNode402
from experiment_runs import emulator
from hang import HANG_S

from adacd_hil.wire.dbc_contract import contract_folder

pytestmark = [pytest.mark.vcan, pytest.mark.slow, pytest.mark.wallclock]

PERIOD_S = 0.01
OVERFLOW = 240
SHUTDOWN, SWITCH_ON, ENABLE, DISABLE_VOLTAGE = 0x06, 0x07, 0x0F, 0x00
TORQUE_MODE = "CYCLIC SYNCHRONOUS TORQUE"
NMT_RESET_NODE = 129
CONTRACTS = {"arm": "drive.eds", "arm_stock": "stock_drive.eds"}


@contextlib.contextmanager
def connection() -> Iterator[canopen.Network]:
    """Connect canopen to nodes as at power-on."""
    network = canopen.Network()
    network.NOTIFIER_CYCLE = 0.05  # how long its thread may take to end
    network.connect(channel="vcan0", interface="socketcan")
    try:
        network.nmt.send_command(NMT_RESET_NODE)
        yield network
        network.nmt.send_command(NMT_RESET_NODE)
    finally:
        network.disconnect()


Mapping = tuple[canopen.pdo.PdoMap, tuple[int, ...], int]
"""A PDO, the objects that are mapped into it, and its transmission type."""


def remap(node: BaseNode402, *mappings: Mapping) -> None:
    node.pdo.read()
    for pdo, objects, kind in mappings:
        pdo.clear()
        for index in objects:
            pdo.add_variable(index)
        pdo.trans_type = kind
        pdo.cob_id = pdo.predefined_cob_id
        pdo.enabled = True
        pdo.save()


class Rhythm:
    """SYNC with its counter and the drives' commands, every 10 ms from a thread, as a master's cycle sends them."""

    def __init__(self, network: canopen.Network) -> None:
        self.word = DISABLE_VOLTAGE
        self.torques = {1: 0, 2: 0}
        self.syncs = 0
        self._network = network
        self._nodes: list[BaseNode402] = []
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def begin(self, nodes: list[BaseNode402]) -> None:
        self._nodes = nodes
        self._thread.start()

    def stop(self) -> None:
        self._end.set()
        if self._thread.ident is not None:
            self._thread.join()

    def _run(self) -> None:
        while not self._end.wait(PERIOD_S):
            for node in self._nodes:
                node.rpdo[1][0x6040].raw = self.word
                node.rpdo[1][0x6071].raw = self.torques[node.id]
                node.rpdo[1].transmit()
            self._network.sync.transmit(self.syncs % OVERFLOW + 1)
            self.syncs += 1


class Stranger:
    """canopen's network with both drives as BaseNode402, remapped and operational."""

    def __init__(self, network: canopen.Network, eds: Path) -> None:
        self.network = network
        self.rhythm = Rhythm(network)
        self.drives = [network.add_node(BaseNode402(node_id, str(eds))) for node_id in (1, 2)]
        for node in self.drives:
            node.sdo.RESPONSE_TIMEOUT = HANG_S

    def start(self) -> None:
        for node in self.drives:
            node.nmt.state = "PRE-OPERATIONAL"
            # the command in RPDO1, state and mode in TPDO1, position and velocity in TPDO2, all on SYNC
            states, motion = (0x6041, 0x6061, 0x6077), (0x6064, 0x606C)
            mappings = (node.rpdo[1], (0x6040, 0x6071), 1), (node.tpdo[1], states, 1), (node.tpdo[2], motion, 1)
            remap(node, *mappings)
            node.sdo[0x1006].raw = 0
            node.sdo[0x1019].raw = OVERFLOW
            node.sdo[0x1006].raw = round(PERIOD_S * 1e6)
            if 0x2200 in node.object_dictionary:
                node.sdo[0x2200].raw = 200
            node.setup_402_state_machine(read_pdos=False)
            node.op_mode = TORQUE_MODE  # by SDO; waits for 0x6061
        for sensor in (3, 4):
            sdo = self.network.add_node(sensor, None).sdo
            for index, value, size in ((0x1006, 0, 4), (0x1019, OVERFLOW, 1), (0x1006, round(PERIOD_S * 1e6), 4)):
                sdo.download(index, 0, value.to_bytes(size, "little"))
        self.rhythm.begin(self.drives)
        self.network.nmt.state = "OPERATIONAL"

    def wait(self, is_true: Callable[[], bool], what: str) -> None:
        """Wait for what the bus has to bring."""
        deadline_s = time.monotonic() + HANG_S
        while not is_true():
            assert time.monotonic() < deadline_s, (
                f"{what}: {[(node.state, hex(node.statusword)) for node in self.drives]}"
            )
            self.drives[0].tpdo[1].wait_for_reception(0.1)

    def enable(self) -> None:
        """Command one step per reported state; p402's state setter sends a PDO of its own and not the torque."""
        for word, state in (
            (SHUTDOWN, "READY TO SWITCH ON"),
            (SWITCH_ON, "SWITCHED ON"),
            (ENABLE, "OPERATION ENABLED"),
        ):
            self.rhythm.word = word
            self.wait(lambda wanted=state: {node.state for node in self.drives} == {wanted}, state)


@pytest.fixture(params=CONTRACTS)
def stranger(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Stranger]:
    """A master of the arm on vcan0, whose time is SYNC's: no watchdog takes a stalled machine for a dead master."""
    with emulator(tmp_path, "--scenario", "idle", "--contract", request.param), connection() as network:
        master = Stranger(network, contract_folder() / CONTRACTS[request.param])
        try:
            yield master
        finally:
            master.rhythm.stop()


def test_it_remaps_enables_and_moves_the_arm(stranger: Stranger) -> None:
    stranger.start()
    assert [node.op_mode for node in stranger.drives] == [TORQUE_MODE] * 2
    stranger.enable()
    before = [node.tpdo[2][0x6064].raw for node in stranger.drives]
    stranger.rhythm.torques = {1: 100, 2: -100}
    stranger.wait(lambda: stranger.drives[0].tpdo[2][0x6064].raw > before[0] + 1000, "joint 1 moves")
    stranger.wait(lambda: stranger.drives[1].tpdo[2][0x6064].raw < before[1] - 1000, "joint 2 moves")
    assert stranger.drives[0].tpdo[1][0x6077].raw == 100
