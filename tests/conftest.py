"""The tests' own process: what it hands down to the programs that it starts, and which files it begins with."""

import gc
import os
import signal
from collections.abc import Iterator
from types import SimpleNamespace

import hypothesis
import pytest

hypothesis.settings.register_profile("untimed", deadline=None)  # an example may compile, or wait for a busy machine
hypothesis.settings.load_profile("untimed")
STARTS_WRITER = "adacd_hil.log.recording.recorder.start_module"
os.environ.pop("COLUMNS", None)  # pytest-xdist gives its workers 80; what no terminal shows has none
os.unsetenv("COLUMNS")  # readline, which pytest loads, sets it behind Python's back
for name in ("FORCE_COLOR", "CLICOLOR_FORCE"):  # as of a CI: what programs read has no colours
    os.environ.pop(name, None)
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell's job in the background: Ctrl-C would reach nobody
    signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup's children would inherit that it is ignored


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files that have slow tests: else one worker is left with them in the end."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


@pytest.fixture(autouse=True)
def _ordinary_priority() -> Iterator[None]:
    """Give back the real-time priority that a command in the tests' own process was granted."""
    yield
    if os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK != os.SCHED_OTHER:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@pytest.fixture(scope="session", autouse=True)
def _writer_thread() -> Iterator[None]:
    """Let threads write the logs of lockstep: see writer_thread.py."""
    from writer_thread import started

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(STARTS_WRITER, started)
        yield


@pytest.fixture(scope="session", autouse=True)
def _young_garbage() -> Iterator[None]:
    """Let a run look for garbage among young objects only: all of this process's take it 0.3 s each time."""
    from adacd_hil import scheduling

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scheduling, "gc", SimpleNamespace(**vars(gc) | {"collect": lambda: gc.collect(1)}))
        yield


@pytest.fixture
def writer_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a process write all logs of the test."""
    from adacd_hil.log.recording.processes import start_module

    monkeypatch.setattr(STARTS_WRITER, start_module)
