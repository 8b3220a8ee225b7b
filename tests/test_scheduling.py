"""What a process asks of the operating system, and how it says what it was not granted."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import NoReturn

import pytest

from adacd_hil import scheduling
from adacd_hil.scheduling import RealtimeRequest, isolated_cpus, request_realtime
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.schema import ConfigError

ASKING = """
import json, os, subprocess, sys
from adacd_hil.scheduling import RealtimeRequest, request_realtime
child = [sys.executable, "-c", "import os; print(os.sched_getscheduler(0), *sorted(os.sched_getaffinity(0)))"]
before = sorted(os.sched_getaffinity(0))
grant = request_realtime(RealtimeRequest(priority=33, cpu=str(before[0])))
after = sorted(os.sched_getaffinity(0))
with grant.unpinned():
    heard = subprocess.check_output(child, text=True).split()
print(json.dumps({
    "before": before, "after": after, "again": sorted(os.sched_getaffinity(0)), "child": heard,
    "granted": grant.describe(), "missing": [str(refusal) for refusal in grant.missing],
    "locked": open("/proc/self/status").read().split("VmLck:")[1].split()[0],
    "policy": os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK, "priority": os.sched_getparam(0).sched_priority,
}))
"""


def test_what_is_said_to_be_granted_is_in_force_and_a_child_inherits_none_of_it() -> None:
    told = json.loads(subprocess.check_output([sys.executable, "-c", ASKING], text=True))
    is_fifo = told["granted"]["scheduler"] == "SCHED_FIFO 33"
    assert is_fifo is (told["policy"] == os.SCHED_FIFO and told["priority"] == 33)
    assert is_fifo is not any("SCHED_FIFO" in line for line in told["missing"])
    is_locked = told["granted"]["memory"] == "locked"
    assert is_locked is (int(told["locked"]) > 16_000)
    assert is_locked is not any("locked memory" in line for line in told["missing"])
    assert told["granted"]["cpu"] == str(told["before"][0])
    assert told["after"] == told["again"] == told["before"][:1]
    assert told["child"] == [str(os.SCHED_OTHER), *map(str, told["before"])]


def refuse(*_: object) -> NoReturn:
    raise PermissionError(1, "Operation not permitted")


def test_what_is_refused_is_said_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("sched_setscheduler", "sched_setaffinity", "open"):
        monkeypatch.setattr(scheduling.os, name, refuse)
    grant = request_realtime(RealtimeRequest(cpu="7", lock_memory=False))
    assert (grant.scheduler, grant.cpu, grant.is_awake) == ("SCHED_OTHER", None, False)
    for refusal, what, remedy in zip(
        grant.missing,
        ("processor 7", "SCHED_FIFO", "shallow idle states"),
        ("realtime.cpu", "limits.conf", "udev"),
        strict=True,
    ):
        assert refusal.reason.startswith(what)
        assert refusal.reason.endswith("Operation not permitted")
        assert remedy in refusal.remedy


def test_a_machine_without_idle_states_lacks_nothing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(scheduling, "_DMA_LATENCY", tmp_path / "none")
    grant = request_realtime(RealtimeRequest(scheduler="other", lock_memory=False))
    assert (grant.is_awake, grant.missing) == (False, ())


def test_an_isolated_processor_that_is_not_there_is_missed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(scheduling, "_DMA_LATENCY", tmp_path / "none")
    monkeypatch.setattr(scheduling, "isolated_cpus", lambda: ())
    grant = request_realtime(RealtimeRequest(scheduler="other", cpu="isolated", lock_memory=False))
    assert [refusal.reason for refusal in grant.missing] == ["isolated processor: there is none"]


def test_isolated_processors_are_read_from_the_kernels_list(tmp_path: Path) -> None:
    assert isolated_cpus(tmp_path) == ()
    for text, cpus in (("2-3,7\n", (2, 3, 7)), ("5", (5,)), ("\n", ())):
        (tmp_path / "isolated").write_text(text)
        assert isolated_cpus(tmp_path) == cpus


@pytest.mark.parametrize(
    ("section", "text"),
    [
        ({"cpu": "fast"}, "`realtime.cpu` = 'fast' must be a processor's number, 'isolated' or 'any'"),
        ({"cpu": "-1"}, "must be a processor's number"),
        ({"cpu": "1", "scheduler": "deadline"}, "refuses to a process that is pinned"),
        ({"priority": 99}, "`realtime.priority` = 99 is above 98"),
    ],
)
def test_a_request_that_cannot_be_served_is_refused_in_the_configuration(section: dict[str, object], text: str) -> None:
    with pytest.raises(ConfigError, match="realtime") as refused:
        parse(Settings, {"realtime": section})
    assert text in str(refused.value)


def test_the_configuration_says_what_is_asked_for() -> None:
    settings = parse(Settings, {"realtime": {"cpu": "isolated", "priority": 50}, "bus": {"period_us": 2000}})
    assert settings.realtime_request == RealtimeRequest("fifo", 50, "isolated", True, 2_000_000)
