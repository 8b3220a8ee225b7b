"""python-canopen's BaseNode402, untouched, drives drives of the shelf through torque mode: with and without a counter.

Time goes by the clock, and nobody tells the drives the period of SYNC, as a master of another arm doesn't either.
"""

import contextlib
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import canopen
import pytest
from canopen.profiles.p402 import BaseNode402
from hang import HANG_S

from adacd_hil.wire.can_interface import can_interfaces
from adacd_hil.wire.codec import contract_folder

pytestmark = [pytest.mark.vcan, pytest.mark.slow, pytest.mark.wallclock]

DRIVES = {"stock-drive": "stock_drive.eds", "maxon-epos4": "maxon_epos4.eds", "zeroerr-erob": "zeroerr_erob.eds"}
ARM = """
extends = "certified"
[arm]
link_length_m = [0.4, 0.25]
[devices]
drive = ["{0}", "{0}"]
sensor = ["int32-sensor", "int32-sensor"]
contract = ""
"""
SYNC_S = 0.01
OVERFLOW = 240
TORQUE_MODE, ENABLED, DISABLED = "CYCLIC SYNCHRONOUS TORQUE", "OPERATION ENABLED", "SWITCH ON DISABLED"


@pytest.fixture(scope="module", params=DRIVES)
def emulated(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Path]]:
    """The channel of an arm with two drives of a maker, and their EDS."""
    names = [name for name in can_interfaces() if name.startswith("vcan")]
    if not names:
        pytest.skip("no vcan interface; tools/with-vcan provides one")
    config = tmp_path_factory.mktemp("arm") / "arm.toml"
    config.write_text(ARM.format(request.param))
    command = [sys.executable, "-m", "firmware_sim.cli.emulator_main", "run", "-i", "socketcan", "-c", names[0]]
    command += ["--scenario", "idle", "--clock", "wall", "--config", str(config)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            assert any(line == "ready\n" for line in process.stderr)
            yield names[0], contract_folder() / DRIVES[request.param]
        finally:
            process.terminate()
            process.communicate(timeout=HANG_S)


@contextlib.contextmanager
def connected(channel: str) -> Iterator[canopen.Network]:
    """Connect canopen, its nodes as at power-on."""
    network = canopen.Network()
    network.NOTIFIER_CYCLE = 0.05  # how long its thread may take to end
    network.connect(channel=channel, interface="socketcan")
    try:
        yield network
    finally:
        network.nmt.send_command(129)
        network.disconnect()


@contextlib.contextmanager
def syncs(network: canopen.Network, is_counted: bool) -> Iterator[None]:
    """Send SYNC every 10 ms from a thread."""
    end = threading.Event()

    def send() -> None:
        count = 0
        while not end.wait(SYNC_S):
            network.sync.transmit(count % OVERFLOW + 1 if is_counted else None)
            count += 1

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield
    finally:
        end.set()
        thread.join()


def add_drive(network: canopen.Network, node_id: int, eds: Path) -> BaseNode402:
    """Add a drive with patience for a machine that stalls."""
    node = network.add_node(BaseNode402(node_id, str(eds)))
    node.sdo.RESPONSE_TIMEOUT = HANG_S
    for name in ("SWITCH_OP_MODE", "SWITCH_STATE_FINAL", "SWITCH_STATE_SINGLE", "CHECK_TPDO"):
        setattr(node, f"TIMEOUT_{name}", HANG_S)
    node.nmt.state = "PRE-OPERATIONAL"
    return node


def remap(node: BaseNode402) -> None:
    """Put state and mode into TPDO1, on SYNC, and the command into RPDO1."""
    node.pdo.read()
    for pdo, objects, kind in ((node.tpdo[1], (0x6041, 0x6061), 1), (node.rpdo[1], (0x6040, 0x6071), 255)):
        pdo.clear()
        for index in objects:
            pdo.add_variable(index)
        pdo.trans_type = kind
        pdo.enabled = True
        pdo.save()


@pytest.mark.parametrize("is_counted", [False, True])
def test_a_stranger_drives_it_through_torque_mode(emulated: tuple[str, Path], is_counted: bool) -> None:
    channel, eds = emulated
    with connected(channel) as network:
        drives = [add_drive(network, node_id, eds) for node_id in (1, 2)]
        for node in drives:
            remap(node)
            if is_counted and 0x1019 in node.object_dictionary:
                node.sdo[0x1019].raw = OVERFLOW
            node.setup_402_state_machine()
        with syncs(network, is_counted):
            network.nmt.state = "OPERATIONAL"
            for node in drives:
                node.op_mode = TORQUE_MODE
                node.state = ENABLED
                assert (node.op_mode, node.state) == (TORQUE_MODE, ENABLED)
            first = drives[0]
            began = first.sdo[0x6064].raw
            first.rpdo[1][0x6071].raw = 50
            first.rpdo[1].transmit()
            for _ in range(20):
                first.tpdo[1].wait_for_reception(HANG_S)
            assert first.sdo[0x6077].raw == 50
            assert first.sdo[0x6064].raw > began + 10
            for node in drives:
                node.state = DISABLED
                assert node.state == DISABLED


def test_a_statusword_by_event_is_sent_on_change(emulated: tuple[str, Path]) -> None:
    channel, eds = emulated
    with connected(channel) as network:
        node = add_drive(network, 1, eds)
        remap(node)
        pdo = node.tpdo[1]
        pdo.trans_type = 255
        pdo.save()
        heard: list[int] = []
        news = threading.Condition()

        def hear(_: int, data: bytearray, __: float) -> None:
            with news:
                heard.append(int.from_bytes(data, "little") & 0x6F)
                news.notify()

        network.subscribe(pdo.cob_id, hear)
        with syncs(network, False):
            network.nmt.state = "OPERATIONAL"
            for word, state in ((6, 0x21), (7, 0x23), (6, 0x21), (0, 0x40)):
                with news:
                    heard.clear()
                    node.rpdo[1][0x6040].raw = word
                    node.rpdo[1].transmit()
                    assert news.wait_for(lambda wanted=state: wanted in heard, HANG_S), (hex(word), heard)
