"""A configuration: all sections as one value, from a built-in name or a TOML file and the files that it extends.

`known_keys` lists every key with type, default, bounds, unit and meaning. `apply_settings` changes single keys: a key
is dotted, `detector.threshold_Nm`; a value is TOML, where a word needs no quotes and a number stands for a list of that
number. Settings that determined the numbers of a log can't be changed for its replay.
"""

import dataclasses
import functools
import itertools
import math
import tomllib
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from adacd_hil.file_access import exists
from adacd_hil.records import GRAVITY_M_S2, JOINTS, POSITION_TERMS, Vector
from adacd_hil.remedies import nearest_name
from adacd_hil.scheduling import RealtimeRequest
from adacd_hil.settings.arm_settings import (
    SLIGHT_TILT_DEG,
    UPRIGHT_DEG,
    ArmSettings,
    BusSettings,
    DataSettings,
    DevicesSettings,
    LockstepSettings,
)
from adacd_hil.settings.run_settings import (
    ControllerSettings,
    ExcitationSettings,
    HistorySettings,
    LogSettings,
    OperatorSettings,
    ReactionSettings,
    RealtimeSettings,
    SafetySettings,
    TareSettings,
    TrajectorySettings,
)
from adacd_hil.settings.schema import WITHDRAWN, ConfigError, describe_gone, parse, setting
from adacd_hil.settings.scheme_settings import (
    CROSS_TALK,
    CertifiedSettings,
    DetectorSettings,
    EstimatorSettings,
    FilterSettings,
    TerminationSettings,
)
from adacd_hil.settings.toml_files import builtin_folder, builtin_names, find_toml, parse_toml, read_toml, to_toml

_LONGEST_CHAIN = 8
"""Most configurations that may extend each other in a row."""


@dataclass(frozen=True)
class Settings:
    """Everything a run depends on, resolved. Attached to every log."""

    name: str = setting("", meaning="name of the configuration")
    scheme: str = setting("paper", choices=("paper", "certified"), meaning="the paper's scheme, or the one beyond it")
    arm: ArmSettings = setting(ArmSettings, meaning="the arm")
    bus: BusSettings = setting(BusSettings, meaning="timing on the bus")
    data: DataSettings = setting(DataSettings, meaning="how much of the cyclic data may be missing")
    devices: DevicesSettings = setting(DevicesSettings, meaning="drives and sensors")
    filter: FilterSettings = setting(FilterSettings, meaning="torque filter")
    estimator: EstimatorSettings = setting(EstimatorSettings, meaning="adaptation law")
    termination: TerminationSettings = setting(TerminationSettings, meaning="end of adaptation")
    detector: DetectorSettings = setting(DetectorSettings, meaning="collision detection")
    certified: CertifiedSettings = setting(CertifiedSettings, meaning="the scheme beyond the paper")
    reaction: ReactionSettings = setting(ReactionSettings, meaning="reactions to a contact")
    trajectory: TrajectorySettings = setting(TrajectorySettings, meaning="the motion")
    excitation: ExcitationSettings = setting(ExcitationSettings, meaning="the motion of the certified adaptation")
    controller: ControllerSettings = setting(ControllerSettings, meaning="joint controller")
    operator: OperatorSettings = setting(OperatorSettings, meaning="scripted user")
    lockstep: LockstepSettings = setting(LockstepSettings, meaning="modelled time of the host")
    realtime: RealtimeSettings = setting(RealtimeSettings, meaning="being on time")
    safety: SafetySettings = setting(SafetySettings, meaning="checks before torque")
    tare: TareSettings = setting(TareSettings, meaning="tare of the torque sensors")
    history: HistorySettings = setting(HistorySettings, meaning="the arm's last certificate")
    log: LogSettings = setting(LogSettings, meaning="the log")
    assumed: tuple[str, ...] = setting((), meaning="keys whose values are guesses; `doctor` asks for each of them")

    @property
    def blind_cycles(self) -> int:
        """Cycles in a row without a fresh sample that fault the run: not fewer than a value may be old."""
        return max(self.data.blind_cycles, self.bus.max_age_cycles)

    @property
    def commission_cycles(self) -> int:
        """Good cycles in a row before the drives are enabled: those of `safety.commission_s`, at least one."""
        return max(1, round(self.safety.commission_s / self.bus.period_s))

    @property
    def further_names(self) -> tuple[str, ...]:
        """Names of the certified scheme's further parameters, after the dynamic ones; () for the paper's scheme."""
        if self.scheme == "paper":
            return ()
        by_place = POSITION_TERMS if self.arm.position_torque_Nm > 0.0 else ()
        between = (CROSS_TALK,) if self.certified.cross_talk_std > 0.0 else ()
        kinds = ("offset", "lag", *self.certified.friction_terms, *between, *by_place)
        return tuple(f"{kind}{joint + 1}" for kind in kinds for joint in range(JOINTS))

    @property
    def further_count(self) -> int:
        """Number of `further_names`."""
        return len(self.further_names)

    @property
    def filter_count(self) -> int:
        """Number of filters in the certified scheme's bank; 0 for the paper's scheme."""
        return len(self.certified.cutoffs_rad_s) if self.scheme == "certified" else 0

    @property
    def channel_count(self) -> int:
        """Number of residuals per joint with a threshold: one smoothed per filter, one bare for all but the slowest."""
        return max(2 * self.filter_count - 1, 0)

    @property
    def cad_theta(self) -> Vector:
        """The CAD model's parameters (p,)."""
        return np.array(self.arm.cad_theta, dtype=np.float64)

    @property
    def mounting_deg(self) -> tuple[float, float]:
        """Tilt of the plane of motion, and the q1 at which link 1 hangs down, deg; see `arm.mounting_deg`."""
        if self.arm.mounting_deg is not None:
            return self.arm.mounting_deg
        return (UPRIGHT_DEG, -90.0) if self.estimator.gravity else (0.0, 0.0)

    @property
    def tilt_rad(self) -> float:
        """Tilt of the plane of motion, rad."""
        return math.radians(self.mounting_deg[0])

    @property
    def gravity_m_s2(self) -> float:
        """Gravity in the plane of motion, m/s²; 0 if the model has no gravity."""
        return GRAVITY_M_S2 * math.sin(self.tilt_rad) if self.estimator.gravity else 0.0

    @property
    def level_rad(self) -> float:
        """The q1 at which link 1 is level and q1 grows uphill, rad; 0 if the model has no gravity."""
        return math.radians(self.mounting_deg[1] + 90.0) if self.estimator.gravity else 0.0

    @property
    def realtime_request(self) -> RealtimeRequest:
        """Real-time request of the control process to the operating system."""
        wish = self.realtime
        return RealtimeRequest(wish.scheduler, wish.priority, wish.cpu, wish.lock_memory, self.bus.period_ns)

    def __post_init__(self) -> None:
        tilt_deg, names = self.mounting_deg[0], self.estimator.parameter_names
        if self.estimator.gravity and tilt_deg == 0.0:
            raise ConfigError("`arm.mounting_deg[0]` = 0 deg: gravity does not act, but `estimator.gravity` = true")
        if tilt_deg > SLIGHT_TILT_DEG and not self.estimator.gravity:
            raise ConfigError(
                f"`arm.mounting_deg[0]` = {tilt_deg:g} deg: gravity acts on the joints; `estimator.gravity` = true "
                f"expected above {SLIGHT_TILT_DEG:g} deg"
            )
        if len(self.arm.cad_theta) not in (0, len(names)):
            gravity = " (`estimator.gravity` adds a4 and a5, Nm)" if self.estimator.gravity else ""
            raise ConfigError(
                f"`arm.cad_theta` has {len(self.arm.cad_theta)} values, {len(names)} expected: "
                f"{', '.join(names)}{gravity}; [] without CAD model"
            )
        if self.bus.host_node in (*self.devices.drive_node, *self.devices.sensor_node):
            raise ConfigError(f"`bus.host_node` = {self.bus.host_node} is the node id of a device")


def renewed(table: dict[str, Any]) -> dict[str, Any]:
    """Return the configuration of a log with the keys of older versions replaced by today's.

    A log holds every key of the version that wrote it. So a term whose key is missing was not in that version's model.
    """
    certified = table.get("certified")
    if isinstance(certified, dict) and "cross_talk_std" not in certified:
        table = table | {"certified": certified | {"cross_talk_std": 0.0}}
    detector = table.get("detector")
    if isinstance(detector, dict):
        table = table | {"detector": {key: detector[key] for key in detector if f"detector.{key}" not in WITHDRAWN}}
    safety = table.get("safety")
    if not isinstance(safety, dict) or "commission_cycles" not in safety:
        return table
    bus = table.get("bus")
    period_us = bus.get("period_us", 1000) if isinstance(bus, dict) else 1000
    cycles = safety["commission_cycles"]
    if not (isinstance(cycles, int) and isinstance(period_us, int)):
        return table
    kept = {key: value for key, value in safety.items() if key != "commission_cycles"}
    return table | {"safety": kept | {"commission_s": cycles * period_us * 1e-6}}


def merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """Merge two TOML tables, section by section; `over` wins."""
    merged = dict(base)
    for key, value in over.items():
        if isinstance(value, dict) and isinstance(merged.get(key), dict):
            merged[key] = merge(merged[key], value)
        else:
            merged[key] = value
    return merged


class ConfigurationLayer(NamedTuple):
    """Settings of one file, or of one profile in it; `origin` names it."""

    origin: str
    table: dict[str, Any]


def load_settings(name_or_file: str = "paper", profile: str | None = None) -> Settings:
    """Resolve a configuration: a built-in name, or a TOML file merged over the one it `extends` (default `paper`).

    `profile` picks the `[profiles.X]` table. Raises ConfigError.
    """
    return parse(Settings, resolved_table(configuration_layers(name_or_file, profile)))


def resolved_table(layers: Sequence[ConfigurationLayer]) -> dict[str, Any]:
    """Merge the layers of a configuration, later over earlier."""
    return functools.reduce(merge, (layer.table for layer in layers), {})


def configuration_layers(name_or_file: str, profile: str | None = None) -> list[ConfigurationLayer]:
    """Read a configuration and all that it extends, the base first. Raises ConfigError.

    A profile's values come first: keys of the files override them.
    """
    files = _load_chain(name_or_file)
    table = resolved_table(files)
    profiles = _table_in(table, "profiles", "`profiles`")
    chosen = profile or _table_in(table, "arm", "`arm`").get("profile", "P")
    if not isinstance(chosen, str) or chosen not in profiles:
        raise ConfigError(f"profile {chosen!r} is not in configuration {name_or_file}; known: {', '.join(profiles)}")
    layers = []
    for layer in files:
        own = _table_in(_table_in(layer.table, "profiles", "`profiles`"), chosen, f"`profiles.{chosen}`")
        if own:
            layers.append(ConfigurationLayer(f"{layer.origin} [profiles.{chosen}]", own))
    layers += [
        ConfigurationLayer(origin, {key: value for key, value in said.items() if key != "profiles"})
        for origin, said in files
    ]
    if profile is not None:
        layers.append(ConfigurationLayer("--profile", {"arm": {"profile": chosen}}))
    return layers


def _table_in(table: dict[str, Any], key: str, name: str) -> dict[str, Any]:
    """Return a table within a table, empty if absent. Raises ConfigError if the value is not a table."""
    value = table.get(key, {})
    if not isinstance(value, dict):
        raise ConfigError(f"{name} = {value!r} must be a table")
    return value


def _find_beside(table: dict[str, Any], folder: Path) -> None:
    """Make the paths of device and contract files absolute if the files lie in the configuration's folder."""

    def found(name: Any) -> Any:
        is_beside = isinstance(name, str) and Path(name).suffix and exists(folder / name)
        return str(folder / name) if is_beside else name

    devices = table.get("devices")
    if not isinstance(devices, dict):
        return
    for key in ("drive", "sensor", "contract"):
        if key in devices:
            value = devices[key]
            devices[key] = [found(name) for name in value] if isinstance(value, list) else found(value)


def _load_chain(name_or_file: str, seen: tuple[str, ...] = ()) -> list[ConfigurationLayer]:
    """Read a configuration and all that it extends; relative paths start in the folder of the file that names them."""
    if name_or_file in seen:
        raise ConfigError(f"configuration {name_or_file} extends itself")
    if len(seen) > _LONGEST_CHAIN:
        raise ConfigError(f"configuration {seen[0]} extends more than {_LONGEST_CHAIN} others, one by one")
    path = find_toml("configuration", name_or_file, builtin_folder())
    table = read_toml(path)
    table.setdefault("name", path.stem)
    _find_beside(table, path.parent)
    if "extends" not in table and name_or_file in builtin_names():
        return [ConfigurationLayer(name_or_file, table)]
    extended = table.pop("extends", "paper")
    if not isinstance(extended, str):
        raise ConfigError(f"`extends` = {extended!r} must be the name of a configuration or a file")
    if extended not in builtin_names() and Path(extended).suffix:
        extended = str(path.parent / extended)
    return [*_load_chain(extended, (*seen, name_or_file)), ConfigurationLayer(name_or_file, table)]


class KnownKey(NamedTuple):
    """One setting. `key` is dotted; a key in the rows of a list has `[]` after the list's name."""

    key: str
    kind: Any
    default: str
    """As TOML; `required` if there is no default, `none` if the setting is absent by default."""
    bounds: str
    """The choices, or the bounds with the unit; empty without bounds."""
    meaning: str
    choices: tuple[str, ...]

    @property
    def is_in_row(self) -> bool:
        """Whether the key belongs to the rows of a list, which only a file can set."""
        return "[]" in self.key


def sections() -> Iterator[tuple[str, type[Any], str]]:
    """Yield name, class and meaning of each table of a configuration; first the top of the file, with an empty name."""
    yield "", Settings, "top of the file"
    hints = typing.get_type_hints(Settings)
    for field in dataclasses.fields(Settings):
        if dataclasses.is_dataclass(hints[field.name]):
            yield field.name, hints[field.name], field.metadata["meaning"]


def keys_of(section: type[Any], prefix: str) -> Iterator[KnownKey]:
    """Yield the settings of a table, rows of its lists included; tables within it are sections of their own."""
    hints = typing.get_type_hints(section)
    for field in dataclasses.fields(section):
        kind = hints[field.name]
        if dataclasses.is_dataclass(kind):
            continue
        default = "required" if field.default is dataclasses.MISSING else in_words(field.default)
        meta = field.metadata
        yield KnownKey(prefix + field.name, kind, default, _bounds(meta), meta["meaning"], meta["choices"])
        for inner in typing.get_args(kind):
            if dataclasses.is_dataclass(inner) and isinstance(inner, type):
                yield from keys_of(inner, f"{prefix}{field.name}[].")


def known_keys() -> dict[str, KnownKey]:
    """Return every setting by its key, in the order of the declarations."""
    tables = ((f"{name}." if name else "", section) for name, section, _ in sections())
    return {known.key: known for prefix, section in tables for known in keys_of(section, prefix)}


def value_of(settings: Settings, key: str) -> Any:
    """Return the value of a dotted key."""
    value: Any = settings
    for part in key.split("."):
        value = getattr(value, part)
    return value


def in_words(value: Any) -> str:
    """Format a value as in a configuration, numbers with six significant digits at most."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = ((field.name, getattr(value, field.name)) for field in dataclasses.fields(value))
        return f"{{{', '.join(f'{name} = {in_words(inner)}' for name, inner in fields)}}}"
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(in_words, value))}]"
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "none"}[value]
    return f'"{value}"' if isinstance(value, str) else f"{value:g}" if isinstance(value, float) else str(value)


def explain_unknown(key: str) -> str:
    """Return one line that a key is unknown, with its successor, the nearest known key, or the keys of its section."""
    keys = [name for name, known in known_keys().items() if not known.is_in_row]
    below = [known for known in keys if known.startswith(f"{key}.")]
    if below:
        return f"`{key}` is a section; its keys are {', '.join(below)}"
    if gone := describe_gone(key):
        return gone
    section, _, last = key.rpartition(".")
    by_name = {known.rpartition(".")[2]: known for known in reversed(keys)}
    found = nearest_name(key, keys) or by_name.get(nearest_name(last, by_name) or "")
    if found:
        return f"unknown key `{key}`; did you mean `{found}`?"
    beside = [known.rpartition(".")[2] for known in keys if section and known.rpartition(".")[0] == section]
    if beside:
        return f"unknown key `{key}`; `{section}` has {', '.join(beside)}"
    names = [field.name for field in dataclasses.fields(Settings)]
    return f"unknown key `{key}`; it begins with a section: {', '.join(names)}"


def _bounds(metadata: Any) -> str:
    if metadata["choices"]:
        return ", ".join(metadata["choices"])
    low, high, unit = metadata["low"], metadata["high"], metadata["unit"]
    if math.isinf(high):
        return str(unit) if math.isinf(low) else f"≥ {low:g} {unit}".strip()
    return f"{low:g} … {high:g} {unit}".strip()


_FACTS: Final = ("profile", "sign", "torque_offset_Nm", "torque_offset_std_Nm", "rated_torque_Nm")
"""Settings of the arm that determined the numbers of a log."""


def apply_settings(settings: Settings, changes: Mapping[str, str]) -> Settings:
    """Return the settings with some keys changed, each `section.key` to a TOML value.

    Raises ConfigError; for an unknown key it names the nearest known one.
    """
    table = tomllib.loads(to_toml(settings))
    known = known_keys()
    for key, text in changes.items():
        if key not in known or known[key].is_in_row:
            raise ConfigError(explain_unknown(key))
        parts = key.split(".")
        section: dict[str, Any] = table
        for part in parts[:-1]:
            section = section.setdefault(part, {})
        section[parts[-1]] = _spread(_read_value(key, text), known[key].kind, section.get(parts[-1]))
    return parse(Settings, table)


def refuse_facts(changes: Mapping[str, str]) -> None:
    """Raise ConfigError if a key determined the numbers of a log, such as a sign or a device."""
    facts = {f"arm.{name}" for name in _FACTS} | {"bus.period_us", "realtime.sample_period"}
    for key in changes:
        if key in facts or key.startswith("devices."):
            raise ConfigError(f"`{key}` made the numbers of the log; a replay can't change it")


def _read_value(key: str, text: str) -> Any:
    try:
        return parse_toml(f"value = {text}")["value"]
    except ConfigError:
        if text and not set(text) & set("\"'[]{}=\n#"):
            return text
        raise ConfigError(f"`{key}` = {text} is not a TOML value") from None


def _spread(value: Any, kind: Any, present: Any) -> Any:
    """Repeat a single value to a list as long as the present one, if the setting is a list."""
    if typing.get_origin(kind) is tuple and not isinstance(value, list):
        elements = [element for element in typing.get_args(kind) if element is not Ellipsis]
        count = len(present) if isinstance(present, list) else len(elements)
        return [value] * count
    return value


def keep_facts(own: Settings, other: Settings) -> Settings:
    """Return `other` with the settings of a log's arm, bus, devices and sample period.

    Signs, torque offsets, rated torques, the contract and the sample period determined the numbers of the log, so that
    no configuration may change them afterwards. Holding torque and position-dependent torque come from the log, too, if
    it has them.
    """
    facts = {name: getattr(own.arm, name) for name in _FACTS}
    if own.arm.holding_torque_Nm is not None:
        facts["holding_torque_Nm"] = own.arm.holding_torque_Nm
    if own.arm.position_torque_Nm > 0.0:
        facts["position_torque_Nm"] = own.arm.position_torque_Nm
    realtime = dataclasses.replace(other.realtime, sample_period=own.realtime.sample_period)
    arm = dataclasses.replace(other.arm, **facts)
    return dataclasses.replace(other, arm=arm, bus=own.bus, devices=own.devices, realtime=realtime)


def parse_changes(given: Sequence[str]) -> dict[str, str]:
    """Parse `key=value` texts of repeated options. Raises ConfigError."""
    changes: dict[str, str] = {}
    for text in given:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            raise ConfigError(f"{text!r} must be key=value, such as detector.threshold_Nm=0.1")
        changes[key.strip()] = value.strip()
    return changes


def parse_variations(given: Sequence[str]) -> list[dict[str, str]]:
    """Parse `key=a,b,c` texts of repeated options; return every combination. Raises ConfigError."""
    lists = [[(key, value) for value in split_list(text)] for key, text in parse_changes(given).items()]
    return [dict(choice) for choice in itertools.product(*lists)]


def split_list(text: str) -> list[str]:
    """Split a text at its commas outside brackets and quotes."""
    parts, depth, quote, start = [], 0, "", 0
    for place, letter in enumerate(text):
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        elif letter in "[{":
            depth += 1
        elif letter in "]}":
            depth -= 1
        elif letter == "," and depth == 0:
            parts.append(text[start:place].strip())
            start = place + 1
    return [*parts, text[start:].strip()]


def changed_keys(before: Settings, after: Settings) -> dict[str, tuple[str, str]]:
    """Return the settings that differ, by key: both values, formatted."""
    tables = [_flat(tomllib.loads(to_toml(settings)), "") for settings in (before, after)]
    keys = [*tables[0], *(key for key in tables[1] if key not in tables[0])]
    words = {key: (tables[0].get(key, "unset"), tables[1].get(key, "unset")) for key in keys}
    return {key: pair for key, pair in words.items() if pair[0] != pair[1]}


def _flat(table: Mapping[str, Any], prefix: str) -> dict[str, str]:
    flat: dict[str, str] = {}
    for key, value in table.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = repr(value)
    return flat
