"""The stored reference runs: what they decide, their bits, and the bits of uncompiled code."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from hang import HANG_S
from reference_runs import (
    CYCLES,
    RUNS,
    SHARE,
    Reference,
    arithmetic,
    bit_differences,
    decision_differences,
    names,
    play,
)

from adacd_hil.control.operator import ScriptedOperator
from adacd_hil.device.device_files import place_devices
from adacd_hil.log.reader import RunLog
from adacd_hil.records import SchemeState
from adacd_hil.replay.log_source import LogSource
from adacd_hil.replay.replay import replay_source
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.run_settings import REACTIONS

RENEW = "if this is meant: python tests/reference/renew.py"
UNCOMPILED = {"certified-quick": 1000, "paper-quick": 750}
"""Runs that are played without compilation, and for how many cycles: each mode of either kernel."""


@pytest.fixture(scope="module", params=names())
def log(request, tmp_path_factory) -> tuple[str, RunLog]:
    """A run by its name, and its log now."""
    return request.param, play(request.param, tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def played(log: tuple[str, RunLog]) -> tuple[Reference, Reference]:
    """What is stored of a run, and what it comes to now."""
    name, now = log
    return Reference.stored(name), Reference.of(now)


@pytest.mark.slow
def test_a_reference_run_decides_as_stored(played: tuple[Reference, Reference]) -> None:
    stored, now = played
    is_same = stored.arithmetic == now.arithmetic
    differences = decision_differences(stored, now, *((0, 0.0) if is_same else (CYCLES, SHARE)))
    assert differences == [], RENEW


@pytest.mark.slow
def test_a_reference_run_has_the_stored_bits(played: tuple[Reference, Reference]) -> None:
    stored, now = played
    if stored.arithmetic != now.arithmetic:
        pytest.skip(f"bits are compared on {stored.arithmetic} only; here is {now.arithmetic}")
    assert bit_differences(stored, now) == [], RENEW


@pytest.mark.slow
def test_the_frames_of_a_reference_run_come_to_the_states_of_the_arm_and_the_decisions(log: tuple[str, RunLog]) -> None:
    """Taken in by pieces, where each cycle was taken in alone."""
    source = LogSource(log[1].path, cycles_per_piece=333)
    (found,) = replay_source(source, [source.settings], script_of=ScriptedOperator, by_frames=True)
    assert found.mismatches == ()
    assert found.arms_compared == found.compared == len(log[1].scheme) > 0


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("name", UNCOMPILED)
def test_uncompiled_code_comes_to_the_same_bits(name: str, tmp_path: Path) -> None:
    stored, cycles = Reference.stored(name), UNCOMPILED[name]
    if stored.arithmetic != arithmetic():
        pytest.skip(f"bits are compared on {stored.arithmetic} only; here is {arithmetic()}")
    program = (
        "import json, sys; from pathlib import Path; from reference_runs import Reference, play;"
        f"print(json.dumps(vars(Reference.of(play({name!r}, Path(sys.argv[1]), {cycles})))))"
    )
    root = RUNS.parents[2]
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        cwd=root,
        env={**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": f"{root}:{root / 'tests'}:{RUNS.parent}"},
        timeout=HANG_S,
    )
    assert done.returncode == 0, done.stderr
    uncompiled = Reference(**json.loads(done.stdout))
    assert bit_differences(stored.until(cycles), uncompiled.until(cycles)) == []


def test_the_runs_cover_both_schemes_and_every_contract() -> None:
    settings = [load_settings(str(RUNS / f"{name}.config.toml")) for name in names()]
    assert len(settings) >= 21
    assert {(one.scheme, one.devices.contract) for one in settings} == {
        ("paper", "arm"),
        ("paper", "arm_fd_500us"),
        ("paper", "arm_stock"),
        ("certified", "arm"),
        ("certified", "arm_fd"),
        ("certified", "arm_fd_500us"),
        ("certified", "arm_stock"),
        ("certified", ""),
    }


def test_the_runs_cover_a_host_that_follows_a_pipelined_one_gears_and_gravity() -> None:
    settings = [load_settings(str(RUNS / f"{name}.config.toml")) for name in names()]
    assert any(one.bus.follows for one in settings)
    assert any(one.bus.is_pipelined for one in settings)
    assert any(one.estimator.gravity for one in settings)
    ratios = {
        device.settings.scale.gear_ratio for one in settings for device in place_devices(one) if device.joint == 0
    }
    assert ratios >= {1.0, 50.0}


def test_the_runs_take_every_reaction() -> None:
    """By the level and the link of the contacts that are stored."""
    wishes = {name: load_settings(str(RUNS / f"{name}.config.toml")).reaction for name in names()}
    taken = {
        (wish.collision if contact["level"] == "COLLISION" else wish.contact)[contact["link"] - 1]
        for name, wish in wishes.items()
        for contact in Reference.stored(name).decisions["contacts"]
        if contact["link"] > 0
    }
    assert taken == set(REACTIONS) - {"none"}
    assert {wish.start for wish in wishes.values()} == {"desired", "measured"}


def test_the_runs_come_through_every_state() -> None:
    states = {state for name in names() for _, state, _ in Reference.stored(name).decisions["transitions"]}
    assert states == {state.name for state in SchemeState} - {"INIT"}  # nothing leads there


def test_a_difference_is_named_with_its_field_and_cycles() -> None:
    stored = Reference.stored("paper-quick")
    text = stored.bits["/scheme"]["tau_J"]
    changed = {**stored.bits["/scheme"], "tau_J": text.replace(text.split()[1], "00000000", 1)}
    now = Reference(stored.arithmetic, stored.decisions, {**stored.bits, "/scheme": changed})
    assert bit_differences(stored, now) == ["/scheme differs first in cycles 250 to 499: tau_J"]


def test_a_decision_that_moved_is_named_unless_it_is_near() -> None:
    stored = Reference.stored("paper-quick")
    cycle, *rest = stored.decisions["transitions"][0]
    moved = {**stored.decisions, "transitions": [[cycle + 2, *rest], *stored.decisions["transitions"][1:]]}
    now = Reference(stored.arithmetic, moved, stored.bits)
    assert decision_differences(stored, now) == [f"transitions[0][0]: {cycle} -> {cycle + 2}"]
    assert decision_differences(stored, now, CYCLES, SHARE) == []
    assert decision_differences(stored, now, CYCLES - 1, SHARE) != []
