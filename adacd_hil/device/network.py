"""The host as CANopen master: NMT, identity and set-up over SDO, heartbeat, EMCY. The host's only door to `canopen`.

No threads: a request is sent, then the bus is read until its answer is in. What arrives meanwhile goes to whom it
concerns. Source: CiA 301 (4.2), clauses 7.2.4 (SDO), 7.2.8 (NMT), 7.5.2 (communication objects).
"""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import canopen
from canopen.emcy import EmcyError
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError, SdoError

from adacd_hil.config import Settings
from adacd_hil.device.arm import SYNC_OVERFLOW
from adacd_hil.device.drive import MODE_CYCLIC_SYNCHRONOUS_TORQUE
from adacd_hil.records import JOINTS, Event
from adacd_hil.wire.bus import Bus, Frame
from adacd_hil.wire.codec import Codec, contract_folder

ANSWER_TIMEOUT_S = 0.5
"""Longest silence while waiting for an answer. CiA 301 gives none; drives answer within 100 ms."""
BOOT_TIMEOUT_S = 2.0
"""Longest silence while waiting for the nodes to boot after a reset of communication."""
_MAX_UNRELATED_FRAMES = 10_000
_SDO_ABORT = 0x80
_RESET_COMMUNICATION = 0x82
_STATE_OPERATIONAL = 5

# canopen reports what it also raises; the raised form is ours to print.
logging.getLogger("canopen").addHandler(logging.NullHandler())
logging.getLogger("canopen").propagate = False


class DeviceError(RuntimeError):
    """A device is missing, not the expected one, or refuses its set-up; one line."""


class Identity(NamedTuple):
    """Object 0x1018 of one node, with its name in the DBC."""

    name: str
    node_id: int
    vendor: int
    product: int
    revision: int
    serial: int


class _Network(canopen.Network):
    """canopen's network over our bus, without its receiving thread."""

    def __init__(self, send: Callable[[int, bytes], None]) -> None:
        super().__init__()
        self._send = send

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:  # noqa: ARG002
        self._send(can_id, bytes(data))


class Master:
    """The CANopen master of one arm."""

    def __init__(self, settings: Settings, codec: Codec, bus: Bus) -> None:
        self._settings = settings
        self._codec = codec
        self._bus = bus
        self._network = _Network(self._send)
        self._events: list[Event] = []
        self._heartbeat_id = codec.message("HostHeartbeat").can_id
        self.nodes: dict[str, Any] = {}
        for kind, eds in (("Drive", "drive.eds"), ("Sensor", "torque_sensor.eds")):
            for joint in range(1, JOINTS + 1):
                name = f"{kind}{joint}"
                self.nodes[name] = self._add_node(name, codec.node_id(f"{name}Heartbeat"), eds)

    def _add_node(self, name: str, node_id: int, eds: str) -> Any:
        node = canopen.RemoteNode(node_id, str(contract_folder() / eds))
        self._network.add_node(node)
        node.sdo.RESPONSE_TIMEOUT = 0.0005  # the answer is in the queue when `_send` returns, or never comes
        node.emcy.add_callback(lambda error: self._on_emergency(name, error))
        return node

    def _on_emergency(self, name: str, error: EmcyError) -> None:
        if error.code:
            description = error.get_desc() or "unknown"
            self._events.append(Event("warning", name, f"EMCY 0x{error.code:04X}: {description}"))
        else:
            self._events.append(Event("info", name, "EMCY 0x0000: error reset"))

    def _send(self, can_id: int, data: bytes) -> None:
        self._bus.send(can_id, data)
        is_request = can_id & 0x780 == 0x600 and data[0] != _SDO_ABORT
        if is_request:
            self._pump(lambda frame: frame.can_id == can_id - 0x80, ANSWER_TIMEOUT_S)

    def _pump(self, is_answer: Callable[[Frame], bool], timeout_s: float) -> bool:
        """Read the bus until an answer is in; False after a silence of `timeout_s`."""
        for _ in range(_MAX_UNRELATED_FRAMES):
            frame = self._bus.receive(timeout_s)
            if frame is None:
                return False
            self.accept(frame)
            if is_answer(frame):
                return True
        return False

    def accept(self, frame: Frame) -> None:
        """Take a frame that is not cyclic: SDO answer, heartbeat, EMCY."""
        if not frame.is_error and frame.data:
            self._network.notify(frame.can_id, bytearray(frame.data), frame.t_ns * 1e-9)

    def take_events(self) -> list[Event]:
        """Return what the devices reported since the last call."""
        events, self._events = self._events, []
        return events

    def reset(self) -> None:
        """Reset the communication of all nodes and wait until each has booted. Raises DeviceError."""
        waiting = {node.id: name for name, node in self.nodes.items()}
        self._network.nmt.send_command(_RESET_COMMUNICATION)

        def is_last_boot(frame: Frame) -> bool:
            if frame.can_id & 0x780 == 0x700 and frame.data == b"\x00":
                waiting.pop(frame.can_id & 0x7F, None)
            return not waiting

        if not self._pump(is_last_boot, BOOT_TIMEOUT_S):
            missing = ", ".join(f"{name} (node {node_id})" for node_id, name in waiting.items())
            raise DeviceError(f"no boot-up from {missing} on {self._bus.channel} within {BOOT_TIMEOUT_S:g} s")

    def identify(self) -> list[Identity]:
        """Read who is there and compare it with EDS and DBC. Raises DeviceError."""
        identities = []
        for name, node in self.nodes.items():
            with _explained(name, node.id, "identity"):
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
            with _explained(name, node.id, "set-up"):
                node.sdo[0x1006].raw = settings.bus.period_us
                node.sdo[0x1019].raw = SYNC_OVERFLOW
                node.sdo[0x1017].raw = settings.bus.heartbeat_ms
                self._compare(name, node, 0x1006, settings.bus.period_us, "SYNC period", "µs")
        for joint in range(JOINTS):
            self._configure_drive(f"Drive{joint + 1}", joint)

    def _configure_drive(self, name: str, joint: int) -> None:
        node = self.nodes[name]
        arm = self._settings.arm
        with _explained(name, node.id, "set-up"):
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
        self._network.nmt.state = "OPERATIONAL"

    def stop(self) -> None:
        """Put all nodes back to pre-operational; drives drop out if they are still enabled. Raises BusError."""
        self._network.nmt.state = "PRE-OPERATIONAL"

    def send_heartbeat(self) -> None:
        """Say that the host lives, 0x700 + 127. Raises BusError."""
        self._bus.send(self._heartbeat_id, bytes((_STATE_OPERATIONAL,)))


@contextmanager
def _explained(name: str, node_id: int, what: str) -> Iterator[None]:
    """Turn canopen's SDO errors into one line."""
    try:
        yield
    except SdoAbortedError as error:
        raise DeviceError(f"{name} (node {node_id}): {what} refused: {error}") from None
    except SdoCommunicationError:
        raise DeviceError(f"{name} (node {node_id}): no SDO answer within {ANSWER_TIMEOUT_S:g} s ({what})") from None
    except (SdoError, KeyError) as error:
        raise DeviceError(f"{name} (node {node_id}): {what}: {error}") from None
