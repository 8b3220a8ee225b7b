"""Options that the commands share."""

import errno
import functools
import math
import shlex
import socket
from collections.abc import Callable
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click
from click.core import ParameterSource

from adacd_hil.cli.completion import (
    complete_channel,
    complete_configuration,
    complete_interface,
    complete_run,
    complete_setting,
)
from adacd_hil.cli.output import PROGRAM, CommandError, ExitCode, explained
from adacd_hil.clock import CLOCKS
from adacd_hil.extras import install_command
from adacd_hil.given_path import GIVEN_FILE, WRITTEN_FOLDER, GivenName, GivenPath
from adacd_hil.log.log_files import MOST_VIEWERS
from adacd_hil.settings.stated import ARM_PROFILES, BITRATES
from adacd_hil.settings.toml_files import builtin_names

if TYPE_CHECKING:
    from adacd_hil.control.session import LiveView


class FiniteRange(click.FloatRange):
    """A number within bounds; click's own range lets NaN through, and infinity where a bound is missing."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number. Raises click.BadParameter for no number, one that isn't finite, or is out of bounds."""
        number: float = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{number:g} is not finite", param, ctx)
        return number


config_option = click.option(
    "--config",
    default="certified",
    show_default=True,
    metavar="NAME|FILE",
    help=f"One of {builtin_names()}, or a TOML file.",
    shell_complete=complete_configuration,
)
profile_option = click.option(
    "--profile", type=click.Choice(ARM_PROFILES), help="Arm profile; default: the configuration's."
)
log_argument = click.argument("log", type=GIVEN_FILE, shell_complete=complete_run)
logs_argument = click.argument("logs", nargs=-1, required=True, type=GivenPath(), shell_complete=complete_run)
interface_option = functools.partial(
    click.option,
    "-i",
    "--interface",
    help="python-can interface, such as socketcan.",
    shell_complete=complete_interface,
)
channel_option = functools.partial(
    click.option,
    "-c",
    "--channel",
    type=GivenName(),
    help="Channel of that interface, such as can0.",
    shell_complete=complete_channel,
)
bitrate_option = click.option(
    "-b", "--bitrate", type=click.IntRange(min=BITRATES[0]), help="bit/s, where python-can sets it."
)
set_option = click.option(
    "--set",
    "changes",
    multiple=True,
    metavar="KEY=VALUE",
    help="Change a setting, such as filter.a_rad_s=50.",
    shell_complete=complete_setting,
)


def run_folder_option(name: str) -> Callable[..., Any]:
    """Return a decorator that adds `--out`, the folder of a run, to a command; name: of the command.

    Without `--out` a run gets a new folder by date, with links to it from `runs/latest` and `runs/NAME`.
    """
    return click.option(
        "--out",
        type=WRITTEN_FOLDER,
        help=f"Folder, without a log so far; default: a new one by date, to which runs/latest and runs/{name} lead.",
    )


json_option = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON on stdout.")
clock_option = functools.partial(
    click.option, "--clock", type=click.Choice(CLOCKS), show_default=True, help="Clock of the cycles."
)


def with_options(command: Callable[..., Any], *options: Callable[..., Any]) -> Callable[..., Any]:
    """Return a command with options, which its help lists in this order."""
    for option in reversed(options):
        command = option(command)
    return command


def stretch_options(command: Callable[..., ExitCode]) -> Callable[..., ExitCode]:
    """Return a command with --from and --until, which receives both as `stretch`, a `TimeWindow`.

    It raises CommandError if they are not times, or not in this order.
    """

    @functools.wraps(command)
    def bounded(*args: Any, from_s: float | None, until_s: float | None, **kwargs: Any) -> ExitCode:
        from adacd_hil.log.time_window import TimeWindow

        for name, bound_s in (("--from", from_s), ("--until", until_s)):
            if bound_s is not None and not math.isfinite(bound_s):
                raise CommandError(f"{name} {bound_s:g} is not a time", ExitCode.USAGE)
        if from_s is not None and until_s is not None and from_s >= until_s:
            raise CommandError(f"--from {from_s:g} s is not before --until {until_s:g} s", ExitCode.USAGE)
        stretch = TimeWindow(-math.inf if from_s is None else from_s, math.inf if until_s is None else until_s)
        return command(*args, stretch=stretch, **kwargs)

    return with_options(
        bounded,
        click.option("--from", "from_s", type=float, help="Begin here, s since the beginning of the log."),
        click.option("--until", "until_s", type=float, help="End before here, s since the beginning of the log."),
    )


def on_bus(command: Callable[..., ExitCode], is_required: bool = True) -> Callable[..., None]:
    """Return a command with the options of a bus; it receives a `Connection` as its first argument.

    It ends the process with its exit status, as `explained`. is_required: click refuses a call without --interface or
    --channel; otherwise it ends with a CommandError, unless there is a --url: the command then receives that first. A
    --url together with one of the options of a bus is a CommandError, too.
    """

    @functools.wraps(command)
    def connect(
        interface: str | None,
        channel: str | None,
        bitrate: int | None,
        config: str,
        profile: str | None,
        dbc: Path | None,
        url: str | None = None,
        **own: Any,
    ) -> ExitCode:
        from adacd_hil.cli.connection import Connection

        if url is not None:
            source = click.get_current_context().get_parameter_source
            for name in ("interface", "channel", "bitrate", "config", "profile", "dbc"):
                if source(name) is not click.core.ParameterSource.DEFAULT:
                    raise CommandError(f"--url watches a run, --{name} is of a bus: choose one", ExitCode.USAGE)
            return command(url, **own)
        if interface is None or channel is None:
            raise CommandError("give --interface and --channel, or --url", ExitCode.USAGE)
        return command(Connection(interface, channel, bitrate, config, profile, dbc), **own)

    return with_options(
        explained(connect),
        interface_option(required=is_required),
        channel_option(required=is_required),
        bitrate_option,
        config_option,
        profile_option,
        click.option("--dbc", type=GIVEN_FILE, help="The contract; default: the configuration's."),
    )


on_bus_or_url = functools.partial(on_bus, is_required=False)
"""Decorates a command that has an option --url, too."""


LIVE_ENTRY_POINTS: Final = "adacd_hil.live"
"""Entry-point group of the function that makes a `LiveView` of host, port, origins, names and most viewers."""
PORT = 8765
"""Default port of Foxglove and Lichtblick."""
HOST = "127.0.0.1"
_LIVE_OPTIONS = (
    click.option("--live", "is_live", is_flag=True, help="Serve the log to Foxglove, Lichtblick and `monitor --url`."),
    click.option(
        "--live-port", type=click.IntRange(0, 65535), default=PORT, show_default=True, help="0: any that is free."
    ),
    click.option(
        "--live-host", default=HOST, show_default=True, help="Address to listen on; 0.0.0.0: all, for any viewer."
    ),
    click.option(
        "--live-origin",
        multiple=True,
        metavar="ORIGIN",
        help="A web page that may watch, in addition to Foxglove's and this machine's, such as https://view.lab.example.",
    ),
    click.option(
        "--live-name", multiple=True, metavar="NAME", help="A further name of this machine, by which viewers find it."
    ),
    click.option(
        "--live-viewers",
        type=click.IntRange(1, 1000),
        default=MOST_VIEWERS,
        show_default=True,
        help="Viewers at a time.",
    ),
)


def typed_again(*added: str) -> str:
    """Return the command that runs, with the arguments and options that were typed, and further words."""
    context = click.get_current_context()
    words = [PROGRAM, context.info_name or ""]
    for parameter in context.command.params:
        name = parameter.name or ""
        if context.get_parameter_source(name) is ParameterSource.COMMANDLINE:
            value = context.params[name]
            for each in value if isinstance(value, tuple) else (value,):
                words += parameter.opts[-1:] if isinstance(parameter, click.Option) else []
                words += [] if each is True else [str(each)]
    return shlex.join([*words, *added])


def require_live(asked_for: str) -> None:
    """Raise CommandError if the extra `live` is not installed, with the command that installs it.

    asked_for: the option that needs it.
    """
    if find_spec("websockets") is None:
        raise CommandError(f"{asked_for} needs the extra `live`: {install_command('live')}", ExitCode.USAGE)


def live_options(command: Callable[..., ExitCode]) -> Callable[..., ExitCode]:
    """Return a command with the options of the live view; it receives `live`: a LiveView, or None without --live.

    The LiveView serves the log of a run to viewers such as Foxglove.
    """

    @functools.wraps(command)
    def run(
        *args: Any,
        is_live: bool,
        live_port: int,
        live_host: str,
        live_origin: tuple[str, ...],
        live_name: tuple[str, ...],
        live_viewers: int,
        **own: Any,
    ) -> ExitCode:
        live = _live_view(live_host, live_port, live_origin, live_name, live_viewers) if is_live else None
        return command(*args, live=live, **own)

    return with_options(run, *_LIVE_OPTIONS)


def _live_view(host: str, port: int, origins: tuple[str, ...], names: tuple[str, ...], most_viewers: int) -> "LiveView":
    """Return the live view that an installed package makes, to listen on host and port.

    origins, names, most_viewers: as of --live-origin, --live-name and --live-viewers. Raises CommandError if the extra
    `live` is missing, no or more than one package serves a view, an origin is wrong, or the port can't be listened on.
    """
    require_live("--live")
    try:
        (view,) = entry_points(group=LIVE_ENTRY_POINTS)
    except ValueError:
        raise CommandError("--live: no package that serves a live view is installed", ExitCode.USAGE) from None
    try:
        live: LiveView = view.load()(host, port, origins, names, most_viewers)
    except ValueError as error:
        raise CommandError(f"--live-origin: {error}", ExitCode.USAGE) from None
    _check_port(host, port)
    return live


def _check_port(host: str, port: int) -> None:
    """Raise CommandError if the port can't be listened on, such as one in use, or the host has no address.

    The port 0, of any that is free, is not tried. Call it before time is spent on compiling.
    """
    try:
        places = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        for family, kind, protocol, _, address in places if port else ():
            with socket.socket(family, kind, protocol) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(address)
    except OSError as error:
        remedy = "; --live-port 0 takes one that is free" if error.errno == errno.EADDRINUSE else ""
        raise CommandError(f"can't listen on {host}:{port}: {error.strerror}{remedy}", ExitCode.FAILURE) from None
    except UnicodeError:
        raise CommandError(f"can't listen on {host}:{port}: that is no name of a machine", ExitCode.FAILURE) from None
