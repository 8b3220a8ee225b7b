"""A device as its master sees it: objects compared and written over SDO before a run, objects read again during it.

A failure is one line with device, object and value. Sources: CiA 402-2 / IEC 61800-7-201 (drives); CiA 404, CiA 303-2
(sensors and units); CiA 301 (4.2), clause 7.2.4 (SDO; 7.2.4.3: expedited upload, a request of 8 bytes and its answer),
clauses 7.5.2.35 to 7.5.2.38 (PDOs).

A PDO is made invalid before anything of it is changed, the mapping is emptied before its entries are, and it becomes
valid last. PDOs that the contract doesn't know are switched off: a stock device's defaults would take bus time.
"""

import math
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, NoReturn

from adacd_hil.device.arm_watch import RateLimitedEvents, Recurrence
from adacd_hil.device.canopen_bus import (
    SDO_ABORT,
    DeviceError,
    RefusedError,
    as_device_error,
    find_variable,
    read_object,
)
from adacd_hil.device.drive import MODE_CYCLIC_SYNCHRONOUS_TORQUE, option_codes, shows_mode, torque_limit_permille
from adacd_hil.device.drive_units import name_velocity_unit, read_drive_units, unit_prefix
from adacd_hil.device.profile import EVENT_TIMER, SYNC_WATCHDOG, ObjectName, PdoSettings, PlacedDevice, ScaleSettings
from adacd_hil.records import Event
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.bus import Bus, Frame
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.contract_frames import NOT_VALID, SDO_REQUEST_ID, SDO_RESPONSE_ID


class Slave:
    """A device of the arm on the bus, as its master sees it."""

    def __init__(self, device: PlacedDevice, node: Any, wait: Callable[[float], object] = lambda _: None) -> None:
        """`node`: canopen's object of it. `wait`: reads the bus for so many seconds."""
        self.wait = wait
        self.device = device
        self.name = device.name
        self.node_id = device.node_id
        self.known: dict[tuple[int, int], int] = {}
        """Values that the set-up has written or compared, by index and sub-index."""
        self._node = node
        self.answer_s = device.settings.patience.answer_s

    def has(self, index: int, sub: int = 0) -> bool:
        """Return whether the EDS lists an object."""
        return find_variable(self._node.object_dictionary, index, sub) is not None

    def can_write(self, index: int, sub: int = 0) -> bool:
        """Return whether the EDS lists an object that SDO may write."""
        variable = find_variable(self._node.object_dictionary, index, sub)
        return variable is not None and variable.is_writable

    def default(self, index: int, sub: int = 0) -> int | None:
        """Return an object's default by the EDS; None without an integer default."""
        variable = find_variable(self._node.object_dictionary, index, sub)
        return None if variable is None else variable.default

    def read(self, index: int, sub: int = 0) -> int:
        """Read an object over SDO and return its number.

        Raises DeviceError if the EDS doesn't list it, or the device refuses or doesn't answer; BusError if the bus
        fails.
        """
        with as_device_error(self.name, self.node_id, f"reading {self.name_object(index, sub)}", self.answer_s):
            return int(self._entry(index, sub).raw)

    def read_unlisted(self, index: int, sub: int) -> int:
        """Read an object that the EDS doesn't list, an unsigned number, over SDO; return 0 if the device has none.

        Raises DeviceError if the device refuses or doesn't answer, BusError if the bus fails.
        """
        return int.from_bytes(read_object(self._node, index, sub) or b"", "little")

    def write_object(self, index: int, sub: int, value: int) -> None:
        """Write a number to an object over SDO, and store it in `known`.

        Raises DeviceError if the EDS doesn't list it, or the device refuses or doesn't answer; BusError if the bus
        fails.
        """
        what = f"writing {self.name_object(index, sub)} = {_number(value)}"
        with as_device_error(self.name, self.node_id, what, self.answer_s):
            self._entry(index, sub).raw = value
        self.known[index, sub] = value

    def write_checked(self, index: int, sub: int, value: int, unit: str = "") -> None:
        """Write a number to an object as `write_object`, and read it back. `unit`: for the error's text.

        Raises DeviceError if the two differ, the EDS doesn't list it, or the device refuses or doesn't answer; BusError
        if the bus fails.
        """
        self.write_object(index, sub, value)
        found = self.read(index, sub)
        if found != value:
            self.fail(
                f"{self.name_object(index, sub)} reads back {_with(found, unit)}, {_with(value, unit)} written",
                f"the device limits or rounds it: see {ObjectName(index, sub)} in its manual",
            )

    def compare(self, index: int, sub: int, expected: int, quantity: str, unit: str = "", is_hex: bool = False) -> str:
        """Read an object; return its difference from `expected` in words, "" if equal. Store `expected` in `known`.

        `quantity`, `unit`: of the value in that text; `is_hex`: its numbers are hexadecimal. Raises DeviceError if the
        object can't be read, BusError if the bus fails.
        """
        found = self.read(index, sub)
        self.known[index, sub] = expected
        if found == expected:
            return ""
        values = [f"0x{value:08X}" if is_hex else _with(value, unit) for value in (found, expected)]
        return f"{quantity} {ObjectName(index, sub)} = {values[0]}, {values[1]} expected"

    def expect(self, index: int, sub: int, expected: int, quantity: str, unit: str = "", remedy: str = "") -> None:
        """Compare an object as `compare`; raise DeviceError, with the remedy, if it differs from `expected`.

        `quantity`, `unit`: of the value, for the error. Raises DeviceError also if the object can't be read, BusError
        if the bus fails.
        """
        if text := self.compare(index, sub, expected, quantity, unit):
            self.fail(text, remedy)

    def name_object(self, index: int, sub: int) -> str:
        """Return an object's index and sub-index, with its name if the EDS lists it."""
        variable = find_variable(self._node.object_dictionary, index, sub)
        return str(ObjectName(index, sub)) + ("" if variable is None else f" {variable.name}")

    def fail(self, text: str, remedy: str = "") -> NoReturn:
        """Raise DeviceError with the device's name, node id and `text`. `remedy`: how the user can correct it."""
        raise DeviceError(f"{self.name} (node {self.node_id}): {text}", remedy)

    def _entry(self, index: int, sub: int) -> Any:
        """Return canopen's access to an object over SDO. Raises DeviceError if the EDS doesn't list the object."""
        entry = self._node.sdo.get_variable(index, sub)
        if entry is None:
            self.fail(f"{ObjectName(index, sub)} is not in the EDS")
        return entry


def _with(value: int, unit: str) -> str:
    return f"{_number(value)} {unit}".rstrip()


def _number(value: int) -> str:
    return f"0x{value:08X}" if value > 0xFFFFFF else str(value)


CST_SUPPORTED = 1 << 9  # of 0x6502


def command_deadline_ms(settings: Settings) -> int:
    """Return the longest time without a new command until a drive faults, ms, rounded up, at least 1.

    It is `bus.command_patience_cycles` periods, for drives that count time instead of SYNCs.
    """
    return max(1, math.ceil(settings.bus.command_patience_cycles * settings.bus.period_us / 1000))


_ROUNDED_SHARE = 0.005
"""Part by which a rated torque may be off because it was rounded to two or three digits."""
TORQUE_UNITS_NM = {"mNm": 1e-3, "µNm": 1e-6, "Nm": 1.0}


def set_up_drive(slave: Slave, settings: Settings, codec: Codec, drives: Sequence[PlacedDevice]) -> list[str]:
    """Check the drive, write its limits, option codes and mode; return values that nothing confirms, a line each.

    Option codes, limits and watchdogs are written only if its profile names them. Objects that its EDS lacks, or
    doesn't let the host write, are left out, but a watchdog that is missing there is a DeviceError. `drives`: of all
    joints. Raises DeviceError for a drive without cyclic synchronous torque, another rated torque, gear or unit than
    configured, or a value that it doesn't take; BusError if the bus fails.
    """
    joint, profile = slave.device.joint, slave.device.settings
    if slave.has(0x6502):
        modes = slave.read(0x6502)
        if not modes & CST_SUPPORTED:
            slave.fail(
                f"supported modes 0x6502 = 0x{modes:08X}, bit 9 (cyclic synchronous torque) expected",
                "this drive can't be commanded by torque; a newer firmware may",
            )
    if slave.has(0x6076):
        _check_rated_torque(slave, settings, drives)
    remarks = _check_units(slave, codec)
    if slave.device.can("option_codes"):
        quick_stop, fault_reaction = option_codes(settings, profile)
        for index, value in ((0x605A, quick_stop), (0x605E, fault_reaction)):
            if value is not None and slave.can_write(index):
                slave.write_checked(index, 0, value)
    if slave.device.can("torque_limits"):
        for index in (0x6072, 0x60E0, 0x60E1):
            if slave.can_write(index):
                slave.write_checked(index, 0, torque_limit_permille(settings, joint), "per mille")
    if profile.command_watchdog == SYNC_WATCHDOG:
        slave.write_checked(0x2200, 0, settings.bus.command_patience_cycles, "SYNCs")
    if slave.device.can("sync_tolerance"):
        slave.write_checked(0x2201, 0, round(10 * settings.bus.sync_patience_periods), "tenths of a period")
    return remarks + _enter_mode(slave, codec)


def _check_rated_torque(slave: Slave, settings: Settings, drives: Sequence[PlacedDevice]) -> None:
    """Raise DeviceError if 0x6076, brought to the joint, differs from the configured rated torque.

    It differs if it is away by a share of over `_ROUNDED_SHARE`. Store the value read in `known`. `drives`: of all
    joints, so that the error can name exchanged drives. Raises DeviceError also if it can't be read, BusError if the
    bus fails.
    """
    found = slave.read(0x6076)
    slave.known[0x6076, 0] = found
    scale, joint = slave.device.settings.scale, slave.device.joint
    rated_Nm = settings.arm.rated_torque_Nm
    expected = [rated_Nm[drive.joint] / drive.settings.scale.joint_torque_Nm for drive in drives]
    alike = [other for other, counts in enumerate(expected) if abs(found - counts) <= _ROUNDED_SHARE * counts]
    if joint in alike:
        return
    later = [other for other in alike if other > joint]  # the drives of the joints before are where they should be
    if not found:
        slave.fail(
            "rated torque 0x6076 = 0: the drive does not know its motor",
            "enter the motor with the maker's tool, and store it",
        )
    unit = torque_unit(scale)
    text = f"rated torque 0x6076 = {found} {unit}, {round(expected[joint])} {unit} expected"
    if scale.joint_torque_Nm != scale.rated_torque_count_Nm:
        text += (
            f" of a motor behind a gear of {scale.gear_ratio:g}: {found * scale.joint_torque_Nm:.4g} Nm at the joint, "
            f"`arm.rated_torque_Nm[{joint}]` = {rated_Nm[joint]:.4g} Nm"
        )
    if later:
        slave.fail(
            f"{text}; it is that of joint {later[0] + 1}: the drives are exchanged",
            "exchange `devices.drive_node`, or the drives' cables",
        )
    place = f"devices.drive[{joint}]"
    slave.fail(
        text,
        f"correct `arm.rated_torque_Nm[{joint}]`, the torque at the joint; or `scale.gear_ratio`, "
        f"`scale.gear_efficiency`, `scale.rated_torque_count_Nm` of {place}",
    )


def torque_unit(scale: ScaleSettings) -> str:
    """Return the unit of one count of 0x6076: Nm, mNm, µNm, else as `x 0.002 Nm`."""
    count_Nm = scale.rated_torque_count_Nm
    return next((name for name, unit_Nm in TORQUE_UNITS_NM.items() if unit_Nm == count_Nm), f"x {count_Nm:g} Nm")


def _check_units(slave: Slave, codec: Codec) -> list[str]:
    """Raise DeviceError if increments, velocity unit or gear in the drive differ from the contract's and the profile's.

    Objects that its EDS lacks are not compared; a gear of 1 by 0x6091 or the profile contradicts no other gear. Return
    a line for increments of a factory value, which confirm nothing.
    """

    def number(index: int, sub: int) -> int | None:
        return slave.read(index, sub) if slave.has(index, sub) else None

    scale, remarks = slave.device.settings.scale, []
    place = f"devices.drive[{slave.device.joint}]"
    found = read_drive_units(number, scale.gear_ratio)
    readings = [found]
    if found.gear_ratio == 1.0 and scale.gear_ratio != 1.0:  # the encoder is at the joint, or 0x6091 was never set
        readings.append(read_drive_units(lambda *at: None if at[0] == 0x6091 else number(*at), scale.gear_ratio))
    feedback = codec.message(f"{slave.name}Feedback")
    position, velocity = (feedback.values[feedback.place(name)].scale for name in ("position", "velocity"))
    increments = math.tau / position
    if found.has_increments and not any(_is_alike(one.increments_per_joint_rev, increments) for one in readings):
        slave.fail(
            f"increments per joint revolution {found.increments_text}, {increments:.10g} expected",
            f"correct `scale.increments_per_joint_rev` and `scale.gear_ratio` of {place}, or encoder and gear in the "
            "drive",
        )
    if found.increments_text and not found.has_increments:
        remarks.append(f"{found.increments_text} is a factory value: nothing confirms {increments:.10g} increments")
    if found.velocity_rad_s is not None and not any(_is_alike(one.velocity_rad_s, velocity) for one in readings):
        slave.fail(
            f"a count of velocity by 0x60A9 = {name_velocity_unit(found.velocity_unit)} is "
            f"{found.velocity_rad_s:.6g} rad/s at the joint, {velocity:.6g} rad/s expected",
            f"correct `scale.velocity_rad_s` of {place}, or set 0x60A9 in the drive",
        )
    if found.is_other_gear(scale.gear_ratio):
        slave.fail(
            f"gear ratio 0x6091 = {found.gear_ratio:g}, {scale.gear_ratio:g} expected",
            f"correct `scale.gear_ratio` of {place}, or the gear in the drive",
        )
    return remarks


def _is_alike(found: float | None, expected: float) -> bool:
    return found is not None and abs(found - expected) <= 1e-6 * abs(expected)


_HALT = 1 << 8  # of the controlword
_MODE_POLL_S = 0.02


def _enter_mode(slave: Slave, codec: Codec) -> list[str]:
    """Request cyclic synchronous torque, if 0x6060 can be written; end a halt under which the drive refuses it.

    A frame that carries 0x6061 may show the mode later, once the drive is enabled: the cycle compares it. If no frame
    carries it, 0x6061 must show it within `patience.mode_s`. Return a remark if the EDS lacks 0x6061 then. A drive
    without 0x6060 and 0x6061 has one mode. Raises DeviceError if 0x6061 doesn't show the mode though it must, or the
    drive refuses or doesn't answer; BusError if the bus fails.
    """
    if slave.can_write(0x6060):
        try:
            slave.write_object(0x6060, 0, MODE_CYCLIC_SYNCHRONOUS_TORQUE)
        except RefusedError:
            if not (slave.can_write(0x6040) and slave.read(0x6040) & _HALT):
                raise
            slave.write_object(0x6040, 0, 0)  # some drives refuse another mode under halt
            slave.known.pop((0x6040, 0))
            slave.write_object(0x6060, 0, MODE_CYCLIC_SYNCHRONOUS_TORQUE)
    if shows_mode(codec, slave.name):
        return []
    if not slave.has(0x6061):
        remark = "nothing shows its mode: no frame has `mode_display`, and its EDS lacks 0x6061"
        return [remark] if slave.can_write(0x6060) else []
    for _ in range(round(slave.device.settings.patience.mode_s / _MODE_POLL_S)):
        if slave.read(0x6061) == MODE_CYCLIC_SYNCHRONOUS_TORQUE:
            return []
        slave.wait(_MODE_POLL_S)
    slave.expect(
        0x6061,
        0,
        MODE_CYCLIC_SYNCHRONOUS_TORQUE,
        "mode of operation",
        remedy="no frame shows the mode, so it is compared before the drive is enabled: map 0x6061 as `mode_display`",
    )
    return []


NEWTON_METRE = 0x00560100
"""0x6131 without its prefix: numerator Nm, denominator 1."""


def check_sensor(slave: Slave, codec: Codec) -> str:
    """Compare unit and decimal digits with the contract; return the status as text, empty for 0 and without 0x6150.

    Objects that the EDS doesn't list are not compared. The unit must be Nm, times any power of ten. Raises DeviceError
    for another unit, for other decimal digits, and if an object can't be read; BusError if the bus fails.
    """
    torque = codec.message(f"{slave.name}Torque")
    scale = torque.values[torque.place("torque")].scale
    channel = sensor_channel(slave)
    remedy = f"correct `scale.torque_Nm` of devices.sensor[{slave.device.joint}], or unit and digits in the sensor"
    prefix = 0
    if slave.has(0x6131, channel):
        unit = slave.read(0x6131, channel)
        if unit & 0x00FFFFFF != NEWTON_METRE:
            slave.fail(
                f"unit 0x6131:{channel} = 0x{unit:08X}, 0x{NEWTON_METRE:08X} (Nm) expected",
                f"set 0x6131:{channel} of the sensor to newton metres with the maker's tool",
            )
        prefix = unit_prefix(unit)
    if slave.has(0x6132, channel):
        digits = prefix - math.log10(scale)
        if abs(digits - round(digits)) > 1e-9:
            slave.fail(f"a count of {scale:g} Nm can't be said in decimal digits 0x6132:{channel}", remedy)
        slave.expect(0x6132, channel, round(digits), "decimal digits", remedy=remedy)
    if slave.has(0x6150, channel):
        status = slave.read(0x6150, channel)
        if status:
            return f"status 0x6150:{channel} = 0x{status:02X}"
    return ""


def sensor_channel(slave: Slave) -> int:
    """Return the channel of a sensor: the sub-index of the torque object in its profile, 1 if that is 0 or missing."""
    pdo = slave.device.pdo("Torque")
    signals = () if pdo is None else pdo.signals
    return next((signal.name.sub for signal in signals if signal.signal == "torque"), 0) or 1


_UPLOAD = 0x40


class _KnownObject(NamedTuple):
    """An object of a device, and the value that it was given or had at the set-up."""

    slave: Slave
    place: tuple[int, int]
    """Index and sub-index."""
    expected: int

    @property
    def name(self) -> str:
        return f"{self.slave.name} (node {self.slave.node_id}): {self.slave.name_object(*self.place)}"


class ParameterWatch(RateLimitedEvents):
    """Reads again the objects that the set-up has written or compared, one at a time, without waiting for answers.

    A device that has reset itself to its defaults, or into which another program has written, runs the arm with other
    limits and other watchdogs than the host assumes.
    """

    def __init__(self, settings: Settings, bus: Bus) -> None:
        super().__init__()
        self._bus = bus
        self._objects: deque[_KnownObject] = deque()
        """Those that are read, the next one first."""
        self._asked: _KnownObject | None = None
        self._asked_cycle = 0
        self._pause_cycles: dict[int, int] = {}
        self._last_cycle: dict[int, int] = {}
        """By node id: least pause between requests, and cycle of the last request."""
        self._period_s = settings.bus.period_s
        self._reread_ms = settings.devices.reread_ms
        self._due = Recurrence(self._reread_ms * 1e-3, self._period_s)
        self.first_difference = ""
        """The first object whose value differs from the set-up, in one line; empty without a difference."""

    def follow(self, slaves: Iterable[Slave]) -> None:
        """Have `step` read the objects that the set-up of these devices has written or compared.

        In turn, the first of each device, then the second of each, and so on.
        """
        found = [[_KnownObject(slave, place, value) for place, value in slave.known.items()] for slave in slaves]
        # By turns, so that no device waits for all objects of another.
        longest = max(map(len, found), default=0)
        self._objects = deque(objects[k] for k in range(longest) for objects in found if k < len(objects))
        self._pause_cycles = {
            one.slave.node_id: math.ceil(one.slave.device.settings.patience.pause_ms * 1e-3 / self._period_s)
            for one in self._objects
        }

    def step(self, cycle: int, t_ns: int) -> None:
        """Send the request for the next object if it is due and none is open; warn of one that got no answer in time.

        Call it once per cycle. A request also waits for the `patience.pause_ms` of its device. None is sent if
        `devices.reread_ms` is 0. Raises BusError if the bus refuses a frame.
        """
        asked = self._asked
        if asked is not None and cycle - self._asked_cycle > round(asked.slave.answer_s / self._period_s):
            text = f"{asked.name} is not answered"
            self.report(t_ns, asked.slave.name, Event("warning", "parameters", text))
            self._asked = asked = None
        if asked is not None or not (self._reread_ms and self._objects):
            return
        chosen = self._objects[0]
        node_id = chosen.slave.node_id
        is_paused = cycle - self._last_cycle.get(node_id, -math.inf) <= self._pause_cycles[node_id]
        if is_paused or not self._due.take_turn(cycle):
            return
        self._asked = chosen
        self._asked_cycle = self._last_cycle[node_id] = cycle
        self._objects.rotate(-1)
        index, sub = chosen.place
        request = bytes((_UPLOAD, index & 0xFF, index >> 8, sub, 0, 0, 0, 0))
        self._bus.send(SDO_REQUEST_ID + chosen.slave.node_id, request)

    def accept(self, frame: Frame) -> bool:
        """Take the answer to the open request and compare it; return False for any other frame.

        The first difference goes into `first_difference`. An answer that isn't expedited is not compared. After an
        abort, warn, and don't read that object again.
        """
        asked, data = self._asked, frame.data
        if asked is None or frame.can_id != SDO_RESPONSE_ID + asked.slave.node_id or len(data) != 8:
            return False
        if (data[1] | data[2] << 8, data[3]) != asked.place:
            return False
        self._asked = None
        if data[0] == SDO_ABORT:
            code = int.from_bytes(data[4:], "little")
            text = f"{asked.name} can't be read again: 0x{code:08X}"
            self.report(frame.t_ns, asked.name, Event("warning", "parameters", text))
            self._objects = deque(one for one in self._objects if one is not asked)
        elif data[0] & 0xE2 == 0x42:  # expedited, with or without its size
            size = 4 - (data[0] >> 2 & 3) if data[0] & 1 else 4
            self._compare(asked, int.from_bytes(data[4 : 4 + size], "little"), size)
        return True

    def _compare(self, asked: _KnownObject, found: int, size: int) -> None:
        """Store in `first_difference`, if it is empty, that an object of `size` bytes is no longer as it was set up."""
        expected = asked.expected & (1 << 8 * size) - 1
        if found != expected and not self.first_difference:
            self.first_difference = f"{asked.name} is 0x{found:X}, 0x{expected:X} was set up"


RTR_NOT_ALLOWED = 1 << 30
_COB_ID, _TYPE, _INHIBIT, _EVENT_TIMER = 1, 2, 3, 5
_RECORDS = (*range(0x1400, 0x1600), *range(0x1800, 0x1A00))


def set_up_pdos(slave: Slave, command_deadline_ms: int) -> None:
    """Write the PDOs of a device that differ from its profile, or all if the profile's `mapping` is `rewritten`.

    Before that switch off the PDOs that the profile doesn't name; one whose identifier can't be written stays on.
    `command_deadline_ms`: event timer of the command PDO if the profile's `command_watchdog` is `0x1400:5`. Raises
    DeviceError if a PDO still differs, or the device refuses or doesn't answer; BusError if the bus fails.
    """
    profile = slave.device.settings
    timers = {pdo.message: _event_timer(slave, pdo, command_deadline_ms) for pdo in profile.pdo}
    compared = set()
    _switch_off_others(slave)
    for pdo in profile.pdo:
        if profile.mapping == "rewritten" or _difference(slave, pdo, timers[pdo.message]):
            _write_pdo(slave, pdo, timers[pdo.message])
        else:
            compared.add(pdo.message)
    for pdo in profile.pdo:
        if pdo.message not in compared and (text := _difference(slave, pdo, timers[pdo.message])):
            slave.fail(
                text,
                f"[[pdo]] {pdo.message} of {slave.device.profile.name} must say what the device can map: see 0x1A00 "
                "and PDOMapping in its EDS; `adacd-hil init --eds` drafts a profile",
            )


def _event_timer(slave: Slave, pdo: PdoSettings, command_deadline_ms: int) -> int:
    """Return the event timer that a PDO shall have, ms: by its profile, or the command deadline.

    The latter for the command PDO if `command_watchdog` is `0x1400:5`.
    """
    has_deadline = pdo.is_received and slave.device.settings.command_watchdog == EVENT_TIMER
    return command_deadline_ms if has_deadline else pdo.event_timer_ms


def _switch_off_others(slave: Slave) -> None:
    """Make the PDOs of a device invalid that its profile doesn't name, if their identifier can be written."""
    used = {pdo.communication_index for pdo in slave.device.settings.pdo}
    for index in _RECORDS:
        if index in used or not slave.can_write(index, _COB_ID):
            continue
        cob_id = slave.read(index, _COB_ID)
        if not cob_id & NOT_VALID:
            slave.write_object(index, _COB_ID, cob_id | NOT_VALID)


def _write_pdo(slave: Slave, pdo: PdoSettings, event_timer_ms: int) -> None:
    """Write the objects of a PDO that can be written: invalid first, valid last.

    The mapping is emptied and written only if it differs, always if `rewritten`, never if `fixed`. Raises DeviceError
    also for an inhibit time or event timer other than 0, or a mapped object, for which the EDS has no sub-index.
    """
    index, mapping_index = pdo.communication_index, pdo.mapping_index
    kept = slave.read(index, _COB_ID) & RTR_NOT_ALLOWED
    cob_id = slave.device.can_id(pdo) | kept
    entries = slave.device.mapping(pdo)
    mapping = slave.device.settings.mapping
    is_all = mapping == "rewritten"
    if slave.can_write(index, _COB_ID):
        slave.write_object(index, _COB_ID, cob_id | NOT_VALID)
    if is_all or (mapping != "fixed" and _mapping_difference(slave, pdo)):
        if not slave.has(mapping_index, len(entries)):
            slave.fail(
                f"{pdo.message}: {len(entries)} objects are to be mapped, 0x{mapping_index:04X} has no sub-index "
                f"{len(entries)}",
                f"map fewer objects in [[pdo]] {pdo.message} of {slave.device.profile.name}",
            )
        slave.write_object(mapping_index, 0, 0)
        for sub, entry in enumerate(entries, 1):
            slave.write_object(mapping_index, sub, entry)
        slave.write_object(mapping_index, 0, len(entries))
    if is_all or slave.can_write(index, _TYPE):
        slave.write_object(index, _TYPE, pdo.transmission)
    for sub, value in ((_INHIBIT, pdo.inhibit_100us), (_EVENT_TIMER, event_timer_ms)):
        if slave.can_write(index, sub):
            slave.write_object(index, sub, value)
        elif value and not slave.has(index, sub):
            slave.fail(
                f"{ObjectName(index, sub)} is not in the EDS, {value} wanted",
                f"leave it out of [[pdo]] {pdo.message} in {slave.device.profile.name}",
            )
    if slave.can_write(index, _COB_ID):
        slave.write_object(index, _COB_ID, cob_id)


def pdo_differences(slave: Slave, command_deadline_ms: int) -> list[str]:
    """Read the PDOs of a device; return the first difference of each from its profile, a line each; empty without any.

    `command_deadline_ms`: as of `set_up_pdos`. Raises DeviceError if the device refuses or doesn't answer, BusError if
    the bus fails.
    """
    found = [
        (pdo, _difference(slave, pdo, _event_timer(slave, pdo, command_deadline_ms)))
        for pdo in slave.device.settings.pdo
    ]
    return [f"{slave.name}{pdo.message}: {text}" for pdo, text in found if text]


def _difference(slave: Slave, pdo: PdoSettings, event_timer_ms: int) -> str:
    """Read a PDO up to its first difference from the profile; return that in words, "" without one.

    Store the expected values of what was read in the device's `known`.
    """
    index = pdo.communication_index
    identifier = slave.read(index, _COB_ID)
    found, expected = identifier & ~RTR_NOT_ALLOWED, slave.device.can_id(pdo)
    slave.known[index, _COB_ID] = expected | identifier & RTR_NOT_ALLOWED
    if found != expected:
        return f"identifier {ObjectName(index, _COB_ID)} = 0x{found:X}, 0x{expected:X} expected"
    parameters = (
        (_TYPE, pdo.transmission, "transmission type", ""),
        (_INHIBIT, pdo.inhibit_100us, "inhibit time", "x 100 µs"),
        (_EVENT_TIMER, event_timer_ms, "event timer", "ms"),
    )
    for sub, value, quantity, unit in parameters:
        if slave.has(index, sub) and (text := slave.compare(index, sub, value, quantity, unit)):
            return text
    return _mapping_difference(slave, pdo)


def _mapping_difference(slave: Slave, pdo: PdoSettings) -> str:
    """Read the mapping of a PDO up to its first difference from the profile; return that in words, "" without one.

    Store the expected values of what was read in the device's `known`.
    """
    mapping_index, entries = pdo.mapping_index, slave.device.mapping(pdo)
    text = slave.compare(mapping_index, 0, len(entries), "number of mapped objects")
    for sub, entry in enumerate(entries, 1):
        text = text or slave.compare(mapping_index, sub, entry, "mapped object", is_hex=True)
    return text
