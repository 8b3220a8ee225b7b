"""A host for tests of the emulated devices: frames by hand, SDO by canopen, virtual time, no threads."""

import struct
from enum import IntEnum
from functools import cache, cached_property
from typing import Any

import canopen
import numpy as np

from adacd_hil.log.types.truth_topic import TRUTH_LAYOUT
from adacd_hil.settings.parsing import parse
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.dbc_contract import contract_folder, load_codec
from firmware_sim.arm.sensing import DriveMode
from firmware_sim.bench.bench import Bench
from firmware_sim.canopen.object_dictionary import CONTRACTS
from firmware_sim.scenario.scenario import Scenario

CODEC = load_codec()
EDS = {1: "drive.eds", 2: "drive.eds", 3: "torque_sensor.eds", 4: "torque_sensor.eds"}
PERIOD_NS = 1_000_000
INVALID = 1 << 31
"""Bit of a COB-ID."""


class Nmt(IntEnum):
    """Commands of NMT."""

    START, STOP, PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 1, 2, 128, 129, 130


class Word(IntEnum):
    """Controlwords by command."""

    SHUTDOWN, SWITCH_ON, ENABLE = 0x06, 0x07, 0x0F
    DISABLE_VOLTAGE, QUICK_STOP, FAULT_RESET = 0x00, 0x02, 0x80


class State(IntEnum):
    """Bits 0 to 3, 5 and 6 of the statusword by state, from the standard's table; x in the table is 0 here."""

    DISABLED, READY, SWITCHED_ON, ENABLED = 0x40, 0x21, 0x23, 0x27
    STOPPING, REACTION, FAULT = 0x07, 0x0F, 0x08


ENABLING = (Word.SHUTDOWN, Word.SWITCH_ON, Word.ENABLE)


def quiet_scenario(**changes: Any) -> Scenario:
    """Nobody touches the arm; no noise unless asked for."""
    return parse(Scenario, {"name": "test", "noise": False} | changes)


@cache
def _dictionary(node: int, contract: str) -> canopen.ObjectDictionary:
    """Read the EDS of a node; the client's side never changes it."""
    file = CONTRACTS[contract].drive_eds if node <= 2 else CONTRACTS[contract].sensor_eds
    return canopen.import_od(str(contract_folder() / file), node)


class _ClientNetwork(canopen.Network):
    """Delivers to the bench and feeds its replies back before `send_message` returns."""

    def __init__(self, host: "BenchHost") -> None:
        super().__init__()
        self._host = host

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        before = len(self._host.frames)
        self._host.put(can_id, data)
        for reply_id, reply in self._host.frames[before:]:
            self.notify(reply_id, bytearray(reply), 0.0)


class BenchHost:
    """Host's end of a bench. `frames`: everything the devices sent, oldest first."""

    def __init__(
        self,
        scenario: Scenario | None = None,
        clock_mode: str = "sync",
        contract: str = "arm",
    ) -> None:
        codec = CODEC if contract == "arm" else load_codec(CONTRACTS[contract].path)
        self.contract = contract
        self.frames: list[tuple[int, bytes]] = []
        self.truths: list[tuple[int, int, np.ndarray]] = []
        self.bench = Bench(
            scenario or quiet_scenario(),
            codec,
            lambda can_id, data: self.frames.append((can_id, data)),
            clock_mode=clock_mode,
            on_truth=lambda cycle, t_ns, block: self.truths.append((cycle, t_ns, block.copy())),
        )
        self.t_ns = 0
        self.cycle = 0
        self.senders = {joint: CODEC.message(f"Drive{joint}Command").sender() for joint in (1, 2)}
        self.bench.boot()

    @cached_property
    def nodes(self) -> dict[int, canopen.RemoteNode]:
        """canopen's own view of the devices."""
        network = _ClientNetwork(self)
        return {n: network.add_node(n, _dictionary(n, self.contract)) for n in EDS}

    def put(self, can_id: int, data: bytes) -> None:
        self.bench.on_frame(Frame(can_id, bytes(data), self.t_ns))

    def take(self) -> list[tuple[int, bytes]]:
        """Return what came since the last call."""
        taken = self.frames[:]
        self.frames.clear()
        return taken

    def taken(self, can_id: int) -> list[bytes]:
        """Return the frames with one identifier that came since the last `take`, and take everything."""
        return [data for got_id, data in self.take() if got_id == can_id]

    def nmt(self, command: int, node: int = 0) -> None:
        self.put(0x000, bytes([command, node]))

    def read(self, node: int, index: int, sub: int = 0) -> int:
        data = self.nodes[node].sdo.upload(index, sub)
        variable = self.nodes[node].object_dictionary.get_variable(index, sub)
        return variable.decode_raw(data)

    def write(self, node: int, index: int, sub: int, value: int) -> None:
        variable = self.nodes[node].object_dictionary.get_variable(index, sub)
        self.nodes[node].sdo.download(index, sub, variable.encode_raw(value))

    def abort_code(self, action: Any) -> int:
        """Run an SDO transfer that must be aborted; return the code."""
        try:
            action()
        except canopen.SdoAbortedError as error:
            return error.code
        raise AssertionError("the transfer was not aborted")

    def command_frame(self, joint: int, controlword: int, target: int = 0) -> bytes:
        """Make the next protected command frame of a joint."""
        return self.senders[joint].protect(bytearray(2) + struct.pack("<Hh", controlword, target))

    def command(self, controlword: int, target: int = 0, joints: tuple[int, ...] = (1, 2)) -> None:
        for joint in joints:
            self.put(0x200 + joint, self.command_frame(joint, controlword, target))

    def sync(self, times: int = 1) -> None:
        """Send the next SYNC; time moves by one period."""
        for _ in range(times):
            self.t_ns += PERIOD_NS
            self.put(0x080, bytes([1 + self.cycle % 240]))
            self.cycle += 1

    def step(self, controlword: int, target: int = 0, joints: tuple[int, ...] = (1, 2), times: int = 1) -> None:
        """Command, then SYNC, so that the command acts at this SYNC."""
        for _ in range(times):
            self.command(controlword, target, joints)
            self.sync()

    def start(self, mode: int = 10) -> None:
        """Choose the mode and enter Operational."""
        for joint in (1, 2):
            self.write(joint, 0x6060, 0, mode)
        self.nmt(Nmt.START)

    def enable(self, mode: int = 10) -> None:
        """Bring both drives to Operation enabled."""
        self.start(mode)
        for controlword in ENABLING:
            self.step(controlword)

    def statusword(self, joint: int = 1) -> int:
        return self.read(joint, 0x6041)

    def state_bits(self, joint: int = 1) -> int:
        """The statusword's bits that name the state, bit 5 (quick stop) included."""
        return self.statusword(joint) & 0x6F

    def emergencies(self, node: int = 1) -> list[tuple[int, int, int, int]]:
        """Take everything; return code, register, watchdog and ms of one node's EMCYs."""
        return [struct.unpack("<HBBI", data) for data in self.taken(0x080 + node)]

    def true(self, name: str) -> np.ndarray:
        """A field of the latest truth block."""
        return self.truths[-1][2][TRUTH_LAYOUT.slices[name]]

    def history(self, name: str) -> np.ndarray:
        """A field of all truth blocks."""
        return np.array([block[TRUTH_LAYOUT.slices[name]] for _, _, block in self.truths])

    def wait_until_at_rest(self, controlword: int | None = Word.ENABLE) -> None:
        """Send SYNCs, with commands or without, until no drive has braked for 20 of them."""
        count = last = 0
        while count - last < 20:
            assert count < 1100
            if controlword is not None:
                self.command(controlword)
            self.sync()
            count += 1
            if any(drive.motor_mode > DriveMode.TORQUE for drive in self.bench.drives):
                last = count


def remap(
    host: BenchHost, node: int, record: int, entries: tuple[int, ...], *, can_id: int, kind: int = 1, timer_ms: int = 0
) -> None:
    """Write a PDO's records in the order that CiA 301 asks for."""
    host.write(node, record, 1, INVALID | can_id)
    host.write(node, record, 2, kind)
    host.write(node, record, 5, timer_ms)
    host.write(node, record + 0x200, 0, 0)
    for sub, value in enumerate(entries, start=1):
        host.write(node, record + 0x200, sub, value)
    host.write(node, record + 0x200, 0, len(entries))
    host.write(node, record, 1, can_id)


def remap_mode(host: BenchHost) -> None:
    """Let RPDO2 of drive 1 bring the mode of operation, at once; `set_mode` sends it."""
    remap(host, 1, 0x1401, (0x60600008,), can_id=0x301, kind=255)


def set_mode(host: BenchHost, mode: int) -> None:
    """Send the mode of operation to drive 1."""
    host.put(0x301, bytes([mode]))


def moving_host(
    torque: int = 300,
    times: int = 40,
    clock_mode: str = "sync",
    objects: dict[tuple[int, int, int], int] | None = None,
    **scenario: Any,
) -> BenchHost:
    """Enable an arm and move it for so many SYNCs. `objects`: value by node, index and sub-index, written before."""
    host = BenchHost(quiet_scenario(**scenario), clock_mode=clock_mode)
    for place, value in (objects or {}).items():
        host.write(*place, value)
    host.enable()
    host.step(Word.ENABLE, torque, times=times)
    host.take()
    return host


def in_state(bits: int) -> BenchHost:
    """Bring both drives to a state; quick stop stays, and braking takes more than one period."""
    host = BenchHost()
    for node in (1, 2):
        host.write(node, 0x605A, 0, 6)
        host.write(node, 0x1016, 1, 127 << 16 | 250)
        host.write(node, 0x1017, 0, 100)
    host.start()
    words = {State.DISABLED: (), State.READY: (Word.SHUTDOWN,), State.SWITCHED_ON: (Word.SHUTDOWN, Word.SWITCH_ON)}
    for word in words.get(bits, ENABLING):
        host.step(word)
    if bits in (State.STOPPING, State.REACTION):
        host.step(Word.ENABLE, 300, times=30)
    if bits == State.STOPPING:
        host.step(Word.QUICK_STOP)
    host.sync(times={State.REACTION: 3, State.FAULT: 20}.get(bits, 0))
    assert host.state_bits() == bits
    return host
