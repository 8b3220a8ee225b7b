"""Compilation of the functions of a cycle, on two processors: a second process compiles the longest ones.

Both keep their results in the same cache, and neither compiles a function that the other is compiling.
"""

import contextlib
import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

from adacd_hil.compiled import compiling
from adacd_hil.log.recording.processes import read_setup, start_module
from adacd_hil.scheme.pipeline.new_pipeline import new_pipeline
from adacd_hil.settings.configuration import Settings

_MODULE = "adacd_hil.control.cycle_compilation"


@contextmanager
def compiling_cycle(settings: Settings) -> Iterator[None]:
    """Have a second process compile the longest of the cycle's functions while the `with` block compiles them all.

    It starts with the first function that the block compiles, if there is a second processor, and ends with the block.
    A block within another starts none.
    """
    helpers: list[subprocess.Popen[bytes]] = []

    def start() -> None:
        if len(os.sched_getaffinity(0)) > 1:
            with contextlib.suppress(OSError):
                helpers.append(start_module(_MODULE, (), settings, subprocess.DEVNULL))

    try:
        with compiling(start):
            yield
    finally:
        for helper in helpers:
            helper.kill()
            helper.wait()


if __name__ == "__main__":
    new_pipeline(read_setup()).compile_longest()
