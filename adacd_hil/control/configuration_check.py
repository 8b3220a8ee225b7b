"""Checks of a configuration without a bus: errors and likely mistakes, a line each."""

import functools
import itertools
import math
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import PurePath
from typing import NamedTuple

from adacd_hil.control.motions import motion_problems
from adacd_hil.device.canopen_bus import find_variable
from adacd_hil.device.contract import load_contract
from adacd_hil.device.device_files import load_profile, place_devices
from adacd_hil.device.drive_units import read_drive_units
from adacd_hil.device.profile import PlacedDevice
from adacd_hil.records import JOINTS
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import (
    ConfigurationLayer,
    configuration_layers,
    profiles_of,
    resolved_table,
)
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.run_settings import ReactionSettings
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.setting_keys import explain_unknown, known_keys, value_of
from adacd_hil.settings.toml_files import builtin_names
from adacd_hil.wire.budget import describe_excess
from adacd_hil.wire.codec import Codec, CodecError
from adacd_hil.wire.contract_attributes import DEFAULT_BITRATE, read_bitrates

_ARMS_OWN = ("arm.cad_theta", "controller.Kp", "controller.Kd")
"""Keys that the built-in profiles set for an emulated arm."""
_MOST_RAD = 2.0 * math.pi
"""A limit below this many degrees is hardly any motion, and probably meant in radians."""


class ConfigurationFindings(NamedTuple):
    """errors: reasons why the configuration can't be used. mistakes: likely ones. `settings`: None with errors.

    guesses: keys of values that the configuration or a device profile lists as assumed.
    """

    errors: list[str]
    mistakes: list[str]
    settings: Settings | None
    guesses: tuple[str, ...] = ()
    is_late: bool = False
    """Whether frames miss their deadlines in the period."""

    @property
    def warnings(self) -> list[str]:
        """The likely mistakes, and a line on the guesses if there are any."""
        guesses = ", ".join(f"`{key}`" for key in self.guesses)
        return [*self.mistakes, *([f"assumed, not known: {guesses}"] if guesses else [])]


def examine_configuration(name_or_file: str, profile: str | None = None) -> ConfigurationFindings:
    """Return errors and likely mistakes of a configuration, by its name or file, instead of raising ConfigError.

    profile: name of one of its `[profiles]` to apply; None: the configuration's choice, and the errors of the other
    profiles of its file are found, too. Wrong keys and values are errors; without any, as `examine_settings`.
    """
    try:
        layers = configuration_layers(name_or_file, profile)
        settings = parse(Settings, resolved_table(layers))
        others = [] if profile is not None else profiles_of(name_or_file)
    except ConfigError as error:
        return ConfigurationFindings([*error.problems], [], None)
    found = examine_settings(settings, layers)
    errors = [
        f"--profile {other}: {line}"
        for other in others
        if other != settings.arm.profile
        for line in examine_configuration(name_or_file, other).errors
    ]
    return found._replace(errors=[*found.errors, *errors], settings=None) if errors else found


def examine_settings(settings: Settings, layers: Sequence[ConfigurationLayer] = ()) -> ConfigurationFindings:
    """Return errors and likely mistakes of settings. layers: of their configuration, () if unknown.

    Checked in turn are the motion's limits, the device profiles, the contract; if one of these has errors, the later
    ones and the likely mistakes are left out. Beside errors of the motion, values that look like radians are errors.
    """
    if problems := motion_problems(settings):
        return ConfigurationFindings([*problems, *_radians(settings)], [], None)
    if problems := _device_problems(settings):
        return ConfigurationFindings(problems, [], None)
    try:
        devices = place_devices(settings)
        codec = load_contract(settings, devices)
        excess = describe_excess(codec, settings)
    except (ConfigError, CodecError) as error:
        return ConfigurationFindings([str(error)], [], None)
    late = [excess] if excess else []
    mistakes = [line for look in _LOOKS for line in look(settings)]
    mistakes += [*_misfits(codec, settings), *_ranges(codec, settings, devices), *_unseen(devices), *_gears(devices)]
    mistakes += [*_unused(codec, settings), *_layer_warnings(layers), *late]
    guesses = *settings.assumed, *profile_guesses(settings)
    return ConfigurationFindings([], mistakes, settings, guesses, bool(late))


def profile_guesses(settings: Settings) -> dict[str, float]:
    """Return the values that the device profiles list as assumed, by keys such as `my-drive.toml: scale.gear_ratio`.

    Raises ConfigError for a profile that is missing, invalid or of another kind, or whose EDS can't be read.
    """
    found = {}
    for kind, names in (("drive", settings.devices.drive), ("sensor", settings.devices.sensor)):
        for name in dict.fromkeys(names):
            profile = load_profile(name, kind).settings
            for key in profile.assumed:
                section, _, field = key.partition(".")
                found[f"{PurePath(name).name}: {key}"] = getattr(getattr(profile, section), field)
    return found


_MOST_NAMED = 4
"""Most guesses that a run names; `config check` names all."""


def guesses_in_brief(settings: Settings, measured: Collection[str] = ()) -> str:
    """Return a line that names up to _MOST_NAMED guessed values of a configuration, and the command to confirm them.

    If there are more, it is the command that names all. "" if there are none. Guessed: listed in `assumed`, of the
    settings or of a device profile. measured: keys of the settings that are guesses no longer. Raises ConfigError as
    `profile_guesses`.
    """
    guesses = [f"`{key}`" for key in (*profile_guesses(settings), *settings.assumed) if key not in measured]
    more = f" and {len(guesses) - _MOST_NAMED} more" if len(guesses) > _MOST_NAMED else ""
    named = f"{', '.join(guesses[:_MOST_NAMED])}{more}"
    remedy = "`adacd-hil config check` names all" if more else "`adacd-hil doctor` asks for each"
    return f"unconfirmed guesses: {named}; {remedy}" if guesses else ""


def _device_problems(settings: Settings) -> list[str]:
    """Return the errors of loading the configured device profiles, each text once; [] without any."""
    devices = settings.devices
    problems: dict[str, None] = {}
    for kind, names in (("drive", devices.drive), ("sensor", devices.sensor)):
        for name in names:
            try:
                load_profile(name, kind)
            except ConfigError as error:
                problems[str(error)] = None
    return list(problems)


_BOUNDS = (
    ("arm.torque_limit_Nm", "arm.rated_torque_Nm", "Nm", ""),
    ("detector.threshold_Nm", "arm.rated_torque_Nm", "Nm", "; the paper's scheme detects no weaker contact"),
    ("reaction.velocity_limit_deg_s", "arm.velocity_limit_deg_s", "deg/s", "; a withdrawal keeps to the smaller one"),
)
"""Pairs of keys: the first must not exceed the second; then the consequence."""


def _over(settings: Settings) -> Iterator[str]:
    """Yield a warning for each joint's value that exceeds its bound in `_BOUNDS`."""
    for key, bound_key, unit, outcome in _BOUNDS:
        pairs = zip(value_of(settings, key), value_of(settings, bound_key), strict=True)
        for joint, (value, bound) in enumerate(pairs):
            if value > bound:
                limit = f"`{bound_key}[{joint}]` = {bound:g} {unit}"
                yield f"`{key}[{joint}]` = {value:g} {unit} exceeds {limit}{outcome}"


def _radians(settings: Settings) -> Iterator[str]:
    """Yield a warning for each limit or amplitude in degrees with values up to `_MOST_RAD`: radians, probably."""
    for key in ("arm.position_limit_deg", "trajectory.amplitude_deg", "arm.velocity_limit_deg_s"):
        values = value_of(settings, key)
        if 0.0 < max(values) <= _MOST_RAD:
            unit = "rad/s" if key.endswith("_s") else "rad"
            meant = " and ".join(f"{math.degrees(value):.3g}" for value in values)
            yield f"`{key}` = {_pair(values)} looks like {unit}; in degrees that would be {meant}"


def _unknown_assumptions(settings: Settings) -> Iterator[str]:
    """Yield a warning for each key in `assumed` that is no setting."""
    known = known_keys()
    for key in settings.assumed:
        if key not in known:
            yield f"`assumed` names no setting: {explain_unknown(key)}"


def _ignored(settings: Settings) -> Iterator[str]:
    """Yield a warning for each reaction to a contact or a collision that scheme `paper` ignores: it always withdraws.

    Yield none for a reaction at its default, and none with another scheme.
    """
    usual = ReactionSettings()
    for key in ("contact", "collision") if settings.scheme == "paper" else ():
        if (wanted := getattr(settings.reaction, key)) != getattr(usual, key):
            yield f"`reaction.{key}` = {list(wanted)} has no effect: with scheme paper the arm always withdraws"


_LOOKS: tuple[Callable[[Settings], Iterator[str]], ...] = (_over, _radians, _unknown_assumptions, _ignored)


def _layer_warnings(layers: Sequence[ConfigurationLayer]) -> Iterator[str]:
    """Yield a warning if no layer but `paper` sets the scheme, and for a CAD model or gains of an emulated arm.

    The latter if a file of the user's describes arm or devices. None for a built-in configuration. layers: the
    configuration and all that it extends, the base first.
    """
    own = [layer for layer in layers if layer.origin not in builtin_names() and "[profiles." not in layer.origin]
    if not own:
        return
    if not any("scheme" in layer.table for layer in layers if layer.origin != "paper"):
        yield 'the scheme is the paper\'s, without certificates; `extends = "certified"` gives the certified one'
    if not any("arm" in layer.table or "devices" in layer.table for layer in own):
        return
    origins = origins_of(layers)
    for key in _ARMS_OWN:
        if "[profiles." in origins.get(key, ""):
            remedy = "give your arm's, or [] for none" if key == "arm.cad_theta" else "give your arm's"
            yield f"`{key}` is that of an emulated arm, from {origins[key]}; {remedy}"


def origins_of(layers: Sequence[ConfigurationLayer]) -> dict[str, str]:
    """Return, by key, the origin of the layer that decides its value: the last one that sets it.

    A key is like `arm.sign`; that of a setting outside sections is its name, like `scheme`.
    """
    found = {}
    for origin, table in layers:
        for section, content in table.items():
            for key in [f"{section}.{name}" for name in content] if isinstance(content, dict) else [section]:
                found[key] = origin
    return found


_COARSE_SHARE = 0.1
"""Part of the largest value above which one count is more likely a mistake."""
_MEASURED = (
    ("Drive", "Feedback", "position", "deg", "position_limit_deg", "increments_per_joint_rev"),
    ("Drive", "Feedback", "velocity", "deg/s", "velocity_limit_deg_s", "velocity_rad_s"),
    ("Sensor", "Torque", "torque", "Nm", "rated_torque_Nm", "torque_Nm"),
)
"""Of each signal: device, frame, name, unit, key of its largest value in `arm`, and key of its count in `scale`."""


def _misfits(codec: Codec, settings: Settings) -> Iterator[str]:
    """Yield a warning for each signal that can't carry its largest value, or has counts above `_COARSE_SHARE` of it.

    Of a position, the largest value to carry is that of `arm` plus the size of `arm.zero_deg`.
    """
    for joint, (device, frame, name, unit, limit, key) in itertools.product(range(JOINTS), _MEASURED):
        message = codec.message(f"{device}{joint + 1}{frame}")
        signal = message.values[message.place(name)]
        count = signal.scale * (math.degrees(1.0) if unit.startswith("deg") else 1.0)
        largest = getattr(settings.arm, limit)[joint]
        if signal.raw_high * count < largest + (abs(settings.arm.zero_deg[joint]) if name == "position" else 0.0):
            words = f"carries ±{signal.raw_high * count:.3g} {unit}"
        elif count > _COARSE_SHARE * largest:
            words = f"has {count:.3g} {unit} a count of {name}"
        else:
            continue
        profile = getattr(settings.devices, device.lower())[joint]
        yield f"{message.name} {words}, `arm.{limit}[{joint}]` = {largest:g} {unit}: is `{key}` of {profile} right?"


def _ranges(codec: Codec, settings: Settings, devices: Sequence[PlacedDevice]) -> Iterator[str]:
    """Yield a warning for each sensor whose stated range is less than the rated torque, or beyond its frame's."""
    for device in devices:
        range_Nm = device.settings.plausibility.torque_range_Nm
        if device.settings.kind != "sensor" or not range_Nm:
            continue
        message = codec.message(f"{device.name}Torque")
        signal = message.values[message.place("torque")]
        most_Nm, rated_Nm = signal.raw_high * signal.scale, settings.arm.rated_torque_Nm[device.joint]
        stated = f"`plausibility.torque_range_Nm` of {settings.devices.sensor[device.joint]} = {range_Nm:g} Nm"
        if range_Nm > most_Nm:
            yield f"{stated}, {message.name} carries ±{most_Nm:.3g} Nm: a saturated torque isn't noticed"
        if range_Nm < rated_Nm:
            yield f"{stated} is below `arm.rated_torque_Nm[{device.joint}]` = {rated_Nm:g} Nm"


def _unseen(devices: Sequence[PlacedDevice]) -> Iterator[str]:
    """Yield a warning for each drive whose actual torque is in no frame, so that the fault TORQUE can't be found."""
    for device in devices:
        sent = {signal.signal for pdo in device.settings.pdo for signal in pdo.signals}
        if device.settings.kind == "drive" and "torque_actual" not in sent:
            yield f"no frame of {device.name} carries `torque_actual`: nothing watches for the fault TORQUE"


def _gears(devices: Sequence[PlacedDevice]) -> Iterator[str]:
    """Yield a warning for each drive whose gear by its profile contradicts 0x6091 by its EDS; a gear of 1 doesn't."""
    for device in devices:
        find = functools.partial(find_variable, device.objects)
        units = read_drive_units(lambda *at, find=find: getattr(find(*at), "default", None))
        gear = device.settings.scale.gear_ratio
        if units.is_other_gear(gear):
            yield (
                f"{device.name}: `scale.gear_ratio` = {gear:g}, 0x6091 = {units.gear_ratio:g} by the EDS: correct it, "
                f"or set the gear in the drive"
            )


def _unused(codec: Codec, settings: Settings) -> Iterator[str]:
    """Yield a warning if `devices.bitrate` is set beside a DBC, `devices.contract`, which has another bit rate.

    None for the default bit rate, which counts as not set.
    """
    bitrate, _ = read_bitrates(codec)
    if settings.devices.contract and settings.devices.bitrate not in (bitrate, DEFAULT_BITRATE):
        yield (
            f"`devices.bitrate` = {settings.devices.bitrate} bit/s is of a composed contract; "
            f"`devices.contract` = {settings.devices.contract!r} has {bitrate} bit/s"
        )


def _pair(values: Sequence[float]) -> str:
    return f"[{', '.join(f'{value:g}' for value in values)}]"
