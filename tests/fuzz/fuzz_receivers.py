"""What takes frames, each with an independent witness of what it may do with them. A violation is an AssertionError.

What is promised, and what can't be. A receiver never raises; a frame that fails its check changes nothing; without an
enable sequence in valid frames no drive is enabled, and without Operation enabled there is no torque. The check itself
is a CRC-8 with a 4-bit counter: of random bytes in the right length on a command's identifier one in 256 passes the CRC
and 3 in 16 of those the counter, so 1 in 1365 is taken as a command. Enabling takes three commands in order with none
that leads back in between: Shutdown, 1/16 of all controlwords; then one with the low bits 111, 1/16, before one that
disables, 3/8: 1/7; then Enable operation, 1/32, before Disable voltage, Quick stop or Shutdown, 7/16: 1/15. That is one
enabling per 1680 accepted commands, 2.3 million such frames on one drive. Protection makes it rare, not impossible.
So the witness judges causes: each step upward must have been asked for, in that very period, by a frame whose CRC an
implementation that isn't ours finds right, or by an SDO write of 0x6040, which CiA 402 allows and CRCs don't cover.
"""

import logging
import struct

import numpy as np
from cantools.autosar.end_to_end import compute_profile2_crc
from fuzz_frames import CanFrame

from adacd_hil.clock import VirtualClock
from adacd_hil.device.arm import Arm
from adacd_hil.device.device_files import place_devices
from adacd_hil.device.network import Master
from adacd_hil.records import ArmCommand, Request, SchemeState
from adacd_hil.scheme.pipeline.new_pipeline import new_pipeline
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.codec import MessageCodec
from adacd_hil.wire.dbc_contract import load_codec
from adacd_hil.wire.embedded_bus import EmbeddedBus
from firmware_sim.arm.sensing import DriveMode
from firmware_sim.bench.bench import Bench
from firmware_sim.nodes.drive_profile import DriveState
from firmware_sim.scenario.scenario import load_scenario

CODEC = load_codec()


def has_right_crc(message: MessageCodec, data: bytes) -> bool:
    """Judge a Profile 2 frame by cantools."""
    return len(data) == message.length and data[0] == compute_profile2_crc(data, message.data_ids[data[1] & 0x0F])


_MAY_RUN = (SchemeState.INIT, SchemeState.COMMISSION, SchemeState.FAULT)
FRAMES_PER_CYCLE = 16


class HostReceiver:
    """The host: arm, master and scheme, with a cycle every 16 frames; nothing but fuzz answers its SYNC."""

    def __init__(self) -> None:
        settings = load_settings("paper")
        bus = EmbeddedBus(VirtualClock())
        self._sent: list[Frame] = []
        bus.attach(self._sent.append)
        self.arm = Arm(settings, CODEC, place_devices(settings), bus)
        self._master = Master(settings, CODEC, place_devices(settings), bus)
        self._pipeline = new_pipeline(settings)
        self._pipeline.compile_cycle()
        self._owner = {}
        for device in (*self.arm.drives, *self.arm.sensors):
            prefix = device.name
            self._owner |= {m.can_id: m for name, m in CODEC.messages.items() if name.startswith(prefix)}
        self._zero = np.zeros(2)
        self._left = 0
        self.cycles = self.changes = self.wrong_enables = 0

    def take(self, frame: CanFrame) -> None:
        """Take a frame as the loop does; a change must come from a frame that passes its check."""
        if self._left == 0:
            self._cycle()
        self._left -= 1
        before = self._values()
        taken = Frame(frame[0], frame[1], 0)
        if not self.arm.accept(taken):
            self._master.accept(taken)
        if self._values() != before:
            self.changes += 1
            self._explain(frame)

    def _values(self) -> tuple[object, ...]:
        drives = tuple((*d.values, d.sample_cycle, d.state, d.mode) for d in self.arm.drives)
        return drives + tuple((*s.values, s.sample_cycle, s.status) for s in self.arm.sensors)

    def _explain(self, frame: CanFrame) -> None:
        can_id, data = frame
        message = self._owner.get(can_id)
        assert message is not None, f"0x{can_id:03X} changed a value"
        assert len(data) == message.length, f"{message.name} of {len(data)} bytes changed a value"
        assert not message.is_protected or has_right_crc(message, data), f"{message.name} {data.hex()} changed a value"

    def _cycle(self) -> None:
        """End one cycle and begin the next; the scheme must not have asked for the drives, the wire shows no torque."""
        self._left = FRAMES_PER_CYCLE
        arm = self.arm
        if self.cycles:
            output = self._pipeline.step(arm.state(), Request.NONE)
            assert output.state in _MAY_RUN, f"cycle {arm.cycle}: {output.state.name}"
            self._sent.clear()
            is_faulted = output.state is SchemeState.FAULT
            arm.send_command(ArmCommand(np.array((5.0, -3.0)), enable=False, quick_stop=is_faulted))
            for sent in self._sent:
                word, torque = CODEC.by_id[sent.can_id].decode_values(sent.data)
                assert (word, torque) == (0x0002 if is_faulted else 0x0000, 0.0)
            self._ask_for_torque()
            self._master.take_events()
        arm.synchronise(self.cycles, self.cycles * 1_000_000, 1)
        self.cycles += 1

    def _ask_for_torque(self) -> None:
        """Ask for torque as an enabling scheme would: only a drive that is reported enabled may get it.

        The drive's status frame has no end-to-end header on classic CAN, so a forged one is believed; the drive itself
        goes by its own state.
        """
        for drive in self.arm.drives:
            frame = drive.command(500, enable=True, quick_stop=False)
            _, torque = CODEC.by_id[drive.command_id].decode_values(frame)
            assert torque == (500.0 if drive.is_enabled else 0.0)
            self.wrong_enables += drive.is_enabled

    @property
    def summary(self) -> str:
        """Say what was counted."""
        implausible = sum(drive.implausible_frames for drive in self.arm.drives)
        bad = sum(sum(sensor.end_to_end.counts[2:]) for sensor in self.arm.sensors)
        return (
            f"host: {self.cycles} cycles, {self.changes} changes, all by frames that pass their check; "
            f"dropped: {implausible} implausible, {bad} end to end; "
            f"{self.wrong_enables} times a forged status frame said enabled"
        )


_UPWARD = {  # step: mask and value of the controlwords that ask for it, CiA 402-2 command coding
    (DriveState.SWITCH_ON_DISABLED, DriveState.READY_TO_SWITCH_ON): (0x87, 0x06),
    (DriveState.READY_TO_SWITCH_ON, DriveState.SWITCHED_ON): (0x87, 0x07),
    (DriveState.SWITCHED_ON, DriveState.OPERATION_ENABLED): (0x8F, 0x0F),
    (DriveState.QUICK_STOP_ACTIVE, DriveState.OPERATION_ENABLED): (0x8F, 0x0F),
    (DriveState.FAULT, DriveState.SWITCH_ON_DISABLED): (0x80, 0x80),
}
_FOLLOWS_TARGET = 1 << 12  # of the statusword: Operation enabled in mode 10
FRAMES_PER_SYNC = 8
FRAMES_PER_SET_UP = 4096
HOST_SERVICES = frozenset({0x000, 0x080, 0x77F, *range(0x601, 0x605)})
"""NMT, SYNC, heartbeat and SDO: what the host may say and no CRC covers."""


class BenchReceiver:
    """The emulated devices, operational in mode 10 and not enabled, with a SYNC every 8 frames."""

    def __init__(self, without: frozenset[int] = frozenset()) -> None:
        """`without`: identifiers whose frames are left out."""
        self._without = without
        self.sent: list[CanFrame] = []
        self.bench = Bench(load_scenario("idle"), CODEC, lambda can_id, data: self.sent.append((can_id, data)))
        self.bench.boot()
        self._commands = {CODEC.message(f"Drive{i + 1}Command").can_id: i for i in range(2)}
        self._sync = 0
        self._count = 0
        self._said: tuple[set[int], set[int]] = (set(), set())
        self._is_anything_said = [False, False]
        self.passed_crc = self.steps = self.enables = self.torques = 0
        self.server_errors = _ServerErrors()

    def take(self, frame: CanFrame) -> None:
        """Take a frame; each step of a drive upward, and each torque, must have been asked for."""
        if frame[0] in self._without:
            return
        if self._count % FRAMES_PER_SET_UP == 0:
            self._set_up()
        if self._count % FRAMES_PER_SYNC == 0:
            self._sync = self._sync % 240 + 1
            self._deliver((0x080, bytes([self._sync])))
        self._count += 1
        self._deliver(frame)

    def _set_up(self) -> None:
        self._is_anything_said = [False, False]
        for node in (1, 2):
            self._deliver((0x600 + node, struct.pack("<BHBB3x", 0x2F, 0x6060, 0, 10)))
        self._deliver((0x000, b"\x01\x00"))

    def _deliver(self, frame: CanFrame) -> None:
        self._listen(frame)
        before = [drive.state for drive in self.bench.drives]
        is_node_reset = frame[0] == 0x000 and frame[1][:1] == b"\x81"  # begins the state machine anew
        self.sent.clear()
        self.bench.on_frame(Frame(frame[0], frame[1], 0))
        for joint, drive in enumerate(self.bench.drives):
            if drive.state is not before[joint] and not is_node_reset:
                self._explain(joint, before[joint], drive.state)
            is_powered = drive.is_enabled and bool(drive.statusword & _FOLLOWS_TARGET)
            assert drive.torque_Nm == 0.0 or is_powered, f"drive {joint + 1}: {drive.torque_Nm} Nm in {drive.state}"
            assert drive.motor_mode is not DriveMode.TORQUE or drive.is_enabled
            self.torques += drive.torque_Nm != 0.0
        if frame[0] == 0x080:
            for said in self._said:
                said.clear()

    def _listen(self, frame: CanFrame) -> None:
        """Note which controlwords the drives have been told in a form that they may obey."""
        can_id, data = frame
        joint = self._commands.get(can_id)
        if joint is not None:
            if has_right_crc(CODEC.by_id[can_id], data):
                self.passed_crc += 1
                self._said[joint].add(data[2] | data[3] << 8)
        elif can_id in (0x601, 0x602) and len(data) == 8 and data[0] & 0xE0 == 0x20 and data[1:4] == b"\x40\x60\x00":
            size = 4 - (data[0] >> 2 & 3) if data[0] & 1 else 4
            self._said[can_id - 0x601].add(int.from_bytes(data[4 : 4 + size], "little"))
            self._is_anything_said[can_id - 0x601] |= not data[0] & 2  # its segments follow

    def _explain(self, joint: int, before: DriveState, after: DriveState) -> None:
        wanted = _UPWARD.get((before, after))
        if wanted is None:
            return
        self.steps += 1
        self.enables += after is DriveState.OPERATION_ENABLED
        mask, value = wanted
        is_asked = any(word & mask == value for word in self._said[joint]) or self._is_anything_said[joint]
        assert is_asked, f"drive {joint + 1} went from {before} to {after}, nobody asked"

    @property
    def summary(self) -> str:
        """Say what was counted."""
        return (
            f"devices: {self.passed_crc} command frames passed the CRC, {self.steps} steps upward and "
            f"{self.enables} enablings, each asked for by a valid frame; torque after {self.torques} frames; "
            f"{len(self.server_errors.texts)} exceptions caught within the SDO server"
        )


class _ServerErrors(logging.Handler):
    """Keeps the exceptions that canopen's SDO server catches and answers by a general abort."""

    def __init__(self) -> None:
        super().__init__()
        self.texts: list[str] = []
        logging.getLogger("canopen.sdo.server").addHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        """Keep it."""
        if record.exc_info:
            self.texts.append(repr(record.exc_info[1]))
