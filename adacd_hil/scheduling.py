"""What a process asks of the operating system to be on time: scheduler, locked memory, no garbage collection."""

import ctypes
import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

_MCL_CURRENT_AND_FUTURE = 3
PRIORITY = 80
"""SCHED_FIFO priority: above ordinary work and threaded interrupts (50), below the kernel's own at 99."""


@dataclass(frozen=True)
class RealtimeGrant:
    """What the operating system granted. `missing`: one line each, with the remedy."""

    scheduler: str
    missing: tuple[str, ...]


def request_realtime() -> RealtimeGrant:
    """Ask for SCHED_FIFO and locked memory for this process. What can't be had is said, not raised."""
    missing = []
    scheduler = "SCHED_OTHER"
    try:
        # Reset on fork: the logger's process must not compete with the cycle.
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
        scheduler = f"SCHED_FIFO {PRIORITY}"
    except OSError as error:
        missing.append(f"SCHED_FIFO: {error.strerror}; allow it with `rtprio 99` in /etc/security/limits.conf")
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT_AND_FUTURE) != 0:
        reason = os.strerror(ctypes.get_errno())
        missing.append(f"locked memory: {reason}; allow it with `memlock unlimited` in /etc/security/limits.conf")
    return RealtimeGrant(scheduler, tuple(missing))


def freeze_garbage() -> None:
    """Collect once and never again: the cycle makes no cycles of references."""
    gc.collect()
    gc.freeze()
    gc.disable()


@contextmanager
def frozen_garbage() -> Iterator[None]:
    """Collect once, and not again while the block lasts."""
    freeze_garbage()
    try:
        yield
    finally:
        gc.unfreeze()
        gc.enable()


def scheduler_name() -> str:
    """Name the scheduler this process runs under."""
    names = {os.SCHED_OTHER: "SCHED_OTHER", os.SCHED_FIFO: "SCHED_FIFO", os.SCHED_RR: "SCHED_RR"}
    policy = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
    return names.get(policy, f"policy {policy}")
