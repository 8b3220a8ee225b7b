"""The devices of a configuration, as the emulator plays them: the contract of their frames, EDS files, counts.

The only place where the emulator reads the host package's description of devices: profiles, which are files that
describe a device, and the contract that follows from them, which is the definition of the messages.
"""

import functools
import math
import tomllib
from collections.abc import Sequence
from fractions import Fraction
from importlib import resources
from typing import Any, NamedTuple

from adacd_hil.device.contract import load_contract
from adacd_hil.device.device_files import place_devices
from adacd_hil.device.profile import STANDARD_OBJECTS, ObjectName, PdoSettings, PlacedDevice, SignalSettings
from adacd_hil.records import JOINTS
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import ConfigurationLayer, configuration_layers, resolved_table
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.schema import ConfigError
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.contract_frames import NOT_VALID
from adacd_hil.wire.dbc_contract import contract_folder
from firmware_sim.arm.hardware_settings import HabitSettings
from firmware_sim.canopen.object_dictionary import (
    CONTRACTS,
    DeviceDescription,
    EmulatedContract,
    LiveValue,
    MadeUp,
    contract_of,
)
from firmware_sim.nodes.drive_node import CYCLIC_SYNCHRONOUS_TORQUE
from firmware_sim.scenario.rehearsal import DeviceCounts, compose_scenario, told_arm
from firmware_sim.scenario.scenario import (
    SCENARIO_SECTIONS,
    ArmTruth,
    Scenario,
    builtin_scenarios,
    load_truth,
    read_table,
    resolve_scenario,
)

_DEVICE_TYPES = {"drive": 0x00020192, "sensor": 0x00020194}
_NEWTON_METRE = 0x00560100
_RECORDS = (*range(0x1400, 0x1600), *range(0x1800, 0x1A00))
_OBJECTS = {
    "drive": {
        "position": (0x6064, 0),
        "velocity": (0x606C, 0),
        "torque_actual": (0x6077, 0),
        "torque_demand": (0x6074, 0),
        "error_code": (0x603F, 0),
        "statusword": (0x6041, 0),
        "controlword": (0x6040, 0),
        "target_torque": (0x6071, 0),
        "torque_offset": (0x60B2, 0),
    },
    "sensor": {
        "torque": (0x9130, 1),
        "gross_torque": (0x2110, 1),
        "status": (0x6150, 1),
        "temperature": (0x2111, 0),
    },
}
"""Objects of the emulated devices for the signals that a profile maps from objects of its own."""
_OWN_EDS = {eds for contract in CONTRACTS.values() for eds in (contract.drive_eds, contract.sensor_eds)}
"""EDS that give every object a value."""
_SIGNED8, _UNSIGNED16, _UNSIGNED32 = 0x0002, 0x0006, 0x0007  # data types, CiA 301 table 44


def _made_up(kind: str, settings: Settings) -> dict[int, MadeUp]:
    """Return objects, by index, that the emulated devices of a kind need; the caller adds those that an EDS lacks.

    kind: "drive" or "sensor".
    """
    made = {
        0x1006: MadeUp("SYNC period", _UNSIGNED32, 0),
        0x1017: MadeUp("heartbeat time", _UNSIGNED16, settings.bus.heartbeat_ms),
    }
    if kind == "drive":
        made |= {
            0x6060: MadeUp("mode of operation", _SIGNED8, CYCLIC_SYNCHRONOUS_TORQUE),
            0x6061: MadeUp("its display", _SIGNED8, 0),
            0x6076: MadeUp("rated torque", _UNSIGNED32, 0),
        }
    return made


class Rehearsal(NamedTuple):
    """An arm that can be played: its frames, its devices, its scenario.

    assumed: a line for each assumption about the arm, for the user.
    """

    codec: Codec
    contract: EmulatedContract
    scenario: Scenario
    assumed: list[str]


def rehearse(
    config: str, scenario: str, truth: str | None = None, profile: str | None = None, seed: int | None = None
) -> Rehearsal:
    """Return the arm of a configuration with a scenario, to be played; all names: built in, or files.

    truth: None: the arm is as configured. profile (of the arm), seed: in place of the files'. Raises ConfigError for a
    configuration, scenario or truth that can't be used, CodecError for its DBC.
    """
    layers = configuration_layers(config, profile)
    settings = parse(Settings, resolved_table(layers))
    return rehearse_settings(settings, layers, scenario, truth, seed)


def rehearse_settings(
    settings: Settings,
    layers: Sequence[ConfigurationLayer],
    scenario_name: str,
    truth_name: str | None = None,
    seed: int | None = None,
) -> Rehearsal:
    """Return the arm of a configuration with a scenario, to be played; `layers`: those that gave the settings.

    If there is no truth and no layer describes an own arm, it is the arm of the profile with the package's devices.
    truth_name: None: no truth. seed: in place of the scenario's. Raises ConfigError for devices, a scenario or a truth
    that can't be used, CodecError for their DBC.
    """
    devices = place_devices(settings)
    codec = load_contract(settings, devices)
    told = told_arm(settings, layers)
    table = read_table(scenario_name)
    is_builtin = scenario_name in builtin_scenarios()
    if truth_name is None and not told.is_own:
        return Rehearsal(
            codec, contract_of(codec), resolve_scenario(scenario_name, table, settings.arm.profile, seed), []
        )
    truth, sections = load_truth(truth_name) if truth_name is not None else (ArmTruth(), {})
    _lay_over(f"scenario {scenario_name}", table, f"truth {truth_name}", sections)
    composed, assumed = compose_scenario(told, truth, _counts(codec, devices), table, is_builtin)
    composed["truth"] = truth.name
    habits = [truth.habits or _maker_habits(device) for device in devices[:JOINTS]]
    if any(one != HabitSettings() for one in habits):
        composed["habits"] = [dict(vars(one)) for one in habits]
    scenario = resolve_scenario(scenario_name, composed, settings.arm.profile, seed)
    contract = describe_devices(codec, devices, settings)
    return Rehearsal(codec, contract, scenario, [*assumed, *_omissions(devices, contract)])


def _lay_over(scenario: str, table: dict[str, Any], truth: str, sections: dict[str, Any]) -> None:
    """Lay a truth's sections over those of a scenario's table, in place. scenario, truth: names, for errors.

    Raises ConfigError for a section that is no table, or that is wrong once it is laid over.
    """
    for name, settings in SCENARIO_SECTIONS.items():
        said, true = table.get(name, {}), sections.get(name, {})
        for place, section in ((scenario, said), (truth, true)):
            if not isinstance(section, dict):
                raise ConfigError(f"{place}: `{name}` = {section!r} must be a table")
        table[name] = said | true
        try:
            parse(settings, table[name], f"{name}.")
        except ConfigError as error:
            raise ConfigError(f"{scenario}{f' with {truth}' if true else ''}: {error}") from None


def _omissions(devices: list[PlacedDevice], contract: EmulatedContract) -> list[str]:
    """Return a line for each EDS that omits objects which the emulator adds, naming these."""
    lines: dict[str, None] = {}
    for device, description in zip(devices, contract.devices, strict=True):
        if names := ", ".join(f"0x{index:04X} ({made.name})" for index, made in description.made_up.items()):
            lines[f"assumed: {names}, which {device.profile.eds.name} omits and every such device has"] = None
    return list(lines)


@functools.cache
def _habits_by_vendor() -> dict[int, HabitSettings]:
    text = resources.files("firmware_sim").joinpath("maker_habits.toml").read_text(encoding="utf-8")
    makers = tomllib.loads(text)["maker"]
    return {
        maker["vendor"]: parse(HabitSettings, {key: maker[key] for key in maker if key not in ("vendor", "name")})
        for maker in makers
    }


def _maker_habits(device: PlacedDevice) -> HabitSettings:
    """Return the habits of the maker's drives, by the vendor id in the device's EDS.

    Makers that `maker_habits.toml` lacks have default habits.
    """
    vendor = _default(device, 0x1018, 1) or device.objects.device_information.vendor_number
    return _habits_by_vendor().get(vendor, HabitSettings())


def _counts(codec: Codec, devices: list[PlacedDevice]) -> DeviceCounts:
    """Return position increments, torque ranges, Nm, rated torques, Nm, and their counts, Nm, by profiles and EDS."""
    drives, sensors = devices[:JOINTS], devices[JOINTS:]
    first, second = (float(drive.settings.scale.increments_per_joint_rev) for drive in drives)
    ranges = []
    for sensor in sensors:
        message = codec.message(f"{sensor.name}Torque")
        signal = message.values[message.place("torque")]
        ranges.append(sensor.settings.plausibility.torque_range_Nm or signal.raw_high * signal.scale)
    count_Nm = [drive.settings.scale.joint_torque_Nm for drive in drives]
    rated_Nm = [_default(drive, 0x6076, 0) * worth for drive, worth in zip(drives, count_Nm, strict=True)]
    return DeviceCounts((first, second), (ranges[0], ranges[1]), (count_Nm[0], count_Nm[1]), (rated_Nm[0], rated_Nm[1]))


def _default(device: PlacedDevice, index: int, sub: int) -> int:
    """Return an object's default in the EDS; 0 if the EDS lacks the object or gives it no default."""
    variable = device.variable(ObjectName(index, sub)) if device.has(index, sub) else None
    return 0 if variable is None or variable.default is None else variable.default


def _can_be_set(device: PlacedDevice, index: int, sub: int) -> bool:
    """Return whether an object may get another value than its EDS's: it is writable, or the increments are assumed.

    False if the EDS lacks it.
    """
    if not device.has(index, sub):
        return False
    is_guess = "scale.increments_per_joint_rev" in device.settings.assumed
    return is_guess or device.variable(ObjectName(index, sub)).is_writable


def describe_devices(codec: Codec, devices: list[PlacedDevice], settings: Settings) -> EmulatedContract:
    """Return the contract of a DBC whose devices have the EDS and values of their device profiles.

    Raises ConfigError for an EDS that can't be played.
    """
    described = tuple(_describe(device, settings) for device in devices)
    return EmulatedContract(codec.path.name, "", "", described, settings.bus.period_us)


def _counts_of_position(device: PlacedDevice) -> dict[tuple[int, int], int]:
    """Return values of encoder, gear and feed constant by (index, sub-index) that give the device profile's increments.

    The objects are 0x608F, 0x6091 and 0x6092; a gear in the EDS is kept.
    """
    scale = device.settings.scale
    told_in, told_out = _default(device, 0x6091, 1), _default(device, 0x6091, 2)
    gear = Fraction(told_in, told_out) if told_in and told_out else Fraction(scale.gear_ratio).limit_denominator(1000)
    encoder = Fraction(scale.increments_per_joint_rev).limit_denominator(1000) / gear
    return {
        (0x608F, 1): encoder.numerator,
        (0x608F, 2): encoder.denominator,
        (0x6091, 1): gear.numerator,
        (0x6091, 2): gear.denominator,
        (0x6092, 1): round(scale.increments_per_joint_rev),
        (0x6092, 2): 1,
    }


def _live_value(device: PlacedDevice, pdo: PdoSettings, signal: SignalSettings) -> LiveValue | None:
    """Return the live value of a mapped object: that of its own signal, else of the signal with which it is compared.

    None: the emulator has neither, so the object keeps a value of its own.
    """
    objects = _OBJECTS[device.settings.kind]
    if signal.signal in objects:
        return LiveValue(objects[signal.signal])
    twin = next((other for other in pdo.signals if other.signal == signal.of), None)
    if twin is None or twin.signal not in objects:
        return None
    (count, _), (twin_count, _) = device.settings.unit_of(signal), device.settings.unit_of(twin)
    return LiveValue(objects[twin.signal], twin_count / count)


_BOTH_WAYS = ("position", "velocity", "torque", "target_torque")
"""Signals with negative values."""


def _check_objects(device: PlacedDevice) -> None:
    """Raise ConfigError if an object hasn't the standard's type, or a signal with negative values is unsigned."""
    place = f"device profile {device.profile.name}"
    for index in STANDARD_OBJECTS:
        if device.has(index):
            device.variable(ObjectName(index))
    for signal in (signal for pdo in device.settings.pdo for signal in pdo.signals if signal.signal in _BOTH_WAYS):
        if not device.variable(signal.name).is_signed:
            raise ConfigError(f"{place}: {signal.name} ({signal.signal}) is unsigned and can't be played")


def _describe(device: PlacedDevice, settings: Settings) -> DeviceDescription:
    """Return a device's description: its EDS, and the values at power-on that profile, settings or standard add to it.

    Added to each EDS are the objects that it omits (`made_up`) and live values behind the profile's objects
    (`aliases`). An EDS of the package keeps its values except the serial number. Raises ConfigError for an EDS with a
    wrong type or an unsigned signal.
    """
    _check_objects(device)
    kind, scale = device.settings.kind, device.settings.scale
    made_up = {index: made for index, made in _made_up(kind, settings).items() if not device.has(index)}
    defaults: dict[tuple[int, int], int] = {}
    if device.settings.serial:
        defaults[0x1018, 4] = device.settings.serial[device.joint]
    aliases = {
        (signal.name.index, signal.name.sub): live
        for pdo in device.settings.pdo
        for signal in pdo.signals
        if (live := _live_value(device, pdo, signal)) is not None
    }
    if device.profile.eds.name in _OWN_EDS and device.profile.eds.parent == contract_folder():
        return DeviceDescription(device.profile.eds, defaults, {}, made_up, aliases)
    fallbacks = {(0x1005, 0): 0x80, (0x1006, 0): 0, (0x1014, 0): 0x80 + device.node_id}
    fallbacks[0x1000, 0] = _DEVICE_TYPES[kind]
    fallbacks |= {(index, 1): NOT_VALID for index in _RECORDS}
    for pdo in device.settings.pdo:
        fallbacks[pdo.communication_index, 1] = device.can_id(pdo)
        fallbacks[pdo.communication_index, 2] = pdo.transmission
    if kind == "drive":
        counts = _counts_of_position(device)
        fallbacks |= counts
        # Writable objects have been set up for this arm, whatever the factory's values; a guess is played as it is.
        defaults |= {place: value for place, value in counts.items() if _can_be_set(device, *place)}
        fallbacks[0x6502, 0] = 1 << CYCLIC_SYNCHRONOUS_TORQUE - 1
    else:
        fallbacks |= {(0x6131, sub): _NEWTON_METRE for sub in range(1, 255)}
        fallbacks |= {(0x6132, sub): max(round(-math.log10(scale.torque_Nm)), 0) for sub in range(1, 255)}
    return DeviceDescription(device.profile.eds, defaults, fallbacks, made_up, aliases)
