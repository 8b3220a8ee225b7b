"""Real-time requests of a process to the operating system, and the grants.

Scheduler, a processor of its own, memory that stays where it is, processors that don't sleep deeply, no garbage
collection. Constants are those of Linux' user-space headers (sched.h, prctl.h, mman.h) and of glibc's malloc.h.
"""

import ctypes
import errno
import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

ANY_CPU = "any"
ISOLATED_CPU = "isolated"

_SCHED_DEADLINE = 6
_SCHED_FLAG_RESET_ON_FORK = 1
_SYS_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274, "riscv64": 274}
_DEADLINE_SHARE = 0.8
"""Part of each period that SCHED_DEADLINE reserves: feedback is awaited for FEEDBACK_SHARE of it and sleeps need
no reserve. The kernel refuses a share that leaves less than 5 % of all processors to others."""

_PR_SET_TIMERSLACK = 29
_MCL_CURRENT_AND_FUTURE = 3
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_MOST_TRIM_BYTES = 2**31 - 1
_MOST_MMAP_BYTES = 2**25
"""The largest M_MMAP_THRESHOLD that glibc takes on 64 bits."""
_HEAP_BYTES = 16 << 20
"""Heap that is touched in advance; a run's own allocations stay below 1 MiB after compilation."""
_ARENA_BYTES = 256 << 10
"""Memory that the interpreter takes from the system at a time for small objects; the smallest among its versions."""
_SMALL_BYTES = 448
_RESERVED_ARENAS = 32

_RTPRIO = "allow it with `rtprio 99` in /etc/security/limits.conf, or CAP_SYS_NICE"
_MEMLOCK = "allow it with `memlock unlimited` in /etc/security/limits.conf, or CAP_IPC_LOCK"
_DMA_LATENCY = Path("/dev/cpu_dma_latency")
_SYSTEM_CPUS = Path("/sys/devices/system/cpu")

_kept_objects: list[bytes] = []


class Refusal(NamedTuple):
    """A request that the system refused. reason: the request's name and why; remedy: how to have it granted."""

    reason: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.reason}; {self.remedy}"


@dataclass(frozen=True)
class RealtimeRequest:
    """The request. scheduler: "fifo", "deadline" or "other" (the present one stays). priority: of SCHED_FIFO, 1..98.

    cpu: "any", "isolated" (the first isolated one) or a processor's number. period_ns: of SCHED_DEADLINE.
    """

    scheduler: str = "fifo"
    priority: int = 80
    cpu: str = ANY_CPU
    lock_memory: bool = True
    period_ns: int = 1_000_000


@dataclass(frozen=True)
class RealtimeGrant:
    """The grant of the operating system.

    `scheduler`: its name, with the priority of SCHED_FIFO or the share of SCHED_DEADLINE. `missing`: requests that were
    refused. `cpu`: the processor that the process stays on, None for any. `cpus`: processors that it was allowed
    before. `is_awake`: idle states with a long wake-up are forbidden.
    """

    scheduler: str
    missing: tuple[Refusal, ...] = ()
    cpu: int | None = None
    is_memory_locked: bool = False
    is_awake: bool = False
    cpus: frozenset[int] = field(default_factory=frozenset)

    @contextmanager
    def unpinned(self) -> Iterator[None]:
        """Let a pinned process run on any of `cpus` while the block lasts, then pin it again; an unpinned one stays so.

        A child that is started in the block doesn't inherit the pinning.
        """
        if self.cpu is not None:
            os.sched_setaffinity(0, self.cpus)
        try:
            yield
        finally:
            if self.cpu is not None:
                os.sched_setaffinity(0, {self.cpu})

    def describe(self) -> dict[str, str]:
        """Return the grant in words, by `scheduler`, `cpu`, `memory` and `idle_states`, for a log's metadata."""
        return {
            "scheduler": self.scheduler,
            "cpu": ANY_CPU if self.cpu is None else str(self.cpu),
            "memory": "locked" if self.is_memory_locked else "pageable",
            "idle_states": "shallow" if self.is_awake else "the system's",
        }


class _SchedulingAttributes(ctypes.Structure):
    """struct sched_attr, times in ns."""

    _fields_ = (
        ("size", ctypes.c_uint32),
        ("policy", ctypes.c_uint32),
        ("flags", ctypes.c_uint64),
        ("nice", ctypes.c_int32),
        ("priority", ctypes.c_uint32),
        ("runtime", ctypes.c_uint64),
        ("deadline", ctypes.c_uint64),
        ("period", ctypes.c_uint64),
    )


def request_realtime(request: RealtimeRequest | None = None) -> RealtimeGrant:
    """Request real-time scheduling, a processor, locked memory and shallow idle states (None: the default request).

    Under SCHED_OTHER also make sleeps exact, to 1 ns of timer slack. Call it after compiling. Return the grant, which
    lists the refusals; none is raised. Children inherit neither scheduler nor locked memory; see
    `RealtimeGrant.unpinned` for the processor.
    """
    request = request or RealtimeRequest()
    libc = ctypes.CDLL(None, use_errno=True)
    cpus = frozenset(os.sched_getaffinity(0))
    cpu, missing = _pin(request.cpu, cpus)
    scheduler, refused = _schedule(libc, request)
    missing += refused
    if scheduler == "SCHED_OTHER":
        libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)  # else 50 µs are added to every sleep
    is_locked = False
    if request.lock_memory:
        reason = _lock_memory(libc)
        is_locked = not reason
        missing += [Refusal(f"locked memory: {reason}", _MEMLOCK)] if reason else []
    is_awake, refused = _keep_awake()
    missing += refused
    return RealtimeGrant(scheduler, tuple(missing), cpu, is_locked, is_awake, cpus)


def _pin(wish: str, cpus: frozenset[int]) -> tuple[int | None, list[Refusal]]:
    """Pin the process to the processor of `wish`; return it and the refusals.

    None if any is wished, or the pinning is refused. wish: "any", "isolated" or a number, as of `RealtimeRequest`.
    cpus: processors that the process may use, for the remedy.
    """
    if wish == ANY_CPU:
        return None, []
    isolated = isolated_cpus()
    if wish == ISOLATED_CPU and not isolated:
        remedy = "isolate one with `isolcpus=N nohz_full=N rcu_nocbs=N` on the kernel's command line, or name one"
        return None, [Refusal("isolated processor: there is none", remedy)]
    cpu = isolated[0] if wish == ISOLATED_CPU else int(wish)
    try:
        os.sched_setaffinity(0, {cpu})
    except OSError as error:
        present = ", ".join(map(str, sorted(cpus)))
        remedy = f"choose one of {present} as `realtime.cpu`, or widen this process's cpuset"
        return None, [Refusal(f"processor {cpu}: {error.strerror}", remedy)]
    return cpu, []


def _schedule(libc: ctypes.CDLL, request: RealtimeRequest) -> tuple[str, list[Refusal]]:
    """Set the requested scheduler; return the name of the one in force and the refusals.

    If SCHED_DEADLINE is refused, SCHED_FIFO is requested; if that is refused, or "other" is requested, the present one
    stays.
    """
    missing = []
    if request.scheduler == "other":
        return scheduler_name(), []
    if request.scheduler == "deadline":
        error_number = _request_deadline(libc, request.period_ns)
        if not error_number:
            return f"SCHED_DEADLINE {_DEADLINE_SHARE:.0%} of {request.period_ns // 1000} µs", []
        remedy = "it needs CAP_SYS_NICE and all processors of its cpuset; or set `realtime.scheduler = 'fifo'`"
        missing.append(Refusal(f"SCHED_DEADLINE: {os.strerror(error_number)}", remedy))
    try:
        # Reset on fork: the logger's process must not compete with the cycle.
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(request.priority))
        return f"SCHED_FIFO {request.priority}", missing
    except OSError as error:
        missing.append(Refusal(f"SCHED_FIFO: {error.strerror}", _RTPRIO))
    return scheduler_name(), missing


def _request_deadline(libc: ctypes.CDLL, period_ns: int) -> int:
    """Request SCHED_DEADLINE with _DEADLINE_SHARE of each period; return the error's number, 0 if it is granted."""
    number = _SYS_SCHED_SETATTR.get(os.uname().machine)
    if number is None:
        return errno.ENOSYS
    attributes = _SchedulingAttributes(
        size=ctypes.sizeof(_SchedulingAttributes),
        policy=_SCHED_DEADLINE,
        flags=_SCHED_FLAG_RESET_ON_FORK,  # without it, fork is forbidden
        runtime=round(_DEADLINE_SHARE * period_ns),
        deadline=period_ns,
        period=period_ns,
    )
    return ctypes.get_errno() if libc.syscall(number, 0, ctypes.byref(attributes), 0) else 0


def _lock_memory(libc: ctypes.CDLL) -> str:
    """Lock all memory, with a reserve; return the error's text, empty if locked.

    Locking reads in all mapped pages, also of the stack, which compiling has made deeper than a cycle does. Freed
    memory is kept, and some is taken and freed in advance, so that a cycle never waits for a page.
    """
    if libc.mlockall(_MCL_CURRENT_AND_FUTURE) != 0:
        return os.strerror(ctypes.get_errno())
    if hasattr(libc, "mallopt"):
        libc.mallopt(_M_TRIM_THRESHOLD, _MOST_TRIM_BYTES)
        libc.mallopt(_M_MMAP_THRESHOLD, _MOST_MMAP_BYTES)
    bytearray(_HEAP_BYTES)
    # An arena is returned when its last object is freed: one object in each stays.
    objects = [bytes(_SMALL_BYTES) for _ in range(_RESERVED_ARENAS * _ARENA_BYTES // _SMALL_BYTES)]
    _kept_objects[:] = objects[:: _ARENA_BYTES // _SMALL_BYTES]
    return ""


def _keep_awake() -> tuple[bool, list[Refusal]]:
    """Forbid idle states with a long wake-up, for as long as this process lives: the file must stay open.

    Return whether they are forbidden, and the refusals; False and none where the kernel has no such file.
    """
    try:
        os.write(os.open(_DMA_LATENCY, os.O_WRONLY), bytes(4))  # the longest latency to bear, int32 in µs
    except FileNotFoundError:
        return False, []  # nothing to forbid here
    except OSError as error:
        remedy = f'allow it with the udev rule `KERNEL=="{_DMA_LATENCY.name}", GROUP="realtime", MODE="0660"`'
        return False, [Refusal(f"shallow idle states: {_DMA_LATENCY}: {error.strerror}", remedy)]
    return True, []


def isolated_cpus(folder: Path = _SYSTEM_CPUS) -> tuple[int, ...]:
    """Return the processors that the kernel keeps free of ordinary work; () if none or unknown.

    folder: of sysfs, whose file `isolated` lists them, such as "2-3,7".
    """
    try:
        text = (folder / "isolated").read_text().strip()
    except OSError:
        return ()
    found: list[int] = []
    for part in filter(None, text.split(",")):
        low, _, high = part.partition("-")
        found += range(int(low), int(high or low) + 1)
    return tuple(found)


def freeze_garbage() -> None:
    """Collect garbage once, exempt the objects that are left from later collections, and disable automatic collection.

    The cycle makes no cycles of references.
    """
    gc.collect()
    gc.freeze()
    gc.disable()


@contextmanager
def frozen_garbage() -> Iterator[None]:
    """Collect garbage once; disable the collection while the block lasts, and enable it afterwards.

    Enable it even if it was disabled before the block.
    """
    freeze_garbage()
    try:
        yield
    finally:
        gc.unfreeze()
        gc.enable()


def scheduler_name() -> str:
    """Return the name of the scheduler that this process runs under, such as SCHED_OTHER; `policy N` if unknown."""
    names = {
        os.SCHED_OTHER: "SCHED_OTHER",
        os.SCHED_FIFO: "SCHED_FIFO",
        os.SCHED_RR: "SCHED_RR",
        _SCHED_DEADLINE: "SCHED_DEADLINE",
    }
    policy = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
    return names.get(policy, f"policy {policy}")
