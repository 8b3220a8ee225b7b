"""The nodes of a bench, two drives and two torque sensors around one arm, and their frames."""

from collections.abc import Callable, Sequence

from adacd_hil.records import JOINTS
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.time_marks import answers_to_sync
from firmware_sim.arm.hardware_settings import HabitSettings
from firmware_sim.arm.sensing import Measurement
from firmware_sim.arm.touch_settings import TICK_S
from firmware_sim.bench.injector import Handler, Injector
from firmware_sim.body.sensors import converter_ends, count_Nm
from firmware_sim.canopen.object_dictionary import Abort, EmulatedContract, longest_pdo, refuse
from firmware_sim.nodes.device import EmulatedDevice, MovableArm, SyncListeners
from firmware_sim.nodes.drive_node import DriveNode
from firmware_sim.nodes.sensor_node import SensorNode
from firmware_sim.scenario.faults import device_ids, own_messages
from firmware_sim.scenario.scenario import Scenario

TICK_NS = round(TICK_S * 1e9)
_NODES = ("Drive1", "Drive2", "Sensor1", "Sensor2")
_LONGEST_PERIOD_US = 100_000
_UNTOLD_PERIOD_NS = 1_000_000
"""Time that a SYNC stands for until 0x1006 of drive 1 is set, if the contract gives no period."""


class BenchNodes:
    """All nodes of one bench: the frames that each takes and sends, and their timers."""

    def __init__(
        self,
        scenario: Scenario,
        codec: Codec,
        contract: EmulatedContract,
        injector: Injector,
        arm: MovableArm,
        is_free_running: bool,
    ) -> None:
        """Build the nodes around an arm, and make them those of `injector`.

        `is_free_running`: time passes without SYNC, so drives watch for it. Raises CodecError when the DBC lacks a
        message, OSError when an EDS can't be read, ConfigError when a fault replaces an object that its device lacks,
        or by a value that the object can't have.
        """
        self.senders: tuple[tuple[int, Callable[[], None]], ...] = ()
        """Senders of the answers to SYNC: place of a node, and its function."""
        self.commands: dict[int, tuple[tuple[int, Handler], ...]] = {}
        """By identifier, the nodes that take a frame of the host, and how."""
        self.has_all_answers = False
        """Whether all cyclic frames of the contract, and no others, answer SYNC."""
        self.answers = answers_to_sync(codec)
        self._arm = arm
        self.wiring = scenario.arm.wiring
        described = [contract.describe_device(place) for place in range(len(_NODES))]
        right_ids = [codec.node_id(f"{name}Heartbeat") for name in _NODES]
        ids = device_ids(scenario.faults, right_ids)
        longest = longest_pdo(codec)
        self.devices = tuple(
            EmulatedDevice(
                ids[i],
                described[i],
                injector.sender(i),
                own_messages(codec.by_id, right_ids[i], ids[i]),
                longest,
            )
            for i in range(len(_NODES))
        )
        self.drives = tuple(
            DriveNode(
                self.devices[i],
                codec,
                i,
                arm,
                scenario.arm,
                is_free_running,
                scenario.habits[i] if scenario.habits else HabitSettings(),
            )
            for i in range(JOINTS)
        )
        self.sensors = tuple(self._make_sensor(i, codec, scenario) for i in range(JOINTS))
        self._nodes: tuple[DriveNode | SensorNode, ...] = (*self.drives, *self.sensors)
        for device, description in zip(self.devices, described, strict=True):
            for alias, (key, ratio) in description.aliases.items():
                if alias != key:
                    device.serve(*alias, _scaled(device.reader(*key), ratio, *device.range_of(*alias)))
                    device.pdos.accept_values(*alias, device.pdos.writer(*key))
        injector.attach(self.devices, self.drives, self.sensors)
        self.latch_motors()
        self.period_ns = contract.period_us * 1000 or _UNTOLD_PERIOD_NS
        """How far one SYNC takes the arm, where time goes by SYNC."""
        self.told_period_ns = 0
        """0x1006 of drive 1; 0: not set."""
        self._set_period(self.devices[0].value(0x1006))
        for device in self.devices:
            device.watch(0x1006, 0, check=_check_period)
        self.devices[0].watch(0x1006, 0, self._set_period)
        self.listeners = SyncListeners(self.devices)

    def listen(self) -> None:
        """Update `senders`, `commands` and `has_all_answers`; call it after a change of the nodes' PDOs."""
        self.senders = tuple((i, send) for i, device in enumerate(self.devices) for send in device.pdos.on_sync)
        self.has_all_answers = self.answers == frozenset().union(*(device.pdos.answers for device in self.devices))
        commands: dict[int, tuple[tuple[int, Handler], ...]] = {}
        for place, device in enumerate(self.devices):
            for can_id, take in device.pdos.handlers():
                commands[can_id] = (*commands.get(can_id, ()), (place, take))
        self.commands = commands

    def poll(self, t_ns: int) -> int:
        """Let all nodes act on their timers that are due at `t_ns`, and return the time, ns, of the next timer.

        Event-driven frames go out, too. NEVER_NS if no timer runs. Both are times of the bench.
        """
        return min(node.poll(t_ns) for node in self._nodes)

    @property
    def has_news(self) -> bool:
        """Whether a node has a frame to send, or a timer to set, before its next timer is due: call `poll`."""
        return any(node.has_news for node in self._nodes)

    def latch_motors(self) -> None:
        """Store the drives' present set-points, Nm, and modes, by joint; `move_arm` uses them until the next call."""
        signs = self.wiring.torque_sign
        torque_Nm = [sign * drive.torque_Nm for sign, drive in zip(signs, self.drives, strict=True)]
        modes = [drive.motor_mode for drive in self.drives]
        if self.wiring.drive_joint == (1, 0):
            torque_Nm.reverse()
            modes.reverse()
        self._motor_Nm, self._motor_modes = torque_Nm, modes

    def move_arm(self, tick_count: int) -> None:
        """Move the arm with the latched set-points for `tick_count` ticks of 100 µs."""
        self._arm.advance(self._motor_Nm, self._motor_modes, tick_count)

    def lose_sync(self, heard: Sequence[int], t_ns: int) -> None:
        """Tell the drives that have not heard this SYNC that they have lost one.

        heard: how often each node has heard it, drives first.
        """
        for drive, has_heard in zip(self.drives, heard, strict=False):  # the drives come first
            if not has_heard:
                drive.on_lost_sync(t_ns)

    def sample(self) -> Measurement:
        """Return the arm's measured values in counts, with pairs by device (Drive1, Drive2 or Sensor1, Sensor2).

        Call it once per SYNC: each call draws new noise. The values are without the scenario's faults.
        """
        return self.wiring.read(self._arm.sample())

    def _make_sensor(self, place: int, codec: Codec, scenario: Scenario) -> SensorNode:
        joint = self.wiring.sensor_joint[place]
        low, high = converter_ends(scenario.sensors, joint)
        own = scenario.own_arm
        factor = 1.0 if own is None else own.torque_factor[place]
        return SensorNode(
            self.devices[JOINTS + place],
            codec,
            place + 1,
            (low, high) if self.wiring.sensor_sign[place] > 0 else (-high, -low),
            lambda: self._arm.joint_temperature_C[joint],
            factor * count_Nm(scenario.sensors, joint),
        )

    def _set_period(self, period_us: int) -> None:
        self.told_period_ns = period_us * 1000
        if period_us:  # 0 is written to change 0x1019; the time of a SYNC stays
            self.period_ns = self.told_period_ns


def _scaled(read: Callable[[], int], ratio: float, low: int, high: int) -> Callable[[], int]:
    """Return a reader of the value times `ratio`, rounded and limited to `low` to `high`.

    For a ratio of 1 it is `read` itself.
    """
    return read if ratio == 1.0 else lambda: min(max(round(read() * ratio), low), high)


def _check_period(period_us: int) -> None:
    """Abort the SDO write (VALUE_RANGE) of a SYNC period, µs, unless it is 0 to `_LONGEST_PERIOD_US` in whole ticks."""
    if not 0 <= period_us <= _LONGEST_PERIOD_US or period_us * 1000 % TICK_NS:
        refuse(Abort.VALUE_RANGE)
