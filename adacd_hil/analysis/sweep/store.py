"""The results of a sweep on disk: parts as they come, one Parquet table in the end.

A part is written beside and renamed, so that a sweep that is killed leaves whole parts only. Columns are those of all
rows; a row that lacks one has null there. Readers: `duckdb`, `pandas.read_parquet`, `pyarrow.parquet`.
"""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from adacd_hil.analysis.sweep.rows import Values
from adacd_hil.extras import install_command
from adacd_hil.log.log_files import LogError
from adacd_hil.output_files import replace_file, replacing

TABLE_NAME = "sweep.parquet"
PLAN_NAME = "plan.json"
_PARTS = "parts"


class SweepStore:
    """The folder of a sweep."""

    def __init__(self, folder: Path) -> None:
        """Open or create it. Raises LogError where pyarrow is missing, OSError where it can't be written."""
        self.folder = folder
        self._parts = folder / _PARTS
        self._parquet = _parquet()
        self._parts.mkdir(parents=True, exist_ok=True)
        self._next = 1 + max((int(path.stem) for path in self._parts.glob("[0-9]*.parquet")), default=-1)

    def done(self) -> frozenset[str]:
        """Return the keys of the rows that are there and didn't fail."""
        keys: set[str] = set()
        for path in self._paths():
            table = self._read(path, ["key", "status"])
            keys.update(
                key
                for key, status in zip(*(table[name].to_pylist() for name in table.column_names), strict=True)
                if status == "ok"
            )
        return frozenset(keys)

    def add(self, rows: Iterable[Values]) -> None:
        """Write a part."""
        path = self._parts / f"{self._next:06d}.parquet"
        self._next += 1
        _write(self._parquet, path, _table(list(rows)))

    def join(self, keys: Iterable[str], about: Mapping[str, str]) -> Path:
        """Write the table of these rows in this order, the last result of each; return its path."""
        rows: dict[str, Values] = {}
        for path in self._paths():
            for row in self._read(path).to_pylist():
                if row["status"] == "ok" or rows.get(row["key"], row)["status"] != "ok":
                    rows[row["key"]] = row
        table = _table([rows[key] for key in keys if key in rows])
        metadata = {f"adacd_hil.{name}": text for name, text in about.items()}
        path = self.folder / TABLE_NAME
        _write(self._parquet, path, table.replace_schema_metadata(metadata))
        replace_file(self.folder / PLAN_NAME, json.dumps(about, indent=2))
        return path

    def _paths(self) -> list[Path]:
        return sorted(self._parts.glob("[0-9]*.parquet"))

    def _read(self, path: Path, columns: list[str] | None = None) -> Any:
        try:
            return self._parquet.read_table(path, columns=columns)
        except (OSError, ValueError) as error:  # of pyarrow, too
            raise LogError(f"sweep {path}: {str(error).splitlines()[0]}; remove it to compute its rows again") from None


def _parquet() -> Any:
    try:
        from pyarrow import parquet
    except ImportError:
        raise LogError(f"sweep needs pyarrow and dask: {install_command('sweep')}") from None
    return parquet


def _table(rows: list[Values]) -> Any:
    import pyarrow as pa

    names = dict.fromkeys(name for row in rows for name in row)
    return pa.table({name: pa.array([row.get(name) for row in rows], from_pandas=False) for name in names})


def _write(parquet: Any, path: Path, table: Any) -> None:
    with replacing(path) as beside:
        parquet.write_table(table, beside, compression="zstd")
