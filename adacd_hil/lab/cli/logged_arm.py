"""An arm's configuration from the log of a run: its settings that differ from a built-in configuration."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from adacd_hil import __version__
from adacd_hil.cli.output import CommandError, ExitCode, quoted
from adacd_hil.clock import wall_ns
from adacd_hil.dates import format_date
from adacd_hil.device.contract import find_contract
from adacd_hil.file_access import exists
from adacd_hil.lab.cli.arm_drafting import DraftFiles
from adacd_hil.lab.commission.arm_draft import Entry, assumed_keys, draft_as_toml
from adacd_hil.log.log_parts import log_in
from adacd_hil.log.log_walk import read_head
from adacd_hil.log.logged_run import settings_of
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.setting_keys import known_keys, value_of

_NOT_TAKEN = {
    "name": "",
    "assumed": "",
    "arm.torque_offset_Nm": "torque offsets are left out, as sensors drift: `adacd-hil tare`",
    "arm.torque_offset_std_Nm": "",
    "operator.script": "the scripted user is left out: on an arm nothing is acknowledged without a person",
    "operator.acknowledge_after_s": "the scripted user is left out: on an arm nothing is acknowledged without a person",
    "operator.acknowledge_faults": "the scripted user is left out: on an arm nothing is acknowledged without a person",
    "operator.acknowledge_on_hardware": "",
    "realtime.sample_period": "",
    "safety.enable_timeout_s": "",
}
"""Keys that belong to the run and not to the arm, each with a warning; "" without one."""


def draft_from_log(log: Path, options: SimpleNamespace, files: DraftFiles) -> tuple[str, dict[str, Any]]:
    """Return the text of a configuration for the arm of a log, and a summary for JSON; write no file.

    options: as of `Drafting`. Adds the device profiles that are in the folder of `files.out` to `files`, and checks the
    configuration with them. Raises LogError if the log can't be read or lacks settings, CommandError for a
    configuration in place of a log, options other than --drive and --sensor, a missing profile, or a configuration with
    errors; ConfigError for a profile that can't be read.
    """
    given = [name for name, value in vars(options).items() if value not in (None, (), False)]
    if further := [name for name in given if name not in ("drive", "sensor")]:
        option = f"--{further[0].removeprefix('is_').replace('_', '-')}"
        raise CommandError(f"--from takes the arm from the log: leave out {option}", ExitCode.USAGE)
    if log.suffix == ".toml":
        raise CommandError(
            f"--from takes the log of a run, a run.mcap or its folder, and {log} is a configuration: use it as it is, "
            f"`--config {quoted(log)}`, or write another one that `extends` it",
            ExitCode.USAGE,
        )
    path = log_in(log)
    settings = settings_of(path, read_head(path).attachments)
    base = "certified" if settings.scheme == "certified" else "paper"
    warnings: list[str] = []
    entries = _differences(settings, base, path, warnings)
    named = {kind: names for kind in ("drive", "sensor") if (names := getattr(options, kind)) is not None}
    entries = [_placed(entry, files) for entry in entries if entry.key.removeprefix("devices.") not in named]
    for kind, names in named.items():
        entries.append(Entry(f"devices.{kind}", tuple(files.beside(name, kind) for name in names), "given"))
    title = f"Written by `adacd-hil init` {__version__} on {format_date(wall_ns())[:10]} from the log {path.name}."
    written = draft_as_toml(entries, title, quoted(files.out), base)
    warnings += files.examine(written).mistakes
    return written, {"from": str(path), "assumed": assumed_keys(entries), "warnings": warnings}


def _differences(settings: Settings, base: str, path: Path, warnings: list[str]) -> list[Entry]:
    """Return the settings of a run that differ from configuration `base` with the run's arm profile, and the guesses.

    `arm.profile` is one of them if it isn't that of `base` alone. A setting without a value is one only as a guess.
    Settings of the run and not of the arm, `_NOT_TAKEN`, are left out; lines on them are added to `warnings`. path: of
    the log, for comments.
    """
    based = load_settings(base, settings.arm.profile)
    entries = []
    if settings.arm.profile != load_settings(base).arm.profile:
        entries.append(Entry("arm.profile", settings.arm.profile, f"as in {path.name}"))
    for key, known in known_keys().items():
        value = None if known.is_in_row else value_of(settings, key)
        if known.is_in_row or value is None or (value == value_of(based, key) and key not in settings.assumed):
            continue
        if key in _NOT_TAKEN:
            if _NOT_TAKEN[key] and _NOT_TAKEN[key] not in warnings:
                warnings.append(_NOT_TAKEN[key])
            continue
        comment = f"{known.meaning}: as in {path.name}"
        entries.append(Entry(key, value, comment, key in settings.assumed))
    unset = (key for key in settings.assumed if key in known_keys() and value_of(settings, key) is None)
    return [*entries, *(Entry(key, None, "not known", True) for key in unset)]


def _placed(entry: Entry, files: DraftFiles) -> Entry:
    """Return an entry with device profiles as seen from the new configuration's folder; any other entry unchanged.

    But a contract that isn't there becomes "", composed from the profiles. Raises CommandError if a device profile
    isn't there, ConfigError if it can't be read.
    """
    kind = entry.key.removeprefix("devices.")
    if entry.key in ("devices.drive", "devices.sensor"):
        for name in entry.value:
            if Path(name).suffix and not exists(Path(name)):
                raise CommandError(
                    f"the log names the device profile {name}, which is not here: give --{kind} PROFILE PROFILE",
                    ExitCode.USAGE,
                )
        return entry._replace(value=tuple(files.beside(name, kind) for name in entry.value))
    if entry.key == "devices.contract" and entry.value:
        try:
            is_there = exists(find_contract(entry.value))
        except ConfigError:
            is_there = False
        return entry if is_there else entry._replace(value="", comment="composed from the profiles")
    return entry
