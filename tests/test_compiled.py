"""The cache of compiled code is keyed by all that the code may depend on."""

import errno
import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest

from adacd_hil.compiled import (
    all_sources,
    cache_folder,
    compiled,
    compiled_sources,
    program_digest,
    source_digest,
)

CALLER = (
    "from adacd_hil.compiled import compiled\nfrom adacd_hil.scheme import (\n    callee,\n)\n\n"
    "@compiled\ndef call(): pass\n"
)
CALLEE = "from adacd_hil.scheme.constants import GRAVITY\n"


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    folder = tmp_path / "adacd_hil" / "scheme"
    folder.mkdir(parents=True)
    other = "from adacd_hil.compiled import source_digest\nfrom adacd_hil.scheme import far\n"
    texts = {"caller": CALLER, "callee": CALLEE, "constants": "GRAVITY = 9.81\n", "other": other, "far": "A = 1\n"}
    for name, text in texts.items():
        (folder / f"{name}.py").write_text(text)
    return tmp_path


def test_what_compiled_code_imports_belongs_to_its_key_and_nothing_else_does(tree: Path) -> None:
    assert list(compiled_sources(tree)) == [f"adacd_hil.scheme.{name}" for name in ("callee", "caller", "constants")]


def test_the_key_has_the_text_of_the_package_itself() -> None:
    sources = compiled_sources(Path(__file__).resolve().parent.parent)
    assert b"def step(" in sources["adacd_hil.scheme.kernel.paper_kernel"]
    assert b"class Layout" in sources["adacd_hil.records"]
    assert b"def source_digest" in sources["adacd_hil.compiled"]
    assert not [name for name in sources if name.startswith(("adacd_hil.cli", "adacd_hil.lab.report"))]
    assert not [name for name in sources if name.startswith("adacd_hil.scheme.pipeline.")]


def test_a_result_depends_on_more_than_what_is_compiled() -> None:
    sources = all_sources(Path(__file__).resolve().parent.parent)
    assert {"adacd_hil.cli.main", "adacd_hil.scheme.pipeline.pipeline"} < set(sources)
    assert program_digest() != source_digest()


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's cache, the temporary folder and NUMBA_CACHE_DIR, as `user`, `temporary` and unset."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "user"))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    return tmp_path


def test_compiled_code_lies_in_the_users_cache_for_this_user_alone(places: Path) -> None:
    for _ in range(2):
        assert cache_folder("digest") == places / "user" / "adacd-hil" / "digest"
    for folder in (places / "user" / "adacd-hil", places / "user" / "adacd-hil" / "digest"):
        assert folder.stat().st_mode & 0o777 == 0o700


def make(folder: Path, kind: str) -> None:
    """Make what lies where a cache should: a folder that others can write, or that is theirs, a link, or a file."""
    if kind == "somebody else's" and os.geteuid():
        pytest.skip("only root can give a folder away")
    folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    if kind == "a link":
        (folder.parent / "elsewhere").mkdir()
        folder.symlink_to("elsewhere")
    elif kind == "a file":
        folder.touch()
    else:
        folder.mkdir()
        folder.chmod(0o1777 if kind == "for all" else 0o770)
        os.chown(folder, 12345 if kind == "somebody else's" else -1, -1)


OTHERS = ("somebody else's", "a link", "a file")


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        *(("adacd-hil", kind) for kind in OTHERS),
        *(("adacd-hil/digest", kind) for kind in ("for a group", "for all", *OTHERS)),
    ],
)
def test_a_cache_that_others_can_write_is_not_read(places: Path, name: str, kind: str) -> None:
    make(places / "user" / name, kind)
    own = places / "temporary" / f"adacd-hil-{os.geteuid()}"
    assert cache_folder("digest") == own / "digest"
    assert own.stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize("kind", OTHERS)
def test_where_every_known_folder_is_somebody_elses_there_is_a_new_one(places: Path, kind: str) -> None:
    make(places / "user", "a file")
    make(places / "temporary" / f"adacd-hil-{os.geteuid()}", kind)
    first, second = cache_folder("digest"), cache_folder("digest")
    assert first != second
    assert first.parent == second.parent == places / "temporary"
    assert first.stat().st_mode & 0o777 == 0o700


def test_a_cache_that_was_left_open_is_closed_to_others(places: Path) -> None:
    make(places / "user" / "adacd-hil", "for a group")
    assert cache_folder("digest") == places / "user" / "adacd-hil" / "digest"
    assert (places / "user" / "adacd-hil").stat().st_mode & 0o777 == 0o700


def test_the_folder_that_the_user_names_comes_first(places: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (places / "mine").mkdir(mode=0o700)
    (places / "named").symlink_to("mine")  # their own choice
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(places / "named"))
    assert cache_folder("digest") == places / "named" / "digest"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(places / "new" / "one"))
    assert cache_folder("digest") == places / "new" / "one" / "digest"


def test_a_named_folder_that_others_can_write_is_not_used_and_that_is_said(
    places: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make(places / "shared", "for all")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(places / "shared"))
    with pytest.warns(UserWarning, match="NUMBA_CACHE_DIR .*/shared is not used: not this user's alone"):
        assert cache_folder("digest") == places / "user" / "adacd-hil" / "digest"
    assert list((places / "shared").iterdir()) == []


TOTAL_OF_RECORDS = """
import sys
import numpy as np
from numba.core.caching import IndexDataCacheFile
from adacd_hil.compiled import _SharedCache, compiled

@compiled
def total(records):
    return records[0].last

def saying(word, function):
    def step(self, *arguments):
        print(word, flush=True)
        sys.stdin.readline()
        function(self, *arguments)
    return step

_SharedCache.save_overload = saying("compiled", _SharedCache.save_overload)
IndexDataCacheFile._save_index = saying("saving", IndexDataCacheFile._save_index)

for count in map(int, sys.argv[1:]):
    records = np.zeros(1, [("first", "f8", (count,)), ("last", "f8")])
    records["last"] = count
    assert total(records) == count
    print(sum(total.stats.cache_hits.values()), flush=True)
"""


@pytest.mark.long
@pytest.mark.slow
def test_processes_that_compile_for_different_types_at_once_take_nothing_from_each_other(tmp_path: Path) -> None:
    program = tmp_path / "total.py"
    program.write_text(TOTAL_OF_RECORDS)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}

    def start(*counts: int) -> "subprocess.Popen[str]":
        words = [sys.executable, str(program), *map(str, counts)]
        return subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)

    def go_on(process: "subprocess.Popen[str]") -> None:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()

    def said(process: "subprocess.Popen[str]") -> str:
        assert process.stdout is not None
        return process.stdout.readline()

    with start(3) as first, start(5) as second:
        assert (said(first), said(second)) == ("compiled\n", "compiled\n")
        go_on(first)
        assert said(first) == "saving\n"  # it has read the index, and has not written it yet
        with (tmp_path / "cache" / source_digest() / "lock").open("ab") as lock, pytest.raises(BlockingIOError):
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        go_on(second)
        assert first.communicate("\n") == ("0\n", None)
        assert second.communicate("\n") == ("saving\n0\n", None)
        assert (first.returncode, second.returncode) == (0, 0)
    assert start(3, 5).communicate() == ("1\n2\n", None)


SYMBOL_OF_A_LAYOUT = """
import sys
import numpy as np
from adacd_hil.compiled import compiled

@compiled
def last(records):
    return records[0]["last"]

last(np.zeros(1, [("first", "f8", (int(sys.argv[1]),)), ("last", "f8")]))
print(*(overload.fndesc.mangled_name for overload in last.overloads.values()))
"""


@pytest.mark.slow
def test_no_two_layouts_share_a_symbol_even_if_two_processes_compile_them(tmp_path: Path) -> None:
    """Of two functions below one symbol, a process that loads both from the cache runs one with the other's memory."""
    program = tmp_path / "last.py"
    program.write_text(SYMBOL_OF_A_LAYOUT)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}

    def symbol(count: int) -> str:
        return subprocess.check_output([sys.executable, str(program), str(count)], text=True, env=environment)

    assert symbol(3) != symbol(500)
    assert symbol(3) == symbol(3)


def test_a_disk_that_takes_no_compiled_code_costs_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("numba.core.caching.IndexDataCacheFile.save", full)
    assert compiled(lambda x: 2.0 * x)(1.5) == 3.0
