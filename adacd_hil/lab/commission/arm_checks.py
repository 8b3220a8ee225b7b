"""Doctor's checks of the arm on its bus: nodes present, identity and contract, measurements at rest.

The drives get no command beyond Disable voltage. `ArmExamination.leave` puts the nodes back to pre-operational.
"""

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from adacd_hil.clock import Clock
from adacd_hil.device.arm import Arm
from adacd_hil.device.arm_report import describe_faults
from adacd_hil.device.canopen_bus import read_object
from adacd_hil.device.device_setup import Slave, command_deadline_ms, pdo_differences, torque_unit
from adacd_hil.device.network import Master
from adacd_hil.device.profile import PlacedDevice
from adacd_hil.device.strangers import host_frames
from adacd_hil.device.torque_sensor import SensorStatus
from adacd_hil.lab.commission.communication_test import (
    CommunicationTest,
    Verdict,
    ZeroTorqueCycle,
    ZeroTorqueLoop,
)
from adacd_hil.lab.commission.host_checks import Check, Finding, failed, ok, skipped, warning
from adacd_hil.lab.commission.survey import NMT_STATES, compare, expected_nodes, survey
from adacd_hil.lab.commission.traffic import Traffic, listen
from adacd_hil.records import JOINTS, Vector
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.bus import Bus, BusError, Tap
from adacd_hil.wire.can_interface import InterfaceState
from adacd_hil.wire.codec import Codec

LISTEN_S = 0.5
"""Listening time for other masters: five of the usual heartbeats of 100 ms."""
HIGH_LOAD_PERCENT = 80.0
"""Bus load above which the worst case (stuff bits, a status and an SDO frame) does not fit a period."""
_PDOS = (0x180, 0x200, 0x280, 0x300, 0x380, 0x400, 0x480, 0x500)


@dataclass
class ArmExamination:
    """The arm that doctor examines, and the results of the checks so far.

    open_bus: opens the bus without a filter. read_link: returns the interface's present state. ask: prints an
    instruction to the user; None if no user can move the arm, for the reason in `no_move_reason`. cycle_s: duration of
    the cycles. move_s: time for the user to move a joint.
    """

    settings: Settings
    codec: Codec
    devices: Sequence[PlacedDevice]
    clock: Clock
    open_bus: Callable[[], Bus]
    read_link: Callable[[], InterfaceState | None]
    bitrate: int = 1_000_000
    data_bitrate: int = 0
    ask: Callable[[str], None] | None = None
    no_move_reason: str = "give --move and move the joints when asked"
    cycle_s: float = 1.0
    move_s: float = 15.0
    _bus: Bus | None = None
    _has_reset: bool = False
    cycles: list[ZeroTorqueCycle] = field(default_factory=list)
    traffic: Traffic = field(default_factory=Traffic)

    def connect(self) -> None:
        """Open the bus; make arm and master on it. `leave` closes it. Raises BusMissingError."""
        self._bus = self.open_bus()
        self.tap = Tap(self._bus, self.clock)
        self.arm = Arm(self.settings, self.codec, self.devices, self.tap)
        self.master = Master(self.settings, self.codec, self.devices, self.tap)

    @cached_property
    def loop(self) -> ZeroTorqueLoop:
        """The zero-torque loop of this examination; later runs continue its cycle count."""
        return ZeroTorqueLoop(self.settings, self.tap, self.clock, self.arm, self.master)

    def reset(self) -> None:
        """Reset the nodes' communication, and let `leave` stop the nodes. Raises DeviceError, BusError."""
        self._has_reset = True
        self.master.reset()

    def leave(self) -> str:
        """Put the nodes back to pre-operational, if `reset` was called; close the bus; return an error's text or ""."""
        trouble = ""
        if self._has_reset:
            try:
                self.master.stop()
            except BusError as error:
                trouble = str(error)
        if self._bus is not None:
            with suppress(BusError):
                self._bus.close()
        return trouble

    def communication(self) -> CommunicationTest:
        """Return a communication test of the cycles so far."""
        test = CommunicationTest(self.settings, self.arm, self.bitrate, self.data_bitrate)
        for cycle in self.cycles:
            test.observe_cycle(cycle)
        return test

    def joint_values(self, name: str) -> NDArray[np.float64]:
        """Return the values of the cycles with complete data (n, 2). name: "q", "dq" or "tau_J"."""
        values = [getattr(cycle.state, name) for cycle in self.cycles if cycle.state.is_complete]
        return np.array(values, dtype=np.float64).reshape(len(values), JOINTS)


def open_arm_bus(patient: ArmExamination) -> Finding:
    """Check that the bus opens; leave it open for the further checks."""
    patient.connect()
    return ok(f"{patient.tap.channel} is open")


def check_other_masters(patient: ArmExamination) -> Finding:
    """Listen for `LISTEN_S`, and check that no other master sends on the bus."""
    traffic = Traffic()
    listen(patient.tap, patient.clock, LISTEN_S, traffic)
    patient.tap.take_passed()
    doing = host_frames(patient.settings, patient.codec, patient.devices)
    if patient.settings.bus.is_shared:
        del doing[patient.codec.message("Nmt").can_id]
    heard = [f"{doing[can_id]} (0x{can_id:03X})" for can_id in sorted(doing.keys() & traffic.talks.keys())]
    if heard:
        return failed(f"somebody else {', '.join(heard)}", "end the other program; an arm has one master")
    return ok(f"none in {LISTEN_S:g} s; {len(traffic.talks)} identifiers heard, {traffic.error_frames} error frames")


def check_nodes(patient: ArmExamination) -> Finding:
    """Check that the expected nodes are there, with the expected identity; warn of further nodes."""
    expected = expected_nodes(patient.master.slaves)
    found = survey(patient.tap, patient.clock, 0.0)
    verdicts = compare(found, expected)
    wrong = [f"node {node}: {text}" for node, text in verdicts.items() if text not in ("", "unexpected")]
    if wrong:
        return failed("; ".join(wrong), "check power, wiring, node id (0x100B or the maker's tool) and configuration")
    strangers = [str(node) for node, text in verdicts.items() if text]
    if strangers:
        return warning(f"node {', '.join(strangers)} is not in the configuration", "take it off the bus if it can be")
    return ok(", ".join(f"{node.name} (node {node.node_id})" for node in expected))


def boot_nodes(patient: ArmExamination) -> Finding:
    """Reset the communication of the nodes, and check that each boots."""
    patient.reset()
    return ok("all nodes booted after a reset of communication")


def check_contract(patient: ArmExamination) -> Finding:
    """Check that the devices' wire version and layout digest, 0x2000, are those of the host's DBC."""
    codec = patient.codec
    lacking = []
    for name, node in patient.master.nodes.items():
        version, digest = read_object(node, 0x2000, 1), read_object(node, 0x2000, 2)
        if version is None or digest is None:
            lacking.append(name)
            continue
        pair = int.from_bytes(version, "little"), int.from_bytes(digest, "little")
        if pair != (codec.wire_version, codec.layout_digest):
            return failed(
                f"{name}: wire version {pair[0]}, layout digest 0x{pair[1]:08X}; the DBC's are "
                f"{codec.wire_version}, 0x{codec.layout_digest:08X}",
                "give host and devices the same DBC file",
            )
    if lacking:
        return skipped(f"{', '.join(lacking)} has no contract object 0x2000; the PDO map is compared instead")
    return ok(f"wire version {codec.wire_version}, layout digest 0x{codec.layout_digest:08X}")


def set_up_nodes(patient: ArmExamination) -> Finding:
    """Identify and configure the nodes as at the start of a run; name SYNC period and heartbeat. Raises DeviceError."""
    patient.master.identify()
    patient.master.configure()
    return ok(f"SYNC period {patient.settings.bus.period_us} µs, heartbeat {patient.settings.bus.heartbeat_ms} ms")


def check_pdo_map(patient: ArmExamination) -> Finding:
    """Check that the devices' PDO parameters and mappings are those of the contract."""
    lines = []
    for slave in patient.master.slaves:
        lines += pdo_differences(slave, command_deadline_ms(patient.settings))
    if lines:
        return failed(
            "; ".join(lines), "correct [[pdo]] of the devices' profiles, or map the devices' PDOs accordingly"
        )
    return ok("read back, equal to the contract")


def describe_torque_scale(slave: Slave, rated_Nm: float) -> str:
    """Describe how a motor's rated torque, 0x6076, becomes that of its joint, `rated_Nm`. Raises DeviceError."""
    if not slave.has(0x6076):
        return f"{slave.name}: its EDS has no 0x6076, so nothing confirms {rated_Nm:g} Nm at the joint"
    scale = slave.device.settings.scale
    parts = [f"{slave.read(0x6076)} {torque_unit(scale)}"]
    if scale.gear_ratio != 1.0:
        parts.append(f"gear {scale.gear_ratio:g}")
    if scale.gear_efficiency != 1.0:
        parts.append(f"efficiency {scale.gear_efficiency:g}")
    return f"{slave.name}: 0x6076 = {' x '.join(parts)}, {rated_Nm:.4g} Nm at the joint, 0.1 % of it a count"


def check_torque_scale(patient: ArmExamination) -> Finding:
    """Describe the drives' rated torques at the joints, which the set-up has compared; warn if one has no 0x6076."""
    slaves = patient.master.slaves[:JOINTS]
    pairs = zip(slaves, patient.settings.arm.rated_torque_Nm, strict=True)
    text = "; ".join(describe_torque_scale(slave, rated_Nm) for slave, rated_Nm in pairs)
    if any(not slave.has(0x6076) for slave in slaves):
        return warning(text, "compare `arm.rated_torque_Nm` with the data sheets of motor and gear")
    return ok(text)


def check_protection(patient: ArmExamination) -> Finding:
    """Check that every cyclic frame has an end-to-end header; name those without one."""
    names = [
        message.name
        for message in patient.codec.messages.values()
        if message.can_id & 0x780 in _PDOS and not message.is_protected
    ]
    if names:
        return warning(
            f"unprotected: {', '.join(names)}",
            "plausibility alone guards them; a CAN FD contract has room for a header in every frame",
        )
    return ok("every cyclic frame has an end-to-end header")


def play_cycles(patient: ArmExamination) -> Finding:
    """Start the nodes, run cycles with disabled drives, and store the cycles for the further checks."""
    patient.tap.take_passed()
    patient.master.start()
    patient.loop.run(patient.cycle_s, patient.cycles.append)
    for cycle in patient.cycles:
        for is_sent, frame in cycle.frames:
            if not is_sent:
                patient.traffic.count_frame(frame)
    return ok(f"{len(patient.cycles)} cycles, torque zero, drives not enabled")


def check_rate(patient: ArmExamination) -> Finding:
    """Check that enough of the stored cycles have complete fresh data; name the rates of SYNC and feedback."""
    report = patient.communication()
    elapsed_s = report.periods * patient.settings.bus.period_s
    rates = ", ".join(
        f"{name} {device['share'] * report.periods / elapsed_s:.0f}/s" for name, device in report.devices().items()
    )
    text = (
        f"SYNC {report.cycles / elapsed_s:.0f}/s of {1e6 / patient.settings.bus.period_us:.0f}, {rates}; "
        f"{100.0 * report.share:.1f} % of the periods complete, {report.overruns} skipped"
    )
    remedy = (
        "`adacd-hil commtest` shows the late part; see `scheduler` and `preemption`, or choose a longer bus.period_us"
    )
    if report.verdict is Verdict.NOT_SUFFICIENT:
        return failed(text, remedy)
    return warning(text, remedy) if report.verdict is Verdict.WARNING else ok(text)


def check_load(patient: ArmExamination) -> Finding:
    """Check that the bus load is at most `HIGH_LOAD_PERCENT`, which leaves room for frames that are not cyclic."""
    load = patient.communication().load_percent()
    text = f"{load:.1f} % at {patient.bitrate} bit/s"
    if load > HIGH_LOAD_PERCENT:
        return warning(text, "choose a longer bus.period_us or CAN FD; `adacd-hil budget` shows the time of each frame")
    return ok(text)


def check_heartbeats(patient: ArmExamination) -> Finding:
    """Check that each node whose heartbeat is watched sends it in state Operational, often enough."""
    expected_Hz = 1e3 / patient.settings.bus.heartbeat_ms
    silent, odd, slow, unwatched = [], [], [], []
    for slave in patient.master.slaves:
        name, talk = slave.name, patient.traffic.talks.get(0x700 + slave.node_id)
        if not slave.device.is_heartbeat_known:
            unwatched.append(name)
        elif talk is None:
            silent.append(name)
        elif talk.data != b"\x05":
            odd.append(f"{name} is {NMT_STATES.get(talk.data[0] & 0x7F if talk.data else -1, 'in an unknown state')}")
        elif talk.rate_Hz is not None and talk.rate_Hz < expected_Hz / 1.5:
            slow.append(f"{name} {talk.rate_Hz:.1f}/s")
    if silent:
        return failed(f"no heartbeat from {', '.join(silent)}", "the node must produce 0x1017; is it still powered?")
    if odd:
        return failed(f"{', '.join(odd)}, after NMT start", "see the node's EMCY and its manual")
    if slow:
        return warning(
            f"slower than {expected_Hz:g}/s: {', '.join(slow)}", "a loaded bus delays heartbeats: see `load`"
        )
    if unwatched:
        return warning(
            f"not watched: {', '.join(unwatched)}",
            "the EDS lets no host set 0x1017; only missing cyclic frames show that such a device is silent",
        )
    return ok(f"all operational, every {patient.settings.bus.heartbeat_ms} ms")


def check_devices(patient: ArmExamination) -> Finding:
    """Check that no drive is in fault, no device reports an error, and bounded values are within their bounds."""
    lines = [line for line in describe_faults(patient.arm) if ": status" not in line]
    events = [f"{event.name}: {event.message}" for event in patient.master.take_events() if event.level != "info"]
    text = "; ".join([*lines, *events])
    if any(device.has_excess(patient.arm.cycle) for device in patient.arm.devices):
        return failed(text, "no run enables the arm outside `low` and `high` of a device's profile, or without a value")
    if text:
        return warning(text, "a run resets the fault if its cause has gone")
    return ok("no fault, no EMCY")


def check_saturation(patient: ArmExamination) -> Finding:
    """Check that no sensor is saturated or invalid."""
    reported = {sensor.name: SensorStatus(sensor.status) for sensor in patient.arm.sensors if sensor.status}
    text = ", ".join(f"{name} {status!r}" for name, status in reported.items())
    if any(status & SensorStatus.NOT_VALID for status in reported.values()):
        return failed(text, "see the sensor's EMCY; check its cable to the strain gauge")
    if reported:
        return failed(text, "take the load off the joint; the arm must hang free")
    return ok("within range")


def _by_joint(form: str, values: Vector) -> str:
    return ", ".join(f"joint {number} {form.format(value)}" for number, value in enumerate(values.tolist(), start=1))


def check_rest(patient: ArmExamination) -> Finding:
    """Check that the arm stands still with its drives off."""
    dq = patient.joint_values("dq")
    if not len(dq):
        return skipped("no complete cycle")
    fastest = np.abs(dq).max(axis=0)
    bound = patient.settings.safety.rest_velocity_rad_s
    text = _by_joint("up to {:.4f} rad/s", fastest)
    if np.any(fastest > bound):
        return failed(f"{text}, above {bound:g}", "let the arm come to rest and keep hands off")
    return ok(text)


def check_torque_zero(patient: ArmExamination) -> Finding:
    """Check that the torque at rest is near zero."""
    tau_J = patient.joint_values("tau_J")
    if not len(tau_J):
        return skipped("no complete cycle")
    mean = tau_J.mean(axis=0)
    bound = patient.settings.safety.rest_torque_Nm
    text = _by_joint("{:+.4f} Nm", mean)
    remedy = "let the arm hang free, then `adacd-hil tare`"
    if np.any(np.abs(mean) > bound):
        return failed(f"{text}, above {bound:g}", remedy)
    if np.any(np.abs(mean) > patient.settings.detector.threshold_Nm):
        return warning(f"{text}: more than the detection threshold", remedy)
    return ok(text)


def check_noise(patient: ArmExamination) -> Finding:
    """Check that the torque signal changes, and that its noise is small."""
    tau_J = patient.joint_values("tau_J")
    if len(tau_J) < 2:
        return skipped("no complete cycles")
    spread = tau_J.std(axis=0)
    text = _by_joint("{:.3f} mNm rms", 1000.0 * spread)
    if np.any(np.ptp(tau_J, axis=0) == 0.0):
        return warning(f"{text}: a value that never changes", "check the cable to the strain gauge")
    if np.any(spread > np.array(patient.settings.detector.threshold_Nm) / 3.0):
        return warning(
            f"{text}: three of it exceed the detection threshold", "check shield and ground; move drive cables away"
        )
    return ok(text)


def check_bus_errors(patient: ArmExamination) -> Finding:
    """Check that no error frame came during the cycles, and that the controller is in state ERROR-ACTIVE."""
    link = patient.read_link()
    errors = patient.traffic.error_frames
    counters = ""
    if link is not None and link.state is not None:
        counters = f", {link.state}, error counters rx {link.rx_errors or 0}, tx {link.tx_errors or 0}"
    if errors or (link is not None and link.state not in (None, "ERROR-ACTIVE")):
        return warning(f"{errors} error frames{counters}", "check wiring, termination and bit rate")
    return ok(f"no error frame{counters}")


def _check_joint(joint: int) -> Callable[[ArmExamination], Finding]:
    """Return the check of a joint's signs, for which the user moves the joint by hand; skipped without a user."""

    def check(patient: ArmExamination) -> Finding:
        if patient.ask is None:
            return skipped(patient.no_move_reason)
        tau_J = patient.joint_values("tau_J")
        if not len(tau_J):
            return skipped("no complete cycle")
        motion = HandMotion(joint, tau_J.mean(axis=0))
        patient.ask(
            f"move joint {joint + 1} by hand toward +q, at least {motion.WANTED_DEG:g} degrees, "
            f"within {patient.move_s:g} s"
        )
        patient.loop.run(patient.move_s, motion.observe_cycle, lambda: motion.is_done)
        return motion.judge()

    return check


WORK_FLOOR_J = 1e-3
"""Least work that shows a sign: 10 degrees against 6 mNm. Noise and zero error make less on a free joint."""
_DOMINANCE = 2.0
"""Least ratio of the moved joint's travel to the other joint's."""


class HandMotion:
    """Judges the signs of joint `joint` (0, 1) while the user moves it toward +q, its drive disabled.

    The hand drives the arm, and the arm drives the idle motor through the sensor, so the sensed torque opposes the
    motion: the work ∫ tau_J dq must be negative. q, dq, tau_J (2,) are in joint coordinates. `zero_Nm` (2,): torque at
    rest.
    """

    WANTED_DEG = 10.0

    def __init__(self, joint: int, zero_Nm: Vector) -> None:
        self._joint = joint
        self._start: Vector | None = None
        self._last: Vector | None = None
        self._way = np.zeros(JOINTS)
        self._work_J = np.zeros(JOINTS)
        self._zero_Nm = zero_Nm

    @property
    def is_done(self) -> bool:
        """Whether any joint has moved by `WANTED_DEG`."""
        return bool(np.abs(self._way).max() >= math.radians(self.WANTED_DEG))

    def observe_cycle(self, cycle: ZeroTorqueCycle) -> None:
        """Add a cycle to the travel and the work of the joints; ignore an incomplete cycle."""
        state = cycle.state
        if not state.is_complete:
            return
        if self._start is None or self._last is None:
            self._start = self._last = state.q
            return
        self._work_J += (state.tau_J - self._zero_Nm) * (state.q - self._last)
        self._last = state.q
        self._way = state.q - self._start

    def judge(self) -> Finding:
        """Judge the motion so far: whether the right joint moved, and position and torque have the right signs."""
        joint, number = self._joint, self._joint + 1
        ways_deg = np.degrees(self._way)
        moved = int(np.argmax(np.abs(self._way)))
        text = f"moved {ways_deg[0]:+.1f} and {ways_deg[1]:+.1f} deg, work {self._work_J[joint]:+.4f} J"
        if not self.is_done:
            return warning(f"not moved by {self.WANTED_DEG:g} deg in time ({text})", "run doctor --move again")
        if moved != joint:
            return failed(
                f"drive {moved + 1} reports the motion of joint {number} ({text})",
                "exchange the node ids of the drives, or their cables",
            )
        if abs(self._way[joint]) < _DOMINANCE * abs(self._way[1 - joint]):
            return warning(f"both joints moved ({text})", "hold the other joint and run doctor --move again")
        if self._way[joint] < 0.0:
            return failed(f"position decreases toward +q ({text})", f"reverse arm.sign of joint {number}")
        return self._judge_torque(text)

    def _judge_torque(self, text: str) -> Finding:
        work_J = self._work_J[self._joint]
        if work_J > WORK_FLOOR_J:
            return failed(
                f"the torque has the motion's sign: it should oppose it ({text})",
                "reverse the torque sensor's sign (0x6126 or the maker's tool), or exchange the sensors",
            )
        if work_J > -WORK_FLOOR_J:
            return warning(f"right joint and direction; too little torque to tell its sign ({text})", "move it faster")
        return ok(f"right joint, right signs ({text})")


ARM_CHECKS: tuple[Check[ArmExamination], ...] = (
    Check("bus", open_arm_bus, ("kernel", "interface", "controller")),
    Check("other masters", check_other_masters, ("bus",)),
    Check("nodes", check_nodes, ("bus", "other masters")),
    Check("boot", boot_nodes, ("bus", "other masters", "nodes")),
    Check("contract", check_contract, ("boot",)),
    Check("set-up", set_up_nodes, ("boot", "contract")),
    Check("PDO map", check_pdo_map, ("boot", "set-up")),
    Check("torque scale", check_torque_scale, ("boot", "set-up")),
    Check("protection", check_protection),
    Check("cycle", play_cycles, ("boot", "contract", "set-up", "PDO map")),
    Check("rate", check_rate, ("cycle",)),
    Check("load", check_load, ("cycle",)),
    Check("heartbeat", check_heartbeats, ("cycle",)),
    Check("devices", check_devices, ("cycle",)),
    Check("saturation", check_saturation, ("cycle",)),
    Check("rest", check_rest, ("cycle",)),
    Check("torque zero", check_torque_zero, ("cycle", "rest", "saturation")),
    Check("torque noise", check_noise, ("cycle", "rest", "saturation")),
    Check("bus errors", check_bus_errors, ("cycle",)),
    *(Check(f"joint {joint + 1}", _check_joint(joint), ("cycle", "rest")) for joint in range(JOINTS)),
)
