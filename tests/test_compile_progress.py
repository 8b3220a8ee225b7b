"""Who compiles says how far it is; processes share the work."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from adacd_hil.compile_progress import listening
from adacd_hil.compiled import compiled, compiling
from adacd_hil.printable import number_of


@compiled
def halve(x):
    return 0.5 * x


@compiled
def quarter(x):
    return halve(halve(x))


needs_compiler = pytest.mark.skipif(
    not hasattr(halve, "py_func"), reason="NUMBA_DISABLE_JIT is set: nothing is compiled, so nothing is counted"
)


@needs_compiler
def test_whoever_listens_is_told_how_far_compiling_is(monkeypatch: pytest.MonkeyPatch) -> None:
    for function in (halve, quarter):
        monkeypatch.setattr(function._cache, "load_overload", lambda *_: None)  # an empty cache
    said: list[str] = []
    begun: list[int] = []
    with (
        listening(said.append),
        compiling(lambda: begun.append(len(said))),
        compiling(lambda: begun.append(-1)),  # the block around it has begun what is begun once
    ):
        assert quarter(4.0) == 1.0
    first = int(said[0].split()[1])  # those that this process has compiled before
    assert said[-1] == f"compiling, {number_of(first + 2, 'function')} so far, once per version"
    assert begun == [0]
    with compiling(lambda: begun.append(-1)):
        assert quarter(np.float64(8.0)) == 2.0
    assert begun == [0]  # it was compiled


WAITING = """
import sys
from adacd_hil.compiled import _SharedCache, compiled

@compiled
def double(x):
    return 2.0 * x

save = _SharedCache.save_overload

def held(self, *arguments):
    print("compiled", flush=True)
    sys.stdin.readline()
    save(self, *arguments)

_SharedCache.save_overload = held
double(1.5)
print(sum(double.stats.cache_hits.values()), flush=True)
"""


@pytest.mark.slow
def test_who_compiles_is_awaited_and_one_that_dies_holds_up_nobody(tmp_path: Path) -> None:
    program = tmp_path / "double.py"
    program.write_text(WAITING)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}

    def start() -> "subprocess.Popen[str]":
        words = [sys.executable, str(program)]
        return subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)

    with start() as first:
        assert first.stdout is not None
        assert first.stdout.readline() == "compiled\n"
        with start() as other:
            assert other.stdin is not None
            with pytest.raises(subprocess.TimeoutExpired):
                other.wait(timeout=0.5)  # it awaits what the first compiles
            first.kill()
            assert other.communicate("\n") == ("compiled\n0\n", None)
    with start() as third:
        assert third.communicate() == ("1\n", None)
