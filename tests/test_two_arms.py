"""Two arms on one bus in virtual time: the first host sends SYNC, the second follows it."""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from called import called
from loaded import loaded_contract
from rig import SessionRig, scripted
from two_arms_rig import FIRST, SECOND, TwoArms

from adacd_hil.cli.connection import received_ids
from adacd_hil.control.operator import ScriptedOperator
from adacd_hil.control.session import Session, SessionSummary
from adacd_hil.device.device_files import place_devices
from adacd_hil.log.reader import read_log
from adacd_hil.records import FaultReason, SchemeState
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings

pytestmark = pytest.mark.slow

PERIOD_NS = 2_000_000


def second_settings() -> Settings:
    """Configure the one of two arms that follows the other's SYNC, at 2 ms."""
    base = scripted(finish_s=0.4)
    return dataclasses.replace(
        base,
        bus=dataclasses.replace(base.bus, period_us=PERIOD_NS // 1000, arms=2, host_node=126, sync="follow"),
        devices=dataclasses.replace(base.devices, drive_node=(5, 6), sensor_node=(7, 8)),
    )


class WatchedSession(Session):
    """A session whose devices watch the host by time, though its clock is virtual."""

    is_lockstep = False


class Played(NamedTuple):
    """The two arms, and how the second one's run ended."""

    arms: TwoArms
    summary: SessionSummary


def play(folder: Path, dies_ns: int = 1 << 62) -> Played:
    """Play the second host to its end; dies_ns: when the first one falls silent."""
    settings = second_settings()
    arms, devices = TwoArms(settings, dies_ns=dies_ns), place_devices(settings)
    host = settings, loaded_contract(settings), devices, arms.end, arms.clock, ScriptedOperator(settings.operator)
    return Played(arms, WatchedSession(*host, folder, "embedded").run())


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    return play(tmp_path_factory.mktemp("two_arms"))


def test_the_second_host_moves_its_arm_by_the_first_ones_sync(played: Played) -> None:
    result = played.summary.result
    assert result is not None
    assert (result.fault, result.overruns, result.state) == (FaultReason.NONE, 0, SchemeState.ADAPT)
    log = read_log(played.summary.log.path)
    assert np.abs(np.degrees(log.scheme["q"][-1])).max() > 5.0
    assert (log.cycle["frames_missing"] > 0).sum() <= 1


def test_the_first_arm_is_not_disturbed(played: Played) -> None:
    states = played.arms.first.states
    assert states[-1].is_enabled
    assert {state.fault for state in states} == {FaultReason.NONE}
    assert [state.cycle for state in states if not state.is_complete] == []
    assert [event for event in played.arms.first.master.take_events() if event.level != "info"] == []
    assert np.abs(states[-1].q).min() > 0.1


def test_the_follower_sends_no_sync_and_nothing_that_is_not_its_own(played: Played) -> None:
    sent = {can_id for can_id, _ in played.arms.end.sent}
    assert sent == {0x000, 0x205, 0x206, 0x605, 0x606, 0x607, 0x608, 0x77E}


@pytest.mark.parametrize("arm", [FIRST, SECOND])
def test_on_a_shared_bus_nmt_names_a_node_of_the_own_arm(played: Played, arm: int) -> None:
    commands = [tuple(data) for can_id, data in played.arms.wire.ends[arm].sent if can_id == 0x000]
    nodes = [1 + 4 * arm, 2 + 4 * arm, 3 + 4 * arm, 4 + 4 * arm]
    assert {node for _, node in commands} == set(nodes)
    assert [node for command, node in commands if command == 0x82] == nodes


def test_the_devices_of_each_arm_have_the_set_up_of_their_own_host(played: Played) -> None:
    watched = [{device.value(0x1016, 1) >> 16 for device in bench.devices} for bench in played.arms.wire.benches]
    assert watched == [{127}, {126}]
    assert {bench.devices[0].value(0x1006) for bench in played.arms.wire.benches} == {2000}


def test_without_sync_the_follower_ends_with_one_line(tmp_path: Path) -> None:
    played = play(tmp_path, dies_ns=500 * PERIOD_NS)
    assert "no SYNC on shared within 100 ms" in played.summary.error
    assert [tuple(data) for can_id, data in played.arms.end.sent[-4:]] == [(0x80, node) for node in (5, 6, 7, 8)]


def test_an_arm_at_other_node_ids_runs_in_lockstep_on_a_bus_of_its_own(tmp_path: Path) -> None:
    devices = dataclasses.replace(load_settings("paper").devices, drive_node=(5, 6), sensor_node=(7, 8))
    settings = dataclasses.replace(scripted(finish_s=0.1), devices=devices)
    result, log = SessionRig(tmp_path, settings, codec=loaded_contract(settings), is_modelled=True).play()
    assert result.fault is FaultReason.NONE
    assert {0x185, 0x186, 0x187, 0x188} <= set(log.frames["can_id"].tolist())


@pytest.mark.parametrize(
    ("bus", "clock", "line"),
    [
        ("arms = 2\nperiod_us = 2000", "lockstep", "`bus.arms` = 2 hosts need --clock realtime"),
        ("arms = 2", "realtime", "contract arm: 2 × arm.dbc at 1000 µs doesn't fit: the cyclic frames need 1525 µs"),
        ('sync = "follow"', "realtime", "`bus.sync` = 'follow' needs another arm's host"),
        ("host_node = 2", "realtime", "`bus.host_node` = 2 is the node id of a device"),
    ],
)
def test_what_a_shared_bus_cannot_be_is_one_line(tmp_path: Path, bus: str, clock: str, line: str) -> None:
    config = tmp_path / "two.toml"
    config.write_text(f"[bus]\n{bus}\n")
    arguments = ["-i", "virtual", "-c", "x", "--config", str(config), "--clock", clock, "--out", str(tmp_path / "out")]
    ran = called("run", *arguments)
    assert ran.exit_code == 2
    (complaint,) = ran.stderr.splitlines()
    assert line in complaint


def test_the_receive_filter_has_what_only_this_host_sends_and_nothing_of_the_neighbour() -> None:
    settings = second_settings()
    heard = set(received_ids(loaded_contract(settings), settings, place_devices(settings)))
    assert heard >= {0x000, 0x080, 0x205, 0x206, 0x605, 0x608, 0x700 + settings.bus.host_node}
    assert {can_id & 0x7F for can_id in heard} - {0} == {5, 6, 7, 8, settings.bus.host_node}
