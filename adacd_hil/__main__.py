"""`python -m adacd_hil`: the console script `adacd-hil`."""

from adacd_hil.cli.start_host import start_host

start_host()
