"""The options of the live view."""

import functools
from collections.abc import Callable
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import click

from adacd_hil.cli.exit_codes import CommandError, ExitCode
from adacd_hil.extras import install_command
from adacd_hil.log.recording.processes import MOST_VIEWERS

if TYPE_CHECKING:
    from adacd_hil.control.session import LiveAddress

PORT = 8765
"""What viewers suggest."""
HOST = "127.0.0.1"
_OPTIONS = (  # last first: click lists them the other way round
    click.option(
        "--live-viewers",
        type=click.IntRange(1, 1000),
        default=MOST_VIEWERS,
        show_default=True,
        help="Viewers at a time.",
    ),
    click.option(
        "--live-name", multiple=True, metavar="NAME", help="A further name of this machine, by which viewers find it."
    ),
    click.option(
        "--live-origin",
        multiple=True,
        metavar="ORIGIN",
        help="A web page that may watch beside Foxglove's and this machine's own, such as https://view.lab.example.",
    ),
    click.option(
        "--live-host", default=HOST, show_default=True, help="Address to listen on; 0.0.0.0: all, for anybody."
    ),
    click.option(
        "--live-port", type=click.IntRange(0, 65535), default=PORT, show_default=True, help="0: any that is free."
    ),
    click.option("--live", "is_live", is_flag=True, help="Serve the log to Foxglove, Lichtblick and `monitor --url`."),
)


def require_extra(asked_for: str, *modules: str) -> None:
    """Raise CommandError when a module of the extra `live` is missing."""
    missing = [module for module in modules if find_spec(module) is None]
    if missing:
        raise CommandError(f"{asked_for} needs the extra `live`: {install_command('live')}", ExitCode.USAGE)


def live_options(command: Callable[..., ExitCode]) -> Callable[..., ExitCode]:
    """Give a command the options of the live view; it takes them as `live`, a LiveAddress or None."""

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
        live = _address(live_host, live_port, live_origin, live_name, live_viewers) if is_live else None
        return command(*args, live=live, **own)

    decorated: Callable[..., ExitCode] = run
    for option in _OPTIONS:
        decorated = option(decorated)
    return decorated


def _address(
    host: str, port: int, origins: tuple[str, ...], names: tuple[str, ...], most_viewers: int
) -> "LiveAddress":
    require_extra("--live", "websockets")
    from adacd_hil.control.session import LiveAddress
    from adacd_hil.log.viewer.admission import normal_origin

    try:
        allowed = tuple(map(normal_origin, origins))
    except ValueError as error:
        raise CommandError(f"--live-origin: {error}", ExitCode.USAGE) from None
    return LiveAddress(host, port, allowed, names, most_viewers)
