"""What the tests' own process hands down to the programs that they start."""

import os
import signal

os.environ.pop("COLUMNS", None)  # pytest-xdist gives its workers 80; what no terminal shows has none
os.unsetenv("COLUMNS")  # readline, which pytest loads, sets it behind Python's back
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell's job in the background: Ctrl-C would reach nobody
    signal.signal(signal.SIGINT, signal.default_int_handler)
