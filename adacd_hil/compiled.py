"""The one door to numba: `compiled` turns a numeric function into machine code, float64, no fast-math.

The on-disk cache is keyed by the text of every module with compiled functions and of all that these import. numba alone
looks only at the file of the function itself, and would go on using the old code of an edited callee and the old value
of an edited constant.

Processes share the work: none compiles what another one is just compiling (`_SharedCache`).
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
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core import event
from numba.core.caching import FunctionCache
from numpy.typing import ArrayLike

from adacd_hil.compile_progress import CompileCount, full_name, functions_below

_ROOT = Path(__file__).resolve().parent.parent
_PACKAGES = ("adacd_hil", "firmware_sim")
_IMPORT = re.compile(r"^\s*from\s+((?:adacd_hil|firmware_sim)[\w.]*)\s+import\s+(\([^)]*\)|[^\n]*)", re.MULTILINE)
_NAME = re.compile(r"\w+")
_USE = re.compile(rb"^[ \t]*@(?:compiled|released)\b", re.MULTILINE)

Function = TypeVar("Function", bound=Callable[..., Any])


def _imports(text: str) -> Iterator[str]:
    """Name what a module imports of the packages: modules and, as they may be modules, names in them."""
    for module, names in _IMPORT.findall(text):
        yield module
        yield from (f"{module}.{name}" for name in _NAME.findall(names))


def all_sources(root: Path) -> dict[str, bytes]:
    """Return the text of every module below `root`, by name."""
    texts = {}
    for package in _PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            name = ".".join(path.relative_to(root).with_suffix("").parts)
            texts[name.removesuffix(".__init__")] = path.read_bytes()
    return texts


def compiled_sources(root: Path) -> dict[str, bytes]:
    """Return the text of every module below `root` that compiles functions and of all modules they import, by name."""
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
    """Digest the sources that compiled code may depend on."""
    return _digest(compiled_sources(_ROOT))


def program_digest() -> str:
    """Digest all sources: what a result may depend on."""
    return _digest(all_sources(_ROOT))


def _digest(sources: dict[str, bytes]) -> str:
    digest = hashlib.sha256()
    for name, text in sources.items():
        digest.update(name.encode() + b"\0" + text)
    return digest.hexdigest()[:16]


def cache_folder(digest: str) -> Path:
    """Make the folder for compiled code of a source state: in NUMBA_CACHE_DIR, the user's cache or the temporary one.

    What is read from it is executed. So it and the folder above it belong to this user alone, or the next place is
    tried, at last a new folder. Raises OSError when there is none at all.
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
    """Make a folder where there is nothing; say what is there. Raises OSError."""
    with contextlib.suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    return folder.lstat()


def _is_own(status: os.stat_result) -> bool:
    """Tell whether it is a folder in which nobody but this user can write."""
    return stat.S_ISDIR(status.st_mode) and status.st_uid == os.geteuid() and not status.st_mode & 0o022


_FOLDER = cache_folder(source_digest())
numba.config.CACHE_DIR = str(_FOLDER)  # type: ignore[attr-defined]


_POLL_S = 0.02
_MOST_POLLS = 6000
"""For another process that compiles a function, 120 s: one that was stopped in the midst of it holds up nobody longer.
"""


class _Claims:
    """Which process compiles which function at present: locks of single bytes of one file, freed when a process ends.

    Calls have no circle, so neither has waiting; the kernel would refuse one.
    """

    def __init__(self) -> None:
        self._descriptor: int | None = None
        with contextlib.suppress(OSError):
            self._descriptor = os.open(_FOLDER / "claims", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)

    def take(self, what: str) -> bool:
        """Claim a function; return whether another process had it until now. Without locks there is no claim."""
        for polls in range(_MOST_POLLS):
            if self._lock(what, fcntl.LOCK_EX | fcntl.LOCK_NB):
                return polls > 0
            threading.Event().wait(_POLL_S)
            _compilation.tell()
        return True

    def give_back(self, what: str) -> None:
        """Let others have it."""
        self._lock(what, fcntl.LOCK_UN)

    def _lock(self, what: str, operation: int) -> bool:
        """Tell whether the operation is done, or can't be done at all; not where another process has the byte."""
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
    """Name a record in the symbols of compiled code.

    numba names it by a count of its process (numba's issue 7654). Two processes then save code of two layouts below one
    symbol, and a third one that loads both runs the code of the first with the memory of the second.
    """
    return "Record", (hashlib.sha256(record.name.encode()).hexdigest()[:16],)


numba.types.Record.mangling_args = property(_name_of_layout)  # type: ignore[method-assign, assignment]


class _SharedCache(FunctionCache):
    """numba's cache on disk, for processes that compile at the same time.

    numba chooses a file's name by the index that it has read before: of two processes that compile a function for
    different types both take the same name, and the index then gives the code of one for the types of the other.
    """

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load what was compiled for these types; None where this process is to compile it, and then to save it."""
        found = super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        if found is None and _claims.take(self._claim(sig)):
            found = super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
            if found is not None:
                _claims.give_back(self._claim(sig))
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save what was compiled, one process after the other. A disk that takes nothing costs compiling anew."""
        try:
            with contextlib.suppress(OSError), (_FOLDER / "lock").open("wb") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                super().save_overload(sig, data)  # type: ignore[no-untyped-call]
        finally:
            _claims.give_back(self._claim(sig))

    def version(self) -> int | None:
        """Return what differs once something more was saved, by whichever process; None: nothing was."""
        try:
            return Path(self._cache_file._index_path).stat().st_mtime_ns
        except OSError:
            return None

    def _claim(self, sig: Any) -> str:
        return f"{full_name(self._py_func)} {sig}"


def compiled(function: Function) -> Function:
    """Compile `function` at its first call; division by zero gives inf or nan, as in numpy."""
    return _compiled(function)


def released(function: Function) -> Function:
    """Compile `function` as `compiled` does; while it runs, other threads of Python go on. For what takes long."""
    return _compiled(function, nogil=True)


def _compiled(function: Function, **options: bool) -> Function:
    # No wrapper for callers in C, of which there are none: a twentieth of the time that compiling takes.
    made = numba.njit(fastmath=False, error_model="numpy", no_cfunc_wrapper=True, **options)  # type: ignore[call-overload]
    dispatcher: Any = made(function)
    if dispatcher is not function:  # as it is where NUMBA_DISABLE_JIT is set
        dispatcher._cache = _SharedCache(function)  # type: ignore[no-untyped-call]
    return cast(Function, dispatcher)


class _Compilation(event.Listener):
    """What is compiled at present, and who is told. No garbage is collected meanwhile: a tenth of the time."""

    def __init__(self) -> None:
        self._depth = 0
        self._was_collecting = False
        self._count = self.new_count(())
        self._on_first: Callable[[], None] | None = None

    def new_count(self, functions: Sequence[Any]) -> CompileCount:
        """Count from now on, towards these functions and all that they call."""
        self._count = CompileCount(functions_below(functions), lambda function: function._cache.version())
        return self._count

    def on_start(self, event: Any) -> None:  # noqa: ARG002
        """Begin to compile a function."""
        if self._depth == 0:
            self._was_collecting = gc.isenabled()
            gc.disable()
        self._depth += 1
        begin, self._on_first = self._on_first, None
        if begin is not None:
            begin()
        self._count.tell()

    def on_end(self, event: Any) -> None:
        """Count it."""
        self._depth -= 1
        if self._depth == 0 and self._was_collecting:
            gc.enable()
        if isinstance(event.data["dispatcher"]._cache, _SharedCache):  # not one of numba's own
            self._count.add(event.data["dispatcher"])

    def tell(self) -> None:
        """Tell the listeners how far it is."""
        self._count.tell()

    @contextmanager
    def of(self, functions: Sequence[Any], on_first: Callable[[], None]) -> Iterator[None]:
        """Count towards these functions in the block, unless a block around this one does."""
        if self._on_first is not None or self._count.is_expecting:
            yield
            return
        self.new_count(functions)
        self._on_first = on_first
        try:
            yield
        finally:
            self._on_first = None
            self.new_count(())


_compilation = _Compilation()
event.register("numba:compile", _compilation)  # type: ignore[no-untyped-call]


def compiling(functions: Sequence[Any], on_first: Callable[[], None] = lambda: None) -> Any:
    """Return a block that compiles these functions and all that they call: who listens is told how many there are.

    on_first: called before the first is compiled, and not at all where all are in the cache.
    """
    return _compilation.of(functions, on_first)


Structured = np.ndarray[Any, np.dtype[np.void]]


def packed(values: Mapping[str, ArrayLike]) -> Structured:
    """Put values of any shape into one element (1,), as float64."""
    element = zeroed({name: np.shape(value) for name, value in values.items()})
    for name, value in values.items():
        element[name] = value
    return element


def zeroed(shapes: Mapping[str, tuple[int, ...]]) -> Structured:
    """Return one element (1,) of zeros, float64, with a field of each shape."""
    return np.zeros(1, float_fields(shapes))


def float_fields(shapes: Mapping[str, tuple[int, ...]]) -> np.dtype[np.void]:
    """Describe an element with float64 fields of these shapes; equal descriptions are one and the same object.

    At each call of compiled code numba looks up the types of the arguments: in 0.2 us if the description is the object
    that it knows, in 5 to 10 us if it is another one that is equal, field by field.
    """
    return _float_fields(tuple(shapes.items()))


@cache
def _float_fields(shapes: tuple[tuple[str, tuple[int, ...]], ...]) -> np.dtype[np.void]:
    return np.dtype([(name, np.float64, shape) for name, shape in shapes])


def record_of(*fields: tuple[Any, ...]) -> np.dtype[np.void]:
    """Describe an element with these fields: name, type and, of an array, shape. They are read as attributes."""
    return np.dtype((np.record, list(fields)))
