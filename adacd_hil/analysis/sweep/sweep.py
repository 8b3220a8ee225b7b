"""A sweep on Dask: tasks go to workers, rows come back and are kept at once; processes of this machine, or a cluster.

The client holds a few tasks per worker in flight and writes what comes back every few seconds, so that memory doesn't
grow with the plan. A worker that dies costs its tasks, which go to another; a task that raises is tried again; after
that its rows say what it raised. Workers need the package and, of replays, the logs at the same paths.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from adacd_hil.analysis.sweep.plan import Plan, Task
from adacd_hil.analysis.sweep.rows import Values, failed
from adacd_hil.analysis.sweep.store import SweepStore
from adacd_hil.clock import MonotonicClock
from adacd_hil.log.log_files import LogError

ROWS_PER_TASK = 20
"""So many replays share the decoding of a log; more would make a lost worker cost more."""
RETRIES = 2
_IN_FLIGHT = 4  # tasks per worker, so that none waits for the client
_WRITE_NS = 5_000_000_000

Work = Callable[[Task], list[Values]]
Progress = Callable[[str], None]


class SweepOutcome(NamedTuple):
    """What came of a sweep: rows that were computed, found done before, and failed."""

    computed: int
    found: int
    failed: int
    elapsed_s: float


def run_sweep(
    plan: Plan,
    work: Work,
    store: SweepStore,
    client: Any,
    progress: Progress,
    rows_per_task: int = ROWS_PER_TASK,
) -> SweepOutcome:
    """Compute the rows that the store lacks. client: of dask.distributed. Raises LogError when the cluster is lost."""
    from distributed import as_completed

    clock = MonotonicClock()
    begin_ns = written_ns = clock.now_ns()
    done = store.done()
    wanted = sum(key not in done for key in plan.row_keys())
    tasks = plan.tasks(done, rows_per_task)
    flying: dict[Any, Task] = {}
    completed = as_completed(loop=client.loop)
    rows: list[Values] = []
    computed = failures = 0

    def launch() -> None:
        workers = max(1, len(client.scheduler_info(n_workers=-1)["workers"]))
        while len(flying) < _IN_FLIGHT * workers and (task := next(tasks, None)) is not None:
            future = client.submit(work, task, retries=RETRIES, pure=False)
            flying[future] = task
            completed.add(future)

    try:
        launch()
        while flying:
            future = next(completed)
            found = _result(future, flying.pop(future))
            future.release()
            rows += found
            computed += len(found)
            failures += sum(row["status"] != "ok" for row in found)
            launch()
            now_ns = clock.now_ns()
            if now_ns - written_ns >= _WRITE_NS:
                store.add(rows)
                rows, written_ns = [], now_ns
                progress(_describe(computed, wanted, failures, (now_ns - begin_ns) * 1e-9))
    finally:
        if rows:
            store.add(rows)
    elapsed_s = (clock.now_ns() - begin_ns) * 1e-9
    progress(_describe(computed, wanted, failures, elapsed_s))
    return SweepOutcome(computed, plan.size - wanted, failures, elapsed_s)


def _result(future: Any, task: Task) -> list[Values]:
    """Return the rows of a task; of one that raised every time, rows that say what."""
    if future.status == "cancelled":
        raise LogError("sweep: the scheduler is gone; begin again to go on with what is missing")
    error = future.exception()
    if error is None:
        found: list[Values] = future.result()
        return found
    text = f"{type(error).__name__}: {error}"
    return [failed(task.subject, row, text) for row in task.rows]


def _describe(computed: int, wanted: int, failures: int, elapsed_s: float) -> str:
    rate = computed / max(elapsed_s, 1e-9)
    left_s = (wanted - computed) / rate if computed else 0.0
    text = f"{computed} of {wanted} rows, {rate:.1f} rows/s, {left_s:.0f} s left"
    return text + (f", {failures} failed" if failures else "")
