"""The one door to numba: `compiled` turns a numeric function into machine code, float64, no fast-math.

The on-disk cache is keyed by the text of every module of both packages. numba alone looks only at the file of the
function itself, and would go on using the old code of an edited callee and the old value of an edited constant.
"""

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

_PACKAGES = ("adacd_hil", "firmware_sim")

Function = TypeVar("Function", bound=Callable[..., Any])


def _source_digest() -> str:
    """Digest the sources of all modules."""
    root = Path(__file__).resolve().parent.parent
    digest = hashlib.sha256()
    for package in _PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _cache_folder() -> Path:
    """Name the folder of this source state, under NUMBA_CACHE_DIR, the user's cache or the temporary folder."""
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given:
        return Path(given) / _source_digest()
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "adacd-hil"
    try:
        base.mkdir(parents=True, exist_ok=True)
    except OSError:
        base = Path(tempfile.gettempdir()) / f"adacd-hil-{os.getuid()}"
    return base / _source_digest()


numba.config.CACHE_DIR = str(_cache_folder())  # type: ignore[attr-defined]


def compiled(function: Function) -> Function:
    """Compile `function` at its first call; division by zero gives inf or nan, as in numpy."""
    return cast(Function, numba.njit(cache=True, fastmath=False, error_model="numpy")(function))
