"""Doctor's findings about an emulated arm in virtual time; what it sends is judged on the wire."""

import dataclasses
import json
from collections.abc import Callable
from importlib import resources
from typing import Any

import numpy as np
import pytest
from called import called
from commission.tare_rig import HandledRig
from loaded import encoded
from own_arm import describe_arm, describe_geared_arm
from rig import CODEC, Rig

from adacd_hil.device.device_files import place_devices
from adacd_hil.lab.cli.doctor_command import as_json, as_text
from adacd_hil.lab.commission.arm_checks import (
    ARM_CHECKS,
    ArmExamination,
    check_other_masters,
    check_pdo_map,
    check_position_scale,
)
from adacd_hil.lab.commission.host_checks import Check, Finding, Status, diagnose, failed, ok, summarise, warning
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.setting_keys import apply_settings
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.dbc_contract import load_codec
from firmware_sim.cli.own_devices import rehearse
from firmware_sim.nodes.device import NmtState
from firmware_sim.scenario.scenario import load_scenario

COMMAND = CODEC.message("Drive1Command")
pytestmark = pytest.mark.slow

PASSED = ("kernel", "interface", "controller")
EARLIER = [Finding(name, Status.OK, "", "") for name in PASSED]


def examination(rig: Rig, codec: Codec = CODEC, **more: Any) -> ArmExamination:
    return ArmExamination(
        rig.settings, codec, place_devices(rig.settings), rig.clock, lambda: rig.bus, lambda: None, **more
    )


def doctor(rig: Rig, ask: Callable[[str], None] | None = None, codec: Codec | None = None) -> dict[str, Finding]:
    patient = examination(rig, codec or rig.codec, ask=ask, cycle_s=0.4, move_s=1.0)
    findings = diagnose(ARM_CHECKS, patient, lambda finding: None, EARLIER)
    assert patient.leave() == ""
    return {finding.name: finding for finding in findings}


def statuses(findings: dict[str, Finding], status: Status) -> list[str]:
    return [name for name, finding in findings.items() if finding.status is status]


def test_a_sound_arm_passes_everything_but_what_it_lacks_and_is_asked_for_no_voltage_only():
    rig = Rig(is_wall=True)
    findings = doctor(rig)
    assert statuses(findings, Status.FAILED) == []
    assert statuses(findings, Status.WARNING) == ["protection"]
    assert statuses(findings, Status.SKIPPED) == ["joint 1", "joint 2"]
    assert findings["rate"].reason.startswith("SYNC 1000/s of 1000, Drive1 1000/s")
    assert findings["protection"].reason.startswith("unprotected: Drive1Feedback, Drive2Feedback")
    commands = [frame for frame in rig.sent if frame.can_id in (0x201, 0x202)]
    assert len(commands) > 800
    assert {tuple(map(int, COMMAND.decode_values(frame.data))) for frame in commands} == {(0, 0)}
    assert {device.state for device in rig.bench.devices} == {NmtState.PRE_OPERATIONAL}


def test_another_master_stops_the_examination_before_anything_is_sent():
    rig = Rig(is_wall=True)
    rig.start()
    rig.add_host()
    findings = doctor(rig)
    assert findings["other masters"].status is Status.FAILED
    assert findings["other masters"].reason == "somebody else sends SYNC (0x080)"
    assert rig.sent == []
    assert findings["cycle"].reason == "needs `other masters`, which failed"
    assert {device.state for device in rig.bench.devices} == {NmtState.OPERATIONAL}


@pytest.mark.parametrize(
    ("arms", "sync", "can_id", "reason"),
    [
        (1, "produce", 0x77F, "sends this host's heartbeat (0x77F)"),
        (1, "produce", 0x201, "commands drive 1 (0x201)"),
        (1, "produce", 0x000, "sends NMT commands (0x000)"),
        (1, "produce", 0x601, "writes objects of drive 1 (0x601)"),
        (2, "follow", 0x080, ""),
        (2, "produce", 0x080, "sends SYNC (0x080)"),
        (2, "follow", 0x000, ""),
        (2, "produce", 0x000, ""),
        (2, "follow", 0x201, "commands drive 1 (0x201)"),
        (2, "follow", 0x77F, "sends this host's heartbeat (0x77F)"),
    ],
)
def test_a_frame_of_a_host_shows_another_master_unless_it_may_be_the_neighbours(arms, sync, can_id, reason):
    rig = Rig(apply_settings(load_settings("paper"), {"bus.arms": str(arms), "bus.sync": sync}), is_wall=True)
    patient = examination(rig)
    patient.connect()
    rig.bus.deliver(can_id, b"\x05\x00\x00\x00\x00\x00")
    found = check_other_masters(patient)
    assert found.status is (Status.FAILED if reason else Status.OK)
    assert found.reason.removeprefix("somebody else ") == reason or not reason


def test_a_missing_node_fails_and_nothing_is_reset():
    rig = Rig(is_wall=True)
    rig.silence(2)
    findings = doctor(rig)
    assert findings["nodes"].reason == "node 2: missing: Drive2 expected"
    assert findings["nodes"].remedy
    assert not any(frame.can_id == 0x000 for frame in rig.sent)


def test_another_contract_is_told_and_stops_the_set_up(tmp_path):
    rig = Rig(is_wall=True)
    other = tmp_path / "other.dbc"
    other.write_bytes(CODEC.text.replace(b"0|32@1- (5.9921124526782858e-06,0)", b"0|32@1- (5e-06,0)"))
    findings = doctor(rig, codec=load_codec(other))
    assert findings["contract"].status is Status.FAILED
    assert "is not the DBC's 0x" in findings["contract"].reason
    assert findings["set-up"].reason == "needs `contract`, which failed"


@pytest.mark.parametrize(
    ("index", "subindex", "value", "reason"),
    [
        (0x1A00, 1, 0x60640010, "Drive1Feedback: mapped object 0x1A00:1 = 0x60640010, 0x60640020 expected"),
        (0x1A00, 0, 1, "Drive1Feedback: number of mapped objects 0x1A00 = 1, 2 expected"),
        (0x1800, 1, 0x80000181, "Drive1Feedback: identifier 0x1800:1 = 0x80000181, 0x181 expected"),
        (0x1400, 1, 0x00000211, "Drive1Command: identifier 0x1400:1 = 0x211, 0x201 expected"),
        (0x1600, 3, 0x60710010, "Drive1Command: mapped object 0x1600:3 = 0x60710010, 0x60400010 expected"),
    ],
)
def test_a_pdo_map_that_is_not_the_contract_is_told(index, subindex, value, reason):
    rig = Rig(is_wall=True)
    rig.bench.devices[0].serve(index, subindex, lambda: value)  # as if it had another mapping
    patient = examination(rig)
    patient.connect()
    finding = check_pdo_map(patient)
    assert finding.status is Status.FAILED
    assert reason in finding.reason


@pytest.mark.parametrize("describe", [describe_arm, describe_geared_arm])
def test_devices_of_one_s_own_pass(tmp_path, describe):
    """Sensors of 16 bits have their torque in 0x7130, and the drives theirs in objects of the maker, or in µNm.

    The maker's 0x2000 is no contract.
    """
    written = called("init", *describe(tmp_path))
    assert written.exit_code == 0, written.stderr
    config = str(tmp_path / "my-arm.toml")
    played = rehearse(config, "idle")
    rig = Rig(load_settings(config), played.scenario, codec=played.codec, is_wall=True, contract=played.contract)
    rig.bench.devices[0].serve(0x2000, 1, lambda: 7)
    findings = doctor(rig)
    assert statuses(findings, Status.FAILED) == []
    assert findings["PDO map"].status is Status.OK
    if describe is describe_geared_arm:
        text = "Drive1: 0x6076 = 400000 µNm x gear 50, 20 Nm at the joint, 0.1 % of it a count"
        assert text in findings["torque scale"].reason
    # Their sensors' EDS tells neither unit nor status, and maxon's no increments.
    blind = {"torque scale", "saturation"} | ({"position scale"} if describe is describe_geared_arm else set())
    assert blind == {"torque scale", "position scale", "saturation"} & set(statuses(findings, Status.WARNING))


@pytest.mark.parametrize(
    ("index", "device", "name"),
    [(0x608F, 1, "position scale"), (0x6132, 2, "torque scale"), (0x6076, 0, "torque scale")],
)
def test_a_scale_that_no_object_says_is_not_passed(index, device, name, monkeypatch):
    patient = examination(Rig(is_wall=True))
    patient.connect()
    look = {check.name: check.run for check in ARM_CHECKS}[name]
    assert look(patient).status is Status.OK
    slave = patient.master.slaves[device]
    has = slave.has
    monkeypatch.setattr(slave, "has", lambda at, sub=0: at != index and has(at, sub))
    finding = look(patient)
    assert finding.status is Status.WARNING
    assert [line.split(":")[0] for line in finding.reason.split("; ") if "nothing confirms" in line] == [slave.name]


@pytest.mark.parametrize(
    ("polarity", "status"), [(0x00, Status.OK), (0xE0, Status.OK), (0xC0, Status.WARNING), (0x40, Status.WARNING)]
)
def test_a_drive_that_reverses_position_and_not_torque_is_not_passed(polarity, status, monkeypatch):
    patient = examination(Rig(is_wall=True))
    patient.connect()
    slave = patient.master.slaves[1]
    has, read = slave.has, slave.read
    monkeypatch.setattr(slave, "has", lambda at, sub=0: at == 0x607E or has(at, sub))
    monkeypatch.setattr(slave, "read", lambda at, sub=0: polarity if at == 0x607E else read(at, sub))
    finding = check_position_scale(patient)
    assert finding.status is status
    assert f"Drive2: polarity 0x607E = 0x{polarity:02X}" in finding.reason


def test_a_value_outside_the_bounds_of_its_profile_fails(tmp_path):
    text = (resources.files("adacd_hil") / "device_profiles" / "adacd-sensor.toml").read_text()
    (tmp_path / "sensor.toml").write_text(text.replace('"error_register" }', '"error_register", low = 1 }'))
    sensor = str(tmp_path / "sensor.toml")
    settings = apply_settings(load_settings("paper"), {"devices.sensor": f'["adacd-sensor", "{sensor}"]'})
    finding = doctor(Rig(settings, is_wall=True))["devices"]
    assert finding.status is Status.FAILED
    assert finding.reason == "Sensor2: error_register 0, at least 1 allowed"


def test_a_drive_without_a_status_is_named():
    rig = Rig(is_wall=True)
    rig.tamper = lambda cycle, can_id, data: None if can_id == 0x281 else data
    finding = doctor(rig)["devices"]
    assert (finding.status, finding.reason.split(":")[0]) == (Status.WARNING, "Drive1")


@pytest.mark.parametrize(
    ("push", "has_noise", "name", "status", "text"),
    [
        (lambda k, q: (1.2, 0.0), True, "torque zero", Status.FAILED, "above 1"),
        (lambda k, q: (-0.3, 0.0), True, "torque zero", Status.WARNING, "more than the detection threshold"),
        (lambda k, q: (0.0, 0.0), False, "torque noise", Status.WARNING, "never changes"),
        (lambda k, q: (0.1 * (-1) ** k, 0.0), True, "torque noise", Status.WARNING, "three of it exceed"),
    ],
)
def test_a_torque_that_is_not_plausible_at_rest_is_told(push, has_noise, name, status, text):
    rig = HandledRig(scenario=dataclasses.replace(load_scenario("idle", "P"), noise=has_noise), is_wall=True)
    rig.push = push
    finding = doctor(rig)[name]
    assert finding.status is status
    assert text in finding.reason


def saturated(cycle: int, can_id: int, data: bytes) -> bytes:
    if can_id == 0x183:  # the header's status nibble
        return CODEC.message("Sensor1Torque").sender().protect(bytearray(data[:1] + b"\x20" + data[2:]))
    return b"\x02" + data[1:] if can_id == 0x283 else data


def moving(cycle: int, can_id: int, data: bytes) -> bytes:
    message = CODEC.message("Drive1Feedback")
    return bytes(encoded(message, message.decode_values(data)[0], 0.2)) if can_id == message.can_id else data


def creeping(cycle: int, can_id: int, data: bytes) -> bytes:
    message = CODEC.message("Drive2Feedback")
    return bytes(encoded(message, message.decode_values(data)[0] + 1e-4 * cycle, 0.0)) if can_id == 0x182 else data


def without_heartbeat(cycle: int, can_id: int, data: bytes) -> bytes | None:
    return None if can_id == 0x704 and data != b"\x00" else data


def losing(cycle: int, can_id: int, data: bytes) -> bytes | None:
    return None if can_id == 0x181 and cycle % 5 == 0 else data


@pytest.mark.parametrize(
    ("tamper", "name", "text", "skipped"),
    [
        (saturated, "saturation", "POSITIVE_OVERLOAD", "torque zero"),
        (moving, "rest", "|dq[joint1]| = 0.2 rad/s exceeds", "torque zero"),
        (creeping, "rest", "q[joint2] went through", "torque zero"),
        (without_heartbeat, "heartbeat", "no heartbeat from Sensor2", ""),
        (losing, "rate", "80.0 % of the periods complete", ""),
    ],
)
def test_what_a_device_sends_wrong_fails_its_check_and_skips_what_needs_it(tamper, name, text, skipped):
    rig = Rig(is_wall=True)
    rig.tamper = tamper
    findings = doctor(rig)
    assert findings[name].status is Status.FAILED
    assert text in findings[name].reason
    if skipped:
        assert findings[skipped].reason == f"needs `{name}`, which failed"


def move_by_hand(rig: HandledRig, speed_rad_s: tuple[float, float], torque_Nm: float) -> Callable[[str], None]:
    """Return an `ask` at which, asked for joint 1, the joints begin to move and both sensors see a torque."""
    begun: list[int] = []

    def since_s(cycle: int) -> float:
        return max(0, cycle - begun[0]) * 1e-3 if begun else 0.0

    def ask(line: str) -> None:
        if line.startswith("move joint 1 "):
            begun.append(rig.bench.cycle)

    rig.hand = lambda cycle: since_s(cycle) * np.array(speed_rad_s)
    rig.push = lambda cycle, q: np.full(2, torque_Nm * (since_s(cycle) > 5e-3))
    return ask


@pytest.mark.parametrize(
    ("speed_rad_s", "torque_Nm", "status", "text"),
    [
        ((0.5, 0.1), -0.3, Status.OK, "right joint, right signs"),
        ((0.5, 0.1), +0.3, Status.FAILED, "the torque has the motion's sign"),
        ((0.5, 0.1), 0.0, Status.WARNING, "too little torque"),
        ((-0.5, 0.1), -0.3, Status.FAILED, "position decreases toward +q"),
        ((0.1, 0.5), -0.3, Status.FAILED, "drive 2 reports the motion of joint 1"),
        ((0.5, 0.4), -0.3, Status.WARNING, "both joints moved"),
        ((0.05, 0.0), -0.3, Status.WARNING, "not moved by 10 deg in time"),
    ],
)
def test_a_joint_moved_by_hand_tells_its_order_and_signs(speed_rad_s, torque_Nm, status, text):
    rig = HandledRig(is_wall=True)
    finding = doctor(rig, move_by_hand(rig, speed_rad_s, torque_Nm))["joint 1"]
    assert finding.status is status
    assert text in finding.reason


def test_who_interrupts_learns_that_nodes_were_not_stopped(monkeypatch):
    def interrupt(_: ArmExamination) -> Finding:
        raise KeyboardInterrupt

    monkeypatch.setattr(ArmExamination, "leave", lambda _: "lab is gone")
    monkeypatch.setattr("adacd_hil.lab.cli.doctor_command.HOST_CHECKS", ())
    monkeypatch.setattr("adacd_hil.lab.cli.doctor_command.ARM_CHECKS", [Check("nodes", interrupt)])
    interrupted = called("doctor", "-i", "virtual", "-c", "lab")
    assert interrupted.exit_code == 130
    assert "nodes were not stopped: lab is gone; cut the drives' power" in interrupted.stderr


def test_a_check_whose_prerequisite_failed_is_skipped_with_the_reason_behind_it():
    checks = [
        Check("a", lambda _: failed("broken", "mend it")),
        Check("b", lambda _: ok("fine"), ("a",)),
        Check("c", lambda _: ok("fine"), ("b",)),
        Check("d", lambda _: warning("odd", "look at it")),
        Check("e", lambda _: ok("fine"), ("d",)),
    ]
    findings = diagnose(checks, None, lambda finding: None)
    assert [finding.status.value for finding in findings] == ["failed", "skipped", "skipped", "warning", "ok"]
    assert findings[2].reason == "needs `a`, which failed"
    assert summarise(findings) == "1 ok, 1 warning, 1 failed, 2 skipped"


def test_the_report_has_a_remedy_under_what_is_wrong():
    findings = [Finding("a", Status.OK, "fine", ""), Finding("bb", Status.FAILED, "broken", "mend it")]
    assert as_text(findings).splitlines() == [
        "ok      a   fine",
        "FAILED  bb  broken",
        "            -> mend it",
        "",
        "1 ok, 0 warning, 1 failed, 0 skipped",
        "FAILED   bb: mend it",
    ]
    assert json.loads(json.dumps(as_json(findings)))["checks"][1]["status"] == "failed"
