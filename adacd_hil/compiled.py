"""The only import of numba: `compiled` turns a numeric function into machine code, float64, no fast-math.

The on-disk cache is keyed by the text of every module with compiled functions and of all modules that these import.
numba alone looks only at the file of the function itself; it would use old code of an edited callee, and the old value
of an edited constant.

Another process waits 120 s at most for a function that one process is compiling (`_SharedCache`). The code is for
every processor of the architecture, so that a wheel can bring it along (`tools/wheel`). On the one machine measured it
was as fast as code for that processor, with the same bits.
"""

import contextlib
import fcntl
import gc
import hashlib
import os
import re
import stat
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import event
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    UserProvidedCacheLocator,
    _CacheLocator,
)

from adacd_hil.compile_progress import call_listeners

_ROOT = Path(__file__).resolve().parent.parent
_PACKAGES = ("adacd_hil", "firmware_sim")
_IMPORT = re.compile(r"^\s*from\s+((?:adacd_hil|firmware_sim)[\w.]*)\s+import\s+(\([^)]*\)|[^\n]*)", re.MULTILINE)
_NAME = re.compile(r"\w+")
_USE = re.compile(rb"^[ \t]*@(?:compiled|released)\b", re.MULTILINE)

Function = TypeVar("Function", bound=Callable[..., Any])


def _imports(text: str) -> Iterator[str]:
    """Yield the dotted modules of both packages that a source imports from, and each with an imported name added.

    The latter may be modules, too.
    """
    for module, names in _IMPORT.findall(text):
        yield module
        yield from (f"{module}.{name}" for name in _NAME.findall(names))


def all_sources(root: Path) -> dict[str, bytes]:
    """Return the source of every module of `adacd_hil` and `firmware_sim` below `root`, as bytes, by dotted name."""
    texts = {}
    for package in _PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            name = ".".join(path.relative_to(root).with_suffix("").parts)
            texts[name.removesuffix(".__init__")] = path.read_bytes()
    return texts


def compiled_sources(root: Path) -> dict[str, bytes]:
    """Return, by dotted name, the source of each module below `root` that compiles functions, and of all its imports.

    Imports of imports are followed, too; modules of packages other than our two are left out.
    """
    texts = all_sources(root)
    waiting = [name for name, text in texts.items() if name == __name__ or _USE.search(text)]
    found: set[str] = set()
    while waiting:
        name = waiting.pop()
        if name in texts and name not in found:
            found.add(name)
            waiting.extend(_imports(texts[name].decode()))
    return {name: texts[name] for name in sorted(found)}


def source_digest() -> str:
    """Return a digest, 16 hexadecimal digits, of all sources that compiled code may depend on."""
    return _digest(compiled_sources(_ROOT))


def program_digest() -> str:
    """Return a digest, 16 hexadecimal digits, of all sources, for results that may depend on any of them."""
    return _digest(all_sources(_ROOT))


def _digest(sources: dict[str, bytes]) -> str:
    digest = hashlib.sha256()
    for name, text in sources.items():
        digest.update(name.encode() + b"\0" + text)
    return digest.hexdigest()[:16]


def cache_folder(digest: str) -> Path:
    """Make and return the folder for compiled code of a state of the sources.

    It is in NUMBA_CACHE_DIR, the user's cache or the temporary folder.

    Code in the folder is executed. So only this user may write in the folder and its parent; else the next place is
    tried, at last a new temporary folder. A NUMBA_CACHE_DIR that is not used is warned of. Raises OSError if all fail.
    """
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given:
        with contextlib.suppress(OSError):
            Path(given).mkdir(mode=0o700, parents=True, exist_ok=True)
            if _is_own(Path(given).stat()) and _is_own(_make(Path(given) / digest)):
                return Path(given) / digest
        warnings.warn(f"NUMBA_CACHE_DIR {given} is not used: not this user's alone", stacklevel=2)
    places = [Path(tempfile.gettempdir()) / f"adacd-hil-{os.geteuid()}"]
    with contextlib.suppress(RuntimeError):  # a user without a home
        places.insert(0, Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "adacd-hil")
    for place in places:
        with contextlib.suppress(OSError):
            place.parent.mkdir(parents=True, exist_ok=True)
            status = _make(place)
            if stat.S_ISDIR(status.st_mode) and status.st_uid == os.geteuid():
                place.chmod(0o700)  # somebody's umask may have left it open
            if _is_own(place.lstat()) and _is_own(_make(place / digest)):
                return place / digest
    return Path(tempfile.mkdtemp(prefix="adacd-hil-"))


def _make(folder: Path) -> os.stat_result:
    """Make a folder unless its name is taken; return the status of that name. Raises OSError if it can't be made."""
    with contextlib.suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    return folder.lstat()


def _is_own(status: os.stat_result) -> bool:
    """Return whether a status is that of a folder in which only this user can write."""
    return stat.S_ISDIR(status.st_mode) and status.st_uid == os.geteuid() and not status.st_mode & 0o022


_DIGEST = source_digest()
_FOLDER = cache_folder(_DIGEST)
SHIPPED = Path(__file__).resolve().parent / "machine_code"
"""Folder that a wheel brings along: below it, by digest of the sources, the compiled code of `tools/wheel`."""
numba.config.CACHE_DIR = str(_FOLDER)  # type: ignore[attr-defined]
numba.config.CPU_NAME, numba.config.CPU_FEATURES = "generic", ""  # type: ignore[attr-defined]


_POLL_S = 0.02
_MOST_POLLS = 6000
"""Waits of 20 ms for another process that compiles a function, 120 s in all: a stopped process blocks others no longer.
"""


class _Claims:
    """Marks the functions that a process is compiling, by locks on single bytes of one file; they end with the process.

    Calls have no circle, so neither has waiting; each wait ends after 120 s.
    """

    def __init__(self) -> None:
        self._descriptor: int | None = None
        with contextlib.suppress(OSError):
            self._descriptor = os.open(_FOLDER / "claims", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)

    def claim(self, what: str) -> bool:
        """Lock `what`, a function's full name and types, for this process; wait, 120 s at most, while another holds it.

        Return whether another process held the lock, and so may have compiled the function; after 120 s return True
        without the lock. Without file locks: False.
        """
        for polls in range(_MOST_POLLS):
            if self._lock(what, fcntl.LOCK_EX | fcntl.LOCK_NB):
                return polls > 0
            threading.Event().wait(_POLL_S)
            _compilation.call_listeners()
        return True

    def release(self, what: str) -> None:
        """Release the claim on a function; `what`: as of `claim`."""
        self._lock(what, fcntl.LOCK_UN)

    def _lock(self, what: str, operation: int) -> bool:
        """Lock or unlock a function's byte; return False if another process has it, True if locks don't work here."""
        if self._descriptor is None:
            return True
        byte = int.from_bytes(hashlib.sha256(what.encode()).digest()[:7], "big")
        try:
            fcntl.lockf(self._descriptor, operation, 1, byte)
        except (BlockingIOError, PermissionError):
            return False
        except OSError:  # a file system without locks
            return True
        return True


_claims = _Claims()


def _name_of_layout(record: numba.types.Record) -> tuple[str, tuple[str]]:
    """Return the name of a record type in the symbols of compiled code: "Record" and a digest of its layout.

    numba names it by a count of its process (numba's issue 7654). Two processes then save code of two layouts below one
    symbol, and a third one that loads both runs the code of the first with the memory of the second.
    """
    return "Record", (hashlib.sha256(record.name.encode()).hexdigest()[:16],)


numba.types.Record.mangling_args = property(_name_of_layout)  # type: ignore[method-assign, assignment]


class _Locator(_CacheLocator):
    """Places the code of our functions by module and line, wherever the sources lie; their state names the folder."""

    def __init__(self, function: Any) -> None:
        self._module, self._line = function.__module__, str(function.__code__.co_firstlineno)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> "_Locator | None":
        """Return the locator of a function of the two packages; None for others' functions."""
        is_ours = any(Path(py_file).resolve().is_relative_to(_ROOT / package) for package in _PACKAGES)
        return cls(py_func) if is_ours else None

    def get_cache_path(self) -> str:
        """Return the folder for the code of this function's module."""
        return str(_FOLDER / self._module)

    def get_source_stamp(self) -> str:
        """Return the digest of all sources that compiled code may depend on, see `source_digest`."""
        return _DIGEST

    def get_disambiguator(self) -> str:
        """Return the line of the function in its source, by which functions of one name have different files."""
        return self._line


class _Implementation(CompileResultCacheImpl):
    _locator_classes = (_Locator, UserProvidedCacheLocator)  # type: ignore[assignment]


class _CacheFile(IndexDataCacheFile):
    """One function's code in the user's cache; code that is missing there comes from the wheel."""

    def __init__(self, path: str, base: str, stamp: object) -> None:
        super().__init__(path, base, stamp)  # type: ignore[no-untyped-call]
        shipped = SHIPPED / _DIGEST / Path(path).relative_to(_FOLDER)
        self._shipped = IndexDataCacheFile(str(shipped), base, stamp)  # type: ignore[no-untyped-call]

    def load(self, key: Any) -> Any:
        """Return the compiled code for numba's key: argument types, processor, function; None: there is none."""
        found = super().load(key)  # type: ignore[no-untyped-call]
        return self._shipped.load(key) if found is None else found  # type: ignore[no-untyped-call]


class _SharedCache(FunctionCache):
    """numba's cache on disk, for processes that compile at the same time.

    numba chooses a file's name by the index that it has read before: of two processes that compile a function for
    different types both take the same name, and the index then gives the code of one for the types of the other.
    """

    _impl_class = _Implementation

    def __init__(self, function: Any) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        locator = self._impl.locator
        self._cache_file = _CacheFile(locator.get_cache_path(), self._impl.filename_base, locator.get_source_stamp())

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the code compiled for these types; None: this process has to compile it, then save it.

        Wait, for `_MOST_POLLS` times `_POLL_S` at most, while another process compiles it.
        """
        found = super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        if found is None and _claims.claim(self._claim(sig)):
            found = super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
            if found is not None:
                _claims.release(self._claim(sig))
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save compiled code, one process after the other, and release the claim of `load_overload`.

        If the disk refuses it, as a full one does, it isn't saved; the next process compiles.
        """
        try:
            with contextlib.suppress(OSError), (_FOLDER / "lock").open("wb") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                super().save_overload(sig, data)  # type: ignore[no-untyped-call]
        finally:
            _claims.release(self._claim(sig))

    def _claim(self, sig: Any) -> str:
        return f"{self._py_func.__module__}.{self._py_func.__qualname__} {sig}"


def compiled(function: Function) -> Function:
    """Return `function`, to be compiled at its first call; division by zero gives inf or nan, as in numpy."""
    return _compiled(function)


def released(function: Function) -> Function:
    """Return `function` as `compiled` does; it releases the GIL while it runs, for functions that take long."""
    return _compiled(function, nogil=True)


def _compiled(function: Function, **options: bool) -> Function:
    # No wrapper for callers in C: there are none, and it takes a twentieth of the compile time.
    made = numba.njit(fastmath=False, error_model="numpy", no_cfunc_wrapper=True, **options)  # type: ignore[call-overload]
    dispatcher: Any = made(function)
    if dispatcher is not function:  # as it is where NUMBA_DISABLE_JIT is set
        dispatcher._cache = _SharedCache(function)
    return cast(Function, dispatcher)


class _Compilation(event.Listener):
    """Counts compilations and calls the listeners. Garbage collection pauses meanwhile; it took a tenth of the time."""

    def __init__(self) -> None:
        self._depth = self._count = 0
        self._was_collecting = False
        self._on_first: Callable[[], None] | None = None

    def on_start(self, event: Any) -> None:  # noqa: ARG002
        """Pause garbage collection as a function begins to compile; call `on_first`, once, and the listeners."""
        if self._depth == 0:
            self._was_collecting = gc.isenabled()
            gc.disable()
        self._depth += 1
        if self._on_first is not None:
            on_first, self._on_first = self._on_first, lambda: None
            on_first()
        self.call_listeners()

    def on_end(self, event: Any) -> None:
        """Count a compiled function and call the listeners; do neither for one of numba's own.

        After the outermost function, resume garbage collection if it was on before.
        """
        self._depth -= 1
        if self._depth == 0 and self._was_collecting:
            gc.enable()
        if isinstance(event.data["dispatcher"]._cache, _SharedCache):  # not one of numba's own
            self._count += 1
            self.call_listeners()

    def call_listeners(self) -> None:
        """Call the listeners with the present count as a line."""
        call_listeners(self._count)

    @contextmanager
    def of(self, on_first: Callable[[], None]) -> Iterator[None]:
        """Call `on_first` before the first function that compiles in the block.

        It isn't called if all functions come from the cache, nor in a block within another.
        """
        if self._on_first is not None:
            yield
            return
        self._on_first = on_first
        try:
            yield
        finally:
            self._on_first = None


_compilation = _Compilation()
event.register("numba:compile", _compilation)  # type: ignore[no-untyped-call]

compiling = _compilation.of
