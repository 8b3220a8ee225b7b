"""What `run` asks before the arm moves, and what it says of a run that has broken off."""

from dataclasses import replace

import pytest
from bus_lab import SHORT_RUN, Lab, answered
from called import complaints

from adacd_hil.cli.commands.run_command import as_text, ask_without_anchor, next_of_run, summarise
from adacd_hil.cli.embedded_run import resolve, run_embedded
from adacd_hil.scheme.identify.anchor import unanchored_joints
from adacd_hil.settings.configuration_files import load_settings

SETTINGS = load_settings("certified")


LAST = replace(
    SETTINGS.history,
    date_utc="2026-11-22T10:00:00Z",
    friction_Nm=(0.1,) * 6,
    friction_std_Nm=(0.01,) * 6,
    inertia_kgm2=(0.2, 0.03, 0.02),
    inertia_std_kgm2=(0.01,) * 3,
    offset_Nm=(0.0, 0.0),
    offset_std_Nm=(0.01, 0.01),
)


def with_arm(**arm):
    return replace(SETTINGS, arm=replace(SETTINGS.arm, **arm))


@pytest.mark.parametrize(
    ("settings", "joints"),
    [
        (with_arm(holding_torque_Nm=None), [0, 1]),
        (with_arm(holding_torque_Nm=(0.0, 0.0)), []),
        (with_arm(holding_torque_Nm=(8.0, 0.05)), [0]),
        (with_arm(holding_torque_Nm=None, torque_offset_std_Nm=(0.005, 0.005)), []),
        (with_arm(holding_torque_Nm=None, torque_offset_std_Nm=(0.005, 0.03)), [1]),
        (replace(with_arm(holding_torque_Nm=None), history=LAST), []),
        (replace(with_arm(holding_torque_Nm=None), history=replace(LAST, offset_std_Nm=(0.03, 0.01))), [0]),
    ],
    ids=["nothing", "free motors", "one brake", "a tare", "a rough tare", "a last certificate", "a rough one"],
)
def test_a_joint_has_an_anchor_by_a_tare_a_last_certificate_or_a_motor_that_holds_little(settings, joints):
    assert unanchored_joints(settings) == joints


@pytest.mark.parametrize(("answer", "is_started"), [("y\n", True), ("\n", False)])
def test_on_a_terminal_the_user_says_that_an_arm_may_run_without_an_anchor(monkeypatch, answer, is_started):
    result = answered(monkeypatch, lambda: ask_without_anchor([1], "-i kvaser -c 0"), answer)
    assert (result.exit_code, "started" in result.stdout) == (0 if is_started else 1, is_started)
    assert "the torque offset of joint 2 has no bound" in result.stderr
    assert "`adacd-hil tare -i kvaser -c 0` first, then `run --tare tare.toml`" in result.stderr


def test_off_a_terminal_an_arm_without_an_anchor_is_refused_unless_that_is_told(tmp_path, monkeypatch):
    lab = Lab(tmp_path, monkeypatch)
    lab.settings_file.write_text('scheme = "certified"\n' + SHORT_RUN)
    monkeypatch.setattr("adacd_hil.cli.commands.run_command.may_be_hardware", lambda interface, channel: True)
    refused = lab.run()
    assert refused.exit_code == 2
    (line,) = complaints(refused)
    assert line.startswith("adacd-hil: the torque offset of joint 1 and joint 2 ")
    assert not (tmp_path / "run.mcap").exists()
    assert lab.run("--without-anchor").exit_code == 0


@pytest.mark.parametrize(
    ("assumed", "line"),
    [
        ([], None),
        (["arm.sign"], "`arm.sign`; `adacd-hil doctor` asks for each"),
        (
            ["arm.sign", "arm.joint", "arm.link_length_m", "arm.rated_torque_Nm", "devices.drive1.node", "bus.bitrate"],
            "`arm.sign`, `arm.joint`, `arm.link_length_m`, `arm.rated_torque_Nm` and 2 more; "
            "`adacd-hil config check` names all",
        ),
    ],
)
def test_a_run_names_at_once_what_nobody_has_confirmed(assumed, line, tmp_path, monkeypatch):
    lab = Lab(tmp_path, monkeypatch)
    lab.settings_file.write_text(f"assumed = {assumed}\n{SHORT_RUN}")
    first = lab.run().stderr.splitlines()[0]
    assert first == f"warning: unconfirmed guesses: {line}" if line else "unconfirmed" not in first


@pytest.mark.slow
def test_a_run_that_loses_its_devices_says_how_far_it_had_come(tmp_path):
    summary, _ = run_embedded(resolve("certified", "power-loss", None, None), "lockstep", tmp_path)
    assert summary.result is None
    told = summarise(summary)
    cycles, state = summary.reached
    assert cycles > 1000
    assert f"The run broke off in {state.name}, after {cycles} cycles" in as_text(told)
    assert next_of_run(told)
