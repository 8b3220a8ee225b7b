"""A configuration: all sections as one value, from a built-in name or a TOML file and the files that it extends."""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from adacd_hil.file_access import exists
from adacd_hil.records import GRAVITY_M_S2, JOINTS, POSITION_TERMS, Vector
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
from adacd_hil.settings.schema import WITHDRAWN, ConfigError, parse, setting
from adacd_hil.settings.scheme_settings import (
    CROSS_TALK,
    CertifiedSettings,
    DetectorSettings,
    EstimatorSettings,
    FilterSettings,
    TerminationSettings,
)
from adacd_hil.settings.toml_files import builtin_folder, builtin_names, find_toml, read_toml

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
