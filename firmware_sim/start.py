"""`firmware-sim` from the console: imports the commands, so that Ctrl-C ends it no less quietly than later."""

import sys
from typing import NoReturn

from adacd_hil.early_interrupt import ending_at_once

OK = 0
"""`firmware_sim.main.ExitCode.OK`: the emulator is ended by Ctrl-C."""


def main() -> NoReturn:
    """Enter here from the console script: import, run the command line and exit with a documented status."""
    try:
        with ending_at_once(OK):
            from firmware_sim.main import main as run
        run()
    except KeyboardInterrupt:  # before the command line takes care of it
        sys.exit(OK)
