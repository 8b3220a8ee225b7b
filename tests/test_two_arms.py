"""Two arms on one bus in virtual time: the first host sends SYNC, the second follows it."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from called import called
from loaded import loaded_contract
from rig import SessionRig, scripted
from two_arms_rig import FIRST, SECOND, TwoArms

from adacd_hil.cli.connection import received_ids
from adacd_hil.control.cycle import Cycle, RunResult
from adacd_hil.control.operator import ScriptedOperator
from adacd_hil.control.pacing import make_pacer
from adacd_hil.device.arm import Arm
from adacd_hil.device.device_files import place_devices
from adacd_hil.device.network import Master
from adacd_hil.log.reader import read_log
from adacd_hil.log.recording.recorder import Recorder
from adacd_hil.records import FaultReason, SchemeState
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.wire.bus import BusError, Tap

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


class Rig:
    """The two arms, and the second one's host with its log. `dies_ns`: when the first host falls silent."""

    def __init__(self, folder: Path, dies_ns: int = 1 << 62) -> None:
        settings = second_settings()
        arms = TwoArms(settings, dies_ns=dies_ns)
        self.wire, self.first, self.end, clock = arms.wire, arms.first, arms.end, arms.clock
        self.tap = Tap(self.end, clock)
        self.arm = Arm(settings, loaded_contract(settings), place_devices(settings), self.tap)
        self.master = Master(settings, loaded_contract(settings), place_devices(settings), self.tap)
        self.pacer = make_pacer(settings, clock, self.tap, self.arm.sync_id)
        operator = ScriptedOperator(settings.operator)
        self.cycle = Cycle(settings, self.tap, self.arm, self.master, self.pacer, operator, lambda _: None, clock)
        self.cycle.compile()
        self.path = folder / "run.mcap"
        self.recorder = Recorder(self.path, blocking=True)

    def run(self) -> RunResult:
        self.master.reset()
        self.master.identify()
        self.master.configure()
        self.master.start()
        try:
            return self.cycle.run(self.recorder)
        finally:
            self.master.stop()
            self.recorder.close()


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> tuple[Rig, RunResult]:
    rig = Rig(tmp_path_factory.mktemp("two_arms"))
    return rig, rig.run()


def test_the_second_host_moves_its_arm_by_the_first_ones_sync(played: tuple[Rig, RunResult]) -> None:
    rig, result = played
    assert (result.fault, result.overruns, result.state) == (FaultReason.NONE, 0, SchemeState.ADAPT)
    log = read_log(rig.path)
    assert np.abs(np.degrees(log.scheme["q"][-1])).max() > 5.0
    assert (log.cycle["frames_missing"] > 0).sum() <= 1


def test_the_first_arm_is_not_disturbed(played: tuple[Rig, RunResult]) -> None:
    rig, _ = played
    states = rig.first.states
    assert states[-1].is_enabled
    assert {state.fault for state in states} == {FaultReason.NONE}
    assert [state.cycle for state in states if not state.is_complete] == []
    assert [event for event in rig.first.master.take_events() if event.level != "info"] == []
    assert np.abs(states[-1].q).min() > 0.1


def test_the_follower_sends_no_sync_and_nothing_that_is_not_its_own(played: tuple[Rig, RunResult]) -> None:
    rig, _ = played
    sent = {can_id for can_id, _ in rig.end.sent}
    assert sent == {0x000, 0x205, 0x206, 0x605, 0x606, 0x607, 0x608, 0x77E}


@pytest.mark.parametrize("arm", [FIRST, SECOND])
def test_on_a_shared_bus_nmt_names_a_node_of_the_own_arm(played: tuple[Rig, RunResult], arm: int) -> None:
    rig, _ = played
    commands = [tuple(data) for can_id, data in rig.wire.ends[arm].sent if can_id == 0x000]
    nodes = [1 + 4 * arm, 2 + 4 * arm, 3 + 4 * arm, 4 + 4 * arm]
    assert {node for _, node in commands} == set(nodes)
    assert [node for command, node in commands if command == 0x82] == nodes


def test_the_devices_of_each_arm_have_the_set_up_of_their_own_host(played: tuple[Rig, RunResult]) -> None:
    rig, _ = played
    watched = [{device.value(0x1016, 1) >> 16 for device in bench.devices} for bench in rig.wire.benches]
    assert watched == [{127}, {126}]
    assert {bench.devices[0].value(0x1006) for bench in rig.wire.benches} == {2000}


def test_without_sync_the_follower_ends_with_one_line(tmp_path: Path) -> None:
    rig = Rig(tmp_path, dies_ns=500 * PERIOD_NS)
    with pytest.raises(BusError, match="no SYNC on shared within 100 ms"):
        rig.run()
    assert [tuple(data) for can_id, data in rig.end.sent[-4:]] == [(0x80, node) for node in (5, 6, 7, 8)]


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
