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
from adacd_hil.device.device_setup import Slave, command_deadline_ms, pdo_differences, sensor_channel, torque_unit
from adacd_hil.device.drive_units import read_drive_units
from adacd_hil.device.network import Master
from adacd_hil.device.profile import ObjectName, PlacedDevice
from adacd_hil.device.strangers import host_frames
from adacd_hil.device.torque_sensor import SensorStatus, TorqueSensor
from adacd_hil.lab.commission.communication_test import (
    CommunicationTest,
    Verdict,
    ZeroTorqueCycle,
    ZeroTorqueLoop,
)
from adacd_hil.lab.commission.host_checks import Check, Finding, failed, ok, skipped, warning
from adacd_hil.lab.commission.profile_draft import POLARITIES
from adacd_hil.lab.commission.survey import NMT_STATES, compare, survey
from adacd_hil.lab.commission.tare import ArmMovedError, check_motion
from adacd_hil.lab.commission.traffic import Traffic, listen
from adacd_hil.records import JOINTS, ArmState, Vector
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.bus import Bus, BusError, Tap
from adacd_hil.wire.can_interface import InterfaceState
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.contract_attributes import DEFAULT_BITRATE
from adacd_hil.wire.contract_frames import FUNCTION_MASK, HEARTBEAT_ID, RPDO_IDS, TPDO_IDS

LISTEN_S = 0.5
"""Listening time for other masters: five of the usual heartbeats of 100 ms."""
HIGH_LOAD_PERCENT = 80.0
"""Bus load above which the worst case (stuff bits, a status and an SDO frame) does not fit a period."""


@dataclass
class ArmExamination:
    """The arm that doctor examines, and the results of the checks so far. Call `connect` first, `leave` last.

    open_bus: opens the bus without a filter. read_link: returns the interface's present state, None without SocketCAN.
    ask: prints an instruction to the user; None if no user can move the arm, for the reason in `no_move_reason`.
    cycle_s: duration of the cycles. move_s: time for the user to move a joint. cycles, traffic: of `play_cycles`, empty
    before.
    """

    settings: Settings
    codec: Codec
    devices: Sequence[PlacedDevice]
    clock: Clock
    open_bus: Callable[[], Bus]
    read_link: Callable[[], InterfaceState | None]
    bitrate: int = DEFAULT_BITRATE
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
        """Open the bus; make tap, arm and master on it. `leave` closes it.

        Raises BusMissingError if the bus can't be opened.
        """
        self._bus = self.open_bus()
        self.tap = Tap(self._bus, self.clock)
        self.arm = Arm(self.settings, self.codec, self.devices, self.tap)
        self.master = Master(self.settings, self.codec, self.devices, self.tap)

    @cached_property
    def loop(self) -> ZeroTorqueLoop:
        """The zero-torque loop of this examination, made at its first use, after `connect`.

        Later runs continue its cycle count.
        """
        return ZeroTorqueLoop(self.settings, self.tap, self.clock, self.arm, self.master)

    def reset(self) -> None:
        """Reset the communication of the nodes; from now on `leave` stops them, even if this fails.

        Raises DeviceError for a node that doesn't come back, BusError if the bus fails.
        """
        self._has_reset = True
        self.master.reset()

    def leave(self) -> str:
        """Put the nodes back to pre-operational, if `reset` was called, and close the bus, if it is open.

        Return the text of the bus's error if the nodes could not be put back, else "".
        """
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
        """Return a new communication test with the cycles that `play_cycles` has stored; without any before that."""
        test = CommunicationTest(self.settings, self.arm, self.bitrate, self.data_bitrate)
        for cycle in self.cycles:
            test.observe_cycle(cycle)
        return test

    def joint_values(self, name: str) -> NDArray[np.float64]:
        """Return a quantity of the stored cycles with complete data (n, 2), n = 0 if there are none.

        name: "q", rad, "dq", rad/s, or "tau_J", Nm.
        """
        return _joint_values([cycle.state for cycle in self.cycles if cycle.state.is_complete], name)


def _joint_values(states: Sequence[ArmState], name: str) -> NDArray[np.float64]:
    return np.array([getattr(state, name) for state in states], dtype=np.float64).reshape(len(states), JOINTS)


def open_arm_bus(patient: ArmExamination) -> Finding:
    """Open the bus, and leave it open for the further checks. An error of the bus is raised."""
    patient.connect()
    return ok(f"{patient.tap.channel} is open")


def check_other_masters(patient: ArmExamination) -> Finding:
    """Listen for `LISTEN_S`, and fail if a frame comes that only a host sends. NMT is allowed on a shared bus.

    The frames heard are then removed from the tap. Raises BusError if the bus fails.
    """
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
    """Fail if an expected node is missing, doesn't answer SDO or has another identity; warn of nodes not configured.

    The wire version and layout digest aren't compared here. Raises BusError if the bus fails.
    """
    slaves = patient.master.slaves
    verdicts = compare(survey(patient.tap, patient.clock, 0.0), slaves)
    wrong = [f"node {node}: {text}" for node, text in verdicts.items() if text not in ("", "unexpected")]
    if wrong:
        return failed("; ".join(wrong), "check power, wiring, node id (0x100B or the maker's tool) and configuration")
    strangers = [str(node) for node, text in verdicts.items() if text]
    if strangers:
        return warning(f"node {', '.join(strangers)} is not in the configuration", "take it off the bus if it can be")
    return ok(", ".join(f"{node.name} (node {node.node_id})" for node in slaves))


def boot_nodes(patient: ArmExamination) -> Finding:
    """Reset the communication of the nodes, and wait until each has booted.

    Raises DeviceError if one doesn't, BusError if the bus fails.
    """
    patient.reset()
    return ok("all nodes booted after a reset of communication")


def check_contract(patient: ArmExamination) -> Finding:
    """Compare wire version and layout digest, 0x2000, of each device whose profile has that object with the host's DBC.

    The check is skipped if the profile of a device lacks it and none differs. Raises DeviceError if a device differs,
    refuses or doesn't answer, BusError if the bus fails.
    """
    lacking = []
    for slave in patient.master.slaves:
        if slave.device.settings.contract_object:
            patient.master.check_contract(slave)
        else:
            lacking.append(slave.name)
    if lacking:
        return skipped(f"{', '.join(lacking)} has no contract object 0x2000; the PDO map is compared instead")
    return ok(f"wire version {patient.codec.wire_version}, layout digest 0x{patient.codec.layout_digest:08X}")


def set_up_nodes(patient: ArmExamination) -> Finding:
    """Identify and configure the nodes as at the start of a run.

    The finding names SYNC period and heartbeat. Raises DeviceError if a node is another one than configured, or refuses
    a setting, BusError if the bus fails.
    """
    patient.master.identify()
    patient.master.configure()
    return ok(f"SYNC period {patient.settings.bus.period_us} µs, heartbeat {patient.settings.bus.heartbeat_ms} ms")


def check_pdo_map(patient: ArmExamination) -> Finding:
    """Read the devices' PDO parameters and mappings; fail if one differs from the contract.

    Raises DeviceError if a device refuses a read or doesn't answer.
    """
    lines = []
    for slave in patient.master.slaves:
        lines += pdo_differences(slave, command_deadline_ms(patient.settings))
    if lines:
        return failed(
            "; ".join(lines), "correct [[pdo]] of the devices' profiles, or map the devices' PDOs accordingly"
        )
    return ok("read back, equal to the contract")


def check_torque_scale(patient: ArmExamination) -> Finding:
    """Describe each drive's way from 0x6076 to the rated torque of its joint, and the torque of a sensor's count.

    The set-up has compared the values already; warn of an EDS without the objects. Raises DeviceError if a device
    refuses a read or doesn't answer.
    """
    slaves = patient.master.slaves
    pairs = zip(slaves[:JOINTS], patient.settings.arm.rated_torque_Nm, strict=True)
    return _together([*(_rated_torque(*pair) for pair in pairs), *map(_torque_of_count, slaves[JOINTS:])])


def check_position_scale(patient: ArmExamination) -> Finding:
    """Describe each drive's increments per revolution of the joint; warn if no object or a factory value tells them.

    Also warn of a polarity, 0x607E, that reverses some of position, velocity and torque, and not all. The set-up has
    compared the increments that an object tells. Raises DeviceError if a drive refuses a read or doesn't answer.
    """
    drives = patient.master.slaves[:JOINTS]
    return _together([*map(_increments, drives), *(_polarity(slave) for slave in drives if slave.has(0x607E))])


def _together(findings: Sequence[Finding]) -> Finding:
    """Return findings on several devices, passed or warnings, as one: a warning if one of them is."""
    text = "; ".join(finding.reason for finding in findings)
    remedies = dict.fromkeys(finding.remedy for finding in findings if finding.remedy)
    return warning(text, "; ".join(remedies)) if remedies else ok(text)


def _rated_torque(slave: Slave, rated_Nm: float) -> Finding:
    """Return the finding that states a motor's rated torque, 0x6076, and that of its joint, `rated_Nm`.

    They are not compared here: `Master.configure` has done that. A warning if the EDS has no 0x6076. Raises DeviceError
    if the drive refuses the read or doesn't answer.
    """
    if not slave.has(0x6076):
        return warning(
            f"{slave.name}: its EDS has no 0x6076, so nothing confirms {rated_Nm:g} Nm at the joint",
            "compare `arm.rated_torque_Nm` with the data sheets of motor and gear",
        )
    scale = slave.device.settings.scale
    parts = [f"{slave.read(0x6076)} {torque_unit(scale)}"]
    if scale.gear_ratio != 1.0:
        parts.append(f"gear {scale.gear_ratio:g}")
    if scale.gear_efficiency != 1.0:
        parts.append(f"efficiency {scale.gear_efficiency:g}")
    return ok(f"{slave.name}: 0x6076 = {' x '.join(parts)}, {rated_Nm:.4g} Nm at the joint, 0.1 % of it a count")


def _torque_of_count(slave: Slave) -> Finding:
    """Return the finding on the torque of one count of a sensor: a warning if the EDS lacks 0x6131 or 0x6132.

    With both, the set-up has compared it. Reads nothing.
    """
    count, channel = f"{slave.device.settings.scale.torque_Nm:g} Nm a count", sensor_channel(slave)
    lacking = [str(ObjectName(index, channel)) for index in (0x6131, 0x6132) if not slave.has(index, channel)]
    if lacking:
        return warning(
            f"{slave.name}: its EDS has no {', '.join(lacking)}, so nothing confirms {count}",
            "compare `scale.torque_Nm` with the sensor's data sheet, or by a known weight",
        )
    return ok(f"{slave.name}: {count}")


def _increments(slave: Slave) -> Finding:
    """Return the finding on a drive's increments per revolution of the joint: a warning if no object tells them.

    So, too, if its objects have a factory value. Raises DeviceError if the drive refuses a read or doesn't answer.
    """
    scale = slave.device.settings.scale
    units = read_drive_units(lambda *place: slave.read(*place) if slave.has(*place) else None, scale.gear_ratio)
    count = f"{scale.increments_per_joint_rev:.10g} increments per revolution of the joint"
    if units.has_increments:
        return ok(f"{slave.name}: {count}, {units.increments_text}")
    return warning(
        f"{slave.name}: nothing confirms {count}" + f": {units.increments_text}" * bool(units.increments_text),
        "turn each joint by a known angle, and compare it with the position",
    )


def _polarity(slave: Slave) -> Finding:
    """Return the finding on a drive's 0x607E: a warning if it reverses only some quantities. Raises DeviceError."""
    polarity = slave.read(0x607E)
    text = f"{slave.name}: polarity 0x607E = 0x{polarity:02X}"
    if polarity & 0xE0 in POLARITIES:
        return ok(text)
    return warning(
        f"{text}: position and torque may count against each other, and the arm run away",
        "set 0x607E to 0 with the maker's tool; `arm.sign` reverses a joint",
    )


def check_protection(patient: ArmExamination) -> Finding:
    """Warn of PDOs of the contract, event-driven ones too, without an end-to-end header, by name."""
    names = [
        message.name
        for message in patient.codec.messages.values()
        if message.can_id & FUNCTION_MASK in (*TPDO_IDS, *RPDO_IDS) and not message.is_protected
    ]
    if names:
        return warning(
            f"unprotected: {', '.join(names)}",
            "plausibility alone guards them; a CAN FD contract has room for a header in every frame",
        )
    return ok("every cyclic frame has an end-to-end header")


def play_cycles(patient: ArmExamination) -> Finding:
    """Start the nodes, run cycles for `cycle_s` with disabled drives; store cycles and received traffic for the checks.

    Frames that passed the tap before are dropped. Raises BusError if the bus fails.
    """
    patient.tap.take_passed()
    patient.master.start()
    patient.loop.run(patient.cycle_s, patient.cycles.append)
    for cycle in patient.cycles:
        for is_sent, frame in cycle.frames:
            if not is_sent:
                patient.traffic.count_frame(frame)
    return ok(f"{len(patient.cycles)} cycles, torque zero, drives not enabled")


def check_rate(patient: ArmExamination) -> Finding:
    """Fail or warn if too few periods have complete fresh data, by the bounds of `commtest`.

    The finding names the rates of SYNC and of each device's fresh values, and the number of skipped periods.
    """
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
    """Warn if the bus load is above `HIGH_LOAD_PERCENT`, too little room for other frames.

    It is the load of the last stored cycles, as of `CommunicationTest.load_percent`.
    """
    load = patient.communication().load_percent()
    text = f"{load:.1f} % at {patient.bitrate} bit/s"
    if load > HIGH_LOAD_PERCENT:
        return warning(text, "choose a longer bus.period_us or CAN FD; `adacd-hil budget` shows the time of each frame")
    return ok(text)


def check_heartbeats(patient: ArmExamination) -> Finding:
    """Fail if a node sent no heartbeat in the stored cycles, or its last one is not Operational.

    Warn if heartbeats came at less than two thirds of their rate. A node whose heartbeat can't be set by its EDS isn't
    watched: warn of it. Only the worst of these is reported.
    """
    expected_Hz = 1e3 / patient.settings.bus.heartbeat_ms
    silent, odd, slow, unwatched = [], [], [], []
    for slave in patient.master.slaves:
        name, talk = slave.name, patient.traffic.talks.get(HEARTBEAT_ID + slave.node_id)
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
    """Fail if a value is outside `low` and `high` of its device's profile, or a status with bounds is missing or old.

    Warn of other faults of the drives, values that are too old, other senders, and EMCYs and other events of the
    devices, which are taken from the master. A sensor's status isn't looked at here.
    """
    lines = [line for line in describe_faults(patient.arm) if ": status 0x" not in line]
    events = [f"{event.name}: {event.message}" for event in patient.master.take_events() if event.level != "info"]
    text = "; ".join([*lines, *events])
    if any(device.has_excess(patient.arm.cycle) for device in patient.arm.devices):
        return failed(text, "no run enables the arm outside `low` and `high` of a device's profile, or without a value")
    if text:
        return warning(text, "a run resets the fault if its cause has gone")
    return ok("no fault, no EMCY")


def check_saturation(patient: ArmExamination) -> Finding:
    """Fail if a sensor's last status is not zero: saturated, not valid; warn of sensors that can't tell.

    They send no status, and their profile has no `plausibility.torque_range_Nm`. The check is skipped without complete
    cycles.
    """
    if not len(patient.joint_values("tau_J")):
        return skipped("no complete cycle")
    reported = {sensor.name: SensorStatus(sensor.status) for sensor in patient.arm.sensors if sensor.status}
    text = ", ".join(f"{name} {status!r}" for name, status in reported.items())
    if any(status & SensorStatus.NOT_VALID for status in reported.values()):
        return failed(text, "see the sensor's EMCY; check its cable to the strain gauge")
    if reported:
        return failed(text, "take the load off the joint; the arm must hang free")
    mute = [sensor.name for sensor in patient.arm.sensors if not _tells_range(sensor, patient.devices)]
    if mute:
        return warning(
            f"{', '.join(mute)}: no status, and no range in the profile: a saturated torque isn't noticed",
            "give `plausibility.torque_range_Nm` of its profile",
        )
    return ok("within range")


def _tells_range(sensor: TorqueSensor, devices: Sequence[PlacedDevice]) -> bool:
    """Return whether a sensor's frames or its profile make a saturation visible. devices: of the arm."""
    frames = (pdo for device in devices if device.name == sensor.name for pdo in device.settings.pdo)
    has_status = any(signal.signal == "status" for pdo in frames for signal in pdo.signals)
    return has_status or sensor.status_in_header is not None or sensor.torque_range_Nm > 0.0


def _by_joint(form: str, values: Vector) -> str:
    return ", ".join(f"joint {number} {form.format(value)}" for number, value in enumerate(values.tolist(), start=1))


def check_rest(patient: ArmExamination) -> Finding:
    """Fail if a joint moved or crept in the stored cycles, as a tare judges it by `check_motion`.

    The check is skipped if no cycle is complete.
    """
    q, dq = patient.joint_values("q"), patient.joint_values("dq")
    if not len(dq):
        return skipped("no complete cycle")
    try:
        check_motion(q, dq, patient.settings)
    except ArmMovedError as moved:
        return failed(str(moved), "let the arm come to rest and keep hands off")
    return ok(_by_joint("up to {:.4f} rad/s", np.abs(dq).max(axis=0)))


def check_torque_zero(patient: ArmExamination) -> Finding:
    """Fail if a joint's mean torque at rest is above `safety.rest_torque_Nm`; warn above the detection threshold.

    The check is skipped without complete cycles.
    """
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
    """Warn if a torque never changed in the stored cycles, or is so noisy that it looks like a contact.

    Noisy: three times its standard deviation exceeds the detection threshold. The check is skipped with fewer than two
    complete cycles.
    """
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
    """Warn if an error frame came during the cycles, or the controller's state is known and not ERROR-ACTIVE."""
    link = patient.read_link()
    errors = patient.traffic.error_frames
    counters = ""
    if link is not None and link.state is not None:
        counters = f", {link.state}, error counters rx {link.rx_errors or 0}, tx {link.tx_errors or 0}"
    if errors or (link is not None and link.state not in (None, "ERROR-ACTIVE")):
        return warning(f"{errors} error frames{counters}", "check wiring, termination and bit rate")
    return ok(f"no error frame{counters}")


WORK_FLOOR_J = 1e-3
"""Least work that shows a sign: 10 degrees against 6 mNm. Noise and zero error make less on a free joint."""
_DOMINANCE = 2.0
"""Least ratio of the moved joint's travel to the other joint's."""
_WANTED_DEG = 10.0
"""Travel of a joint that ends the motion by hand."""


def _check_joint(joint: int) -> Callable[[ArmExamination], Finding]:
    """Return the check of a joint's signs, for which the user moves the joint by hand. joint: from 0.

    It runs cycles for `move_s`, or until a joint has moved by `_WANTED_DEG`. The check is skipped if no user can be
    asked, or there are no complete cycles.
    """

    def check(patient: ArmExamination) -> Finding:
        if patient.ask is None:
            return skipped(patient.no_move_reason)
        at_rest_Nm = patient.joint_values("tau_J")
        if not len(at_rest_Nm):
            return skipped("no complete cycle")
        states: list[ArmState] = []

        def observe(cycle: ZeroTorqueCycle) -> None:
            if cycle.state.is_complete:
                states.append(cycle.state)

        def way() -> Vector:
            return states[-1].q - states[0].q if states else np.zeros(JOINTS)

        patient.ask(
            f"move joint {joint + 1} by hand toward +q, at least {_WANTED_DEG:g} degrees, within {patient.move_s:g} s"
        )
        patient.loop.run(patient.move_s, observe, lambda: _has_moved(way()))
        steps = np.diff(_joint_values(states, "q"), axis=0)
        torque_Nm = _joint_values(states, "tau_J")[1:] - at_rest_Nm.mean(axis=0)
        return _judge_motion(joint, way(), float((torque_Nm * steps)[:, joint].sum()))

    return check


def _has_moved(way: Vector) -> bool:
    return bool(np.abs(way).max() >= math.radians(_WANTED_DEG))


def _judge_motion(joint: int, way: Vector, work_J: float) -> Finding:
    """Return the finding on a motion by hand toward +q: whether the right joint moved, with the right signs.

    joint: from 0. way (2,): travel of both joints, rad. work_J: of the joint, as of `_judge_work`. A failure if the
    other joint moved further, q decreased, or the torque has the motion's sign. A warning if no joint moved far enough,
    the other joint moved along, or too little torque tells the sign.
    """
    number, moved = joint + 1, int(np.argmax(np.abs(way)))
    text = "moved {:+.1f} and {:+.1f} deg, work {:+.4f} J".format(*np.degrees(way), work_J)
    if not _has_moved(way):
        return warning(f"not moved by {_WANTED_DEG:g} deg in time ({text})", "run doctor --move again")
    if moved != joint:
        return failed(
            f"drive {moved + 1} reports the motion of joint {number} ({text})",
            "exchange the node ids of the drives, or their cables",
        )
    if abs(way[joint]) < _DOMINANCE * abs(way[1 - joint]):
        return warning(f"both joints moved ({text})", "hold the other joint and run doctor --move again")
    if way[joint] < 0.0:
        return failed(f"position decreases toward +q ({text})", f"reverse arm.sign of joint {number}")
    return _judge_work(work_J, text)


def _judge_work(work_J: float, text: str) -> Finding:
    """Return the finding on the work ∫ tau_J dq of a joint moved by hand, its drive disabled, zero torque subtracted.

    The hand drives the arm, and the arm drives the idle motor through the sensor, so the sensed torque opposes the
    motion: the work must be negative. The check fails above `WORK_FLOOR_J`, warns down to -`WORK_FLOOR_J`, and passes
    below that. text: of the motion.
    """
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
    Check("position scale", check_position_scale, ("boot", "set-up")),
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
