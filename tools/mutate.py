"""Breaks the arm's safety code on purpose, one small change at a time, and counts how many changes the tests notice.

    python tools/mutate.py                                       all targets, as the release check does
    python tools/mutate.py --sample 50 --seed 3                  a seeded sample of them, for a quick look
    python tools/mutate.py adacd_hil/control/gate.py             one target
    python tools/mutate.py some/module.py --tests some/test.py   any other module

Changes (one per mutant): comparisons, and/or/not, arithmetic and bit operators, integers and floats by one and in sign,
booleans, conditions negated, operands of and/or left out, return values dropped, statements dropped, min/max and
any/all swapped; in tables a row dropped; everywhere an enum member replaced by its neighbour. The last two are why this
is not mutmut or cosmic-ray: neither changes rows of tables nor members of enumerations, and tables of rows and members
are what decides here. Messages, annotations, decorators and docstrings stay.

Each mutant runs in a child forked from a process that has imported the third-party packages and nothing of this
project; an import hook hands the child the changed text. So nothing is written to the source tree. Nothing is compiled
by numba, whose cache is keyed by the files and would hide the changes.

A mutant that does the same as the original can be listed in tools/mutate_equivalent.toml with the reason. Such ones
run too, and count neither as killed nor as survivors; one that a test notices after all is an error.

Exit status: 0 enough were killed; 1 fewer than --require percent; 2 wrong usage, tests that fail without any change,
or a listed equivalent that was killed.
"""

import argparse
import ast
import contextlib
import copy
import enum
import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import json
import os
import random
import signal
import sys
import tempfile
import time
import tomllib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType
from typing import NoReturn

ROOT = Path(__file__).resolve().parent.parent
EQUIVALENT = ROOT / "tools" / "mutate_equivalent.toml"
TARGETS: dict[str, tuple[str, ...]] = {  # module: its quick tests as globs, quickest first
    "adacd_hil/control/gate.py": ("tests/control/test_gate.py",),
    "adacd_hil/wire/e2e.py": ("tests/wire/test_e2e*.py",),
    "adacd_hil/device/drive.py": ("tests/device/test_drive*.py",),
    "adacd_hil/scheme/supervisor/kept_request.py": ("tests/scheme/test_kept_request.py",),
    "adacd_hil/scheme/supervisor/supervisor.py": ("tests/scheme/test_supervisor.py",),
    "firmware_sim/nodes/drive_profile.py": (
        "tests/firmware_sim/test_drive_states_table.py",
        "tests/firmware_sim/test_drive_limits.py",
        "tests/firmware_sim/test_drive_node.py",
        "tests/firmware_sim/test_drive_stops.py",
    ),
}
WARM = ("pytest", "numpy", "hypothesis", "cantools", "can", "canopen", "numba", "scipy.signal")
SHORTEST_TIMEOUT_S = 20.0
SLOWNESS = 10.0  # a mutant may take this many times as long as the unchanged module: the machine is shared

KILLED, SURVIVED, EQUIVALENT_STATUS, TIMEOUT = "killed", "survived", "equivalent", "timeout"
_PASSED, _NOT_IMPORTED = 0, 90


@dataclass(frozen=True)
class Mutant:
    """One change of one file: bytes `start` to `end` of its text become `text`."""

    file: str
    line: int
    where: str  # class and function, empty outside of any
    kind: str
    start: int
    end: int
    text: str
    before: str  # the line or lines concerned, on one line
    after: str

    @property
    def key(self) -> "Key":
        """Return what identifies it in the list of equivalents."""
        return self.file, self.where, self.before, self.after

    def apply(self, source: bytes) -> bytes:
        """Return the changed text."""
        return source[: self.start] + self.text.encode() + source[self.end :]


Key = tuple[str, str, str, str]
"""File, where, before, after: what identifies a mutant in the list of equivalents, whatever its line number."""


@dataclass(frozen=True)
class Verdict:
    """What became of a mutant."""

    mutant: Mutant
    status: str
    by: str  # the test that noticed it


class UsageError(Exception):
    """What was asked can't be done; one line."""


# ------------------------------------------------------------------------------------------------ the changes

_COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
_OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.BitXor: ast.BitAnd,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
}
_SWAPPED_CALLS = {"min": "max", "max": "min", "any": "all", "all": "any"}


class _Finder(ast.NodeVisitor):
    """Collects the changes of one module. `enums`: the names in it that stand for enumerations."""

    def __init__(self, file: str, source: bytes, enums: dict[str, type[enum.Enum]]) -> None:
        self._file = file
        self._source = source
        self._enums = enums
        self._line_starts = [0]
        for line in source.splitlines(keepends=True):
            self._line_starts.append(self._line_starts[-1] + len(line))
        self._depth = 0  # of functions
        self._scope: list[str] = []
        self.mutants: list[Mutant] = []

    # -- places

    def _span(self, node: ast.expr | ast.stmt) -> tuple[int, int]:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        starts = self._line_starts
        return starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset

    def _add(self, node: ast.expr | ast.stmt, kind: str, text: str, span: tuple[int, int] | None = None) -> None:
        start, end = span or self._span(node)
        first = self._source.rfind(b"\n", 0, start) + 1
        last = self._source.find(b"\n", end)
        last = len(self._source) if last < 0 else last
        line = self._source.count(b"\n", 0, start) + 1
        before = _one_line(self._source[first:last])
        after = _one_line(self._source[first:start] + text.encode() + self._source[end:last])
        if before != after:
            self.mutants.append(Mutant(self._file, line, ".".join(self._scope), kind, start, end, text, before, after))

    def _replace(self, node: ast.expr, kind: str, new: ast.expr) -> None:
        self._add(node, kind, f"({ast.unparse(ast.fix_missing_locations(new))})")

    # -- expressions

    def visit_Compare(self, node: ast.Compare) -> None:
        for index, operator in enumerate(node.ops):
            for other in _COMPARISONS[type(operator)]:
                new = copy.deepcopy(node)
                new.ops[index] = other()
                self._replace(node, "comparison", new)
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        new = copy.deepcopy(node)
        new.op = ast.And() if isinstance(node.op, ast.Or) else ast.Or()
        self._replace(node, "and/or", new)
        for index in range(len(node.values)):
            left = node.values[:index] + node.values[index + 1 :]
            self._replace(node, "operand", left[0] if len(left) == 1 else ast.BoolOp(node.op, left))
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        self._replace(node, "unary operator", node.operand)
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        other = _OPERATORS.get(type(node.op))
        if other is not None:
            self._replace(node, "operator", ast.BinOp(node.left, other(), node.right))
        self.generic_visit(node)

    def visit_IfExp(self, node: ast.IfExp) -> None:
        self._replace(node.test, "condition", ast.UnaryOp(ast.Not(), node.test))
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        value = node.value
        if isinstance(value, bool):
            self._add(node, "constant", str(not value))
        elif isinstance(value, int | float):
            others = {value + 1, value - 1, -value} - {value}
            for other in sorted(others):
                self._add(node, "constant", f"({other!r})")

    def visit_Attribute(self, node: ast.Attribute) -> None:
        if isinstance(node.value, ast.Name) and node.value.id in self._enums:
            members = list(self._enums[node.value.id])
            names = [member.name for member in members]
            if node.attr in names and len(names) > 1:
                sibling = names[(names.index(node.attr) + 1) % len(names)]
                self._add(node, "enum member", f"{node.value.id}.{sibling}")
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        if isinstance(node.func, ast.Name) and node.func.id in _SWAPPED_CALLS:
            self._add(node.func, "min/max, any/all", _SWAPPED_CALLS[node.func.id])
        self.generic_visit(node)

    def visit_comprehension(self, node: ast.comprehension) -> None:
        for condition in node.ifs:
            self._replace(condition, "condition", ast.UnaryOp(ast.Not(), condition))
        self.generic_visit(node)

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """Leave messages as they are."""

    # -- statements

    def visit_Module(self, node: ast.Module) -> None:
        self._visit_body(node.body)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        self._scope.append(node.name)
        self._visit_body(node.body)
        self._scope.pop()

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        for default in (*node.args.defaults, *(d for d in node.args.kw_defaults if d is not None)):
            self.visit(default)
        self._depth += 1
        self._scope.append(node.name)
        self._visit_body(node.body)
        self._scope.pop()
        self._depth -= 1

    def _visit_body(self, body: Sequence[ast.stmt]) -> None:
        for statement in body:
            if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
                continue  # documentation
            if self._depth == 0 and isinstance(statement, ast.Assign | ast.AnnAssign) and statement.value is not None:
                self._count_wrong_rows(statement.value)
            self.visit(statement)

    def _count_wrong_rows(self, value: ast.expr) -> None:
        """Offer a table without each of its rows; of nested tables only dicts in dicts are tables again."""
        if isinstance(value, ast.Call):
            for argument in value.args:
                self._count_wrong_rows(argument)
        elif isinstance(value, ast.BinOp):
            self._count_wrong_rows(value.left)
            self._count_wrong_rows(value.right)
        elif isinstance(value, ast.Tuple | ast.List | ast.Set) and len(value.elts) > 1:
            for index, row in enumerate(value.elts):
                self._drop(row, value.elts[index - 1] if index else None, value.elts[index + 1 :])
        elif isinstance(value, ast.Dict):
            rows = [key if key is not None else row for key, row in zip(value.keys, value.values, strict=True)]
            for index, (first, row) in enumerate(zip(rows, value.values, strict=True)):
                self._drop(row, value.values[index - 1] if index else None, rows[index + 1 :], first)
                if isinstance(row, ast.Dict):
                    self._count_wrong_rows(row)

    def _drop(
        self, row: ast.expr, previous: ast.expr | None, following: Sequence[ast.expr], first: ast.expr | None = None
    ) -> None:
        """Drop a row with the comma before or after it."""
        start, end = self._span(first or row)[0], self._span(row)[1]
        stars = self._source[:start].rstrip()
        if first is row and stars.endswith(b"**"):
            start = len(stars) - 2
        if following:
            comma = self._source.find(b",", end)
            self._add(row, "row", "", (start, comma + 1))
        elif previous is not None:
            self._add(row, "row", "", (self._source.find(b",", self._span(previous)[1]) + 1, end))
        else:
            self._add(row, "row", "", (start, self._closing(end)))

    def _closing(self, end: int) -> int:
        """Return where a lone row ends, its comma included."""
        rest = self._source[end:].lstrip()
        return self._source.find(b",", end) + 1 if rest.startswith(b",") else end

    def visit_If(self, node: ast.If) -> None:
        self._replace(node.test, "condition", ast.UnaryOp(ast.Not(), node.test))
        self._visit_blocks(node)

    def visit_While(self, node: ast.While) -> None:
        self._replace(node.test, "condition", ast.UnaryOp(ast.Not(), node.test))
        self._visit_blocks(node)

    def _visit_blocks(self, node: ast.If | ast.While) -> None:
        self.visit(node.test)
        self._visit_body(node.body)
        self._visit_body(node.orelse)

    def visit_match_case(self, node: ast.match_case) -> None:
        if node.guard is not None:
            self._replace(node.guard, "condition", ast.UnaryOp(ast.Not(), node.guard))
        self.generic_visit(node)

    def visit_Return(self, node: ast.Return) -> None:
        is_none = node.value is None or (isinstance(node.value, ast.Constant) and node.value.value is None)
        if not is_none:
            self._add(node, "return value", "return None")
        self.generic_visit(node)

    def _drop_statement(self, node: ast.stmt) -> None:
        if self._depth:
            self._add(node, "statement", "pass")

    def visit_Expr(self, node: ast.Expr) -> None:
        self._drop_statement(node)
        self.generic_visit(node)

    def visit_Assign(self, node: ast.Assign) -> None:
        self._drop_statement(node)
        self.generic_visit(node)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        self._drop_statement(node)
        other = _OPERATORS.get(type(node.op))
        if other is not None:
            self._add(node, "operator", ast.unparse(ast.AugAssign(node.target, other(), node.value)))
        self.generic_visit(node)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self._drop_statement(node)
            self.visit(node.value)

    def visit_Raise(self, node: ast.Raise) -> None:
        self._drop_statement(node)

    def visit_Continue(self, node: ast.Continue) -> None:
        self._drop_statement(node)

    def visit_Break(self, node: ast.Break) -> None:
        self._drop_statement(node)


def _one_line(text: bytes) -> str:
    return " ".join(text.decode().split())


def find_mutants(file: str, source: bytes, module: ModuleType | None = None) -> list[Mutant]:
    """Return every change of a module, in the order of its text, each one compilable and different.

    `module`: the module itself, from which enumerations are known; without it their members stay.
    """
    names = vars(module) if module is not None else {}
    enums = {name: kind for name, kind in names.items() if isinstance(kind, type) and issubclass(kind, enum.Enum)}
    finder = _Finder(file, source, enums)
    finder.visit(ast.parse(source))
    unique: dict[bytes, Mutant] = {}
    for mutant in sorted(finder.mutants, key=lambda m: (m.start, m.end, m.text)):
        changed = mutant.apply(source)
        with contextlib.suppress(SyntaxError):
            compile(changed, file, "exec")
            unique.setdefault(changed, mutant)
    return list(unique.values())


# ------------------------------------------------------------------------------------------------ running them


class _ChangedModule(importlib.abc.MetaPathFinder):
    """Hands out one module with a changed text."""

    def __init__(self, file: str, source: bytes) -> None:
        self._name = _module_name(file)
        self._path = str(ROOT / file)
        self._code = compile(source, self._path, "exec")
        self.is_imported = False

    def find_spec(self, name: str, *_: object) -> importlib.machinery.ModuleSpec | None:
        if name != self._name:
            return None
        self.is_imported = True
        loader = _Loader(name, self._path, self._code)
        return importlib.util.spec_from_file_location(name, self._path, loader=loader)


class _Loader(importlib.machinery.SourceFileLoader):
    def __init__(self, name: str, path: str, code: object) -> None:
        super().__init__(name, path)
        self._changed = code

    def get_code(self, _fullname: str) -> object:  # type: ignore[override]
        return self._changed


class _FirstFailure:
    """A pytest plugin that writes down the first test that failed."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def pytest_runtest_logreport(self, report: object) -> None:
        self._note(report)

    def pytest_collectreport(self, report: object) -> None:
        self._note(report)

    def _note(self, report: object) -> None:
        if getattr(report, "failed", False) and not self._path.exists():
            self._path.write_text(str(getattr(report, "nodeid", "")))


def _module_name(file: str) -> str:
    return file.removesuffix(".py").replace("/", ".")


def _run_tests(file: str, source: bytes, tests: Sequence[str], note: Path) -> NoReturn:
    """Be the child: run the tests with the changed module, end with pytest's status."""
    status = 3
    try:
        quiet = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(quiet, stream)
        os.setpgid(0, 0)
        changed = _ChangedModule(file, source)
        sys.meta_path.insert(0, changed)
        import hypothesis
        import pytest

        phases = (hypothesis.Phase.explicit, hypothesis.Phase.generate)  # found is enough, no shortest example
        hypothesis.settings.register_profile("mutation", derandomize=True, database=None, phases=phases)
        hypothesis.settings.load_profile("mutation")
        already_imported = "ignore::pytest.PytestAssertRewriteWarning"
        arguments = ["-x", "-q", "-p", "no:cacheprovider", "-W", already_imported, "--rootdir", str(ROOT), *tests]
        status = int(pytest.main(arguments, plugins=[_FirstFailure(note)]))
        if status == _PASSED and not changed.is_imported:
            status = _NOT_IMPORTED
    except BaseException as error:  # nothing may leave the child but its status
        note.write_text(repr(error))
    finally:
        os._exit(status)


class Pool:
    """Forked children, at most `size` at once."""

    def __init__(self, size: int, folder: Path) -> None:
        self._size = size
        self._folder = folder
        self._running: dict[int, tuple[object, Path, float]] = {}
        self._started = 0

    def run(
        self, jobs: Iterator[tuple[object, str, bytes, Sequence[str], float]]
    ) -> Iterator[tuple[object, int | None, str]]:
        """Run jobs (key, file, source, tests, timeout s); yield (key, status or None for a time-out, first failure)."""
        waiting = True
        while waiting or self._running:
            while waiting and len(self._running) < self._size:
                job = next(jobs, None)
                if job is None:
                    waiting = False
                    break
                self._start(*job)
            yield from self._collect()
            time.sleep(0.005)  # children end, time out or say something: no one call waits for all three

    def _start(self, key: object, file: str, source: bytes, tests: Sequence[str], timeout_s: float) -> None:
        self._started += 1
        note = self._folder / str(self._started)
        sys.stdout.flush()
        sys.stderr.flush()
        child = os.fork()
        if child == 0:
            _run_tests(file, source, tests, note)
        self._running[child] = (key, note, time.monotonic() + timeout_s)

    def _collect(self) -> Iterator[tuple[object, int | None, str]]:
        for child, (key, note, deadline_s) in list(self._running.items()):
            ended, status = os.waitpid(child, os.WNOHANG)
            is_late = not ended and time.monotonic() > deadline_s
            if is_late:
                os.kill(child, signal.SIGKILL)
                os.waitpid(child, 0)
            if ended or is_late:
                del self._running[child]
                by = note.read_text() if note.exists() else ""
                yield key, None if is_late else os.waitstatus_to_exitcode(status), by


def _expand(globs: Sequence[str]) -> list[str]:
    tests = [str(path) for one in globs for path in sorted(ROOT.glob(os.path.relpath(ROOT / one, ROOT)))]
    if not tests:
        raise UsageError(f"no tests match {', '.join(globs)}")
    return tests


def _load_original(file: str) -> ModuleType:
    """Import a target in a throw-away manner: its names only, with nothing of the project left imported."""
    before = set(sys.modules)
    module = importlib.import_module(_module_name(file))
    for name in set(sys.modules) - before:
        if name.split(".")[0] in ("adacd_hil", "firmware_sim"):
            del sys.modules[name]
    return module


def _read_target(file: str) -> bytes:
    path = ROOT / file
    if not path.is_file():
        raise UsageError(f"{file} is not a file of {ROOT}")
    return path.read_bytes()


def _read_equivalent() -> dict[Key, str]:
    """Read the list: what identifies each mutant → the reason."""
    if not EQUIVALENT.exists():
        return {}
    entries = tomllib.loads(EQUIVALENT.read_text()).get("equivalent", [])
    for entry in entries:
        if set(entry) != {"file", "where", "before", "after", "reason"} or not entry["reason"]:
            raise UsageError(f"{EQUIVALENT.name}: an entry has file, where, before, after and reason: {entry}")
    return {(e["file"], e["where"], _squeeze(e["before"]), _squeeze(e["after"])): e["reason"] for e in entries}


def _squeeze(text: str) -> str:
    return " ".join(text.split())


def run(
    targets: dict[str, tuple[str, ...]], sample: int | None, seed: int, jobs: int
) -> tuple[list[Verdict], list[str]]:
    """Run the mutants of all targets; return the verdicts and what is wrong with the list of equivalents.

    Raises UsageError.
    """
    for name in WARM:
        importlib.import_module(name)
    listed = _read_equivalent()
    with tempfile.TemporaryDirectory(prefix="mutate-") as text:
        pool = Pool(jobs, Path(text))
        sources = {file: _read_target(file) for file in targets}
        tests = {file: _expand(globs) for file, globs in targets.items()}
        timeouts_s = _measure(pool, sources, tests)
        mutants = [m for file, source in sources.items() for m in find_mutants(file, source, _load_original(file))]
        keys = {mutant.key for mutant in mutants}
        problems = [f"{key[0]}: no such mutant: {key[3]}" for key in listed if key[0] in sources and key not in keys]
        if sample is not None and sample < len(mutants):
            mutants = sorted(random.Random(seed).sample(mutants, sample), key=lambda m: (m.file, m.start, m.text))
        work = ((m, m.file, m.apply(sources[m.file]), tests[m.file], timeouts_s[m.file]) for m in mutants)
        verdicts = []
        for mutant, status, by in pool.run(iter(work)):
            assert isinstance(mutant, Mutant)
            verdict = Verdict(mutant, _judge(mutant, status, listed), by)
            if verdict.status == EQUIVALENT_STATUS and status != _PASSED:
                problems.append(
                    f"{mutant.file}:{mutant.line}: listed as equivalent, but noticed by {by or 'a time-out'}"
                )
            verdicts.append(verdict)
            _show_progress(verdicts, len(mutants))
    print(file=sys.stderr)
    return sorted(verdicts, key=lambda v: (v.mutant.file, v.mutant.start, v.mutant.text)), problems


def _judge(mutant: Mutant, status: int | None, listed: dict[Key, str]) -> str:
    if status == _NOT_IMPORTED:
        raise UsageError(f"the tests of {mutant.file} don't import it")
    if mutant.key in listed:
        return EQUIVALENT_STATUS
    if status is None:
        return TIMEOUT
    return SURVIVED if status == _PASSED else KILLED


def _measure(pool: Pool, sources: dict[str, bytes], tests: dict[str, list[str]]) -> dict[str, float]:
    """Run the tests on the unchanged modules; return how long each target's mutants may take, in s."""
    timeouts_s = {}
    for file, source in sources.items():
        start_s = time.monotonic()
        ((_, status, by),) = pool.run(iter([(file, file, source, tests[file], 600.0)]))
        if status != _PASSED:
            raise UsageError(f"the tests of {file} fail without any change: {by or f'pytest status {status}'}")
        took_s = time.monotonic() - start_s
        timeouts_s[file] = max(SHORTEST_TIMEOUT_S, SLOWNESS * took_s)
        print(f"{file}: {took_s:.1f} s for its tests", file=sys.stderr)
    return timeouts_s


def _show_progress(verdicts: list[Verdict], total: int) -> None:
    counts = Counter(verdict.status for verdict in verdicts)
    words = ", ".join(f"{count} {status}" for status, count in sorted(counts.items()))
    print(f"\r{len(verdicts)}/{total}: {words}   ", end="", file=sys.stderr, flush=True)


# ------------------------------------------------------------------------------------------------ the report


def killed_percent(verdicts: Sequence[Verdict]) -> float:
    """Return the share of mutants that a test noticed, of those that aren't equivalent; a time-out is noticed."""
    counts = Counter(verdict.status for verdict in verdicts)
    killed = counts[KILLED] + counts[TIMEOUT]
    total = killed + counts[SURVIVED]
    return 100.0 * killed / total if total else 100.0


def print_table(verdicts: Sequence[Verdict]) -> None:
    """Print a row per file, then the survivors."""
    print(f"{'file':36} {'mutants':>8} {'killed':>7} {'time-out':>9} {'survived':>9} {'equivalent':>11} {'%':>7}")
    for file in dict.fromkeys(verdict.mutant.file for verdict in verdicts):
        of_file = [verdict for verdict in verdicts if verdict.mutant.file == file]
        counts = Counter(verdict.status for verdict in of_file)
        print(
            f"{file:36} {len(of_file):8} {counts[KILLED]:7} {counts[TIMEOUT]:9} {counts[SURVIVED]:9} "
            f"{counts[EQUIVALENT_STATUS]:11} {killed_percent(of_file):7.1f}"
        )
    for verdict in verdicts:
        if verdict.status == SURVIVED:
            mutant = verdict.mutant
            print(f"{mutant.file}:{mutant.line}: {mutant.kind}\n  - {mutant.before}\n  + {mutant.after}")


def main() -> int:
    """Parse, run, report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="*", help="modules, relative to the project; default: the table's")
    parser.add_argument("--tests", nargs="+", help="their tests, as globs; default: the table's")
    parser.add_argument("--sample", type=int, metavar="N", help="only N mutants, chosen by --seed")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="mutants at once; default: one per CPU")
    parser.add_argument("--require", type=float, default=95.0, metavar="PERCENT", help="exit status 1 below")
    parser.add_argument("--json", action="store_true", help="the verdict of every mutant on stdout")
    options = parser.parse_args()
    os.environ["NUMBA_DISABLE_JIT"] = "1"
    sys.path.insert(0, str(ROOT))
    os.chdir(ROOT)
    try:
        targets = _choose(options.targets, options.tests)
        verdicts, problems = run(targets, options.sample, options.seed, options.jobs)
    except UsageError as error:
        print(f"mutate: {error}", file=sys.stderr)
        return 2
    if options.json:
        rows = [asdict(verdict.mutant) | {"status": verdict.status, "by": verdict.by} for verdict in verdicts]
        print(json.dumps({"killed_percent": killed_percent(verdicts), "mutants": rows, "problems": problems}))
    else:
        print_table(verdicts)
    for problem in problems:
        print(f"mutate: {EQUIVALENT.name}: {problem}", file=sys.stderr)
    if problems:
        return 2
    return 0 if killed_percent(verdicts) >= options.require else 1


def _choose(files: Sequence[str], tests: Sequence[str] | None) -> dict[str, tuple[str, ...]]:
    chosen = list(files) or list(TARGETS)
    unknown = [file for file in chosen if file not in TARGETS]
    if unknown and tests is None:
        raise UsageError(f"which tests are {unknown[0]}'s? give them by --tests")
    return {file: tuple(tests) if tests is not None else TARGETS[file] for file in chosen}


if __name__ == "__main__":
    sys.exit(main())
