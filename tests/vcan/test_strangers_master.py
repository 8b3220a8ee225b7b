"""A master that we did not write, the `canopen` package untouched, runs the emulated arm over real SocketCAN.

p402's own way through the states is used where it works. Where it doesn't (fault reset, canopen#261; quick stop,
canopen#167) the controlword is written directly, and a comment says so.
"""

import contextlib
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import canopen
import pytest
from canopen.profiles.p402 import BaseNode402
from hang import HANG_S

from adacd_hil.wire.can_interface import can_interfaces
from adacd_hil.wire.codec import contract_folder

pytestmark = [pytest.mark.vcan, pytest.mark.slow, pytest.mark.wallclock]

PERIOD_S = 0.01
SHUTDOWN, SWITCH_ON, ENABLE, QUICK_STOP, DISABLE_VOLTAGE, FAULT_RESET = 0x06, 0x07, 0x0F, 0x02, 0x00, 0x80
NMT_RESET_NODE = 129
SENSOR_EDS = {"arm": "torque_sensor.eds", "arm_stock": "int32_sensor.eds"}
DRIVE_EDS = {"arm": "drive.eds", "arm_stock": "stock_drive.eds"}
# By SYNC: a stall of the machine stops the arm's time too, and no watchdog mistakes it for a dead master.
EMULATOR = (sys.executable, "-m", "firmware_sim.cli.emulator_main", "run", "-i", "socketcan", "--scenario", "idle")


@contextlib.contextmanager
def emulator(channel: str, contract: str) -> Iterator[None]:
    process = subprocess.Popen([*EMULATOR, "-c", channel, "--contract", contract], stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        lines = iter(process.stderr.readline, "")
        assert any(line == "ready\n" for line in lines)
        yield
    finally:
        process.terminate()
        process.communicate(timeout=HANG_S)


class Bus(NamedTuple):
    """A channel with the emulated arm on it."""

    channel: str
    contract: str


@pytest.fixture(scope="module", params=["arm", "arm_stock"])
def bus(request: pytest.FixtureRequest) -> Iterator[Bus]:
    names = [name for name in can_interfaces() if name.startswith("vcan")]
    if not names:
        pytest.skip("no vcan interface; tools/with-vcan provides one")
    with emulator(names[0], request.param):
        yield Bus(names[0], request.param)


@contextlib.contextmanager
def connection(bus: Bus) -> Iterator[canopen.Network]:
    """Connect canopen, its nodes as at power-on."""
    network = canopen.Network()
    network.NOTIFIER_CYCLE = 0.05  # how long its thread may take to end
    network.connect(channel=bus.channel, interface="socketcan")
    try:
        network.nmt.send_command(NMT_RESET_NODE)
        yield network
        network.nmt.send_command(NMT_RESET_NODE)
    finally:
        network.disconnect()


class Rhythm:
    """SYNC with its counter and the drives' commands, every 10 ms from a thread, as a master's cycle sends them."""

    def __init__(self, network: canopen.Network) -> None:
        self.words = {1: DISABLE_VOLTAGE, 2: DISABLE_VOLTAGE}
        self.torques = {1: 0, 2: 0}
        self.commanded = {1, 2}
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
                if node.id in self.commanded:
                    node.rpdo[1][0x6040].raw = self.words[node.id]
                    node.rpdo[1][0x6071].raw = self.torques[node.id]
                    node.rpdo[1].transmit()
            self._network.sync.transmit(self.syncs % 240 + 1)
            self.syncs += 1


class Stranger:
    """canopen's network with both drives as BaseNode402, remapped and operational."""

    def __init__(self, network: canopen.Network, contract: str) -> None:
        self.network = network
        self.rhythm = Rhythm(network)
        path = str(contract_folder() / DRIVE_EDS[contract])
        self.drives = [network.add_node(BaseNode402(node_id, path)) for node_id in (1, 2)]
        for node in self.drives:
            node.sdo.RESPONSE_TIMEOUT = HANG_S

    def remap(self, node: BaseNode402) -> None:
        """Put the command into RPDO1, state and mode into TPDO1, position and velocity into TPDO2, all on SYNC."""
        node.nmt.state = "PRE-OPERATIONAL"
        node.rpdo.read()
        node.tpdo.read()
        for pdo, objects in (
            (node.rpdo[1], (0x6040, 0x6071)),
            (node.tpdo[1], (0x6041, 0x6061, 0x6077)),
            (node.tpdo[2], (0x6064, 0x606C)),
        ):
            pdo.clear()
            for index in objects:
                pdo.add_variable(index)
            pdo.trans_type = 1
            pdo.cob_id = pdo.predefined_cob_id
            pdo.enabled = True
            pdo.save()

    def start(self) -> None:
        for node in self.drives:
            self.remap(node)
            node.sdo[0x1006].raw = 0
            node.sdo[0x1019].raw = 240
            node.sdo[0x1006].raw = round(PERIOD_S * 1e6)
            if 0x2200 in node.object_dictionary:
                node.sdo[0x2200].raw = 200
            node.setup_402_state_machine(read_pdos=False)
            node.op_mode = "CYCLIC SYNCHRONOUS TORQUE"  # by SDO; waits for 0x6061
        for sensor in (3, 4):
            sdo = self.network.add_node(sensor, None).sdo
            for index, value, size in ((0x1006, 0, 4), (0x1019, 240, 1), (0x1006, round(PERIOD_S * 1e6), 4)):
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

    def wait_for(self, state: str, node: BaseNode402 | None = None) -> None:
        for waited in [node] if node is not None else self.drives:
            self.wait(lambda waited=waited: waited.state == state, state)

    def enable(self) -> None:
        """Command one step per reported state; p402's state setter sends a PDO of its own and not the torque."""
        for word, state in (
            (SHUTDOWN, "READY TO SWITCH ON"),
            (SWITCH_ON, "SWITCHED ON"),
            (ENABLE, "OPERATION ENABLED"),
        ):
            self.command(word)
            self.wait_for(state)

    def command(self, word: int) -> None:
        self.rhythm.words = {1: word, 2: word}


@pytest.fixture
def stranger(bus: Bus) -> Iterator[Stranger]:
    with connection(bus) as network:
        master = Stranger(network, bus.contract)
        try:
            yield master
        finally:
            master.rhythm.stop()


def test_the_scanner_finds_all_nodes(bus: Bus) -> None:
    with connection(bus) as network:
        nodes = {1, 2, 3, 4}
        answered: set[int] = set()
        news = threading.Condition()

        def hear(can_id: int, *_: object) -> None:
            with news:
                answered.add(can_id - 0x580)
                news.notify()

        for node in nodes:
            network.subscribe(0x580 + node, hear)
        deadline_s = time.monotonic() + HANG_S
        while set(network.scanner.nodes) != nodes:
            assert time.monotonic() < deadline_s, network.scanner.nodes
            network.scanner.search()
            with news:  # a node that still boots hears nothing, and is asked again
                news.wait_for(lambda: answered == nodes, 0.5)


def test_it_remaps_enables_and_moves_the_arm(stranger: Stranger) -> None:
    stranger.start()
    assert [node.op_mode for node in stranger.drives] == ["CYCLIC SYNCHRONOUS TORQUE"] * 2
    stranger.enable()
    before = [node.tpdo[2][0x6064].raw for node in stranger.drives]
    stranger.rhythm.torques = {1: 100, 2: -100}
    stranger.wait(lambda: stranger.drives[0].tpdo[2][0x6064].raw > before[0] + 1000, "joint 1 moves")
    stranger.wait(lambda: stranger.drives[1].tpdo[2][0x6064].raw < before[1] - 1000, "joint 2 moves")
    assert stranger.drives[0].tpdo[1][0x6077].raw == 100


def test_it_stops_quickly_and_stays_there_until_the_voltage_is_disabled(stranger: Stranger) -> None:
    stranger.start()
    for node in stranger.drives:
        node.sdo[0x605A].raw = 6
    stranger.enable()
    stranger.rhythm.torques = {1: 100, 2: 0}
    stranger.wait(lambda: abs(stranger.drives[0].tpdo[2][0x606C].raw) > 100, "joint 1 moves")
    # p402 would ask for Switch on disabled next, from which there is no way back (canopen#167).
    stranger.command(QUICK_STOP)
    stranger.wait_for("QUICK STOP ACTIVE")
    stranger.wait(lambda: abs(stranger.drives[0].tpdo[2][0x606C].raw) < 50, "joint 1 stands still")
    stranger.command(ENABLE)
    stranger.rhythm.torques = {1: 0, 2: 0}
    stranger.wait_for("OPERATION ENABLED")
    stranger.command(QUICK_STOP)
    stranger.wait_for("QUICK STOP ACTIVE")
    stranger.command(DISABLE_VOLTAGE)
    stranger.wait_for("SWITCH ON DISABLED")


def test_a_fault_by_missing_commands_is_latched_until_fault_reset(stranger: Stranger) -> None:
    stranger.start()
    first = stranger.drives[0]
    first.sdo[0x1400][5].raw = 100  # ms of the device's time, which is SYNC's
    stranger.enable()
    stranger.rhythm.commanded = {2}
    stranger.wait_for("FAULT", first)
    assert first.sdo[0x603F].raw == 0x8250
    assert stranger.drives[1].state == "OPERATION ENABLED"
    stranger.wait(lambda: any(error.code == 0x8250 for error in first.emcy.log), "EMCY")
    stranger.rhythm.commanded = {1, 2}
    stranger.rhythm.words[1] = ENABLE
    stranger.wait(lambda: any(error.code == 0 for error in first.emcy.log), "EMCY 0x0000")
    assert first.state == "FAULT"
    # p402's reset_from_fault waits for the state before it makes the rising edge (canopen#261).
    stranger.rhythm.words[1] = FAULT_RESET
    stranger.wait_for("SWITCH ON DISABLED", first)
    stranger.enable()


ABORTS = [
    (0x5FFF, 0, b"", 0x06020000),
    (0x6041, 0, b"\0\0", 0x06010002),
    (0x1018, 9, b"", 0x06090011),
    (0x6040, 0, b"\0", 0x06070010),
    (0x6060, 0, b"\x08", 0x06090030),
]


def test_sdo_aborts_are_right(bus: Bus) -> None:
    with connection(bus) as network:
        node = network.add_node(1, str(contract_folder() / DRIVE_EDS[bus.contract]))
        node.sdo.RESPONSE_TIMEOUT = HANG_S
        for index, sub, data, code in ABORTS:
            with pytest.raises(canopen.SdoAbortedError) as aborted:
                _ = node.sdo.download(index, sub, data) if data else node.sdo.upload(index, sub)
            assert (index, hex(aborted.value.code)) == (index, hex(code))


def test_a_sensors_mapping_is_read_and_the_stock_sensors_can_not_be_written(bus: Bus) -> None:
    with connection(bus) as network:
        sensor = network.add_node(3, str(contract_folder() / SENSOR_EDS[bus.contract]))
        sensor.sdo.RESPONSE_TIMEOUT = HANG_S
        sensor.tpdo.read()
        assert [variable.index for variable in sensor.tpdo[1]][-1] == 0x9130
        if bus.contract == "arm_stock":
            with pytest.raises(canopen.SdoAbortedError) as aborted:
                sensor.sdo.download(0x1A00, 0, b"\0")
            assert aborted.value.code == 0x06010002
