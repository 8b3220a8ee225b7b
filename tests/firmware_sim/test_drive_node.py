"""The emulated drive against the standard: states, commands, torque, watchdogs; seen on the wire and in the arm."""

import struct

import pytest
from bench_host import BenchHost, Nmt, State, Word, in_state, quiet_scenario

from firmware_sim.nodes.drive_profile import TRANSITIONS, DriveEvent, DriveState

S, E = DriveState, DriveEvent
# CiA 402-2, written down by hand from its figure and table of transitions, independently of the code:
# state -> {event: next state}. What is absent changes nothing.
STANDARD = {
    S.START: {E.POWER_ON: S.NOT_READY_TO_SWITCH_ON},
    S.NOT_READY_TO_SWITCH_ON: {
        E.INITIALISED: S.SWITCH_ON_DISABLED,
        E.FAULT_DETECTED: S.FAULT_REACTION_ACTIVE,
    },
    S.SWITCH_ON_DISABLED: {
        E.SHUTDOWN: S.READY_TO_SWITCH_ON,
        E.FAULT_DETECTED: S.FAULT_REACTION_ACTIVE,
    },
    S.READY_TO_SWITCH_ON: {
        E.SWITCH_ON: S.SWITCHED_ON,
        E.ENABLE_OPERATION: S.SWITCHED_ON,
        E.QUICK_STOP: S.SWITCH_ON_DISABLED,
        E.DISABLE_VOLTAGE: S.SWITCH_ON_DISABLED,
        E.FAULT_DETECTED: S.FAULT_REACTION_ACTIVE,
    },
    S.SWITCHED_ON: {
        E.ENABLE_OPERATION: S.OPERATION_ENABLED,
        E.SHUTDOWN: S.READY_TO_SWITCH_ON,
        E.QUICK_STOP: S.SWITCH_ON_DISABLED,
        E.DISABLE_VOLTAGE: S.SWITCH_ON_DISABLED,
        E.FAULT_DETECTED: S.FAULT_REACTION_ACTIVE,
    },
    S.OPERATION_ENABLED: {
        E.SWITCH_ON: S.SWITCHED_ON,
        E.SHUTDOWN: S.READY_TO_SWITCH_ON,
        E.DISABLE_VOLTAGE: S.SWITCH_ON_DISABLED,
        E.QUICK_STOP: S.QUICK_STOP_ACTIVE,
        E.FAULT_DETECTED: S.FAULT_REACTION_ACTIVE,
    },
    S.QUICK_STOP_ACTIVE: {
        E.QUICK_STOP_DONE: S.SWITCH_ON_DISABLED,
        E.DISABLE_VOLTAGE: S.SWITCH_ON_DISABLED,
        E.ENABLE_OPERATION: S.OPERATION_ENABLED,
        E.FAULT_DETECTED: S.FAULT_REACTION_ACTIVE,
    },
    S.FAULT_REACTION_ACTIVE: {E.FAULT_REACTION_DONE: S.FAULT},
    S.FAULT: {E.FAULT_RESET: S.SWITCH_ON_DISABLED},
}


@pytest.mark.parametrize("state", list(DriveState))
def test_every_event_in_every_state_does_what_the_standard_says(state):
    assert {event: target for (source, event), target in TRANSITIONS.items() if source is state} == STANDARD[state]


def test_a_command_with_any_one_bit_flipped_changes_nothing(host):
    host.enable()
    for bit in range(48):
        host.step(Word.ENABLE, 100)
        frame = bytearray(host.command_frame(1, Word.ENABLE, 200))
        frame[bit // 8] ^= 1 << bit % 8
        host.put(0x201, frame)
        host.command(Word.ENABLE, 100, joints=(2,))
        host.sync()
        assert host.bench.drives[0].torque_Nm == pytest.approx(1.2)
        assert host.state_bits() == State.ENABLED
        assert host.bench.drives[0].rejected_commands == bit + 1


def test_a_repeated_command_counts_as_none(host):
    host.enable()
    frame = host.command_frame(1, Word.ENABLE, 100)
    for _ in range(4):
        host.put(0x201, frame)
        host.command(Word.ENABLE, 0, joints=(2,))
        host.sync()
    assert host.state_bits(1) == State.REACTION
    assert host.state_bits(2) == State.ENABLED


def test_two_syncs_without_command_are_forgiven_and_hold_the_torque_and_the_third_faults(host):
    host.enable()
    host.step(Word.ENABLE, 10)
    host.sync()
    host.sync()
    assert host.state_bits() == State.ENABLED
    assert host.bench.drives[0].torque_Nm == pytest.approx(0.12)
    host.take()
    host.sync()
    assert host.state_bits() == State.REACTION
    frames = host.take()
    assert (0x081, struct.pack("<HBBI", 0x8250, 0x11, 2, 6)) in frames
    assert (host.read(1, 0x603F), host.read(1, 0x6071)) == (0x8250, 0)
    status = next(data for can_id, data in frames if can_id == 0x281)
    assert struct.unpack("<HbhH", status)[3] == 0x8250


def test_bit_7_that_was_set_already_when_the_fault_came_resets_nothing(host):
    host.enable()
    host.step(Word.FAULT_RESET | Word.ENABLE)
    host.sync(times=20)
    assert host.state_bits() == State.FAULT
    host.step(Word.FAULT_RESET | Word.ENABLE)
    assert host.state_bits() == State.FAULT
    host.step(Word.ENABLE)
    host.step(Word.FAULT_RESET)
    assert host.state_bits() == State.DISABLED


def test_a_fault_reaction_ends_even_when_someone_keeps_pushing():
    contact = {"at_s": 0.05, "link": 1, "point_m": 0.3, "force_N": 40.0, "duration_s": 5.0}
    host = BenchHost(quiet_scenario(contacts=[contact]))
    host.enable()
    host.step(Word.ENABLE, times=100)
    host.sync(times=3)
    host.wait_until_at_rest()
    assert abs(host.true("dq")[0]) > 0.05
    assert host.state_bits(1) == State.FAULT


@pytest.mark.parametrize("command", [Nmt.STOP, Nmt.RESET_COMMUNICATION])
def test_leaving_operational_while_enabled_is_a_fault(command):
    host = in_state(State.ENABLED)
    host.step(Word.ENABLE, 300, times=30)
    host.take()
    host.nmt(command)
    assert host.bench.drives[0].state is DriveState.FAULT_REACTION_ACTIVE
    assert host.bench.drives[0].torque_Nm == 0.0
    assert host.taken(0x081)[0][:2] == b"\x00\x81"
    host.nmt(Nmt.START)
    host.wait_until_at_rest()
    assert host.state_bits() == State.FAULT
    host.step(Word.FAULT_RESET)
    assert host.state_bits() == State.DISABLED


def test_the_rpdo_deadline_faults_by_time(host):
    host.write(1, 0x1400, 5, 5)
    host.enable()
    host.bench.advance_to(host.bench.now_ns + 4_999_999)
    assert host.state_bits() == State.ENABLED
    host.bench.advance_to(host.bench.now_ns + 1)
    assert host.state_bits(1) == State.REACTION
    assert host.state_bits(2) == State.ENABLED
    assert host.read(1, 0x603F) == 0x8250


def test_feedback_carries_encoder_counts_and_velocity_as_served_by_sdo():
    host = BenchHost(quiet_scenario(start_deg=[-30.0, -60.0]))
    host.enable()
    host.step(Word.ENABLE, 300, times=20)
    host.take()
    host.sync()
    position, velocity = struct.unpack("<ii", host.taken(0x182)[0])
    assert position == pytest.approx(host.true("q")[1] * (1 << 20) / 6.283185307179586, abs=1.0)
    assert velocity == pytest.approx(host.true("dq")[1] / 5e-4, rel=0.2)
    assert (host.read(2, 0x6064), host.read(2, 0x606C)) == (position, velocity)


def test_status_comes_on_entering_operational_on_change_and_every_100_ms(host):
    host.nmt(Nmt.START)
    assert len(host.taken(0x281)) == 1
    host.sync(times=99)
    assert host.taken(0x281) == []
    host.sync(times=2)
    assert len(host.taken(0x281)) == 1
    host.step(Word.SHUTDOWN)
    assert [struct.unpack_from("<H", data)[0] & 0x6F for data in host.taken(0x281)] == [State.READY]
    host.write(1, 0x6060, 0, 10)
    assert [data[2] for data in host.taken(0x281)] == [10]


def test_status_keeps_its_inhibit_time(host):
    host.write(1, 0x1801, 1, 0x80000281)
    host.write(1, 0x1801, 3, 100)
    host.write(1, 0x1801, 1, 0x281)
    host.nmt(Nmt.START)
    host.take()
    for controlword in (Word.SHUTDOWN, Word.SWITCH_ON, Word.SHUTDOWN, Word.SWITCH_ON):
        host.step(controlword)
    assert host.taken(0x281) == []
    host.step(Word.SWITCH_ON, times=10)
    assert [data[0] & 0x6F for data in host.taken(0x281)] == [State.SWITCHED_ON]
