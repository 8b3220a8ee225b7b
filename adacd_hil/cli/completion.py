"""Completion in the shell: configurations, scenarios, keys and values of settings, interfaces, run folders.

Modules are imported at their first use: a shell waits for each answer.
"""

import os
from collections.abc import Callable, Iterable
from pathlib import Path

from click import Context, Parameter
from click.shell_completion import BashComplete, CompletionItem, ZshComplete, add_completion_class

_ASKED = "_ADACD_HIL_COMPLETE"
"""The environment variable by which a shell asks click for completions."""
_FILE = "file"
_MOST_RUNS = 30


def _complete_toml(package: str, folder: str) -> Callable[[Context, Parameter, str], list[CompletionItem]]:
    """Return a completion function for the TOML files in a package's folder by name, and for others by path."""

    def complete(_ctx: Context, _param: Parameter, incomplete: str) -> list[CompletionItem]:
        from importlib import resources

        from adacd_hil.settings.toml_files import toml_names

        names = toml_names(resources.files(package) / folder)
        return [*_starting(names, incomplete), *_toml_files(incomplete)]

    return complete


complete_configuration = _complete_toml("adacd_hil", "configs")
complete_scenario = _complete_toml("firmware_sim", "scenarios")
complete_truth = _complete_toml("firmware_sim", "truths")


def complete_setting(_ctx: Context, param: Parameter, incomplete: str) -> list[CompletionItem]:
    """Return the groups that begin with `incomplete`, and the keys that do if it has a dot or no group does so.

    For an option KEY=VALUE return `KEY=` of each such key, or behind the `=` the setting's choices.
    """
    from adacd_hil.settings.setting_keys import known_keys, sections

    known = {key: row for key, row in known_keys().items() if not row.is_in_row}
    if param.param_type_name == "argument":
        groups = [CompletionItem(name, help=meaning) for name, _, meaning in sections() if name.startswith(incomplete)]
        keys = [CompletionItem(key, help=row.meaning) for key, row in known.items() if key.startswith(incomplete)]
        return [item for item in groups if item.value] + (keys if "." in incomplete or not groups else [])
    key, equals, value = incomplete.partition("=")
    if equals:
        choices = known[key].choices if key in known else ()
        before, comma, last = value.rpartition(",")
        return [CompletionItem(f"{key}={before}{comma}{choice}") for choice in choices if choice.startswith(last)]
    return [CompletionItem(f"{name}=", help=row.meaning) for name, row in known.items() if name.startswith(incomplete)]


def complete_interface(_ctx: Context, _param: Parameter, incomplete: str) -> list[CompletionItem]:
    """Return the names of python-can's interfaces that begin with `incomplete`, SocketCAN first."""
    from adacd_hil.wire.python_can import interface_names

    return _starting(("socketcan", *(name for name in interface_names() if name != "socketcan")), incomplete)


def complete_channel(ctx: Context, _param: Parameter, incomplete: str) -> list[CompletionItem]:
    """Return this machine's CAN interfaces that begin with `incomplete`.

    [] if --interface is given and isn't `socketcan`.
    """
    if ctx.params.get("interface") not in (None, "socketcan"):
        return []
    from adacd_hil.wire.can_interface import can_interfaces

    return _starting(can_interfaces(), incomplete)


def complete_run(_ctx: Context, _param: Parameter, incomplete: str) -> list[CompletionItem]:
    """Return the last 30 folders in `runs` with a log, as far as they begin with `incomplete`; the shell adds files.

    The links come first, then the newest dates.
    """
    from adacd_hil.cli.output import RUNS
    from adacd_hil.log.log_files import LOG_NAME

    try:
        found = sorted((path for path in RUNS.iterdir() if (path / LOG_NAME).is_file()), reverse=True)
    except OSError:
        found = []
    # Bash forgets the words before a file, and completes files if no word fits.
    return [CompletionItem(incomplete, type=_FILE), *_starting(map(str, found[:_MOST_RUNS]), incomplete)]


def _starting(names: Iterable[str], incomplete: str) -> list[CompletionItem]:
    return [CompletionItem(name) for name in names if name.startswith(incomplete)]


def _toml_files(incomplete: str) -> list[CompletionItem]:
    """Return the TOML files and folders whose paths begin with `incomplete`; hidden ones only if that isn't empty.

    Folders end with a slash. [] for a folder that can't be listed.
    """
    folder, slash, _ = incomplete.rpartition("/")
    found = []
    try:
        for path in sorted(Path(folder or ("/" if slash else ".")).iterdir()):
            name = f"{folder}{slash}{path.name}"
            if not name.startswith(incomplete) or (path.name.startswith(".") and not incomplete):
                continue
            if path.is_dir():
                found.append(CompletionItem(f"{name}/"))
            elif path.suffix == ".toml":
                found.append(CompletionItem(name))
    except OSError:
        pass
    return found


_CHANGES = ("--set", "--vary")
"""Options whose value is KEY=VALUE."""


class BashWithEquals(BashComplete):
    """Bash's completion for `KEY=VALUE`, which bash splits into three words; only the last of them is replaced."""

    source_template = BashComplete.source_template.replace(
        "    return 0",
        "    [[ ${#COMPREPLY[@]} -eq 1 && ${COMPREPLY[0]} == *[=/] ]] && compopt -o nospace\n\n    return 0",
    )
    _kept = ""
    """The part of the word before `=` that bash keeps."""

    def get_completion_args(self) -> tuple[list[str], str]:
        """Return the words before the cursor, and the word under it; behind --set and --vary join KEY, `=` and VALUE.

        Bash has split these three. The `KEY=` of a joined word under the cursor is kept for `format_completion`.
        """
        args, incomplete = super().get_completion_args()
        words: list[str] = []
        for word in [*args, incomplete]:
            is_part = len(words) > 1 and words[-2] in _CHANGES and (word == "=" or words[-1].endswith("="))
            if is_part:
                words[-1] += word
                self._kept = words[-1].partition("=")[0] + "="
            else:
                self._kept = ""
                words.append(word)
        return words[:-1], words[-1]

    def format_completion(self, item: CompletionItem) -> str:
        """Return a completion as bash needs it: without the `KEY=` that bash keeps."""
        return super().format_completion(CompletionItem(item.value.removeprefix(self._kept), item.type))


class ZshWithEquals(ZshComplete):
    """Zsh's completion, without a space behind `KEY=` and `folder/`."""

    source_template = ZshComplete.source_template.replace(
        '    if [ -n "$completions" ]',
        "    local -a stay\n"
        "    stay=(${(M)completions:#*/})\n"
        "    completions=(${completions:#*/})\n"
        "    (( $#stay )) && compadd -U -S '' -V unsorted -a stay\n"
        '    if [ -n "$completions" ]',
    ).replace("completions_with_descriptions -U", "completions_with_descriptions -U -S '' -r ' '")


def is_completing() -> bool:
    """Return whether a shell started this process to complete a command line."""
    return _ASKED in os.environ


def prepare_completion() -> None:
    """Register BashWithEquals and ZshWithEquals with click."""
    add_completion_class(BashWithEquals)
    add_completion_class(ZshWithEquals)
