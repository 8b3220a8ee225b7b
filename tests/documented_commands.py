"""Checks of what documents show: command lines, TOML, settings, paths. Each check lists its complaints, a line each.

Command lines are parsed by the commands' own click definitions, in a folder where the files that the documents name
exist; values are resolved as the command would: settings, configurations, scenarios, contracts, interfaces.
"""

import ast
import dataclasses
import functools
import importlib
import importlib.metadata
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
from firmware_sim.scenario.faults import FaultSettings
from firmware_sim.scenario.scenario import Scenario, load_scenario

Complaints = list[str]

PROGRAMS = {"adacd-hil": host_cli, "firmware-sim": emulator_cli}
OTHERS = {
    *("apt-get", "candump", "canbusload", "canplayer", "cp", "dask", "duckdb", "echo", "grep", "groupadd", "ip"),
    *("openssl", "python3", "sleep", "ssh", "systemctl", "udevadm", "useradd", "usermod"),
}
"""Programs that aren't ours: known to be meant, their arguments are not looked at."""
PREFIXES = {"chrt": 3, "nice": 3}
"""Programs that run another one, with the words before it."""
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
        return _click_complaints(program, rest, is_whole)
    if program == "python" and rest:
        return command_complaints(rest, is_whole)
    if TOOL.fullmatch(program):
        return _tool_complaints(program, rest)
    if program == "sh" and rest[:1] == ["-c"]:
        return [line for inner in split_commands(rest[1]) for line in command_complaints(inner)]
    if program in PREFIXES:
        return command_complaints(words[PREFIXES[program] :])
    if program == "make":
        return [f"the Makefile has no target {target}" for target in rest if target not in make_targets()]
    if program == "pip":
        return _pip_complaints(rest)
    if program == "podman":
        return command_complaints(rest[rest.index("adacd-hil") :]) if "run" in rest else []
    if program.startswith("can_"):
        return [] if program in _scripts("python-can") else [f"python-can has no program {program}"]
    if program in OTHERS:
        return _key_complaints(re.findall(r"set\.([a-z]+\.\w+)", " ".join(rest)))
    return [f"program {program!r} is unknown to tests/documented_commands.py"]


def _click_complaints(program: str, words: list[str], is_whole: bool) -> Complaints:
    found = _find(program, words)
    if isinstance(found, str):
        return [found]
    command, rest = found
    if not rest and not is_whole:
        return []
    context = click.Context(command, info_name=program)
    if _is_usage(rest) or (not is_whole and rest[-1] in _valued_options(command)):
        return _usage_complaints(command, context, rest)
    try:
        parsed = _made(command, rest, is_whole)
    except click.UsageError as error:
        return [f"`{program} {' '.join(words)}`: {error.format_message()}"]
    lines = [line for param in command.params for line in _value_complaints(param, parsed.params)]
    return [f"`{program} {' '.join(words)}`: {line}" for line in lines]


def _find(program: str, words: list[str]) -> tuple[click.Command, list[str]] | str:
    """Walk down to the command; where words are left that name none, say so."""
    command: click.Command = PROGRAMS[program]
    rest = list(words)
    while isinstance(command, click.Group) and rest:
        names = rest[0].split("|")
        for name in names:
            if name not in command.commands:
                return f"`{program} {' '.join(words)}`: no command {name!r}; known: {', '.join(command.commands)}"
        command = command.commands[names[0]]
        rest = rest[1:]
    return command, rest


def _is_usage(words: list[str]) -> bool:
    """Whether words are the pattern of a command line rather than one."""
    return any(word.startswith("[") or "|" in word or PLACEHOLDER.fullmatch(word.strip("[]….")) for word in words)


def _valued_options(command: click.Command) -> set[str]:
    return {name for param in command.params if not getattr(param, "is_flag", False) for name in param.opts}


def _usage_complaints(command: click.Command, context: click.Context, words: list[str]) -> Complaints:
    options = {name: param for param in command.params for name in (*param.opts, *param.secondary_opts)}
    lines = []
    words = [word.strip("[]") for word in words]
    for word, value in zip(words, (*words[1:], ""), strict=True):
        if not word.startswith("-"):
            continue
        if word not in options:
            lines.append(f"`{command.name}` has no option {word}")
            continue
        param = options[word]
        if getattr(param, "is_flag", False) or not value or PLACEHOLDER.fullmatch(value.strip("….")):
            continue
        for choice in value.split("|"):
            is_placeholder = PLACEHOLDER.fullmatch(choice) and not isinstance(param.type, click.Choice)
            try:
                if not is_placeholder:
                    param.type.convert(choice, param, context)
            except click.UsageError as error:
                lines.append(f"`{command.name} {word}`: {error.format_message()}")
    return lines


SAMPLES = {
    "interface": "socketcan",
    "channel": "vcan0",
    "map_path": "map.toml",
    "out": "out",
    "recordings": "recording.csv",
    "scenario": "paper",
    "files": "my.toml",
}
"""Values for what a command requires and a document, naming only a part of the command, leaves out."""


def _made(command: click.Command, words: list[str], is_whole: bool) -> click.Context:
    """Parse. Raises click.UsageError."""
    while True:
        try:
            return command.make_context(command.name, list(words))
        except click.MissingParameter as error:
            if is_whole or error.param is None:
                raise
            sample = SAMPLES.get(error.param.name or "", "runs/run/run.mcap")
            is_argument = isinstance(error.param, click.Argument)
            words = [*words, sample] if is_argument else [*words, error.param.opts[0], sample]


def _value_complaints(param: click.Parameter, values: dict[str, Any]) -> Complaints:
    """Resolve a value as the command would."""
    value = values.get(param.name or "")
    if value is None or value == () or value == "":
        return []
    try:
        resolve = RESOLVED.get(param.name or "")
        if resolve is not None:
            resolve(value, values)
        elif _is_input(param):
            for path in value if isinstance(value, tuple) else (value,):
                _require(path)
    except (ConfigError, CodecError, OSError, LookupError) as error:
        return [str(error)]
    return []


def _is_input(param: click.Parameter) -> bool:
    return isinstance(param.type, click.Path) and not isinstance(param.type, WrittenPath)


def _require(path: Path) -> None:
    if not path.exists():
        raise FileNotFoundError(
            f"{path}: the fixture `folder` of tests/test_documented_commands.py has no such example"
        )


def _base(values: dict[str, Any]) -> Settings:
    return load_settings(values.get("config") or "certified", values.get("profile"))


def _resolve_changes(value: tuple[str, ...], values: dict[str, Any]) -> None:
    apply_settings(_base(values), parse_changes(value))


def _resolve_variations(value: tuple[str, ...], values: dict[str, Any]) -> None:
    for choice in parse_variations(value):
        apply_settings(_base(values), choice)


def _resolve_scenarios(value: str | tuple[str, ...], values: dict[str, Any]) -> None:
    for name in (value,) if isinstance(value, str) else value:
        load_scenario(name)


def _resolve_contract(value: str | Path, values: dict[str, Any]) -> None:
    load_codec(value if isinstance(value, Path) else find_contract(value))


def _resolve_interface(value: str, values: dict[str, Any]) -> None:
    if value not in can.VALID_INTERFACES:
        raise LookupError(f"python-can has no interface {value!r}")


def _resolve_address(value: str, values: dict[str, Any]) -> None:
    if not re.fullmatch(r"(tcp|tls|ws|wss)://[\w.-]+:\d+", value):
        raise LookupError(f"{value!r} is no address such as tcp://host:8786")


def _resolve_files(value: tuple[str, ...], values: dict[str, Any]) -> None:
    for name in value:
        _require(Path(name))


RESOLVED: dict[str, Callable[[Any, dict[str, Any]], object]] = {
    "changes": _resolve_changes,
    "vary": _resolve_variations,
    "config": lambda value, values: loaded_contract(load_settings(value, values.get("profile"))),
    "scenario": _resolve_scenarios,
    "scenarios": _resolve_scenarios,
    "dbc": _resolve_contract,
    "interface": _resolve_interface,
    "map_path": lambda value, values: None if values.get("is_init") else read_map(value),
    "url": _resolve_address,
    "scheduler": _resolve_address,
    "files": _resolve_files,
}
"""What becomes of a parameter's value, by the parameter's name; raises where the value is good for nothing."""


@functools.cache
def _click_commands() -> dict[str, click.Command]:
    """Return every command of both programs by its words, `adacd-hil log cut`."""

    def below(words: str, command: click.Command) -> Iterator[tuple[str, click.Command]]:
        yield words, command
        if isinstance(command, click.Group):
            for name, inner in command.commands.items():
                yield from below(f"{words} {name}", inner)

    return {words: command for program, group in PROGRAMS.items() for words, command in below(program, group)}


def _own_options(command: click.Command) -> set[str]:
    return {name for param in command.params for name in (*param.opts, *param.secondary_opts)}


def option_complaints(span: str, row_head: str = "") -> Complaints:
    """Check an option that stands alone: of the command that begins its table row, else of any command or tool."""
    option, _, value = span.partition(" ")
    names = row_head.replace("\\|", "|").strip("`").split(" ")
    if names[0] in PROGRAMS:
        found = _find(names[0], [word for word in names[1:] if not _is_usage([word]) or "|" in word])
        if isinstance(found, str):
            return [found]
        return _usage_complaints(found[0], click.Context(found[0]), [option, *value.split()])
    known = set().union(*(_own_options(command) for command in _click_commands().values()), *map(flags, tools()))
    return [] if option in known else [f"no command and no tool has an option {option}"]


@functools.cache
def environment_names() -> frozenset[str]:
    """Return the environment variables that stand for options."""
    names = set()
    for words, command in _click_commands().items():
        prefix = words.upper().replace("-", "_").replace(" ", "_")
        names |= {f"{prefix}_{(param.name or '').upper()}" for param in command.params}
    return frozenset(names)


def tools() -> list[Path]:
    """List the instruments."""
    found = (*(ROOT / "tools").iterdir(), *(ROOT / "tools" / "campaigns").iterdir())
    return [path for path in sorted(found) if path.suffix in (".py", "") and path.is_file()]


@functools.cache
def flags(tool: Path) -> frozenset[str]:
    """Return the options that a tool's argument parsers have, and its subcommands, from its source."""
    text = tool.read_text(encoding="utf-8")
    if "import argparse" not in text:
        return frozenset()
    nodes = list(ast.walk(ast.parse(text)))
    nodes += [inner for node in nodes if isinstance(node, ast.ImportFrom) for inner in _shared_options(node)]
    calls = [node for node in nodes if isinstance(node, ast.Call)]
    added = [call for call in calls if getattr(call.func, "attr", "") == "add_argument"]
    found = {argument.value for call in added for argument in call.args if isinstance(argument, ast.Constant)}
    if any(getattr(call.func, "attr", "") == "add_parser" for call in calls):  # whose names may come from a table
        found |= {node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    return frozenset(found)


def _shared_options(imported: ast.ImportFrom) -> Iterator[ast.AST]:
    """Give what is in the functions that a tool imports from another: some add options that several tools have."""
    names = {alias.name for alias in imported.names}
    for source in (tool for tool in tools() if tool.stem == imported.module):
        for node in ast.parse(source.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.FunctionDef) and node.name in names:
                yield from ast.walk(node)


def _tool_complaints(tool: str, words: list[str]) -> Complaints:
    path = ROOT / tool
    if not path.is_file():
        return [f"{tool} does not exist"]
    own, inner = words, []
    if "--" in words:
        own, inner = words[: words.index("--")], words[words.index("--") + 1 :]
    lines = [f"{tool} has no option {word}" for word in own if word.startswith("-") and word not in flags(path)]
    return lines + (command_complaints(inner) if inner else [])


@functools.cache
def make_targets() -> frozenset[str]:
    """Return the targets of the Makefile that have names."""
    text = (ROOT / "Makefile").read_text(encoding="utf-8")
    return frozenset(re.findall(r"^([a-z-]+):", text, re.MULTILINE))


@functools.cache
def _scripts(package: str) -> frozenset[str]:
    return frozenset(entry.name for entry in importlib.metadata.distribution(package).entry_points)


def _pip_complaints(words: list[str]) -> Complaints:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    named = [name for word in words for name in re.findall(r"(?:adacd-hil|\.)\[([\w,]+)\]", word)]
    return [f"there is no extra {name!r}" for names in named for name in names.split(",") if name not in extras]


# -- TOML ------------------------------------------------------------------------------------------------------------


def toml_complaints(text: str, path: Path) -> Complaints:
    """Check a TOML block, written to `path`: one of the kinds of files must take it whole, or all say why not."""
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        return [f"not TOML: {error}"]
    refusals = {}
    for kind, load in KINDS.items():
        try:
            load(path)
        except (ConfigError, CodecError, OSError) as error:
            refusals[kind] = str(error)
    if len(refusals) < len(KINDS):
        return []
    return [f"keys {', '.join(table)} are of no kind of file:", *(f"  {kind}: {why}" for kind, why in refusals.items())]


def _load_scenario(path: Path) -> None:
    problems = check_scenario(str(path), load_codec()).problems
    if problems:
        raise ConfigError("; ".join(problems))


def _load_profile(path: Path) -> None:
    load_profile(str(path), "drive")


KINDS: dict[str, Callable[[Path], object]] = {
    "configuration": lambda path: loaded_contract(load_settings(str(path))),
    "scenario": _load_scenario,
    "device profile": _load_profile,
    "map of a recording": read_map,
    "tare": read_tare,
}
"""Every kind of TOML file that somebody writes for us, with what reads it."""

SECTIONS = (Settings, Scenario, ProfileSettings, Tare)


def _all_sections() -> Iterator[type[Any]]:
    """Give every dataclass of settings."""
    waiting: list[Any] = list(SECTIONS)
    seen = set()
    while waiting:
        section = waiting.pop()
        if section in seen:
            continue
        seen.add(section)
        yield section
        for hint in typing.get_type_hints(section).values():
            options = (hint, *typing.get_args(hint))
            waiting += [option for option in options if dataclasses.is_dataclass(option)]


def assignment_complaints(span: str) -> Complaints:
    """Check inline TOML: a row of `[[faults]]`, or a key with a value that some section takes."""
    span = re.sub(r"^\[(\w+)\] ", r"\1.", span)
    try:
        table = tomllib.loads(span if "kind = " not in span else f"row = {{ {span} }}")
    except tomllib.TOMLDecodeError as error:
        return [f"`{span}` is not TOML: {error}"]
    if "row" in table:
        return _row_complaints(table["row"])
    ((key, value),) = table.items()
    if key in ("extends", "name"):  # of a configuration's file, not of the settings
        return []
    if isinstance(value, dict):
        ((inner, inner_value),) = value.items()
        return _key_complaints([f"{key}.{inner}"]) or _values_refused(inner, inner_value)
    return _values_refused(key, value)


def _row_complaints(row: dict[str, Any]) -> Complaints:
    """Check a fault. Its time, which most kinds need, stands in another column."""
    complaints = []
    for table in (row, {"at_s": 1.0, **row}):
        try:
            parse(FaultSettings, table)
        except ConfigError as error:
            complaints.append(f"{row}: {error}")
        else:
            return []
    return complaints


def _values_refused(key: str, value: Any) -> Complaints:
    complaints = []
    for section in _all_sections():
        if key not in {field.name for field in dataclasses.fields(section)}:
            continue
        try:
            parse(section, {key: value})
            return []
        except ConfigError as error:
            about = [line for line in error.problems if f"`{key}" in line]
        if not about:
            return []
        complaints += about
    return complaints or [f"no section of settings, scenarios or profiles has a key `{key}`"]


def _key_complaints(keys: list[str]) -> Complaints:
    return [line for key in keys for line in key_complaints(key)]


def key_complaints(key: str) -> Complaints:
    """Check a dotted key of the configuration."""
    section, _, name = key.partition(".")
    known = {field.name for field in dataclasses.fields(typing.get_type_hints(Settings)[section])}
    return [] if name in known else [f"the configuration has no key `{key}`"]


SETTING_SECTIONS = {name for name, hint in typing.get_type_hints(Settings).items() if dataclasses.is_dataclass(hint)}


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
    parts = dotted.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found: Any = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for name in parts[count:]:
            if not hasattr(found, name):
                return [f"{found.__name__} has no {name}"]
            found = getattr(found, name)
        return []
    return [f"there is no module {dotted}"]


def tree_complaints(text: str) -> Complaints:
    """Check a tree of the project: a folder per line, what is in it parted by `·`, words about it after `#`."""
    lines = []
    root = folder = ROOT
    for row in text.splitlines():
        names = row.partition("#")[0].split("·")
        first, _, more = names[0].strip().partition(" ")
        if first.endswith("/"):
            root = ROOT / first if not row.startswith(" ") else root
            folder = root if not row.startswith(" ") else root / first
            names = [more, *names[1:]]
        lines += [f"{folder.relative_to(ROOT)}/ does not exist"] if not folder.is_dir() else []
        for name in filter(None, (each.strip() for each in names)):
            if not (folder / name).exists() and not (folder / f"{name}.py").exists():
                lines.append(f"{(folder / name).relative_to(ROOT)} does not exist")
    return lines
