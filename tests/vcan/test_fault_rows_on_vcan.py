"""Rows of faults one after the other in one lockstep run on vcan: candump sees each do what it says, and nothing else.

The host tolerates all of them, so the run ends as asked, and its logs are those of the embedded bus.
"""

import contextlib
import itertools
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from experiment_runs import Played, Witness, candump, emulator, run_on_vcan
from mcap.reader import make_reader
from rig import SessionRig

from adacd_hil.log.log_files import TRUTH_NAME
from adacd_hil.log.reader import RunLog, read_log
from adacd_hil.settings.configuration import load_settings
from adacd_hil.wire.codec import load_codec
from adacd_hil.wire.e2e import crc8
from firmware_sim.bench.bench_time import TruthLog
from firmware_sim.scenario.scenario import load_scenario

pytestmark = [pytest.mark.vcan, pytest.mark.slow]

CODEC = load_codec()
SETTINGS = '[safety]\ntolerated_emergencies = [0x1000]\n[operator]\nscript = [{ at_s = 0.36, request = "finish" }]\n'
TORQUE1, TORQUE2, EMERGENCY2, FLOOD = 0x183, 0x184, 0x084, 0x7F0
CYCLIC = (0x181, 0x182, TORQUE1, TORQUE2)
ROWS = {
    "lose": 'node = "sensor1", frame = "torque", count = 3',
    "duplicate": 'node = "sensor2", frame = "torque", duration_s = 0.015',
    "corrupt": 'node = "sensor1", frame = "torque", bits = 2, count = 3',
    "delay within a period": 'node = "sensor1", frame = "torque", delay_us = 300.0, duration_s = 0.015',
    "delay beyond a period": 'node = "sensor2", frame = "torque", delay_us = 1500.0, duration_s = 0.015',
    "reorder": 'node = "sensor2", frame = "torque", count = 1',
    "freeze_counter": 'node = "sensor1", frame = "torque", count = 3',
    "emcy_storm": 'node = "sensor2", code = 0x1000, rate_Hz = 500.0, duration_s = 0.015',
    "babble": 'node = "drive1", can_id = 0x7F0, rate_Hz = 2000.0, duration_s = 0.015',
    "lose SYNC": 'frame = "sync", count = 1',
}
PLACES = {name: place for place, name in enumerate(ROWS)}

Group = list[tuple[int, bytes]]
"""Identifiers and data of what followed one SYNC."""


def scenario_text() -> str:
    rows = "\n".join(
        f'[[faults]]\nkind = "{name.split()[0]}"\nat_s = {0.03 * (place + 1):.2f}\n' + keys.replace(", ", "\n")
        for place, (name, keys) in enumerate(ROWS.items())
    )
    return f"start_deg = [-30.0, -60.0]\nseed = 7\n{rows}\n"


class Witnessed(NamedTuple):
    """The run, and what candump saw of it: `groups[k]` followed SYNC k."""

    played: Played
    groups: list[Group]
    truth: RunLog

    def cycles(self, name: str) -> list[int]:
        """Return the cycles in which a row was active, by the truth."""
        masks = self.truth.truth["faults"].astype(np.int64)
        return self.truth.truth["cycle"][masks >> PLACES[name] & 1 == 1].astype(int).tolist()

    def window(self, name: str) -> list[Group]:
        return [self.groups[cycle] for cycle in self.cycles(name)]

    def next_group(self, name: str) -> Group:
        return self.groups[self.cycles(name)[-1] + 1]

    def others(self, *names: str) -> Iterator[Group]:
        """Return the groups of the cycles from the first row to the last in which none of these acts."""
        taken = {cycle for name in names for cycle in (*self.cycles(name), self.cycles(name)[-1] + 1)}
        first, last = self.cycles("lose")[0], self.cycles("lose SYNC")[-1] + 20
        return (self.groups[cycle] for cycle in range(first, last) if cycle not in taken)


def count(groups: "list[Group] | Iterator[Group]", can_id: int) -> list[int]:
    """Count the frames with an identifier in each group."""
    return [sum(found == can_id for found, _ in group) for group in groups]


def counters(group: Group, can_id: int) -> list[int]:
    """Return the alive counters of the frames with an identifier, in their order."""
    return [data[1] & 0x0F for found, data in group if found == can_id]


def is_wrong(can_id: int, data: bytes) -> bool:
    """Whether the CRC doesn't fit."""
    return data[0] != crc8(bytearray(data), CODEC.by_id[can_id].data_ids[data[1] & 0x0F])


def wrong(groups: "list[Group] | Iterator[Group]") -> int:
    return sum(is_wrong(can_id, data) for group in groups for can_id, data in group if can_id == TORQUE1)


def order(group: Group) -> list[int]:
    return [can_id for can_id, _ in group if can_id in CYCLIC]


@pytest.fixture(scope="module")
def witnessed(tmp_path_factory: pytest.TempPathFactory) -> Witnessed:
    if not shutil.which("candump"):
        pytest.skip("candump (Debian package can-utils) is not installed")
    folder = tmp_path_factory.mktemp("faults")
    (folder / "scenario.toml").write_text(scenario_text())
    (folder / "settings.toml").write_text(SETTINGS)
    with contextlib.ExitStack() as stack:
        stack.enter_context(candump(folder / "candump.log"))
        stack.enter_context(emulator(folder, "--scenario", str(folder / "scenario.toml")))
        played = run_on_vcan(folder, "--clock", "lockstep", "--config", str(folder / "settings.toml"))
    witness = Witness(folder / "candump.log")
    if witness.dropped:
        pytest.skip(f"candump had no room for {witness.dropped} frames on this machine")
    return Witnessed(played, groups_of(witness), read_log(folder / TRUTH_NAME))


def groups_of(witness: Witness) -> list[Group]:
    """Split what candump saw at the SYNCs."""
    groups: list[Group] = []
    for line in witness.lines:
        can_id, _, data = line.split()[2].partition("#")
        if can_id == "080":
            groups.append([])
        elif groups:
            groups[-1].append((int(can_id, 16), bytes.fromhex(data)))
    return groups


@pytest.fixture(scope="module")
def embedded(witnessed: Witnessed, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Play the same in this process; return where the logs are."""
    folder, files = tmp_path_factory.mktemp("embedded"), witnessed.played.folder
    settings = load_settings(str(files / "settings.toml"))
    scenario = load_scenario(str(files / "scenario.toml"))
    with TruthLog(folder / TRUTH_NAME, blocking=True, scenario=scenario) as truth:
        watched = {"on_truth": truth.write, "on_event": truth.write_event}
        SessionRig(folder, settings, scenario, is_modelled=True, **watched).session.run()
    return folder


def messages(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Return what a log holds by topic: stamps and payloads."""
    found: dict[str, list[tuple[int, bytes]]] = {}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
            found.setdefault(channel.topic, []).append((message.log_time, message.data))
    return found


def test_the_host_goes_on_through_all_of_them(witnessed: Witnessed) -> None:
    assert (witnessed.played.status, witnessed.played.error_lines) == (0, [])


WITNESS: dict[str, tuple[Callable[[Witnessed], object], object]] = {
    "three torques are missing": (lambda w: count(w.window("lose"), TORQUE1), [0] * 3),
    "the other sensor's are not": (lambda w: count(w.window("lose"), TORQUE2), [1] * 3),
    "each torque comes twice": (lambda w: count(w.window("duplicate"), TORQUE2), [2] * 15),
    "and is the same": (
        lambda w: [len({data for can_id, data in group if can_id == TORQUE2}) for group in w.window("duplicate")],
        [1] * 15,
    ),
    "three torques have a wrong CRC": (lambda w: wrong(w.window("corrupt")), 3),
    "no others have": (lambda w: wrong(w.others("corrupt")), 0),
    "late torque comes last": (lambda w: {order(group)[-1] for group in w.window("delay within a period")}, {TORQUE1}),
    "in its own cycle": (lambda w: count(w.window("delay within a period"), TORQUE1), [1] * 15),
    "later torque comes a cycle later": (
        lambda w: count(w.window("delay beyond a period"), TORQUE2),
        [0] + [1] * 14,
    ),
    "the last one with one that is in time": (
        lambda w: count([w.next_group("delay beyond a period")], TORQUE2),
        [2],
    ),
    "one torque is missing": (lambda w: count(w.window("reorder"), TORQUE2), [0]),
    "it follows the next one": (
        lambda w: [(b - a) % 16 for a, b in itertools.pairwise(counters(w.next_group("reorder"), TORQUE2))],
        [15],
    ),
    "the counter stands still": (
        lambda w: len({counters(group, TORQUE1)[0] for group in w.window("freeze_counter")}),
        1,
    ),
    "with a CRC that fits": (lambda w: wrong(w.window("freeze_counter")), 0),
    "eight messages say 0x1000": (
        lambda w: [data[:2] for group in w.window("emcy_storm") for can_id, data in group if can_id == EMERGENCY2],
        [b"\x00\x10"] * 8,
    ),
    "a flood of 2 kHz": (lambda w: count(w.window("babble"), FLOOD), [2] * 15),
    "and then none": (lambda w: sum(count(w.others("babble"), FLOOD)), 0),
    "nobody answers the lost SYNC": (lambda w: [order(group) for group in w.window("lose SYNC")], [[]]),
    "but the next": (lambda w: sorted(order(w.next_group("lose SYNC"))), sorted(CYCLIC)),
    "one frame of each kind else": (
        lambda w: {
            tuple(sorted(order(group)))
            for group in w.others("lose", "duplicate", "delay beyond a period", "reorder", "lose SYNC")
        },
        {CYCLIC},
    ),
}


@pytest.mark.parametrize("what", WITNESS)
def test_candump_sees_what_a_fault_does_to_the_wire(witnessed: Witnessed, what: str) -> None:
    look, expected = WITNESS[what]
    assert look(witnessed) == expected


def test_each_fault_is_labelled_in_the_truth_with_the_times_of_its_first_and_first_healthy_cycle(
    witnessed: Witnessed,
) -> None:
    stamps = dict(zip(witnessed.truth.truth["cycle"].astype(int).tolist(), witnessed.truth.truth.t_ns, strict=True))
    found = [(e.t_ns, e.event.name, e.event.message.split(":")[0]) for e in witnessed.truth.events]
    expected = []
    for name, place in PLACES.items():
        cycles = witnessed.cycles(name)
        expected.append((stamps[cycles[0]], f"fault {place}", "begins"))
        expected.append((stamps[cycles[-1] + 1], f"fault {place}", "ends"))
    assert found == expected


@pytest.mark.parametrize("name", ["run.mcap", TRUTH_NAME])
def test_the_logs_are_those_of_the_embedded_bus_bit_for_bit(witnessed: Witnessed, embedded: Path, name: str) -> None:
    ours, theirs = messages(embedded / name), messages(witnessed.played.folder / name)
    assert [topic for topic in ours if ours[topic] != theirs.get(topic)] == []
    assert len(ours["/events"]) >= (2 * len(ROWS) if name == TRUTH_NAME else 3)
