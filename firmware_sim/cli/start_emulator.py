"""Entry point of the console script `firmware-sim`."""

from collections.abc import Callable
from typing import NoReturn

from adacd_hil.start import ExitCode, start_program


def start_emulator() -> NoReturn:
    """Import the command line, run it, and exit with a documented status; Ctrl-C is its usual end."""

    def load() -> Callable[[], NoReturn]:
        from firmware_sim.cli.emulator_main import main

        return main

    start_program(load, ExitCode.OK)
