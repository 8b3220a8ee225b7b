"""Checks of what documents show: command lines, TOML, settings, paths. Each check lists its complaints, a line each.

Command lines are parsed by the commands' own click definitions, in a folder where the files that the documents name
exist; values are resolved as the command would: settings, configurations, scenarios, contracts, interfaces.
"""

import copy
import dataclasses
import functools
import importlib.metadata
import itertools
import pkgutil
import re
import shlex
import tomllib
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import click
from documents import ROOT
from loaded import loaded_contract

from adacd_hil.cli.main import cli as host_cli
from adacd_hil.control.tare_file import Tare, read_tare
from adacd_hil.device.contract import find_contract
from adacd_hil.device.device_files import load_profile
from adacd_hil.device.profile import ProfileSettings
from adacd_hil.given_path import WrittenPath
from adacd_hil.lab.offline.recording_map import read_map
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.setting_keys import apply_settings, parse_changes, parse_variations
from adacd_hil.wire.codec import CodecError
from adacd_hil.wire.dbc_contract import load_codec
from firmware_sim.cli.emulator_main import cli as emulator_cli
from firmware_sim.cli.scenario_list import check as check_scenario
from firmware_sim.scenario.scenario import Scenario, load_scenario

Complaints = list[str]

PROGRAMS = {"adacd-hil": host_cli, "firmware-sim": emulator_cli}
OTHERS = {
    *("cp", "duckdb", "echo", "grep", "groupadd", "ip", "python3", "sleep", "systemctl", "udevadm", "useradd"),
    "usermod",
}
"""Programs that aren't ours: known to be meant, their arguments are not looked at but for keys of our settings."""
TOOL = re.compile(r"tools/(campaigns/)?[\w-]+(\.py|\.sh)?|tests/[\w/-]+\.py")
PLACEHOLDER = re.compile(r"[A-Z][A-Z0-9_]*(=[A-Z,.…]+)?|\.\.\.|…")
PACKAGES = ("", "adacd_hil", "firmware_sim", "dbc", "docs", "tests")
"""Folders that paths in documents count from."""


_OR = "\x1f"


# -- command lines ---------------------------------------------------------------------------------------------------


def split_commands(text: str) -> list[list[str]]:
    """Split shell text into the words of its simple commands; pipes, `&` and redirections part them."""
    text = re.sub(r"(?<!\S)#.*", "", text.replace("\\\n", " "))
    text = re.sub(r"(?<=\w)\|(?=\w)", _OR, text)  # NAME|FILE
    lexer = shlex.shlex(text, posix=True, punctuation_chars=";&|<>\n")
    lexer.whitespace = " \t"
    lexer.whitespace_split = True
    lexer.commenters = ""
    commands: list[list[str]] = [[]]
    is_redirected = False
    for word in lexer:
        if set(word) <= set(";&|\n"):
            commands.append([])
        elif set(word) <= set("<>"):
            is_redirected = True
        elif is_redirected:
            is_redirected = False
        else:
            commands[-1].append(word.replace(_OR, "|"))
    return [words for words in commands if words]


def command_complaints(words: list[str], is_whole: bool = True) -> Complaints:
    """Check one command line. `is_whole`: what the command requires must be there."""
    program, *rest = words
    program = program.removeprefix(".venv/bin/").removeprefix("/opt/adacd-hil/bin/")
    if program in PROGRAMS:
        return [f"`{' '.join(words)}`: {line}" for line in _click_complaints(program, rest, is_whole)]
    if program == "python" and rest:
        return command_complaints(rest, is_whole)
    if TOOL.fullmatch(program):
        return _tool_complaints(program, rest)
    if program == "sh" and rest[:1] == ["-c"]:
        return [line for inner in split_commands(rest[1]) for line in command_complaints(inner)]
    if program == "make":
        targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
        return [f"the Makefile has no target {target}" for target in rest if target not in targets]
    if program == "pip":
        return _pip_complaints(rest)
    if program == "podman":
        return command_complaints(rest[rest.index("adacd-hil") :]) if "run" in rest else []
    if program.startswith("can_"):
        scripts = importlib.metadata.distribution("python-can").entry_points.names
        return [] if program in scripts else [f"python-can has no program {program}"]
    if program in OTHERS:
        return [line for key in re.findall(r"set\.([a-z]+\.\w+)", " ".join(rest)) for line in key_complaints(key)]
    return [f"program {program!r} is unknown to tests/documented_commands.py"]


def _click_complaints(program: str, words: list[str], is_whole: bool) -> Complaints:
    try:
        command, rest = _find(program, words)
        if _is_pattern(rest) or (rest[-1:] and rest[-1].startswith("--") and not is_whole):
            return _pattern_complaints(command, rest)
        parsed = (command if is_whole else _lenient(command)).make_context(command.name, rest).params if rest else {}
    except click.UsageError as error:
        return [error.format_message()]
    return [line for param in command.params for line in _value_complaints(param, parsed)]


def _find(program: str, words: list[str]) -> tuple[click.Command, list[str]]:
    """Walk down to the command; return the words after it, too. Raises click.UsageError where a word names none."""
    command: click.Command = PROGRAMS[program]
    rest = list(words)
    while isinstance(command, click.Group) and rest:
        names = rest.pop(0).split("|")
        for name in names:
            if name not in command.commands:
                raise click.UsageError(f"no command {name!r}; known: {', '.join(command.commands)}")
        command = command.commands[names[0]]
    return command, rest


def _lenient(command: click.Command) -> click.Command:
    """Copy a command, so that nothing is required."""
    lenient = copy.deepcopy(command)
    for param in lenient.params:
        param.required = False
    return lenient


def _is_pattern(words: list[str]) -> bool:
    """Whether words are the pattern of a command line rather than one."""
    return any(word.startswith("[") or "|" in word or PLACEHOLDER.fullmatch(word.strip("[]….")) for word in words)


def _pattern_complaints(command: click.Command, words: list[str]) -> Complaints:
    """Check the options that a pattern names, and the values that it gives them."""
    options = {name: param for param in command.params for name in _names(param)}
    words = [word.strip("[]") for word in words]
    lines = [f"no option {word}" for word in words if word.startswith("-") and word not in options]
    for word, value in itertools.pairwise(words):
        param = options.get(word)
        if param is None or getattr(param, "is_flag", False) or PLACEHOLDER.fullmatch(value.strip("….")):
            continue
        for choice in value.split("|"):
            is_placeholder = PLACEHOLDER.fullmatch(choice) and not isinstance(param.type, click.Choice)
            try:
                if not is_placeholder:
                    param.type.convert(choice, param, None)
            except click.UsageError as error:
                lines.append(f"{word}: {error.format_message()}")
    return lines


def _names(param: click.Parameter) -> tuple[str, ...]:
    return (*param.opts, *param.secondary_opts)


def _value_complaints(param: click.Parameter, values: dict[str, Any]) -> Complaints:
    """Resolve a value as the command would."""
    value, resolve = values.get(param.name or ""), RESOLVED.get(param.name or "")
    if value in (None, (), ""):
        return []
    try:
        if resolve is not None and not resolve(value, values):
            return [f"{param.name} {value!r} is none"]
        if resolve is None and isinstance(param.type, click.Path) and not isinstance(param.type, WrittenPath):
            _find_files(value, values)
    except (ConfigError, CodecError, OSError) as error:
        return [str(error)]
    return []


def _find_files(value: Any, values: dict[str, Any]) -> object:
    """Raise OSError for a file that is not in the folder of tests/test_documented_commands.py."""
    return [Path(path).stat() for path in (value if isinstance(value, tuple) else (value,))]


def _base(values: dict[str, Any]) -> Settings:
    return load_settings(values.get("config") or "certified", values.get("profile"))


def _change_each(value: tuple[str, ...], values: dict[str, Any]) -> object:
    return [apply_settings(_base(values), choice) for choice in parse_variations(value)]


def _load_scenarios(value: str | tuple[str, ...], values: dict[str, Any]) -> object:
    return [load_scenario(name) for name in ((value,) if isinstance(value, str) else value)]


def _is_address(value: str, values: dict[str, Any]) -> object:
    return re.fullmatch(r"(tcp|tls|ws|wss)://[\w.-]+:\d+", value)


RESOLVED: dict[str, Callable[[Any, dict[str, Any]], object]] = {
    "changes": lambda value, values: apply_settings(_base(values), parse_changes(value)),
    "vary": _change_each,
    "config": lambda value, values: loaded_contract(load_settings(value, values.get("profile"))),
    "scenario": _load_scenarios,
    "scenarios": _load_scenarios,
    "dbc": lambda value, values: load_codec(value if isinstance(value, Path) else find_contract(value)),
    "interface": lambda value, values: value in can.VALID_INTERFACES,
    "map_path": lambda value, values: values.get("is_init") or read_map(value),
    "url": _is_address,
    "scheduler": _is_address,
    "files": _find_files,
}
"""What becomes of a parameter's value, by its name; raises or gives nothing where it is good for nothing."""


@functools.cache
def _click_commands() -> dict[str, click.Command]:
    """Return every command of both programs by its words, `adacd-hil log cut`."""

    def below(words: str, command: click.Command) -> Iterator[tuple[str, click.Command]]:
        yield words, command
        if isinstance(command, click.Group):
            for name, inner in command.commands.items():
                yield from below(f"{words} {name}", inner)

    return {words: command for program, group in PROGRAMS.items() for words, command in below(program, group)}


def option_complaints(span: str, row_head: str = "") -> Complaints:
    """Check an option that stands alone: of the command that begins its table row, else of any command or tool."""
    option, *value = span.split()
    program, *names = row_head.replace("\\|", "|").strip("`").split(" ")
    if program in PROGRAMS:
        return _pattern_complaints(_find(program, names)[0], [option, *value])
    known = {name for command in _click_commands().values() for param in command.params for name in _names(param)}
    return [] if option in known.union(*map(flags, tools())) else [f"no command and no tool has an option {option}"]


@functools.cache
def environment_names() -> frozenset[str]:
    """Return the environment variables that stand for options."""
    commands = _click_commands().items()
    names = (f"{words} {param.name}" for words, command in commands for param in command.params)
    return frozenset(re.sub(r"[- ]", "_", name).upper() for name in names)


def tools() -> list[Path]:
    """List the instruments."""
    found = (*(ROOT / "tools").iterdir(), *(ROOT / "tools" / "campaigns").iterdir())
    return [path for path in sorted(found) if path.suffix in (".py", "") and path.is_file()]


@functools.cache
def flags(tool: Path) -> frozenset[str]:
    """Return the words in quotes in a tool and the tools that it imports: options and subcommands are among them."""
    text = tool.read_text(encoding="utf-8")
    imported = re.findall(r"^(?:from|import) (\w+)", text, re.MULTILINE)
    texts = [text, *(other.read_text(encoding="utf-8") for other in tools() if other.stem in imported)]
    return frozenset(re.findall(r'"([\w-]+)"', "".join(texts)))


def _tool_complaints(tool: str, words: list[str]) -> Complaints:
    path = ROOT / tool
    if not path.is_file():
        return [f"{tool} does not exist"]
    own = list(itertools.takewhile(lambda word: word != "--", words))
    lines = [f"{tool} has no option {word}" for word in own if word.startswith("-") and word not in flags(path)]
    inner = words[len(own) + 1 :]
    return lines + (command_complaints(inner) if inner else [])


def _pip_complaints(words: list[str]) -> Complaints:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    named = [name for word in words for name in re.findall(r"(?:adacd-hil|\.)\[([\w,]+)\]", word)]
    return [f"there is no extra {name!r}" for names in named for name in names.split(",") if name not in extras]


# -- TOML ------------------------------------------------------------------------------------------------------------


def toml_complaints(text: str, path: Path) -> Complaints:
    """Check a TOML block, written to `path`: one of the kinds of files must take it whole, or all say why not."""
    refusals = []
    for kind, load in KINDS.items():
        try:
            load(path)
            return []
        except (ConfigError, CodecError, OSError) as error:
            refusals.append(f"no {kind}: {error}")
    return refusals


def _load_scenario(path: Path) -> None:
    if problems := check_scenario(str(path), load_codec()).problems:
        raise ConfigError("; ".join(problems))


KINDS: dict[str, Callable[[Path], object]] = {
    "configuration": lambda path: loaded_contract(load_settings(str(path))),
    "scenario": _load_scenario,
    "device profile": lambda path: load_profile(str(path), "drive"),
    "map of a recording": read_map,
    "tare": read_tare,
}
"""Every kind of TOML file that somebody writes for us, with what reads it."""


@functools.cache
def _all_sections() -> dict[type[Any], set[str]]:
    """Return every dataclass of settings, with its fields."""
    waiting: list[Any] = [Settings, Scenario, ProfileSettings, Tare]
    found = {}
    while waiting:
        section = waiting.pop()
        if dataclasses.is_dataclass(section) and section not in found:
            hints = typing.get_type_hints(section)
            found[section] = set(hints)
            waiting += [option for hint in hints.values() for option in (hint, *typing.get_args(hint))]
    return found


def assignment_complaints(span: str) -> Complaints:
    """Check inline TOML: a key of the configuration with its section, or one that some section takes, and its value."""
    try:
        table = tomllib.loads(re.sub(r"^\[(\w+)\] ", r"\1.", span))
    except tomllib.TOMLDecodeError as error:
        return [f"`{span}` is not TOML: {error}"]
    ((key, value),) = table.items()
    complaints = []
    for section in [Settings] if isinstance(value, dict) else [s for s, keys in _all_sections().items() if key in keys]:
        try:
            parse(section, table)
            return []
        except ConfigError as error:
            about = [line for line in error.problems if f"`{key}" in line]
            if not about:
                return []
            complaints += about
    return complaints or [f"no section of settings, scenarios or profiles has a key `{key}`"]


SETTING_SECTIONS = {name: hint for name, hint in typing.get_type_hints(Settings).items() if hint in _all_sections()}


def key_complaints(key: str) -> Complaints:
    """Check a dotted key of the configuration."""
    section, _, name = key.partition(".")
    known = _all_sections()[SETTING_SECTIONS[section]]
    return [] if name in known else [f"the configuration has no key `{key}`"]


# -- paths and names -------------------------------------------------------------------------------------------------


def path_complaints(text: str, page: Path) -> Complaints:
    """Check that a file or folder of the project exists, counted from the root, a package, or the page."""
    clean = text.rstrip("/")
    if any((ROOT / package / clean).exists() for package in PACKAGES) or (page.parent / clean).exists():
        return []
    places = () if "/" in clean else (ROOT / "adacd_hil", ROOT / "firmware_sim")
    return [] if any(True for place in places for _ in place.rglob(clean)) else [f"{text} does not exist"]


def name_complaints(dotted: str) -> Complaints:
    """Check that a dotted Python name of ours can be imported."""
    try:
        pkgutil.resolve_name(dotted)
    except (ImportError, AttributeError) as error:
        return [f"{dotted}: {error}"]
    return []
