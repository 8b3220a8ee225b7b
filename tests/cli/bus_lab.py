"""A folder and an emulated arm for the commands that run on a bus: each opens the embedded one."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import pytest
from called import called
from click.testing import CliRunner, Result
from rig import Rig

from adacd_hil.clock import Clock
from adacd_hil.log.reader import RunLog, read_log
from adacd_hil.settings.parsing import parse
from adacd_hil.wire.bus import Bus
from firmware_sim.scenario.scenario import Scenario

USAGE, BUS_MISSING = 2, 5
OFFSET = (0.3, -0.2)
ON_BUS = ("-i", "embedded", "-c", "embedded", "--clock", "lockstep")
SHORT_RUN = '[operator]\nscript = [{at_s = 0.2, request = "finish"}]\n'


class Lab:
    """A folder, and an emulated arm that is there whenever a command opens the bus."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder = folder
        self.scenario: dict[str, Any] = {"start_deg": [-30.0, -60.0], "torque_offset_Nm": list(OFFSET)}
        self.serials: dict[int, int] = {}
        self.tare_file = folder / "tare.toml"
        self.settings_file = folder / "settings.toml"
        self.settings_file.write_text(SHORT_RUN)
        monkeypatch.setattr("adacd_hil.cli.connection.open_bus", self._open_bus)
        monkeypatch.setattr("adacd_hil.cli.commands.run_command.drop_old_frames", lambda bus, interface: None)
        monkeypatch.setattr("adacd_hil.cli.connection.is_virtual", lambda interface, channel: True)

    def _open_bus(self, interface: str, channel: str, clock: Clock, *_: object) -> Bus:
        rig = Rig(scenario=parse(Scenario, self.scenario), clock=clock)
        for index, serial in self.serials.items():
            rig.bench.devices[index].serve(0x1018, 4, lambda serial=serial: serial)
        return rig.bus

    def tare(self, *arguments: str) -> Result:
        return called("tare", *ON_BUS, "--seconds", "0.3", "--out", self.tare_file, *arguments)

    def run(self, *arguments: str) -> Result:
        config = ("--config", str(self.settings_file), "--out", str(self.folder))
        return called("run", *ON_BUS, "--json", *config, *arguments)

    @property
    def log(self) -> RunLog:
        return read_log(self.folder / "run.mcap")


def answered(monkeypatch: pytest.MonkeyPatch, ask: Callable[[], object], answer: str) -> Result:
    """Type an answer to a question on a terminal; what goes on prints `started`."""

    @click.command()
    def command() -> None:
        monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
        ask()
        print("started")

    return CliRunner().invoke(command, input=answer)
