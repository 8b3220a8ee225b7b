"""Entry point of the console script `firmware-sim`."""

from collections.abc import Callable
from typing import NoReturn

from adacd_hil.start import start_program

INTERRUPTED = 0
"""`firmware_sim.cli.emulator_main.EmulatorExit.OK`, which takes numpy to import: the emulator is ended by Ctrl-C."""


def start_emulator() -> NoReturn:
    """Import the command line, run it, and exit with a status of `EmulatorExit`."""

    def load() -> Callable[[], NoReturn]:
        from firmware_sim.cli.emulator_main import main

        return main

    start_program(load, INTERRUPTED)
