"""The one door to numba: `compiled` turns a numeric function into machine code, float64, no fast-math.

The on-disk cache is keyed by the text of every module with compiled functions and of all that these import. numba alone
looks only at the file of the function itself, and would go on using the old code of an edited callee and the old value
of an edited constant.
"""

import hashlib
import os
import re
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

_PACKAGES = ("adacd_hil", "firmware_sim")
_IMPORT = re.compile(r"^\s*from\s+((?:adacd_hil|firmware_sim)[\w.]*)\s+import\s+(\([^)]*\)|[^\n]*)", re.MULTILINE)
_NAME = re.compile(r"\w+")

Function = TypeVar("Function", bound=Callable[..., Any])


def _imports(text: str) -> Iterator[str]:
    """Name what a module imports of the packages: modules and, as they may be modules, names in them."""
    for module, names in _IMPORT.findall(text):
        yield module
        yield from (f"{module}.{name}" for name in _NAME.findall(names))


def compiled_sources(root: Path) -> dict[str, bytes]:
    """Return the text of every module below `root` that compiles functions and of all modules they import, by name."""
    texts = {}
    for package in _PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            name = ".".join(path.relative_to(root).with_suffix("").parts)
            texts[name.removesuffix(".__init__")] = path.read_bytes()
    waiting = [name for name, text in texts.items() if b"adacd_hil.compiled" in text]
    found: set[str] = set()
    while waiting:
        name = waiting.pop()
        if name in texts and name not in found:
            found.add(name)
            waiting.extend(_imports(texts[name].decode()))
    return {name: texts[name] for name in sorted(found)}


def source_digest() -> str:
    """Digest the sources that compiled code may depend on."""
    digest = hashlib.sha256()
    for name, text in compiled_sources(Path(__file__).resolve().parent.parent).items():
        digest.update(name.encode() + b"\0" + text)
    return digest.hexdigest()[:16]


def _cache_folder() -> Path:
    """Name the folder of this source state, under NUMBA_CACHE_DIR, the user's cache or the temporary folder."""
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given:
        return Path(given) / source_digest()
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "adacd-hil"
    try:
        base.mkdir(parents=True, exist_ok=True)
    except OSError:
        base = Path(tempfile.gettempdir()) / f"adacd-hil-{os.getuid()}"
    return base / source_digest()


numba.config.CACHE_DIR = str(_cache_folder())  # type: ignore[attr-defined]


def compiled(function: Function) -> Function:
    """Compile `function` at its first call; division by zero gives inf or nan, as in numpy."""
    return cast(Function, numba.njit(cache=True, fastmath=False, error_model="numpy")(function))


def released(function: Function) -> Function:
    """Compile `function` as `compiled` does; while it runs, other threads of Python go on. For what takes long."""
    return cast(Function, numba.njit(cache=True, fastmath=False, error_model="numpy", nogil=True)(function))
