"""`adacd-hil config`: effective settings and their origins, errors and likely mistakes, the meaning of a key."""

from typing import TYPE_CHECKING, Any

import click

from adacd_hil.cli.completion import complete_configuration, complete_setting
from adacd_hil.cli.options import json_option, profile_option, set_option
from adacd_hil.cli.output import (
    CommandError,
    ExitCode,
    answer,
    explain_statuses,
    explained,
    format_table,
    text_of,
)
from adacd_hil.given_path import CommandGroup
from adacd_hil.printable import number_of

if TYPE_CHECKING:
    from adacd_hil.settings.setting_keys import KnownKey

EPILOG = explain_statuses(OK="done, warnings included", USAGE="wrong usage, or a configuration that can't be used")


@click.group("config", cls=CommandGroup)
def config() -> None:
    """Show, check and explain configurations."""


@config.command("show", epilog=EPILOG)
@click.argument("keys", nargs=-1, metavar="[GROUP|KEY]...", shell_complete=complete_setting)
@click.option(
    "--config",
    "name",
    default="certified",
    show_default=True,
    metavar="NAME|FILE",
    help="Built-in name or TOML file.",
    shell_complete=complete_configuration,
)
@profile_option
@set_option
@click.option("--changed", "is_changed", is_flag=True, help="Only settings that differ from their default.")
@json_option
@explained
def show_settings(
    keys: tuple[str, ...], name: str, profile: str | None, changes: tuple[str, ...], is_changed: bool, as_json: bool
) -> ExitCode:
    """Show the effective settings and the origin of each: the default, a file or a profile in it, --profile or --set.

    GROUP or KEY: these only.
    """
    rows = effective(name, profile, changes, keys)
    if is_changed:
        rows = [row for row in rows if row["value"] != row["default"]]
    if rows or as_json:
        table = [(row["key"], row["value"], row["origin"]) for row in rows]
        answer(as_json, rows, format_table(("key", "value", "from"), table))
    return ExitCode.OK


def effective(name: str, profile: str | None, given: tuple[str, ...], keys: tuple[str, ...]) -> list[dict[str, str]]:
    """Return a row per setting, all as text by name: key, effective value, default, and origin of the value.

    Settings in the rows of a list have no row. given: changes as KEY=VALUE, which override the configuration. keys:
    keys or groups of the settings to return; (): all. Raises ConfigError for an invalid configuration or change,
    CommandError for an unknown key or group.
    """
    from adacd_hil.control.configuration_check import origins_of
    from adacd_hil.settings.configuration import Settings
    from adacd_hil.settings.configuration_files import configuration_layers, resolved_table
    from adacd_hil.settings.parsing import parse
    from adacd_hil.settings.setting_keys import apply_settings, in_words, parse_changes, value_of

    layers = configuration_layers(name, profile)
    changes = parse_changes(given)
    settings = parse(Settings, resolved_table(layers))
    settings = apply_settings(settings, changes) if changes else settings
    origins = origins_of(layers) | dict.fromkeys(changes, "--set")
    return [
        {
            "key": known.key,
            "value": in_words(value_of(settings, known.key)),
            "default": known.default,
            "origin": origins.get(known.key, "default"),
        }
        for known in _chosen(keys)
        if not known.is_in_row
    ]


@config.command(epilog=EPILOG)
@click.argument("names", nargs=-1, required=True, metavar="NAME|FILE...", shell_complete=complete_configuration)
@profile_option
@json_option
@explained
def check(names: tuple[str, ...], profile: str | None, as_json: bool) -> ExitCode:
    """List errors and likely mistakes of configurations, a line each."""
    from adacd_hil.control.configuration_check import examine_configuration

    findings = {name: examine_configuration(name, profile) for name in names}
    described = {name: {"errors": found.errors, "warnings": found.warnings} for name, found in findings.items()}
    lines = []
    for name, found in findings.items():
        lines += [f"{name}: error: {line}" for line in found.errors]
        lines += [f"{name}: warning: {line}" for line in found.warnings]
        lines.append(f"{name}: {number_of(len(found.errors), 'error')}, {number_of(len(found.warnings), 'warning')}")
    answer(as_json, described, text_of(lines))
    return ExitCode.USAGE if any(found.errors for found in findings.values()) else ExitCode.OK


@config.command(epilog=EPILOG)
@click.argument("keys", nargs=-1, metavar="[GROUP|KEY]...", shell_complete=complete_setting)
@json_option
@explained
def docs(keys: tuple[str, ...], as_json: bool) -> ExitCode:
    """Explain settings: meaning, unit, bounds, default. Without GROUP or KEY: list the groups."""
    if not keys:
        _list_groups(as_json)
        return ExitCode.OK
    rows = _chosen(keys)
    head = ("key", "default", "bounds", "meaning")
    table = [(row.key, row.default, row.bounds, row.meaning) for row in rows]
    text = format_table(head, table)
    if len(rows) == 1:
        (row,) = rows
        bounds = f"\n  bounds: {row.bounds}" if row.bounds else ""
        text = f"{row.key}\n  {row.meaning}\n  default: {row.default}{bounds}"
    answer(as_json, [dict(zip(head, cells, strict=True)) for cells in table], text)
    return ExitCode.OK


def _list_groups(as_json: bool) -> None:
    """Print the groups of settings: name, number of keys, meaning; `as_json`: as JSON, else as a table."""
    from adacd_hil.settings.setting_keys import keys_of, sections

    groups: list[dict[str, Any]] = [
        {"group": name or "(top)", "keys": sum(1 for _ in keys_of(section, "")), "meaning": meaning}
        for name, section, meaning in sections()
    ]
    rows = [tuple(map(str, group.values())) for group in groups]
    answer(as_json, groups, format_table(("group", "keys", "meaning"), rows, right=(1,)))


def _chosen(keys: tuple[str, ...]) -> "list[KnownKey]":
    """Return the settings that are named by their key or their group, each once; without names, all.

    Raises CommandError for an unknown name.
    """
    from adacd_hil.remedies import nearest_name
    from adacd_hil.settings.setting_keys import explain_unknown, known_keys, sections

    known = known_keys()
    if not keys:
        return list(known.values())
    groups = {name for name, *_ in sections() if name}
    chosen: list[KnownKey] = []
    for key in keys:
        if key in groups:
            chosen += [row for name, row in known.items() if name.startswith(f"{key}.")]
        elif key in known:
            chosen.append(known[key])
        elif group := nearest_name(key, groups):
            raise CommandError(f"unknown group `{key}`; did you mean `{group}`?", ExitCode.USAGE)
        else:
            raise CommandError(explain_unknown(key), ExitCode.USAGE)
    return list(dict.fromkeys(chosen))
