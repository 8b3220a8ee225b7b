"""The host as CANopen master of one arm: NMT, identity and set-up over SDO, heartbeat, EMCY.

Source: CiA 301 (4.2), clauses 7.2.8 (NMT) and 7.5.2 (communication objects).
"""

from typing import Any, NamedTuple

from adacd_hil.config import Settings
from adacd_hil.device.arm import SYNC_OVERFLOW
from adacd_hil.device.canopen_bus import CanopenBus, DeviceError, explained
from adacd_hil.device.drive import MODE_CYCLIC_SYNCHRONOUS_TORQUE
from adacd_hil.records import JOINTS, Event
from adacd_hil.wire.bus import Bus, Frame
from adacd_hil.wire.codec import Codec, contract_folder

BOOT_TIMEOUT_S = 2.0
"""Longest silence while waiting for the nodes to boot after a reset of communication."""
_START, _ENTER_PRE_OPERATIONAL, _RESET_COMMUNICATION = 0x01, 0x80, 0x82
_STATE_OPERATIONAL = 5


class Identity(NamedTuple):
    """Object 0x1018 of one node, with its name in the DBC."""

    name: str
    node_id: int
    vendor: int
    product: int
    revision: int
    serial: int


class Master:
    """The CANopen master of one arm."""

    def __init__(self, settings: Settings, codec: Codec, bus: Bus) -> None:
        self._settings = settings
        self._codec = codec
        self._bus = bus
        self._canopen = CanopenBus(bus)
        self._events: list[Event] = []
        self._heartbeat_id = codec.message("HostHeartbeat").can_id
        self.nodes: dict[str, Any] = {}
        for kind, eds in (("Drive", "drive.eds"), ("Sensor", "torque_sensor.eds")):
            for joint in range(1, JOINTS + 1):
                name = f"{kind}{joint}"
                self.nodes[name] = self._add_node(name, codec.node_id(f"{name}Heartbeat"), eds)

    def _add_node(self, name: str, node_id: int, eds: str) -> Any:
        return self._canopen.add_node(node_id, contract_folder() / eds, lambda error: self._on_emergency(name, error))

    def _on_emergency(self, name: str, error: Any) -> None:
        if error.code:
            description = error.get_desc() or "unknown"
            self._events.append(Event("warning", name, f"EMCY 0x{error.code:04X}: {description}"))
        else:
            self._events.append(Event("info", name, "EMCY 0x0000: error reset"))

    def accept(self, frame: Frame) -> None:
        """Take a frame that is not cyclic: SDO answer, heartbeat, EMCY."""
        self._canopen.accept(frame)

    def take_events(self) -> list[Event]:
        """Return what the devices reported since the last call."""
        events, self._events = self._events, []
        return events

    def reset(self) -> None:
        """Reset the communication of all nodes and wait until each has booted. Raises DeviceError."""
        while self._bus.receive(0.0) is not None:  # from before the reset; a full queue has no room for what follows
            pass
        waiting = {node.id: name for name, node in self.nodes.items()}
        self._canopen.command(_RESET_COMMUNICATION)

        def is_last_boot(frame: Frame) -> bool:
            if frame.can_id & 0x780 == 0x700 and frame.data == b"\x00":
                waiting.pop(frame.can_id & 0x7F, None)
            return not waiting

        if not self._canopen.pump(is_last_boot, BOOT_TIMEOUT_S):
            missing = ", ".join(f"{name} (node {node_id})" for node_id, name in waiting.items())
            raise DeviceError(f"no boot-up from {missing} on {self._bus.channel} within {BOOT_TIMEOUT_S:g} s")

    def identify(self) -> list[Identity]:
        """Read who is there and compare it with EDS and DBC. Raises DeviceError."""
        identities = []
        for name, node in self.nodes.items():
            with explained(name, node.id, "identity"):
                read = {index: node.sdo[0x1018][index].raw for index in (1, 2, 3, 4)}
                expected = {index: node.object_dictionary[0x1018][index].default for index in (1, 2)}
                version = node.sdo[0x2000][1].raw
                digest = node.sdo[0x2000][2].raw
            for index, what in ((1, "vendor"), (2, "product code")):
                if read[index] != expected[index]:
                    raise DeviceError(
                        f"{name} (node {node.id}): {what} 0x{read[index]:X} is not the EDS's 0x{expected[index]:X}"
                    )
            if version != self._codec.wire_version:
                raise DeviceError(
                    f"{name} (node {node.id}): wire version {version} is not the DBC's {self._codec.wire_version}"
                )
            if digest != self._codec.layout_digest:
                raise DeviceError(
                    f"{name} (node {node.id}): layout digest 0x{digest:08X} is not the DBC's "
                    f"0x{self._codec.layout_digest:08X}; host and device use different DBC files"
                )
            identities.append(Identity(name, node.id, *read.values()))
        return identities

    def configure(self) -> None:
        """Write communication and application parameters, and read back what matters. Raises DeviceError."""
        settings = self._settings
        for name, node in self.nodes.items():
            with explained(name, node.id, "set-up"):
                node.sdo[0x1006].raw = settings.bus.period_us
                node.sdo[0x1019].raw = SYNC_OVERFLOW
                node.sdo[0x1017].raw = settings.bus.heartbeat_ms
                self._compare(name, node, 0x1006, settings.bus.period_us, "SYNC period", "µs")
        for joint in range(JOINTS):
            self._configure_drive(f"Drive{joint + 1}", joint)

    def _configure_drive(self, name: str, joint: int) -> None:
        node = self.nodes[name]
        arm = self._settings.arm
        with explained(name, node.id, "set-up"):
            node.sdo[0x6060].raw = MODE_CYCLIC_SYNCHRONOUS_TORQUE
            self._compare(name, node, 0x6061, MODE_CYCLIC_SYNCHRONOUS_TORQUE, "mode of operation", "")
            self._compare(name, node, 0x6076, round(arm.rated_torque_Nm[joint] * 1000), "rated torque", "mNm")
            node.sdo[0x2200].raw = self._settings.bus.command_patience_cycles
            node.sdo[0x6072].raw = min(0xFFFF, round(1000 * arm.torque_limit_Nm[joint] / arm.rated_torque_Nm[joint]))

    @staticmethod
    def _compare(name: str, node: Any, index: int, expected: int, quantity: str, unit: str) -> None:
        found = node.sdo[index].raw
        if found != expected:
            raise DeviceError(
                f"{name} (node {node.id}): {quantity} 0x{index:04X} = {found} {unit}".rstrip()
                + f", {expected} {unit}".rstrip()
                + " expected"
            )

    def start(self) -> None:
        """Let all nodes exchange cyclic frames. Raises BusError."""
        self._canopen.command(_START)

    def stop(self) -> None:
        """Put all nodes back to pre-operational; drives drop out if they are still enabled. Raises BusError."""
        self._canopen.command(_ENTER_PRE_OPERATIONAL)

    def send_heartbeat(self) -> None:
        """Say that the host lives, 0x700 + 127. Raises BusError."""
        self._bus.send(self._heartbeat_id, bytes((_STATE_OPERATIONAL,)))
