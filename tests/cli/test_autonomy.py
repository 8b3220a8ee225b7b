"""What acts by itself, and where it may: scripts, acknowledgements, arms without data."""

import dataclasses
import os
import pty
import signal
import subprocess
import sys
from pathlib import Path

import can
import pytest
from bus_lab import SHORT_RUN, USAGE, Lab
from called import called

from adacd_hil.cli.connection import check_autonomy, check_clock
from adacd_hil.cli.embedded_run import USER, resolve
from adacd_hil.cli.output import CommandError, ExitCode
from adacd_hil.scheduling import RealtimeGrant, scheduler_name
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.run_settings import OperatorSettings
from adacd_hil.settings.setting_keys import apply_settings
from adacd_hil.settings.toml_files import builtin_names
from adacd_hil.terminal import on_interrupt
from adacd_hil.wire.can_interface import InterfaceState, is_virtual

CERTIFIED = load_settings("certified")


def test_only_the_demo_s_own_configurations_act_by_script():
    acting = {name for name in builtin_names() if load_settings(name).operator != OperatorSettings()}
    assert acting == {"demo", "demo_paper"}
    assert load_settings("demo").operator == load_settings("demo_paper").operator


@pytest.mark.parametrize(("config", "base"), [("demo", "certified"), ("demo_paper", "paper")])
def test_but_for_its_user_a_configuration_of_the_demo_is_the_one_that_it_extends(config, base):
    own, plain = load_settings(config), load_settings(base)
    assert dataclasses.replace(own, name=base, operator=plain.operator) == plain


def test_a_configuration_without_a_script_gets_the_demo_s_user(tmp_path):
    mine = tmp_path / "my-arm.toml"
    mine.write_text('extends = "certified"\n[operator]\nscript = []\nacknowledge_after_s = 0.0\n')
    assert resolve(str(mine), "paper", None, None).settings.operator == load_settings(USER).operator
    assert resolve(str(mine), "push-link1", None, None).settings.operator.acknowledge_after_s == 0.6
    mine.write_text('extends = "certified"\n[operator]\nacknowledge_after_s = 2.0\nacknowledge_faults = 3\n')
    own = resolve(str(mine), "paper", None, None).settings.operator
    assert (own.script, own.acknowledge_faults) == (load_settings(USER).operator.script, 3)
    assert own.acknowledge_after_s == 2.0
    mine.write_text('extends = "certified"\n[operator]\nscript = [{ at_s = 1.0, request = "finish" }]\n')
    assert resolve(str(mine), "paper", None, None).settings.operator == load_settings(str(mine)).operator


def test_an_emulated_arm_says_what_its_motors_hold_unless_the_configuration_does(tmp_path):
    assert resolve("certified", "idle", None, None).settings.arm.holding_torque_Nm == (0.0, 0.0)
    geared = resolve("certified", "motor-side-friction", None, None)
    assert geared.settings.arm.holding_torque_Nm == geared.scenario.mechanics.motor_coulomb_Nm != (0.0, 0.0)
    cogging = resolve("certified", "torque-ripple", None, None)
    assert cogging.settings.arm.holding_torque_Nm == cogging.scenario.mechanics.ripple_Nm != (0.0, 0.0)
    mine = tmp_path / "my-arm.toml"
    mine.write_text('extends = "certified"\n[arm]\nholding_torque_Nm = [8.0, 4.0]\n')
    assert resolve(str(mine), "idle", None, None).settings.arm.holding_torque_Nm == (8.0, 4.0)
    assert load_settings("certified").arm.holding_torque_Nm is None


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("bus.max_age_cycles", "6", "lets an arm move without data"),
        ("data.blind_cycles", "6", "lets an arm move without data"),
        ("operator.acknowledge_after_s", "0.5", "acknowledges by itself"),
        ("operator.acknowledge_faults", "1", "acknowledges by itself"),
    ],
)
def test_on_what_may_be_hardware_nothing_is_driven_blind_or_acknowledged_by_itself(key, value, words):
    settings = apply_settings(CERTIFIED, {key: value})
    with pytest.raises(CommandError, match=f"`{key}` = {value} {words}") as refused:
        check_autonomy(settings, "pcan", "PCAN_USBBUS1")
    assert refused.value.code is ExitCode.USAGE
    check_autonomy(settings, "virtual", "x")


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"operator.acknowledge_after_s": "0.5", "operator.acknowledge_on_hardware": "true"},
        {"operator.script": '[{ at_s = 1.0, request = "finish" }]'},
    ],
)
def test_a_script_acknowledges_on_hardware_by_a_second_setting_and_ends_a_run_without(changes):
    check_autonomy(apply_settings(CERTIFIED, changes), "pcan", "PCAN_USBBUS1")


@pytest.mark.parametrize(
    ("kind", "expected"), [("vcan", True), ("vxcan", True), ("slcan", False), ("can", False), ("", False)]
)
def test_what_kind_an_interface_is_says_whether_a_wire_is_behind_it(monkeypatch, kind, expected):
    monkeypatch.setattr("adacd_hil.wire.can_interface.read_link", lambda _: InterfaceState("bus", True, kind, 16, 10))
    monkeypatch.setattr("adacd_hil.cli.connection.can_interfaces", lambda: ["bus"])
    assert is_virtual("socketcan", "bus") == expected
    assert is_refused("lockstep", "socketcan", "bus") != expected
    assert not is_refused("realtime", "socketcan", "bus")


def is_refused(clock: str, interface: str, channel: str) -> bool:
    """Tell whether a run by this clock is refused on this channel."""
    try:
        check_clock(clock, interface, channel)
    except CommandError as refused:
        return refused.code is ExitCode.USAGE
    return False


def test_lockstep_is_refused_on_an_adapter_and_a_name_that_is_not_there_is_left_to_who_opens_it():
    assert not is_virtual("socketcan", "no_such_can0")
    assert not is_virtual("pcan", "PCAN_USBBUS1")
    assert is_refused("lockstep", "pcan", "PCAN_USBBUS1")
    assert not is_refused("lockstep", "socketcan", "no_such_can0")
    assert not is_refused("lockstep", "virtual", "any")


IN_BACKGROUND = """
import os, sys, termios
from adacd_hil.cli.connection import never_stopped
os.setpgid(0, 0)  # out of the terminal's foreground
attributes = termios.tcgetattr(0)
with never_stopped():
    attributes[3] |= termios.TOSTOP
    termios.tcsetattr(0, termios.TCSANOW, attributes)
    print("written", flush=True)
    try:
        sys.stdin.readline()
    except OSError:
        os._exit(7)
"""


@pytest.mark.slow
def test_a_terminal_does_not_stop_who_runs_in_its_background():
    leader, terminal = pty.fork()
    if not leader:
        child = os.spawnl(os.P_NOWAIT, sys.executable, sys.executable, "-c", IN_BACKGROUND)
        _, status = os.waitpid(child, os.WUNTRACED)
        os._exit(100 if os.WIFSTOPPED(status) else os.waitstatus_to_exitcode(status))
    shown = os.read(terminal, 100)
    _, status = os.waitpid(leader, 0)
    os.close(terminal)
    assert os.waitstatus_to_exitcode(status) == 7
    assert b"written".startswith(shown.strip())  # as much as there was
    assert shown


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGTSTP])
def test_a_signal_asks_for_the_end(number):
    asked: list[int] = []
    before = signal.getsignal(number)
    further = [number] if number == signal.SIGTSTP else []  # Ctrl-Z, where an arm would be left alone
    with on_interrupt(lambda: asked.append(1), *further):
        signal.raise_signal(number)
    assert asked == [1]
    assert signal.getsignal(number) is before


def test_a_command_that_was_started_to_outlive_its_terminal_goes_on_after_a_hang_up():
    program = (
        "import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
        "from adacd_hil.terminal import on_interrupt\n"
        "with on_interrupt(lambda: print('asked')):\n"
        "    signal.raise_signal(signal.SIGHUP)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == ""


@pytest.mark.slow
@pytest.mark.parametrize("command", ["run", "tare", "commtest"])
def test_an_arm_that_has_a_host_is_left_to_it(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # The scheduler would be that of all tests that follow.
    monkeypatch.setattr("adacd_hil.control.session.request_realtime", lambda _: RealtimeGrant(scheduler_name()))
    with can.Bus(command, interface="virtual") as other:
        heartbeat = other.send_periodic(can.Message(arbitration_id=0x77F, data=[5], is_extended_id=False), 0.05)
        refused = called(command, "-i", "virtual", "-c", command)
        heartbeat.stop()
        assert other.recv(0.0) is None
    assert refused.exit_code == ExitCode.BUS_MISSING
    line = f"somebody else sends this host's heartbeat (0x77F) on {command}: end the other program; an arm has one host"
    assert line in refused.stderr.splitlines()[-1]


def test_a_channel_that_comes_while_the_run_begins_counts_as_hardware(tmp_path: Path, monkeypatch) -> None:
    lab = Lab(tmp_path, monkeypatch)
    lab.settings_file.write_text("[operator]\nacknowledge_after_s = 0.5\n" + SHORT_RUN.removeprefix("[operator]\n"))
    found = iter((False, False, True))
    monkeypatch.setattr("adacd_hil.cli.connection.may_be_hardware", lambda interface, channel: next(found))
    result = lab.run()
    assert (result.exit_code, "acknowledges by itself" in result.stderr) == (USAGE, True)
    assert next(found, None) is None
    assert not (tmp_path / "run.mcap").exists()
