"""The master against the emulated devices."""

from pathlib import Path

import numpy as np
import pytest
from loaded import loaded_contract
from rig import Rig

from adacd_hil.device.arm_report import describe_faults
from adacd_hil.device.device_files import place_devices
from adacd_hil.device.network import Master
from adacd_hil.records import ArmCommand, FaultReason
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.parsing import parse
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.dbc_contract import contract_folder

pytestmark = pytest.mark.slow

CONFIGURATIONS = ("paper", "fd", "fd_500us", "stock")


class NetworkRig(Rig):
    """Host and emulator in one process. `table`: what the host believes."""

    def __init__(self, table: dict[str, object] | None = None, config: str = "paper") -> None:
        self.cycle = 0
        codec = loaded_contract(load_settings(config))
        super().__init__(parse(Settings, table) if table else config, codec=codec)
        self.period_ns = self.settings.bus.period_ns

    def accept(self, frame: Frame) -> None:
        if not self.arm.accept(frame):
            self.master.accept(frame)

    def step(self, *tau: float, enable: bool = False) -> None:
        self.clock.sleep_until_ns(self.cycle * self.period_ns)
        self.arm.synchronise(self.cycle, self.cycle * self.period_ns, 1)
        while (frame := self.bus.receive(0.0)) is not None:
            self.accept(frame)
        self.arm.send_command(ArmCommand(np.array(tau or (0.0, 0.0)), enable, False))
        if self.cycle % 100 == 0:
            self.master.send_heartbeat()
        self.cycle += 1


def read(rig: NetworkRig, name: str, index: int, sub: int = 0) -> int:
    return int(next(slave for slave in rig.master.slaves if slave.name == name).read(index, sub))


@pytest.mark.parametrize("config", CONFIGURATIONS)
def test_the_emulated_devices_of_every_contract_are_set_up_enabled_and_moved(config: str) -> None:
    rig = NetworkRig(config=config)
    rig.start()
    for _ in range(400):
        rig.step(0.3, 0.1, enable=True)
    state = rig.arm.state()
    assert (state.is_enabled, state.is_complete, state.fault) == (True, True, FaultReason.NONE)
    assert state.dq.min() > 0.1
    np.testing.assert_allclose(state.tau_J, [0.3, 0.1], atol=0.1)
    assert describe_faults(rig.arm) == rig.master.failed_heartbeats(rig.cycle * rig.period_ns) == []


@pytest.mark.parametrize(("watch_host", "deadline_ms"), [(True, 10), (False, 0)])
def test_devices_watch_the_host_and_its_commands_but_in_lockstep(watch_host: bool, deadline_ms: int) -> None:
    rig = NetworkRig(config="stock")
    settings = load_settings("stock")
    rig.master = Master(settings, loaded_contract(settings), place_devices(settings), rig.bus, watch_host=watch_host)
    rig.start()
    assert read(rig, "Drive1", 0x1400, 5) == deadline_ms
    assert bool(read(rig, "Drive1", 0x1016, 1)) is watch_host


@pytest.mark.parametrize(("line", "why"), [("AccessType=ro", "read-only"), ("AccessType=rw", "")])
def test_a_heartbeat_whose_period_the_host_cant_set_is_named_and_not_watched(
    tmp_path: Path, line: str, why: str
) -> None:
    head, place, tail = (contract_folder() / "drive.eds").read_text().partition("[1017]")
    (tmp_path / "drive.eds").write_text(head + place + tail.replace("AccessType=rw", line, 1))
    (tmp_path / "own.toml").write_text('extends = "adacd-drive"\neds = "drive.eds"\n')
    rig = NetworkRig({"devices": {"drive": [str(tmp_path / "own.toml"), "adacd-drive"]}})
    rig.start()
    warnings = [event.message for event in rig.master.take_events() if event.name == "Drive1"]
    assert warnings == ([f"its heartbeat isn't watched: 0x1017 is {why} in its EDS"] if why else [])
    for _ in range(400):
        rig.step()
        failures = rig.master.failed_heartbeats(rig.cycle * rig.period_ns)
    assert failures == []  # an emulated drive to which nobody writes 0x1017 sends none


def test_an_emergency_is_an_event_with_name_watchdog_and_time_and_stays_until_reset() -> None:
    rig = NetworkRig()
    rig.start()
    rig.master.take_events()
    rig.accept(Frame(0x081, bytes.fromhex("5082 11 02 d2040000"), 0))
    text = "EMCY 0x8250: RPDO timeout, watchdog 2 (command) at device time 1234 ms"
    assert [(event.level, event.name, event.message) for event in rig.master.take_events()] == [
        ("warning", "Drive1", text)
    ]
    assert rig.master.describe_emergencies() == [f"Drive1: {text}"]
    rig.accept(Frame(0x081, bytes(8), 0))
    assert [event.message for event in rig.master.take_events()] == ["EMCY 0x0000: error reset"]
    assert rig.master.describe_emergencies() == []
