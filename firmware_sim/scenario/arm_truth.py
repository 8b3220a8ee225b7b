"""A truth: what the real arm is where the host is told otherwise, or nothing. The host never reads it.

`[arm]` has values of their own; `[factor]` multiplies what the host is told; `[wiring]` exchanges and reverses devices;
`[sensors]`, `[drives]` and `[mechanics]` are the sections of a scenario and are laid over them. A truth that comes with
the package states one thing that a user gets wrong, of any arm.
"""

from dataclasses import dataclass
from importlib import resources
from importlib.resources.abc import Traversable
from typing import Any

from adacd_hil.settings.schema import ConfigError, parse, setting
from adacd_hil.settings.toml_files import find_toml, read_toml, toml_names

Pair = tuple[float, float]
SCENARIO_SECTIONS = ("sensors", "drives", "mechanics")


@dataclass(frozen=True)
class TruthArmSettings:
    """The arm itself; what is absent is as the host is told, or assumed. Pairs are by joint."""

    link_length_m: Pair | None = setting(None, unit="m", low=0.01, high=5.0, meaning="joint to joint, joint 2 to tip")
    mass_kg: Pair | None = setting(None, unit="kg", low=1e-4, high=1000.0, meaning="mass of each link")
    center_m: Pair | None = setting(
        None, unit="m", low=-5.0, high=5.0, meaning="centre of mass from the link's joint; absent: the middle"
    )
    inertia_kg_m2: Pair | None = setting(
        None, unit="kg m²", low=0.0, high=1000.0, meaning="about the centre of mass; absent: a rod's"
    )
    viscous_Nm_s: Pair | None = setting(None, unit="Nm s/rad", low=0.0, high=1e4, meaning="viscous friction")
    coulomb_Nm: Pair | None = setting(None, unit="Nm", low=0.0, high=1e3, meaning="Coulomb friction")
    rated_torque_Nm: Pair | None = setting(
        None, unit="Nm", low=0.1, high=1000.0, meaning="rated torque of each joint's drive, 0x6076"
    )
    brake_damping_Nm_s: Pair | None = setting(
        None, unit="Nm s/rad", low=0.0, high=1e4, meaning="quick stop and fault: braking torque per rad/s"
    )
    stop_deg: Pair | None = setting(None, unit="deg", low=1.0, high=720.0, meaning="joint stops at ±")
    torque_offset_Nm: Pair | None = setting(
        None, unit="Nm", low=-50.0, high=50.0, meaning="zero error of the torque sensors"
    )

    def __post_init__(self) -> None:
        for key in ("center_m", "inertia_kg_m2"):
            if getattr(self, key) is not None and self.mass_kg is None:
                raise ConfigError(f"`arm.{key}` needs `arm.mass_kg` beside it")


@dataclass(frozen=True)
class FactorSettings:
    """What is multiplied, by joint; 1 leaves it."""

    link_length: Pair = setting((1.0, 1.0), low=0.1, high=10.0, meaning="of the lengths; masses keep their shares")
    mass: Pair = setting((1.0, 1.0), low=0.01, high=100.0, meaning="of the masses, and with them the inertia")
    rated_torque: Pair = setting((1.0, 1.0), low=0.01, high=100.0, meaning="of the rated torque of each joint's drive")
    torque_counts: Pair = setting((1.0, 1.0), low=1e-3, high=1e3, meaning="of the torque sensors' counts")
    position_counts: Pair = setting((1.0, 1.0), low=1e-3, high=1e3, meaning="of the drives' counts of position")
    velocity_counts: Pair = setting((1.0, 1.0), low=1e-3, high=1e3, meaning="of the drives' counts of velocity")


SWAPS = ("nothing", "drives", "sensors", "joints")


@dataclass(frozen=True)
class WiringSettings:
    """Which devices are elsewhere than the host is told."""

    swapped: str = setting(
        "nothing", choices=SWAPS, meaning="what is exchanged between the joints; `joints`: drives and sensors"
    )
    reversed_joint: tuple[bool, bool] = setting(
        (False, False), meaning="joints whose drive and sensor both count the other way"
    )
    reversed_sensor: tuple[bool, bool] = setting((False, False), meaning="torque sensors that count the other way")


@dataclass(frozen=True)
class ArmTruth:
    """What the host isn't told, resolved; `sections`: those of a scenario, as they were read."""

    name: str = setting("", meaning="name of the truth")
    about: str = setting("", meaning="what the host is told wrongly, in one line")
    arm: TruthArmSettings = setting(TruthArmSettings, meaning="the arm")
    factor: FactorSettings = setting(FactorSettings, meaning="factors on what the host is told")
    wiring: WiringSettings = setting(WiringSettings, meaning="devices elsewhere than the host is told")


def truth_folder() -> Traversable:
    """Return the folder of the truths that come with the package."""
    return resources.files("firmware_sim") / "truths"


def truth_names() -> list[str]:
    """Name the truths that come with the package."""
    return toml_names(truth_folder())


def load_truth(name_or_file: str) -> tuple[ArmTruth, dict[str, Any]]:
    """Read a truth, a built-in name or a TOML file, and its sections of a scenario, unchecked. Raises ConfigError."""
    path = find_toml("truth", name_or_file, truth_folder())
    table = read_toml(path, "truth")
    table.setdefault("name", path.stem)
    sections = {key: table.pop(key) for key in SCENARIO_SECTIONS if key in table}
    try:
        return parse(ArmTruth, table), sections
    except ConfigError as error:
        raise ConfigError(f"truth {name_or_file}: {error}") from None
