"""`adacd-hil` from the console: imports the commands, so that Ctrl-C ends it no less quietly than later."""

import sys
from typing import NoReturn

from adacd_hil.early_interrupt import ending_at_once

INTERRUPTED = 130
"""`adacd_hil.cli.exit_codes.ExitCode.INTERRUPTED`, which takes numpy to import."""


def main() -> NoReturn:
    """Enter here from the console script: import, run the command line and exit with a documented status."""
    try:
        with ending_at_once(INTERRUPTED, "adacd-hil: interrupted"):
            from adacd_hil.cli.main import main as run
        run()
    except KeyboardInterrupt:  # before the command line takes care of it
        sys.exit(INTERRUPTED)
