"""Processes that the log runs beside the control process: a module of ours, with descriptors and what it is told."""

import contextlib
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path


def start_module(
    module: str, descriptors: Sequence[int], told: bytes, stderr: int | None = None
) -> "subprocess.Popen[bytes]":
    """Run a module of ours with descriptors as its arguments and `told` on its standard input. Raises OSError.

    It is in a session of its own: Ctrl-C is for the control process. No folder but ours is searched for modules.
    stderr: as of subprocess; None: the one of this process.
    """
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", module, *map(str, descriptors)],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=stderr,
        pass_fds=descriptors,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": _module_path()},
    )
    assert process.stdin is not None
    with contextlib.suppress(BrokenPipeError), process.stdin:  # one that died says so to who waits for its word
        process.stdin.write(told)
    return process


def _module_path() -> str:
    """Name the folder that this package was imported from, before what the environment names."""
    own = str(Path(__file__).resolve().parents[2])
    return os.pathsep.join(filter(None, (own, os.environ.get("PYTHONPATH", ""))))
