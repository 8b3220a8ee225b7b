"""Entry point of the console script `adacd-hil`."""

from collections.abc import Callable
from typing import NoReturn

from adacd_hil.start import ExitCode, start_program


def start_host() -> NoReturn:
    """Import the program, run its command line and exit with a documented status."""

    def load() -> Callable[[], NoReturn]:
        from adacd_hil.cli.main import main

        return main

    start_program(load, ExitCode.INTERRUPTED, "adacd-hil: interrupted")
