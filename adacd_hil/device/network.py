"""The host as CANopen master of one arm: boot, identity and set-up over SDO, NMT, heartbeats both ways, EMCY.

Boot: reset of communication, wait for every boot-up, identity, SYNC, heartbeats, PDOs, application, start.
Source: CiA 301 (4.2), clauses 7.2.8 (NMT) and 7.5.2 (communication objects); CiA 302-2 (boot-up of slaves).
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

from adacd_hil.device.arm_watch import OPERATIONAL, PATIENCE_PERIODS, EventSource, watch_heartbeats
from adacd_hil.device.canopen_bus import CanopenBus, DeviceError, describe_emergency
from adacd_hil.device.device_setup import (
    ParameterWatch,
    Slave,
    check_sensor,
    command_deadline_ms,
    set_up_drive,
    set_up_pdos,
)
from adacd_hil.device.profile import EMCY_INHIBIT_100US, PlacedDevice
from adacd_hil.records import Event
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.bus import Bus, Frame
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.contract_frames import FUNCTION_MASK, HEARTBEAT_ID, HOST_HEARTBEAT, SYNC_ID, SYNC_OVERFLOW
from adacd_hil.wire.frame_lengths import MAX_STANDARD_ID

START, ENTER_PRE_OPERATIONAL, RESET_COMMUNICATION = 0x01, 0x80, 0x82
"""NMT commands."""
_PROFILE_NUMBER_MASK = 0xFFFF  # of 0x1000
_SAME_DBC = "give host and devices the same DBC file: `devices.contract`, and the node ids that it has"
_UNPOWERED = "check the device's power, wiring and node id; `adacd-hil scan` lists who is there"
_MOST_OLD_FRAMES = 10_000  # more than any queue holds; a bus that somebody floods is never empty


class Identity(NamedTuple):
    """Object 0x1018 of one node, with its name in the DBC; 0 for an entry that the EDS doesn't list."""

    name: str
    node_id: int
    vendor: int
    product: int
    revision: int
    serial: int


def identity_difference(slave: Slave, device_type: int, found: Identity) -> tuple[str, str, str]:
    """Return the first difference of a device found from its EDS and profile: quantity, values, remedy; "" without one.

    If the profile's `identity` is "eds", type, vendor and product must be the EDS's, and the revision one that the EDS
    covers. Of the type, 0x1000, the low word counts; any value that the EDS leaves open fits. The serial number must be
    the profile's if that has one. found: 0 for an entry of 0x1018 that was not read.
    """
    profile, name = slave.device.settings, slave.device.profile.name
    if profile.identity == "eds":
        another = (
            f"another device has this node id, or profile {name} is of another: `adacd-hil scan` lists the nodes; "
            f"correct `devices.{profile.kind}_node` or `devices.{profile.kind}`"
        )
        expected_type = slave.default(0x1000)
        if expected_type is not None and (device_type ^ expected_type) & _PROFILE_NUMBER_MASK:
            return "device type", f"0x1000 = 0x{device_type:08X}, 0x{expected_type:08X} expected", another
        for quantity, value, expected in (
            ("vendor", found.vendor, slave.default(0x1018, 1)),
            ("product code", found.product, slave.default(0x1018, 2)),
        ):
            if expected is not None and value != expected:
                return quantity, f"0x{value:X} is not the EDS's 0x{expected:X}", another
        # CiA 301, 7.5.2.19: the high word stands for a behaviour on the bus, the low word for versions of it.
        revision = slave.default(0x1018, 3) or 0
        major, minor = divmod(revision, 1 << 16)
        if revision and (found.revision >> 16 != major or found.revision & 0xFFFF < minor):
            return (
                "revision",
                f"0x{found.revision:X} is not of the EDS's 0x{revision:X}",
                f'get the EDS of this firmware from the maker; `identity = "any"` in {name} takes every revision',
            )
    if profile.serial and found.serial != profile.serial[slave.device.joint]:
        return (
            "serial number",
            f"0x1018:4 = {found.serial}, {profile.serial[slave.device.joint]} expected",
            f"the device was changed, or moved to another joint: correct `serial` of {name}",
        )
    return "", "", ""


class Master(EventSource):
    """The CANopen master of one arm."""

    def __init__(
        self, settings: Settings, codec: Codec, devices: Sequence[PlacedDevice], bus: Bus, watch_host: bool = True
    ) -> None:
        """`watch_host`: devices shall watch the host by time: its heartbeat, and its commands where they count ms.

        Not in lockstep: cycles have no fixed duration there, and a device waits by the wall clock.
        """
        super().__init__()
        self._watch_host = watch_host
        self._settings = settings
        self._codec = codec
        self._bus = bus
        self._canopen = CanopenBus(bus)
        self._emergencies: dict[str, str] = {}
        self._heartbeat_id = codec.message(HOST_HEARTBEAT).can_id
        self.slaves: list[Slave] = []
        self._drives = [device for device in devices if device.settings.kind == "drive"]
        self.nodes: dict[str, Any] = {}
        for device in devices:
            listener = functools.partial(self._on_emergency, device.name)
            patience = device.settings.patience
            node = self._canopen.add_node(
                device.node_id, device.objects, listener, patience.answer_s, patience.pause_ms * 1e-3
            )
            self.nodes[device.name] = node
            self.slaves.append(Slave(device, node, self._let_pass))
        self._heartbeats = watch_heartbeats(devices, settings.bus.heartbeat_ms, self.events.append)
        self.parameters = ParameterWatch(settings, bus)
        self._canopen.bystander = self._heartbeats.accept

    def _on_emergency(self, name: str, error: Any) -> None:
        """Add an event for an EMCY of device `name`, and store it as its last error; an error reset deletes that."""
        slave = next(slave for slave in self.slaves if slave.name == name)
        text = describe_emergency(error.code, bytes(error.data), slave.device.can("watchdog_in_emcy"))
        if error.code >> 8:
            self._emergencies[name] = text
        else:
            self._emergencies.pop(name, None)
        self.events.append(Event("warning" if error.code >> 8 else "info", name, text))

    def accept(self, frame: Frame) -> None:
        """Take a frame that is not cyclic: SDO answer, heartbeat, EMCY. Ignore error frames, count malformed ones."""
        if self.parameters.accept(frame):
            return
        self._heartbeats.accept(frame)
        self._canopen.accept(frame)

    def _let_pass(self, duration_s: float) -> None:
        """Read the bus for `duration_s`, or up to twice that if frames come; hand its frames to their consumers."""
        self._canopen.pump(lambda _: False, duration_s)

    def describe_checks(self) -> list[str]:
        """Return [line] with the number of frames that fitted no CANopen service and were dropped; [] without any."""
        count = self._canopen.malformed_frames
        return [f"{count} frames dropped that are not what their identifier says"] if count else []

    def describe_emergencies(self) -> list[str]:
        """Return the last error that each device reported and has not reset since, one line each."""
        return [f"{name}: {text}" for name, text in self._emergencies.items()]

    def reset(self) -> None:
        """Reset the communication of the arm's nodes and wait until each has booted.

        Unless `bus.is_shared`, all other nodes on the bus are reset, too. Drop frames received earlier, forget the
        devices' EMCYs, and stop watching heartbeats. Raises DeviceError if a node doesn't boot within
        `devices.boot_timeout_s`, BusError if the bus fails.
        """
        for _ in range(_MOST_OLD_FRAMES):  # from before the reset; a full queue has no room for new frames
            if self._bus.receive(0.0) is None:
                break
        timeout_s = self._settings.devices.boot_timeout_s
        waiting = {slave.node_id: slave.name for slave in self.slaves}
        self._heartbeats.stop()
        self._emergencies.clear()
        self._command(RESET_COMMUNICATION)

        def is_last_boot(frame: Frame) -> bool:
            if frame.can_id & FUNCTION_MASK == HEARTBEAT_ID and frame.data == b"\x00":
                waiting.pop(frame.can_id & 0x7F, None)
            return not waiting

        if not self._canopen.pump(is_last_boot, timeout_s):
            missing = ", ".join(f"{name} (node {node_id})" for node_id, name in waiting.items())
            raise DeviceError(f"no boot-up from {missing} on {self._bus.channel} within {timeout_s:g} s", _UNPOWERED)

    def identify(self) -> list[Identity]:
        """Read and return each device's identity.

        Raises DeviceError if one differs from EDS, profile or DBC, or can't be read; BusError if the bus fails.
        """
        return [self._identify(slave) for slave in self.slaves]

    def _identify(self, slave: Slave) -> Identity:
        """Return a device's identity, 0 for entries that the EDS lacks, but for a serial number that the profile names.

        Raises DeviceError for another node id than the DBC's, another device than the EDS's, another serial number than
        the profile's, and another contract in 0x2000, as far as the profile has these; BusError if the bus fails.
        """
        profile = slave.device.settings
        by_contract = self._codec.node_id(f"{slave.name}Heartbeat")
        if slave.node_id != by_contract:
            slave.fail(
                f"node id {by_contract} by the DBC, {slave.node_id} by the configuration",
                f'correct `devices.{profile.kind}_node`, or `devices.contract` = "" composes the frames',
            )
        device_type = slave.read(0x1000)
        read = [slave.read(0x1018, sub) if slave.has(0x1018, sub) else 0 for sub in (1, 2, 3, 4)]
        if profile.serial and not slave.has(0x1018, 4):
            read[3] = slave.read_unlisted(0x1018, 4)
        found = Identity(slave.name, slave.node_id, *read)
        quantity, difference, remedy = identity_difference(slave, device_type, found)
        if difference:
            slave.fail(f"{quantity} {difference}", remedy)
        if profile.contract_object:
            self.check_contract(slave)
        return found

    def check_contract(self, slave: Slave) -> None:
        """Raise DeviceError unless the device has the DBC's wire version and layout digest in 0x2000.

        Raises DeviceError also if it can't be read, BusError if the bus fails.
        """
        version, digest = slave.read(0x2000, 1), slave.read(0x2000, 2)
        if version != self._codec.wire_version:
            slave.fail(f"wire version {version} is not the DBC's {self._codec.wire_version}", _SAME_DBC)
        if digest != self._codec.layout_digest:
            slave.fail(
                f"layout digest 0x{digest:08X} is not the DBC's 0x{self._codec.layout_digest:08X}; "
                "host and device use different DBC files",
                _SAME_DBC,
            )

    def configure(self) -> None:
        """Set up all devices over SDO: the profile's `setup`, then SYNC, heartbeats, EMCY, PDOs, drives and sensors.

        Afterwards `parameters` watches the values that were written or compared. Remarks become events. Raises
        DeviceError if a device refuses a value or differs from its profile or the configuration; BusError if the bus
        fails.
        """
        for slave in self.slaves:
            for extra in slave.device.settings.setup:  # first: the host checks and writes on top of them
                slave.write_checked(extra.name.index, extra.name.sub, extra.value)
            self._set_up_sync(slave)
            self._set_up_heartbeats(slave)
            self._set_up_emergencies(slave)
            set_up_pdos(slave, command_deadline_ms(self._settings) if self._watch_host else 0)
            if slave.device.settings.kind == "drive":
                for remark in set_up_drive(slave, self._settings, self._codec, self._drives):
                    self.events.append(Event("warning", slave.name, remark))
            else:
                status = check_sensor(slave, self._codec)
                if status:
                    self.events.append(Event("info", slave.name, status))
        self.parameters.follow(self.slaves)

    def _set_up_sync(self, slave: Slave) -> None:
        """Write SYNC's period, and the overflow of its counter if the device counts.

        Raises DeviceError if the device has another identifier of SYNC or doesn't take the values; BusError if the bus
        fails.
        """
        if slave.has(0x1005):
            identifier = slave.read(0x1005) & MAX_STANDARD_ID
            if identifier != SYNC_ID:
                slave.fail(
                    f"SYNC identifier 0x1005 = 0x{identifier:X}, 0x{SYNC_ID:X} expected",
                    "set 0x1005 with the maker's tool, and store it",
                )
        counts = slave.can_write(0x1019) and slave.device.can("sync_counter")
        has_period = slave.can_write(0x1006)
        if counts and slave.read(0x1019) != SYNC_OVERFLOW:
            if has_period:
                # CiA 301, 7.5.2.22: the overflow value can be changed at period 0 only
                slave.write_object(0x1006, 0, 0)
            slave.write_checked(0x1019, 0, SYNC_OVERFLOW)
        if has_period:
            slave.write_object(0x1006, 0, self._settings.bus.period_us)
            slave.expect(
                0x1006,
                0,
                self._settings.bus.period_us,
                "SYNC period",
                "µs",
                remedy="the device takes other periods: choose a `bus.period_us` of its manual",
            )

    @staticmethod
    def _set_up_emergencies(slave: Slave) -> None:
        if slave.can_write(0x1015):
            slave.write_checked(0x1015, 0, EMCY_INHIBIT_100US, "x 100 µs")

    def _set_up_heartbeats(self, slave: Slave) -> None:
        """Write the period of the device's heartbeat; if the EDS doesn't allow that, warn that it isn't watched.

        Write the device's patience with the host's heartbeat, if it has one; 0, never, if `watch_host` is False. Raises
        DeviceError if the device doesn't take a value, BusError if the bus fails.
        """
        period_ms = self._settings.bus.heartbeat_ms
        if slave.device.is_heartbeat_known:
            slave.write_checked(0x1017, 0, period_ms, "ms")
        else:
            why = "read-only" if slave.has(0x1017) else "not there"
            self.events.append(Event("warning", slave.name, f"its heartbeat isn't watched: 0x1017 is {why} in its EDS"))
        if slave.can_write(0x1016, 1) and slave.device.can("heartbeat_consumer"):
            host = self._heartbeat_id & 0x7F
            entry = host << 16 | round(PATIENCE_PERIODS * period_ms)
            slave.write_checked(0x1016, 1, entry if self._watch_host else 0)

    def start(self) -> None:
        """Watch heartbeats, and send NMT start: to all nodes at once if `devices.start` is all, else to this arm's.

        This arm's nodes get it one by one, sensors first. With all and `bus.is_shared`, they alone get it, in the order
        of `slaves`. Raises BusError if the bus refuses a frame.
        """
        self._heartbeats.start()
        if self._settings.devices.start == "all":
            self._command(START)
            return
        # False sorts first: a drive that starts finds its sensor sending.
        for slave in sorted(self.slaves, key=lambda slave: slave.device.settings.kind == "drive"):
            self._canopen.command(START, slave.node_id)

    def stop(self) -> None:
        """Send the NMT command to enter pre-operational to all nodes, and stop watching their heartbeats.

        If `bus.is_shared`, only this arm's nodes get it. Drives that are still enabled then leave Operation enabled.
        Raises BusError if the bus refuses a frame.
        """
        self._heartbeats.stop()
        self._command(ENTER_PRE_OPERATIONAL)

    def leave_operational(self, node_id: int) -> None:
        """Send one node the NMT command to enter pre-operational; do not wait for its reply.

        Raises BusError if the bus refuses the frame.
        """
        self._canopen.command(ENTER_PRE_OPERATIONAL, node_id)

    def _command(self, nmt_command: int) -> None:
        """Send an NMT command to the arm: to all nodes at once, or to each of its own where other arms listen too."""
        for node_id in [slave.node_id for slave in self.slaves] if self._settings.bus.is_shared else [0]:
            self._canopen.command(nmt_command, node_id)

    def failed_heartbeats(self, t_ns: int) -> list[str]:
        """Return the failures of the nodes' heartbeats now, one line per node; empty without a failure.

        A node fails if it is silent for PATIENCE_PERIODS, or was in another state than OPERATIONAL since the last call,
        only between `start` and `stop`. For PATIENCE_PERIODS after the first call, a node that hasn't been OPERATIONAL
        yet passes. A failure that begins, changes or ends adds an event. Nodes are not watched if their EDS doesn't let
        the host write 0x1017.
        """
        return self._heartbeats.judge_nodes(t_ns)

    def send_heartbeat(self) -> None:
        """Send the host's heartbeat, 0x700 + its node id. Raises BusError if the bus refuses it."""
        self._bus.send(self._heartbeat_id, bytes((OPERATIONAL,)))
