"""Our master and arm run slaves that we did not write: canopen's LocalNode, untouched, from stock EDS files.

Only the application is here: the CiA 402 state machine, a mass, a torque, and PDOs through canopen's own classes. All
in one process, in virtual time.
"""

import contextlib
import dataclasses
import functools
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import canopen
import numpy as np
import pytest
from loaded import loaded_contract
from own_arm import OWN_SENSOR

from adacd_hil.device.arm import Arm
from adacd_hil.device.canopen_bus import DeviceError
from adacd_hil.device.device_files import place_devices
from adacd_hil.device.network import Master
from adacd_hil.records import ArmCommand, ArmState, FaultReason
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.wire.bus import Bus, Frame
from adacd_hil.wire.dbc_contract import contract_folder

PERIOD_NS = 1_000_000
INCREMENTS_PER_RAD = 1048576 / (2 * np.pi)
STATUSWORDS = {
    "switch on disabled": 0x0250,
    "ready to switch on": 0x0231,
    "switched on": 0x0233,
    "operation enabled": 0x0237,
}


@functools.cache
def read_once(eds: Path, node_id: int) -> canopen.ObjectDictionary:
    """What LocalNode does with a path, but not again for each test; a node keeps its values elsewhere."""
    return canopen.import_od(str(eds), node_id)


compose_once = functools.cache(loaded_contract)


class Timer:
    """Calls an action in virtual time, at a period where it has one. canopen gets one for `send_periodic`."""

    def __init__(self, wire: "Wire", due_s: float, action: Callable[[], None], period_s: float = 0.0) -> None:
        self._wire, self._action, self._period_ns = wire, action, round(period_s * 1e9)
        self.due_ns = wire.now_ns + round(due_s * 1e9)
        wire.timers.append(self)

    def fire(self) -> None:
        self.due_ns += self._period_ns
        if not self._period_ns:
            self.stop()
        self._action()

    def stop(self) -> None:
        self._wire.timers.remove(self)


class Wire(Bus):
    """The host's bus, and to canopen's networks a python-can bus, in one process."""

    channel = "in-process"

    def __init__(self) -> None:
        self.now_ns = 0
        self.timers: list[Timer] = []
        self.networks: list[canopen.Network] = []
        self.sent: list[Frame] = []
        self._received: deque[Frame] = deque()

    # the host's end
    def send(self, can_id: int, data: bytes) -> None:
        self.sent.append(Frame(can_id, data, self.now_ns))
        for network in self.networks:
            network.notify(can_id, bytearray(data), self.now_ns * 1e-9)

    def receive(self, timeout_s: float) -> Frame | None:
        end_ns = self.now_ns + round(timeout_s * 1e9)
        while not self._received:
            due_ns = min((timer.due_ns for timer in self.timers), default=end_ns + 1)
            if due_ns > end_ns:
                self.now_ns = end_ns
                return None
            self.advance_to(due_ns)
        return self._received.popleft()

    def recover(self) -> None:
        self._received.clear()

    def close(self) -> None:
        pass

    def advance_to(self, t_ns: int) -> None:
        while (timer := min(self.timers, key=lambda t: t.due_ns, default=None)) and timer.due_ns <= t_ns:
            self.now_ns = timer.due_ns
            timer.fire()
        self.now_ns = t_ns

    # canopen's end
    def to_host(self, message: can.Message) -> None:
        self._received.append(Frame(message.arbitration_id, bytes(message.data), self.now_ns))

    def connect(self, node: canopen.LocalNode) -> canopen.Network:
        network = canopen.Network()
        network.bus = PythonCanEnd(self)
        network.add_node(node)
        self.networks.append(network)
        return network


class PythonCanEnd:
    """As much of a python-can bus as canopen asks for."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire

    def send(self, message: can.Message) -> None:
        self._wire.to_host(message)

    def send_periodic(self, message: can.Message, period_s: float) -> Timer:
        return Timer(self._wire, period_s, lambda: self._wire.to_host(message), period_s)


class Stranger:
    """A LocalNode with what every application does: boot, take over the PDO set-up, act on SYNC."""

    def __init__(self, wire: Wire, node_id: int, eds: Path) -> None:
        self.wire = wire
        self.node = canopen.LocalNode(node_id, read_once(eds, node_id))
        self.network = wire.connect(self.node)
        self.lies: dict[tuple[int, int], int] = {}
        self.refusals: dict[tuple[int, int], int] = {}
        self.node.add_read_callback(lambda index, subindex, od: self.lies.get((index, subindex)))
        self.node.add_write_callback(self._on_write)
        self.network.subscribe(0x000, self._on_nmt)
        self.network.subscribe(0x080, self._on_sync)
        self.is_mapped = False

    def _on_write(self, index: int, subindex: int, od: object, data: bytes) -> None:
        if (index, subindex) in self.refusals:
            raise canopen.SdoAbortedError(self.refusals[index, subindex])
        self.on_write(index, data)

    def _on_nmt(self, can_id: int, data: bytes, timestamp: float) -> None:
        command, node_id = data
        if node_id not in (0, self.node.id):
            return
        if command == 130:
            for index in [index for index in self.node.data_store if index < 0x2000]:
                del self.node.data_store[index]
            self.boot()
        if command == 1 and not self.is_mapped:
            self.is_mapped = True
            self.node.tpdo.read()
            self.node.rpdo.read()
            self.on_mapped()

    def _on_sync(self, can_id: int, data: bytes, timestamp: float) -> None:
        if self.node.nmt.state == "OPERATIONAL":
            self.on_sync()

    def boot(self) -> None:
        self.node.nmt.state = "INITIALISING"
        self.node.nmt.state = "PRE-OPERATIONAL"

    def unplug(self) -> None:
        self.wire.networks.remove(self.network)

    def on_write(self, index: int, data: bytes) -> None:
        pass

    def on_mapped(self) -> None:
        pass

    def on_sync(self) -> None:
        pass


class StrangeDrive(Stranger):
    """A CiA 402 drive with a mass of 1 kg m² behind it; rated torque in mNm."""

    def __init__(self, wire: Wire, node_id: int, rated_mNm: int) -> None:
        super().__init__(wire, node_id, contract_folder() / "stock_drive.eds")
        self.node.sdo[0x6076].raw = rated_mNm
        self.rated_Nm = rated_mNm * 1e-3
        self.state = "switch on disabled"
        self.torque_Nm = self.velocity = self.position = 0.0
        self._command = (0, 0)
        self._told = ""

    def on_write(self, index: int, data: bytes) -> None:
        if index == 0x6060:
            self.node.sdo[0x6061].raw = data[0]

    def on_mapped(self) -> None:
        self.node.rpdo[1].add_callback(self._on_command)

    def _on_command(self, pdo: canopen.pdo.PdoMap) -> None:
        self._command = (pdo[0x6040].raw, pdo[0x6071].raw)

    def on_sync(self) -> None:
        controlword, permille = self._command
        self._obey(controlword)
        is_on = self.state == "operation enabled" and self.node.sdo[0x6061].raw == 10
        self.torque_Nm = permille * 1e-3 * self.rated_Nm if is_on else 0.0
        self.velocity += self.torque_Nm * 1e-3
        self.position += self.velocity * 1e-3
        feedback, status = self.node.tpdo[1], self.node.tpdo[2]
        feedback[0x6064].raw = round(self.position * INCREMENTS_PER_RAD)
        feedback[0x606C].raw = round(self.velocity * INCREMENTS_PER_RAD)
        feedback.transmit()
        if self._told != self.state:
            self._told = self.state
            status[0x6041].raw = STATUSWORDS[self.state]
            status[0x6061].raw = self.node.sdo[0x6061].raw
            status[0x6077].raw = 0
            status[0x603F].raw = 0
            status.transmit()

    def _obey(self, controlword: int) -> None:
        command = controlword & 0x0F
        if not command & 0x02 or not command & 0x04:
            self.state = "switch on disabled"
        elif command == 0x06:
            self.state = "ready to switch on"
        elif command == 0x07 and self.state != "switch on disabled":
            self.state = "switched on"
        elif command == 0x0F and self.state in ("switched on", "operation enabled"):
            self.state = "operation enabled"


class StrangeSensor(Stranger):
    """A torque transducer: int32, 1e-5 Nm, on SYNC."""

    torque_Nm = 0.0

    def on_sync(self) -> None:
        torque = self.node.tpdo[1]
        torque[0x9130].raw = round(self.torque_Nm * 1e5)
        torque.transmit()


class Rig:
    """The host's master and arm with four strangers."""

    def __init__(self, sensor_eds: str = "int32_sensor.eds", **devices: Any) -> None:
        stock = load_settings("stock")
        self.settings = dataclasses.replace(stock, devices=dataclasses.replace(stock.devices, contract="", **devices))
        self.wire = Wire()
        self.drives = [StrangeDrive(self.wire, 1, 12_000), StrangeDrive(self.wire, 2, 6_000)]
        self.sensors = [StrangeSensor(self.wire, node, contract_folder() / sensor_eds) for node in (3, 4)]
        codec = compose_once(self.settings)
        self.arm = Arm(self.settings, codec, place_devices(self.settings), self.wire)
        self.master = Master(self.settings, codec, place_devices(self.settings), self.wire)
        self.cycle = 0

    def boot(self) -> None:
        self.master.reset()
        self.master.identify()
        self.master.configure()

    def start(self) -> None:
        self.boot()
        self.master.start()

    def step(self, *tau: float) -> ArmState:
        self.wire.advance_to(self.wire.now_ns + PERIOD_NS)
        self.arm.synchronise(self.cycle, self.wire.now_ns, 1)
        while (frame := self.wire.receive(0.0)) is not None:
            if not self.arm.accept(frame):
                self.master.accept(frame)
        state = self.arm.state()
        self.arm.send_command(ArmCommand(np.array(tau or (0.0, 0.0)), enable=True, quick_stop=False))
        self.cycle += 1
        return state

    def enable(self) -> None:
        self.start()
        for _ in range(10):
            state = self.step()
        assert state.is_enabled


def test_mapping_communication_and_application_are_set_up() -> None:
    rig = Rig()
    rig.boot()
    first, second = (drive.node.sdo for drive in rig.drives)
    mapping = [first[0x1A00][sub].raw for sub in range(first[0x1A00][0].raw + 1)]
    assert mapping == [2, 0x60640020, 0x606C0020]
    assert [first[0x1800][sub].raw for sub in (1, 2)] == [0x181, 1]
    assert [first[0x1801][sub].raw for sub in (1, 2, 5)] == [0x281, 255, 100]
    assert [first[0x1400][sub].raw for sub in (1, 2, 5)] == [0x201, 1, 10]
    values = [second[i].raw for i in (0x1006, 0x1017, 0x1015, 0x1019, 0x6060, 0x6061, 0x6072, 0x60E0, 0x60E1, 0x605A)]
    assert values == [1000, 100, 100, 240, 10, 10, 1000, 1000, 1000, 2]
    assert second[0x1016][1].raw == 127 << 16 | 250


def test_a_pdo_is_changed_only_while_it_is_invalid_and_its_mapping_empty() -> None:
    rig = Rig()
    rig.boot()
    writes = [
        (int.from_bytes(f.data[1:3], "little"), f.data[3], int.from_bytes(f.data[4:8], "little"))
        for f in rig.wire.sent
        if f.can_id == 0x601 and f.data[0] & 0xE0 == 0x20
    ]
    first = writes.index((0x1A00, 0, 0))
    assert writes[first - 1 : first + 8] == [
        (0x1800, 1, 0x80000181),
        (0x1A00, 0, 0),
        (0x1A00, 1, 0x60640020),
        (0x1A00, 2, 0x606C0020),
        (0x1A00, 0, 2),
        (0x1800, 2, 1),
        (0x1800, 3, 0),
        (0x1800, 5, 0),
        (0x1800, 1, 0x00000181),
    ]


def test_pdos_that_the_contract_does_not_know_are_switched_off() -> None:
    rig = Rig()
    rig.drives[0].lies[0x1802, 1] = 0x381
    rig.boot()
    assert rig.drives[0].node.data_store[0x1802][1] == (0x80000381).to_bytes(4, "little")


def test_a_fixed_mapping_is_not_written() -> None:
    rig = Rig()
    rig.boot()
    indexes = {int.from_bytes(f.data[1:3], "little") for f in rig.wire.sent if f.can_id == 0x603 and f.data[0] < 0x40}
    assert indexes == {0x1006, 0x1015, 0x1016, 0x1017, 0x1019}


def test_a_node_that_comes_late_is_waited_for() -> None:
    rig = Rig()
    late = rig.sensors[1]
    late.unplug()

    def plug_in() -> None:
        rig.wire.networks.append(late.network)
        late.boot()

    Timer(rig.wire, 1.5, plug_in)
    rig.boot()
    assert rig.wire.now_ns >= 1_500_000_000


def test_other_traffic_does_not_prolong_the_wait_for_a_node() -> None:
    rig = Rig()
    rig.sensors[1].unplug()
    other = can.Message(arbitration_id=0x7F0, data=[5], is_extended_id=False)
    Timer(rig.wire, 0.01, lambda: rig.wire.to_host(other), 0.01)
    with pytest.raises(DeviceError, match=r"no boot-up from Sensor2 \(node 4\) on in-process within 2 s"):
        rig.master.reset()
    assert rig.wire.now_ns <= 2_100_000_000


@pytest.mark.parametrize(("devices", "started"), [({}, [3, 4, 1, 2]), ({"start": "all"}, [0])])
def test_sensors_are_started_before_drives_or_all_at_once(devices: dict[str, str], started: list[int]) -> None:
    rig = Rig(**devices)
    rig.start()
    assert [frame.data[1] for frame in rig.wire.sent if frame.can_id == 0 and frame.data[0] == 1] == started


def test_strangers_reach_operation_enabled_and_give_feedback() -> None:
    rig = Rig()
    rig.sensors[0].torque_Nm, rig.sensors[1].torque_Nm = 1.5, -0.25
    rig.drives[0].position = 0.5
    rig.enable()
    state = rig.step()
    assert (state.is_complete, state.age_q, state.age_tau_J, state.fault) == (True, (0, 0), (0, 0), FaultReason.NONE)
    np.testing.assert_allclose([*state.q, *state.tau_J], [0.5, 0.0, 1.5, -0.25], atol=1e-5)


def test_torque_reaches_strangers_in_newton_metres_and_moves_them() -> None:
    rig = Rig()
    rig.enable()
    for _ in range(100):
        state = rig.step(6.0, -1.5)
    assert [drive.torque_Nm for drive in rig.drives] == [6.0, -1.5]
    np.testing.assert_allclose(state.dq, [0.6, -0.15], rtol=0.05)
    assert all(drive.implausible_frames == 0 for drive in rig.arm.drives)


NO_MAPPING, WRONG_STATE = 0x06040041, 0x08000022
LIES = {
    "vendor": (1, {(0x1018, 1): 0xBAD}, "vendor 0xBAD is not the EDS's 0xB0B"),
    "product": (3, {(0x1018, 2): 0x41}, "product code 0x41 is not the EDS's 0x40"),
    "major revision": (1, {(0x1018, 3): 0x20002}, "revision 0x20002 is not of the EDS's 0x10002"),
    "device type": (2, {(0x1000, 0): 0x00020191}, "device type 0x1000 = 0x00020191, 0x00020192 expected"),
    "mapping of a drive": (1, {(0x1A00, 2): 0x60690020}, "0x1A00:2 = 0x60690020, 0x606C0020 expected"),
    "identifier": (1, {(0x1400, 1): 0x301}, "identifier 0x1400:1 = 0x301, 0x201 expected"),
    "fixed mapping": (4, {(0x1A00, 1): 0x71300110}, "0x1A00:1 = 0x71300110, 0x91300120 expected"),
    "transmission type": (4, {(0x1800, 2): 254}, "transmission type 0x1800:2 = 254, 1 expected"),
    "rated torque": (2, {(0x6076, 0): 12_000}, "rated torque 0x6076 = 12000 mNm, 6000 mNm expected"),
    "modes": (1, {(0x6502, 0): 0x1A5}, "supported modes 0x6502 = 0x000001A5, bit 9"),
    "motor": (1, {(0x6076, 0): 0}, "rated torque 0x6076 = 0: the drive does not know its motor"),
    "encoder": (1, {(0x608F, 1): 4096}, "0x608F x 0x6091 = 4096/1 x 16/1, 1048576 expected"),
    "torque limit": (1, {(0x60E1, 0): 900}, "reads back 900 per mille, 1000 per mille written"),
    "SYNC identifier": (3, {(0x1005, 0): 0x40000081}, "SYNC identifier 0x1005 = 0x81, 0x80 expected"),
    "SYNC period": (1, {(0x1006, 0): 2000}, "SYNC period 0x1006 = 2000 µs, 1000 µs expected"),
}
"""What a node says wrongly of itself: the node, its answers, and a part of the message."""
REMEDIES = {"rated torque": "`arm.rated_torque_Nm[1]`", "encoder": "`scale.increments_per_joint_rev`"}


def refused_boot(rig: Rig, node: int) -> DeviceError:
    """Return the error that ends the boot: one line that names the node, with a remedy."""
    with pytest.raises(DeviceError) as raised:
        rig.boot()
    name = f"{'Drive' if node < 3 else 'Sensor'}{(node - 1) % 2 + 1} (node {node})"
    assert name in str(raised.value)
    assert raised.value.remedy
    return raised.value


@pytest.mark.parametrize("name", LIES)
def test_a_wrong_device_is_named_with_object_value_and_expectation_and_a_remedy(name: str) -> None:
    node, lies, said = LIES[name]
    rig = Rig()
    (*rig.drives, *rig.sensors)[node - 1].lies.update(lies)
    error = refused_boot(rig, node)
    assert said in str(error)
    assert REMEDIES.get(name, "") in error.remedy
    assert "wiring" not in error.remedy


@pytest.mark.parametrize(
    ("index", "sub", "code", "said"),
    [
        (0x1A00, 2, NO_MAPPING, "Mapped object 2 = 0x606C0020 refused: Code 0x06040041"),
        (0x6060, 0, WRONG_STATE, "writing 0x6060 Modes of operation = 10 refused: Code 0x08000022"),
    ],
)
def test_an_abort_is_told_with_object_value_and_code(index: int, sub: int, code: int, said: str) -> None:
    rig = Rig()
    rig.drives[1].refusals[index, sub] = code
    assert said in str(refused_boot(rig, 2))


def test_a_node_that_is_silent_is_named() -> None:
    rig = Rig()
    rig.drives[1].unplug()
    error = refused_boot(rig, 2)
    assert "no boot-up" in str(error)
    assert "within 2 s" in str(error)
    assert "wiring" in error.remedy
    rig = Rig()
    rig.sensors[0].network.unsubscribe(rig.sensors[0].node.sdo.rx_cobid)
    assert "no SDO answer within 0.5 s (reading 0x1000 Device type)" in str(refused_boot(rig, 3))


def is_write(frame: Frame, can_id: int, index: int) -> bool:
    return frame.can_id == can_id and frame.data[0] & 0xE0 == 0x20 and frame.data[1:3] == index.to_bytes(2, "little")


def test_what_the_device_maps_already_is_compared_and_not_written() -> None:
    rig = Rig()
    rig.boot()
    rig.wire.sent.clear()
    rig.master.configure()
    written = {index for index in range(0x1400, 0x1C00) if any(is_write(f, 0x601, index) for f in rig.wire.sent)}
    assert written == set()


def test_an_identifier_that_cant_be_written_is_compared() -> None:
    rig = Rig()
    drive = rig.drives[0]
    for index in (0x1400, 0x1800):
        drive.refusals[index, 1] = 0x06010002
    with pytest.raises(DeviceError, match=r"writing 0x1800:1 .* refused"):
        rig.boot()
    rig = Rig()
    rig.boot()
    for index in (0x1400, 0x1800):
        rig.drives[0].refusals[index, 1] = 0x06010002
    rig.master.configure()


@pytest.mark.parametrize("shown", [0, 8, -1])
def test_a_mode_that_is_shown_only_once_the_drive_is_enabled_is_compared_then(shown: int) -> None:
    rig = Rig()
    drive = rig.drives[0]
    drive.on_write = lambda index, data: None  # type: ignore[method-assign]
    drive.node.sdo[0x6061].raw = shown
    rig.start()
    for _ in range(20):
        assert not rig.step(1.0, 1.0).is_enabled
    assert drive.state == "operation enabled"
    assert {frame.data[2:] for frame in rig.wire.sent if frame.can_id == 0x201} == {bytes(2)}
    drive.node.sdo[0x6061].raw = 10
    drive._told = ""
    for _ in range(5):
        state = rig.step(1.0, 1.0)
    assert state.is_enabled
    assert rig.wire.sent[-1].data[2:] != bytes(2)


def test_a_drive_whose_mode_a_frame_shows_may_refuse_the_reading_of_it() -> None:
    rig = Rig()

    def refuse(index: int, subindex: int, od: object) -> None:
        if index == 0x6061:
            raise canopen.SdoAbortedError(0x08000022)

    rig.drives[0].node.add_read_callback(refuse)
    rig.boot()


def test_a_drive_that_refuses_another_mode_under_halt_is_taken_out_of_it_first() -> None:
    rig = Rig()
    drive = rig.drives[0]
    drive.node.sdo[0x6040].raw = 0x0100
    drive.refusals[0x6060, 0] = 0x08000022
    told = drive.on_write

    def on_write(index: int, data: bytes) -> None:
        told(index, data)
        if index == 0x6040 and not data[1] & 1:
            drive.refusals.pop((0x6060, 0), None)

    drive.on_write = on_write  # type: ignore[method-assign]
    rig.enable()


def rig_with_profile(folder: Path, line: str = "") -> Rig:
    path = folder / "own.toml"
    features = 'features = ["heartbeat_consumer", "sync_counter"]'
    path.write_text(OWN_SENSOR.replace("[scale]", f"{features}\n{line}\n[scale]"))
    return Rig("torque_sensor.eds", sensor=(str(path), str(path)))


def test_a_users_own_profile_runs_a_sensor(tmp_path: Path) -> None:
    rig = rig_with_profile(tmp_path)
    rig.start()
    rig.sensors[0].torque_Nm = 0.5  # the stranger counts in 1e-5 Nm
    rig.step()
    np.testing.assert_allclose(rig.step().tau_J, [0.05, 0.0])


def test_a_prefix_in_the_unit_counts_with_the_digits(tmp_path: Path) -> None:
    rig = rig_with_profile(tmp_path)
    for sensor in rig.sensors:
        sensor.lies.update({(0x6131, 1): 0xFD560100, (0x6132, 1): 3})  # mNm, three digits
    rig.boot()


@pytest.mark.parametrize(
    ("profile", "lies", "said"),
    [
        ("", {(0x6132, 1): 3}, "decimal digits 0x6132:1 = 3, 6 expected"),
        ("", {(0x6131, 1): 0x00210000}, "unit 0x6131:1 = 0x00210000, 0x00560100 (Nm) expected"),
        ("serial = [4, 3]", {}, "serial number 0x1018:4 = 3, 4 expected"),
    ],
    ids=["digits", "unit", "serial number"],
)
def test_a_sensor_that_contradicts_its_profile_is_named(
    tmp_path: Path, profile: str, lies: dict[tuple[int, int], int], said: str
) -> None:
    rig = rig_with_profile(tmp_path, profile)
    rig.sensors[0].lies.update(lies)
    assert str(refused_boot(rig, 3)) == f"Sensor1 (node 3): {said}"


@pytest.mark.parametrize(("encoder", "is_taken"), [(65536, True), (1048576, True), (32768, False)])
def test_a_gear_that_the_drive_was_never_given_is_the_profile_s(tmp_path: Path, encoder: int, is_taken: bool) -> None:
    path = tmp_path / "geared.toml"
    path.write_text('extends = "stock-drive"\n[scale]\ngear_ratio = 16\n')
    rig = Rig(drive=(str(path), str(path)))
    for drive, rated in zip(rig.drives, (750, 375), strict=True):  # 12 and 6 Nm over 16
        drive.lies.update({(0x6091, 1): 1, (0x6091, 2): 1, (0x608F, 1): encoder, (0x6076, 0): rated})
    with contextlib.nullcontext() if is_taken else pytest.raises(DeviceError, match="increments per joint revolution"):
        rig.boot()


def test_any_identity_is_taken_where_the_profile_says_so(tmp_path: Path) -> None:
    rig = rig_with_profile(tmp_path, 'identity = "any"')
    rig.sensors[0].lies.update({(0x1018, 1): 0xBAD, (0x1000, 0): 0})
    rig.master.reset()
    assert rig.master.identify()[2].vendor == 0xBAD


def test_extra_writes_of_a_profile_are_done_and_read_back(tmp_path: Path) -> None:
    rig = rig_with_profile(tmp_path, 'setup = [{ object = "0x6131:1", value = 0xFD560100 }]')
    for sensor in rig.sensors:
        sensor.lies[0x6132, 1] = 3  # of mNm
    rig.boot()
    assert rig.sensors[1].node.data_store[0x6131][1] == bytes.fromhex("000156fd")


def test_extra_writes_change_nothing_that_the_host_checks_or_sets(tmp_path: Path) -> None:
    rig = rig_with_profile(tmp_path, 'setup = [{ object = "0x6131:1", value = 0xFD560100 }]')  # digits stay those of Nm
    with pytest.raises(DeviceError, match="decimal digits 0x6132:1 = 6, 3 expected"):
        rig.boot()
    rig = rig_with_profile(tmp_path, 'setup = [{ object = "0x1017", value = 0 }]')  # no heartbeat
    rig.boot()
    assert rig.sensors[0].node.data_store[0x1017][0] == (100).to_bytes(2, "little")
