"""How long a test waits for what comes for certain: so long only where it never comes.

A machine that has several times as much to do as it has processors takes minutes for what takes seconds on an idle one,
compiling above all. So this is no limit on how long something takes; what is one measures the machine beside it. The
time limit of pytest, in pyproject.toml, is longer: it ends what waits without a limit of its own.
"""

HANG_S = 1200
