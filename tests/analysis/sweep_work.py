"""Work of a sweep without an arm, for processes that import little."""

import os
import signal
from pathlib import Path

import adacd_hil.lab.tune.sweep  # noqa: F401  # of the tasks that arrive


def row_of(task, row, **more):
    return {"key": row.key, "seed": task.subject.seed, **dict(row.changes), "status": "ok", "error": None, **more}


class Work:
    """Rows without an arm. Notes what it was asked for, in a file since it is sent about; raises as often as told."""

    def __init__(self, folder: Path, failures: dict[int, int] | None = None) -> None:
        self.notes = folder / f"notes{len(list(folder.glob('notes*')))}"
        self.notes.touch()
        self.failures = failures or {}

    def __call__(self, task):
        with self.notes.open("a") as notes:
            notes.write(f"{task.subject.seed} {len(task.rows)}\n")
        if self.tries(task.subject.seed) <= self.failures.get(task.subject.seed, 0):
            raise OSError("the disk was away")
        return [row_of(task, row) for row in task.rows]

    def tries(self, seed: int) -> int:
        """Count the tasks of a seed."""
        return sum(line.split()[0] == str(seed) for line in self.notes.read_text().splitlines())


class Dying(Work):
    """Its worker dies with some seeds: always, or as they are tried for the first time."""

    def __init__(self, folder: Path, always=(), once=()) -> None:
        super().__init__(folder)
        self.always, self.once = always, once

    def __call__(self, task):
        rows = super().__call__(task)
        seed = task.subject.seed
        if seed in self.always or (seed in self.once and self.tries(seed) == 1):
            os.kill(os.getpid(), signal.SIGKILL)
        return rows
