"""`adacd-hil`: the commands. Each one parses its options, calls one function, and prints the result."""

import sys
from collections.abc import Iterator, Sequence
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, Final, NoReturn

import click

from adacd_hil import __version__
from adacd_hil.cli.commands.config_command import config
from adacd_hil.cli.commands.replay_command import replay
from adacd_hil.cli.completion import complete_scenario, is_completing, prepare_completion
from adacd_hil.cli.options import (
    clock_option,
    json_option,
    live_options,
    on_bus,
    run_folder_option,
)
from adacd_hil.cli.output import EPILOG, CommandError, ExitCode, answer, complain
from adacd_hil.clock import REALTIME
from adacd_hil.extras import pip_command
from adacd_hil.given_path import GIVEN_FILE, WRITTEN_FILE, CommandGroup
from adacd_hil.printable import one_line
from adacd_hil.terminal import is_interrupted, open_terminals

if TYPE_CHECKING:
    from adacd_hil.cli.connection import Connection


@click.group(
    cls=CommandGroup,
    epilog=EPILOG,
    context_settings={"auto_envvar_prefix": "ADACD_HIL", "help_option_names": ["-h", "--help"]},
)
@click.version_option(__version__)
def cli() -> None:
    """Identify an arm online from its joint torques over CAN, then detect collisions."""


@cli.command(epilog=EPILOG)
@on_bus
@click.option("--tare", type=GIVEN_FILE, help="Offsets that `adacd-hil tare` wrote.")
@click.option(
    "--without-anchor",
    is_flag=True,
    help="Start without a bound on the torque offsets; a push before the first motion is then learnt as offset.",
)
@click.option(
    "--history",
    type=WRITTEN_FILE,
    help="File of the arm's certificates: the last one is compared, this run's are added.",
)
@click.option(
    "--scenario",
    metavar="NAME|FILE",
    help="Rehearse with this scenario's user, as in `demo`. On a virtual interface only.",
    shell_complete=complete_scenario,
)
@run_folder_option("run")
@clock_option(default=REALTIME)
@json_option
@live_options
def run(connection: "Connection", as_json: bool, **options: Any) -> ExitCode:
    """Run the scheme on an arm, real or emulated, that is on a bus.

    On a terminal, type `ack` to acknowledge a stop, `payload` before and `changed` after changing the payload, `accept`
    to confirm that the arm is free when its certificate is withheld, `relearn` to take back a certificate in a stop,
    and `finish` to end. Ctrl-C parks the arm and ends; a second Ctrl-C
    stops at once.
    """
    from adacd_hil.cli.commands.run_command import as_text, next_of_run, run_on_bus

    result, code = run_on_bus(connection, **options)
    answer(as_json, result, as_text(result), *next_of_run(result))
    return code


COMMAND_ENTRY_POINTS: Final = "adacd_hil.commands"
"""Entry-point group of further commands: each entry is a sequence of click commands."""


def further_commands() -> Iterator[click.Command]:
    """Yield the commands that other packages add by entry points; warn of one that can't be imported, and go on."""
    for entry in entry_points(group=COMMAND_ENTRY_POINTS):
        try:
            yield from entry.load()
        except (ImportError, AttributeError) as error:
            if is_interrupted(error):
                raise
            line = f"adacd-hil: the commands of {entry.value} can't be imported: {error}"
            print(one_line(line), file=sys.stderr)


for command in (config, replay, *further_commands()):
    cli.add_command(command)


def _misused(error: click.ClickException) -> str:
    """Return one line on a wrong command line, with the command that shows its help, if there is one."""
    text = " ".join(error.format_message().split())
    context = error.ctx if isinstance(error, click.UsageError) else None
    return text if context is None else f"{text} see `{context.command_path} --help`"


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the command line (default: this process's) and exit with a documented status.

    Without `arguments`, first replace the standard streams by terminals of ours, unless a shell asks for completions.
    Errors of click and of missing packages are printed on standard error in one line.
    """
    if is_completing():  # click writes completions in raw form
        prepare_completion()
    elif arguments is None:
        open_terminals()
    try:
        code = cli.main(arguments, prog_name="adacd-hil", standalone_mode=False)
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        code = error.exit_code
    except click.ClickException as error:
        print(f"adacd-hil: {one_line(_misused(error))}", file=sys.stderr)
        code = error.exit_code
    except (click.Abort, KeyboardInterrupt):
        code = ExitCode.INTERRUPTED
    except OSError as error:  # help that can't be written
        code = complain(error)
    except ImportError as error:
        code = complain(KeyboardInterrupt() if is_interrupted(error) else _missing(error))
    sys.exit(code)


def _missing(error: ImportError) -> Exception:
    """Return a CommandError with a missing third-party package and the command to install it; else `error` itself.

    `run`, `replay` and `config` need fewer packages than the commands of the lab.
    """
    package = (error.name or "").partition(".")[0]
    if not isinstance(error, ModuleNotFoundError) or package in ("", "adacd_hil", "firmware_sim"):
        return error
    line = f"package {package} is not installed, which this command needs: {pip_command()} install {package}"
    return CommandError(line, ExitCode.USAGE)


if __name__ == "__main__":
    main()
